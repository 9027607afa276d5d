"""The two algorithms that flew, and residuals as the paper plots them: center in the illumination frame, and radius."""

from __future__ import annotations

import math

import numpy as np

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask
from giantlike.core.outcomes import Failure
from giantlike.core.statistics import robust_sigma
from giantlike.missions.artemis1.images import ImageWindow
from giantlike.missions.artemis1.passes import Setting
from giantlike.processing.limb.edges import EdgePoints, scan_edges
from giantlike.processing.limb.view import LimbView
from giantlike.processing.limb.zernike import zernike_edges
from giantlike.ray_tracing import FocalPlane, McEwen
from giantlike.relative.horizon.cell_scan import measure_by_cells
from giantlike.relative.horizon.geometry import (
    Altitude,
    CraMethod,
    Figure,
    christian_robinson,
    fit_horizon,
    horizon_residuals,
)
from giantlike.relative.horizon.options import HorizonScan, HorizonSearch

_THRESHOLD_SIGMAS = 8.0
_LIT_COSINE = math.cos(math.radians(75.0))
"""Edges that face farther from the Sun in the image lie near the cusps, where the light fades."""
_OUTLIERS = 4.0  # robust sigmas
_ROUNDS = 3


def edges_of(setting: Setting, shot: ImageWindow, sun: Float) -> EdgePoints:
    """Lit limb of an image: pixels by a scan along the sunlight, refined by the moments of Zernike."""
    detector = setting.detector
    dark_dn = math.sqrt(float(detector.variance_dn2(np.zeros(1))[0]))
    usable: Mask = np.ones(shot.pixels_dn.shape, dtype=bool)
    contrast_dn = float(np.quantile(shot.pixels_dn, 0.98))
    threshold_dn = max(_THRESHOLD_SIGMAS * dark_dn, 0.1 * contrast_dn)
    blur_px = setting.psf.sigma_px
    seeds = scan_edges(shot.pixels_dn, usable, -sun[:2], threshold_dn=threshold_dn, blur_sigma_px=blur_px)
    return zernike_edges(
        shot.pixels_dn,
        usable,
        seeds,
        variance_dn2=detector.variance_dn2,
        blur_sigma_px=blur_px,
        size=5,
        curvature_px=1.0 / shot.radius_px,
    )


def non_iterative(setting: Setting, shot: ImageWindow, sun: Float, figure: Figure) -> tuple[Float, Float] | Failure:
    """Christian-Robinson algorithm on edges by moments. Returns ``position_camera_km`` and ``points_px`` (n, 2)."""
    edges = edges_of(setting, shot, sun)
    toward = sun[:2] / np.linalg.norm(sun[:2])
    facing = edges.normals_px @ toward > _LIT_COSINE
    points, sigmas = edges.points_px[facing], edges.sigma_px[facing]
    position: Float | Failure = np.zeros(3)
    for _ in range(_ROUNDS):
        position = christian_robinson(points, shot.model, figure, method=CraMethod.TOTAL_LEAST_SQUARES, sigma_px=sigmas)
        if isinstance(position, Failure):
            return position
        residuals = horizon_residuals(points, shot.model, figure, position)[0]
        near = np.abs(residuals) < _OUTLIERS * max(robust_sigma(residuals), 1e-3)
        points, sigmas = points[near], sigmas[near]
    assert not isinstance(position, Failure)
    return position, points + shot.corner_px


def iterative(setting: Setting, shot: ImageWindow, sun: Float, figure: Figure, start_km: Float) -> Float | Failure:
    """Fit of an ellipsoidal sigmoid to the light along the limb, from the solution of the other algorithm."""
    detector = setting.detector
    clipped = shot.pixels_dn >= detector.saturation_dn
    radius_px = apparent_radius_px(shot.model, float(figure.radii_km.mean()), start_km)
    view = LimbView(
        pixels_dn=shot.pixels_dn,
        usable=~clipped,
        saturated=clipped,
        detector=detector,
        plane=FocalPlane(model=shot.model, psf=setting.psf, columns=shot.pixels_dn.shape[1], rows=len(shot.pixels_dn)),
        sun_direction_camera=sun,
        radius_px=radius_px,
    )
    search = HorizonSearch(search_px=5.0, search_range=0.02, max_iterations=15, outlier_mad=5.0, tolerance_px=0.005)
    measured = measure_by_cells(view, figure, McEwen(), start_km, search, HorizonScan())
    if isinstance(measured, Failure):
        return measured
    found_km = measured.position_camera_km
    solution = fit_horizon(measured, shot.model, figure, found_km, Altitude(), sun_direction_camera=sun)
    return solution.position_camera_km


def apparent_radius_px(model: CameraModel, radius_km: float, position_km: Float) -> float:
    """Radius of a sphere in the image, px, by the tangent of its angle: Holt et al. (2018), eq. 10, halved."""
    distance = float(np.linalg.norm(position_km))
    focal_px = float(model.parameters[list(model.parameter_names).index("fx_px")])
    return focal_px * radius_km / math.sqrt(distance**2 - radius_km**2)


def residual_px(model: CameraModel, radius_km: float, estimate_km: Float, known_km: Float, sun: Float) -> Float:
    """Estimate minus truth: center along the Sun and across it, and radius, (3,), px.

    Negative radii are ranges that are too long, as in the paper.
    """
    off = model.project(estimate_km) - model.project(known_km)
    toward = sun[:2] / np.linalg.norm(sun[:2])
    across = np.array([-toward[1], toward[0]])
    radii = [apparent_radius_px(model, radius_km, each) for each in (estimate_km, known_km)]
    return np.array([off @ toward, off @ across, radii[0] - radii[1]])
