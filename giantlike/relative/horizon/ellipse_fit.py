"""Ellipse fit: position of a body from an ellipse through the edges of its lit limb, without a reflectance law."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera_models import CameraModel, ifov_rad
from giantlike.core.arrays import Float, Mask, require, require_number, unit
from giantlike.core.causes import Cause
from giantlike.core.detector import UNKNOWN_PSF_SIGMA_PX
from giantlike.core.outcomes import Failure, PositionFix, Reason
from giantlike.core.pixel_box import PixelBox
from giantlike.core.statistics import robust_sigma
from giantlike.core.values import Value, select_rows
from giantlike.processing.correlated_fit import robust_solution
from giantlike.processing.geometry.conic_fit import ConicFit, fit_ellipse
from giantlike.processing.limb.edges import EdgePoints, scan_edges
from giantlike.processing.limb.measurement import LimbMeasurement, SmoothError, too_few
from giantlike.processing.limb.segmentation import Background, background_of
from giantlike.processing.limb.view import LimbView
from giantlike.processing.limb.zernike import zernike_edges
from giantlike.relative.estimator import BodyEstimator
from giantlike.relative.horizon.clipped_disk import measure_clipped
from giantlike.relative.horizon.ellipsoid_cra import EllipsoidStandIn
from giantlike.relative.horizon.geometry import Altitude, Figure, christian_robinson, fit_horizon, horizon_residuals
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.judge import LEAST_USED_SHARE
from giantlike.relative.light.phase_correction import sunlight_px
from giantlike.relative.limb.fix import IteratedSearch, LimbSearch, LimbSolution, ScanOptions, limb_fix, limb_view
from giantlike.relative.limb.terrain import with_terrain

__all__ = ["EllipseFit", "EllipseFitOptions"]

_ROUNDS = 3  # iterations of fit and rejection; the points used do not change after two
_LIGHT_SIGMAS, _LIGHT_SHARE = 5.0, 0.1
"""Threshold of light above the background, in sigmas and as a fraction of the brightness of the body."""
_SKY_SAMPLE, _LEAST_SKY_STEP, _MIN_SKY = 16_000, 4, 60
"""Approximate number of sky pixels sampled, which determine its level to a hundredth of its noise; minimum step between
them; and minimum number of samples for level and noise."""
_BOX_MARGIN_PX = 8  # margin around the search region of the limb, px, for the windows of edges
_STRETCH = 1.5
"""Maximum ratio of the apparent size of a body under distortion to its size by the scale at the center; limb beyond it
is not measured."""
_MIN_COSINE = 0.2
"""Minimum cosine between sunlight and the normal of an edge; below it the limb merges with the terminator."""
_MAX_TURN_RAD = 0.5  # maximum angle between the normals of edge and prediction, rad
_MIN_CONTRAST = 0.25  # minimum contrast of an edge relative to the median edge
_GROWTH = 2.5
"""Ratio of the error of an edge in 5 x 5 pixels by a brightness gradient inside to its increase in 7 x 7.

That brightness follows the cosine of emission, the root of the distance from the limb. On spheres under the laws of
Lambert, Lommel-Seeliger and McEwen, at 20 to 110 degrees, the correction reduces errors of 0.05-0.2 px to 0.06 px and
less.
"""
_GROWTH_LENGTH = 3.0
"""Correlation length, along the Sun, of the error of that correction, radii: it has one sign along most of the limb,
and is symmetric about the direction of the Sun."""
_GROWTH_ERROR, _WINDOW_ERROR_PX2 = 0.5, 3.0
"""Relative error of that correction; and its additional error times the radius, px^2.

