r"""Wahba's problem: the rotation that best maps one set of directions to another.

Three methods for one problem. Davenport's q-method: the unit quaternion that maximizes :math:`q^T K q` is the
eigenvector of the largest eigenvalue of the symmetric 4x4 matrix K. The singular value decomposition: the rotation
nearest to the profile matrix B, the weighted sum of the outer products. The Euler axis by cross products (ESOQ2): the
largest eigenvalue from the characteristic polynomial of K, then axis and angle in closed form.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, as_finite, as_unit, require
from giantlike.core.outcomes import Failure, Reason

MAX_SIGMA_RAD = 0.5
"""Largest standard deviation of an attitude about any axis, rad: larger errors are not small rotations."""

_NEWTON_STEPS = 30  # bound; Newton's method stops at the rounding of float64


class WahbaMethod(StrEnum):
    """Solver of Wahba's problem; all methods minimize the same sum."""

    Q_METHOD = "q_method"  # eigenvector of Davenport's matrix: the most robust
    SVD = "svd"  # singular values of the profile matrix
    ESOQ2 = "esoq2"
    """Axis and angle in closed form, without a decomposition. In a narrow field it loses digits of the roll."""


def solve_wahba(
    vectors_inertial: ArrayLike,
    vectors_camera: ArrayLike,
    sigma_rad: ArrayLike,
    *,
    method: WahbaMethod = WahbaMethod.Q_METHOD,
) -> tuple[Rotation, Float] | Failure:
    r"""Attitude from pairs of directions, each weighted by its inverse variance.

    Minimizes :math:`\frac12\sum_i \sigma_i^{-2} \|b_i - T a_i\|^2` over rotations T.

    ``vectors_inertial``, ``vectors_camera`` (n, 3), unit vectors a_i (inertial) and b_i (camera axes) of the same
    stars, n >= 2; ``sigma_rad`` (n,) or scalar; returns ``camera_from_inertial``; ``covariance_rad2``: of the small
    rotation e about the camera axes with
    ``camera_from_inertial_true = Rotation.from_rotvec(e) * camera_from_inertial``: the inverse of
    :math:`\sum_i \sigma_i^{-2} (I - b_i b_i^T)`.

    Source: Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, eq. 2.
    """
    a, b = as_unit(vectors_inertial, "vectors_inertial"), as_unit(vectors_camera, "vectors_camera")
    require(a.ndim == 2 and a.shape == b.shape, f"vectors must both have shape (n, 3), got {a.shape} and {b.shape}")
    n = len(a)
    sigma = (
        np.full(n, float(np.asarray(sigma_rad))) if np.ndim(sigma_rad) == 0 else as_finite(sigma_rad, (n,), "sigma_rad")
    )
    require(bool((sigma > 0).all()), "sigma_rad must be > 0")
    if n < 2:
        return Failure(Reason.DEGENERATE_GEOMETRY, f"an attitude needs at least 2 directions, got {n}")
    weights = sigma**-2
    information = np.eye(3) * weights.sum() - np.einsum("i,ij,ik->jk", weights, b, b)
    weakest = float(np.linalg.eigvalsh(information)[0])
    if not weakest > MAX_SIGMA_RAD**-2:
        return Failure(
            Reason.DEGENERATE_GEOMETRY,
            f"{n} directions determine the rotation about one axis only to {max(weakest, 1e-30) ** -0.5:.2g} rad: "
            "they lie along one line, or are too uncertain",
        )
    rotation = _rotation(a, b, weights, method)
    covariance: Float = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return rotation, covariance


def davenport_quaternions(vectors_inertial: Float, vectors_camera: Float, weights: ArrayLike = 1.0) -> Float:
    """Quaternions (..., 4) camera_from_inertial, scalar last, of Wahba problems (..., n, 3) by the q-method."""
    weighted = np.asarray(weights)[..., None] * vectors_camera
    profile = np.swapaxes(weighted, -1, -2) @ vectors_inertial  # sum of w b a^T
    return np.linalg.eigh(_davenport(profile))[1][..., -1]


def _rotation(a: Float, b: Float, weights: Float, method: WahbaMethod) -> Rotation:
    if method is WahbaMethod.Q_METHOD:
        return Rotation.from_quat(davenport_quaternions(a, b, weights))
    profile = np.einsum("i,ij,ik->jk", weights / weights.sum(), b, a)
    if method is WahbaMethod.SVD:
        left, _, right = np.linalg.svd(profile)
        proper = np.diag([1.0, 1.0, np.linalg.det(left) * np.linalg.det(right)])
        return Rotation.from_matrix(left @ proper @ right)
    return _esoq2(profile)


def _esoq2(profile: Float) -> Rotation:
    """Rotation of a profile matrix (3, 3) of unit weight, by axis and angle.

    With t the trace of B, S = B + B^T and z its antisymmetric part, ``K q = l q`` for ``q = (e sin, cos)`` of half the
    angle reads ``(l - t) cos = z.e sin`` and ``M e = 0``, ``M = (l - t) ((l + t) I - S) - z z^T``: the axis e is the
    cross product of two rows of M. This fails for the identity, so the inertial axes are first rotated by 180 deg about
    the coordinate axis that gives the largest angle, the smallest trace.
    """
    flips = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
    flip = flips[np.argmin(flips @ np.diag(profile))]
    turned = profile * flip
    davenport = _davenport(turned)
    largest = _largest_eigenvalue(davenport)
    trace, z = davenport[3, 3], davenport[:3, 3]
    matrix = (largest - trace) * ((largest + trace) * np.eye(3) - turned - turned.T) - np.outer(z, z)
    crosses = np.stack([np.cross(matrix[i], matrix[j]) for i, j in ((0, 1), (1, 2), (2, 0))])
    axis = crosses[np.argmax(np.linalg.norm(crosses, axis=1))]
    axis = axis / np.linalg.norm(axis)
    found = Rotation.from_quat([*((largest - trace) * axis), z @ axis])
    return found * Rotation.from_matrix(np.diag(flip))


def _largest_eigenvalue(davenport: Float) -> float:
    """Largest root, at most 1, of the characteristic polynomial of (4, 4) without trace, by Newton's method."""
    square = davenport @ davenport
    quadratic = -float(np.trace(square)) / 2.0
    linear = -float(np.trace(square @ davenport)) / 3.0
    constant = float(np.linalg.det(davenport))
    root = 1.0
    for _ in range(_NEWTON_STEPS):
        value = ((root * root + quadratic) * root + linear) * root + constant
        slope = (4.0 * root * root + 2.0 * quadratic) * root + linear
        if not (value > 0.0 and slope > 0.0):  # rounding: the root is reached
            break
        root -= value / slope
    return root


def _davenport(profile: Float) -> Float:
    """Matrices K (m, 4, 4) of profile matrices B (m, 3, 3), for quaternions with the scalar last."""
    trace = np.trace(profile, axis1=-2, axis2=-1)
    twist = profile[..., [2, 0, 1], [1, 2, 0]] - profile[..., [1, 2, 0], [2, 0, 1]]
    davenport = np.empty((*trace.shape, 4, 4))
    davenport[..., :3, :3] = profile + np.swapaxes(profile, -1, -2) - trace[..., None, None] * np.eye(3)
    davenport[..., :3, 3] = davenport[..., 3, :3] = twist
    davenport[..., 3, 3] = trace
    return davenport
