r"""Hot pixels and tracks of charged particles: light in a few pixels only, distinguished from stars.

Light through the optics is spread by the point spread function; charge freed by a particle in the detector, or leaking
in a pixel, is not. Two models of the pixels in the core of a source are compared:

- a star: the pixel-integrated Gaussian of the usual width at the fitted centroid, with its flux free;
- a few pixels: the k brightest ones hold any amount of light, all others none.

Each has its weighted sum of squared residuals, and each free pixel costs ``4``, the gain of picking the highest of
about eight noise values. The model of the star has an error of 8 % of its own light in every pixel (no optics are
Gaussian), so that bright stars are not rejected for their wings. A source is not a star where the residuals of the star
exceed noise and 7 % of the power of the light (real optics leave a few percent, a single pixel more than 7 % from sigma
= 0.5 px on), the residuals of the few pixels are smaller, and either

- they lie on a line: the smaller second moment of their light is at most ``0.08 + 0.3 sigma^2`` px^2, between tracks
(99th percentile: 0.14 px^2) and stars (first percentile: 0.18, 0.24, 0.46 px^2 at sigma 0.45, 0.6, 0.8);
- or the star leaves more than a quarter of the power: crossing tracks leave about a half.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value
from giantlike.processing.detection.gauss_newton import star_light
from giantlike.processing.detection.matched_filter import recorded_width_px
from giantlike.processing.detection.patches import Patches

CORE_WIDTHS = 2.0
"""Radius of the core of a source in recorded star widths, to which half a pixel is added: 86 % of the light."""
MODEL_ERROR = 0.08  # relative error of the star model in a pixel: no optics are Gaussian
_PIXEL_COST = 4.0  # of a free pixel, in chi-square: the expected square of the highest of eight noise values
_MOST_PIXELS = 12  # of a particle
_REFUSED_SIGMAS = 4.0  # excess of chi-square over its degrees of freedom, in its standard deviations
_STAR_UNKNOWNS = 4  # x, y, flux, background
_LEAST_POWER, _UNLIKE_POWER = 0.07, 0.25  # fraction of the power unexplained by a star, for lines and for other shapes
_LINE_PX2, _LINE_GROWTH, _LINE_MOST_PX2 = 0.08, 0.3, 0.4  # limit of the second moment across a line, see above; px^2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FewPixels(Value):
    """Comparison of n sources with light in a few pixels."""

    not_star: Mask  # (n,); True if light in a few pixels explains the source and a star does not
    n_pixels: NDArray[np.int64]  # (n,); number of these pixels; 0 for sources that a star explains


def core_of(patches: Patches, points_px: Float, psf_sigma_px: float) -> Mask:
    """Mask (n, w, w) of the core of the sources at ``points_px`` (n, 2)."""
    dx, dy = patches.offsets_px(points_px)
    return np.asarray((dy**2)[:, :, None] + (dx**2)[:, None, :] <= _core_radius_px(psf_sigma_px) ** 2)


def _core_radius_px(psf_sigma_px: float) -> float:
    return CORE_WIDTHS * recorded_width_px(psf_sigma_px) + 0.5


def find_few_pixels(
    patches: Patches, points_px: Float, widths_px: Float, background_dn: Float, psf_sigma_px: float
) -> FewPixels:
    """Compare a star and light in a few pixels as explanations of sources (n,)."""
    n, gain = len(points_px), patches.gain_e_per_dn
    star, used, left = _star_light(patches, points_px, widths_px, background_dn, psf_sigma_px)
    freedom = np.maximum(np.count_nonzero(used, axis=(1, 2)) - _STAR_UNKNOWNS, 1)
    refused = np.flatnonzero(left > freedom + _REFUSED_SIGMAS * np.sqrt(2.0 * freedom))
    not_star, n_pixels = np.zeros(n, dtype=bool), np.zeros(n, dtype=np.int64)
    if not refused.size:
        return FewPixels(not_star=not_star, n_pixels=n_pixels)
    some = patches.select(refused)
    light = (some.values_dn - background_dn[refused, None, None]).reshape(refused.size, -1)
    star, used = star[refused].reshape(light.shape), used[refused].reshape(light.shape)
    few, n_pixels[refused], lit = _brightest_pixels(light, used, some.noise_dn[:, None] ** 2, gain)
    x, y, xx, yy, xy = some.moments(points_px[refused], lit.reshape(some.values_dn.shape))
    xx, yy, xy = xx - x**2, yy - y**2, xy - x * y
    across = (xx + yy) / 2.0 - np.hypot((xx - yy) / 2.0, xy)  # second moment across the line through the light
    thin = across <= min(_LINE_PX2 + _LINE_GROWTH * psf_sigma_px**2, _LINE_MOST_PX2)
    unlike, all_light = (np.where(used, part**2, 0.0).sum(axis=1) for part in (light - star, light))
    not_star[refused] = (unlike > np.where(thin, _LEAST_POWER, _UNLIKE_POWER) * all_light) & (few < left[refused])
    return FewPixels(not_star=not_star, n_pixels=n_pixels)


def log_odds_of_optics(patches: Patches, points_px: Float, background_dn: Float, psf_sigma_px: float) -> Float:
    """Log likelihood ratio (n,) of light through the optics to light in a few pixels, which cost as free ones."""
    _, used, left = _star_light(patches, points_px, np.full(len(points_px), psf_sigma_px), background_dn, psf_sigma_px)
    light = (patches.values_dn - background_dn[:, None, None]).reshape(len(left), -1)
    used = used.reshape(light.shape)
    few = _brightest_pixels(light, used, patches.noise_dn[:, None] ** 2, patches.gain_e_per_dn)[0]
    return np.asarray(0.5 * (few - left))


def _star_light(
    patches: Patches, points_px: Float, widths_px: Float, background_dn: Float, psf_sigma_px: float
) -> tuple[Float, Mask, Float]:
    """Light (n, w, w) of the stars that fit best, pixels of their cores (n, w, w), and squares (n,) left."""
    return star_light(
        patches.values_dn,
        patches.valid,
        patches.saturated,
        patches.noise_dn**2,
        patches.corner_px,
        np.array(points_px),
        np.array(widths_px),
        np.array(background_dn),
        _core_radius_px(psf_sigma_px),
        patches.gain_e_per_dn,
        MODEL_ERROR,
    )


def _brightest_pixels(
    light: Float, used: Mask, floor: Float, gain_e_per_dn: float
) -> tuple[Float, NDArray[np.int64], Float]:
    """Explain sources by their brightest pixels: chi-square (n,) left, number of pixels (n,), their light (n, k)."""
    n = len(light)
    single = np.where(used, light**2 / (floor + np.maximum(light, 0.0) / gain_e_per_dn), 0.0)
    brightest = -np.sort(np.where(light > 0.0, -single, 0.0), axis=1)[:, :_MOST_PIXELS]
    explained = np.concatenate([np.zeros((n, 1)), np.cumsum(brightest - _PIXEL_COST, axis=1)], axis=1)
    n_pixels = explained.argmax(axis=1)
    least = np.take_along_axis(np.pad(brightest, ((0, 0), (1, 0)), constant_values=np.inf), n_pixels[:, None], axis=1)
    lit: Float = np.where((single >= least) & (light > 0.0), light, 0.0)
    return single.sum(axis=1) - explained.max(axis=1), n_pixels.astype(np.int64), lit
