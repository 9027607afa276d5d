"""Center of brightness of resolved bodies: the correction, several bodies, what it says of its errors, refusals."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.detector import GaussianPsf
from giantlike.core.errors import InputError
from giantlike.core.outcomes import CenterFix, Failure, Quality, Reason
from giantlike.ephemeris import ApparentGeometry
from giantlike.gauntlet import stage_of
from giantlike.image import Image
from giantlike.ray_tracing import Body, Lambert, LommelSeeliger, McEwen, Reflectance, RenderOptions, Template, render
from giantlike.relative.light.moment import Moment, MomentOptions
from giantlike.relative.verification import checks
from giantlike.scene import Scene, Target
from giantlike.shapes import Shape, irregular_body, sphere
from tests.limb_images import BodyImage, body_image
from tests.sizes import slow
from tests.tolerances import RARE

REQUIRED = 0.03  # of the radius
WITHIN_3_SIGMA = 9.0
ROCK = irregular_body(4, facets=4_000)
LAWS = (McEwen(), LommelSeeliger(), Lambert())


def found(case: BodyImage, options: MomentOptions | None = None) -> CenterFix:
    fix = Moment(options).estimate(case.image, case.camera, case.scene)
    assert isinstance(fix, CenterFix), fix
    return fix


def nees(error: Float, fix: CenterFix) -> float:
    return float(error @ np.linalg.solve(fix.covariance_px2, error))


@cache
def told_wrong(seed: int) -> BodyImage:
    """A body under one of three laws, told to be McEwen's, at 0 to 100 degrees; center and range off."""
    rng = np.random.default_rng(seed)
    case = body_image(ROCK, seed, phase_deg=100.0 * rng.uniform(), radius_px=30.0, law=LAWS[seed % 3])
    case = replace(case, target=replace(case.target, reflectance=McEwen()))
    off = (float(rng.uniform(-12, 12)), float(rng.uniform(-12, 12)))
    return case.believed(off_px=off, range_error=float(rng.normal(0.0, 0.02)))


@pytest.mark.parametrize("phase_deg", [0.5, 35.0, 70.0, 100.0])
@pytest.mark.parametrize("radius_px", [10.0, slow(80.0)])
def test_the_center_is_right_to_three_percent_of_the_radius(phase_deg: float, radius_px: float) -> None:
    case = body_image(ROCK, 7, phase_deg=phase_deg, radius_px=radius_px)
    fix = found(case.believed(off_px=(9.0, -6.0), range_error=0.015))
    assert np.linalg.norm(fix.center_px - case.center_px) < REQUIRED * radius_px
    assert nees(fix.center_px - case.center_px, fix) < float(chi2.ppf(1.0 - RARE, 2))
    assert not fix.flags.suspect


@pytest.mark.monte_carlo(few=6, full=24)
def test_errors_with_wrong_laws_and_ranges_are_within_the_stated_covariance(draws: int) -> None:
    cases = [told_wrong(seed) for seed in range(draws)]
    fixes = [found(case) for case in cases]
    values = [nees(fix.center_px - case.center_px, fix) for case, fix in zip(cases, fixes, strict=True)]
    # the law is a stated systematic: an upper bound, and no claim that it is always off
    assert np.mean(values) < float(chi2.ppf(1.0 - RARE, 2 * len(values))) / len(values)
    assert np.mean(values) > 0.1
    sigma = [float(np.sqrt(np.linalg.eigvalsh(fix.covariance_px2)[-1])) for fix in fixes]
    assert np.median(sigma) < 2.0 * REQUIRED * 30.0


def test_residuals_are_those_of_the_bright_pixels_and_say_where_they_are() -> None:
    case = body_image(ROCK, 7, phase_deg=35.0, radius_px=20.0)
    fix = found(case)
    columns, rows = np.rint(fix.residuals_at_px).astype(int).T
    assert fix.residuals_at_px.shape == (fix.n_used, 2)
    brightest = np.unravel_index(np.argmax(case.image.pixels), case.image.pixels.shape)
    assert brightest in set(zip(rows.tolist(), columns.tolist(), strict=True))
    others = np.delete(case.image.pixels, np.ravel_multi_index((rows, columns), case.image.pixels.shape))
    assert np.median(case.image.pixels[rows, columns]) > np.quantile(others, 0.99)


@pytest.mark.monte_carlo(few=6, full=16)
def test_noise_alone_is_within_the_covariance(draws: int) -> None:
    """A sphere at zero phase needs no correction, so that nothing but noise is left."""
    errors: list[float] = []
    for noise in range(draws):
        case = body_image(sphere(1.0), 3, phase_deg=0.01, radius_px=12.0, peak_dn=120.0, noise_seed=noise)
        fix = found(case)
        errors.append(nees(fix.center_px - case.center_px, fix))
    assert np.mean(errors) < float(chi2.ppf(1.0 - RARE, 2 * draws)) / draws


