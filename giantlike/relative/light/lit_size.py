"""Size of a body by the area of its light, above several levels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float
from giantlike.relative.light.law_mixture import LawFit, LawMixture
from giantlike.relative.light.separation import LIGHT_SIGMAS, SeparatedLight

_INCONSISTENT_SIGMAS = 4.0  # between predicted and measured size: once in 16,000 by chance
_COUNT_PX = 0.5
"""Error of each pixel along the edge of the lit area, px: 0.3 by the discrete count, and noise where light fades."""
_EDGE_PX = 0.05
"""Additional error of the edge at each level, px, by the rays of the template and the shape of the point spread
function.
With twice as much the errors of exact bodies stay, and their sigmas are a seventh larger."""
_TOP = 0.3  # maximum level of counted areas as a fraction of the brightest pixel; above, areas depend on the law
_WIDTH_SIGMA = 0.1
"""Relative error of the width of the point spread function, which moves the edge mainly at faint levels. With a width
declared 30 % wrong, sizes of bodies of 120 px are in error by 0.19, 0.22, 0.34 and 0.35 % at phases of 15, 60, 90 and
125 degrees. With 0.15 the errors are 0.12, 0.15, 0.22 and 0.29 %, but sigmas of exact bodies a third larger; by the
faintest level alone they are 0.6 to 1.7 %."""
_FADE = 0.02
"""Relative error of the brightness along the terminator in addition to that of the law: it moves the edge there."""
_HEIGHT = 0.1
"""Height, radii, of relief with slopes of one radian: markings of a quarter of the radius may be slopes of waves of
half a radius, whose height is 1 / 4 pi of it."""
_UNKNOWN = 0.1  # A priori relative error of the size: larger than any search


@dataclass(frozen=True, slots=True, kw_only=True)
class LitSize:
    """Size of the body in the image: ``scale`` times its prediction, with a relative ``sigma``.

    ``excess`` is the ratio of the difference of measured and predicted size to the largest consistent one, and
    ``area_ratio`` the ratio of lit area to expected lit area.
    """

    scale: float
    sigma: float
    area_ratio: float
    excess: float


def first_scale(light: SeparatedLight, laws: LawMixture, *, range_sigma: float, trace: float) -> float:
    """Ratio of measured to predicted size, under the assumed law, by the faintest level; 1 if inconsistent.

    ``range_sigma``: relative, of the prediction; ``trace``: faintest level as a fraction of the brightest pixel.
    """
    level = _faintest_dn(light, trace)
    seen, own = _areas(light.signal_dn[light.region], level), _areas(light.expected_dn(laws.own.brightness), level)
    scale = math.sqrt(float(seen[0] / own[0]))
    return scale if abs(math.log(scale)) < _INCONSISTENT_SIGMAS * range_sigma else 1.0


def measured_size(
    light: SeparatedLight,
    laws: LawMixture,
    law: LawFit,
    *,
    range_sigma: float,
    trace: float,
    psf_sigma_px: float,
    radius_px: float,
) -> LitSize:
    """Size by areas under the estimated law, on which the faint ones depend little, combined with the predicted size.

    ``range_sigma``, ``trace`` as for :func:`first_scale`.

    A point spread function that is wider by a fraction e moves the edge at a level by ``e`` times its width times the
    normal quantile of the level relative to the limb: sizes at levels from the faintest up to a third of the peak give
    size and width together.
    """
    from scipy.special import ndtri

    level, signal = _faintest_dn(light, trace), light.signal_dn[light.region]
    expected = light.expected_dn(laws.at(law.shares).brightness)
    peak = float(expected.max())
    levels = level * np.exp2(np.arange(max(math.ceil(math.log2(_TOP * peak / level)), 1), dtype=np.float64))
    seen, own = _areas(signal, levels), _areas(expected, levels)
    width_px = 0.5 * math.pi * radius_px / own  # of the size, relative, by that of the edge of the lit side
    variance = _estimate_counting_error(own) ** 2 + (_EDGE_PX * width_px) ** 2
    variance += (0.5 * math.hypot(_FADE, law.sigma) * (1.0 - own / own[0])) ** 2
    by_width = psf_sigma_px * width_px * ndtri(1.0 - np.minimum(levels / peak, 0.5))
    design = np.stack([np.ones_like(levels), by_width], axis=1)
    sizes, information = 0.5 * np.log(seen / own), np.diag([_UNKNOWN**-2.0, _WIDTH_SIGMA**-2.0])
    covariance = np.linalg.inv((design / variance[:, None]).T @ design + information)
    found = covariance @ (design.T @ (sizes / variance))
    left = float(np.sum((sizes - design @ found) ** 2 / variance)) / max(len(levels) - 2, 1)
    log_size = float(found[0])
    # Birge ratio: inconsistent sizes, of levels or prediction, get larger sigmas.
    own_variance = float(covariance[0, 0]) * max(left, 1.0) + (_HEIGHT * law.markings) ** 2
    ratio = float(seen[0] / own[0])
    excess = abs(log_size) / (_INCONSISTENT_SIGMAS * math.sqrt(range_sigma**2 + own_variance))
    if excess > 1.0:  # halo, or another body
        return LitSize(scale=1.0, sigma=range_sigma, area_ratio=ratio, excess=excess)
    weight = range_sigma**2 / (range_sigma**2 + own_variance)
    sigma = math.sqrt(weight * own_variance) * max(1.0, _INCONSISTENT_SIGMAS * excess)
    return LitSize(scale=math.exp(weight * log_size), sigma=sigma, area_ratio=ratio, excess=excess)


def _faintest_dn(light: SeparatedLight, trace: float) -> float:
    """Fraction ``trace`` of the peak, or the limit by noise if larger, DN."""
    return max(LIGHT_SIGMAS * light.sky.sigma_dn, trace * float(light.signal_dn[light.region].max()))


def _areas(signal_dn: Float, levels_dn: Float | float) -> Float:
    """Pixels (n,) above levels (n,), at least 1."""
    faintest = np.min(levels_dn)
    ordered = np.sort(signal_dn[signal_dn > faintest])
    counts = ordered.size - np.searchsorted(ordered, np.atleast_1d(levels_dn), side="right")
    return np.maximum(counts, 1).astype(np.float64)


def _estimate_counting_error(areas_px: Float) -> Float:
    """Relative error of the size of lit areas that are counted in pixels."""
    return np.asarray(0.5 * _COUNT_PX * np.sqrt(2.0 * np.sqrt(math.pi * areas_px)) / areas_px)
