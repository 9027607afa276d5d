"""Size of a body by the area of its light, above several levels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float
from giantlike.relative.light.law_mixture import LawFit, LawMixture
from giantlike.relative.light.separation import LIGHT_SIGMAS, BodyLight

_INCONSISTENT_SIGMAS = 4.0  # between predicted and measured size: once in 16,000 by chance
_COUNT_PX = 0.5
"""Error of each pixel along the edge of the lit area, px: 0.3 as it is counted or not, and noise where light fades."""
_EDGE_PX = 0.05
"""Error of the edge at each level, px, besides: by the rays of the template and the shape of the point spread function.
Twice as much leaves the errors of exact bodies and makes their sigmas a seventh larger."""
_TOP = 0.3
"""Share of the brightest pixel up to which areas are counted: above, they are those of the law."""
_WIDTH_SIGMA = 0.1
"""Relative error of the width of the point spread function, which moves the edge at faint levels and hardly at bright
ones. Sizes of bodies of 120 px whose width is told 30 % off are 0.19, 0.22, 0.34 and 0.35 % wrong at phases of 15, 60,
90 and 125 degrees; 0.12, 0.15, 0.22 and 0.29 % with 0.15, but then sigmas of exact bodies are a third larger; and 0.6
to 1.7 % by the faintest level alone."""
_FADE = 0.02
"""Relative error of the brightness along the terminator, beside that of the law found: it moves the edge there."""
_HEIGHT = 0.1
"""Height, over the radius, of relief with slopes of one radian: markings of a quarter of the radius may be slopes of
waves of half of it, which are 1 / 4 pi as high."""
_UNKNOWN = 0.1
"""Relative error of the size before it is measured: larger than any that is searched."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LitSize:
    """Size of the body in the image: ``scale`` times its prediction, with a relative ``sigma``.

    ``excess`` is the difference of measured and predicted size over the largest that is consistent, and ``area_ratio``
    the lit area over that expected.
    """

    scale: float
    sigma: float
    area_ratio: float
    excess: float


def first_scale(light: BodyLight, laws: LawMixture, *, range_sigma: float, trace: float) -> float:
    """Size over that predicted, under the law assumed, by the faintest level; 1 where they are not consistent."""
    level = _faintest_dn(light, trace)
    seen, own = _areas(light.signal_dn[light.region], level), _areas(light.expected_dn(laws.own.brightness), level)
    scale = math.sqrt(float(seen[0] / own[0]))
    return scale if abs(math.log(scale)) < _INCONSISTENT_SIGMAS * range_sigma else 1.0


def measured_size(
    light: BodyLight,
    laws: LawMixture,
    law: LawFit,
    *,
    range_sigma: float,
    trace: float,
    psf_sigma_px: float,
    radius_px: float,
) -> LitSize:
    """Size by areas under the law found, on which the faint ones depend little, and size predicted.

    ``range_sigma``, ``trace`` as for :func:`first_scale`.

    Notes
    -----
    A point spread function that is wider by a share e moves the edge at a level by ``e`` times its width times the
    normal quantile of the level over that of the limb: sizes at levels from the faintest up to a third of the peak
    give size and width together.
    """
    from scipy.special import ndtri

    level, signal = _faintest_dn(light, trace), light.signal_dn[light.region]
    expected = light.expected_dn(laws.at(law.shares).brightness)
    peak = float(expected.max())
    levels = level * np.exp2(np.arange(max(math.ceil(math.log2(_TOP * peak / level)), 1), dtype=np.float64))
    seen, own = _areas(signal, levels), _areas(expected, levels)
    width_px = 0.5 * math.pi * radius_px / own  # of the size, relative, by that of the edge of the lit side
    variance = _counted(own) ** 2 + (_EDGE_PX * width_px) ** 2
    variance += (0.5 * math.hypot(_FADE, law.sigma) * (1.0 - own / own[0])) ** 2
    by_width = psf_sigma_px * width_px * ndtri(1.0 - np.minimum(levels / peak, 0.5))
    design = np.stack([np.ones_like(levels), by_width], axis=1)
    sizes, information = 0.5 * np.log(seen / own), np.diag([_UNKNOWN**-2.0, _WIDTH_SIGMA**-2.0])
    covariance = np.linalg.inv((design / variance[:, None]).T @ design + information)
    found = covariance @ (design.T @ (sizes / variance))
    left = float(np.sum((sizes - design @ found) ** 2 / variance)) / max(len(levels) - 2, 1)
    log_size = float(found[0])
    # Birge's ratio: sizes that are unlikely together, of levels or as predicted, are less certain than they say.
    own_variance = float(covariance[0, 0]) * max(left, 1.0) + (_HEIGHT * law.markings) ** 2
    ratio = float(seen[0] / own[0])
    excess = abs(log_size) / (_INCONSISTENT_SIGMAS * math.sqrt(range_sigma**2 + own_variance))
    if excess > 1.0:  # halo, or another body
        return LitSize(scale=1.0, sigma=range_sigma, area_ratio=ratio, excess=excess)
    weight = range_sigma**2 / (range_sigma**2 + own_variance)
    sigma = math.sqrt(weight * own_variance) * max(1.0, _INCONSISTENT_SIGMAS * excess)
    return LitSize(scale=math.exp(weight * log_size), sigma=sigma, area_ratio=ratio, excess=excess)


def _faintest_dn(light: BodyLight, trace: float) -> float:
    """A share ``trace`` of the peak, or what the noise allows, DN."""
    return max(LIGHT_SIGMAS * light.sky.sigma_dn, trace * float(light.signal_dn[light.region].max()))


def _areas(signal_dn: Float, levels_dn: Float | float) -> Float:
    """Pixels (n,) above levels (n,), at least 1."""
    faintest = np.min(levels_dn)
    ordered = np.sort(signal_dn[signal_dn > faintest])
    counts = ordered.size - np.searchsorted(ordered, np.atleast_1d(levels_dn), side="right")
    return np.maximum(counts, 1).astype(np.float64)


def _counted(areas_px: Float) -> Float:
    """Relative error of the size of lit areas that are counted in pixels."""
    return np.asarray(0.5 * _COUNT_PX * np.sqrt(2.0 * np.sqrt(math.pi * areas_px)) / areas_px)
