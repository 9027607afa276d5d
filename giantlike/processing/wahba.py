r"""Wahba's problem: the rotation that best takes one set of directions to another.

Davenport's q-method: the unit quaternion that maximises :math:`q^T K q` is the eigenvector of the largest
eigenvalue of the symmetric 4x4 matrix K.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, as_finite, as_unit, require
from giantlike.core.outcomes import Failure, Reason

MAX_SIGMA_RAD = 0.5
"""An attitude that is less certain than this about any axis is no attitude."""


def solve_wahba(
    vectors_inertial: ArrayLike, vectors_camera: ArrayLike, sigma_rad: ArrayLike
) -> tuple[Rotation, Float] | Failure:
    r"""Attitude from pairs of directions, each weighted by its inverse variance.

    Minimises :math:`\frac12\sum_i \sigma_i^{-2} \|b_i - T a_i\|^2` over rotations T.

    Parameters
    ----------
    vectors_inertial, vectors_camera : (n, 3) float64, unitless
        Unit vectors a_i (inertial) and b_i (camera axes) of the same stars, n >= 2.
    sigma_rad : (n,) or scalar, rad
        Standard deviation of the angle between a_i and b_i, per axis across the line of sight.

    Returns
    -------
    camera_from_inertial : Rotation
    covariance_rad2 : (3, 3) float64, rad^2
        Of the small rotation e about the camera axes with
        ``camera_from_inertial_true = Rotation.from_rotvec(e) * camera_from_inertial``:
        the inverse of :math:`\sum_i \sigma_i^{-2} (I - b_i b_i^T)`.

    Or a :class:`~giantlike.core.outcomes.Failure` of reason ``degenerate_geometry``: fewer than two
    directions, or all along one line, so that one axis stays free (sigma above ``MAX_SIGMA_RAD``).

    Raises
    ------
    InputError
        Shapes disagree, a vector is not unit to 1e-9, or a sigma is not positive.

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, eq. 2.
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
    information = attitude_information(b, weights)
    weakest = float(np.linalg.eigvalsh(information)[0])
    if not weakest > MAX_SIGMA_RAD**-2:
        return Failure(
            Reason.DEGENERATE_GEOMETRY,
            f"{n} directions leave the rotation about one axis free to {max(weakest, 1e-30) ** -0.5:.2g} rad: "
            "they lie along one line, or are too uncertain",
        )
    rotation = Rotation.from_quat(davenport_quaternions(a[None], b[None], weights[None])[0])
    covariance: Float = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return rotation, covariance


def attitude_information(vectors_camera: Float, weights: Float) -> Float:
    r"""Information matrix (3, 3), 1/rad^2, about the camera axes: :math:`\sum_i w_i (I - b_i b_i^T)`."""
    outer = np.einsum("i,ij,ik->jk", weights, vectors_camera, vectors_camera)
    result: Float = np.eye(3) * weights.sum() - outer
    return result


def davenport_quaternions(vectors_inertial: Float, vectors_camera: Float, weights: Float) -> Float:
    """Optimal rotations of m independent problems of n directions each.

    Parameters
    ----------
    vectors_inertial, vectors_camera : (m, n, 3) float64, unitless
    weights : (m, n) float64

    Returns
    -------
    (m, 4) float64
        Quaternions camera_from_inertial, scalar last.
    """
    profile = np.einsum("mi,mij,mik->mjk", weights, vectors_camera, vectors_inertial)  # sum of w b a^T
    trace = np.trace(profile, axis1=1, axis2=2)
    axis = np.stack(
        [
            profile[:, 2, 1] - profile[:, 1, 2],
            profile[:, 0, 2] - profile[:, 2, 0],
            profile[:, 1, 0] - profile[:, 0, 1],
        ],
        axis=-1,
    )
    davenport = np.empty((len(profile), 4, 4))
    davenport[:, :3, :3] = profile + np.swapaxes(profile, 1, 2) - trace[:, None, None] * np.eye(3)
    davenport[:, :3, 3] = davenport[:, 3, :3] = axis
    davenport[:, 3, 3] = trace
    quaternions: Float = np.linalg.eigh(davenport)[1][:, :, -1]
    return quaternions
