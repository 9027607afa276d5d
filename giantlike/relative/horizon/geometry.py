"""The horizon of an ellipsoid in the image: position from its points, with covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, as_finite, as_floats, require, require_number
from giantlike.core.causes import Cause, add_parts
from giantlike.core.findings import Corrections
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.processing.correlated_fit import solution_gain
from giantlike.processing.limb.altitude import lift_points
from giantlike.processing.limb.measurement import LimbMeasurement, smooth_parts
from giantlike.processing.outline_errors import outline_errors
from giantlike.ray_tracing.air import Air
from giantlike.relative.horizon.ray_loops import distances
from giantlike.relative.limb.fix import LimbSolution
from giantlike.scene import TargetGeometry

MIN_POINTS = 4  # points of a horizon that a position needs: one more than its parameters
_EXPLAINED_SIGMAS = 2.5
"""Scatter of points, and the product of neighbors, that pixel noise reaches once in a hundred times."""
_FOOT_STEPS, _NEAR_STEPS = 4, 2  # Newton steps to the nearest point of the horizon, from pixels away and from the fit
_MAX_STEPS, _STEP_PX = 25, 1e-7
"""Most Gauss-Newton steps; and motion of the horizon, px, below which they end: far below any noise."""
_ALTITUDE_STEP = 1e-4  # of the smallest radius
_COLLINEAR_PX = 1e-6  # rounding of pixel coordinates


class CraMethod(StrEnum):
    """Method by which the position is found from points of the horizon."""

    LEAST_SQUARES = "least_squares"
    TOTAL_LEAST_SQUARES = "total_least_squares"
    MAXIMUM_LIKELIHOOD = "maximum_likelihood"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Figure(Value):
    """Ellipsoid in its attitude before the camera.

    Parameters
    ----------
    radii_km : (3,) float64, km; semi-axes
    camera_from_axes : Rotation; takes vectors along the principal axes to camera axes
    air : Air, optional; over the ellipsoid

    Raises
    ------
    InputError
        A semi-axis is not positive and finite.
    """

    radii_km: Float
    camera_from_axes: Rotation
    air: Air | None = None
    to_sphere: Float = field(init=False, repr=False)
    """The matrix B (3, 3), 1/km, that takes camera vectors to where the body is the unit sphere."""
    shape_matrix: Float = field(init=False, repr=False)
    """The matrix A (3, 3), 1/km^2, camera axes: points of the surface about its center have ``x.A.x == 1``."""

    def __post_init__(self) -> None:
        radii = as_finite(self.radii_km, (3,), "radii_km")
        require(bool(np.all(radii > 0)), f"radii_km must be > 0, got {radii.tolist()}")
        object.__setattr__(self, "radii_km", radii)
        to_sphere = self.camera_from_axes.as_matrix().T / radii[:, None]
        object.__setattr__(self, "to_sphere", to_sphere)
        object.__setattr__(self, "shape_matrix", to_sphere.T @ to_sphere)
        Value.__post_init__(self)

    def cone(self, position_camera_km: Float) -> tuple[Float, Float]:
        """Cone of the rays that graze an ellipsoid with the center s (3,), km, camera axes.

        Returns ``pull`` (3,), 1/km, and ``conic`` (3, 3), 1/km^2, the matrix ``M = A s s.A - (s.A.s - 1) A``: ``x.M.x``
        is zero for rays x that graze the body, positive for those that meet it. Raises InputError for a camera inside
        the ellipsoid.
        """
        pull = self.shape_matrix @ position_camera_km
        strength = float(position_camera_km @ pull)
        where = np.asarray(position_camera_km).tolist()
        require(strength > 1.0, f"the camera must be outside the ellipsoid, got a center at {where} km")
        return pull, np.outer(pull, pull) - (strength - 1.0) * self.shape_matrix


@dataclass(frozen=True, slots=True)
class Altitude:
    """Altitude above the surface at which the limb is seen, by an atmosphere or haze."""

    altitude_km: float = 0.0
    sigma_km: float = 0.0  # standard deviation; 0 where the altitude is known
    uneven: bool = False  # True for haze, which is seen higher where the Sun is lower: by as much as it is uncertain

    def __post_init__(self) -> None:
        require_number(self.altitude_km, "limb_altitude_km")
        require_number(self.sigma_km, "altitude_sigma_km", least=0.0)

    @classmethod
    def from_geometry(cls, geometry: TargetGeometry) -> Altitude:
        """Altitude of the limb of a target by its atmosphere, if it has one."""
        return cls(*geometry.limb_altitude_km, uneven=geometry.target.atmosphere is not None)

    def above(self, figure: Figure) -> Figure:
        """Return the ellipsoid that is seen in place of a body."""
        return replace(figure, radii_km=figure.radii_km + self.altitude_km)

    def after(self, left: Float, design: Float, covariance: Float, lift: Float) -> Altitude:
        """Estimate the altitude from a fit of the position; it stays as before where the range takes up all of it.

        ``left`` (n,) px; ``design`` (n, 3) px/km; ``covariance`` (n, n) px^2; ``lift`` (n,) px/km.
        """
        variance = self.sigma_km**2
        if variance == 0.0:
            return self
        weighted = np.linalg.solve(covariance, np.column_stack([lift, design]))
        gain = weighted[:, 0] - weighted[:, 1:] @ np.linalg.solve(design.T @ weighted[:, 1:], weighted[:, 1:].T @ lift)
        known = variance - variance**2 * float(gain @ lift)
        estimate_km = self.altitude_km + variance * float(gain @ left)
        return replace(self, altitude_km=estimate_km, sigma_km=math.sqrt(max(known, 0.0)))

    @property
    def corrections(self) -> Corrections:
        """Both numbers for a fix; none of them where the limb is that of the surface."""
        if self == Altitude():
            return Corrections()
        return Corrections(limb_altitude_km=self.altitude_km, altitude_sigma_km=self.sigma_km)


@dataclass(frozen=True, slots=True, eq=False)
class PixelRays(Value):
    """Directions of pixels and their change with the pixel."""

    directions: Float  # (n, 3), camera axes
    by_pixel: Float  # (n, 3, 2) 1/px

    @classmethod
    def through(cls, points_px: Float, model: CameraModel) -> PixelRays:
        """Rays of the points (n, 2), px."""
        return cls(model.unproject(points_px), model.unproject_jacobian(points_px))


def christian_robinson(
    points_px: ArrayLike,
    model: CameraModel,
    figure: Figure,
    *,
    method: CraMethod = CraMethod.MAXIMUM_LIKELIHOOD,
    sigma_px: ArrayLike = 1.0,
) -> Float | Failure:
    r"""Position of an ellipsoid from points on its horizon; no start value is needed.

    ``points_px`` (n, 2); ``sigma_px`` (n,); returns (3,) km, camera axes.

    Notes
    -----
    With ``B`` that turns the body into a unit sphere, horizon directions ``w_i = B x_i / |B x_i|`` lie on a cone,
    ``w_i . n = 1``, and the position is ``(n.n - 1)^(-1/2) B^-1 n``.

    ``least_squares`` solves this for n as it stands. The noise of the points is then in the matrix, and short arcs
    at long range come out too far away. ``total_least_squares`` lets the ``w_i`` be noisy as they really are:
    across the line of sight and not along it. (With the same noise in every component, as total least squares
    usually has it, the bias stays.) ``maximum_likelihood`` goes on from there to the position with the least
    distances between points and horizon in the image, in units of ``sigma_px``.

    References
    ----------
    .. [1] Inman et al., Artemis I optical navigation system performance, section III.A (the matrix B, least and
       total least squares).
    .. [2] Thrasher et al., Development of the Optical Deep-Space Instrument for Navigation, eqs. 8-13; its eq. 10
       needs the rotation from camera to principal axes, as here.
    """
    points = _points(points_px)
    if len(points) < MIN_POINTS:
        return Failure(
            Reason.TOO_FEW_DETECTIONS, f"needed at least {MIN_POINTS} points on the horizon, got {len(points)}"
        )
    if np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] < _COLLINEAR_PX:
        return Failure(
            Reason.DEGENERATE_GEOMETRY, f"the {len(points)} points lie on a line: no ellipse goes through them"
        )
    directions = model.unproject(points)
    require(bool(np.isfinite(directions).all()), "points_px must lie where the camera model has directions")
    mapped = directions @ figure.to_sphere.T
    length = np.linalg.norm(mapped, axis=1)
    cone = mapped / length[:, None]
    if method is CraMethod.LEAST_SQUARES:
        normal = np.linalg.lstsq(cone, np.ones(len(cone)), rcond=None)[0]
    else:
        normal = _total_least_squares(cone, _noise_metric(cone, length, points, model, figure))
    excess = float(normal @ normal) - 1.0
    if not excess > 0.0:
        return Failure(
            Reason.DEGENERATE_GEOMETRY,
            f"the {len(points)} points lie on no cone around an ellipsoid: too short an arc, or no limb",
        )
    position: Float = np.linalg.solve(figure.to_sphere, normal) / np.sqrt(excess)
    if method is not CraMethod.MAXIMUM_LIKELIHOOD:
        return position
    return _refine_position(
        points, model, figure, position, np.broadcast_to(as_floats(sigma_px, (), "sigma_px"), len(points))
    )


def horizon_residuals(
    points_px: ArrayLike, model: CameraModel, figure: Figure, position_camera_km: ArrayLike
) -> tuple[Float, Float, Float]:
    """Distances of image points from the horizon, and motion of the horizon with the body.

    ``points_px`` (n, 2); returns ``residuals_px`` (n,), distance from the nearest point of the horizon, positive
    outside, NaN where there is none; ``jacobian`` (n, 3) px/km, outward motion of the horizon at that point with the
    position, so that a step solves ``jacobian @ step = residuals``; ``normals_px`` (n, 2), outward unit normals of the
    horizon there.

    Notes
    -----
    The horizon is where ``x.M.x = 0`` for the direction x of a pixel, with ``M = A s s.A - (s.A.s - 1) A``. The
    foot of the perpendicular is found by Newton steps along the gradient in the distorted image, whose rays are
    taken as linear about each point: exact for points near the horizon, to 0.01 px for those 5 px away.

    References
    ----------
    .. [1] Thrasher et al., eqs. 14, 15 and 18; eq. 18 has the sign opposite to the derivative taken here.
    """
    position = as_finite(position_camera_km, (3,), "position_camera_km")
    return ray_residuals(PixelRays.through(_points(points_px), model), figure, position)


def altitude_design(points_px: ArrayLike, model: CameraModel, figure: Figure, position_camera_km: ArrayLike) -> Float:
    """Outward motion of the horizon with all radii of an ellipsoid.

    It is nearly that with a shorter range, times range over radius: what is not known of the altitude of a limb is
    lost for the range, unless the ellipsoid is seen from so near that the two differ.

    ``points_px`` (n, 2); returns (n,) px/km.
    """
    rays = PixelRays.through(_points(points_px), model)
    position = as_finite(position_camera_km, (3,), "position_camera_km")
    step = _ALTITUDE_STEP * float(figure.radii_km.min())
    low, high = (ray_residuals(rays, Altitude(step * sign).above(figure), position)[0] for sign in (-1.0, 1.0))
    result: Float = (low - high) / (2.0 * step)
    return result


def cone_weights(points_px: ArrayLike, model: CameraModel, figure: Figure, position_camera_km: ArrayLike) -> Float:
    """Weights that points have in the unweighted equations of the cone. ``points_px`` (n, 2); returns (n,) 1/px^2."""
    points = _points(points_px)
    position = as_finite(position_camera_km, (3,), "position_camera_km")
    normal = figure.to_sphere @ position
    normal = normal / np.sqrt(normal @ normal - 1.0)
    mapped = model.unproject(points) @ figure.to_sphere.T
    length = np.linalg.norm(mapped, axis=1)
    cone = mapped / length[:, None]
    across = (normal - (cone @ normal)[:, None] * cone) / length[:, None]
    gradient = np.einsum("ni,ij,njk->nk", across, figure.to_sphere, model.unproject_jacobian(points))
    result: Float = np.sum(gradient**2, axis=1)
    return result


def fit_horizon(
    measured: LimbMeasurement,
    model: CameraModel,
    figure: Figure,
    start_km: Float,
    altitude: Altitude,
    *,
    sun_direction_camera: Float,
    method: CraMethod = CraMethod.MAXIMUM_LIKELIHOOD,
) -> LimbSolution:
    """Fit the position of an ellipsoid to all points of a measured limb at once.

    ``start_km`` in camera axes; ``sun_direction_camera``: unit vector from body to Sun.

    The points err by noise; by albedo and relief, found from their scatter where noise does not explain that; by blur
    and law, which all share; and by the altitude.
    """
    points, keep = measured.observed_px[measured.keep], measured.keep
    residuals, design, _ = horizon_residuals(points, model, figure, start_km)
    lift = altitude_design(points, model, figure, start_km) if altitude.sigma_km > 0.0 else np.zeros(len(points))
    by_altitude = altitude.sigma_km * lift[:, None]
    if altitude.uneven:
        by_altitude = lift_points(by_altitude[:, 0], model.unproject(points), start_km, sun_direction_camera)
    own, weighting = _own_errors(measured, residuals, design)
    others = {
        **{cause: shared[keep] @ shared[keep].T for cause, shared in measured.common_px.items()},
        Cause.ALTITUDE: by_altitude @ by_altitude.T,
    }
    covariance = weighting + np.sum(list(others.values()), axis=0)
    best = method is CraMethod.MAXIMUM_LIKELIHOOD
    gain = solution_gain(design, covariance, weights=None if best else cone_weights(points, model, figure, start_km))
    step = gain @ residuals if best else np.zeros(3)
    left = residuals - design @ step
    return LimbSolution(
        position_camera_km=start_km + step,
        covariances_km2=add_parts(
            {cause: gain @ part @ gain.T for cause, part in add_parts(own, others).items()},
            smooth_parts(measured.smooth_errors, measured.predicted_px[keep], measured.even_gain),
        ),
        residuals_px=left,
        limb_px=measured.seen_px[keep],
        corrections=altitude.after(left, design, covariance, lift).corrections,
    )


def _own_errors(measured: LimbMeasurement, residuals: Float, design: Float) -> tuple[dict[Cause, Float], Float]:
    """Covariances (n, n) of the points' own errors, px^2, and the sum of them that weights are made from."""
    sigma, points = measured.sigma_px[measured.keep], measured.observed_px[measured.keep]
    noise = np.diag(sigma**2)
    if measured.relief is not None:
        shown = max(measured.relief.sigma_px, float(np.sqrt(np.mean(residuals**2))))
        relief = replace(measured.relief, sigma_px=shown).covariance_px2(points)
        return {Cause.NOISE: noise, Cause.RELIEF: relief}, noise + relief
    whitened = design / sigma[:, None]
    basis, _ = np.linalg.qr(whitened / np.linalg.norm(whitened, axis=0))
    left = residuals / sigma
    left = left - basis @ (basis.T @ left)
    freedom = left.size - 3
    scatter = (float(left @ left) / freedom - 1.0) / np.sqrt(2.0 / freedom)
    waves = float(left[1:] @ left[:-1]) / np.sqrt(left.size)
    if max(scatter, waves) < _EXPLAINED_SIGMAS:
        return {Cause.NOISE: noise}, noise
    spacing_px = float(np.median(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    radius_px = measured.perimeter_px / (2.0 * np.pi)
    errors = outline_errors(residuals, design, sigma, points, radius=radius_px, least_length=spacing_px)
    own = errors.covariances(sigma, points)
    return {Cause.NOISE: own.noise, Cause.RELIEF: own.relief}, own.for_weights


def _points(points_px: ArrayLike) -> Float:
    points = as_floats(points_px, (2,), "points_px")
    require(points.ndim == 2, f"points_px must have shape (n, 2), got {points.shape}")
    return points


def _noise_metric(cone: Float, length: Float, points_px: Float, model: CameraModel, figure: Figure) -> Float:
    """Mean covariance (3, 3) of the unit vectors of the cone for unit noise in the image."""
    by_pixel = figure.to_sphere @ model.unproject_jacobian(points_px)  # (n, 3, 2)
    across = (by_pixel - cone[:, :, None] * (cone[:, None, :] @ by_pixel)) / length[:, None, None]
    metric: Float = np.einsum("nik,njk->ij", across, across) / len(cone)
    return metric


def _total_least_squares(cone: Float, metric: Float) -> Float:
    """Solution n of ``w.n = 1`` for w with noise of covariance ``metric`` (3, 3): a plane through the w."""
    middle = cone.mean(axis=0)
    offsets = cone - middle
    _, vectors = eigh(offsets.T @ offsets, metric)
    result: Float = vectors[:, 0] / (vectors[:, 0] @ middle)
    return result


def ray_residuals(
    rays: PixelRays, figure: Figure, position_camera_km: Float, *, steps: int = _FOOT_STEPS
) -> tuple[Float, Float, Float]:
    """Return the same as :func:`horizon_residuals`, from rays instead of pixels, with ``steps`` Newton steps."""
    pull, conic = figure.cone(position_camera_km)
    return distances(rays.directions, rays.by_pixel, pull, conic, figure.shape_matrix, steps)


def _refine_position(
    points_px: Float, model: CameraModel, figure: Figure, start_km: Float, sigma_px: Float
) -> Float | Failure:
    """Gauss-Newton on the distances in the image."""
    position = start_km
    rays = PixelRays.through(points_px, model)
    for _ in range(_MAX_STEPS):
        residuals, jacobian, _ = ray_residuals(rays, figure, position, steps=_NEAR_STEPS)
        known = np.isfinite(residuals)
        if known.sum() < MIN_POINTS:
            break
        weighted = jacobian[known] / sigma_px[known, None]
        step = np.linalg.lstsq(weighted, residuals[known] / sigma_px[known], rcond=None)[0]
        scale = float(np.linalg.norm(position))
        step *= min(1.0, 0.2 * scale / max(float(np.linalg.norm(step)), 1e-300))
        position = position + step
        if float(position @ figure.shape_matrix @ position) <= 1.0:
            break
        if float(np.max(np.abs(jacobian[known] @ step))) < _STEP_PX:
            return position
    return Failure(
        Reason.NOT_CONVERGED,
        f"the fit of the horizon to {len(points_px)} points did not settle: too short an arc for its noise",
    )
