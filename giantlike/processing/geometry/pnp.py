"""Perspective-n-point: position and attitude of a body relative to a camera from points of it in an image.

RANSAC over minimal samples of points, then Gauss-Newton over the points that agree, weighted by their covariances and
by the a priori attitude.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask, as_finite, as_floats, require, unit
from giantlike.core.frames import rotate, skew
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.statistics import error_floor, squared_residuals
from giantlike.core.values import Value

_SETTLED = 1e-9  # predicted decrease of chi-square at convergence: steps of 3e-5 sigma
_CONDITION_LIMIT = 1e14  # of a scaled matrix, above which the pose is undetermined: float64 has 16 digits
_ROUNDS = 5  # of selecting the points that agree and fitting them
_PRIOR_SIGMAS = 3.0  # of the a priori attitude, by which the inlier limit of samples is widened
_OUTLIER_SIGMAS = 5.0  # of the scatter of the other points; a good point exceeds it once in 270,000


@dataclass(frozen=True, slots=True, kw_only=True)
class PnpOptions:
    """Options of the pose estimation."""

    inlier_px: float = 2.0  # largest residual that agrees; in the end also within five sigmas of the others
    attitude_sigma_rad: float = math.inf  # per axis, a priori: 0 fixes the attitude, infinity frees it
    max_samples: int = 200  # of random samples. Default 200: with half outliers, all fail in 3e-12 of cases
    min_inliers: int = 5  # fewest points that must agree. Default 5: two more than fix a pose.
    max_iterations: int = 30  # largest number of Gauss-Newton steps, default 30
    seed: int = 0  # seed of the samples: equal input gives equal output

    def __post_init__(self) -> None:
        require(self.inlier_px > 0.0, f"inlier_px must be > 0, got {self.inlier_px}")
        require(self.attitude_sigma_rad >= 0.0, f"attitude_sigma_rad must be >= 0, got {self.attitude_sigma_rad}")
        require(self.max_samples >= 1, f"max_samples must be >= 1, got {self.max_samples}")
        require(self.min_inliers >= self.sample_size, f"min_inliers must be >= {self.sample_size}")
        require(self.max_iterations >= 1, f"max_iterations must be >= 1, got {self.max_iterations}")

    @property
    def sample_size(self) -> int:
        """Number of points of a sample: three, or two with an a priori attitude."""
        return 3 if math.isinf(self.attitude_sigma_rad) else 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PnpFix(Value):
    """Pose of a body from its points."""

    position_camera_km: Float  # from the camera to the origin of the body axes
    camera_from_body: Rotation
    covariance: Float  # km, rad; position and rotation ``e``, true ``from_rotvec(e) * camera_from_body``
    inliers: Mask  # (n,); True for points that agree
    residuals_px: Float  # (n, 2); measured minus projected, of all points
    floor_px: float  # standard deviation per axis of errors beyond the covariances, included in ``covariance``


def solve_pnp(
    points_body_km: ArrayLike,
    observed_px: ArrayLike,
    covariance_px2: ArrayLike,
    model: CameraModel,
    camera_from_body: Rotation,
    *,
    options: PnpOptions = PnpOptions(),
) -> PnpFix | Failure:
    r"""Estimate the pose of a body from points (n, 3), seen at (n, 2) px, some of which may be misidentified.

    Samples hold three points, or two where the attitude is known, for which the position is the linear solution of ``u
    x (r + R x) = 0``, u the ray to a point x. The cost of a pose is the sum of squared distances, each truncated at the
    outlier limit. Errors beyond the covariances are an isotropic variance for which the sum of squares equals its
    degrees of freedom m; the covariance is multiplied by ``m / (m - 2)``, because that variance is itself an estimate.
    """
    points = as_floats(points_body_km, (3,), "points_body_km")
    require(points.ndim == 2, f"points_body_km must have shape (n, 3), got {points.shape}")
    pixels = as_finite(observed_px, (len(points), 2), "observed_px")
    spread = as_finite(covariance_px2, (len(points), 2, 2), "covariance_px2")
    require(bool(np.isfinite(points).all()), "points_body_km must be finite")
    require(bool((np.linalg.eigvalsh(spread) > 0.0).all()), "covariance_px2 must be positive definite")
    if len(points) < options.min_inliers:
        return Failure(Reason.TOO_FEW_MATCHES, f"needed {options.min_inliers} points, got {len(points)}")
    problem = _PoseProblem(points, pixels, spread, model, camera_from_body, options)
    start = _ransac(problem)
    return start if isinstance(start, Failure) else _refine(problem, *start)


@dataclass(frozen=True, slots=True, eq=False)
class _PoseProblem(Value):
    """Checked input of :func:`solve_pnp`."""

    points: Float
    pixels: Float
    spread: Float
    model: CameraModel
    known: Rotation
    options: PnpOptions

    def project(self, rotations: Float, positions: Float) -> Float:
        """Pixels (m, n, 2) of all points under poses (m, 3, 3), (m, 3)."""
        return self.model.project(self.points @ np.swapaxes(rotations, -1, -2) + positions[:, None])

    def residuals(self, rotation: Rotation, position: Float) -> Float:
        """Observed minus projected pixels (n, 2) of a pose."""
        return np.asarray(self.pixels - self.project(rotation.as_matrix()[None], position[None])[0])

    @property
    def n_free(self) -> int:
        """Number of unknowns: the position alone if the attitude is exact."""
        return 3 if self.options.attitude_sigma_rad == 0.0 else 6

    @property
    def weighs_attitude(self) -> bool:
        """True if the attitude is estimated with an a priori sigma."""
        return 0.0 < self.options.attitude_sigma_rad < math.inf


def _ransac(problem: _PoseProblem) -> tuple[Rotation, Float, Mask] | Failure:
    """Pose of the sample that most points agree with, and the mask of these points."""
    options, count = problem.options, len(problem.points)
    random = np.random.default_rng(options.seed)
    samples = np.argsort(random.random((options.max_samples, count)), axis=1)[:, : options.sample_size]
    rays, points = problem.model.unproject(problem.pixels)[samples], problem.points[samples]
    if options.sample_size == 2:
        rotation = problem.known.as_matrix()
        positions = _positions(rays, points @ rotation.T)
        rotations = np.broadcast_to(rotation, (len(positions), 3, 3))
    else:
        rotations, positions = poses_of_three_points(points, rays)
    sound = np.isfinite(positions).all(axis=1) & np.isfinite(rotations).all(axis=(1, 2))
    rotations, positions = rotations[sound], positions[sound]
    if not len(positions):
        return Failure(
            Reason.DEGENERATE_GEOMETRY, "no sample of the points determines a pose: do they lie on one line?"
        )
    distances = np.linalg.norm(problem.project(rotations, positions) - problem.pixels, axis=-1)
    limit = np.full(count, options.inlier_px)
    if problem.weighs_attitude:  # samples use the a priori attitude as if exact
        range_km = float(np.median(np.linalg.norm(positions, axis=1)))
        levers_px = np.linalg.norm(problem.points, axis=1) / range_km * problem.model.focal_length_px
        limit = limit + _PRIOR_SIGMAS * options.attitude_sigma_rad * levers_px
    cost = np.where(distances < limit, (distances / limit) ** 2, 1.0).sum(axis=1)
    best = int(np.argmin(cost))
    agree: Mask = distances[best] < limit
    if int(agree.sum()) < options.min_inliers:
        detail = f"{int(agree.sum())} of {count} points agree to {options.inlier_px:g} px, needed {options.min_inliers}"
        return Failure(Reason.TOO_FEW_MATCHES, detail)
    return Rotation.from_matrix(rotations[best]), positions[best], agree


def _positions(rays: Float, turned: Float) -> Float:
    """Positions (m, 3) from rays (m, k, 3) to points at ``turned`` (m, k, 3) from them; NaN if undetermined."""
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    normal = across.sum(axis=1)
    right = -np.einsum("mkij,mkj->mi", across, turned)
    free = ~np.isfinite(normal).all(axis=(1, 2)) | ~np.isfinite(right).all(axis=1)
    normal[free], right[free] = np.eye(3), 0.0
    free |= ~(np.linalg.cond(normal) < _CONDITION_LIMIT)
    normal[free] = np.eye(3)
    result: Float = np.linalg.solve(normal, right[..., None])[..., 0]
    result[free] = np.nan
    return result


def _refine(problem: _PoseProblem, rotation: Rotation, position: Float, agree: Mask) -> PnpFix | Failure:
    """Alternate fitting and selecting the points that agree until the selection no longer changes."""
    options, floor2 = problem.options, 0.0
    for _ in range(_ROUNDS):
        fit = _gauss_newton(problem, rotation, position, agree, floor2)
        if isinstance(fit, Failure):
            return fit
        rotation, position = fit
        left = problem.residuals(rotation, position)
        before, agree = agree, _agreeing(left, problem.spread, agree, options.inlier_px)
        if int(agree.sum()) < options.min_inliers:
            detail = f"{int(agree.sum())} points agree to {options.inlier_px:g} px, needed {options.min_inliers}"
            return Failure(Reason.TOO_FEW_MATCHES, detail)
        freedom = 2 * int(agree.sum()) - problem.n_free
        was, floor2 = floor2, 0.0
        if freedom > 0:
            floor2 = error_floor(left[agree], problem.spread[agree], freedom=freedom) ** 2
        if np.array_equal(before, agree) and abs(floor2 - was) <= 1e-3 * (was + 1e-12):
            break
    scaled, scale = _scale(_normal_equations(problem, rotation, position, agree, floor2)[0])
    covariance = np.linalg.inv(scaled) * np.outer(scale, scale)
    if freedom > 2:
        share = floor2 / (floor2 + 0.5 * float(np.mean(np.trace(problem.spread[agree], axis1=1, axis2=2))))
        covariance = covariance * (1.0 + 2.0 * share / (freedom - 2.0))
    return PnpFix(
        position_camera_km=position,
        camera_from_body=rotation,
        covariance=np.pad(covariance, (0, 6 - problem.n_free)),
        inliers=agree,
        residuals_px=left,
        floor_px=math.sqrt(floor2),
    )


def _gauss_newton(
    problem: _PoseProblem, rotation: Rotation, position: Float, used: Mask, floor2: float
) -> tuple[Rotation, Float] | Failure:
    """Best pose for some of the points."""
    options = problem.options
    for _ in range(options.max_iterations):
        information, gradient = _normal_equations(problem, rotation, position, used, floor2)
        if not (np.isfinite(information).all() and np.isfinite(gradient).all()):
            return Failure(
                Reason.NOT_CONVERGED, "the fit of the pose left the region that the camera model can project"
            )
        scaled, scale = _scale(information)
        if not np.linalg.cond(scaled) < _CONDITION_LIMIT:
            return Failure(
                Reason.DEGENERATE_GEOMETRY,
                f"{int(used.sum())} points do not determine the pose: do they lie on one line?",
            )
        change = scale * np.linalg.solve(scaled, scale * gradient)
        position = position + change[:3]
        if len(change) == 6:
            rotation = Rotation.from_rotvec(change[3:]) * rotation
        if float(change @ information @ change) < _SETTLED:
            return rotation, position
    return Failure(Reason.NOT_CONVERGED, f"the pose did not converge in {options.max_iterations} steps")


def _normal_equations(
    problem: _PoseProblem, rotation: Rotation, position: Float, used: Mask, floor2: float
) -> tuple[Float, Float]:
    """Information matrix (k, k) and gradient (k,) of position and, unless exact, rotation about camera axes."""
    turned = rotate(rotation, problem.points[used])
    design = problem.model.project_jacobian(turned + position)
    if problem.n_free == 6:
        design = np.concatenate([design, -design @ skew(turned)], axis=-1)
    weights = np.linalg.inv(problem.spread[used] + floor2 * np.eye(2))
    information: Float = np.einsum("nki,nkl,nlj->ij", design, weights, design)
    gradient: Float = np.einsum("nki,nkl,nl->i", design, weights, problem.residuals(rotation, position)[used])
    if problem.weighs_attitude:
        information[3:, 3:] += np.eye(3) / problem.options.attitude_sigma_rad**2
        gradient[3:] -= (rotation * problem.known.inv()).as_rotvec() / problem.options.attitude_sigma_rad**2
    return information, gradient


def _scale(information: Float) -> tuple[Float, Float]:
    """Information matrix scaled to a unit diagonal, and the scales (k,)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    return information * np.outer(scale, scale), scale


def _agreeing(residuals: Float, spread: Float, before: Mask, inlier_px: float) -> Mask:
    """Mask (n,) of points near enough, and no further off than the scatter of those before explains."""
    near = np.linalg.norm(residuals, axis=1) < inlier_px
    floor = error_floor(residuals[before], spread[before])
    scatter = spread + min(floor, inlier_px) ** 2 * np.eye(2)
    agree: Mask = near & (squared_residuals(residuals, scatter) < _OUTLIER_SIGMAS**2)
    return agree


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
