"""Limb matching on bodies rendered with other rays than the templates, on what it must refuse, and on real images."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float, unit
from giantlike.core.causes import Cause
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, PositionFix, Quality, Reason
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.io.image_files import read_image_file
from giantlike.processing.limb.measurement import limb_design
from giantlike.ray_tracing import Body, Lambert, McEwen, Reflectance, trace_silhouette
from giantlike.relative import ESTIMATORS, Estimator
from giantlike.relative.horizon.geometry import Figure, horizon_residuals
from giantlike.relative.inputs import gather
from giantlike.relative.limb.fix import limb_view
from giantlike.relative.limb.limb_matching import LimbMatching, LimbMatchingOptions
from giantlike.relative.limb.line_scan import LineScan, Outline, lay_lines
from giantlike.relative.limb.profiles import LimbScanOptions
from giantlike.scene import Scene, Target
from giantlike.shapes import Ellipsoid, TriangleMesh, irregular_body, load_shape, sphere
from tests.limb_images import CAMERA, NEES_LIMIT, BodyImage, assert_sound, body_image, mean_nees_band
from tests.numerical import numerical_jacobian
from tests.sizes import slow
from tests.tolerances import FLOAT64, FLOAT64_SUM

SIGMA_PX, SIGMA_RANGE = 0.1, 1e-3  # three times what is usual at a radius of 80 px and up to 100 degrees of phase
CRESCENT_PX, CRESCENT_RANGE = 0.15, 1.8e-3  # the same at 120 degrees: less limb, and less light on it
TYPICAL_PX, TYPICAL_RANGE = 0.035, 3.5e-4  # median over all phase angles: twice what is usual
OFF = {"off_px": (7.0, -8.0), "range_error": 0.015}
JACOBIAN_PX = 1e-6  # of steps of 0.025 px: what central differences leave
VESTA_PX = 6.0  # "a few pixels": the mesh is coarse, and the pose itself is a fit to it
VESTA_RANGE = 0.005
VESTA_SIGMAS = 3.0  # of the turn, of 0.1 to 0.2 deg: the pose is a fit to the same images
NEAR_LIMB_PX = 1.0  # nine of ten points; a terminator lies tens of pixels away
PHASES_DEG = (20.0, 40.0, 60.0, 80.0, 100.0, 120.0)


@cache
def body(seed: int = 1) -> TriangleMesh:
    return irregular_body(seed, facets=20_000)


def fixed(case: BodyImage, options: LimbMatchingOptions | None = None, *, image: Image | None = None) -> PositionFix:
    result = LimbMatching(options).estimate(image or case.image, case.camera, case.scene)
    assert isinstance(result, PositionFix), result
    return result


def refused(case: BodyImage, *, image: Image | None = None, options: LimbMatchingOptions | None = None) -> Failure:
    result = LimbMatching(options).estimate(image or case.image, case.camera, case.scene)
    assert isinstance(result, Failure), result
    return result


def repainted(case: BodyImage, pixels: Float) -> Image:
    return replace(case.image, pixels=np.clip(np.rint(pixels), 0, 65535).astype(np.uint16))


BODIES = pytest.mark.parametrize("seeds", [(1,), slow((1, 2))], ids=["one", "two"])


@cache
def fixes(seeds: tuple[int, ...]) -> tuple[tuple[BodyImage, PositionFix], ...]:
    """Bodies at each phase angle, predicted 10 px and 1.5 % of range off."""
    cases = [body_image(body(seed), 10 * seed + i, phase_deg=p) for seed in seeds for i, p in enumerate(PHASES_DEG)]
    found = []
    for i, case in enumerate(cases):
        sign = (-1) ** i
        prediction = case.believed(off_px=(7.0 * sign, -8.0), range_error=0.015 * sign)
        found.append((prediction, fixed(prediction)))
    return tuple(found)


def geometry_body(case: BodyImage) -> Body:
    """The body where it truly is."""
    geometry = case.target.ephemeris
    assert isinstance(geometry, ApparentGeometry)
    return Body(
        shape=case.target.shape,
        camera_from_body=geometry.inertial_from_body,
        position_camera_km=case.position_camera_km,
        reflectance=case.target.reflectance,
    )


# --- accuracy ---------------------------------------------------------------------------------------------------


@BODIES
def test_the_position_is_found_at_all_phase_angles(seeds: tuple[int, ...]) -> None:
    for (case, fix), phase_deg in zip(fixes(seeds), len(seeds) * PHASES_DEG, strict=True):
        crescent = phase_deg > 110.0
        assert_sound(
            case,
            fix,
            sigma_px=CRESCENT_PX if crescent else SIGMA_PX,
            sigma_range=CRESCENT_RANGE if crescent else SIGMA_RANGE,
        )


@BODIES
def test_covariances_are_as_small_as_an_image_allows_and_errors_as_large_as_they_say(seeds: tuple[int, ...]) -> None:
    sigma_px = [np.sqrt(np.linalg.eigvalsh(fix.covariance_px2)[-1]) for _, fix in fixes(seeds)]
    sigma_range = [fix.sigma_range_km / fix.range_km for _, fix in fixes(seeds)]
    assert np.median(sigma_px) < TYPICAL_PX
    assert np.median(sigma_range) < TYPICAL_RANGE
    nees = [case.nees(fix) for case, fix in fixes(seeds)]
    low, high = mean_nees_band(len(nees))
    assert low < np.mean(nees) < high, nees


def test_a_fix_is_complete_and_its_parts_agree() -> None:
    case, fix = fixes((1,))[2]
    model = case.camera.model
    assert fix.estimator == "limb_matching"
    assert fix.target == "BODY"
    assert_allclose(fix.center_px, model.project(fix.position_camera_km), rtol=0, atol=FLOAT64_SUM)
    jacobian = model.project_jacobian(fix.position_camera_km)
    assert_allclose(fix.covariance_px2, jacobian @ fix.covariance_camera_km2 @ jacobian.T, rtol=0, atol=FLOAT64)
    assert fix.residuals.shape == (fix.n_used,)
    assert fix.limb_px.shape == (fix.n_used, 2)
    assert np.array_equal(fix.residuals_at_px, fix.measured_limb_px)
    assert fix.limb_rejected_px.shape == (fix.n_rejected, 2)
    assert np.isfinite(fix.limb_rejected_px).all()
    assert_allclose(fix.score, np.sqrt(np.mean(fix.residuals**2)), rtol=0, atol=FLOAT64)
    assert fix.score < 0.15
    assert fix.flags is Quality.APRIORI_ATTITUDE
    assert {"giantlike", "shape_sha256", "options", "reflectance"} <= set(fix.provenance)
    assert np.all(np.abs(fix.predicted_px - fix.center_px) > 5.0)


def test_the_same_image_gives_the_same_fix() -> None:
    case, fix = fixes((1,))[3]
    again = fixed(case)
    assert again.position_camera_km.tolist() == fix.position_camera_km.tolist()
    assert again.covariance_camera_km2.tolist() == fix.covariance_camera_km2.tolist()


@pytest.mark.parametrize(("off_px", "range_error"), [((39.0, -30.0), 0.029), slow((-36.0, 38.0), -0.029)])
def test_the_body_is_found_almost_forty_pixels_and_three_percent_from_its_prediction(
    off_px: tuple[float, float], range_error: float
) -> None:
    case = body_image(body(), 30, phase_deg=70.0).believed(off_px=off_px, range_error=range_error)
    fix = fixed(case)
    assert_sound(case, fix, sigma_px=SIGMA_PX, sigma_range=SIGMA_RANGE)
    assert Quality.FAR_FROM_PREDICTION not in fix.flags


def test_a_small_body_is_found_with_a_larger_covariance() -> None:
    case = body_image(body(), 31, phase_deg=50.0, radius_px=14.0).believed(off_px=(5.0, 5.0), range_error=-0.01)
    fix = fixed(case)
    assert_sound(case, fix, sigma_px=0.12, sigma_range=6e-3)
    assert fix.sigma_range_km / fix.range_km > TYPICAL_RANGE


def test_a_body_of_a_few_pixels_is_left_to_other_estimators_unless_asked_for() -> None:
    case = body_image(body(), 31, phase_deg=50.0, radius_px=11.0)
    failure = refused(case)
    assert failure.reason is Reason.NO_LIMB
    assert re.search(r"the body is 2[12]\.\d px across, min_diameter_px is 25: use cross_correlation", failure.detail)


def test_a_wrong_reflectance_law_is_found_out_and_within_the_covariance() -> None:
    """Taken as it is, Lambert's law put this limb 0.3 px off."""
    case = body_image(body(), 32, phase_deg=40.0).believed(**OFF)  # type: ignore[arg-type]
    wrong = replace(case, target=replace(case.target, reflectance=Lambert()))
    fix = fixed(wrong)
    assert_sound(wrong, fix, sigma_px=SIGMA_PX, sigma_range=2.0 * SIGMA_RANGE)
    assert Cause.REFLECTANCE in fix.parts


