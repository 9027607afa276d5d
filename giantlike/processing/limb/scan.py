"""Limb scanning: position of the edge in the image along lines across a predicted outline.

After a search for the whole outline at once (:mod:`giantlike.processing.limb.search`), the profile of each line along
the outward normal is matched with the one expected there by least squares.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float, Mask, require
from giantlike.core.statistics import MAD_TO_SIGMA, robust_sigma
from giantlike.core.values import Value
from giantlike.processing.limb import line_match
from giantlike.processing.limb.view import in_frame

SAMPLING_VARIANCE_PX2 = 1.0 / 3.0
"""Variance of the cubic B-spline through which lines are sampled: it widens every edge by so much."""
PIXEL_VARIANCE_PX2 = 1.0 / 12.0  # variance of a uniform distribution over a pixel, px^2

_SPLINE_NOISE = 0.479365  # sum of squares of a cubic B-spline over the pixels, mean over sub-pixel phases
_SPLINE_NOISE_VARIANCE_PX2 = 2.0 / 3.0  # of its autocorrelation, along each axis
_RIVAL_PX, _RIVAL_CORRELATION = 2.0, 0.98
"""Distance from the best shift, px, and correlation relative to the best, from which another shift is a rival."""
_MODEL_ERROR = 0.02
"""Relative error of the expected profile. It limits the weight of the dark side, where noise is lowest and stray light
matters. Not yet studied."""
_MEDIAN_SIGMA = 1.2533  # standard error of a median / that of a mean, for a normal distribution: sqrt(pi / 2)
_LINES_ALIKE = 3.0  # neighboring lines with common pixels and so common errors: a profile of 4 x 4 pixels each 1.5 px
_LEAST_SLOPE, _SLOPE_ROOM = 1e-3, 2.0  # of the brightness, 1/px; and the factor on the measured scatter of slopes
_LEAST_USABLE, _CORE_PX = 0.5, 2.0
"""Minimum usable fraction of a window, and half width, px, about the limb that must be fully usable: two standard
deviations of a usual edge, which hold most of the information on its position."""
_WIDTHS_PX = np.geomspace(0.6, 4.0, 16)


@dataclass(frozen=True, slots=True, eq=False)
class Scans(Value):
    """Image values along lines."""

    points_px: Float  # (n, 2); where the lines have their zero
    normals_px: Float  # (n, 2); their directions, outward
    offsets_px: Float  # (m,); places along every line, evenly spaced and symmetric about zero
    values_dn: Float  # (n, m)
    usable: Mask  # (n, m); False where a pixel that the value is made from is bad or outside the image

    def some(self, lines: slice) -> Scans:
        """Return some of the lines."""
        part = self.points_px[lines], self.normals_px[lines]
        return Scans(*part, self.offsets_px, self.values_dn[lines], self.usable[lines])

    @property
    def step_px(self) -> float:
        """Distance between neighboring positions, px."""
        return float(self.offsets_px[1] - self.offsets_px[0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ProfileMatch(Value):
    """Shift of the profile of each line from the expected one."""

    complete: Mask  # (n,); enough values about the limb are usable: other arrays are undefined elsewhere
    shift_px: Float  # (n,); positive outward
    sigma_px: Float  # (n,); standard deviation of the shift from pixel noise
    without_slope_px: Float  # (n,); outward change with fixed slope: small if the brightness is right
    gain_dn: Float  # (n,); brightness of the image / that of the expected profile
    correlation: Float  # (n,); normalized correlation at the best shift
    unexplained: Float  # (n,); RMS of the residuals of the match / height of the profile in the image
    shared_px: Float  # (n, c); shift for a unit of each of the c parameters common to all lines
    shared_gain: Float  # (n, c); relative change of gain for a unit of each
    information: Float  # (n, c, c); information of each line on these, its shift, gain, offset and slope left free
    pull: Float  # (n, c); that information times the estimate
    at_border: Mask  # (n,); the best shift is at the limit of the search
    rivalled: Mask  # (n,); another position on the line fits equally well

    def brightness_error_px(self, good: Mask) -> float:
        """Shift of the whole limb, px, by a wrong reflectance law, from its good points (n,).

        Freeing the slope of the brightness moves a limb of unexpected brightness by about as much (median, less noise).
        """
        typical, scatter = float(np.median(self.without_slope_px[good])), robust_sigma(self.without_slope_px[good])
        chance = _MEDIAN_SIGMA * scatter / math.sqrt(max(np.count_nonzero(good) / _LINES_ALIKE, 1.0))
        return math.sqrt(max(typical**2 - chance**2, 0.0))


def line_offsets(reach_px: float, step_px: float) -> Float:
    """Equidistant positions (m,), px, along a line, symmetric about zero and including it.

    >>> line_offsets(1.0, 0.5).tolist()
    [-1.0, -0.5, 0.0, 0.5, 1.0]
    """
    count = int(np.ceil(reach_px / step_px - 1e-9))
    return np.arange(-count, count + 1, dtype=np.float64) * step_px


def scan_lines(pixels_dn: Float, usable: Mask, points_px: Float, normals_px: Float, offsets_px: Float) -> Scans:
    """Sample an image along n lines, at offsets (m,).

    Values are weighted means of 4 x 4 pixels with cubic B-spline weights: smooth in position, never beyond the pixels'
    range, and the same for an image and a template, so that the added blur cancels.
    """
    require(pixels_dn.shape == usable.shape, f"pixels {pixels_dn.shape} and usable {usable.shape} differ in shape")
    places = _places(points_px, normals_px, offsets_px)
    values = values_on_lines(pixels_dn[None], points_px, normals_px, offsets_px)[0]
    clean = usable
    if not usable.all():
        clean = cv2.erode(usable.view(np.uint8), np.ones((5, 5), np.uint8), borderValue=1).view(np.bool_)
    return Scans(
        points_px, normals_px, offsets_px, values, in_frame(places, usable.shape, margin_px=1.5) & _at(clean, places)
    )


def values_on_lines(images: Float, points_px: Float, normals_px: Float, offsets_px: Float) -> Float:
    """Values (k, n, m) of images (k, rows, columns) at m offsets along n lines, as :func:`scan_lines` samples them."""
    return sample_lines(np.ascontiguousarray(images), points_px, normals_px, offsets_px)


def _places(points_px: Float, normals_px: Float, offsets_px: Float) -> Float:
    """Places (n, m, 2) on lines."""
    return points_px[:, None, :] + offsets_px[None, :, None] * normals_px[:, None, :]


def step_profile(offsets_px: Float, width_px: float) -> Float:
    """Profile of a bright half-line up to zero, blurred by a Gaussian. ``offsets_px`` (m,); returns (m,)."""
    return ndtr(-offsets_px / width_px)


def match_profiles(
    scans: Scans,
    expected: Float,
    *,
    variance_dn2: Callable[[Float], Float],
    window_px: float,
    search_px: float,
    shared: Float | None = None,
    about_px: Float | None = None,
) -> ProfileMatch:
    """Match the profile of every line with the one expected there, in shift, gain, offset and slope.

    ``window_px``: distance to both sides of the limb over which profiles are compared; ``search_px``: largest shift;
    ``scans``: must reach the sum of both to both sides; ``expected`` (n, m); ``shared`` (n, m, c);
    ``about_px`` (n,), NaN, and the default, is the best shift of the line.

    The best multiple of the step has the highest normalized correlation; a least-squares fit of ``gain (1 + slope u)
    expected(u - shift) + offset`` then gives the rest, in three linear steps. The scatter of slopes about zero is
    estimated from all lines together. Shift and noise are from the weighted fit; the noise includes the correlation
    from B-spline sampling.
    """
    step = scans.step_px
    half, most = round(window_px / step), round(search_px / step)
    middle = scans.offsets_px.size // 2
    require(
        half + most <= middle,
        f"lines reach {scans.offsets_px[-1]:g} px, needed window + search = {window_px + search_px:g} px",
    )
    part = slice(middle - half, middle + half + 1)
    about = np.full(len(expected), np.nan) if about_px is None else about_px
    values, expected = scans.values_dn, np.ascontiguousarray(expected)
    enough = math.ceil(_LEAST_USABLE * (2 * half + 1)), math.floor(_CORE_PX / step)
    lag, start_px, best, rival, light, used, complete = line_match.find_shifts(
        values, scans.usable, expected, about, step, half, most, _RIVAL_PX, *enough
    )
    variance = variance_dn2(light)
    weights = used / (variance + (_MODEL_ERROR * light.max(axis=1, keepdims=True)) ** 2)
    shift, free, slope_variance, without_slope = line_match.refine_shifts(
        values, expected, lag, start_px, np.isfinite(about), weights, step, half, most
    )
    others = np.zeros((*expected.shape, 0)) if shared is None else shared
    solution, noise, left_rms, taken, information, pull = line_match.fit_lines(
        values,
        expected,
        others,
        lag,
        shift,
        weights,
        variance,
        _stiffness(free, slope_variance),
        _noise_correlation(scans.offsets_px[part]),
        step,
        half,
        most,
    )
    shift = shift + np.clip(_quotient(solution[:, 2], solution[:, 0]), -2.0 * step, 2.0 * step)
    gain = np.where(solution[:, 0] == 0.0, np.inf, solution[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        unexplained = left_rms / (np.abs(solution[:, 0]) * np.ptp(expected[:, part], axis=1))
        sigma = noise / np.abs(solution[:, 0])
    return ProfileMatch(
        complete=complete,
        shift_px=(lag - most) * step + shift,
        sigma_px=np.where(np.isfinite(sigma), sigma, np.inf),
        without_slope_px=_quotient(without_slope[:, 1], without_slope[:, 0]) - _quotient(free[:, 2], free[:, 0]),
        gain_dn=solution[:, 0],
        correlation=best,
        unexplained=np.where(np.isfinite(unexplained), unexplained, np.inf),
        shared_px=taken[:, 2] / gain[:, None],
        shared_gain=taken[:, 0] / gain[:, None],
        information=information,
        pull=pull,
        at_border=(lag == 0) | (lag == 2 * most),
        rivalled=rival > _RIVAL_CORRELATION * best,
    )


def edge_width_px(scans: Scans, *, variance_dn2: Callable[[Float], Float], window_px: float, search_px: float) -> float:
    """Standard deviation, px, of the Gaussian that blurs the edges on the lines, median over the lines.

    It includes the point spread function, the pixel and sampling (:data:`SAMPLING_VARIANCE_PX2`).
    """
    misfit = []
    for width in _WIDTHS_PX:
        expected = np.broadcast_to(step_profile(scans.offsets_px, float(width)), scans.values_dn.shape)
        match = match_profiles(scans, expected, variance_dn2=variance_dn2, window_px=window_px, search_px=search_px)
        misfit.append(np.where(match.complete & (match.gain_dn > 0), match.unexplained, np.inf))
    best = np.argmin(np.array(misfit), axis=0)
    found = np.isfinite(np.array(misfit)).any(axis=0)
    require(bool(found.any()), "no line holds an edge whose width could be measured")
    return float(np.median(_WIDTHS_PX[best[found]]))


def _at(mask: Mask, places_px: Float) -> Mask:
    """Values of a mask at the nearest pixels; edge values for positions outside, False where no position is in view."""
    rows, columns = mask.shape
    seen: Mask = np.all(np.isfinite(places_px), axis=-1)
    nearest = np.rint(np.where(seen[..., None], places_px, 0.0))
    index = np.clip(nearest, 0, (columns - 1, rows - 1)).astype(np.intp)
    return np.asarray(mask[index[..., 1], index[..., 0]] & seen)


def _noise_correlation(offsets_px: Float) -> Float:
    """Covariance (w, w) of values at positions along a line, divided by the noise variance of a pixel."""
    apart = offsets_px[:, None] - offsets_px
    return _SPLINE_NOISE**2 * np.exp(-0.5 * apart**2 / _SPLINE_NOISE_VARIANCE_PX2)


def _stiffness(free: Float, slope_variance: Float) -> Float:
    """Prior information (n,) on slopes, 1/DN^2: the scatter of all free ones (n, 4) beyond their noise."""
    determined = (free[:, 0] > 0.0) & np.isfinite(slope_variance)
    if not determined.any():
        return np.full(len(free), _LEAST_SLOPE**-2)
    slope = np.abs(free[determined, 3] / free[determined, 0])
    noise = np.median(slope_variance[determined] / free[determined, 0] ** 2)
    excess = (MAD_TO_SIGMA * float(np.median(slope))) ** 2 - float(noise)
    spread = max(_SLOPE_ROOM**2 * excess, _LEAST_SLOPE**2)
    return 1.0 / (spread * np.maximum(free[:, 0] ** 2, 1e-300))


def _quotient(shifted: Float, gain: Float) -> Float:
    """Shifts (n,), px, from gains times shifts; 0 where there is no gain."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num(shifted / gain, posinf=0.0, neginf=0.0)


