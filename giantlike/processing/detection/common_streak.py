"""Streaks that all stars of an image share: recognized, and measured one by one.

A camera that turns during the exposure draws every star into a line of one direction and length. Bright elongated
sources are fitted as lines; where most of them agree, that line is what the image is filtered for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask
from giantlike.processing.detection.centroid import MIN_PSF_SIGMA_PX, Patches, border_level, cut_patches
from giantlike.processing.detection.matched_filter import recorded_width_px
from giantlike.processing.detection.streak import LineFits, fit_lines

_LOOKED_AT = 24
_LEAST_AGREEING, _AGREEING_SHARE = 4, 0.6
_AGREE_RELATIVE, _AGREE_PX = 0.15, 0.7
_SHORTEST_PX, _SHORTEST_WIDTHS = 2.5, 2.5
_HALF_PATCH_PX = 32  # streaks up to about twice this are recognized
_QUICK_HALF_PX = 5
_POWER_SIGMAS = 5.0
_QUICK_LONG = 0.55  # of the longest axis: points of up to 1 px give 0.5 and less
_MOMENT_SIGMAS = 3.0
_WIDTHS = (0.5, 0.65, 0.8, 1.0, 1.25, 1.6, 2.0, 2.5)
_USUAL_WIDTH, _FOR_WIDTH = 1.0, 8


@dataclass(frozen=True, slots=True, kw_only=True)
class CommonStreak:
    """Line that the stars of an image are drawn into.

    Parameters
    ----------
    half_px : (float, float), px
        From the middle to one end.
    sigma_px : float, px
        Width of the point spread function across it.
    """

    half_px: tuple[float, float]
    sigma_px: float


def find_common_streak(
    pixels: NDArray[np.generic],
    bad: Mask | None,
    peaks_px: NDArray[np.int64],
    *,
    noise_dn: Float,
    psf_sigma_px: float | None,
    gain_e_per_dn: float,
    saturation_dn: float,
) -> CommonStreak | None:
    """Line that most of the brightest sources agree on; None where they are points or do not agree.

    Parameters
    ----------
    pixels : (rows, columns) real, DN
    bad : (rows, columns) bool or None
    peaks_px : (n, 2) int64, px
        One peak of each source, the most significant first.
    noise_dn : (n,) float64, DN
    psf_sigma_px : float, px, optional
        By default the width that explains the brightest streaks best.
    gain_e_per_dn, saturation_dn : float
    """
    peaks_px, noise_dn = peaks_px[:_LOOKED_AT], noise_dn[:_LOOKED_AT]
    if len(peaks_px) < _LEAST_AGREEING or not _mostly_long(pixels, bad, peaks_px):
        return None
    patches = cut_patches(pixels, bad, peaks_px, _HALF_PATCH_PX, saturation_dn)
    guess = _moments(patches, noise_dn)
    width = recorded_width_px(1.0 if psf_sigma_px is None else psf_sigma_px)
    long = 2.0 * np.hypot(*guess.halves_px.T) > max(_SHORTEST_PX, _SHORTEST_WIDTHS * width) / 2.0
    if np.count_nonzero(long) < max(_LEAST_AGREEING, _AGREEING_SHARE * len(peaks_px)):
        return None
    chosen = np.flatnonzero(long)
    patches, guess, noise_dn = patches.select(chosen), guess.select(chosen), noise_dn[chosen]
    half = math.ceil(float(np.hypot(*guess.halves_px.T).max()) + 5.0 * width) + 2
    if half < _HALF_PATCH_PX:
        middle = np.rint(guess.centers_px).astype(np.int64)
        patches = cut_patches(pixels, bad, middle, half, saturation_dn)
    known = None if psf_sigma_px is None else max(psf_sigma_px, MIN_PSF_SIGMA_PX)
    first = _fitted(patches, guess, noise_dn, known or _USUAL_WIDTH, gain_e_per_dn)
    agreed = _agreed(first, len(peaks_px), known or _USUAL_WIDTH)
    if agreed is None or known is not None:
        return agreed
    few = np.arange(min(_FOR_WIDTH, len(guess.flux_dn)))
    sigma = _width(patches.select(few), guess.select(few), noise_dn[few], gain_e_per_dn)
    return _agreed(_fitted(patches, guess, noise_dn, sigma, gain_e_per_dn), len(peaks_px), sigma)


def _width(patches: Patches, guess: _Guess, noise_dn: Float, gain_e_per_dn: float) -> float:
    """Width, px, that explains lines best: vertex of the parabola through three values, in its logarithm."""
    left = [float(np.median(_fitted(patches, guess, noise_dn, sigma, gain_e_per_dn).chi2)) for sigma in _WIDTHS]
    best = int(np.argmin(left))
    if not 0 < best < len(_WIDTHS) - 1:
        return _WIDTHS[best]
    x = np.log(_WIDTHS[best - 1 : best + 2])
    second, first, _ = np.polyfit(x, left[best - 1 : best + 2], 2)
    return float(np.exp(-first / (2.0 * second))) if second > 0 else _WIDTHS[best]


def measure_streaks(
    patches: Patches, *, streak: CommonStreak, flux_dn: Float, noise_dn: Float, gain_e_per_dn: float
) -> LineFits:
    """Fit a line to each patch, starting in its middle with the direction and length of the image."""
    n = len(flux_dn)
    middle = (patches.corner_px + patches.half_px).astype(np.float64)
    guess = _Guess(middle, np.tile(np.array(streak.half_px), (n, 1)), flux_dn, _level(patches))
    return _fitted(patches, guess, noise_dn, streak.sigma_px, gain_e_per_dn)


def unexplained_power(patches: Patches, fits: LineFits, shares: Float, noise_dn: Float) -> Float:
    """Share (n,) of the power of the light in each patch that its line leaves over, noise taken off; at least 0."""
    light = np.where(patches.valid & ~patches.saturated, patches.values_dn - fits.background_dn[:, None, None], 0.0)
    left = np.where(light != 0.0, light - fits.flux_dn[:, None, None] * shares, 0.0)
    noise = noise_dn**2 * fits.n_pixels
    spread = _POWER_SIGMAS * noise_dn**2 * np.sqrt(2.0 * fits.n_pixels)
    rest, whole = (np.sum(values**2, axis=(1, 2)) - noise for values in (left, light))
    result: Float = np.maximum(rest - spread, 0.0) / np.maximum(whole, 1e-300)
    return result


def _mostly_long(pixels: NDArray[np.generic], bad: Mask | None, peaks_px: NDArray[np.int64]) -> bool:
    """Whether sources are longer than points: a quick look, before lines are fitted."""
    patches = cut_patches(pixels, bad, peaks_px, _QUICK_HALF_PX)
    axis = patches.longest_axis(peaks_px.astype(np.float64), border_level(patches), 1.0)
    return float(np.median(axis)) > _QUICK_LONG


@dataclass(frozen=True, slots=True)
class _Guess:
    centers_px: Float
    halves_px: Float
    flux_dn: Float
    background_dn: Float

    def select(self, which: NDArray[np.integer]) -> _Guess:
        return _Guess(self.centers_px[which], self.halves_px[which], self.flux_dn[which], self.background_dn[which])


def _fitted(patches: Patches, guess: _Guess, noise_dn: Float, sigma_px: float, gain_e_per_dn: float) -> LineFits:
    return fit_lines(
        patches,
        centers_px=guess.centers_px,
        halves_px=guess.halves_px,
        flux_dn=guess.flux_dn,
        background_dn=guess.background_dn,
        noise_dn=noise_dn,
        sigma_px=sigma_px,
        gain_e_per_dn=gain_e_per_dn,
    )


def _level(patches: Patches) -> Float:
    """Median (n,) of the valid pixels of each patch."""
    values = np.where(patches.valid, patches.values_dn, np.nan).reshape(len(patches.valid), -1)
    result: Float = np.nanmedian(values, axis=1)
    return result


def _moments(patches: Patches, noise_dn: Float) -> _Guess:
    """Middle, direction and length of what hangs together with the middle of each patch, from its moments."""
    n, half = len(noise_dn), patches.half_px
    level = _level(patches)
    centers, halves, flux = np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n)
    for k in range(n):
        light = np.where(patches.valid[k], patches.values_dn[k] - level[k], 0.0)
        smooth = cv2.GaussianBlur(light, (0, 0), 1.0)
        lit = (smooth > _MOMENT_SIGMAS * 0.3 * noise_dn[k]) & (smooth > 0.15 * smooth[half, half])
        _, labels = cv2.connectedComponents(lit.astype(np.uint8), connectivity=8)
        y, x = np.nonzero(labels == labels[half, half]) if lit[half, half] else (np.array([half]), np.array([half]))
        weight = np.maximum(light[y, x], 0.0) + 1e-12
        total = float(weight.sum())
        mean = np.array([weight @ x, weight @ y]) / total
        away = np.stack([x, y], axis=1) - mean
        values, vectors = np.linalg.eigh((away * weight[:, None]).T @ away / total)
        centers[k] = patches.corner_px[k] + mean
        halves[k] = math.sqrt(max(3.0 * (values[1] - values[0]), 0.0)) * vectors[:, 1]
        flux[k] = total
    return _Guess(centers, halves, flux, level)


def _agreed(fits: LineFits, n_sources: int, sigma_px: float) -> CommonStreak | None:
    """Median of the lines, where enough of them agree; directions are compared at twice their angle."""
    good = fits.converged & (fits.lengths_px > max(_SHORTEST_PX, _SHORTEST_WIDTHS * recorded_width_px(sigma_px)))
    if np.count_nonzero(good) < _LEAST_AGREEING:
        return None
    half = fits.halves_px[good]
    length, angle = np.hypot(*half.T), np.arctan2(half[:, 1], half[:, 0])
    doubled = length[:, None] * np.stack([np.cos(2.0 * angle), np.sin(2.0 * angle)], axis=1)
    typical = np.median(doubled, axis=0)
    size = float(np.hypot(*typical))
    near = np.hypot(*(doubled - typical).T) < 2.0 * _AGREE_RELATIVE * size + _AGREE_PX
    if np.count_nonzero(near) < max(_LEAST_AGREEING, _AGREEING_SHARE * n_sources):
        return None
    typical = np.median(doubled[near], axis=0)
    size, turn = float(np.hypot(*typical)), 0.5 * math.atan2(typical[1], typical[0])
    return CommonStreak(half_px=(size * math.cos(turn), size * math.sin(turn)), sigma_px=sigma_px)
