"""Whole-pass estimator: truth found within its sigma, honest covariance, tests of terms, weak combinations named."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from giantlike.calibration.options import Treatment
from giantlike.camera import ModelUncertainty
from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.outcomes import AttitudeErrors, Failure, Reason
from giantlike.passes import (
    LimbPoints,
    NavigationPass,
    PassFix,
    PassImage,
    PassOptions,
    PassTerm,
    estimate_pass,
)
from giantlike.passes.images import MeasuredPosition, covariance_root
from giantlike.processing.limb.measurement import LimbMeasurement
from tests.numerical import numerical_jacobian
from tests.passes.simulated_pass import (
    ASSUMED_ALTITUDE_KM,
    EARTH_KM,
    MODEL,
    TRUE_ALTITUDE_KM,
    Truth,
    as_positions,
    simulated_pass,
)
from tests.tolerances import RARE

FEW_SIGMAS = 4.0  # of one number; one in 16,000 is beyond
RUNS = 16
STEP_PX, LATE_S, BIAS_RAD = 0.5, 0.8, np.array([1e-4, -6e-5, 0.0])
TRAJECTORY_SIGMAS = np.array([4.0, 4.0, 8.0, 1e-3, 1e-3, 1e-3])  # km, km/s: 18 to 24 kft are 5 to 7 km


def solved(given: NavigationPass, options: PassOptions) -> PassFix:
    fix = estimate_pass(given, options)
    assert isinstance(fix, PassFix), fix
    return fix


def usual(**changes: object) -> PassOptions:
    values: dict[str, object] = {
        "estimate": {
            PassTerm.LIMB_ALTITUDE: math.inf,
            PassTerm.POINTING_BIAS: 1e-3,
            PassTerm.EXPOSURE_STEPS: math.inf,
        }
    }
    return PassOptions(**(values | changes))  # type: ignore[arg-type]


def drawn(rng: np.random.Generator) -> Truth:
    return Truth(
        bias_rad=BIAS_RAD + 1e-4 * rng.normal(size=3),
        step_px=STEP_PX,
        trajectory=TRAJECTORY_SIGMAS * rng.normal(size=6),
    )


def nees(fix: PassFix, truth: Float) -> float:
    error = fix.values - truth
    scale = fix.sigmas
    return float(error / scale @ np.linalg.solve(fix.correlation, error / scale))


def in_band(values: list[float], freedom: int) -> bool:
    low, high = (float(chi2.ppf(chance, freedom * len(values))) for chance in (RARE, 1.0 - RARE))
    return low < sum(values) < high


def test_an_earth_pass_processed_with_a_limb_of_35_km_finds_the_true_25_km() -> None:
    rng = np.random.default_rng(1)
    truth = drawn(rng)
    given = simulated_pass(truth, rng, images=80, trajectory_sigmas=TRAJECTORY_SIGMAS)
    assert given.limb_altitude_km == ASSUMED_ALTITUDE_KM
    fix = solved(given, usual())
    error_km = fix.value("limb_altitude") - TRUE_ALTITUDE_KM
    assert abs(error_km) < FEW_SIGMAS * fix.sigma("limb_altitude")
    assert fix.sigma("limb_altitude") < 1.0  # km: ten of them lie between the truth and what was assumed
    assert fix.test("limb_altitude").significant(1e-6)
    assert abs(fix.value("exposure_steps_5e-05s") - STEP_PX) < FEW_SIGMAS * fix.sigma("exposure_steps_5e-05s")
    assert fix.noise_scale < 1.1


def test_errors_of_all_parameters_are_as_large_as_their_covariance_says() -> None:
    rng = np.random.default_rng(2)
    squares = []
    for _ in range(RUNS):
        truth = replace(drawn(rng), trajectory=TRAJECTORY_SIGMAS * rng.normal(size=6))
        given = simulated_pass(truth, rng, images=20, trajectory_sigmas=TRAJECTORY_SIGMAS)
        fix = solved(given, usual())
        true = np.array([TRUE_ALTITUDE_KM, *truth.bias_rad, STEP_PX])
        squares.append(nees(fix, true))
    assert in_band(squares, 5)


def test_every_term_is_found_within_its_sigma() -> None:
    rng = np.random.default_rng(3)
    truth = Truth(
        bias_rad=BIAS_RAD,
        drift_rad_s=np.array([3e-8, -2e-8, 0.0]),
        interlock_rad=np.array([-5e-5, 4e-5, 0.0]),
        late_s=LATE_S,
        step_px=STEP_PX,
    )
    given = simulated_pass(truth, rng, images=60, points=40, sensors=("a", "b"))
    terms = {
        PassTerm.LIMB_ALTITUDE: math.inf,
        PassTerm.POINTING_BIAS: 1e-3,
        PassTerm.POINTING_DRIFT: 1e-6,
        PassTerm.INTERLOCK: 1e-3,
        PassTerm.TIMETAG_BIAS: 10.0,
        PassTerm.EXPOSURE_STEPS: math.inf,
    }
    fix = solved(given, PassOptions(estimate=terms))
    true = np.concatenate(
        [[TRUE_ALTITUDE_KM], truth.bias_rad, truth.drift_rad_s, truth.interlock_rad, [truth.late_s, truth.step_px]]
    )
    assert np.all(np.abs(fix.values - true) < FEW_SIGMAS * fix.sigmas), dict(zip(fix.names, fix.values, strict=True))
    for term in (PassTerm.LIMB_ALTITUDE, PassTerm.INTERLOCK, PassTerm.TIMETAG_BIAS, PassTerm.EXPOSURE_STEPS):
        assert fix.test(term).significant(1e-3), term
    plain = solved(given, PassOptions(estimate={PassTerm.LIMB_ALTITUDE: math.inf, PassTerm.POINTING_BIAS: 1e-3}))
    assert plain.chi2 / plain.freedom > 1.05 * fix.chi2 / fix.freedom  # what is left out shows in the residuals


def test_positions_tell_the_same_as_limbs() -> None:
    rng = np.random.default_rng(4)
    squares = []
    for _ in range(RUNS):
        truth = replace(drawn(rng), late_s=0.0)
        limbs = simulated_pass(truth, rng, images=20, points=4, trajectory_sigmas=TRAJECTORY_SIGMAS)
        fix = solved(as_positions(limbs, truth, rng), usual())
        squares.append(nees(fix, np.array([TRUE_ALTITUDE_KM, *truth.bias_rad, STEP_PX])))
    assert in_band(squares, 5)


def test_a_considered_trajectory_enlarges_the_covariance_and_an_ignored_one_makes_it_false() -> None:
    rng = np.random.default_rng(5)
    truth = replace(drawn(rng), trajectory=np.array([0.0, 0.0, 3.0 * TRAJECTORY_SIGMAS[2], 0.0, 0.0, 0.0]))
    given = simulated_pass(truth, rng, images=60, points=60, trajectory_sigmas=TRAJECTORY_SIGMAS)
    exact = replace(
        given,
        images=tuple(replace(image, by_trajectory=np.zeros((3, 0))) for image in given.images),
        covariance_trajectory=np.zeros((0, 0)),
    )
    considered, ignored = solved(given, usual()), solved(exact, usual())
    assert_allclose(considered.values, ignored.values, rtol=0, atol=1e-3 * considered.sigmas.min())
    off = abs(considered.value("limb_altitude") - TRUE_ALTITUDE_KM)
    assert off < FEW_SIGMAS * considered.sigma("limb_altitude")
    assert off > FEW_SIGMAS * ignored.sigma("limb_altitude")
    assert_allclose(
        considered.parts["noise"] + considered.parts["a priori"] + considered.parts["considered trajectory"],
        considered.covariance,
        rtol=1e-9,
    )
    estimated = solved(given, usual(trajectory=Treatment.ESTIMATE))
    assert estimated.sigma("limb_altitude") <= considered.sigma("limb_altitude") * (1.0 + 1e-9)


@pytest.mark.parametrize("seed", [0, 2, 5])
def test_residuals_by_considered_errors_are_not_noise(seed: int) -> None:
    """The ratio of residuals to noise was 2.4 to 5.5 where a trajectory that errs as declared was considered."""
    rng = np.random.default_rng(seed)
    sigmas = np.array([50.0, 50.0, 50.0, 0.02, 0.02, 0.02])
    truth = replace(drawn(rng), trajectory=sigmas * rng.normal(size=6))
    fix = solved(simulated_pass(truth, rng, images=60, points=60, trajectory_sigmas=sigmas), usual())
    assert fix.chi2 > 5.0 * fix.freedom
    assert fix.noise_scale < 1.05


def test_a_pass_whose_residuals_are_far_beyond_the_noise_is_a_failure() -> None:
    rng = np.random.default_rng(5)
    truth = replace(drawn(rng), trajectory=np.array([0.0, 0.0, 0.0, 2.0, -2.0, 0.0]))
    given = simulated_pass(truth, rng, images=20, points=60, trajectory_sigmas=TRAJECTORY_SIGMAS)
    exact = replace(
        given,
        images=tuple(replace(image, by_trajectory=np.zeros((3, 0))) for image in given.images),
        covariance_trajectory=np.zeros((0, 0)),
    )
    outcome = estimate_pass(exact, usual(outlier_sigmas=1e6))
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.LARGE_RESIDUALS
    assert "times the stated noise" in outcome.detail


def test_what_a_pass_cannot_tell_is_refused_by_name_or_left_as_known_before() -> None:
    rng = np.random.default_rng(6)
    given = simulated_pass(Truth(), rng, images=20)
    free = PassOptions(estimate={PassTerm.LIMB_ALTITUDE: math.inf, PassTerm.RANGE_SCALE: math.inf})
    refused = estimate_pass(as_positions(given, Truth(), rng), free)
    assert isinstance(refused, Failure)
    assert refused.reason is Reason.DEGENERATE_GEOMETRY
    assert "limb_altitude" in refused.detail
    assert "range_scale" in refused.detail
    vague = solved(given, free)  # the altitude changes the flattening a little, which limbs show and positions do not
    assert set(vague.weak[0].weights) == {"limb_altitude", "range_scale"}
    assert vague.sigma("limb_altitude") > 50.0
    known = {PassTerm.LIMB_ALTITUDE: 20.0, PassTerm.RANGE_SCALE: 1e-3}
    fix = solved(given, PassOptions(estimate=known))
    assert set(fix.weak[0].weights) == {"limb_altitude", "range_scale"}
    # What the images say is shared by the a priori variances: 20 km against a thousandth of the radius.
    by_range_km = 1e-3 * float(EARTH_KM.mean())
    share = 20.0**2 / (20.0**2 + by_range_km**2)
    expected_km = ASSUMED_ALTITUDE_KM + share * (TRUE_ALTITUDE_KM - ASSUMED_ALTITUDE_KM)
    assert abs(fix.value("limb_altitude") - expected_km) < 1.0
    assert abs(fix.sigma("limb_altitude") - math.sqrt(share) * by_range_km) < 0.1
    assert fix.learned[1] < 0.2


def test_a_parameter_that_moves_nothing_is_named() -> None:
    rng = np.random.default_rng(7)
    given = simulated_pass(Truth(), rng, images=5)
    still = replace(given, images=tuple(replace(i, rate_camera_km_s=np.zeros(3)) for i in given.images))
    failed = estimate_pass(still, PassOptions(estimate={PassTerm.TIMETAG_BIAS: math.inf}))
    assert isinstance(failed, Failure)
    assert "timetag_bias" in failed.detail
    fix = solved(still, PassOptions(estimate={PassTerm.TIMETAG_BIAS: 2.0}))
    assert_allclose([fix.value("timetag_bias"), fix.sigma("timetag_bias")], [0.0, 2.0], atol=1e-9)
    assert fix.learned[0] == pytest.approx(0.0, abs=1e-9)
    assert not fix.test("timetag_bias").significant(0.5)


@pytest.mark.slow
def test_terms_that_are_not_there_are_called_significant_as_rarely_as_stated() -> None:
    rng = np.random.default_rng(8)
    level, hits, count = 0.1, 0, 40
    for _ in range(count):
        given = simulated_pass(Truth(altitude_km=ASSUMED_ALTITUDE_KM), rng, images=8, points=16)
        fix = solved(given, usual())
        hits += sum(fix.test(term).significant(level) for term in (PassTerm.LIMB_ALTITUDE, PassTerm.EXPOSURE_STEPS))
    low, high = (float(binom.ppf(chance, 2 * count, level)) for chance in (RARE, 1.0 - RARE))
    assert low <= hits <= high
    assert hits <= 22  # a quarter: a test that always rejects would have 80


def test_jitter_of_the_timetags_is_measured_and_given_for_every_image() -> None:
    rng = np.random.default_rng(9)
    truth = Truth(jitter_s=0.5)
    given = simulated_pass(truth, rng, images=80, rate_px_s=1.0)
    options = usual(timetag_jitter_s=0.05, estimate_jitter=True)
    fix = solved(given, options)
    assert fix.jitter is not None
    assert abs(math.log(fix.jitter.sigma_s / truth.jitter_s)) < FEW_SIGMAS * fix.jitter.sigma_of_log
    assert fix.jitter.sigma_of_log < 0.2  # 80 images tell a standard deviation to 1/sqrt(160) at best
    assert fix.jitter.p_value < 1e-6
    assert np.all(fix.jitter.sigmas_s < 1.2 * truth.jitter_s)
    without = solved(simulated_pass(Truth(), rng, images=40), options)
    assert without.jitter is not None
    assert without.jitter.sigma_s < 0.1
    assert without.jitter.p_value > 1e-3


def test_outliers_on_the_limb_are_left_out() -> None:
    rng = np.random.default_rng(10)
    given = simulated_pass(Truth(), rng, images=12)
    spoiled = []
    for image in given.images:
        assert isinstance(image.observed, LimbPoints)
        points = image.observed.points_px.copy()
        points[:2] += 5.0
        observed = LimbPoints(
            points_px=points, sigma_px=image.observed.sigma_px, model=image.observed.model, figure=image.observed.figure
        )
        spoiled.append(replace(image, observed=observed))
    fix = solved(replace(given, images=tuple(spoiled)), usual())
    assert fix.n_rejected >= 20  # of 24; some lie along the limb, where a step of 5 px leaves nothing
    assert abs(fix.value("limb_altitude") - TRUE_ALTITUDE_KM) < FEW_SIGMAS * fix.sigma("limb_altitude")


def test_errors_that_limbs_share_do_not_average_out() -> None:
    rng = np.random.default_rng(11)
    sigmas = []
    for count in (5, 45):
        given = simulated_pass(Truth(), rng, images=count)
        images = []
        for image in given.images:
            assert isinstance(image.observed, LimbPoints)
            observed = replace_limb(image.observed, {"relief": np.full((image.observed.size, 1), 0.2)})
            images.append(replace(image, observed=observed))
        sigmas.append(solved(replace(given, images=tuple(images)), usual()).sigma("limb_altitude"))
    km_per_px = 150_000.0 / 7312.5
    assert_allclose(sigmas[1], 0.2 * km_per_px, rtol=0.1)
    assert sigmas[0] > sigmas[1]


def test_an_error_of_the_camera_that_limbs_share_is_in_the_covariance() -> None:
    """The focal length is off by one sigma: taken as exact it is mistaken for an altitude of the limb."""
    rng, sigma_px = np.random.default_rng(17), 15.0
    known = ModelUncertainty(
        estimated=("fx_px", "cx_px"),
        covariance=np.array([[sigma_px**2, 0.5 * sigma_px], [0.5 * sigma_px, 1.0]]),
        residual_sigma_px=0.1,
        n_observations=100,
        n_images=5,
    )
    given, found = simulated_pass(Truth(), rng, images=20), {}
    for uncertainty in (None, known):
        images = []
        for image in given.images:
            assert isinstance(image.observed, LimbPoints)
            model = replace(MODEL, fx_px=MODEL.fx_px - sigma_px)
            observed = LimbPoints.of(measured(image.observed, image), model, image.observed.figure, uncertainty)
            images.append(replace(image, observed=observed))
        found[uncertainty is known] = solved(replace(given, images=tuple(images)), usual())
    errors = {
        key: (abs(fix.value("limb_altitude") - TRUE_ALTITUDE_KM), fix.sigma("limb_altitude"))
        for key, fix in found.items()
    }
    assert errors[False][0] > FEW_SIGMAS * errors[False][1], errors
    assert errors[True][0] < 2.0 * errors[True][1], errors


def test_shifts_by_the_camera_are_those_of_points_of_another_camera_and_of_its_attitude() -> None:
    rng = np.random.default_rng(18)
    image = simulated_pass(Truth(), rng, images=1, points=9).images[0]
    assert isinstance(image.observed, LimbPoints)
    model, limb = MODEL, measured(image.observed, image)
    covariance = np.array([[4.0, 0.3], [0.3, 0.5]])
    known = ModelUncertainty(
        estimated=("fx_px", "cy_px"), covariance=covariance, residual_sigma_px=0.1, n_observations=9, n_images=1
    )
    by_camera = 1e-7 * rng.normal(size=(3, len(model.parameter_names)))
    errors = AttitudeErrors(by_camera=by_camera)
    shifts = LimbPoints.of(limb, model, image.observed.figure, known, errors).shared_px["camera"]
    root, rays = covariance_root(covariance), model.unproject(limb.observed_px)
    assert_allclose(root @ root, covariance, rtol=0, atol=1e-12)
    for column, change in enumerate(root.T):
        other = replace(model, fx_px=model.fx_px + change[0], cy_px=model.cy_px + change[1])
        turn = Rotation.from_rotvec(by_camera[:, [0, 3]] @ change)
        moved = other.project(turn.apply(rays)) - limb.observed_px
        assert_allclose(shifts[:, column], np.einsum("ni,ni->n", moved, limb.normals_px), rtol=0, atol=1e-5)


def measured(limb: LimbPoints, image: PassImage) -> LimbMeasurement:
    """Points as a scan returns them."""
    arms = limb.points_px - limb.model.project(image.position_camera_km)
    count = limb.size
    return LimbMeasurement(
        predicted_px=limb.points_px,
        normals_px=arms / np.linalg.norm(arms, axis=1)[:, None],
        design=np.zeros((count, 3)),
        shift_px=np.zeros(count),
        sigma_px=limb.sigma_px,
        keep=np.ones(count, dtype=bool),
        common_px={},
        smooth_errors=(),
        position_camera_km=image.position_camera_km,
        spacing_px=1.0,
        perimeter_px=1.0,
        cut_by_frame=False,
        rejected={},
        area=np.zeros((1, 1), dtype=bool),
    )


def replace_limb(limb: LimbPoints, shared: dict[str, Float]) -> LimbPoints:
    return LimbPoints(
        points_px=limb.points_px, sigma_px=limb.sigma_px, model=limb.model, figure=limb.figure, shared_px=shared
    )


@pytest.mark.parametrize("limb", [True, False])
def test_derivatives_by_the_errors_of_an_image_are_the_numerical_ones(limb: bool) -> None:
    rng = np.random.default_rng(12)
    truth = Truth(altitude_km=ASSUMED_ALTITUDE_KM)
    given = simulated_pass(truth, rng, images=2, points=12)
    image = given.images[1] if limb else as_positions(given, truth, rng).images[1]
    observed = image.observed
    if isinstance(observed, LimbPoints):
        observed = replace_limb(observed, {"psf": rng.normal(size=(observed.size, 2))})
    else:
        observed = MeasuredPosition(
            position_camera_km=observed.position_camera_km,
            covariance_camera_km2=observed.covariance_camera_km2,
            radius_km=observed.radius_km,
            apparent_radius_px=observed.apparent_radius_px,
            shared_km={"psf": rng.normal(size=(3, 2))},
        )
    units = np.array([1e-5] * 3 + [1.0] * 3 + [1.0, 0.1, 0.1, 0.1])  # rad, km, km, px, sigmas: about 0.1 px each

    def residuals(scaled: Float) -> Float:
        return -observed.effects(image.position_camera_km, ASSUMED_ALTITUDE_KM, scaled * units)[0]

    _, design = observed.effects(image.position_camera_km, ASSUMED_ALTITUDE_KM, np.zeros(10))
    expected = numerical_jacobian(residuals, np.zeros(10), 0.1)
    # Residuals are some 0.2 px: the derivative is taken where the point is, not at the foot on the limb.
    assert np.all(np.abs(design * units - expected) < 1e-4 * np.abs(expected).max(axis=0))


def test_wrong_input_is_refused_with_a_remedy() -> None:
    given = simulated_pass(Truth(), np.random.default_rng(13), images=3)
    with pytest.raises(InputError, match="one sensor"):
        estimate_pass(given, PassOptions(estimate={PassTerm.INTERLOCK: 1.0}))
    same = replace(given, images=tuple(replace(image, exposure_s=1e-3) for image in given.images))
    with pytest.raises(InputError, match="all images have the exposure"):
        estimate_pass(same, usual())
    unknown = replace(given, images=tuple(replace(image, exposure_s=math.nan) for image in given.images))
    with pytest.raises(InputError, match="image 0, image 1"):
        estimate_pass(unknown, usual())
    with pytest.raises(InputError, match="both name limb_altitude"):
        PassOptions(estimate={PassTerm.LIMB_ALTITUDE: 1.0}, consider={PassTerm.LIMB_ALTITUDE: 1.0})
    with pytest.raises(InputError, match="there is no term 'haze'"):
        PassOptions(estimate={"haze": 1.0})  # type: ignore[dict-item]
    with pytest.raises(InputError, match="must have 6 columns"):
        NavigationPass(images=given.images, covariance_trajectory=np.eye(6))
    with pytest.raises(InputError, match="first guess"):
        PassOptions(estimate_jitter=True)
    with pytest.raises(InputError, match="at least one image"):
        NavigationPass(images=())
