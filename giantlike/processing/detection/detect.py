"""Detection of stars and other point sources in an image.

1. The image is filtered with a Gaussian of the width of a star minus a box of the same sum, and the noise of the result
is measured on a coarse grid (:func:`~giantlike.processing.detection.matched_filter.matched_filter`).
2. Pixels above ``threshold_sigma`` are joined to connected components. Each local maximum of the filtered image in
   them is a candidate; only the highest one where the component is far larger than a star, or saturated.
3. All candidates are fitted together (:func:`~giantlike.processing.detection.centroid.fit_stars`).
4. Flags compare area, fitted width and windowed second moments with the values of a star.

This is the scheme of Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, section
"Identifying Potential Stars in an Optical Image" (flatten, threshold in units of the noise, connected components,
Gaussian fit), with a linear filter instead of the 5 x 5 median, which removes light of stars of its size.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from giantlike._system.processes import one_thread
from giantlike.core.arrays import Float, Mask, require_number
from giantlike.core.detector import Detector
from giantlike.core.outcomes import Failure, Reason
from giantlike.processing.detection.candidates import Candidates, find_candidates
from giantlike.processing.detection.centroid import StarFits, fit_stars, neighbor_pairs, windowed_shape
from giantlike.processing.detection.common_streak import (
    CommonStreak,
    find_common_streak,
    fit_streaks,
    unexplained_power,
)
from giantlike.processing.detection.detections import DetectionFlag, Detections, UnmeasuredSources
from giantlike.processing.detection.frame import Frame, frame_of
from giantlike.processing.detection.matched_filter import (
    FilteredImage,
    matched_filter,
    noise_between,
    recorded_width_px,
)
from giantlike.processing.detection.options import DetectionOptions
from giantlike.processing.detection.particles import CORE_WIDTHS, MODEL_ERROR, core_of, find_few_pixels
from giantlike.processing.detection.patches import (
    MIN_PSF_SIGMA_PX,
    PIXEL_VARIANCE_PX2,
    Patches,
    cut_patches,
    draw_stars,
    neighbor_reach_px,
)
from giantlike.processing.detection.streak import line_shares

_FIRST_PSF_SIGMA_PX = 1.0  # width of the first filter when none is given: between usual cameras of 0.5 and 2 px
_PSF_ROUNDS = 3  # of filtering and estimating the width
_PSF_SETTLED = 0.2  # largest last change of ln sigma: a filter off by this loses 1 % of the signal to noise
_PSF_STARS = 50  # stars in the median width: known to 2 % if single stars are known to 10 %
_PSF_MOST_TRIED = 1000  # sources tried to find them: bounds the time for images full of hot pixels
_PSF_MIN_SIGNIFICANCE = 12.0  # of these stars: their widths are then known to about 10 %
_PSF_WIDTH_PRIOR = 1.0  # standard deviation of the prior on ln sigma: weak, the width is to be estimated
_HOT_PIXEL_WIDTH_PX = 0.3  # single bright pixels are fitted narrower than this

_LEAST_MEASURED = 100  # fewest measured sources: attitudes from 100 and 2,000 stars agree to 0.0013 px
_GROWTH = 1.1  # minimum growth of their number where their information is too low: bounds the number of rounds

_SAME_PEAK_PX = 1.5  # from a peak, within which one found later is a residual of the star

_STREAK_MIN_SIGNIFICANCE = 8.0  # of sources that show a common streak: three sigma above the detection limit
_STREAK_LENGTH_SIGMAS, _STREAK_LENGTH_RELATIVE = 5.0, 0.25  # largest difference from the length of the common streak
_STREAK_UNEXPLAINED = 0.3  # fraction of unexplained power above which a source is not a streak; not yet studied

_EXTENDED_WIDTH = 2.0  # width / width of a recorded star above which a source is extended
_EXTENDED_WIDTH_SATURATED = 3.0  # the same for saturated sources: bright stars bloom
_ELONGATED = 0.9  # longest axis of the windowed moments: 0.5 for a star, 1 for anything longer than the window
_SHARP_WIDTH = 0.62  # width over the usual width of the stars of the image below which a source is sharp; no study yet
_SHARP_MIN_PSF_PX = 0.4  # usual width, px, below which a star and a hot pixel look the same
_USUAL_MIN_STARS = 10  # fewest stars whose median width replaces that of the PSF


def detect_sources(
    pixels: ArrayLike,
    *,
    detector: Detector,
    psf_sigma_px: float | None = None,
    mask: ArrayLike | None = None,
    options: DetectionOptions | None = None,
) -> Detections | Failure:
    """Detect stars and other point sources and fit their centroids.

    Parameters
    ----------
    pixels : (rows, columns) real, DN; of any dtype; values that are not finite are masked
    detector : Detector
        Gain (for the shot noise of stars) and saturation; integer images also saturate at the end of their dtype. The
        background noise is that of ``options.noise``, by default measured on the image.
    psf_sigma_px : float, px, optional
        Standard deviation of the point spread function before pixels integrate it. By default it is the median
        over the brightest isolated sources of this image (1 px where there are none).
    mask : (rows, columns) bool, optional; True where a pixel is bad
    options : DetectionOptions, optional

    Returns
    -------
    Detections or Failure
        Brightest first, possibly none; ``detections.select(detections.clean)`` are those that look like stars.
        ``no_signal``: all good pixels are equal, or there are none. ``saturated``: more of the image is
        saturated than the options allow.

    Raises
    ------
    InputError
        Pixels are not 2-D and real, the mask has another shape, or ``psf_sigma_px`` is negative or not finite.

    Examples
    --------
    >>> image = np.random.default_rng(1).normal(100.0, 2.0, (64, 64))
    >>> image[30:33, 40:43] += [[40, 90, 40], [90, 200, 90], [40, 90, 40]]
    >>> found = detect_sources(image, detector=Detector(gain_e_per_dn=10.0), psf_sigma_px=0.8)
    >>> found.points_px.round(1).tolist()
    [[41.0, 31.0]]
    """
    options = DetectionOptions() if options is None else options
    parts = detect_in_parts(
        pixels, (options.information,), detector=detector, psf_sigma_px=psf_sigma_px, mask=mask, options=options
    )
    with one_thread():
        return next(parts)


def detect_in_parts(
    pixels: ArrayLike,
    shares: Sequence[float],
    *,
    detector: Detector,
    psf_sigma_px: float | None = None,
    mask: ArrayLike | None = None,
    options: DetectionOptions,
) -> Iterator[Detections | Failure]:
    """Detect sources, and measure more of them until ``options.information`` is reached."""
    if psf_sigma_px is not None:
        require_number(psf_sigma_px, "psf_sigma_px", least=0.0)
    frame = frame_of(pixels, mask, detector, options)
    if isinstance(frame, Failure):
        yield frame
        return
    psf, filtered, found = _search(frame, psf_sigma_px, options)
    streak = None if options.streak is False else _common_streak(frame, found, psf_sigma_px)
    if streak is not None:
        psf = streak.sigma_px
        filtered, found = _search_with(frame, psf, options, streak.half_px)
    elif options.streak:
        yield Failure(
            Reason.NO_SIGNAL,
            "the brightest sources have no common streak of one direction and length: do not require one",
        )
        return
    if frame.noise_dn is None:
        noise_dn, at_peaks = noise_between(filtered, frame.bad, found.peaks_px, frame.noise_floor_dn)
    else:
        noise_dn = float(np.median(frame.noise_dn[::8, ::8]))
        at_peaks = frame.noise_dn[found.peaks_px[:, 1], found.peaks_px[:, 0]].astype(np.float64)
    found = replace(found, noise_dn=at_peaks).select(slice(options.max_sources))
    for _ in range(options.searches - 1 if streak is None and len(found) else 0):
        found, noise_dn = _search_again(frame, found, psf, noise_dn, options)
    measured: Detections | None = None
    for share in shares:
        if not len(found):
            measured = Detections.empty(psf_sigma_px=psf, noise_dn=noise_dn)
        elif streak is not None:
            measured = _measure_lines(frame, found, streak, noise_dn)
        elif share < 1.0:
            measured = _measure_enough(frame, found, psf, noise_dn, share)
        elif measured is None or measured.left_out is None:
            measured = _measure(frame, found, psf, noise_dn)
        else:
            measured = _measure_up_to(len(found), frame, found, psf, noise_dn, measured)
        yield measured.select(np.argsort(-measured.flux_dn, kind="stable"))


def _search(
    frame: Frame, psf_sigma_px: float | None, options: DetectionOptions
) -> tuple[float, FilteredImage, Candidates]:
    """Search with the given width of the PSF or, without one, with the width of the sources of the image."""
    if psf_sigma_px is not None:
        psf = max(psf_sigma_px, MIN_PSF_SIGMA_PX)
        return psf, *_search_with(frame, psf, options)
    psf = _FIRST_PSF_SIGMA_PX
    filtered, found = _search_with(frame, psf, options)
    for _ in range(_PSF_ROUNDS):
        measured = _estimate_psf(frame, found, psf)
        settled = abs(math.log(measured / psf)) < _PSF_SETTLED
        psf = measured
        if settled:
            break
        filtered, found = _search_with(frame, psf, options)
    return psf, filtered, found


def _search_with(
    frame: Frame, psf_sigma_px: float, options: DetectionOptions, half_streak_px: tuple[float, float] | None = None
) -> tuple[FilteredImage, Candidates]:
    """Filter for stars or streaks of this width and list the peaks."""
    filtered = matched_filter(
        frame.flat,
        frame.bad,
        psf_sigma_px=psf_sigma_px,
        noise_floor_dn=frame.noise_floor_dn,
        half_streak_px=half_streak_px,
        stored=frame.pixels,
    )
    if frame.noise_dn is not None:
        filtered = replace(filtered, noise_dn=np.maximum(frame.noise_dn, np.float32(frame.noise_floor_dn)))
    found = find_candidates(frame, filtered, options)
    return filtered, found if half_streak_px is None else found.select(found.first)


def _search_again(
    frame: Frame, found: Candidates, psf_sigma_px: float, noise_dn: float, options: DetectionOptions
) -> tuple[Candidates, float]:
    """Candidates, and those in the image without them (as stars), with the noise of that image, and its median, DN.

    Where stars were, their light counts as noise by the error of its model: their wings are no sources.
    """
    stars = _measure(frame, found, psf_sigma_px, noise_dn)
    stars = stars.select((stars.flags & np.uint16(DetectionFlag.EXTENDED | DetectionFlag.FIT_FAILED)) == 0)
    light = draw_stars(frame.flat.shape, stars.points_px, stars.flux_dn, stars.width_px)
    filtered, more = _search_with(replace(frame, flat=frame.flat - light), psf_sigma_px, options)
    columns, rows = more.peaks_px.T
    error = MODEL_ERROR * cv2.dilate(light, np.ones((3, 3), dtype=np.uint8))[rows, columns]
    clear = more.significance * more.noise_dn > options.threshold_sigma * np.hypot(more.noise_dn, error)
    clear &= cKDTree(found.peaks_px).query(more.peaks_px)[0] > _SAME_PEAK_PX
    found = found.join(more.select(clear)).select(slice(options.max_sources))
    columns, rows = found.peaks_px.T
    noise = filtered.noise_dn[rows, columns].astype(np.float64)
    return replace(found, noise_dn=noise), float(np.median(filtered.noise_dn))


def _common_streak(frame: Frame, found: Candidates, psf_sigma_px: float | None) -> CommonStreak | None:
    bright = found.select(found.first & (found.significance > _STREAK_MIN_SIGNIFICANCE))
    return find_common_streak(frame, bright.peaks_px, bright.noise_dn, psf_sigma_px)


def _estimate_psf(frame: Frame, found: Candidates, psf_sigma_px: float) -> float:
    """Median fitted width of the most significant isolated, unsaturated, compact sources that may be stars."""
    found = found.select(found.alone & ~found.extended & (found.significance > _PSF_MIN_SIGNIFICANCE))
    stars: list[float] = []
    sharper: list[float] = []
    for start in range(0, min(len(found), _PSF_MOST_TRIED), 2 * _PSF_STARS):
        some = found.select(slice(start, start + 2 * _PSF_STARS))
        patches = frame.patches(some.peaks_px, _half_patch_px(psf_sigma_px), some.noise_dn)
        whole = np.flatnonzero(patches.valid.all(axis=(1, 2)) & ~patches.saturated.any(axis=(1, 2)))
        whole = whole[: _PSF_STARS - len(stars)]
        if not whole.size:
            continue
        patches, some = patches.select(whole), some.select(whole)
        fits = fit_stars(
            patches,
            points_px=some.points_px,
            flux_dn=some.flux_dn,
            psf_sigma_px=psf_sigma_px,
            width_prior=_PSF_WIDTH_PRIOR,
            isolated=True,
        )
        level = patches.subtract_slopes(fits.planes, fits.points_px)
        few = find_few_pixels(level, fits.points_px, fits.width_px, fits.background_dn, psf_sigma_px)
        wide = fits.converged & (fits.width_px > _HOT_PIXEL_WIDTH_PX) & ~few.not_star
        stars.extend(fits.width_px[wide])
        sharper.extend(fits.width_px[fits.converged & ~wide])
        if len(stars) >= _PSF_STARS:
            break
    widths = stars or sharper
    return max(float(np.median(widths)), MIN_PSF_SIGMA_PX) if widths else psf_sigma_px


def _half_patch_px(psf_sigma_px: float) -> int:
    return math.ceil(3.0 * recorded_width_px(psf_sigma_px)) + 1


def _measure_enough(
    frame: Frame, found: Candidates, psf_sigma_px: float, noise_dn: float, information: float
) -> Detections:
    """Measure the most significant candidates until the stars have the required fraction of the information."""
    gain = frame.detector.gain_e_per_dn
    variance = _expected_variance_px2(found.significance, found.flux_dn, psf_sigma_px, gain)
    worth = np.where(found.extended | found.plateau, 0.0, 1.0 / variance)
    beyond = np.append(np.cumsum(worth[::-1])[::-1], 0.0)  # sum from the n-th on
    least, known = (1.0 - information) * beyond[0], 0
    measured: Detections | None = None
    while True:
        count = max(int(np.argmax(beyond <= least)), _LEAST_MEASURED, math.ceil(_GROWTH * known))
        measured = _measure_up_to(count, frame, found, psf_sigma_px, noise_dn, measured)
        if count >= len(found):
            return measured
        stars = measured.select(measured.clean)
        expected = _expected_variance_px2(stars.snr, stars.flux_dn, psf_sigma_px, gain)
        scale = float(np.median(stars.sigma_px**2 / expected)) if len(stars) else 1.0
        held = float(np.sum(stars.sigma_px**-2)) * scale
        least, known = (1.0 - information) * (held + beyond[count]), count
        if beyond[count] <= least:
            left = UnmeasuredSources(peaks_px=found.peaks_px[count:], sigma_px=np.sqrt(scale * variance[count:]))
            return replace(measured, left_out=left)


def _measure_up_to(
    count: int, frame: Frame, found: Candidates, psf_sigma_px: float, noise_dn: float, measured: Detections | None
) -> Detections:
    """Measure so many candidates, of which the first may be measured."""
    number, known = np.arange(len(found)), 0 if measured is None else len(measured)
    chosen = (number >= known) & (number < count)
    pairs = neighbor_pairs(found.peaks_px.astype(np.float64), neighbor_reach_px(_half_patch_px(psf_sigma_px)))
    fitted = chosen.copy()
    fitted[pairs[chosen[pairs[:, 0]], 1]] = True  # a star is fitted with the neighbors that overlap it
    usual = None if measured is None else _usual_of(measured)
    more = _measure(frame, found.select(fitted), psf_sigma_px, noise_dn, usual).select(chosen[fitted])
    return more if measured is None else measured.joined(more)


def _usual_of(measured: Detections) -> float | None:
    """Usual width of the stars measured so far, px; None for few of them."""
    widths = measured.width_px[measured.clean][:_PSF_STARS]
    return min(measured.psf_sigma_px, float(np.median(widths))) if widths.size >= _USUAL_MIN_STARS else None


def _expected_variance_px2(snr: Float, flux_dn: Float, psf_sigma_px: float, gain_e_per_dn: float) -> Float:
    """Variance per axis of centroids (n,): Fisher information of a Gaussian on noise, and of its own photons."""
    variance = recorded_width_px(psf_sigma_px) ** 2
    return variance * (2.0 / snr**2 + 1.0 / (flux_dn * gain_e_per_dn))


def _measure(
    frame: Frame, found: Candidates, psf_sigma_px: float, noise_dn: float, usual_px: float | None = None
) -> Detections:
    """Fit all candidates as stars and flag them; the usual width of stars is theirs, unless it is given."""
    patches = frame.patches(found.peaks_px, _half_patch_px(psf_sigma_px), found.noise_dn)
    fits = fit_stars(patches, points_px=found.points_px, flux_dn=found.flux_dn, psf_sigma_px=psf_sigma_px)
    width = recorded_width_px(psf_sigma_px)
    failed = ~fits.converged
    fits = replace(
        fits,
        points_px=np.where(failed[:, None], found.peaks_px, fits.points_px),
        covariance_px2=np.where(failed[:, None, None], width**2 * np.eye(2), fits.covariance_px2),
        planes=np.where(failed[:, None], fits.planes * [1.0, 0.0, 0.0], fits.planes),
    )
    patches = patches.subtract_slopes(fits.planes, fits.points_px)
    flux = np.where(failed, found.flux_dn, fits.flux_dn)
    core = core_of(patches, fits.points_px, psf_sigma_px)
    moments = windowed_shape(patches, fits.points_px, fits.background_dn, psf_sigma_px)
    peak = np.where(core & patches.valid, patches.values_dn, -np.inf).max(axis=(1, 2)) - fits.background_dn
    return Detections(
        points_px=fits.points_px,
        covariance_px2=fits.covariance_px2,
        flux_dn=flux,
        snr=flux / (found.noise_dn * 2.0 * math.sqrt(math.pi) * width),
        peak_dn=np.where(np.isfinite(peak), peak, 0.0),
        area_px=found.area_px,
        background_dn=fits.background_dn,
        width_px=fits.width_px,
        flags=_flags(frame, found, _FittedStars(patches, fits, core, moments), psf_sigma_px, usual_px),
        psf_sigma_px=psf_sigma_px,
        noise_dn=noise_dn,
        moments=moments,
    )


def _measure_lines(frame: Frame, found: Candidates, streak: CommonStreak, noise_dn: float) -> Detections:
    """Fit all candidates as lines; those unlike the common streak are flagged as extended."""
    width = recorded_width_px(streak.sigma_px)
    half = math.ceil(max(abs(h) for h in streak.half_px) + 3.0 * width) + 2
    patches = frame.patches(found.peaks_px, half, found.noise_dn)
    fits = fit_streaks(patches, streak, found.flux_dn)
    shares = line_shares(patches, fits.centers_px, fits.halves_px, streak.sigma_px)[0]
    core = shares > 0.1 * shares.max(axis=(1, 2), keepdims=True)
    light = np.where(core & patches.valid, patches.values_dn, -np.inf).max(axis=(1, 2)) - fits.background_dn
    expected = 2.0 * math.hypot(*streak.half_px)
    allowed = np.minimum(_STREAK_LENGTH_SIGMAS * fits.length_sigma_px, expected / 2.0)
    allowed += _STREAK_LENGTH_RELATIVE * expected
    x, y = streak.half_px
    turned = np.abs(x * fits.halves_px[:, 1] - y * fits.halves_px[:, 0]) / (expected / 2.0)
    unlike = (np.abs(fits.lengths_px - expected) > allowed) | (2.0 * turned > allowed)
    unlike |= unexplained_power(patches, fits, shares) > _STREAK_UNEXPLAINED
    ends = fits.ends_px
    last = np.array(frame.pixels.shape[::-1]) - 1.0
    cut = ((ends < width) | (ends > last - width)).any(axis=(1, 2))
    flags = _combined_flags(
        {
            DetectionFlag.STREAK: ~unlike & fits.converged,
            DetectionFlag.SATURATED: (core & patches.saturated).any(axis=(1, 2)),
            DetectionFlag.MASKED: (core & ~patches.valid).any(axis=(1, 2)) & ~cut,
            DetectionFlag.CUT_BY_FRAME: cut,
            DetectionFlag.EXTENDED: unlike & fits.converged,
            DetectionFlag.FIT_FAILED: ~fits.converged,
        }
    )
    power = np.sqrt(np.sum(shares**2, axis=(1, 2)))
    failed = ~fits.converged
    flux = np.where(failed, found.flux_dn, fits.flux_dn)
    return Detections(
        points_px=np.where(failed[:, None], found.peaks_px, fits.centers_px),
        covariance_px2=np.where(failed[:, None, None], expected**2 * np.eye(2), fits.covariance_px2[:, :2, :2]),
        flux_dn=flux,
        snr=np.where(failed, found.significance, fits.flux_dn * power / found.noise_dn),
        peak_dn=np.where(np.isfinite(light), light, 0.0),
        area_px=found.area_px,
        background_dn=fits.background_dn,
        width_px=np.full(len(found), streak.sigma_px),
        flags=flags,
        psf_sigma_px=streak.sigma_px,
        noise_dn=noise_dn,
        halves_px=fits.halves_px,
        half_sigma_px=fits.length_sigma_px / 2.0,
    )


@dataclass(frozen=True, slots=True)
class _FittedStars:
    """Patches without the slopes of their backgrounds, stars fitted to them, cores (n, w, w) and moments (n, 2)."""

    patches: Patches
    fits: StarFits
    core: Mask
    moments: Float


def _flags(
    frame: Frame, found: Candidates, fitted: _FittedStars, psf_sigma_px: float, usual_px: float | None
) -> NDArray[np.uint16]:
    """Combine :class:`DetectionFlag` values (n,)."""
    patches, fits, core = fitted.patches, fitted.fits, fitted.core
    rows, columns = frame.pixels.shape
    width = recorded_width_px(psf_sigma_px)
    points_px, failed = fits.points_px, ~fits.converged
    saturated = (core & patches.saturated).any(axis=(1, 2))
    margin = CORE_WIDTHS * width - 0.5
    last = np.array([columns, rows]) - 1.0 - margin
    cut = ((points_px < margin) | (points_px > last)).any(axis=1)
    masked = np.zeros(len(points_px), dtype=bool)
    if frame.bad is not None:
        bad = cut_patches(frame.bad, None, found.peaks_px, patches.half_px, detector=frame.detector).values_dn > 0
        masked |= (core & bad).any(axis=(1, 2))
    relative_width = np.hypot(fits.width_px, math.sqrt(PIXEL_VARIANCE_PX2)) / width
    wide = relative_width > np.where(saturated, _EXTENDED_WIDTH_SATURATED, _EXTENDED_WIDTH)
    long = fitted.moments[:, 0] > _ELONGATED
    long &= ~saturated  # a plateau has no shape
    usual = _usual_width_px(fits, ~saturated & ~wide & ~long, psf_sigma_px) if usual_px is None else usual_px
    few = find_few_pixels(patches, points_px, np.full(len(points_px), usual), fits.background_dn, psf_sigma_px)
    sharp = (few.not_star | (fits.width_px < _SHARP_WIDTH * usual)) & (usual >= _SHARP_MIN_PSF_PX) & ~saturated
    blended = np.zeros(len(points_px), dtype=bool)
    blended[neighbor_pairs(points_px, patches.reach_px)[:, 0]] = True
    return _combined_flags(
        {
            DetectionFlag.SATURATED: saturated,
            DetectionFlag.MASKED: masked,
            DetectionFlag.CUT_BY_FRAME: cut,
            DetectionFlag.EXTENDED: found.extended | wide | long,
            DetectionFlag.SHARP: sharp & ~failed,
            DetectionFlag.COSMIC_RAY: sharp & few.not_star & (few.n_pixels > 1),
            DetectionFlag.BLENDED: blended | ~found.alone,
            DetectionFlag.FIT_FAILED: failed,
        }
    )


def _combined_flags(masks: Mapping[DetectionFlag, ArrayLike]) -> NDArray[np.uint16]:
    """Combined flags (n,) of the detections for which each of them holds."""
    flags = [np.where(mask, np.uint16(flag), np.uint16(0)) for flag, mask in masks.items()]
    result: NDArray[np.uint16] = np.bitwise_or.reduce(flags)
    return result


def _usual_width_px(fits: StarFits, compact: Mask, psf_sigma_px: float) -> float:
    """Median width, px, of the stars, at most that of the PSF: sharper stars must not be mistaken for hot pixels."""
    brightest = np.argsort(-np.where(compact & fits.converged, fits.flux_dn, -np.inf))[:_PSF_STARS]
    widths = fits.width_px[brightest][(compact & fits.converged)[brightest]]
    widths = widths[widths > _HOT_PIXEL_WIDTH_PX]
    return min(psf_sigma_px, float(np.median(widths))) if widths.size >= _USUAL_MIN_STARS else psf_sigma_px
