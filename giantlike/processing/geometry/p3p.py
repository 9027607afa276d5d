"""Perspective-three-point: poses of a body from three of its points, the minimal case of perspective-n-point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, unit

_REAL = 1e-4  # largest imaginary part of a real root over its size: rounding separates double roots


def poses_of_three_points(points_body_km: Float, rays_camera: Float) -> tuple[Float, Float]:
    r"""All poses for which three points of a body lie on three rays, for many triples at once.

    ``points_body_km`` (m, 3, 3); ``rays_camera`` (m, 3, 3), unit vectors from the camera to them; returns
    ``camera_from_body`` (k, 3, 3) and ``position_camera_km`` (k, 3).

    With the distances s, s (1 + h p) and s (1 + h t) to the points, the law of cosines in the three triangles with a
    corner at the camera reads, for :math:`2m_{ij} = |u_i - u_j|^2 / h^2` of the rays u and
    the sides :math:`d_{ij}` of the triangle,

    .. math::
        d_{13}^2 &= s^2 h^2 (t^2 + 2(1 + ht) m_{13}) \\
        d_{12}^2 &= s^2 h^2 (p^2 + 2(1 + hp) m_{12}) \\
        d_{23}^2 &= s^2 h^2 ((p - t)^2 + 2(1 + hp)(1 + ht) m_{23})

    Dividing by the first, the difference of the other two is linear in p, which leaves a quartic in t. With h the
    largest distance between two rays all coefficients are of order one at any range, and no differences of nearly
    equal cosines occur: a narrow field loses no digits.
    """
    triples, roots = _relative_distances(points_body_km, rays_camera)
    seen = rays_camera[triples] * roots[:, :, None]
    return _align(points_body_km[triples], seen)


def _relative_distances(points: Float, rays: Float) -> tuple[NDArray[np.int64], Float]:
    """Index (k,) of the triple of each solution, and its three distances (k, 3), km."""
    side = [np.sum((points[:, i] - points[:, j]) ** 2, axis=1) for i, j in ((1, 2), (0, 2), (0, 1))]
    apart = [np.sum((rays[:, i] - rays[:, j]) ** 2, axis=1) for i, j in ((1, 2), (0, 2), (0, 1))]
    h = np.sqrt(np.max(apart, axis=0))
    with np.errstate(divide="ignore", invalid="ignore"):
        m23, m13, m12 = (0.5 * gap / h**2 for gap in apart)
        a, c = side[0] / side[1], side[2] / side[1]
    one, zero = np.ones_like(h), np.zeros_like(h)
    # polynomials in t, lowest power first
    q = np.stack([2.0 * m13, 2.0 * h * m13, one])
    above = (a - c) * q + np.stack([2.0 * (m12 - m23), -2.0 * h * m23, -one])
    below = np.stack([2.0 * h * (m23 - m12), -2.0 + 2.0 * h * h * m23, zero])[:2]
    below2 = _product(below, below)
    quartic = _product(above, above)
    quartic = quartic + _pad(2.0 * m12 * below2, 5) + _pad(2.0 * h * m12 * _product(above, below), 5)
    quartic = quartic - c * _product(q, below2)
    roots, usable = _roots(quartic)
    triple, which = np.nonzero(usable)
    t = roots[triple, which]
    powers = np.stack([np.ones_like(t), t, t * t])
    with np.errstate(divide="ignore", invalid="ignore"):
        p = np.sum(above[:, triple] * powers, axis=0) / np.sum(below[:, triple] * powers[:2], axis=0)
        first = np.sqrt(side[1][triple] / np.sum(q[:, triple] * powers, axis=0)) / h[triple]
        distances = first[:, None] * np.stack([one[triple], 1.0 + h[triple] * p, 1.0 + h[triple] * t], axis=1)
    sound = np.isfinite(distances).all(axis=1) & (distances > 0.0).all(axis=1)
    return triple[sound], distances[sound]


def _product(first: Float, second: Float) -> Float:
    """Product of polynomials (i, m) and (j, m), lowest power first: (i + j - 1, m)."""
    result = np.zeros((len(first) + len(second) - 1, first.shape[1]))
    for power, coefficient in enumerate(first):
        result[power : power + len(second)] += coefficient * second
    return result


def _pad(polynomial: Float, length: int) -> Float:
    return np.pad(polynomial, [(0, length - len(polynomial)), (0, 0)])


def _roots(quartic: Float) -> tuple[Float, Mask]:
    """Real parts (m, 4) of the roots of quartics (5, m), lowest power first, and a mask of the real roots."""
    with np.errstate(divide="ignore", invalid="ignore"):
        monic = quartic[:4] / quartic[4]
    sound = np.isfinite(monic).all(axis=0)
    companion = np.zeros((quartic.shape[1], 4, 4))
    companion[:, [1, 2, 3], [0, 1, 2]] = 1.0
    companion[:, :, 3] = np.where(sound, -monic, 0.0).T
    roots = np.linalg.eigvals(companion)
    real = np.abs(roots.imag) < _REAL * (1.0 + np.abs(roots.real))
    return np.asarray(roots.real, dtype=np.float64), real & sound[:, None]


def _align(points_body: Float, seen_camera: Float) -> tuple[Float, Float]:
    """Rotations (k, 3, 3) and positions (k, 3) that take triples (k, 3, 3) of points to camera axes."""
    body_middle, seen_middle = points_body.mean(axis=1), seen_camera.mean(axis=1)
    frames = [_triad(triple - triple[:, :1]) for triple in (points_body, seen_camera)]
    rotations = frames[1] @ np.swapaxes(frames[0], -1, -2)
    return rotations, seen_middle - np.einsum("kij,kj->ki", rotations, body_middle)


def _triad(corners: Float) -> Float:
    """Axes (k, 3, 3), in columns, of triangles (k, 3, 3) whose first corner is the origin."""
    with np.errstate(divide="ignore", invalid="ignore"):
        along = unit(corners[:, 1])
        up = unit(np.cross(along, corners[:, 2]))
    return np.stack([along, np.cross(up, along), up], axis=-1)
