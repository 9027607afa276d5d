"""Common streak of the stars of an image: detection, and fits of the single streaks.

A camera that rotates during the exposure images every star as a line of one direction and length. Bright elongated
sources are fitted as lines; if most of them agree, the image is filtered for that line.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float
from giantlike.processing.detection.centroid import windowed_shape
from giantlike.processing.detection.frame import Frame
from giantlike.processing.detection.matched_filter import recorded_width_px
from giantlike.processing.detection.patches import MIN_PSF_SIGMA_PX, Patches
from giantlike.processing.detection.streak import LineFits, StreakGuesses, fit_lines

_BRIGHTEST = 24  # sources fitted to find a common streak: bounds the time
_LEAST_AGREEING, _AGREEING_SHARE = 4, 0.6  # number and fraction of these sources that must agree; not yet studied
_AGREE_RELATIVE, _AGREE_PX = 0.15, 0.7  # largest difference of lines that agree: of their length, plus px; no study yet
_SHORTEST_PX, _SHORTEST_WIDTHS = 2.5, 2.5  # shortest streak, px and widths of a star: below, a point fits as well
_HALF_PATCH_PX = 32  # half side of the first patches: streaks up to about twice this length are recognized
_QUICK_HALF_PX = 5  # half side of the patches of the quick check: the window of the moments is about 1 px wide
_POWER_SIGMAS = 5.0  # excess of the residual power over the noise that counts as unexplained
_QUICK_LONG = 0.55  # elongation above which lines are fitted: points of up to 1 px width have at most 0.5
_MOMENT_SIGMAS = 3.0  # threshold of the pixels in a moment; smoothing by 1 px leaves 0.3 of the noise
_WIDTHS = (0.5, 0.65, 0.8, 1.0, 1.25, 1.6, 2.0, 2.5)  # trial widths across a streak, px: steps of 25 %
_USUAL_WIDTH, _FOR_WIDTH = 1.0, 8  # first width, px, and number of streaks from which the width is estimated


@dataclass(frozen=True, slots=True, kw_only=True)
class CommonStreak:
    """Streak common to the stars of an image."""

    half_px: tuple[float, float]  # vector (x, y) from the middle to one end
    sigma_px: float  # width of the point spread function across it


def find_common_streak(
    frame: Frame, peaks_px: NDArray[np.int64], noise_dn: Float, psf_sigma_px: float | None
) -> CommonStreak | None:
    """Find the line that most of the brightest sources (n, 2) agree on; None where they are points or do not agree."""
    peaks_px, noise_dn = peaks_px[:_BRIGHTEST], noise_dn[:_BRIGHTEST]
    if len(peaks_px) < _LEAST_AGREEING or not _mostly_long(frame, peaks_px):
        return None
    patches = frame.patches(peaks_px, _HALF_PATCH_PX, noise_dn)
    guess = _from_moments(patches)
    width = recorded_width_px(_USUAL_WIDTH if psf_sigma_px is None else psf_sigma_px)
    long = 2.0 * np.hypot(*guess.halves_px.T) > max(_SHORTEST_PX, _SHORTEST_WIDTHS * width) / 2.0
    if np.count_nonzero(long) < max(_LEAST_AGREEING, _AGREEING_SHARE * len(peaks_px)):
        return None
    chosen = np.flatnonzero(long)
    patches, guess = patches.select(chosen), guess.select(chosen)
    half = math.ceil(float(np.hypot(*guess.halves_px.T).max()) + 5.0 * width) + 2
    if half < _HALF_PATCH_PX:
        patches = frame.patches(np.rint(guess.centers_px).astype(np.int64), half, noise_dn[chosen])
    first_sigma = _USUAL_WIDTH if psf_sigma_px is None else max(psf_sigma_px, MIN_PSF_SIGMA_PX)
    agreed = _find_common(fit_lines(patches, guess, first_sigma), len(peaks_px), first_sigma)
    if agreed is None or psf_sigma_px is not None:
        return agreed
    few = np.arange(min(_FOR_WIDTH, len(chosen)))
    sigma = _best_width_px(patches.select(few), guess.select(few))
    return _find_common(fit_lines(patches, guess, sigma), len(peaks_px), sigma)


def _best_width_px(patches: Patches, guess: StreakGuesses) -> float:
    """Width that explains lines best: vertex of the parabola through three values, in its logarithm."""
    left = [float(np.median(fit_lines(patches, guess, sigma).chi2)) for sigma in _WIDTHS]
    best = int(np.argmin(left))
    if not 0 < best < len(_WIDTHS) - 1:
        return _WIDTHS[best]
    x = np.log(_WIDTHS[best - 1 : best + 2])
    second, first, _ = np.polyfit(x, left[best - 1 : best + 2], 2)
    return float(np.exp(-first / (2.0 * second))) if second > 0 else _WIDTHS[best]


def fit_streaks(patches: Patches, streak: CommonStreak, flux_dn: Float) -> LineFits:
    """Fit a line to each patch, starting in its middle with the direction and length of the image. ``flux_dn`` (n,)."""
    halves = np.tile(np.array(streak.half_px), (len(flux_dn), 1))
    start = StreakGuesses(patches.centers_px.astype(np.float64), halves, flux_dn, _level_dn(patches))
    return fit_lines(patches, start, streak.sigma_px)


def unexplained_power(patches: Patches, fits: LineFits, shares: Float) -> Float:
    """Fraction (n,) of the power of the signal in each patch that its line, ``shares`` (n, w, w), does not explain."""
    patches = patches.subtract_slopes(fits.planes, fits.centers_px)
    light = np.where(patches.valid & ~patches.saturated, patches.values_dn - fits.background_dn[:, None, None], 0.0)
    left = np.where(light != 0.0, light - fits.flux_dn[:, None, None] * shares, 0.0)
    variance = patches.noise_dn**2
    spread = _POWER_SIGMAS * variance * np.sqrt(2.0 * fits.n_pixels)
    rest, whole = (np.sum(values**2, axis=(1, 2)) - variance * fits.n_pixels for values in (left, light))
    result: Float = np.maximum(rest - spread, 0.0) / np.maximum(whole, 1e-300)
    return result


def _mostly_long(frame: Frame, peaks_px: NDArray[np.int64]) -> bool:
    """True if sources are longer than points: a quick check, before lines are fitted."""
    patches = frame.patches(peaks_px, _QUICK_HALF_PX)
    long = windowed_shape(patches, peaks_px.astype(np.float64), patches.border_level_dn(), _USUAL_WIDTH)[:, 0]
    return float(np.median(long)) > _QUICK_LONG


def _level_dn(patches: Patches) -> Float:
    """Median (n,) of the valid pixels of each patch."""
    values = np.where(patches.valid, patches.values_dn, np.nan).reshape(len(patches.valid), -1)
    return np.nanmedian(values, axis=1)


def _from_moments(patches: Patches) -> StreakGuesses:
    """Lines from the moments of the light connected with the middle of each patch."""
    n, half = len(patches.noise_dn), patches.half_px
    level = _level_dn(patches)
    centers, halves, flux = np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n)
    for k in range(n):
        light = np.where(patches.valid[k], patches.values_dn[k] - level[k], 0.0)
        smooth = cv2.GaussianBlur(light, (0, 0), 1.0)
        lit = (smooth > _MOMENT_SIGMAS * 0.3 * patches.noise_dn[k]) & (smooth > 0.15 * smooth[half, half])
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
    return StreakGuesses(centers, halves, flux, level)


def _find_common(fits: LineFits, n_sources: int, sigma_px: float) -> CommonStreak | None:
    """Median of the lines if enough of them agree; directions are compared at twice their angle."""
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
