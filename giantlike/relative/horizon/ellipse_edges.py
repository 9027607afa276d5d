"""Edges on the lit limb near a predicted one, for the estimator that puts an ellipse through them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float, Mask, require
from giantlike.core.detector import UNKNOWN_PSF_SIGMA_PX
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.processing.correlated_fit import robust_solution
from giantlike.processing.limb.edges import EdgePoints, scan_edges
from giantlike.processing.limb.segmentation import Background, background_of
from giantlike.processing.limb.zernike import zernike_edges
from giantlike.relative.estimator import EstimatorInputs
from giantlike.relative.horizon.geometry import Figure, horizon_residuals
from giantlike.relative.light.phase_correction import sunlight_px
from giantlike.shapes import PlacedEllipsoid

_LIGHT_SIGMAS, _LIGHT_SHARE = 5.0, 0.1  # of light: over the background, and of the brightness of the body
_SKY_STEP = 4
_MIN_SKY = 60
_MIN_COSINE = 0.2  # between sunlight and edge: beyond, the limb goes over into the terminator
_MAX_TURN_RAD = 0.5  # between the normals of edge and prediction
_MIN_CONTRAST = 0.25  # of the median edge
_GROWTH = 2.5
"""Error of an edge in 5 x 5 pixels by brightness that changes inside, over how much more it is in 7 x 7.

That brightness goes with the cosine of emission, the root of the distance from the limb. On spheres under the laws of
Lambert, Lommel-Seeliger and McEwen, at 20 to 110 degrees, it takes 0.05-0.2 px of error down to 0.06 px and less.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class EllipseFitOptions:
    """Options of :class:`EllipseFit`.

    Parameters
    ----------
    search_px : float, px
        Largest error of the predicted center.
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimbEdges(Value):
    """Edges on the lit limb.

    Parameters
    ----------
    edges : EdgePoints
        As measured in windows of 5 x 5 pixels.
    points_px : (n, 2) float64, px
        The same, less what brightness that changes inside the limb does to them.
    correction_px : (n,) float64, px
        That, along the normals.
    n_found : int
        Edges that the scan met.
    """

    edges: EdgePoints
    points_px: Float
    correction_px: Float
    n_found: int


def limb_edges(inputs: EstimatorInputs, placed: PlacedEllipsoid, options: EllipseFitOptions) -> LimbEdges | Failure:
    """Find the edges of the lit limb near the predicted one.

    Parameters
    ----------
    inputs : EstimatorInputs
    placed : PlacedEllipsoid
        The ellipsoid that stands for the body.
    options : EllipseFitOptions

    Returns
    -------
    LimbEdges or Failure
        ``NO_LIMB`` or ``SATURATED``.
    """
    figure, center_km = figure_of(inputs, placed)
    sky = _sky(inputs, figure, center_km, options)
    if isinstance(sky, Failure):
        return sky
    background, body_dn = sky
    sunlight = sunlight_px(inputs.geometry, inputs.camera.model)
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
    return LimbEdges(edges=small, points_px=points, correction_px=correction, n_found=len(seeds))


def figure_of(inputs: EstimatorInputs, placed: PlacedEllipsoid) -> tuple[Figure, Float]:
    """The ellipsoid in camera axes, and where its center is predicted (3,), km, camera axes."""
    turn = inputs.geometry.camera_from_body
    figure = Figure(radii_km=placed.ellipsoid.radii_km, camera_from_axes=turn * placed.body_from_axes)
    return figure, inputs.geometry.position_camera_km + rotate(turn, placed.center_body_km)


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
