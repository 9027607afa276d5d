"""The laboratory calibration of III.A: a collimated point at every position of a gimbal grid, eq. 39, and the fit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.calibration import ImageObservations, calibrate
from giantlike.calibration.observations import collimator_directions
from giantlike.camera_models import BrownModel
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector
from giantlike.core.outcomes import Failure
from giantlike.core.values import Value
from giantlike.independent import PinholeView, Psf, Recorder, StarField, record, star_image
from giantlike.missions.orion.constants import ROUNDING, focal_px, table
from giantlike.missions.replay import DERIVED, INDEPENDENT, SELF_CHECK, Comparison, ReplaySettings, Stated
from giantlike.processing import detect_sources

FOCAL_ERROR, K1, P1, P2 = 1.002, -0.08, 1e-4, -5e-5
"""Assumed lens: the paper shows the flight camera's in a figure only."""
OFF_CENTER_PX = (3.2, -2.1)
STAR_DN = 13_000.0  # of a collimated point over all pixels: its peak of about 3,600 DN does not saturate
FOCUSED_PX, STAKED_PX = 0.1, 0.7  # blur of the lens in focus, and as it is staked
READ_NOISE_DN = 5.0
MATCH_PX = 40.0  # farther than the lens moves a point, nearer than half of the 255 px between points


def gimbal_angles() -> tuple[Float, Float]:
    """Azimuths and elevations, rad, of the least grid in steps of 2 degrees that covers the field."""
    gimbal = table("paper")["gimbal"]
    half = [math.ceil(field / 2.0 / gimbal["step_deg"]) for field in gimbal["field_deg"]]
    axes = [np.radians(gimbal["step_deg"]) * np.arange(-count, count + 1) for count in half]
    azimuth, elevation = np.meshgrid(*axes)
    return azimuth.ravel(), elevation.ravel()