def test_the_published_correction_is_an_approximation_and_none_is_the_center_of_light() -> None:
    case = body_image(sphere(1.0), 5, phase_deg=60.0, law=Lambert())
    geometry = case.target.ephemeris
    assert isinstance(geometry, ApparentGeometry)
    assert geometry.sun_direction_inertial is not None
    to_sun = geometry.sun_direction_inertial[:2] / np.linalg.norm(geometry.sun_direction_inertial[:2])
    light = found(case, MomentOptions(correction="none"))
    published = found(case, MomentOptions(correction="kaasalainen_tanga"))
    rendered = found(case)
    toward = [float((fix.center_px - case.center_px) @ to_sun) for fix in (light, published, rendered)]
    assert toward[0] > 0.2 * 80.0
    assert abs(toward[1]) < 0.2 * 80.0
    assert abs(toward[2]) < 0.01 * 80.0
    for fix in (light, published):  # their error is stated: the difference from the rendered correction
        assert nees(fix.center_px - case.center_px, fix) < 9.0  # three sigma


CAMERA = Camera(
    name="two",
    columns=300,
    rows=260,
    model=PinholeModel(fx_px=2500.0, fy_px=2500.0, cx_px=149.5, cy_px=129.5),
    psf=GaussianPsf(sigma_px=0.8),
)


def pair(off_px: float = 12.0) -> tuple[Image, Scene, dict[str, Float]]:
    """A planet and its moon in one image, both predicted ``off_px`` to the right."""
    rng, light, targets, centers = np.random.default_rng(9), np.zeros((260, 300)), [], {}
    sun = np.array([0.8, -0.2, -0.5]) / np.linalg.norm([0.8, -0.2, -0.5])
    bodies: tuple[tuple[str, Shape, float, tuple[float, float], Reflectance, float], ...] = (
        ("PLANET", sphere(40.0), 40.0, (110.3, 140.8), Lambert(), 2500.0),
        ("MOON", ROCK, 10.0, (215.6, 80.2), McEwen(), 400.0),
    )
    for name, shape, radius_px, center, law, level_dn in bodies:
        range_km = shape.mean_radius_km * 2500.0 / radius_px
        position = range_km * CAMERA.model.unproject(center)
        body = Body(shape=shape, camera_from_body=Rotation.identity(), position_camera_km=position, reflectance=law)
        template = render(
            body,
            CAMERA.model,
            sun_direction_camera=sun,
            psf=CAMERA.psf,
            columns=300,
            rows=260,
            options=RenderOptions(rays_per_pixel_side=4, jitter_seed=2),
        )
        assert isinstance(template, Template)
        light += level_dn * template.placed(300, 260)
        predicted = range_km * CAMERA.model.unproject((center[0] + off_px, center[1]))
        place = ApparentGeometry(position_inertial_km=predicted, sun_direction_inertial=sun)
        targets.append(Target(name=name, shape=shape, ephemeris=place, reflectance=law))
        centers[name] = np.array(center)
    pixels = (50.0 + light + rng.normal(0.0, 5.0, light.shape)).astype(np.float32)
    image = Image(pixels=pixels, camera_from_inertial=Rotation.identity(), name="pair")
    return image, Scene(targets=tuple(targets)), centers


def test_two_bodies_in_one_image_are_told_apart_and_measured_each() -> None:
    image, scene, centers = pair()
    for name, radius_px in (("PLANET", 40.0), ("MOON", 10.0)):
        fix = Moment().estimate(image, CAMERA, scene, name)
        assert isinstance(fix, CenterFix), fix
        assert fix.target == name
        assert np.linalg.norm(fix.center_px - centers[name]) < REQUIRED * radius_px
        assert nees(fix.center_px - centers[name], fix) < float(chi2.ppf(1.0 - RARE, 2))


def test_a_body_is_found_although_another_expected_one_is_too_faint() -> None:
    image, scene, centers = pair()
    dark = image.pixels.copy()
    dark[60:105, 195:240] = np.random.default_rng(10).normal(50.0, 5.0, (45, 45))
    fix = Moment().estimate(replace(image, pixels=dark), CAMERA, scene, "PLANET")
    assert isinstance(fix, CenterFix), fix
    assert np.linalg.norm(fix.center_px - centers["PLANET"]) < REQUIRED * 40.0
    assert isinstance(Moment().estimate(replace(image, pixels=dark), CAMERA, scene, "MOON"), Failure)