@compiled
def sample_lines(images: Float, points_px: Float, normals_px: Float, offsets_px: Float) -> Float:
    """Weighted means (k, n, m) of 4 x 4 pixels, the weights a cubic B-spline about each position."""
    count, rows, columns = images.shape
    result = np.empty((count, len(points_px), len(offsets_px)))
    across, down = np.empty(4), np.empty(4)
    xs, ys = np.empty(4, np.int64), np.empty(4, np.int64)
    for line in range(len(points_px)):
        for place in range(len(offsets_px)):
            _taps(points_px[line, 0] + offsets_px[place] * normals_px[line, 0], columns, xs, across)
            _taps(points_px[line, 1] + offsets_px[place] * normals_px[line, 1], rows, ys, down)
            for k in range(count):
                total = 0.0
                for j in range(4):
                    part = 0.0
                    for i in range(4):
                        part += across[i] * images[k, ys[j], xs[i]]
                    total += down[j] * part
                result[k, line, place] = total
    return result


@compiled
def _taps(at: float, size: int, pixels: NDArray[np.int64], shares: Float) -> None:
    """Fill in the four pixels about a position along an axis of given size, and their cubic B-spline weights."""
    first = math.floor(at) if math.isfinite(at) else 0
    t = at - first
    s = 1.0 - t
    shares[0] = s * s * s / 6.0
    shares[1] = 2.0 / 3.0 - 0.5 * t * t * (2.0 - t)
    shares[2] = 2.0 / 3.0 - 0.5 * s * s * (2.0 - s)
    shares[3] = t * t * t / 6.0
    for k in range(4):
        pixels[k] = min(max(first - 1 + k, 0), size - 1)
