"""Shapes of star patterns: triads for a calibrated camera, quads for a camera of unknown focal length."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask

CODE_LOW, CODE_SPAN = 0.5 - np.sqrt(0.5), np.sqrt(2.0)
"""Lowest coordinate and diameter of the circle through (0, 0) and (1, 1) that contains C and D."""
# Pairs of the stars of a quad, and the other two stars of each.
_PAIRS = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
_REST = _PAIRS[::-1]


def describe_triads(vectors: Float, triads: NDArray[np.intp]) -> tuple[Float, NDArray[np.intp], Mask]:
    """Sides of triads of unit vectors, with the stars ordered by them.

    The three interstar angles are the invariants of three directions under rotation [1]_; here as chords,
    ``2 sin(angle / 2)``, which need no arc cosine. A mirror image has the same chords and the opposite sense.

    ``vectors`` (n, 3), unit vectors, in any frame; ``triads`` (m, 3); returns ``sides`` (m, 3), chords, longest first;
    ``ordered`` (m, 3); ``right_handed`` (m,), True if the ordered stars have a positive triple product.

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


def describe_quads(vectors: Float, quads: NDArray[np.intp]) -> tuple[Float, NDArray[np.intp], NDArray[np.intp]]:
    """Codes of quads of unit vectors: the positions of two stars in the frame of the two most distant ones.

    A similarity of the plane tangent to the sphere at the center of the quad takes the most distant stars, A and B, to
    (0, 0) and (1, 1); the positions of the other two, C and D, are the code [1]_. Only quads whose C and D lie in the
    circle over AB are kept. A is the end to which C and D are closer, C the star of smaller first coordinate.

    ``vectors`` (n, 3), unit vectors, in any right-handed frame; ``quads`` (m, 4), indices into ``vectors``; returns
    ``codes`` (k, 4), C and D, scaled from the extent of the circle to [0, 1]; ``ordered`` (k, 4), indices of A, B, C
    and D of the quads kept; ``which`` (k,).

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