From ellipsoids of 60-300 px under the laws of McEwen, Lambert, Lommel-Seeliger, Hapke and Minnaert, at 15-125 degrees,
with the declared point spread function, 30 % wider or narrower, and with wings. Ratios of squared errors to variance in
144 fixes: 1.3 along the Sun and in range, 0.7 across; by phase 0.6, 0.7, 0.6 and, at 125 degrees, 1.7.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class EllipseFitOptions(LimbSearch):
    """Options of :class:`EllipseFit`.

    Parameters
    ----------
    search_px : float, px; largest error of the predicted center
    search_range : float; largest relative error of the predicted range
    max_relief : float
        Meshes that depart from their best-fit ellipsoid by more than this (root mean square over mean radius) are
        refused.
    min_edges : int; fewer edges than this are no limb
    max_edges : int
        On longer limbs every second, third ... edge is used.
    outlier_mad : float; edges beyond so many robust sigmas are left out
    large_rms_px : float, px; kept for files of earlier versions: residuals raise no flag
    """

    search_range: float = 0.05
    max_relief: float = 0.08
    min_edges: int = 20
    max_edges: int = 300

    def __post_init__(self) -> None:
        LimbSearch.__post_init__(self)
        require_number(self.max_relief, "max_relief", above=0.0)
        require(
            8 <= self.min_edges <= self.max_edges <= 1000,
            f"edges must be 8 <= min_edges <= max_edges <= 1000, got {self.min_edges} and {self.max_edges}",
        )


class EllipseFit(BodyEstimator[EllipseFitOptions, PositionFix]):
    """Position of a body from an ellipse through the edges of its lit limb.

    Edges are found by a scan along the sunlight, measured by Zernike moments, and mapped by the camera model to the
    plane tangent to the sphere of directions at the predicted position, where the horizon of an ellipsoid is an ellipse
    for any distortion. An ellipse with all five parameters free selects the edges of the limb; direction and range then
    follow from the best-fitting horizon of the known axes. No reflectance law is used: the bias of edges by a
    brightness gradient inside the limb is estimated from windows of two sizes, and its uncertainty is in the
    covariance, as is the relief that residuals show. Where the disk is clipped along the limb and too few edges are
    left, lines are matched with a template that is clipped alike.

    ``score`` of the fix is the root mean square of the residuals in px; ``residuals`` are distances across the horizon,
    px, positive outside.

    Failures are ``WRONG_SHAPE`` for a body that is not an ellipsoid, ``NO_LIMB``, ``SATURATED``, and ``NOT_CONVERGED``
    or ``DEGENERATE_GEOMETRY`` where the arc does not determine an ellipse.

    Parameters
    ----------
    options : EllipseFitOptions

    References
    ----------
    .. [1] Thrasher et al., Development of the Optical Deep-Space Instrument for Navigation, "OpNav Target
       Identification" (center of a resolved body by an ellipse through its horizon points) and eqs. 8-13.
    .. [2] Inman et al., Artemis I optical navigation system performance, section III.A (scan, then moments).
    """

    name: ClassVar[str] = "ellipse_fit"
    options_type = EllipseFitOptions

    def _estimate(self, inputs: EstimatorInputs) -> PositionFix | Failure:
        stand_in = EllipsoidStandIn.from_inputs(inputs, self.options.max_relief)
        if isinstance(stand_in, Failure):
            return stand_in
        altitude = Altitude.from_geometry(inputs.geometry)
        stand_in = replace(stand_in, figure=altitude.above(stand_in.figure))
        view = limb_view(inputs, altitude.sigma_km)
        measured = limb_edges(view, stand_in, sunlight_px(inputs.geometry, inputs.camera.model), self.options)
        if view.clipped_pixels.any() and _mostly_lost(measured):
            search = IteratedSearch(search_px=self.options.search_px, search_range=self.options.search_range)
            law, start_km = inputs.geometry.target.reflectance, stand_in.position_camera_km
            measured = measure_clipped(view, stand_in.figure, law, start_km, search, ScanOptions())
        if isinstance(measured, Failure):
            return measured
        measured = with_terrain(measured, inputs, self.options.outlier_mad)
        solved = fit_limb_ellipse(measured, view, stand_in, self.options, altitude)
        if isinstance(solved, Failure):
            return solved
        return limb_fix(inputs, *solved, self.options)


