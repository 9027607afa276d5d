"""Bodies that moved in the image during the exposure: the motion is found, and they lie where it had its middle."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import shift as translated
from scipy.stats import chi2

from giantlike.core.findings import Smear
from giantlike.core.outcomes import Quality
from giantlike.relative.template.cross_correlation import CrossCorrelation
from tests.relative.light.test_light_truth import shot
from tests.sizes import slow
from tests.tolerances import RARE

SEEDS = (1, 2, 3)
DIAMETER_PX = 90.0
SIGMA_PX = (
    0.02  # of the image without motion 0.01; 0.1 to 0.2 px were stated where the motion was an error of the model
)
LENGTH_PX, ANGLE_RAD = 0.3, 0.1
ROUNDED_PX2 = 1e-12


@pytest.mark.monte_carlo(few=1, full=3)
@pytest.mark.parametrize("length_px", [slow(2.5), 5.0, slow(12.0)])
def test_bodies_in_motion_are_placed_as_well_as_others_and_tell_how_they_moved(length_px: float, draws: int) -> None:
    total = 0.0
    for seed in SEEDS[:draws]:
        angle = 0.9 * seed
        motion_px = (length_px * math.cos(angle), length_px * math.sin(angle))
        one = shot(seed, phase_deg=30.0 * seed, diameter_px=DIAMETER_PX, motion_px=motion_px)
        fix = one.fix(CrossCorrelation())
        assert not fix.flags.suspect, fix.flags
        assert np.sqrt(np.diag(fix.covariance_px2)).max() < SIGMA_PX
        error = fix.center_px - one.center_px
        total += float(error @ np.linalg.solve(fix.covariance_px2, error))
        smear = fix.corrections.smear
        assert smear
        assert smear.length_px == pytest.approx(length_px, abs=LENGTH_PX)
        along = smear.direction[0] * math.cos(angle) + smear.direction[1] * math.sin(angle)
        assert abs(along) > math.cos(ANGLE_RAD)
    assert total < chi2.ppf(1.0 - RARE, 2 * draws)


@pytest.mark.parametrize("law", ["mcewen", slow("hapke"), slow("lambert")])
def test_bodies_at_rest_have_no_smear(law: str) -> None:
    for marked in (False, True):
        fix = shot(4, law=law, diameter_px=DIAMETER_PX, marked=marked).fix(CrossCorrelation())
        assert fix.corrections.smear is None


def test_a_point_becomes_a_line_with_the_variance_that_is_stated() -> None:
    smear = Smear(straight_px2=(6.0**2 - 3.0**2) / 24.0, oblique_px2=-6.0 * 3.0 / 12.0)
    y, x = np.mgrid[-20:21, -20:21]
    spot = np.exp(-0.5 * (x**2 + y**2) / 1.5**2)
    line, spot = smear.blur(spot) / spot.sum(), spot / spot.sum()
    found = [float(((line - spot) * product).sum()) for product in (x * x, x * y, y * y)]
    assert float(line.sum()) == pytest.approx(1.0, abs=1e-7)
    np.testing.assert_allclose(found, smear.blur_px2, rtol=0, atol=1e-5)
    np.testing.assert_allclose(smear.blur_px2, [36.0 / 12.0, -18.0 / 12.0, 9.0 / 12.0], rtol=0, atol=ROUNDED_PX2)


@pytest.mark.parametrize("share", [0.5, 0.3])
def test_two_points_have_the_variance_of_the_line(share: float) -> None:
    smear = Smear(straight_px2=(6.0**2 - 3.0**2) / 24.0, oblique_px2=-6.0 * 3.0 / 12.0)
    y, x = np.mgrid[-30:31, -30:31]
    spot = np.exp(-0.5 * (x**2 + y**2) / 2.0**2)
    pair, spot = smear.blur_double_exposure(spot, share) / spot.sum(), spot / spot.sum()
    found = [float(((pair - spot) * product).sum()) for product in (x, y, x * x, x * y, y * y)]
    np.testing.assert_allclose(found, [0.0, 0.0, *smear.blur_px2], rtol=0, atol=1e-5)


def test_two_exposures_a_few_pixels_apart_are_no_motion() -> None:
    one = shot(1, diameter_px=DIAMETER_PX)
    pixels = one.image.pixels.astype(np.float64)
    twice = 0.5 * (pixels + translated(pixels, (4.4, 3.3), order=3, mode="nearest"))
    fix = replace(one, image=replace(one.image, pixels=np.round(twice).astype(np.int32))).fix(CrossCorrelation())
    assert fix.corrections.smear
    assert Quality.UNEXPLAINED_LIGHT in fix.flags, fix.findings.checks


def test_a_smear_is_half_as_long_on_blocks_of_two_pixels() -> None:
    smear = Smear(straight_px2=-0.25, oblique_px2=1.5)
    assert smear.on_blocks(2.0).length_px == pytest.approx(0.5 * smear.length_px, abs=ROUNDED_PX2)
