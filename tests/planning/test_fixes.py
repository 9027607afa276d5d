"""Predicted signals and fixes, against images by ``giantlike.independent``; and the choice of images."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks.planning import CAMERA, EXPOSURES_S, TRUTH, candidates, compare, scene
from giantlike.core.causes import Cause, sum_parts
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Reason
from giantlike.core.time import time_from_et
from giantlike.planning import OrbitPrior, Plan, PlanOptions, SelectOptions, plan_images
from giantlike.planning.selection import Measurement, choose_images

IMAGES, ESTIMATOR = 8, "cross_correlation"
OPTIONS = PlanOptions(exposures_s=EXPOSURES_S, estimators=(ESTIMATOR,), draws=4, seed=3, truth=TRUTH)


@pytest.fixture(scope="module")
def plan() -> Plan:
    several = candidates(IMAGES, 3, diameters_px=(34.0, 46.0))
    apart = [replace(one, epoch=time_from_et(7e8 + 600.0 * number)) for number, one in enumerate(several)]
    made = plan_images(apart, CAMERA, scene(), None, OPTIONS)
    assert isinstance(made, Plan)
    return made


def test_fixes_of_independent_images_are_as_predicted(plan: Plan) -> None:
    found = compare(plan, range(IMAGES), 100)["fixes"][ESTIMATOR]
    assert found["failed"] <= 0.25
    assert 0.6 <= found["predicted"][0] <= 1.6  # the noise of 8 stated sigmas; benchmarks/planning.py has the figures
    assert 0.2 <= found["nees_predicted"] <= 2.2
    assert found["brier"] < 0.2


def test_a_forecast_has_its_causes_and_the_number_of_draws(plan: Plan) -> None:
    for image in plan.images:
        fix = image.fixes[ESTIMATOR]
        assert fix.draws == OPTIONS.draws
        assert fix.covariance is not None
        assert_allclose(sum_parts(fix.parts), fix.covariance)
        assert {Cause.NOISE, Cause.SHAPE_SCALE} <= set(fix.parts)
        assert 0.0 < fix.failure_probability < 1.0
        assert_allclose(math.sqrt(fix.parts[Cause.SHAPE_SCALE][2, 2]), 0.004, rtol=0.2)  # as declared, of the range


def test_the_exposure_fills_the_well_without_saturation(plan: Plan) -> None:
    full_dn = CAMERA.detector.saturation_dn - CAMERA.detector.bias_dn
    for image in plan.images:
        assert image.light is not None
        low, middle, high = image.light.quantiles_dn
        assert 0.55 * full_dn <= high <= 0.8 * full_dn  # exposures are 26 % apart
        assert low < middle < high
        assert image.light.saturated == 0.0
        assert image.light.snr > image.light.snr_peak > 50.0
    moving = PlanOptions(exposures_s=(1.0,), estimators=(), min_snr=1e7)
    faint = plan_images([plan.images[0].candidate], CAMERA, scene(), None, moving)
    assert getattr(faint, "reason", None) is Reason.NO_SIGNAL


def test_without_a_zero_point_there_are_no_signals_and_no_fixes() -> None:
    dark = plan_images(candidates(1, 3), replace(CAMERA, photometry=None), scene(), None, OPTIONS)
    assert isinstance(dark, Plan)
    assert dark.images[0].failure is None
    assert dark.images[0].light is None
    assert dark.images[0].fixes == {}
    with pytest.raises(InputError, match="no image has a predicted fix of cross_correlation"):
        dark.select(1)


def test_chosen_images_keep_their_gap_and_gain_less_and_less(plan: Plan) -> None:
    best = plan.select(4, SelectOptions(min_gap_s=1000.0))
    times = [image.candidate.image().et or 0.0 for image in best.images]
    assert len(best.images) == 4
    assert np.diff(times).min() >= 1000.0
    assert np.isfinite(best.gain).all()
    assert best.gain.min() > 0.0
    assert best.orbit_covariance is not None
    larger = plan.select(8).orbit_covariance
    assert larger is not None
    assert np.linalg.det(larger[:3, :3]) < np.linalg.det(best.orbit_covariance[:3, :3])


def _measurements(seed: int, count: int) -> tuple[list[Measurement], OrbitPrior]:
    rng, found = np.random.default_rng(seed), []
    for et in np.sort(rng.uniform(0.0, 8e4, count)):
        sight, partials = rng.normal(size=(3, 3)) * [[5.0], [5.0], [2e-3]], np.zeros((3, 7))
        partials[:, :3], partials[:, 3:6], partials[2, 6] = sight, et * sight, 5e-3
        covariance = np.diag(np.append(rng.uniform(0.05, 1.0, 2), 1e-3) ** 2)
        found.append(Measurement(et=et, partials=partials, covariance=covariance, weight=rng.uniform(0.3, 1.0)))
    prior = OrbitPrior(et=0.0, state=np.ones(6), covariance=np.diag(np.repeat([10.0, 1e-3], 3) ** 2))
    return found, prior


@pytest.mark.parametrize("seed", range(3))
def test_four_chosen_images_gain_nearly_as_much_as_the_best_four(seed: int) -> None:
    measurements, prior = _measurements(seed, 12)
    _, gains, covariance = choose_images(measurements, 4, prior, 0.0)
    best = max(
        sum(choose_images([measurements[k] for k in some], 4, prior, 0.0)[1]) for some in combinations(range(12), 4)
    )
    assert sum(gains) >= 0.95 * best
    assert_allclose(sum(gains), 0.5 * np.log(np.linalg.det(prior.covariance) / np.linalg.det(covariance)), rtol=1e-6)


def test_the_orbit_covariance_is_that_of_drawn_fits() -> None:
    measurements, prior = _measurements(5, 6)
    measurements = [replace(one, weight=1.0) for one in measurements]
    _, _, covariance = choose_images(measurements, 6, prior, 0.0)
    rng, errors = np.random.default_rng(1), []
    rows = np.concatenate([np.linalg.solve(np.linalg.cholesky(one.covariance), one.partials) for one in measurements])
    stiff = np.concatenate([rows, np.diag(np.append(np.diag(prior.covariance) ** -0.5, 1.0))])
    for _ in range(300):
        truth = rng.standard_normal(7) * np.append(np.sqrt(np.diag(prior.covariance)), 1.0)
        values = np.append(rows @ truth + rng.standard_normal(len(rows)), np.zeros(7))
        errors.append((np.linalg.lstsq(stiff, values, rcond=None)[0] - truth)[:6])
    assert_allclose(np.std(errors, axis=0), np.sqrt(np.diag(covariance)), rtol=0.13)  # 3 sigma of 300 draws
