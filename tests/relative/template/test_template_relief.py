"""Crescents with relief that their template lacks: analytic images, relief by waves drawn around the body."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.stats import chi2

from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.pixel_box import BoxPixels
from giantlike.relative.template.fit import TemplateFit, TemplateFitOptions, fit_template
from giantlike.relative.template.state import TemplateImages, TemplateState
from tests.tolerances import RARE

SHAPE, CORNER, RADIUS_PX = (84, 84), (50, 60), 32.0
TRUE = TemplateState(center_px=np.array([91.3, 101.6]), log_range=0.0, psf_variance_px2=0.49)
FINE = 4  # samples along a pixel
SUN = np.array([0.8, 0.6]) * math.sin(math.radians(125.0))
NOISE_DN, PEAK_DN = 5.0, 3000.0
HIGHEST = 24  # waves around the body
DRAWS = 40
CAUTIOUS = 0.25  # a third of an outline tells little of the longest waves, and they may be there


def crescent(state: TemplateState, heights: Float) -> Float:
    """Lambert's light of a ball of which relief moves all light radially; ``heights`` (n, 2) of waves 2, 3, ..."""
    x, y = (np.arange(FINE * size) / FINE - 0.5 + 0.5 / FINE for size in SHAPE[::-1])
    x, y = np.meshgrid(x + CORNER[0] - state.center_px[0], y + CORNER[1] - state.center_px[1])
    angle = np.arctan2(y, x)
    relief = sum(a * np.cos(n * angle) + b * np.sin(n * angle) for n, (a, b) in enumerate(heights, start=2))
    scale = RADIUS_PX * math.exp(-state.log_range) * (1.0 + relief)
    x, y = x / scale, y / scale
    inside = np.clip(1.0 - x**2 - y**2, 0.0, None)
    toward = math.cos(math.radians(125.0)) * np.sqrt(inside) + SUN[0] * x + SUN[1] * y
    image = np.where(inside > 0.0, np.clip(toward, 0.0, None), 0.0)
    binned = image.reshape(SHAPE[0], FINE, SHAPE[1], FINE).mean(axis=(1, 3))
    return np.asarray(gaussian_filter(binned, math.sqrt(state.psf_variance_px2)))


def rendered(state: TemplateState, fine: bool) -> TemplateImages:
    """Templates without relief; so many laws that blocks are too few for a jackknife."""
    light = crescent(state, np.zeros((1, 2)))
    return TemplateImages(light=light, others=[light**power for power in (0.5, 0.7, 1.5, 2.0)])


def fits(sigma: float, draws: int) -> list[TemplateFit]:
    """Fits to bodies with their own relief of a standard deviation, over the radius, each."""
    random, found = np.random.default_rng(5), []
    degrees = np.arange(2, HIGHEST + 1)
    shares = np.exp(-(degrees**2) / 8.0**2)
    for _ in range(draws):
        heights = sigma * np.sqrt(shares / shares.sum())[:, None] * random.normal(size=(len(degrees), 2))
        pixels = PEAK_DN * crescent(TRUE, heights) + NOISE_DN * random.normal(size=SHAPE)
        box = BoxPixels(
            values_dn=pixels,
            usable=np.ones(SHAPE, bool),
            corner_px=CORNER,
            noise_variance_dn2=lambda signal: np.full(signal.shape, NOISE_DN**2),
        )
        fit = fit_template(box, rendered, TRUE, options=TemplateFitOptions(sun_direction=(*SUN, 0.6), radius_px=32.0))
        assert isinstance(fit, TemplateFit), fit
        found.append(fit)
    return found


def squared_error(fit: TemplateFit, covariance: Float) -> float:
    error = np.array([*(fit.state.center_px - TRUE.center_px), fit.state.log_range - TRUE.log_range])
    return float(error @ np.linalg.solve(covariance, error)) / 3.0


def mean_nees(found: list[TemplateFit], *, relief: bool) -> float:
    """Mean squared error over the covariance, per degree of freedom, with the part by relief or without."""
    covariances = [fit.covariance if relief else fit.covariance - fit.parts[Cause.RELIEF] for fit in found]
    return float(np.mean([squared_error(*pair) for pair in zip(found, covariances, strict=True)]))


@pytest.mark.monte_carlo(few=8, full=DRAWS)
def test_what_a_crescent_took_up_of_relief_is_in_its_covariance(draws: int) -> None:
    found = fits(0.01, draws)
    high = float(chi2.ppf(1.0 - RARE, 3 * draws)) / (3 * draws)
    assert mean_nees(found, relief=False) > high  # residuals alone are too optimistic
    assert CAUTIOUS < mean_nees(found, relief=True) < high


def test_where_edges_are_right_no_relief_is_looked_for() -> None:
    assert all(not fit.parts[Cause.RELIEF].any() for fit in fits(0.0, draws=5))
