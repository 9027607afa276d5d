"""Limb scanning on edges that are known exactly, and least squares for residuals that err together."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import ndtr

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector
from giantlike.core.errors import InputError
from giantlike.processing.correlated_fit import robust_solution, solution_gain
from giantlike.processing.limb.measurement import pixels_near
from giantlike.processing.limb.scan import (
    PIXEL_VARIANCE_PX2,
    SAMPLING_VARIANCE_PX2,
    Scans,
    edge_width_px,
    line_offsets,
    match_profiles,
    scan_lines,
    step_profile,
)
from giantlike.processing.limb.search import search_limb
from giantlike.processing.limb.view import LimbView, PredictedLimb
from giantlike.ray_tracing import FocalPlane
from tests.bands import mean_square_band
from tests.tolerances import FLOAT64_SUM

DETECTOR = Detector(gain_e_per_dn=1.0, read_noise_e=5.0)
NOISELESS_PX = 0.005  # the shift is fitted linearly about the nearest half pixel
CORRELATED = 0.95  # a shift of 1.5 px by multiples of half a pixel; bad values left in make it 0.7
SIGMA_RATIO = 0.15  # of 600 lines: five times the standard error of a standard deviation, 2.9 %
PSF_PX = 0.8
RADIUS_PX = 120.0
CENTER_PX = np.array([150.3, 149.6])
SIZE = 300


def disk(*, center_px: Float = CENTER_PX, radius_px: float = RADIUS_PX, level_dn: float = 2000.0) -> Float:
    """A bright disk seen through a Gaussian; the pixel is a Gaussian of its variance, the curvature negligible."""
    y, x = np.mgrid[:SIZE, :SIZE]
    distance = np.hypot(x - center_px[0], y - center_px[1])
    result: Float = level_dn * ndtr((radius_px - distance) / np.sqrt(PSF_PX**2 + PIXEL_VARIANCE_PX2))
    return result


def circle(count: int, *, radius_px: float = RADIUS_PX, center_px: Float = CENTER_PX) -> tuple[Float, Float]:
    angles = (np.arange(count) + 0.37) * 2.0 * np.pi / count
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return center_px + radius_px * normals, normals


def limb_of(points: Float, normals: Float) -> PredictedLimb:
    return PredictedLimb(
        points_px=points,
        points_camera_km=np.zeros((len(points), 3)),
        normals_px=normals,
        brightness=np.ones(len(points)),
    )


def view_of(image: Float) -> LimbView:
    return LimbView(
        pixels_dn=image,
        usable=np.ones(image.shape, dtype=bool),
        saturated=np.zeros(image.shape, dtype=bool),
        detector=DETECTOR,
        plane=FocalPlane(model=PinholeModel(fx_px=1e3, fy_px=1e3, cx_px=150.0, cy_px=150.0), columns=SIZE, rows=SIZE),
        sun_direction_camera=np.array([-1.0, 0.0, 0.0]),
        radius_px=RADIUS_PX,
    )


def scans_of(image: Float, points: Float, normals: Float, reach_px: float = 10.0) -> Scans:
    return scan_lines(image, np.ones(image.shape, dtype=bool), points, normals, line_offsets(reach_px, 0.5))


def expected_of(scans: Scans) -> Float:
    width = np.sqrt(PSF_PX**2 + PIXEL_VARIANCE_PX2 + SAMPLING_VARIANCE_PX2)
    return np.tile(step_profile(scans.offsets_px, width), (len(scans.points_px), 1))


def test_lines_over_a_plane_hold_exactly_its_values() -> None:
    y, x = np.mgrid[:60, :50]
    points, normals = np.array([[20.3, 31.7], [25.0, 30.0]]), np.array([[0.6, 0.8], [-1.0, 0.0]])
    scans = scans_of(2.0 * x - 3.0 * y + 5.0, points, normals, reach_px=6.0)
    places = points[:, None] + scans.offsets_px[:, None] * normals[:, None]
    assert_allclose(scans.values_dn, 2.0 * places[..., 0] - 3.0 * places[..., 1] + 5.0, rtol=0, atol=FLOAT64_SUM)
    assert scans.usable.all()


def test_values_made_from_a_bad_pixel_or_from_beyond_the_edge_are_not_usable() -> None:
    usable = np.ones((40, 40), dtype=bool)
    usable[20, 24] = False
    scans = scan_lines(
        np.zeros((40, 40)), usable, np.array([[20.0, 20.0]]), np.array([[1.0, 0.0]]), line_offsets(24.0, 1.0)
    )
    columns = 20.0 + scans.offsets_px
    clean = (np.abs(columns - 24.0) > 2.0) & (columns >= 1.0) & (columns <= 38.0)
    assert scans.usable[0].tolist() == clean.tolist()


@pytest.mark.parametrize("moved_px", [-2.9, -0.77, 0.0, 0.24, 1.5, 3.6])
def test_a_match_finds_the_shift_of_a_blurred_edge_without_noise(moved_px: float) -> None:
    points, normals = circle(90)
    scans = scans_of(disk(radius_px=RADIUS_PX + moved_px), points, normals)
    match = match_profiles(scans, expected_of(scans), variance_dn2=DETECTOR.variance_dn2, window_px=5.0, search_px=4.0)
    assert match.complete.all()
    assert not match.at_border.any()
    assert not match.rivalled.any()
    assert_allclose(match.shift_px, moved_px, rtol=0, atol=NOISELESS_PX)
    assert_allclose(match.gain_dn, 2000.0, rtol=0, atol=10.0)


def test_lines_that_bad_columns_cross_are_matched_by_what_is_left_of_them() -> None:
    points, normals = circle(90)
    pixels, usable = disk(radius_px=RADIUS_PX + 1.5), np.ones((SIZE, SIZE), dtype=bool)
    for column in (int(CENTER_PX[0]) - 12, int(CENTER_PX[0]) + 15):
        pixels[:, column], usable[:, column] = 5000.0, False
    scans = scan_lines(pixels, usable, points, normals, line_offsets(9.0, 0.5))
    match = match_profiles(scans, expected_of(scans), variance_dn2=DETECTOR.variance_dn2, window_px=5.0, search_px=4.0)
    crossed = ~scans.usable.all(axis=1)
    assert match.complete[~crossed].all()
    assert np.count_nonzero(match.complete & crossed) > 0.3 * np.count_nonzero(crossed)
    assert_allclose(match.shift_px[match.complete], 1.5, rtol=0, atol=NOISELESS_PX)
    assert match.correlation[match.complete].min() > CORRELATED


def test_the_scatter_of_shifts_is_the_stated_sigma() -> None:
    points, normals = circle(150)
    rng = np.random.default_rng(5)
    clean = disk(level_dn=400.0)
    shifts, sigmas = [], []
    for _ in range(4):
        scans = scans_of(rng.poisson(clean) + rng.normal(0.0, 5.0, clean.shape), points, normals)
        match = match_profiles(
            scans, expected_of(scans), variance_dn2=DETECTOR.variance_dn2, window_px=5.0, search_px=4.0
        )
        shifts.append(match.shift_px)
        sigmas.append(match.sigma_px)
    scatter = np.std(np.concatenate(shifts))
    stated = np.sqrt(np.mean(np.concatenate(sigmas) ** 2))
    assert abs(scatter / stated - 1.0) < SIGMA_RATIO, (scatter, stated)


def test_a_line_with_two_equal_edges_is_called_rivalled() -> None:
    points, normals = circle(40)
    y, x = np.mgrid[:SIZE, :SIZE]
    distance = np.hypot(x - CENTER_PX[0], y - CENTER_PX[1])
    rings = sum(ndtr((RADIUS_PX + off - distance) / 0.85) * sign for off, sign in ((3.5, 1), (0.0, -1), (-3.5, 1)))
    scans = scans_of(1000.0 * np.asarray(rings), points, normals)
    match = match_profiles(scans, expected_of(scans), variance_dn2=DETECTOR.variance_dn2, window_px=3.0, search_px=6.0)
    assert match.rivalled.all()


def test_freeing_the_slope_makes_no_difference_where_the_expected_brightness_holds() -> None:
    points, normals = circle(60)
    scans = scans_of(disk(), points, normals)
    expected = expected_of(scans)
    darker = expected * np.where(scans.offsets_px < 0, 1.0 + 0.08 * scans.offsets_px, 1.0)
    options = {"variance_dn2": DETECTOR.variance_dn2, "window_px": 5.0, "search_px": 4.0}
    right = match_profiles(scans, expected, **options)  # type: ignore[arg-type]
    wrong = match_profiles(scans, darker, **options)  # type: ignore[arg-type]
    assert np.abs(np.median(right.without_slope_px)) < NOISELESS_PX
    assert np.abs(np.median(wrong.without_slope_px)) > 5 * NOISELESS_PX
    assert np.abs(np.median(wrong.shift_px)) < np.abs(np.median(wrong.shift_px + wrong.without_slope_px))


def test_lines_that_are_too_short_for_window_and_search_are_refused() -> None:
    points, normals = circle(4)
    scans = scans_of(disk(), points, normals, reach_px=6.0)
    with pytest.raises(InputError, match="lines reach 6 px"):
        match_profiles(scans, expected_of(scans), variance_dn2=DETECTOR.variance_dn2, window_px=5.0, search_px=4.0)


def test_the_width_of_an_edge_is_measured() -> None:
    points, normals = circle(60)
    width = edge_width_px(
        scans_of(disk(), points, normals), variance_dn2=DETECTOR.variance_dn2, window_px=5.0, search_px=3.0
    )
    truth = np.sqrt(PSF_PX**2 + PIXEL_VARIANCE_PX2 + SAMPLING_VARIANCE_PX2)
    assert abs(width / truth - 1.0) < 0.08  # half the spacing of the widths that are tried


@pytest.mark.parametrize(("moved_px", "grown"), [((0.0, 0.0), 1.0), ((23.0, -31.0), 1.02), ((-38.0, 5.0), 0.975)])
def test_an_outline_is_found_far_from_its_prediction(moved_px: tuple[float, float], grown: float) -> None:
    radius = 80.0
    points, normals = circle(120, radius_px=radius)
    lit = normals[:, 0] > -0.3
    rng = np.random.default_rng(1)
    center = CENTER_PX + moved_px
    image = disk(center_px=center, radius_px=radius * grown, level_dn=300.0) + rng.normal(0.0, 5.0, (SIZE, SIZE))
    image *= np.indices(image.shape)[1] > center[0] - 0.35 * radius  # night on one side
    coarse = search_limb(
        view_of(image), limb_of(points[lit], normals[lit]), CENTER_PX, search_px=40.0, search_range=0.03
    )
    limb_error = normals[lit] @ (coarse.shift_px - moved_px) + radius * (coarse.scale - grown)
    assert np.abs(limb_error).max() < 2.0
    assert coarse.contrast > 0.8


def test_noise_has_no_outline() -> None:
    points, normals = circle(120, radius_px=80.0)
    image = np.random.default_rng(2).normal(0.0, 5.0, (SIZE, SIZE))
    coarse = search_limb(view_of(image), limb_of(points, normals), CENTER_PX, search_px=30.0, search_range=0.03)
    assert coarse.contrast < 0.2


# --- least squares on a limb ------------------------------------------------------------------------------------


def arc(count: int = 120) -> tuple[Float, Float]:
    """Points on an arc of 100 px and the design of center and radius."""
    angles = np.linspace(0.0, np.pi, count)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return 100.0 * normals, np.column_stack([normals, np.ones(count)])


def test_a_quarter_of_outliers_on_one_side_does_not_move_a_robust_solution() -> None:
    points, design = arc()
    rng = np.random.default_rng(3)
    truth = np.array([0.4, -0.2, 0.1])
    sigma = np.full(len(points), 0.02)
    residuals = design @ truth + rng.normal(0.0, sigma)
    outliers = rng.choice(len(points), len(points) // 4, replace=False)
    residuals[outliers] += rng.uniform(1.0, 4.0, outliers.size)
    solution, keep = robust_solution(residuals, design, sigma, outlier_mad=4.0)
    assert not keep[outliers].any()
    assert keep.sum() > 0.7 * len(points)
    assert_allclose(solution, truth, rtol=0, atol=0.02)  # 4 sigma of a half circle of 90 points


def test_fewer_residuals_than_parameters_are_refused() -> None:
    _, design = arc(3)
    with pytest.raises(InputError, match="more than 3 residuals"):
        robust_solution(np.zeros(3), design, np.ones(3), outlier_mad=4.0)


@pytest.mark.monte_carlo(few=60, full=4000)
def test_the_best_solution_is_never_worse_than_a_weighted_one_and_both_know_their_scatter(draws: int) -> None:
    points, design = arc(60)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    noise = 0.3**2 * np.exp(-apart / 20.0) + np.diag(np.linspace(0.05, 0.4, 60) ** 2)
    drawn = np.linalg.cholesky(noise) @ np.random.default_rng(4).normal(size=(60, draws))
    gains = [solution_gain(design, noise, weights=weights) for weights in (None, np.ones(60))]
    best, plain = (gain @ noise @ gain.T for gain in gains)
    assert np.linalg.eigvalsh(plain - best).min() > -1e-12
    for gain, stated in zip(gains, (best, plain), strict=True):
        low, high = mean_square_band(draws - 1, 1e-4)
        assert np.all(np.diag(np.cov(gain @ drawn)) / np.diag(stated) > low)
        assert np.all(np.diag(np.cov(gain @ drawn)) / np.diag(stated) < high)


def test_points_that_no_lens_shows_are_on_no_line_and_no_pixel() -> None:
    """Beyond where a distortion folds over there is no place in the image; the cast of such a place was undefined."""
    points, normals = circle(8)
    points[3], normals[5] = np.nan, np.nan
    offsets = line_offsets(5.0, 0.5)
    scans = scan_lines(disk(), np.ones((SIZE, SIZE), dtype=bool), points, normals, offsets)
    assert not scans.usable[[3, 5]].any()
    assert scans.usable[[0, 1, 2, 4, 6, 7]].all()
    seen = np.delete(np.arange(8), [3, 5])
    known = pixels_near(points[seen], normals[seen], offsets, (SIZE, SIZE))
    np.testing.assert_array_equal(pixels_near(points, normals, offsets, (SIZE, SIZE)), known)
