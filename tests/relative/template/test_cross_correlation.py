"""Cross-correlation: the photometric fit on analytic images, and the estimator on bodies rendered with other rays."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel, PinholeModel
from giantlike.core.arrays import Float, unit
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import CenterFix, Failure, PositionFix, Quality, Reason
from giantlike.core.pixel_box import BoxPixels
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import AttitudeSource, Image
from giantlike.ray_tracing import Body, Lambert, LommelSeeliger, McEwen, Reflectance, RenderOptions, Template, render
from giantlike.relative.place import center_of_position
from giantlike.relative.template.align import align_template
from giantlike.relative.template.cross_correlation import CrossCorrelation, CrossCorrelationOptions
from giantlike.relative.template.fit import TemplateFit, TemplateFitOptions, fit_template
from giantlike.relative.template.linear import LinearProblem, fit_unweighted
from giantlike.relative.template.state import TemplateImages, TemplateState
from giantlike.scene import Scene, Target
from giantlike.shapes import Shape, TriangleMesh, irregular_body, load_shape, sphere
from tests.sizes import slow
from tests.tolerances import FLOAT64_SUM, RARE

# --- the fit, on images that are known exactly ------------------------------------------------------------------

EXACT_PX = 2e-3  # a last step below 0.05 px is not followed by another render
EXACT_LOG_RANGE = 2e-4  # the same error, at the 17 px that the light reaches
MISSED_FOR_NOISE = 1.6  # the widening by the jackknife is one-sided: with nothing to find, variances come out larger
ALIGNED_PX = 0.3  # where a new render takes over
NOISE = Detector(gain_e_per_dn=1.0, read_noise_e=5.0).variance_dn2
SHAPE = (64, 70)
CORNER = (100, 200)
TRUE = TemplateState(center_px=np.array([134.3, 231.6]), log_range=0.013, psf_variance_px2=0.64)
EVERYWHERE = np.ones(SHAPE, dtype=bool)


def blobs(seed: int = 1, *, law: float = 1.0) -> Callable[[TemplateState, bool], TemplateImages]:
    """A body of Gaussian blobs, whose image is known for any center, range and blur; ``law`` changes their shades."""
    random = np.random.default_rng(seed)
    places, widths = random.uniform(-16, 16, (14, 2)), random.uniform(1.0, 3.5, 14)
    shades = random.uniform(0.2, 1.0, 14)

    def light(state: TemplateState, exponent: float) -> Float:
        scale = math.exp(-state.log_range)
        image = np.zeros(SHAPE)
        rows, columns = np.indices(SHAPE)
        for place, width, shade in zip(places, widths, shades**exponent, strict=True):
            x, y = state.center_px + scale * place - CORNER
            own = (scale * width) ** 2
            total = own + state.psf_variance_px2 + 1.0 / 12.0
            image += shade * own / total * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2.0 * total))
        return image

    return lambda state, fine: TemplateImages(light=light(state, law), others=[light(state, 2.0)])


def start(random: np.random.Generator, *, shift_px: float = 0.4, log_range: float = 0.005) -> TemplateState:
    return replace(
        TRUE,
        center_px=TRUE.center_px + random.normal(0, shift_px, 2),
        log_range=TRUE.log_range + float(random.normal(0, log_range)),
    )


def boxed(pixels: Float, usable: NDArray[np.bool_] = EVERYWHERE) -> BoxPixels:
    return BoxPixels(values_dn=pixels, usable=usable, corner_px=CORNER, noise_variance_dn2=NOISE)


def fitted(
    pixels: Float,
    at: TemplateState,
    *,
    usable: NDArray[np.bool_] = EVERYWHERE,
    options: TemplateFitOptions | None = None,
) -> TemplateFit:
    chosen = options or TemplateFitOptions()
    fit = fit_template(boxed(pixels, usable), blobs(), at, options=chosen)
    assert isinstance(fit, TemplateFit), fit
    return fit


def errors(fit: TemplateFit) -> Float:
    return np.array([*(fit.state.center_px - TRUE.center_px), fit.state.log_range - TRUE.log_range])


def noisy(signal: Float, random: np.random.Generator) -> Float:
    return np.asarray(signal + random.normal(size=signal.shape) * np.sqrt(NOISE(signal)))


def mean_nees(fits: list[TemplateFit], covariance: Callable[[TemplateFit], Float]) -> float:
    return float(np.mean([errors(fit) @ np.linalg.solve(covariance(fit), errors(fit)) for fit in fits]))


def test_the_fit_finds_center_range_gain_and_offset_without_noise() -> None:
    pixels = 2000.0 * blobs()(TRUE, True).light + 37.0
    far = replace(TRUE, center_px=np.add(TRUE.center_px, [0.9, -0.7]), log_range=TRUE.log_range - 0.03)
    fit = fitted(pixels, far)
    assert_allclose(errors(fit), 0.0, rtol=0, atol=EXACT_PX)
    assert abs(errors(fit)[2]) < EXACT_LOG_RANGE
    assert_allclose([fit.gain_dn, fit.offset_dn], [2000.0, 37.0], rtol=0, atol=3.0)
    assert fit.score > 0.9999


def test_the_fit_is_not_pulled_by_another_reflectance_law() -> None:
    pixels = 2000.0 * blobs(law=1.7)(TRUE, True).light
    free = fitted(pixels, TRUE)

    def one_law(state: TemplateState, fine: bool) -> TemplateImages:
        return TemplateImages(light=blobs()(state, fine).light)

    bound = fit_template(boxed(pixels), one_law, TRUE)
    assert isinstance(bound, TemplateFit)
    assert np.hypot(*errors(free)[:2]) < 0.25 * np.hypot(*errors(bound)[:2])


def test_the_fit_finds_the_width_of_the_point_spread_function() -> None:
    pixels = 2000.0 * blobs()(replace(TRUE, psf_variance_px2=1.1), True).light
    fit = fitted(pixels, TRUE, options=TemplateFitOptions(blur_sigma_px2=1.0))
    assert_allclose(fit.state.psf_variance_px2, 1.1, rtol=0, atol=0.01)
    assert_allclose(errors(fit), 0.0, rtol=0, atol=EXACT_PX)


@pytest.mark.monte_carlo(few=25, full=300)
def test_errors_under_pure_noise_are_consistent_with_the_covariance(draws: int) -> None:
    random = np.random.default_rng(11)
    signal = 1500.0 * blobs()(TRUE, True).light + 20.0
    fits = [fitted(noisy(signal, random), start(random)) for _ in range(draws)]
    low, high = (float(chi2.ppf(q, 3 * draws)) / draws for q in (RARE, 1.0 - RARE))
    assert mean_nees(fits, lambda fit: fit.noise_covariance) < high * 1.1  # some of the noise counts as model error
    assert low / MISSED_FOR_NOISE < mean_nees(fits, lambda fit: fit.covariance) < high


@pytest.mark.monte_carlo(few=25, full=200)
def test_correlated_model_errors_are_in_the_covariance(draws: int) -> None:
    random = np.random.default_rng(12)
    fits = []
    for _ in range(draws):
        texture = gaussian_filter(random.normal(size=SHAPE), 2.0)
        texture *= 0.05 / texture.std()  # albedo that the template does not know
        fits.append(fitted(noisy(1500.0 * blobs()(TRUE, True).light * (1.0 + texture), random), start(random)))
    low, high = (float(chi2.ppf(q, 3 * draws)) / draws for q in (RARE, 1.0 - RARE))
    assert mean_nees(fits, lambda fit: fit.noise_covariance) > 5.0 * high  # noise alone is far too optimistic
    assert (
        low / MISSED_FOR_NOISE < mean_nees(fits, lambda fit: fit.covariance) < 1.2 * high
    )  # an estimate from one body's residuals


def test_stated_relief_widens_the_covariance_in_proportion() -> None:
    pixels = noisy(1500.0 * blobs()(TRUE, True).light, np.random.default_rng(21))

    def variance(relief_sigma: float, length_px: float) -> float:
        options = TemplateFitOptions(relief_sigma=relief_sigma, relief_length_px=length_px)
        return float(np.trace(fitted(pixels, TRUE, options=options).covariance[:2, :2]))

    plain, little, much = variance(0.0, 5.0), variance(0.02, 5.0), variance(0.04, 5.0)
    assert plain < little < much
    assert_allclose((much - plain) / (little - plain), 4.0, rtol=0, atol=0.4)  # noise is little beside
    assert variance(0.02, 10.0) > little


def test_hits_and_stars_in_the_box_are_rejected() -> None:
    random = np.random.default_rng(13)
    pixels = noisy(1500.0 * blobs()(TRUE, True).light, random)
    clean = fitted(pixels, TRUE)
    spoiled = pixels.copy()
    spoiled[random.integers(0, SHAPE[0], 25), random.integers(0, SHAPE[1], 25)] += 3000.0
    fit = fitted(spoiled, TRUE)
    assert fit.n_rejected >= 20
    shift = fit.state.center_px - clean.state.center_px
    assert np.abs(shift).max() < 2.0 * np.sqrt(np.diag(clean.covariance)[:2]).max()


def test_pixels_that_are_not_usable_do_not_count() -> None:
    pixels = 1500.0 * blobs()(TRUE, True).light
    usable = EVERYWHERE.copy()
    usable[:, 30:34] = False
    fit = fitted(np.where(usable, pixels, 1e6), start(np.random.default_rng(14)), usable=usable)
    assert_allclose(errors(fit), 0.0, rtol=0, atol=EXACT_PX)
    assert not fit.used[~usable].any()


def test_an_uncertain_range_that_is_not_estimated_widens_the_center() -> None:
    near = replace(TRUE, log_range=0.0)
    pixels = noisy(60.0 * blobs()(near, True).light, np.random.default_rng(15))
    tight = fitted(pixels, near, options=TemplateFitOptions(log_range_sigma=1e-5))
    loose = fitted(pixels, near, options=TemplateFitOptions(log_range_sigma=0.02))
    assert abs(tight.state.log_range) < 1e-4
    assert loose.noise_covariance[2, 2] < 0.02**2
    assert np.trace(loose.noise_covariance[:2, :2]) > np.trace(tight.noise_covariance[:2, :2])


def test_a_template_without_features_is_refused() -> None:
    def flat(state: TemplateState, fine: bool) -> TemplateImages:
        return TemplateImages(light=np.ones(SHAPE))

    fit = fit_template(boxed(np.full(SHAPE, 50.0)), flat, TRUE)
    assert isinstance(fit, Failure)
    assert fit.reason is Reason.DEGENERATE_GEOMETRY


def test_a_failed_render_ends_the_fit_with_its_reason() -> None:
    dark = Failure(Reason.NOT_LIT, "dark")
    fit = fit_template(boxed(np.ones(SHAPE)), lambda state, fine: dark, TRUE)
    assert fit is dark


def test_the_motion_of_an_image_is_that_of_its_pixels_by_their_slopes() -> None:
    images, step = blobs()(TRUE, True), np.array([0.3, -0.2, 0.01])
    problem = LinearProblem(boxed(1000.0 * images.light), images, TRUE, None)
    rows, columns = np.indices(SHAPE)
    slopes = np.sum(problem["center"] ** 2, axis=0)
    x, y = columns + CORNER[0] - TRUE.center_px[0], rows + CORNER[1] - TRUE.center_px[1]
    squares = (step[0] - step[2] * x) ** 2 + (step[1] - step[2] * y) ** 2
    assert_allclose(problem.motion_px(step), math.sqrt(np.average(squares, weights=slopes)), rtol=1e-9)
    assert_allclose(problem.reach_px, math.sqrt(np.average(x**2 + y**2, weights=images.light)), rtol=1e-9)


def test_plain_least_squares_are_those_of_numpy() -> None:
    random = np.random.default_rng(8)
    basis = random.normal(size=(4, *SHAPE)) * np.array([1e-3, 1.0, 30.0, 1e4])[:, None, None]
    pixels = boxed(
        np.tensordot([5e3, 3.0, 0.2, 1e-3], basis, 1) + random.normal(size=SHAPE), random.random(SHAPE) < 0.8
    )
    expected = np.linalg.lstsq(basis[:, pixels.usable].T, pixels.values_dn[pixels.usable], rcond=None)[0]
    assert_allclose(fit_unweighted(basis, pixels), expected, rtol=1e-8)


def test_alignment_takes_a_rough_start_near_the_solution() -> None:
    rendered = replace(TRUE, center_px=np.add(TRUE.center_px, [1.0, 2.0]), log_range=TRUE.log_range + 0.06)
    light = blobs()(rendered, True).light
    pixels = noisy(1500.0 * blobs()(TRUE, True).light, np.random.default_rng(16))
    rough = replace(rendered, center_px=np.add(TRUE.center_px, [-1.5, 1.2]))
    state = align_template(boxed(pixels), [light], rendered, rough, radius_px=18.0)
    assert np.abs(state.center_px - TRUE.center_px).max() < ALIGNED_PX
    assert abs(state.log_range - TRUE.log_range) * 17.0 < ALIGNED_PX


# --- the estimator, on rendered bodies --------------------------------------------------------------------------

CENTER_PX = 0.1  # requirement, per axis
LOG_RANGE = 0.002  # a limb of 30 px that is off by 0.06 px
NEES_LIMIT = float(chi2.ppf(1.0 - RARE, 3)) * 1.5  # covariances come from residuals, which leave them a third uncertain
DETECTOR = Detector(gain_e_per_dn=1.0, read_noise_e=5.0, saturation_dn=4095.0)
CAMERA = Camera(
    name="NavCam",
    columns=320,
    rows=300,
    model=BrownModel(fx_px=3000.0, fy_px=3000.0, cx_px=161.0, cy_px=148.0, k1=-0.5, p1=2e-4),
    psf=GaussianPsf(sigma_px=0.75),
    detector=DETECTOR,
)
ROCK = irregular_body(7, facets=20_000)
POSE = Rotation.from_rotvec([0.4, -0.9, 0.3])
NO_MASK = np.zeros((0, 0), dtype=bool)
ATTITUDE = Rotation.from_rotvec([0.1, 2.0, -1.0])


@dataclass(frozen=True, kw_only=True)
class Case:
    """A body before the camera: the truth. A priori it is 10 px and 1.5 % in range away."""

    diameter_px: float
    phase_deg: float
    shape: Shape = ROCK
    pixel: tuple[float, float] = (160.3, 150.8)
    azimuth_deg: float = 30.0
    law: Reflectance = field(default_factory=McEwen)
    camera: Camera = CAMERA
    rays: int = 3
    seed: int = 1

    @property
    def range_km(self) -> float:
        return 2 * self.shape.mean_radius_km * self.camera.model.focal_length_px / self.diameter_px

    @property
    def sun(self) -> Float:
        phase, azimuth = math.radians(self.phase_deg), math.radians(self.azimuth_deg)
        back = -self.camera.model.unproject(self.pixel)
        side = unit(np.cross(back, [math.sin(azimuth), math.cos(azimuth), 0.0]))
        return math.cos(phase) * back + math.sin(phase) * side

    def light(self) -> Float:
        template = render(
            Body(
                shape=self.shape,
                camera_from_body=POSE,
                position_camera_km=self.range_km * self.camera.model.unproject(self.pixel),
                reflectance=self.law,
            ),
            self.camera.model,
            sun_direction_camera=self.sun,
            psf=GaussianPsf(sigma_px=0.75),
            columns=self.camera.columns,
            rows=self.camera.rows,
            options=RenderOptions(rays_per_pixel_side=self.rays, min_rays_across=1, jitter_seed=self.seed),
        )
        assert isinstance(template, Template), template
        peak = float(template.brightness.max())
        return template.placed(self.camera.columns, self.camera.rows) / peak

    def image(self, *, peak_dn: float = 3000.0, extra_dn: Float | float = 0.0) -> Image:
        random = np.random.default_rng(self.seed)
        signal = peak_dn * self.light() + extra_dn
        pixels = random.poisson(signal) + random.normal(0.0, DETECTOR.read_noise_e, signal.shape)
        stored = np.clip(np.rint(pixels), -100, 4095).astype(np.int16)
        return Image(pixels=stored, camera_from_inertial=ATTITUDE, name="rock.fits")

    def scene(
        self, *, off_px: tuple[float, float] = (8.0, -6.0), range_factor: float = 1.015, sun: Float | None = None
    ) -> Scene:
        back = ATTITUDE.inv()
        predicted = self.range_km * range_factor * self.camera.model.unproject(np.add(self.pixel, off_px))
        geometry = ApparentGeometry(
            position_inertial_km=rotate(back, predicted),
            inertial_from_body=back * POSE,
            sun_direction_inertial=rotate(back, self.sun if sun is None else sun),
        )
        return Scene(targets=(Target(name="ROCK", shape=self.shape, ephemeris=geometry),))


def estimated(case: Case, image: Image, scene: Scene, options: CrossCorrelationOptions | None = None) -> CenterFix:
    fix = CrossCorrelation(options or CrossCorrelationOptions()).estimate(image, case.camera, scene)
    assert isinstance(fix, CenterFix), fix
    return fix


def positioned(case: Case, image: Image, scene: Scene, options: CrossCorrelationOptions | None = None) -> PositionFix:
    fix = estimated(case, image, scene, options)
    assert isinstance(fix, PositionFix)
    return fix


def failure(image: Image, scene: Scene, camera: Camera = CAMERA) -> Failure:
    outcome = CrossCorrelation().estimate(image, camera, scene)
    assert isinstance(outcome, Failure), outcome
    return outcome


@pytest.mark.parametrize(
    ("diameter_px", "phase_deg"),
    [(20.0, 30.0), slow(20.0, 110.0), slow(50.0, 60.0), slow(50.0, 120.0), (130.0, 20.0), slow(130.0, 90.0)],
)
def test_center_and_range_of_resolved_bodies(diameter_px: float, phase_deg: float) -> None:
    case = Case(diameter_px=diameter_px, phase_deg=phase_deg)
    fix = positioned(case, case.image(), case.scene())
    error_km = fix.position_camera_km - case.range_km * CAMERA.model.unproject(case.pixel)
    assert error_km @ np.linalg.solve(fix.covariance_camera_km2, error_km) < NEES_LIMIT
    assert np.sqrt(np.diag(fix.covariance_px2)).max() < CENTER_PX
    assert fix.sigma_range_km / fix.range_km < LOG_RANGE * 150.0 / diameter_px  # three times what is usual
    assert fix.score > 0.99
    assert not fix.flags.suspect
    assert len(fix.residuals) == fix.n_used


@pytest.mark.parametrize("law", [Lambert(), slow(LommelSeeliger())])
def test_a_wrong_reflectance_law_does_not_pull_center_or_range(law: Reflectance) -> None:
    case = Case(diameter_px=80.0, phase_deg=40.0, law=law)
    free = positioned(case, case.image(), case.scene())
    assert_allclose(free.center_px, case.pixel, rtol=0, atol=0.5 * CENTER_PX)
    assert abs(math.log(free.range_km / case.range_km)) < LOG_RANGE


@pytest.mark.parametrize("range_factor", [0.95, slow(1.05)])
def test_an_error_of_the_range_does_not_pull_the_center(range_factor: float) -> None:
    case = Case(diameter_px=110.0, phase_deg=80.0)
    fix = positioned(case, case.image(), case.scene(range_factor=range_factor))
    assert_allclose(fix.center_px, case.pixel, rtol=0, atol=CENTER_PX)
    assert abs(math.log(fix.range_km / case.range_km)) < LOG_RANGE


@pytest.mark.monte_carlo(few=4, full=30)
def test_errors_on_rendered_bodies_are_consistent_with_the_covariance(draws: int) -> None:
    nees = []
    for seed in range(draws):
        random = np.random.default_rng(seed)
        case = Case(
            diameter_px=26.0,
            phase_deg=65.0,
            azimuth_deg=float(random.uniform(0, 360)),
            pixel=(160.0 + float(random.uniform(0, 1)), 150.0 + float(random.uniform(0, 1))),
            seed=seed,
        )
        off = (float(random.uniform(-10, 10)), float(random.uniform(-10, 10)))
        fix = estimated(case, case.image(), case.scene(off_px=off))
        error = fix.center_px - case.pixel
        nees.append(float(error @ np.linalg.solve(fix.covariance_px2, error)))
    low, high = (float(chi2.ppf(q, 2 * draws)) / draws for q in (RARE, 1.0 - RARE))
    assert low / MISSED_FOR_NOISE < np.mean(nees) < high


def test_a_body_larger_than_the_frame_is_found() -> None:
    case = Case(diameter_px=420.0, phase_deg=50.0, pixel=(60.2, 240.7), rays=2)
    fix = positioned(case, case.image(), case.scene())
    assert_allclose(fix.center_px, case.pixel, rtol=0, atol=CENTER_PX)
    assert Quality.CUT_BY_FRAME in fix.flags
    inside = (fix.limb_px >= -0.5) & (fix.limb_px <= [CAMERA.columns - 0.5, CAMERA.rows - 0.5])
    assert inside.all()


@pytest.mark.parametrize("off_px", [(8.0, -6.0), (-25.0, 0.0)], ids=["predicted_inside", "predicted_outside"])
def test_a_body_on_the_edge_of_the_frame_is_found(off_px: tuple[float, float]) -> None:
    case = Case(diameter_px=40.0, phase_deg=40.0, pixel=(2.3, 150.8))
    fix = positioned(case, case.image(), case.scene(off_px=off_px))
    assert_allclose(fix.center_px, case.pixel, rtol=0, atol=CENTER_PX)
    assert Quality.CUT_BY_FRAME in fix.flags


def test_bad_saturated_and_foreign_pixels_do_not_pull_the_center() -> None:
    case = Case(diameter_px=60.0, phase_deg=50.0)
    rows, columns = np.indices((CAMERA.rows, CAMERA.columns))
    star = 2500.0 * np.exp(-((columns - 185.0) ** 2 + (rows - 122.0) ** 2) / (2 * 0.8**2))
    image = case.image(extra_dn=star)
    pixels, mask = image.pixels.copy(), np.zeros(image.pixels.shape, bool)
    pixels[:, 150] = -77
    mask[:, 150] = True
    pixels[140:144, 170] = 4095
    fix = positioned(case, replace(image, pixels=pixels, mask=mask), case.scene())
    assert_allclose(fix.center_px, case.pixel, rtol=0, atol=CENTER_PX)
    assert Quality.MASKED in fix.flags
    assert Quality.SATURATED in fix.flags
    assert fix.n_rejected > 0


def test_an_unknown_point_spread_function_does_not_pull_the_center() -> None:
    camera = replace(CAMERA, psf=None)
    case = Case(diameter_px=60.0, phase_deg=70.0, camera=camera)
    fix = positioned(case, case.image(), case.scene())
    assert_allclose(fix.center_px, case.pixel, rtol=0, atol=CENTER_PX)
    assert abs(math.log(fix.range_km / case.range_km)) < LOG_RANGE


def test_the_range_of_a_small_body_is_not_estimated_unless_asked_for() -> None:
    case = Case(diameter_px=12.0, phase_deg=40.0)
    image, scene = case.image(), case.scene()
    assert type(estimated(case, image, scene)) is CenterFix
    assert type(estimated(case, image, scene, CrossCorrelationOptions(estimate_scale=True))) is PositionFix
    assert_allclose(estimated(case, image, scene).center_px, case.pixel, rtol=0, atol=CENTER_PX)


def test_position_and_center_say_the_same() -> None:
    case = Case(diameter_px=60.0, phase_deg=50.0)
    fix = positioned(case, case.image(), case.scene())
    center, covariance = center_of_position(CAMERA.model, fix.position_camera_km, fix.covariance_camera_km2)
    assert_allclose(center, fix.center_px, rtol=0, atol=FLOAT64_SUM)
    assert_allclose(covariance, fix.covariance_px2, rtol=0, atol=FLOAT64_SUM)
    distance = np.linalg.norm(fix.limb_px - fix.center_px, axis=1)
    assert float(distance.min()) / 30.0 > 0.5
    assert float(distance.max()) / 30.0 < 2.5
    assert not len(fix.measured_limb_px), "an outline is no limb that was measured"


def test_residuals_say_where_they_are_in_the_image() -> None:
    case = Case(diameter_px=60.0, phase_deg=50.0)
    image = case.image()
    spoiled = np.array(image.pixels, dtype=np.float64)
    x, y = np.rint(case.pixel - np.array([4.0, -3.0])).astype(int)
    spoiled[y, x] += 0.02 * spoiled.max()
    fix = positioned(case, replace(image, pixels=spoiled), case.scene())
    change = fix.residuals - positioned(case, image, case.scene()).residuals
    assert_allclose(fix.residuals_at_px[np.argmax(change)], [x, y], rtol=0, atol=0)


def test_a_sphere_is_found_and_two_runs_agree_to_the_last_bit() -> None:
    case = Case(diameter_px=40.0, phase_deg=70.0, shape=sphere(1.3))
    image, scene = case.image(), case.scene()
    first, second = estimated(case, image, scene), estimated(case, image, scene)
    assert_allclose(first.center_px, case.pixel, rtol=0, atol=CENTER_PX)
    assert_allclose(second.center_px, first.center_px, rtol=0, atol=0)
    assert first.provenance["shape_sha256"] == case.shape.sha256


def test_flags_say_where_the_attitude_came_from() -> None:
    case = Case(diameter_px=20.0, phase_deg=40.0)
    image, scene = case.image(), case.scene()
    stars = replace(image, attitude_source=AttitudeSource.STARS)
    between = replace(image, attitude_source=AttitudeSource.INTERPOLATED)
    assert Quality.APRIORI_ATTITUDE in estimated(case, image, scene).flags
    assert Quality.INTERPOLATED_ATTITUDE in estimated(case, between, scene).flags
    assert estimated(case, stars, scene).flags is Quality.NONE


def test_what_cannot_be_found_is_refused_with_a_reason() -> None:
    case = Case(diameter_px=40.0, phase_deg=40.0)
    image, scene = case.image(), case.scene()
    noise = np.random.default_rng(1).normal(0, 5, image.pixels.shape).astype(np.float32)
    dark = np.zeros_like(noise)
    assert failure(replace(image, pixels=noise, mask=NO_MASK), scene).reason is Reason.LOW_CORRELATION
    assert failure(replace(image, pixels=dark, mask=NO_MASK), scene).reason is Reason.NO_SIGNAL
    assert failure(image, case.scene(off_px=(400.0, 0.0))).reason is Reason.OUT_OF_FRAME
    behind = case.camera.model.unproject(case.pixel)
    assert failure(image, Case(diameter_px=40.0, phase_deg=40.0, shape=sphere(1.0)).scene(sun=behind)).reason in {
        Reason.NOT_LIT
    }
    assert failure(replace(image, camera_from_inertial=None), scene).reason is Reason.NO_ATTITUDE
    assert "ROCK" in failure(image, case.scene(off_px=(400.0, 0.0))).detail


@pytest.mark.parametrize(("peak_dn", "suspect"), [(7000.0, False), (60_000.0, True)])
def test_an_overexposed_body_is_found_by_what_its_saturated_pixels_leave(peak_dn: float, suspect: bool) -> None:
    case = Case(diameter_px=40.0, phase_deg=30.0)
    fix = positioned(case, case.image(peak_dn=peak_dn), case.scene())
    assert Quality.SATURATED in fix.flags
    assert fix.flags.suspect is suspect
    assert_allclose(fix.center_px, case.pixel, rtol=0, atol=CENTER_PX)


def test_a_body_beyond_the_declared_search_is_found_and_suspect() -> None:
    case = Case(diameter_px=40.0, phase_deg=40.0)
    for scene in (case.scene(off_px=(60.0, 0.0)), case.scene(range_factor=1.08)):
        fix = positioned(case, case.image(), scene)
        assert Quality.FAR_FROM_PREDICTION in fix.flags
        assert_allclose(fix.center_px, case.pixel, rtol=0, atol=CENTER_PX)


def test_a_weak_match_is_kept_and_as_uncertain_as_it_is() -> None:
    case = Case(diameter_px=40.0, phase_deg=40.0)
    fix = estimated(case, case.image(peak_dn=12.0), case.scene())
    assert not fix.flags.suspect
    error = fix.center_px - case.pixel
    assert float(error @ np.linalg.solve(fix.covariance_px2, error)) < float(chi2.ppf(1.0 - RARE, 2))


@pytest.mark.parametrize(
    "name",
    ["min_scale_diameter_px", "range_sigma", "clip_sigma", "search_px", "max_iterations", "relief_length_rad"],
)
def test_options_out_of_range_are_refused(name: str) -> None:
    with pytest.raises(InputError):
        CrossCorrelationOptions(**{name: 0})  # type: ignore[arg-type]


def test_an_image_of_another_size_than_the_camera_is_misuse() -> None:
    case = Case(diameter_px=40.0, phase_deg=40.0)
    with pytest.raises(InputError, match="320 x 300"):
        CrossCorrelation().estimate(
            replace(case.image(), pixels=np.ones((300, 321)), mask=NO_MASK), CAMERA, case.scene()
        )


# --- a real body ------------------------------------------------------------------------------------------------

VESTA_PX = 4.0  # the mesh has facets of 20 px and the pose holds to half a pixel
VESTA_LOG_RANGE = 0.003


@pytest.mark.slow
@pytest.mark.real_data
def test_vesta_larger_than_the_frame_agrees_with_its_pose(data_dir: Path) -> None:
    folder = data_dir / "bodies" / "dawn_vesta"
    poses = json.loads((folder / "poses.json").read_text())
    table, pose = poses["camera"], poses["images"]["00000002.png"]
    model = PinholeModel(**{key: table[key] for key in ("fx_px", "fy_px", "cx_px", "cy_px")})
    camera = Camera(name="FC2", columns=table["columns"], rows=table["rows"], model=model)
    turn = Rotation.from_quat(pose["q_wxyz_camera_from_body"], scalar_first=True)
    position = np.array(pose["t_body_in_camera_km"])
    truth = model.project(position)
    geometry = ApparentGeometry(
        position_inertial_km=1.015 * float(np.linalg.norm(position)) * model.unproject(np.add(truth, [12.0, -9.0])),
        inertial_from_body=turn,
        sun_direction_inertial=unit(rotate(turn, np.array(pose["sun_body"]))),
    )
    shape = load_shape(data_dir / "shapes" / "vesta_5002.ply", units="km")
    assert isinstance(shape, TriangleMesh)
    scene = Scene(targets=(Target(name="VESTA", shape=shape, ephemeris=geometry),))
    image = Image.open(folder / "00000002.png").with_attitude(Rotation.identity())
    options = CrossCorrelationOptions(max_iterations=4, free_reflectance=False)  # quicker, and enough here
    fix = CrossCorrelation(options).estimate(image, camera, scene)
    assert isinstance(fix, PositionFix), fix
    assert_allclose(fix.center_px, truth, rtol=0, atol=VESTA_PX)
    assert abs(math.log(fix.range_km / pose["range_km"])) < VESTA_LOG_RANGE
    assert Quality.CUT_BY_FRAME in fix.flags
    assert not fix.flags.suspect
