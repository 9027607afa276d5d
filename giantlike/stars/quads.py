"""Quads of stars, described by their shape alone: what a camera of unknown focal length sees of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float

CODE_LOW, CODE_SPAN = 0.5 - np.sqrt(0.5), np.sqrt(2.0)
"""The circle through (0, 0) and (1, 1) reaches from the first of these over a width of the second."""
_PAIRS = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
_REST = np.array([[2, 3], [1, 3], [1, 2], [0, 3], [0, 2], [0, 1]])


def describe_quads(vectors: Float, quads: NDArray[np.intp]) -> tuple[Float, NDArray[np.intp], NDArray[np.intp]]:
    """Codes of quads of unit vectors: where two stars lie in the frame that the two outermost ones make.

    The stars furthest apart, A and B, are put at (0, 0) and (1, 1) by a similarity of the plane that touches the
    sphere at the middle of the quad; the places of the other two, C and D, are the code [1]_. Only quads whose C and
    D lie in the circle over AB count. Of the two ways to name A and B the one is taken in which C and D lie nearer
    to A, then C is the one of smaller first coordinate.

    Parameters
    ----------
    vectors : (n, 3) float64, unitless
        Unit vectors, in any right-handed frame.
    quads : (m, 4) int
        Indices into ``vectors``.

    Returns
    -------
    codes : (k, 4) float64, unitless
        C and D, brought from the circle's extent to [0, 1].
    ordered : (k, 4) int
        Indices of A, B, C and D of the quads that count.
    which : (k,) int
        Their row in ``quads``.

    References
    ----------
    .. [1] The ODIN paper (004 of the specification), Star Identification: quads for uncalibrated cameras.
    """
    corners = vectors[quads]
    apart = np.einsum("mij,mkj->mik", corners, corners)[:, _PAIRS[:, 0], _PAIRS[:, 1]]
    longest = np.argmin(apart, axis=1)
    order = np.concatenate([_PAIRS, _REST], axis=1)[longest]
    corners = np.take_along_axis(corners, order[..., None], axis=1)
    middle = corners.sum(axis=1)
    middle /= np.linalg.norm(middle, axis=1)[:, None]
    plane = corners / np.einsum("mij,mj->mi", corners, middle)[..., None]
    base = plane[:, 1] - plane[:, 0]
    across = np.cross(middle, base)
    away = plane[:, 2:] - plane[:, :1]
    length = np.sum(base**2, axis=1)[:, None]
    x, y = np.einsum("mij,mj->mi", away, base) / length, np.einsum("mij,mj->mi", away, across) / length
    places = np.stack([x - y, x + y], axis=-1)
    which = np.flatnonzero((np.sum((places - 0.5) ** 2, axis=2) <= 0.5).all(axis=1))
    places, ordered = places[which], np.take_along_axis(quads, order, axis=1)[which]
    swap = places[:, :, 0].sum(axis=1) > 1.0
    places[swap] = 1.0 - places[swap]
    ordered[swap, :2] = ordered[swap, 1::-1]
    turn = places[:, 0, 0] > places[:, 1, 0]
    places[turn] = places[turn, ::-1]
    ordered[turn, 2:] = ordered[turn, 3:1:-1]
    codes: Float = (places.reshape(-1, 4) - CODE_LOW) / CODE_SPAN
    return codes, ordered, which
