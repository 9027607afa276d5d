"""Triads of stars, described by the angles between them: what a calibrated camera sees of them anywhere on the sky."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask


def describe_triads(vectors: Float, triads: NDArray[np.intp]) -> tuple[Float, NDArray[np.intp], Mask]:
    """Sides of triads of unit vectors, and their stars in an order that the sides alone decide.

    The three interstar angles are the invariants of three directions under rotation [1]_; here as chords,
    ``2 sin(angle / 2)``, which need no arc cosine. A mirror keeps them and turns the sense over.

    Parameters
    ----------
    vectors : (n, 3) float64, unitless
        Unit vectors, in any frame.
    triads : (m, 3) int
        Indices into ``vectors``.

    Returns
    -------
    sides : (m, 3) float64, unitless
        Chords, longest first.
    ordered : (m, 3) int
        The same triads: star ``j`` lies opposite to side ``j``.
    right_handed : (m,) bool
        Whether the ordered stars have a positive triple product.

    References
    ----------
    .. [1] The ODIN paper (004 of the specification), Star Identification: eq. 7, and triads for calibrated cameras.
    """
    corners = vectors[triads]
    across = corners[:, [1, 2, 0]] - corners[:, [2, 0, 1]]
    opposite = np.sqrt(np.einsum("mij,mij->mi", across, across))
    order = np.argsort(-opposite, axis=1, kind="stable")
    ordered = np.take_along_axis(triads, order, axis=1)
    a, b, c = (vectors[ordered[:, j]] for j in range(3))
    right_handed: Mask = np.einsum("ij,ij->i", a, np.cross(b, c)) > 0.0
    return np.take_along_axis(opposite, order, axis=1), ordered, right_handed
