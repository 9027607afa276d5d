"""One measurement of limbs on plain arrays: what lines and cells give, and what decides which points are good."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.outcomes import Failure, Reason
from giantlike.processing.limb.measurement import LimbMeasurement, SmoothError, judge_points, smooth_parts, too_few
from giantlike.processing.limb.view import LimbView
from giantlike.ray_tracing import Body, FocalPlane, McEwen, RenderOptions, Template, render
from giantlike.relative.horizon.cell_scan import measure_by_cells
from giantlike.relative.horizon.geometry import Altitude, Figure, fit_horizon
from giantlike.relative.horizon.options import HorizonScan, HorizonSearch
from giantlike.relative.limb.fix import IteratedSearch
from giantlike.relative.limb.line_scan import measure_by_lines
from giantlike.relative.limb.profiles import LimbScanOptions
from giantlike.relative.limb.solution import solve_limb
from giantlike.shapes import Ellipsoid
from tests.tolerances import SETTLED

SIGMAS = 4.0  # of three coordinates: once in ten thousand
SIZE, RADIUS_PX = 240, 70.0
SUN = np.array([np.sin(0.9), 0.0, -np.cos(0.9)])
SHAPE = Ellipsoid(radii_km=np.array([0.3, 0.28, 0.25]))
PLANE = FocalPlane(
    model=PinholeModel(fx_px=2000.0, fy_px=2000.0, cx_px=119.5, cy_px=119.5),
    columns=SIZE,
    rows=SIZE,
    psf=GaussianPsf(sigma_px=0.8),
)


def seen() -> tuple[LimbView, Body]:
    """An ellipsoid in plain arrays, and where it is."""
    truth = Body(
        shape=SHAPE,
        camera_from_body=Rotation.from_rotvec([0.3, -0.2, 0.5]),
        position_camera_km=np.array([0.02, -0.03, 0.28 * 2000.0 / RADIUS_PX]),
        reflectance=McEwen(),
    )
    options = RenderOptions(rays_per_pixel_side=5, jitter_seed=1)
    template = render(
        truth, PLANE.model, sun_direction_camera=SUN, psf=PLANE.psf, columns=SIZE, rows=SIZE, options=options
    )
    assert isinstance(template, Template)
    light = template.placed(SIZE, SIZE) * 3000.0 / template.brightness.max()
    rng = np.random.default_rng(4)
    pixels = rng.poisson(light) + rng.normal(0.0, 5.0, light.shape)
    view = LimbView(
        pixels_dn=pixels,
        usable=np.ones(pixels.shape, dtype=bool),
        saturated=np.zeros(pixels.shape, dtype=bool),
        detector=Detector(gain_e_per_dn=1.0, read_noise_e=5.0),
        plane=PLANE,
        sun_direction_camera=SUN,
        radius_px=RADIUS_PX,
    )
    return view, truth


def sigmas(position: Float, covariance: Float, truth: Float) -> float:
    error = position - truth
    return float(np.sqrt(error @ np.linalg.solve(covariance, error)))


def test_lines_and_cells_measure_a_limb_of_arrays_into_one_value() -> None:
    view, truth = seen()
    start = truth.at(truth.position_camera_km * 1.01 + np.array([0.02, -0.015, 0.0]))
    by_lines = measure_by_lines(view, start, IteratedSearch(), LimbScanOptions())
    assert isinstance(by_lines, LimbMeasurement)
    solution = solve_limb(by_lines, RADIUS_PX)
    assert sigmas(solution.position_camera_km, solution.covariance_camera_km2, truth.position_camera_km) < SIGMAS
    figure = Figure(radii_km=SHAPE.radii_km, camera_from_axes=truth.camera_from_body)
    by_cells = measure_by_cells(
        view, figure, truth.reflectance, start.position_camera_km, HorizonSearch(), HorizonScan()
    )
    assert isinstance(by_cells, LimbMeasurement)
    solution = fit_horizon(
        by_cells, PLANE.model, figure, by_cells.position_camera_km, Altitude(), sun_direction_camera=SUN
    )
    assert sigmas(solution.position_camera_km, solution.covariance_camera_km2, truth.position_camera_km) < SIGMAS
    known = {Cause.NOISE, Cause.PSF, Cause.ALTITUDE, Cause.REFLECTANCE}
    assert known <= set(solution.covariances_km2) <= known | {Cause.RELIEF}
    for measured in (by_lines, by_cells):
        assert measured.n_used <= measured.keep.size <= measured.n_offered
        assert 0.3 < measured.outline_share <= 0.7
        assert measured.rejected.keys() >= {"too weak", "not like the expected profile", "too bright or too dark"}


def test_points_are_rejected_for_the_first_reason_that_applies() -> None:
    yes = np.ones(6, dtype=bool)
    no = {number: np.arange(6) != number for number in range(6)}
    gains = np.array([1.0, 1.0, 1.0, 6.0, 1.0, 1.0])
    good, rejected = judge_points(
        complete=no[0], strong=no[0] & no[1], alike=no[2], gain_dn=gains, also={"ambiguous": no[4]}
    )
    assert good.tolist() == [False, False, False, False, False, True]
    assert list(rejected.values()) == [1, 1, 1, 1, 1]
    assert judge_points(complete=yes, strong=yes, alike=yes, gain_dn=gains, even=False)[0].all()


@pytest.mark.parametrize(("share", "reason"), [(0.1, Reason.NO_LIMB), (0.3, Reason.SATURATED)])
def test_too_few_points_name_saturation_where_it_is_the_reason(share: float, reason: Reason) -> None:
    view, _ = seen()
    saturated = np.zeros((SIZE, SIZE), dtype=bool)
    saturated[: int(share * SIZE)] = True
    view = replace(view, usable=~saturated, saturated=saturated)
    everywhere, good = np.ones((SIZE, SIZE), dtype=bool), np.arange(9) < 4
    failure = too_few(view, everywhere, good, {"too weak": 5, "ambiguous": 0}, needed=8)
    assert isinstance(failure, Failure)
    assert failure.reason is reason
    assert failure.detail.startswith("4 of 9")
    assert failure.detail.endswith("5 too weak")


def test_a_smooth_error_moves_a_solution_by_what_it_is() -> None:
    """One that all points share moves the radius by its sigma and nothing else."""
    angles = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    points = 100.0 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    design = np.stack([np.cos(angles), np.sin(angles), np.ones(60)], axis=-1)
    shared = SmoothError(cause=Cause.PSF, sigma_px=0.3, length_px=1e9)
    gain = np.linalg.pinv(design)
    covariance = smooth_parts((shared,), points, gain)[Cause.PSF]
    assert_allclose(covariance, np.diag([0.0, 0.0, 0.09]), rtol=0, atol=SETTLED)


def test_an_error_along_the_sun_is_the_same_on_both_sides_of_it_and_moves_no_circle_across() -> None:
    angles = np.radians([-60.0, -20.0, 20.0, 60.0])
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    error = SmoothError(cause=Cause.EDGE, sigma_px=0.2, length_px=30.0, along=(1.0, 0.0))
    covariance = error.covariance_px2(40.0 * normals)
    assert_allclose(covariance, covariance[::-1], rtol=0, atol=SETTLED)
    assert covariance[0, 1] < covariance[0, 3]
    gain = np.linalg.pinv(np.column_stack([normals, np.ones(4)]))
    moved = smooth_parts((error,), 40.0 * normals, gain)[Cause.EDGE]
    assert moved[0, 0] > 1e-3
    assert_allclose(moved[1], 0.0, rtol=0, atol=SETTLED)


def test_some_points_of_a_measurement_can_be_solved_alone() -> None:
    """A fit of some points failed where the points share errors: those were still as many as before."""
    view, truth = seen()
    measured = measure_by_lines(view, truth, IteratedSearch(), LimbScanOptions())
    assert isinstance(measured, LimbMeasurement)
    assert measured.common_px
    which = np.flatnonzero(measured.keep)[::-2]
    some = measured.select(which)
    assert_allclose(some.observed_px, measured.observed_px[which], rtol=0, atol=0)
    figure = Figure(radii_km=SHAPE.radii_km, camera_from_axes=truth.camera_from_body)
    solution = fit_horizon(some, PLANE.model, figure, truth.position_camera_km, Altitude(), sun_direction_camera=SUN)
    assert sigmas(solution.position_camera_km, solution.covariance_camera_km2, truth.position_camera_km) < SIGMAS