def test_an_ellipsoid_is_a_body_like_any_other() -> None:
    shape = Ellipsoid(radii_km=np.array([0.3, 0.25, 0.2]))
    case = body_image(shape, 33, phase_deg=65.0).believed(**OFF)  # type: ignore[arg-type]
    fix = fixed(case)
    assert_sound(case, fix, sigma_px=SIGMA_PX, sigma_range=SIGMA_RANGE)


def test_an_unknown_point_spread_function_is_measured_on_the_limb() -> None:
    case = body_image(body(), 34, phase_deg=60.0).believed(**OFF)  # type: ignore[arg-type]
    blind = replace(case, camera=replace(case.camera, psf=None))
    fix = fixed(blind)
    assert_sound(case, fix, sigma_px=1.5 * SIGMA_PX, sigma_range=2.0 * SIGMA_RANGE)


def test_a_body_cut_by_the_frame_is_found_and_flagged() -> None:
    for seed in range(35, 45):
        case = body_image(body(), seed, phase_deg=30.0, center_px=(20.0, 190.0)).believed(off_px=(5.0, -6.0))
        fix = LimbMatching().estimate(case.image, case.camera, case.scene)
        if isinstance(fix, PositionFix):
            break
    assert isinstance(fix, PositionFix)
    assert Quality.CUT_BY_FRAME in fix.flags
    assert_sound(case, fix, sigma_px=0.3, sigma_range=3e-3)


