"""Ellipse fit: centre and apparent diameter of a body from the edge of its lit limb, and its position from both."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, require, unit
from giantlike.core.outcomes import Failure, PositionFix, Quality, Reason
from giantlike.image import Image
from giantlike.processing.conic_fit import ConicFit, conic_matrix, fit_ellipse
from giantlike.processing.correlated_fit import generalised_solution, robust_solution
from giantlike.processing.edges import EdgePoints, scan_edges
from giantlike.processing.segmentation import Background, background_of
from giantlike.processing.zernike import zernike_edges
from giantlike.relative.ellipsoid_cra import relief_sigma_km
from giantlike.relative.estimator import EstimatorInputs, apparent_radius_px, center_of_position, gather
from giantlike.relative.horizon import Figure, horizon_residuals
from giantlike.relative.template_render import UNKNOWN_PSF_SIGMA_PX
from giantlike.relative.unresolved import sunlight_px
from giantlike.scene import Scene
from giantlike.shapes import PlacedEllipsoid, TriangleMesh

Mask = NDArray[np.bool_]

_LIGHT_SIGMAS, _LIGHT_SHARE = 5.0, 0.1  # of light: over the background, and of the brightness of the body
_SKY_STEP = 4
_MIN_SKY = 60
_MIN_COSINE = 0.2  # between sunlight and edge: beyond, the limb goes over into the terminator
_MAX_TURN_RAD = 0.5  # between the normals of edge and prediction
_MIN_CONTRAST = 0.25  # of the median edge
_ROUNDS = 3
_CORRELATION_PX = 2.0  # windows of neighbouring edges share pixels
_GROWTH = 2.5
"""Error of an edge in 5 x 5 pixels by brightness that changes inside, over how much more it is in 7 x 7.

