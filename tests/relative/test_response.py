"""Images whose values are not proportional to light: the bend is found, and bodies lie where the renderer put them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from giantlike.core.detector import Detector
from giantlike.core.findings import Response
from giantlike.relative.auto import Auto
from giantlike.relative.estimator import Estimator
from giantlike.relative.horizon.ellipsoid_cra import EllipsoidCRA
from giantlike.relative.horizon.sigmoid_limb import SigmoidLimb
from giantlike.relative.light.moment import Moment
from giantlike.relative.limb.limb_matching import LimbMatching
from giantlike.relative.template.cross_correlation import CrossCorrelation
from tests.relative.light.test_light_truth import Shot, shot
from tests.sizes import slow
from tests.tolerances import RARE

SEEDS = (1, 2, 3)
DIAMETER_PX, FULL_DN = 110.0, 4000.0
SIGMA_PX = 0.05  # twice that of the image as it was; 0.1 to 0.4 px were stated where the bend was an error of the model
BEND = 0.05  # of a table of square roots; other tables are parabolas about as well


def tabled(one: Shot, exponent: float) -> Shot:
    """The image on bytes by a table of powers, and a detector told in this unit but not of the table."""
    share = np.clip(one.image.pixels / FULL_DN, 0.0, 1.0)
    values = np.round(255.0 * share**exponent).astype(np.uint8)
    detector = Detector(gain_e_per_dn=FULL_DN / 255.0, read_noise_e=5.0)
    return replace(one, image=replace(one.image, pixels=values), camera=replace(one.camera, detector=detector))


@pytest.mark.monte_carlo(few=1, full=3)
@pytest.mark.parametrize("exponent", [0.5, slow(1.0 / 2.2), slow(0.6)])
def test_bodies_on_bytes_by_a_table_are_placed_as_well_as_in_light(exponent: float, draws: int) -> None:
    total = 0.0
    for seed in SEEDS[:draws]:
        one = tabled(shot(seed, phase_deg=40.0 + 20.0 * seed, diameter_px=DIAMETER_PX), exponent)
        fix = one.fix(CrossCorrelation())
        assert not fix.flags.suspect, fix.flags
        assert np.sqrt(np.diag(fix.covariance_px2)).max() < SIGMA_PX
        error = fix.center_px - one.center_px
        total += float(error @ np.linalg.solve(fix.covariance_px2, error))
    assert total < chi2.ppf(1.0 - RARE, 2 * draws)


@pytest.mark.parametrize("seed", [1, slow(2), slow(3)])
def test_auto_gives_other_estimators_an_image_in_proportion_to_light(seed: int) -> None:
    """Limbs on the values as they are contradict the template by many sigma."""
    one = tabled(shot(seed, phase_deg=60.0, diameter_px=DIAMETER_PX), 0.5)
    fix = one.fix(Auto())
    assert not fix.flags.suspect, fix.flags
    assert fix.findings.checked_by
    assert fix.corrections.response
    error = fix.center_px - one.center_px
    assert float(error @ np.linalg.solve(fix.covariance_px2, error)) < chi2.ppf(1.0 - RARE, 2)


@pytest.mark.monte_carlo(few=1, full=3)
@pytest.mark.parametrize("estimator", [Moment(), LimbMatching(), slow(EllipsoidCRA()), slow(SigmoidLimb())])
def test_estimators_without_a_response_of_their_own_make_their_fix_again_in_light(
    estimator: Estimator, draws: int
) -> None:
    total, size = 0.0, 0
    for seed in SEEDS[:draws]:
        one = tabled(shot(seed, phase_deg=40.0 + 20.0 * seed, diameter_px=DIAMETER_PX), 0.5)
        fix = one.fix(estimator)
        assert not fix.flags.suspect, fix.flags
        assert fix.corrections.response
        assert np.sqrt(np.diag(fix.covariance_px2)).max() < (0.3 if estimator.name == "moment" else SIGMA_PX)
        error = fix.center_px - one.center_px
        total += float(error @ np.linalg.solve(fix.covariance_px2, error))
        size += 2
    assert total < chi2.ppf(1.0 - RARE, size)


def test_the_bend_of_a_table_of_square_roots_is_that_of_its_parabola() -> None:
    fix = tabled(shot(1, diameter_px=DIAMETER_PX), 0.5).fix(CrossCorrelation())
    found = fix.corrections.response
    assert found
    # Light over the sky is (v^2 - d^2) / (b^2 - d^2) of the brightest: of the square the share is (b - d) / (b + d).
    expected = (found.bright_dn - found.dark_dn) / (found.bright_dn + found.dark_dn)
    assert found.bend == pytest.approx(expected, abs=BEND)


@pytest.mark.parametrize("other", [{"seed": 1, "marked": True}, slow({"seed": 2, "law": "hapke"})])
def test_markings_and_other_laws_bend_nothing(other: dict[str, Any]) -> None:
    one = shot(diameter_px=DIAMETER_PX, **other)
    for estimator in (CrossCorrelation(), LimbMatching(), Moment()):
        assert one.fix(estimator).corrections.response is None


def test_light_and_its_derivative_by_the_bend_agree_with_differences() -> None:
    values = np.linspace(-2.0, 230.0, 40)
    low, here, high = (Response(bend=bend, dark_dn=20.0, bright_dn=220.0) for bend in (0.69999, 0.7, 0.70001))
    slope = (high.light_dn(values) - low.light_dn(values)) / 2e-5
    np.testing.assert_allclose(here.changes_dn(here.light_dn(values))[0], slope, rtol=0, atol=1e-6)
    assert np.all(np.diff(here.light_dn(values)) > 0.0)