def test_bad_and_saturated_pixels_on_the_limb_cost_lines_and_not_accuracy() -> None:
    case = body_image(body(), 36, phase_deg=50.0).believed(**OFF)  # type: ignore[arg-type]
    clean = fixed(case)
    mask = np.zeros(case.image.pixels.shape, dtype=bool)
    x, y = np.rint(clean.limb_px[:: max(clean.n_used // 8, 1)]).astype(int).T
    mask[y, x] = True
    pixels = case.image.pixels.copy()
    pixels[mask] = 0
    fix = fixed(case, image=replace(case.image, pixels=pixels, mask=mask))
    assert Quality.MASKED in fix.flags
    assert fix.n_used < clean.n_used
    assert_sound(case, fix, sigma_px=SIGMA_PX, sigma_range=SIGMA_RANGE)
    pixels[mask] = int(CAMERA.detector.saturation_dn)
    saturated = fixed(case, image=replace(case.image, pixels=pixels))
    assert Quality.SATURATED in saturated.flags
    assert_sound(case, saturated, sigma_px=SIGMA_PX, sigma_range=SIGMA_RANGE)


@pytest.mark.slow
def test_stars_beside_the_limb_do_not_pull_it() -> None:
    case = body_image(body(), 37, phase_deg=50.0).believed(**OFF)  # type: ignore[arg-type]
    clean = fixed(case)
    outward = unit(clean.limb_px - clean.center_px)
    y, x = np.indices(case.image.pixels.shape)
    pixels = case.image.pixels.astype(np.float64)
    for place in (clean.limb_px + 3.0 * outward)[:: max(clean.n_used // 10, 1)]:
        pixels += 1500.0 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * 0.8**2))
    fix = fixed(case, image=repainted(case, pixels))
    assert fix.n_rejected > clean.n_rejected
    assert_sound(case, fix, sigma_px=1.5 * SIGMA_PX, sigma_range=2.0 * SIGMA_RANGE)


@pytest.mark.parametrize(
    ("phase_deg", "law"), [(0.0, McEwen()), slow(0.0, Lambert()), slow(0.7, McEwen()), (0.7, Lambert())]
)
def test_the_whole_limb_is_used_at_opposition(phase_deg: float, law: Reflectance) -> None:
    """The cosine of the incidence angle vanishes all around the limb there; the limb is bright all the same."""
    case = body_image(body(), 47, phase_deg=phase_deg, law=law, radius_px=50.0).believed(**OFF)  # type: ignore[arg-type]
    inputs = gather(case.image, case.camera, case.scene, None, estimator="test", options=None)
    assert not isinstance(inputs, Failure)
    view = limb_view(inputs, 0.0)
    outline = Outline.from_body(view, inputs.geometry.body())
    lines = lay_lines(view, outline, max_lines=300, spacing_px=1.5, margin_px=0.0)
    assert lines is not None
    assert lines.angles_rad.size * lines.spacing_px > 0.97 * lines.perimeter_px
    fix = fixed(case)
    assert fix.n_used > 0.9 * lines.angles_rad.size
    assert_sound(case, fix, sigma_px=SIGMA_PX, sigma_range=SIGMA_RANGE)


@pytest.mark.parametrize("phase_deg", [slow(100.0), 130.0])
def test_points_lie_on_lit_limb_and_never_on_the_terminator_of_a_concave_body(phase_deg: float) -> None:
    shape = irregular_body(5, facets=20_000, relief=0.12)
    case = body_image(shape, 60, phase_deg=phase_deg).believed(off_px=(6.0, -5.0), range_error=0.01)
    fix = fixed(case)
    geometry = case.target.ephemeris
    assert isinstance(geometry, ApparentGeometry)
    sun = geometry.sun_direction_inertial
    assert sun is not None
    arms = fix.limb_px - case.center_px
    truth = geometry_body(case)
    limb = trace_silhouette(truth, CAMERA.model, np.arctan2(arms[:, 1], arms[:, 0]), sun_direction_camera=sun)
    off_px = np.einsum("ni,ni->n", fix.limb_px - limb.points_px, limb.normals_px)
    assert np.quantile(np.abs(off_px), 0.9) < NEAR_LIMB_PX
    inside = np.rint(fix.limb_px - 2.5 * limb.normals_px).astype(int)
    light = case.image.pixels[inside[:, 1], inside[:, 0]] - CAMERA.detector.bias_dn
    assert np.mean(light > 20.0) > 0.95  # four times the noise of the dark
    assert_sound(case, fix, sigma_px=2.0 * CRESCENT_PX, sigma_range=2.0 * CRESCENT_RANGE)


def test_a_disk_larger_than_the_frame_is_found_from_the_limb_that_remains() -> None:
    case = body_image(body(), 61, phase_deg=40.0, radius_px=300.0, center_px=(-20.0, 180.0))
    case = case.believed(off_px=(6.0, -7.0), range_error=0.01)
    result = LimbMatching().estimate(case.image, case.camera, case.scene)
    if isinstance(result, Failure):  # this side of the body is dark
        case = body_image(body(), 61, phase_deg=40.0, radius_px=300.0, center_px=(420.0, 180.0))
        result = LimbMatching().estimate(case.image, case.camera, case.scene)
    assert isinstance(result, PositionFix), result
    assert Quality.CUT_BY_FRAME in result.flags
    assert_sound(case, result, sigma_px=1.0, sigma_range=5e-3)


@pytest.mark.slow
def test_a_limb_that_only_touches_a_corner_is_refused_or_told_to_be_short() -> None:
    for seed in (62, 63):
        case = body_image(body(), seed, phase_deg=30.0, radius_px=300.0, center_px=(-100.0, -100.0))
        result = LimbMatching().estimate(case.image, case.camera, case.scene)
        if isinstance(result, Failure):
            assert result.reason in (Reason.NO_LIMB, Reason.NOT_LIT, Reason.DEGENERATE_GEOMETRY, Reason.OUT_OF_FRAME)
        else:
            assert Quality.SHORT_ARC in result.flags
            assert case.nees(result) < NEES_LIMIT


def test_a_ring_before_the_limb_is_not_taken_for_it() -> None:
    case = body_image(body(), 67, phase_deg=50.0).believed(**OFF)  # type: ignore[arg-type]
    y, x = np.indices(case.image.pixels.shape) - case.center_px[::-1, None, None]
    pixels = case.image.pixels.astype(np.float64)
    for radius in (1.25, 1.6):
        distance = 80.0 * np.hypot(x / 80.0, y / 22.0) - 80.0 * radius
        pixels += 1200.0 * np.exp(-0.5 * (distance / 4.0) ** 2)
    fix = fixed(case, image=repainted(case, pixels))
    assert_sound(case, fix, sigma_px=2.0 * SIGMA_PX, sigma_range=2.0 * SIGMA_RANGE)


@pytest.mark.slow
def test_a_second_body_before_the_limb_is_not_taken_for_it() -> None:
    case = body_image(body(), 68, phase_deg=40.0).believed(**OFF)  # type: ignore[arg-type]
    clean = fixed(case)
    place = clean.limb_px[clean.n_used // 2]
    y, x = np.indices(case.image.pixels.shape)
    moon = np.hypot(x - place[0], y - place[1]) < 14.0
    pixels = np.where(moon, 2200.0 + CAMERA.detector.bias_dn, case.image.pixels.astype(np.float64))
    fix = fixed(case, image=repainted(case, pixels))
    assert fix.n_rejected > clean.n_rejected
    assert np.linalg.norm(fix.limb_px - place, axis=1).min() > 8.0
    assert_sound(case, fix, sigma_px=2.0 * SIGMA_PX, sigma_range=2.0 * SIGMA_RANGE)


# --- what it must refuse ----------------------------------------------------------------------------------------


def test_an_empty_sky_has_no_limb() -> None:
    case = body_image(body(), 40, phase_deg=60.0)
    noise = np.random.default_rng(0).normal(100.0, 5.0, case.image.pixels.shape)
    failure = refused(case, image=repainted(case, noise))
    assert failure.reason is Reason.NO_LIMB
    assert "contrast" in failure.detail


def test_a_body_behind_the_light_is_not_lit() -> None:
    case = body_image(body(), 41, phase_deg=60.0)
    geometry = case.target.ephemeris
    assert isinstance(geometry, ApparentGeometry)
    dark = replace(geometry, sun_direction_inertial=unit(case.position_camera_km))
    failure = refused(replace(case, target=replace(case.target, ephemeris=dark)))
    assert failure.reason is Reason.NOT_LIT


def test_an_overexposed_body_is_called_saturated_and_found() -> None:
    """Fifteen times too bright: the limb lies half a pixel or more inside the edge of what is clipped."""
    case = body_image(body(), 42, phase_deg=30.0, peak_dn=60_000.0)
    fix = fixed(case)
    assert Quality.SATURATED in fix.flags
    assert_sound(case, fix, sigma_px=1.0, sigma_range=1e-2)


@pytest.mark.slow
def test_a_surface_that_fills_the_frame_is_refused_as_such() -> None:
    case = body_image(body(), 43, phase_deg=30.0, radius_px=700.0)
    failure = refused(case)
    assert failure.reason is Reason.NO_LIMB
    assert "the surface fills the frame" in failure.detail
    assert "400 x 400" in failure.detail


@pytest.mark.slow
@pytest.mark.parametrize(("radius_px", "seed"), [(320.0, 3), (340.0, 3), (340.0, 5)])
def test_a_terminator_is_no_limb_where_the_surface_fills_the_frame(radius_px: float, seed: int) -> None:
    """The search that widens by itself led 60 to 100 px away, to a position that was suspect and no more."""
    failure = refused(body_image(body(seed), 43, phase_deg=90.0, radius_px=radius_px))
    assert failure.reason is Reason.NO_LIMB
    assert "beyond the search" in failure.detail


def test_an_outline_that_fits_best_at_the_border_of_the_widest_search_is_no_limb() -> None:
    """Light that fades over 200 px, told to be a body of 600 px: the search ran along it to its end."""
    case = body_image(body(), 43, phase_deg=60.0)
    near = case.believed(range_error=80.0 / 300.0 - 1.0)
    away = -unit(np.array([-0.74, -0.45]))  # from the Sun, in the image
    rows, columns = np.mgrid[:400, :400] - 200.0
    light = 3000.0 * np.clip((away[0] * columns + away[1] * rows + 120.0) / 200.0, 0.0, 1.0)
    rng = np.random.default_rng(0)
    failure = refused(near, image=repainted(near, rng.poisson(light) + rng.normal(100.0, 5.0, light.shape)))
    assert failure.reason is Reason.NO_LIMB
    assert "at the border" in failure.detail


def test_another_body_than_the_one_in_the_image_is_not_believed() -> None:
    case = body_image(body(), 44, phase_deg=60.0)
    other = replace(case, target=replace(case.target, shape=irregular_body(9, facets=20_000, relief=0.12)))
    result = LimbMatching().estimate(other.image, other.camera, other.scene)
    assert isinstance(result, Failure) or result.flags.suspect, result
    if isinstance(result, Failure):
        assert result.reason in (Reason.LARGE_RESIDUALS, Reason.NO_LIMB, Reason.NOT_CONVERGED)


def test_too_few_iterations_are_a_failure_with_the_last_motion() -> None:
    case = body_image(body(), 45, phase_deg=60.0).believed(**OFF)  # type: ignore[arg-type]
    failure = refused(case, options=LimbMatchingOptions(max_iterations=1))
    assert failure.reason is Reason.NOT_CONVERGED
    assert "px after 1 iterations" in failure.detail


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"search_px": 0.0}, "search_px"),
        ({"search_range": 0.5}, "search_range"),
        ({"max_iterations": 0}, "max_iterations"),
        ({"outlier_mad": float("nan")}, "outlier_mad"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        LimbMatchingOptions(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize("options", [{"step_px": 2.0}, {"min_lines": 2}, {"max_lines": 5}, {"min_contrast": 1.5}])
def test_scan_options_out_of_range_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(options))):
        LimbScanOptions(**options)  # type: ignore[arg-type]


def test_the_estimator_is_registered_under_its_name() -> None:
    estimator = ESTIMATORS["limb_matching"]()
    assert isinstance(estimator, LimbMatching)
    assert isinstance(estimator, Estimator)


# --- the pieces -------------------------------------------------------------------------------------------------


def test_the_limb_moves_with_the_body_as_the_design_says() -> None:
    shape = Ellipsoid(radii_km=np.array([0.3, 0.25, 0.2]))
    case = body_image(shape, 50, phase_deg=60.0, center_px=(120.0, 280.0))
    geometry = case.target.ephemeris
    assert isinstance(geometry, ApparentGeometry)
    sun = geometry.sun_direction_inertial
    assert sun is not None
    inputs = gather(case.image, case.camera, case.scene, None, estimator="test", options=None)
    assert not isinstance(inputs, Failure)
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    limb = trace_silhouette(inputs.geometry.body(), case.camera.model, angles, sun_direction_camera=sun)
    design = limb_design(limb.normals_px, case.camera.model.project_jacobian(limb.points_camera_km))
    figure = Figure(radii_km=shape.radii_km, camera_from_axes=geometry.inertial_from_body)

    def inside_px(position_km: Float) -> Float:
        return -horizon_residuals(limb.points_px, case.camera.model, figure, position_km)[0]

    step_km = 1e-5 * float(np.linalg.norm(case.position_camera_km))
    numerical = numerical_jacobian(inside_px, case.position_camera_km, step_km)
    assert_allclose(design * step_km, numerical * step_km, rtol=0, atol=JACOBIAN_PX)


def test_the_limb_of_a_mesh_moves_with_it_as_the_design_says() -> None:
    case = body_image(body(), 51, phase_deg=60.0)
    inputs = gather(case.image, case.camera, case.scene, None, estimator="test", options=None)
    assert not isinstance(inputs, Failure)
    view, options, shape = limb_view(inputs, 0.0), LimbMatchingOptions(), inputs.geometry.body()
    measured = []
    for shift_px in (0.0, 0.5):
        position = case.believed(off_px=(shift_px, 0.0)).scene.geometry(case.image)
        assert not isinstance(position, Failure)
        placed = shape.at(position.position_camera_km)
        lines = lay_lines(view, Outline.from_body(view, placed), max_lines=400, spacing_px=1.5, margin_px=7.0)
        assert lines is not None
        scan = LineScan(view=view, body=shape, lines=lines, search=options, options=options.scan)
        limb = scan.measure_at(placed.position_camera_km)
        assert not isinstance(limb, Failure)
        measured.append(limb)
    here, there = measured
    predicted = there.design @ (here.position_camera_km - there.position_camera_km)
    assert abs(np.median(here.shift_px)) < 0.02
    assert np.median(np.abs(there.shift_px - predicted)) < 0.06  # the same points, with rays through other places


# --- real images ------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.real_data
@pytest.mark.parametrize("name", [slow("00000000.png"), "00000002.png"])
def test_vesta_is_found_from_the_limb_in_two_corners(data_dir: Path, name: str) -> None:
    poses = json.loads((data_dir / "bodies" / "dawn_vesta" / "poses.json").read_text())
    numbers, pose = poses["camera"], poses["images"][name]
    camera = Camera(
        name="FC2",
        columns=numbers["columns"],
        rows=numbers["rows"],
        model=PinholeModel(**{key: numbers[key] for key in ("fx_px", "fy_px", "cx_px", "cy_px")}),
        psf=GaussianPsf(sigma_px=0.8),
        detector=Detector(read_noise_e=1.0, saturation_dn=255.0),
    )
    camera_from_body = Rotation.from_quat(pose["q_wxyz_camera_from_body"], scalar_first=True)
    position = np.array(pose["t_body_in_camera_km"])
    geometry = ApparentGeometry(
        position_inertial_km=position + np.array([12.0, -9.0, 0.0]) * position[2] / numbers["fx_px"],
        inertial_from_body=camera_from_body,
        sun_direction_inertial=rotate(camera_from_body, unit(np.array(pose["sun_body"]))),
    )
    shape = load_shape(data_dir / "shapes" / "vesta_5002.ply")
    image = replace(Image.open(data_dir / "bodies" / "dawn_vesta" / name), camera_from_inertial=Rotation.identity())
    fix = LimbMatching().estimate(
        image, camera, Scene(targets=(Target(name="VESTA", shape=shape, ephemeris=geometry),))
    )
    assert isinstance(fix, PositionFix), fix
    assert np.abs(fix.center_px - camera.model.project(position)).max() < VESTA_PX
    assert abs(fix.range_km / np.linalg.norm(position) - 1.0) < VESTA_RANGE
    assert Quality.CUT_BY_FRAME in fix.flags
    assert Quality.SHORT_ARC in fix.flags
    assert np.sqrt(np.diag(fix.covariance_px2)).max() > 0.3  # two short arcs do not give a hundredth of a pixel
    assert fix.turn is not None
    assert abs(fix.turn.turn_rad) < VESTA_SIGMAS * np.sqrt(fix.turn.covariance[2, 2])


@pytest.mark.real_data
def test_europa_is_found_from_an_arc_of_limb_in_a_corner_of_the_frame(data_dir: Path) -> None:
    """Off by 10 px and 1 % of range; the pointing behind the center of the label is good to some pixels."""
    image = Image.open(data_dir / "bodies" / "galileo_ssi" / "4600R.IMG").with_attitude(Rotation.identity())
    label = {
        key: float(image.metadata[key])
        for key in ("TARGET_CENTER_DISTANCE", "SUB_SPACECRAFT_LINE", "SUB_SPACECRAFT_SAMPLE", "SUNAZ", "PHA")
    }
    focal_px = 1500.467 / 0.03048
    camera = Camera(
        name="SSI",
        columns=800,
        rows=800,
        model=PinholeModel(fx_px=focal_px, fy_px=focal_px, cx_px=399.5, cy_px=399.5),
        psf=GaussianPsf(sigma_px=0.8),
        detector=Detector(gain_e_per_dn=50.0, read_noise_e=50.0, saturation_dn=255.0),
    )
    center = np.array([label["SUB_SPACECRAFT_SAMPLE"], label["SUB_SPACECRAFT_LINE"]]) - 1.0
    sight, azimuth, phase = camera.model.unproject(center), np.radians(label["SUNAZ"]), np.radians(label["PHA"])
    across = unit(np.cross(np.cross(sight, [np.cos(azimuth), np.sin(azimuth), 0.0]), sight))
    geometry = ApparentGeometry(
        position_inertial_km=1.01
        * label["TARGET_CENTER_DISTANCE"]
        * camera.model.unproject(center + np.array([7.0, -7.0])),
        inertial_from_body=Rotation.identity(),
        sun_direction_inertial=np.sin(phase) * across - np.cos(phase) * sight,
    )
    scene = Scene(targets=(Target(name="EUROPA", shape=sphere(1560.8), ephemeris=geometry),))
    fix = LimbMatching().estimate(image, camera, scene)
    assert isinstance(fix, PositionFix), fix
    assert {Quality.CUT_BY_FRAME, Quality.SHORT_ARC} <= set(fix.flags)
    assert fix.score < 0.3
    error_px = fix.center_px - center
    slack = 5.0**2 * np.eye(2)  # pointing behind the label
    assert error_px @ np.linalg.solve(fix.covariance_px2 + slack, error_px) < NEES_LIMIT
    assert abs(fix.range_km / label["TARGET_CENTER_DISTANCE"] - 1.0) < 4.0 * fix.sigma_range_km / fix.range_km
    assert np.all(fix.limb_px < 400.0)


@pytest.mark.real_data
@pytest.mark.parametrize("name", ["m0154651923f6_2p_cif_gbl.fit", "m0157063318f4_2p_iof_gbl.fit"])
def test_eros_that_fills_the_frame_is_refused(data_dir: Path, name: str) -> None:
    path = data_dir / "bodies" / "near_msi" / name
    header = read_image_file(path).header
    number = {key: float(header[f"NEAR-{key:03d}"]) for key in (19, 20, 21, 22, 23, 24, 25, 27, 28, 29)}
    msi_from_near = Rotation.from_matrix([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
    near_from_inertial = Rotation.from_quat([number[key] for key in (19, 20, 21, 22)], scalar_first=True)
    spacecraft, eros = np.array([number[k] for k in (23, 24, 25)]), np.array([number[k] for k in (27, 28, 29)])
    focal = 1.0 / 95.9e-6
    camera = Camera(
        name="MSI",
        columns=537,
        rows=412,
        model=PinholeModel(fx_px=focal, fy_px=focal, cx_px=268.0, cy_px=205.5),
        psf=GaussianPsf(sigma_px=0.8),
    )
    geometry = ApparentGeometry(position_inertial_km=eros - spacecraft, sun_direction_inertial=unit(-eros))
    image = Image.open(path).with_attitude(msi_from_near * near_from_inertial)
    shape = load_shape(data_dir / "shapes" / "eros007790.tab")
    failure = LimbMatching().estimate(
        image, camera, Scene(targets=(Target(name="EROS", shape=shape, ephemeris=geometry),))
    )
    assert isinstance(failure, Failure)
    assert failure.reason is Reason.NO_LIMB
    assert "537 x 412" in failure.detail