def test_bad_pixels_on_the_body_do_little_and_are_flagged() -> None:
    case = body_image(ROCK, 7, phase_deg=50.0)
    x, y = np.rint(case.center_px).astype(int)
    mask = np.zeros(case.image.pixels.shape, dtype=bool)
    mask[y - 3 : y, x] = mask[y + 20, x - 20 : x - 16] = True
    pixels = np.where(mask, 4000, case.image.pixels)
    spoilt = replace(case, image=replace(case.image, pixels=pixels, mask=mask))
    fix = found(spoilt)
    assert Quality.MASKED in fix.flags
    assert_allclose(fix.center_px, found(case).center_px, rtol=0, atol=0.05)


def test_light_beside_the_body_makes_the_fix_suspect_or_its_sigma_as_large_as_its_error() -> None:
    case = body_image(ROCK, 7, phase_deg=50.0)
    x, y = np.rint(case.center_px).astype(int)
    pixels = case.image.pixels.astype(np.float64)
    pixels[y - 8 : y + 8, x - 140 : x + 140] += 1500.0  # a ring, edge on
    fix = found(replace(case, image=replace(case.image, pixels=pixels)))
    assert fix.flags.suspect or nees(fix.center_px - case.center_px, fix) < WITHIN_3_SIGMA
    assert not found(case).flags.suspect


def test_what_cannot_be_measured_is_refused_with_its_reason() -> None:
    case = body_image(ROCK, 7, phase_deg=50.0)

    def reason(changed: BodyImage) -> Reason:
        failure = Moment().estimate(changed.image, changed.camera, changed.scene)
        assert isinstance(failure, Failure)
        return failure.reason

    noise = np.random.default_rng(1).normal(100.0, 5.0, case.image.pixels.shape)
    assert reason(replace(case, image=replace(case.image, pixels=noise))) is Reason.NO_SIGNAL
    assert reason(body_image(ROCK, 7, phase_deg=50.0, center_px=(40.0, 200.0))) is Reason.OUT_OF_FRAME
    assert reason(case.believed(off_px=(120.0, 0.0))) is Reason.NO_SIGNAL
    assert reason(case.believed(range_error=3.0)) is Reason.NO_SIGNAL  # a blob of another size
    assert reason(body_image(ROCK, 7, phase_deg=50.0, radius_px=300.0)) is Reason.OUT_OF_FRAME
    clipped = np.minimum(case.image.pixels * 8.0, 4095.0)
    assert reason(replace(case, image=replace(case.image, pixels=clipped))) is Reason.SATURATED
    with pytest.raises(InputError, match="correction must be one of"):
        MomentOptions(correction="magic")
    with pytest.raises(InputError, match="search_px"):
        MomentOptions(search_px=0.0)


def test_checks_render_a_body_once_in_the_size_that_its_light_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    render_at, renders = checks._at, []

    def counted(*given: Any) -> Any:
        renders.append(given)
        return render_at(*given)

    monkeypatch.setattr(checks, "_at", counted)
    fix = found(body_image(ROCK, 7, phase_deg=20.0).believed(range_error=0.015))
    assert fix.corrections.seen_size == pytest.approx(1.015, abs=0.003)  # a quarter of a pixel of the limb
    assert len(renders) == 1


def test_a_body_of_which_more_is_lost_than_it_has_light_has_no_signal() -> None:
    case = body_image(ROCK, 7, phase_deg=90.0, radius_px=15.0, peak_dn=400.0)
    x, y = np.rint(case.center_px).astype(int)
    pixels = case.image.pixels.astype(np.float64) + 3000.0
    bright = case.image.pixels > 0.5 * case.image.pixels.max()
    lost = np.zeros_like(bright)
    lost[y - 16 : y + 16, x - 16 : x + 16] = True
    lost &= ~bright
    received = Moment().estimate(replace(case.image, pixels=np.where(lost, 0.0, pixels)), case.camera, case.scene)
    assert isinstance(received, CenterFix)  # blocks of one value that never arrived are masked
    off_px = received.center_px - case.center_px
    assert off_px @ np.linalg.solve(received.covariance_px2, off_px) < float(chi2.ppf(1.0 - RARE, 2))
    pixels[lost] = np.random.default_rng(1).uniform(0.0, 200.0, int(lost.sum()))  # as they never are
    failure = Moment().estimate(replace(case.image, pixels=pixels), case.camera, case.scene)
    assert isinstance(failure, Failure)
    assert failure.reason is Reason.NO_SIGNAL


def test_a_body_whose_lit_side_is_beyond_the_frame_is_out_of_it() -> None:
    stage = stage_of(3000, 804)
    assert stage.scene is not None
    failure = Moment().estimate(stage.image, stage.camera, stage.scene)
    assert isinstance(failure, Failure)
    assert failure.reason is Reason.OUT_OF_FRAME
