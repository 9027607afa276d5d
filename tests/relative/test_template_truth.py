"""Template fits on images of the independent renderer: what a template lacks is fitted or stands in the covariance."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import chi2

from giantlike.core.arrays import Float
from giantlike.core.outcomes import PositionFix
from giantlike.relative.estimator import place_covariance
from giantlike.relative.template.cross_correlation import CrossCorrelation
from tests.relative.test_light_truth import light, shot
from tests.tolerances import RARE

SEEDS = (1, 2, 3)
DIAMETER_PX = 110.0
PLANE_DN = (200.0, 100.0)  # DN over the frame
SPAN_PX, SPAN_RANGE = 0.05, 5e-4  # where a law in the span of the model is told wrong: a few sigma
PLANE_PX = 0.06  # four sigma of the noise of the sky; the plane pulls ten times as far where it is not modeled


def errors(seed: int, law: str, phase_deg: float, slope_dn: tuple[float, float] = (0.0, 0.0)) -> tuple[Float, Float]:
    """Errors (3,) of x, y in px and of the logarithm of the range, and their stated covariance."""
    one = shot(seed, law=law, phase_deg=phase_deg, diameter_px=DIAMETER_PX, slope_dn=slope_dn)
    fix = one.fix(CrossCorrelation())
    assert isinstance(fix, PositionFix)
    assert not fix.flags.suspect, fix.flags
    _, pose = light(seed, law, phase_deg, DIAMETER_PX, False, 0.0)
    log_range = math.log(fix.range_km / float(np.linalg.norm(pose.position_camera_km)))
    covariance = place_covariance(one.camera.model, fix.position_camera_km, fix.covariance_camera_km2)
    return np.array([*(fix.center_px - one.center_px), log_range]), covariance


def assert_honest(results: list[tuple[Float, Float]]) -> None:
    total = sum(float(error @ np.linalg.solve(covariance, error)) for error, covariance in results)
    assert total < chi2.ppf(1.0 - RARE, 3 * len(results)), [error for error, _ in results]


@pytest.mark.parametrize("phase_deg", [15.0, 90.0])
def test_a_sloping_background_pulls_neither_center_nor_range(phase_deg: float) -> None:
    results = [errors(seed, "mcewen", phase_deg, PLANE_DN) for seed in SEEDS]
    assert max(float(np.abs(error[:2]).max()) for error, _ in results) < PLANE_PX
    assert_honest(results)


@pytest.mark.parametrize(("law", "phase_deg"), [("lambert", 15.0), ("lommel_seeliger", 60.0)])
def test_a_law_within_the_mixture_is_found_as_if_it_were_told(law: str, phase_deg: float) -> None:
    results = [errors(seed, law, phase_deg) for seed in SEEDS]
    worst = np.abs([error for error, _ in results]).max(axis=0)
    assert worst[:2].max() < SPAN_PX
    assert worst[2] < SPAN_RANGE
    assert_honest(results)


@pytest.mark.parametrize(("law", "phase_deg"), [("hapke", 110.0), ("minnaert", 60.0)])
def test_the_covariance_counts_a_law_beyond_the_mixture(law: str, phase_deg: float) -> None:
    assert_honest([errors(seed, law, phase_deg) for seed in SEEDS])