def lens() -> PinholeView:
    """The made-up camera: as many pixels as the field of the paper has with its focal length."""
    half = np.radians(np.array(table("paper")["gimbal"]["field_deg"]) / 2.0)
    columns, rows = (round(2.0 * focal_px() * math.tan(each)) for each in half)
    center = ((columns - 1) / 2.0 + OFF_CENTER_PX[0], (rows - 1) / 2.0 + OFF_CENTER_PX[1])
    return PinholeView(focal_px() * FOCAL_ERROR, center, columns, rows, k1=K1, p1=P1, p2=P2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grid(Value):
    """The composite of all images, measured."""

    azimuth_rad: Float  # (n,); of the points that fell on the detector and were found
    points_px: Float  # (n, 2)
    eq39_px: Float  # (n,); error of eq. 39: centroids against tangents of the gimbal's angles.
    residuals_px: Float  # (n, 2); after the fit of a Brown model to the same centroids


def measure_grid(seed: int) -> Grid:
    """Take all images, combine them, find the points, and calibrate; a failure of any would be a defect."""
    azimuth, elevation = gimbal_angles()
    targets, view, rng = collimator_directions(azimuth, elevation), lens(), np.random.default_rng(seed)
    field = StarField(targets, np.zeros(len(targets)))
    light, _ = star_image(field, view, Rotation.identity(), psf=Psf(STAKED_PX), zero_point_dn=STAR_DN)
    seen = record(light, rng, Recorder(read_noise_e=READ_NOISE_DN, saturation_dn=4095.0))
    found = detect_sources(
        seen.pixels.astype(np.int16), detector=Detector(read_noise_e=READ_NOISE_DN), psf_sigma_px=STAKED_PX
    )
    if isinstance(found, Failure):
        found.unwrap()
    ideal = BrownModel(fx_px=focal_px(), fy_px=focal_px(), cx_px=(view.columns - 1) / 2.0, cy_px=(view.rows - 1) / 2.0)
    expected = ideal.project(targets)
    found = found.select(found.flux_dn > STAR_DN / 3.0)  # a whole point, not one that the edge cuts
    nearest, distance = _nearest(expected, found.points_px)
    seen_here = distance < MATCH_PX
    points = found.points_px[nearest[seen_here]]
    sigmas = np.sqrt(np.trace(found.covariance_px2[nearest[seen_here]], axis1=1, axis2=2) / 2.0)
    found_fit = calibrate(
        [ImageObservations(name="grid", targets=targets[seen_here], points_px=points, sigma_px=sigmas)],
        ideal,
        estimate=("fx_px", "fy_px", "cx_px", "cy_px", "k1", "p1", "p2"),
        columns=view.columns,
        rows=view.rows,
    )
    fitted = found_fit.unwrap()
    return Grid(
        azimuth_rad=azimuth[seen_here],
        points_px=points,
        eq39_px=equation_39(points - [ideal.cx_px, ideal.cy_px], azimuth[seen_here], elevation[seen_here]),
        residuals_px=fitted.observed_px - fitted.predicted_px,
    )


def equation_39(points_px: Float, azimuth_rad: Float, elevation_rad: Float) -> Float:
    """Error (n,) of eq. 39, px: points from the principal point; y grows down here and elevation is up."""
    ideal = focal_px() * np.column_stack([-np.tan(azimuth_rad), np.tan(elevation_rad)])
    return np.asarray(np.linalg.norm(points_px - ideal, axis=1))


def pinhole_error_px(azimuth_rad: Float, elevation_rad: Float) -> Float:
    """Error (n,), px, by eq. 39 of an ideal pinhole: its angles differ from gimbal angles."""
    directions = collimator_directions(azimuth_rad, elevation_rad)
    points = focal_px() * directions[:, :2] / directions[:, 2:]
    return equation_39(points, azimuth_rad, elevation_rad)


def centroid_errors_px(blur_px: float, count: int, seed: int) -> float:
    """Root mean square error of centroids per axis, px, of points at random positions on the pixels."""
    rng, spacing, size = np.random.default_rng(seed), 20, 20 * count
    view = PinholeView(focal_px(), ((size - 1) / 2.0, (size - 1) / 2.0), size, size)
    rows, columns = np.mgrid[0:count, 0:count] * spacing + spacing / 2.0
    places = np.column_stack([columns.ravel(), rows.ravel()]) + rng.uniform(-0.5, 0.5, (count**2, 2))
    directions = view.directions(places)
    field = StarField(directions / np.linalg.norm(directions, axis=1, keepdims=True), np.zeros(count**2))
    light, places = star_image(field, view, Rotation.identity(), psf=Psf(blur_px), zero_point_dn=STAR_DN / 10.0)
    seen = record(light, rng, Recorder(read_noise_e=READ_NOISE_DN, saturation_dn=4095.0))
    found = detect_sources(
        seen.pixels.astype(np.int16), detector=Detector(read_noise_e=READ_NOISE_DN), psf_sigma_px=blur_px
    )
    if isinstance(found, Failure):
        return math.inf
    _, distance = _nearest(places, found.points_px)
    return float(np.sqrt(np.mean(np.minimum(distance, 1.0) ** 2) / 2.0))


def _nearest(places_px: Float, points_px: Float) -> tuple[NDArray[np.intp], Float]:
    """Index of the point nearest to each position, and its distance, px."""
    if not len(points_px):
        return np.zeros(len(places_px), dtype=np.intp), np.full(len(places_px), np.inf)
    distances = np.linalg.norm(places_px[:, None] - points_px, axis=2)
    nearest = np.argmin(distances, axis=1)
    return nearest, distances[np.arange(len(places_px)), nearest]


FIT_PX = 0.1  # best accuracy of real-time centroids of bodies: a lens calibrated better than this adds nothing
POINTS = {False: 20, True: 8}  # points along a side, for the focus; fewer in a small run


def grid_comparisons(grid: Grid) -> list[Comparison]:
    """Eq. 39, the grid and the fit."""
    gimbal, kind = table("paper")["gimbal"], DERIVED
    azimuth, elevation = gimbal_angles()
    outside = [
        math.degrees(float(each.max())) - field / 2.0
        for each, field in zip((azimuth, elevation), gimbal["field_deg"], strict=True)
    ]
    arcsec = math.degrees(gimbal["pitch_mm"] / gimbal["focal_mm"]) * 3600.0
    residual = float(np.sqrt(np.mean(grid.residuals_px**2)))
    return [
        Stated("III.A", "images of the grid", gimbal["images"], len(azimuth), kind).near(
            0.0,
            "The least grid in steps of 2 degrees, through the boresight, that covers 19.5 by 15.6 degrees: 11 by 9.",
        ),
        Stated("III.A", "images whose point falls on the detector", gimbal["images"], len(grid.azimuth_rad), kind).near(
            0.0,
            f"The outer ring of the grid lies {outside[0]:.2f} and {outside[1]:.2f} degrees beyond the field "
            "that the paper states: all 99 are seen only by a larger detector, or the field is that of another one.",
        ),
        Stated("eq. 39", "a pixel of III.A, arcsec", table("paper")["camera"]["arcsec_per_px"], arcsec, DERIVED).near(
            ROUNDING, "43.3 mm and 0.018 mm are of another camera than the 28.2 arcsec of eq. 21."
        ),
        Stated(
            "eq. 39",
            "eq. 39 in a pinhole, largest error, px",
            1.0,
            float(pinhole_error_px(azimuth, elevation).max()),
            kind,
        ).at_most(
            "The paper has it stand for the lens, which has none here; 1 px is allowed. The tangent of a "
            "gimbal's "
            "azimuth is not that of the angle in the image: away from the axes eq. 39 takes geometry for distortion."
        ),
        Stated(
            "III.A, Fig. 5", "eq. 39 with a made-up lens after the fit, rms per axis, px", FIT_PX, residual, SELF_CHECK
        ).at_most(
            "Distortions are mapped and eliminated, the paper says; a Brown model fitted to the centroids of "
            f"the grid leaves this. Before it eq. 39 finds up to {float(grid.eq39_px.max()):.1f} px."
        ),
    ]


def focus_comparisons(settings: ReplaySettings) -> list[Comparison]:
    """The collimator's point, and the focus of the lens as it is staked."""
    gimbal = table("paper")["gimbal"]
    staked_px = FOCUSED_PX if settings.change == "lens_in_focus" else STAKED_PX
    spot_px = gimbal["pinhole_um"] * 1e-3 / gimbal["collimator_mm"] * focal_px()
    focused, staked = (
        centroid_errors_px(blur, POINTS[settings.small], settings.seed) for blur in (FOCUSED_PX, staked_px)
    )
    return [
        Stated("III.A", "image of the pinhole of the collimator, px", 1.0, spot_px, DERIVED).at_most(
            "15 um over 500 mm: smaller than a pixel, so that it stands for a star as the paper says."
        ),
        Stated(
            "III.A",
            "centroids of the lens as it is staked against one in focus",
            "a slight defocus gives sub-pixel resolution",
            f"{staked:.3f} px against {focused:.3f} px",
            INDEPENDENT,
            "lens_in_focus",
        ).agrees(
            staked < 0.5 * focused,
            f"Agrees where the error is less than half: blurs of {staked_px:g} and {FOCUSED_PX:g} px, "
            f"points of 1,300 DN.",
        ),
    ]