That brightness goes with the cosine of emission, the root of the distance from the limb. On spheres under the laws of
Lambert, Lommel-Seeliger and McEwen, at 20 to 110 degrees, it takes 0.05-0.2 px of error down to 0.06 px and less.
"""
_GROWTH_ERROR = 0.4
_MAX_RANGE_SIGMA = 0.25
_QUARTER = 0.25
_STEP = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class EllipseFitOptions:
    """Options of :class:`EllipseFit`.

    Parameters
    ----------
    search_px : float, px
        Largest error of the predicted centre.
    search_range : float
        Largest relative error of the predicted range.
    max_relief : float
        Meshes that depart from their best-fit ellipsoid by more than this (root mean square over mean radius) are
        refused.
    min_edges : int
        Fewer edges than this are no limb.
    max_edges : int
        Of longer limbs every second, third ... edge is taken.
    outlier_mad : float
        Edges beyond so many robust sigmas are left out.
    large_rms_px : float, px
        Larger residuals, beyond what relief explains, get a flag.
    """

    search_px: float = 40.0
    search_range: float = 0.05
    max_relief: float = 0.08
    min_edges: int = 20
    max_edges: int = 300
    outlier_mad: float = 4.0
    large_rms_px: float = 1.0

    def __post_init__(self) -> None:
        for name in ("search_px", "max_relief", "outlier_mad", "large_rms_px"):
            value = getattr(self, name)
            require(math.isfinite(value) and value > 0, f"{name} must be > 0, got {value}")
        require(0.0 <= self.search_range <= 0.3, f"search_range must be in [0, 0.3], got {self.search_range}")
        require(
            8 <= self.min_edges <= self.max_edges <= 1000,
            f"edges must be 8 <= min_edges <= max_edges <= 1000, got {self.min_edges} and {self.max_edges}",
        )


class EllipseFit:
    """Position of a body from an ellipse through the edges of its lit limb.

    Edges are found by a scan along the sunlight, measured by Zernike moments, and taken through the camera model to the
    plane that touches the sphere of directions at the predicted place, where the horizon of an ellipsoid is an ellipse
    whatever the distortion. The ellipse is free in all its five parameters: neither the size nor the flattening is put
    in. Direction and range then follow from the cone over it and the known axes of the body. No reflectance law is
    used, and no law's error enters: what a brightness that changes inside the limb does to edges is told by windows of
    two sizes, and its uncertainty is in the covariance. In return the fit is several times less certain than that of
    ``ellipsoid_cra``, which knows the shape from the start.

    ``score`` of the fix is the root mean square of the residuals in px; ``residuals`` are distances across the ellipse,
    px, positive outside.

    Parameters
    ----------
    options : EllipseFitOptions

    References
    ----------
    .. [1] Thrasher et al., Development of the Optical Deep-Space Instrument for Navigation, "OpNav Target
       Identification" (centre of a resolved body by an ellipse through its horizon points) and eqs. 8-13.
    .. [2] Inman et al., Artemis I optical navigation system performance, section III.A (scan, then moments).
    """

    name: ClassVar[str] = "ellipse_fit"

    def __init__(self, options: EllipseFitOptions | None = None) -> None:
        self.options = options or EllipseFitOptions()

    def estimate(self, image: Image, camera: Camera, scene: Scene, target: str | None = None) -> PositionFix | Failure:
        """Find a target of ``scene`` in ``image``; ``target`` may be left out when there is only one.

        Returns
        -------
        PositionFix or Failure
            ``WRONG_SHAPE`` for a body that is no ellipsoid; ``NO_LIMB``, ``OUT_OF_FRAME``, ``SATURATED``,
            ``DEGENERATE_GEOMETRY`` where the arc does not fix an ellipse, and what ``gather`` fails for.

        Raises
        ------
        InputError
            The image has another size than the camera, or there is no such target.
        DataError
            SPICE kernels do not cover the epoch.
        """
        inputs = gather(image, camera, scene, target, estimator=self.name, options=self.options)
        if isinstance(inputs, Failure):
            return inputs
        shape = inputs.geometry.target.shape
        placed = shape.best_fit_ellipsoid
        relief_km = relief_sigma_km(shape, placed) if isinstance(shape, TriangleMesh) else 0.0
        if relief_km > self.options.max_relief * shape.mean_radius_km:
            return inputs.fail(
                Reason.WRONG_SHAPE,
                f"the shape departs from its best-fit ellipsoid by {relief_km / shape.mean_radius_km:.1%} of its "
                f"radius (rms), allowed {self.options.max_relief:.1%}",
            )
        limb = _limb(inputs, placed, self.options)
        if isinstance(limb, Failure):
            return limb
        relief_px = apparent_radius_px(camera, inputs.predicted_px, relief_km, inputs.geometry.range_km)
        return _fix(inputs, placed, limb, relief_px, self.options)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Limb:
    """Edges on the limb: points (n, 2), what was taken off them along their normals (n,), and how many there were."""

    edges: EdgePoints
    points_px: Float
    correction_px: Float
    n_found: int


def position_of_cone(cone: Float, figure: Figure) -> Float | None:
    """Position of an ellipsoid whose horizon lies on a cone of directions.

    Parameters
    ----------
    cone : (3, 3) float64
        Symmetric, ``x . cone . x = 0`` for directions x of the horizon, positive inside.
    figure : Figure

    Returns
    -------
    (3,) float64, km, camera axes, or None
        None where the cone is none around an ellipsoid.

    Notes
    -----
    With the body as unit sphere the cone is ``n n^T - I``, up to scale: its eigenvalue of the other sign belongs to n,
    and over the mean of the two that are equal but for noise it is ``1 - n.n``; from there as in
    :func:`~giantlike.relative.horizon.christian_robinson`.
    """
    back = np.linalg.inv(figure.to_sphere)
    values, vectors = np.linalg.eigh(back.T @ cone @ back)
    across = 0.5 * float(values[0] + values[1])
    if not (values[2] > 0.0 > values[1]):
        return None
    axis = vectors[:, 2] * math.copysign(1.0, float((back @ vectors[:, 2])[2]))
    excess = -float(values[2]) / across
    result: Float = back @ axis * math.sqrt((1.0 + excess) / excess)
    return result


def _limb(inputs: EstimatorInputs, placed: PlacedEllipsoid, options: EllipseFitOptions) -> _Limb | Failure:
    """Edges on the lit limb near the predicted one."""
    figure, center_km = _figure(inputs, placed)
    sky = _sky(inputs, figure, center_km, options)
    if isinstance(sky, Failure):
        return sky
    background, body_dn = sky
    sunlight = sunlight_px(inputs)
    if not sunlight.any():
        return inputs.fail(Reason.NO_LIMB, "the Sun stands behind the camera: sunlight has no direction in the image")
    threshold = background.level_dn + max(_LIGHT_SIGMAS * background.sigma_dn, _LIGHT_SHARE * body_dn)
    blur_px = UNKNOWN_PSF_SIGMA_PX if inputs.psf_sigma_px is None else inputs.psf_sigma_px
    seeds = scan_edges(inputs.pixels_dn, inputs.usable, sunlight, threshold_dn=threshold, blur_sigma_px=blur_px)
    both = []
    for size in (5, 7):
        found = zernike_edges(
            inputs.pixels_dn - background.level_dn,
            inputs.usable,
            seeds,
            variance_dn2=inputs.camera.detector.variance_dn2,
            blur_sigma_px=blur_px,
            size=size,
            curvature_px=1.0 / inputs.radius_px,
        )
        both.append(_near_prediction(inputs, found, figure, center_km, sunlight, options))
    small, large = _paired(*both)
    if len(small) < options.min_edges:
        return _no_limb(inputs, len(seeds), len(small), options)
    shift = np.einsum("ij,ij->i", large.points_px - small.points_px, small.normals_px)
    correction = _GROWTH * _smooth(shift, small.normals_px, options.outlier_mad)
    points = small.points_px - correction[:, None] * small.normals_px
    return _Limb(edges=small, points_px=points, correction_px=correction, n_found=len(seeds))


def _figure(inputs: EstimatorInputs, placed: PlacedEllipsoid) -> tuple[Figure, Float]:
    """The ellipsoid in camera axes, and where its centre is predicted, km."""
    turn = inputs.geometry.camera_from_body
    figure = Figure(radii_km=placed.ellipsoid.radii_km, camera_from_axes=turn * placed.body_from_axes)
    return figure, inputs.geometry.position_camera_km + turn.apply(placed.center_body_km.copy())


def _sky(
    inputs: EstimatorInputs, figure: Figure, center_km: Float, options: EllipseFitOptions
) -> tuple[Background, float] | Failure:
    """Background beside the predicted body, and how bright the body is above it (upper quartile)."""
    rows, columns = (np.arange(0, size, _SKY_STEP) for size in (inputs.camera.rows, inputs.camera.columns))
    x, y = (part.ravel() for part in np.meshgrid(columns, rows))
    points = np.stack([x, y], axis=-1).astype(np.float64)
    directions = inputs.camera.model.unproject(points)
    keep = inputs.usable[y, x] & np.isfinite(directions).all(axis=1)
    directions, values = directions[keep], inputs.pixels_dn[y[keep], x[keep]]
    slack = options.search_px * float(inputs.camera.ifov_rad(np.clip(inputs.predicted_px, 0, [columns[-1], rows[-1]])))
    outward = _horizon_angle(directions, figure, center_km)
    sky, body = values[outward > slack], values[outward < -slack]
    if sky.size < _MIN_SKY:
        return inputs.fail(
            Reason.NO_LIMB,
            f"no sky in the frame beside the body, as predicted and {options.search_px:g} px around it",
        )
    background = background_of(sky)
    noise = math.sqrt(float(inputs.camera.detector.variance_dn2(np.zeros(1))[0]))
    background = Background(level_dn=background.level_dn, sigma_dn=max(background.sigma_dn, 0.1 * noise))
    bright = float(np.percentile(body, 75.0)) - background.level_dn if body.size else 0.0
    return background, max(bright, 0.0)


def _horizon_angle(directions: Float, figure: Figure, center_km: Float) -> Float:
    """Roughly how far outside the horizon directions (n, 3) lie, rad."""
    mapped = directions @ figure.to_sphere.T
    normal = figure.to_sphere @ center_km
    distance = float(np.linalg.norm(normal))
    cosine = np.clip(mapped @ normal / np.linalg.norm(mapped, axis=1) / distance, -1.0, 1.0)
    result: Float = (np.arccos(cosine) / math.asin(1.0 / distance) - 1.0) * (
        float(np.cbrt(np.prod(figure.radii_km))) / float(np.linalg.norm(center_km))
    )
    return result


def _near_prediction(
    inputs: EstimatorInputs,
    found: EdgePoints,
    figure: Figure,
    center_km: Float,
    sunlight: Float,
    options: EllipseFitOptions,
) -> EdgePoints:
    """Edges that sunlight meets first and that lie and look as the predicted limb, but for the errors allowed."""
    if not len(found):
        return found
    known = np.isfinite(inputs.camera.model.unproject(found.points_px)).all(axis=1)
    found = found.select(np.flatnonzero(known))
    away_px, _, normals = horizon_residuals(found.points_px, inputs.camera.model, figure, center_km)
    reach = options.search_px + options.search_range * inputs.reach_px
    good: Mask = np.isfinite(away_px) & (np.abs(away_px) < reach)
    good &= found.normals_px @ -sunlight > _MIN_COSINE
    turn = _MAX_TURN_RAD + reach / inputs.radius_px
    good &= np.einsum("ij,ij->i", normals, found.normals_px) > math.cos(min(turn, 1.4))
    typical_dn = float(np.median(found.contrast_dn[good])) if good.any() else 0.0
    strong: Mask = found.contrast_dn > _MIN_CONTRAST * typical_dn
    return found.select(np.flatnonzero(good & strong))


def _paired(small: EdgePoints, large: EdgePoints) -> tuple[EdgePoints, EdgePoints]:
    """Edges that both windows measured about the same pixel, in one order."""
    width = 1 + max(int(found.pixels_px.max(initial=0)) for found in (small, large))
    keys = [found.pixels_px[:, 1] * width + found.pixels_px[:, 0] for found in (small, large)]
    _, first, second = np.intersect1d(keys[0], keys[1], return_indices=True)
    return small.select(first), large.select(second)


def _smooth(values: Float, normals: Float, outlier_mad: float) -> Float:
    """What of values (n,) along a limb is even or goes with the direction (n, 2) of its normal."""
    design = np.concatenate([np.ones((len(values), 1)), normals], axis=1)
    solution, _ = robust_solution(values, design, np.full(len(values), 1e-3), outlier_mad=outlier_mad)
    result: Float = design @ solution
    return result


def _no_limb(inputs: EstimatorInputs, n_seeds: int, n_edges: int, options: EllipseFitOptions) -> Failure:
    saturated = float(inputs.saturated.mean())
    return inputs.fail(
        Reason.SATURATED if saturated > 0.2 else Reason.NO_LIMB,
        f"{n_edges} of {n_seeds} edges that the sunlight meets lie and look like the predicted limb, needed "
        f"{options.min_edges}",
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Plane:
    """The plane that touches the sphere of directions at one of them."""

    camera_from_plane: Float

    @classmethod
    def touching(cls, direction: Float) -> _Plane:
        turn, _ = Rotation.align_vectors(direction[None], np.array([[0.0, 0.0, 1.0]]))
        return cls(np.asarray(turn.as_matrix(), dtype=np.float64))

    def points(self, model: CameraModel, points_px: Float) -> Float:
        """Pixels (n, 2) in the plane (n, 2), unit: the distance of the plane."""
        turned = model.unproject(points_px) @ self.camera_from_plane
        result: Float = turned[:, :2] / turned[:, 2:]
        return result

    def scale(self, model: CameraModel, points_px: Float, normals_px: Float) -> Float:
        """How far (n,) a step of one pixel along normals goes."""
        sides = [self.points(model, points_px + side * normals_px) for side in (0.5, -0.5)]
        result: Float = np.linalg.norm(sides[0] - sides[1], axis=1)
        return result

    def cone(self, coefficients: Float) -> Float:
        """The cone (3, 3) over a conic in the plane, camera axes."""
        result: Float = self.camera_from_plane @ conic_matrix(coefficients) @ self.camera_from_plane.T
        return result


def _fix(
    inputs: EstimatorInputs, placed: PlacedEllipsoid, limb: _Limb, relief_px: float, options: EllipseFitOptions
) -> PositionFix | Failure:
    """Fit the ellipse, take it to a position, and judge it."""
    model, edges = inputs.camera.model, limb.edges
    figure, center_km = _figure(inputs, placed)
    plane = _Plane.touching(unit(center_km))
    points = plane.points(model, limb.points_px)
    scale = plane.scale(model, limb.points_px, edges.normals_px)
    kept = _agreeing(points, np.hypot(edges.sigma_px, relief_px) * scale, options)
    if isinstance(kept, Failure):
        return inputs.fail(kept.reason, kept.detail)
    step = math.ceil(np.count_nonzero(kept) / options.max_edges)
    order = np.argsort(np.arctan2(*(points[kept] - points[kept].mean(axis=0)).T))
    used = np.flatnonzero(kept)[order][::step]
    typical = float(np.median(scale))
    fit = fit_ellipse(points[used], sigma=(edges.sigma_px * scale)[used], correlation_length=_CORRELATION_PX * typical)
    if isinstance(fit, Failure):
        return inputs.fail(fit.reason, fit.detail)
    solved = _position(fit, plane, figure)
    if isinstance(solved, Failure):
        return inputs.fail(solved.reason, solved.detail)
    position_km, covariance_km2 = solved
    covariance_km2 = covariance_km2 + _systematic(
        inputs, limb.points_px[used], limb.correction_px[used], edges.sigma_px[used], figure, position_km
    )
    return _judged(
        inputs,
        limb,
        used,
        n_used=int(kept.sum()),
        position_km=position_km - (center_km - inputs.geometry.position_camera_km),
        covariance_km2=covariance_km2,
        residuals_px=fit.residuals / scale[used],
        relief_px=relief_px,
        options=options,
    )


def _agreeing(points: Float, sigma: Float, options: EllipseFitOptions) -> Mask | Failure:
    """Points that lie on one ellipse, but for their noise and the scatter of all."""
    middle = points.mean(axis=0)
    size = float(np.sqrt(points.var(axis=0).sum()))
    x, y = ((points - middle) / size).T
    design = np.stack([x * x + y * y, x, y, x * x - y * y, 2 * x * y], axis=-1)
    keep: Mask = robust_solution(np.ones(len(x)), design, sigma / size, outlier_mad=options.outlier_mad)[1]
    for _ in range(_ROUNDS):
        if np.count_nonzero(keep) < options.min_edges:
            return Failure(
                Reason.NO_LIMB, f"{int(keep.sum())} of {len(x)} edges lie on one ellipse, needed {options.min_edges}"
            )
        fit = fit_ellipse(points[keep], sigma=sigma[keep])
        if isinstance(fit, Failure):
            return fit
        away = _distances(points, fit)
        scatter = 1.4826 * float(np.median(np.abs(away[keep])))
        keep = np.abs(away) <= options.outlier_mad * np.hypot(sigma, scatter)
    return keep


def _distances(points: Float, fit: ConicFit) -> Float:
    """Distances (n,) of points from an ellipse, to first order."""
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    gradient = 2.0 * homogeneous @ fit.matrix
    result: Float = -0.5 * np.einsum("ij,ij->i", gradient, homogeneous) / np.linalg.norm(gradient[:, :2], axis=1)
    return result


def _position(fit: ConicFit, plane: _Plane, figure: Figure) -> tuple[Float, Float] | Failure:
    """Position of the ellipsoid (3,), km, and covariance (3, 3) by the scatter of the points."""
    position = position_of_cone(plane.cone(fit.coefficients), figure)
    values, vectors = np.linalg.eigh(fit.covariance)
    moves = []
    for value, vector in zip(values, vectors.T, strict=True):
        arm = math.sqrt(max(float(value), 0.0)) * vector
        sides = [position_of_cone(plane.cone(fit.coefficients + side * _STEP * arm), figure) for side in (1.0, -1.0)]
        if sides[0] is None or sides[1] is None or position is None:
            return Failure(Reason.DEGENERATE_GEOMETRY, "the ellipse is not the horizon of the body: too short an arc")
        moves.append((sides[0] - sides[1]) / (2.0 * _STEP))
    if position is None:
        return Failure(Reason.DEGENERATE_GEOMETRY, "the ellipse is not the horizon of the body: too short an arc")
    spread = np.array(moves)
    return position, spread.T @ spread


def _systematic(
    inputs: EstimatorInputs, points_px: Float, correction_px: Float, sigma_px: Float, figure: Figure, position_km: Float
) -> Float:
    """Covariance (3, 3), km^2, by what the correction for changing brightness leaves, alike along a radian of limb."""
    _, design, normals = horizon_residuals(points_px, inputs.camera.model, figure, position_km)
    by_ellipse = np.concatenate([design, _free_shape(normals)], axis=1)
    apart = np.linalg.norm(points_px[:, None] - points_px[None], axis=-1)
    left = _GROWTH_ERROR * float(np.sqrt(np.mean(correction_px**2)))
    shared = left**2 * np.exp(-apart / inputs.radius_px)
    covariance = generalised_solution(np.zeros(len(points_px)), by_ellipse, shared, weights=1.0 / sigma_px**2)[1]
    result: Float = covariance[:3, :3]
    return result


def _free_shape(normals: Float) -> Float:
    """The two ways (n, 2) in which the outline is free besides centre and size: flattening along two directions."""
    x, y = normals.T
    return np.stack([x * x - y * y, 2 * x * y], axis=-1)


def _judged(
    inputs: EstimatorInputs,
    limb: _Limb,
    used: NDArray[np.intp],
    *,
    n_used: int,
    position_km: Float,
    covariance_km2: Float,
    residuals_px: Float,
    relief_px: float,
    options: EllipseFitOptions,
) -> PositionFix | Failure:
    """The fix with its flags, or why there is none."""
    center_px, covariance_px2 = center_of_position(inputs.camera.model, position_km, covariance_km2)
    range_km = float(np.linalg.norm(position_km))
    sight = position_km / range_km
    sigma_range = math.sqrt(float(sight @ covariance_km2 @ sight)) / range_km
    sigma_px = math.sqrt(float(np.linalg.eigvalsh(covariance_px2)[-1]))
    if not (sigma_range < _MAX_RANGE_SIGMA and sigma_px < inputs.radius_px):
        return inputs.fail(
            Reason.DEGENERATE_GEOMETRY,
            f"{n_used} edges do not fix an ellipse: sigma {sigma_px:.1f} px across and {sigma_range:.1%} of range",
        )
    area = np.zeros(inputs.usable.shape, dtype=bool)
    area[limb.edges.pixels_px[:, 1], limb.edges.pixels_px[:, 0]] = True
    rms_px = float(np.sqrt(np.mean(residuals_px**2)))
    off_px = float(np.max(np.abs(center_px - inputs.predicted_px)))
    off_range = abs(range_km / inputs.geometry.range_km - 1.0)
    share = n_used / (2.0 * math.pi * inputs.radius_px)
    checks = (
        (Quality.SHAPE_APPROXIMATED, relief_px > 0.0),
        (Quality.SHORT_ARC, share < _QUARTER),
        (Quality.MANY_REJECTED, n_used < 0.5 * len(limb.edges)),
        (Quality.LARGE_RESIDUALS, rms_px > options.large_rms_px + 1.5 * relief_px),
        (
            Quality.FAR_FROM_PREDICTION,
            off_px > options.search_px or off_range > options.search_range + 2.0 * sigma_range,
        ),
    )
    flags = inputs.flags_at(area)
    for flag, applies in checks:
        flags |= flag if applies else Quality.NONE
    return PositionFix(
        estimator=inputs.estimator,
        target=inputs.target_name,
        center_px=center_px,
        covariance_px2=covariance_px2,
        predicted_px=inputs.predicted_px,
        residuals=residuals_px,
        n_used=n_used,
        n_rejected=limb.n_found - n_used,
        score=rms_px,
        flags=flags,
        provenance=inputs.provenance,
        position_camera_km=position_km,
        covariance_camera_km2=covariance_km2,
        limb_px=limb.points_px[used],
    )