def _mostly_lost(measured: LimbMeasurement | Failure) -> bool:
    """True if the limb could not be measured, or less than half of the sunward edges are limb."""
    return isinstance(measured, Failure) or measured.n_offered < LEAST_USED_SHARE * (
        measured.n_offered + measured.n_elsewhere
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Plane(Value):
    """Plane tangent to the sphere of directions at one of them."""

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
        """Length (n,) in the plane of one pixel along normals."""
        sides = [self.points(model, points_px + side * normals_px) for side in (0.5, -0.5)]
        result: Float = np.linalg.norm(sides[0] - sides[1], axis=1)
        return result


def limb_edges(
    view: LimbView, stand_in: EllipsoidStandIn, sunlight: Float, options: EllipseFitOptions
) -> LimbMeasurement | Failure:
    """Measure the edges of the lit limb near the predicted one.

    ``sunlight`` (2,), unit vector along which sunlight travels in the image.
    """
    if not sunlight.any():
        return Failure(Reason.NO_LIMB, "the Sun stands behind the camera: sunlight has no direction in the image")
    sky = _sky(view, stand_in, options.search_px)
    if isinstance(sky, Failure):
        return sky
    background, body_dn = sky
    threshold = background.level_dn + max(_LIGHT_SIGMAS * background.sigma_dn, _LIGHT_SHARE * body_dn)
    blur_px = UNKNOWN_PSF_SIGMA_PX if view.psf_sigma_px is None else view.psf_sigma_px
    box = _search_box(view, stand_in, options)
    pixels_dn, usable = view.pixels_dn[box.slices] - background.level_dn, view.usable[box.slices]
    threshold_dn = threshold - background.level_dn
    seeds = scan_edges(pixels_dn, usable, sunlight, threshold_dn=threshold_dn, blur_sigma_px=blur_px)
    both = []
    for size in (5, 7):
        found = zernike_edges(
            pixels_dn,
            usable,
            seeds,
            variance_dn2=view.detector.variance_dn2,
            blur_sigma_px=blur_px,
            size=size,
            curvature_px=1.0 / view.radius_px,
        )
        both.append(_near_prediction(view, found.shift(box.corner_px), stand_in, sunlight, options))
    small, large = _pair_edges(*both)
    if len(small) < options.min_edges:
        light = (view.usable & (view.pixels_dn > threshold)) | view.clipped_pixels
        good = np.arange(max(len(seeds), len(small))) < len(small)
        elsewhere = {"not like the predicted limb in place, direction or contrast": len(seeds) - len(small)}
        return too_few(view, light, good, elsewhere, needed=options.min_edges)
    shift = np.einsum("ij,ij->i", large.points_px - small.points_px, small.normals_px)
    smooth, noise = _smooth(shift, small.normals_px, options.outlier_mad)
    correction = _GROWTH * smooth
    points = small.points_px - correction[:, None] * small.normals_px
    away_px, design, _ = horizon_residuals(points, view.model, stand_in.figure, stand_in.position_camera_km)
    area = np.zeros(view.usable.shape, dtype=bool)
    area[small.pixels_px[:, 1], small.pixels_px[:, 0]] = True
    corrected_px = float(np.sqrt(np.mean(correction**2)))
    growth_px = math.hypot(_GROWTH_ERROR * corrected_px, _WINDOW_ERROR_PX2 / view.radius_px)
    return LimbMeasurement(
        predicted_px=points - away_px[:, None] * small.normals_px,
        normals_px=small.normals_px,
        design=design,
        shift_px=away_px,
        sigma_px=small.sigma_px,
        keep=np.ones(len(small), dtype=bool),
        common_px={Cause.NOISE: _GROWTH * noise},
        smooth_errors=(
            SmoothError(
                cause=Cause.EDGE,
                sigma_px=growth_px,
                length_px=_GROWTH_LENGTH * view.radius_px,
                along=(float(sunlight[0]), float(sunlight[1])),
            ),
        ),
        position_camera_km=stand_in.position_camera_km,
        spacing_px=1.0,
        perimeter_px=2.0 * math.pi * view.radius_px,
        cut_by_frame=False,
        rejected={},
        area=area,
        relief=stand_in.relief,
        n_elsewhere=len(seeds) - len(small),
    )


def fit_limb_ellipse(
    measured: LimbMeasurement,
    view: LimbView,
    stand_in: EllipsoidStandIn,
    options: EllipseFitOptions,
    altitude: Altitude,
) -> tuple[LimbMeasurement, LimbSolution] | Failure:
    """Fit an ellipse to edges of a limb, and the horizon of the body to those that lie on it."""
    model, observed_px, figure = view.model, measured.observed_px, stand_in.figure
    plane = _Plane.touching(unit(stand_in.position_camera_km))
    points = plane.points(model, observed_px)
    scale = plane.scale(model, observed_px, measured.normals_px)
    kept = _select_agreeing(points, np.hypot(measured.sigma_px, measured.relief_px) * scale, options)
    if isinstance(kept, Failure):
        return kept
    order = np.argsort(np.arctan2(*(points[kept] - points[kept].mean(axis=0)).T))
    used = np.flatnonzero(kept)[order][:: math.ceil(np.count_nonzero(kept) / options.max_edges)]
    start_km = christian_robinson(observed_px[used], model, figure, sigma_px=measured.sigma_px[used])
    if isinstance(start_km, Failure):
        return start_km
    chosen, sun = measured.select(used), view.sun_direction_camera
    solution = fit_horizon(chosen, model, figure, start_km, altitude, sun_direction_camera=sun)
    return replace(measured, keep=kept), replace(
        solution, position_camera_km=solution.position_camera_km - stand_in.offset_camera_km
    )


def _sky(view: LimbView, stand_in: EllipsoidStandIn, search_px: float) -> tuple[Background, float] | Failure:
    """Background next to the predicted body, and brightness of the body above it (upper quartile)."""
    step = max(math.isqrt(view.usable.size // _SKY_SAMPLE), _LEAST_SKY_STEP)
    rows, columns = (np.arange(0, size, step) for size in view.usable.shape)
    x, y = (part.ravel() for part in np.meshgrid(columns, rows))
    directions = view.model.unproject(np.stack([x, y], axis=-1).astype(np.float64))
    keep = view.usable[y, x] & np.isfinite(directions).all(axis=1)
    directions, values = directions[keep], view.pixels_dn[y[keep], x[keep]]
    center_px = np.clip(view.model.project(stand_in.position_camera_km), 0, [columns[-1], rows[-1]])
    slack = search_px * float(ifov_rad(view.model, center_px))
    outward = _horizon_angle(directions, stand_in.figure, stand_in.position_camera_km)
    sky, body = values[outward > slack], values[outward < -slack]
    if sky.size < _MIN_SKY:
        return Failure(
            Reason.NO_LIMB, f"no sky in the frame beside the body, as predicted and {search_px:g} px around it"
        )
    background = background_of(sky)
    sigma_dn = max(background.sigma_dn, 0.1 * view.sky_noise_dn)
    bright = float(np.percentile(body, 75.0)) - background.level_dn if body.size else 0.0
    return Background(level_dn=background.level_dn, sigma_dn=sigma_dn), max(bright, 0.0)


def _horizon_angle(directions: Float, figure: Figure, center_km: Float) -> Float:
    """Approximate angle, rad, of directions (n, 3) outside the horizon."""
    mapped = directions @ figure.to_sphere.T
    normal = figure.to_sphere @ center_km
    distance = float(np.linalg.norm(normal))
    cosine = np.clip(mapped @ normal / np.linalg.norm(mapped, axis=1) / distance, -1.0, 1.0)
    result: Float = (np.arccos(cosine) / math.asin(1.0 / distance) - 1.0) * (
        float(np.cbrt(np.prod(figure.radii_km))) / float(np.linalg.norm(center_km))
    )
    return result


def _search_box(view: LimbView, stand_in: EllipsoidStandIn, options: EllipseFitOptions) -> PixelBox:
    """Part of the frame that holds all possible positions of the limb; all of it where the center has no image."""
    rows, columns = view.usable.shape
    center_px = view.model.project(stand_in.position_camera_km)
    if not np.isfinite(center_px).all():
        return PixelBox(x=0, y=0, width=columns, height=rows)
    radius_px = _longest_px(view, stand_in.figure)
    reach = _STRETCH * (1.0 + options.search_range) * radius_px + options.search_px + _BOX_MARGIN_PX
    return PixelBox.spanning(center_px - reach, center_px + reach + 1.0).clip(columns, rows)


def _longest_px(view: LimbView, figure: Figure) -> float:
    """Apparent length of the longest semi-axis, px."""
    return view.radius_px * float(figure.radii_km.max() / np.cbrt(np.prod(figure.radii_km)))


def _near_prediction(
    view: LimbView, found: EdgePoints, stand_in: EllipsoidStandIn, sunlight: Float, options: EllipseFitOptions
) -> EdgePoints:
    """Sunward edges consistent in position and appearance with the predicted limb, within the allowed errors."""
    if not len(found):
        return found
    model, figure = view.model, stand_in.figure
    known = np.isfinite(model.unproject(found.points_px)).all(axis=1)
    found = select_rows(found, np.flatnonzero(known))
    away_px, _, normals = horizon_residuals(found.points_px, model, figure, stand_in.position_camera_km)
    reach = options.search_px + options.search_range * _longest_px(view, figure)
    good: Mask = np.isfinite(away_px) & (np.abs(away_px) < reach)
    good &= found.normals_px @ -sunlight > _MIN_COSINE
    turn = _MAX_TURN_RAD + reach / view.radius_px
    good &= np.einsum("ij,ij->i", normals, found.normals_px) > math.cos(min(turn, 1.4))
    typical_dn = float(np.median(found.contrast_dn[good])) if good.any() else 0.0
    strong: Mask = found.contrast_dn > _MIN_CONTRAST * typical_dn
    return select_rows(found, np.flatnonzero(good & strong))


def _pair_edges(small: EdgePoints, large: EdgePoints) -> tuple[EdgePoints, EdgePoints]:
    """Edges that both windows measured about the same pixel, in one order."""
    width = 1 + max(int(found.pixels_px.max(initial=0)) for found in (small, large))
    keys = [found.pixels_px[:, 1] * width + found.pixels_px[:, 0] for found in (small, large)]
    _, first, second = np.intersect1d(keys[0], keys[1], return_indices=True)
    return select_rows(small, first), select_rows(large, second)


def _smooth(values: Float, normals: Float, outlier_mad: float) -> tuple[Float, Float]:
    """Part of values (n,) along a limb that is constant or linear in the direction (n, 2) of its normal.

    Also the change of it (n, 3) by one standard deviation of each unknown.
    """
    design = np.concatenate([np.ones((len(values), 1)), normals], axis=1)
    solution, keep = robust_solution(values, design, np.full(len(values), 1e-3), outlier_mad=outlier_mad)
    result: Float = design @ solution
    left, (_, triangle) = (values - result)[keep], np.linalg.qr(design[keep])
    scatter = float(np.sqrt(left @ left / max(len(left) - design.shape[1], 1)))
    return result, scatter * np.linalg.solve(triangle.T, design.T).T


def _select_agreeing(points: Float, sigma: Float, options: EllipseFitOptions) -> Mask | Failure:
    """Points that lie on one ellipse within noise and scatter."""
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
        scatter = robust_sigma(away[keep], 0.0)
        before, keep = keep, np.abs(away) <= options.outlier_mad * np.hypot(sigma, scatter)
        if np.array_equal(keep, before):
            break
    return keep


def _distances(points: Float, fit: ConicFit) -> Float:
    """Distances (n,) of points from an ellipse, to first order."""
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    gradient = 2.0 * homogeneous @ fit.matrix
    result: Float = -0.5 * np.einsum("ij,ij->i", gradient, homogeneous) / np.linalg.norm(gradient[:, :2], axis=1)
    return result
