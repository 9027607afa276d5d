"""Normalized cross-correlation of a template with an image, with bad and missing pixels, and its sub-pixel peak."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, require
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.pixel_box import PixelBox
from giantlike.core.values import Value

_FITTED = 4  # parameters of a correlation peak: position (two), gain and level
_LEAST_NOISE = 1e-12  # minimum relative noise: where image and template are equal, rounding may leave none
_FEW_SHIFTS = 100  # up to which sums over the pixels of a template are faster one by one than by FFT
_PARABOLOID = np.array(
    [
        [-1, 0, 1, -1, 0, 1, -1, 0, 1],
        [-1, -1, -1, 0, 0, 0, 1, 1, 1],
        [1, -2, 1, 1, -2, 1, 1, -2, 1],
        [1, 0, -1, 0, 0, 0, -1, 0, 1],
        [1, 1, 1, -2, -2, -2, 1, 1, 1],
    ]
) / np.array([[6.0], [6.0], [6.0], [4.0], [6.0]])
"""Least-squares coefficients ``c1`` to ``c5`` of a paraboloid, see :func:`find_peak`, by 3 x 3 values row by row."""
_CONTRAST_LIMIT = 1e-5  # minimum standard deviation / largest value that float32 sums resolve


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrelationOptions:
    """Options of :func:`locate_template`."""

    search_px: int = 40  # largest distance from the predicted position, along each axis
    min_score: float = 0.5  # minimum correlation of a detection
    min_overlap: float = 0.3  # of common pixels of image and template, relative to the most in the search region

    def __post_init__(self) -> None:
        whole = isinstance(self.search_px, int | np.integer) and 1 <= self.search_px <= 4096
        require(whole, f"search_px must be a whole number in [1, 4096], got {self.search_px}")
        require(0.0 < self.min_score < 1.0, f"min_score must be in (0, 1), got {self.min_score}")
        require(0.0 < self.min_overlap <= 1.0, f"min_overlap must be in (0, 1], got {self.min_overlap}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CorrelationPeak(Value):
    """The highest point of a correlation surface."""

    offset_px: Float  # column and row of the peak in the surface, to a fraction of a pixel
    score: float  # correlation at the pixel of the peak, -1 to 1
    at_edge: bool  # True if the peak lies on the border of the surface or of the part of it that is defined
    covariance_px2: Float  # of ``offset_px``, by noise as in the peak (``find_peak``); infinite without round peak


def normalized_correlation(
    image: Float,
    template: Float,
    *,
    image_usable: Mask | None = None,
    template_usable: Mask | None = None,
    min_overlap: float = 0.3,
) -> Float:
    """Correlation coefficient (H - h + 1, W - w + 1) of a template (h, w) with every part of an image (H, W).

    NaN where it is undefined: too few shared pixels, or no contrast in one of the two.
    """
    require(
        template.shape[0] <= image.shape[0] and template.shape[1] <= image.shape[1],
        f"template {template.shape} must not be larger than the image {image.shape}",
    )
    for name, array, mask in (("image", image, image_usable), ("template", template, template_usable)):
        require(mask is None or mask.shape == array.shape, f"{name}_usable must have the shape of the {name}")
    whole_image = image_usable is None or bool(image_usable.all())
    whole_template = template_usable is None or bool(template_usable.all())
    if whole_image and whole_template:
        return _whole(image, template)
    image_ok = np.ones(image.shape, bool) if image_usable is None else image_usable
    template_ok = np.ones(template.shape, bool) if template_usable is None else template_usable
    return _correlate_masked(image, image_ok, template, template_ok, min_overlap)


def find_peak(surface: Float, *, n_pixels: int = 0) -> CorrelationPeak | None:
    r"""Highest point of a correlation surface, refined by a paraboloid; None where it is nowhere defined.

    ``n_pixels``: number of common pixels of template and image at the peak (without it the covariance is infinite).

    The paraboloid ``c0 + c1 x + c2 y + c3 x^2 + c4 x y + c5 y^2`` is the least-squares fit to the 3 x 3 pixels around
    the peak; a fit without a maximum within a pixel leaves the peak on its pixel. With N pixels of the same,
    independent noise, a peak of height r and K the negative second derivatives of the surface there, the covariance of
    the position is :math:`(1 - r^2) / (r (N - 4)) K^{-1}`: the ratio of the variance of the noise to the squared signal
    of the template is ``(1 - r^2) / (r^2 (N - 4))``, and K is r times the information of a unit of signal. (Derived
    here.) It underestimates differences that are correlated over several pixels, such as errors of the model, and
    excludes the error of the paraboloid, up to a few hundredths of a pixel for a peak as narrow as a point spread
    function.

    Source: Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, "Template Matching".
    """
    if np.isnan(surface).all():
        return None
    row, column = (int(v) for v in np.unravel_index(int(np.nanargmax(surface)), surface.shape))
    score = float(surface[row, column])
    pixel = np.array([column, row], dtype=np.float64)
    patch = surface[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    at_edge = patch.shape != (3, 3) or bool(np.isnan(patch).any())
    shift, height, curvature = (np.zeros(2), score, np.zeros((2, 2))) if at_edge else _paraboloid(patch)
    return CorrelationPeak(
        offset_px=pixel + shift,
        score=score,
        at_edge=at_edge,
        covariance_px2=_peak_covariance(height, curvature, n_pixels),
    )


def locate_template(
    pixels: Float,
    usable: Mask,
    template: Float,
    corner_px: tuple[int, int],
    *,
    options: CorrelationOptions = CorrelationOptions(),
) -> CorrelationPeak | Failure:
    """Find a template (h, w), predicted to begin at ``corner_px`` (column, row); either may extend beyond the frame."""
    corner = np.array(corner_px)
    box = PixelBox.spanning(corner, corner + template.shape[::-1], options.search_px)
    window, window_usable = box.cut(pixels), box.cut(usable)
    if not window_usable.any():
        return Failure(Reason.OUT_OF_FRAME, f"no usable pixel within {options.search_px} px of the predicted place")
    surface = normalized_correlation(window, template, image_usable=window_usable, min_overlap=options.min_overlap)
    n_pixels = 0
    if not np.isnan(surface).all():
        row, column = np.unravel_index(int(np.nanargmax(surface)), surface.shape)
        part = window_usable[row : row + template.shape[0], column : column + template.shape[1]]
        n_pixels = int(np.count_nonzero(part))
    peak = find_peak(surface, n_pixels=n_pixels)
    if peak is None:
        return Failure(Reason.NO_SIGNAL, f"no contrast within {options.search_px} px of the predicted place")
    if peak.score < options.min_score:
        detail = f"best correlation {peak.score:.3g} within {options.search_px} px, needed {options.min_score:g}"
        return Failure(Reason.LOW_CORRELATION, detail)
    shift = peak.offset_px - options.search_px
    if peak.at_edge:
        detail = (
            f"best match at the edge of the search region, {shift[0]:.0f} and {shift[1]:.0f} px from the prediction"
        )
        return Failure(Reason.PEAK_AT_EDGE, f"{detail}; increase search_px")
    return replace(peak, offset_px=shift)


def _whole(image: Float, template: Float) -> Float:
    """Correlation without masks, by OpenCV; means are subtracted first, for the sake of its float32 sums."""
    level = float(image.mean())
    flat = (image - level).astype(np.float32)
    bright = float(np.abs(template).max())
    pattern = ((template - template.mean()) / (bright or 1.0)).astype(np.float32)
    surface: Float = cv2.matchTemplate(flat, pattern, cv2.TM_CCOEFF_NORMED).astype(np.float64)
    size = (template.shape[1], template.shape[0])
    mean = cv2.boxFilter(image - level, cv2.CV_64F, size, anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    square = cv2.sqrBoxFilter(image - level, cv2.CV_64F, size, anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    deviation = np.sqrt(np.maximum(square - mean**2, 0.0))[: surface.shape[0], : surface.shape[1]]
    surface[deviation <= _CONTRAST_LIMIT * float(np.abs(image).max())] = np.nan
    if float(template.std()) <= _CONTRAST_LIMIT * float(np.abs(template).max()):
        surface[:] = np.nan
    return surface


def _correlate_masked(image: Float, image_ok: Mask, template: Float, template_ok: Mask, min_overlap: float) -> Float:
    """Correlation over the pixels that are usable in both."""
    rows, columns = image.shape[0] - template.shape[0] + 1, image.shape[1] - template.shape[1] + 1
    if not (image_ok.any() and template_ok.any()):
        return np.full((rows, columns), np.nan)
    flat = np.where(image_ok, image - image[image_ok].mean(), 0.0)
    pattern = np.where(template_ok, template - template[template_ok].mean(), 0.0)
    scales = float(np.abs(flat).max()) or 1.0, float(np.abs(pattern).max()) or 1.0
    sums = _sum_directly if rows * columns <= _FEW_SHIFTS else _sum_by_fft
    count, sum_i, sum_t, square_i, square_t, product = sums(
        flat / scales[0], image_ok, pattern / scales[1], template_ok
    )
    enough = count >= max(min_overlap * float(count.max()), 3.0)
    n = np.where(enough, count, 1.0)
    variance_i = square_i / n - (sum_i / n) ** 2
    variance_t = square_t / n - (sum_t / n) ** 2
    covariance = product / n - sum_i * sum_t / n**2
    defined = enough & (variance_i > _CONTRAST_LIMIT**2) & (variance_t > _CONTRAST_LIMIT**2)
    surface = np.full((rows, columns), np.nan)
    surface[defined] = covariance[defined] / np.sqrt(variance_i[defined] * variance_t[defined])
    return np.clip(surface, -1.0, 1.0)


_Sums: TypeAlias = tuple[Float, Float, Float, Float, Float, Float]
"""For each shift: pixels usable in image and template, and the sums over them of the image, of the template, of the
squares of both, and of their product."""


def _sum_by_fft(flat: Float, image_ok: Mask, pattern: Float, template_ok: Mask) -> _Sums:
    """Sums for all shifts of a template within an image, both zero where they are not usable."""
    from scipy import fft

    rows, columns = flat.shape[0] - pattern.shape[0] + 1, flat.shape[1] - pattern.shape[1] + 1
    size = [fft.next_fast_len(n, real=True) for n in flat.shape]
    ones_i, flat_i, square_i = (fft.rfft2(a, size) for a in (image_ok.astype(np.float64), flat, flat**2))
    ones_t, pattern_t, square_t = (
        np.conj(fft.rfft2(a, size)) for a in (template_ok.astype(np.float64), pattern, pattern**2)
    )

    def sum_products(spectrum: NDArray[np.complex128]) -> Float:
        return np.asarray(fft.irfft2(spectrum, size)[:rows, :columns])

    return (
        np.rint(sum_products(ones_i * ones_t)),
        sum_products(flat_i * ones_t),
        sum_products(ones_i * pattern_t),
        sum_products(square_i * ones_t),
        sum_products(ones_i * square_t),
        sum_products(flat_i * pattern_t),
    )


def _sum_directly(flat: Float, image_ok: Mask, pattern: Float, template_ok: Mask) -> _Sums:
    """Return :func:`_sum_by_fft`, shift by shift."""
    shape = flat.shape[0] - pattern.shape[0] + 1, flat.shape[1] - pattern.shape[1] + 1
    values = pattern[template_ok]
    of_template = np.stack([np.ones(values.size), values, values**2])
    shifted = np.lib.stride_tricks.sliding_window_view(flat, shape)[template_ok].reshape(values.size, -1)
    usable = np.lib.stride_tricks.sliding_window_view(image_ok, shape)[template_ok].reshape(values.size, -1)
    count, sum_t, square_t = of_template @ usable
    sum_i, product = of_template[:2] @ shifted
    square_i = np.einsum("nk,nk->k", shifted, shifted)
    count, sum_i, sum_t, square_i, square_t, product = (
        each.reshape(shape) for each in (count, sum_i, sum_t, square_i, square_t, product)
    )
    return count, sum_i, sum_t, square_i, square_t, product


def _paraboloid(patch: Float) -> tuple[Float, float, Float]:
    """Maximum of the paraboloid through 3 x 3 values: position from the middle, height, curvature (0 without one)."""
    c1, c2, c3, c4, c5 = (_PARABOLOID @ patch.ravel()).tolist()
    determinant = 4.0 * c3 * c5 - c4**2
    middle = float(patch[1, 1])
    if not (c3 < 0.0 and determinant > 0.0):
        return np.zeros(2), middle, np.zeros((2, 2))
    peak = np.array([c4 * c2 - 2.0 * c5 * c1, c4 * c1 - 2.0 * c3 * c2]) / determinant
    if math.hypot(*peak) > math.sqrt(2.0):
        return np.zeros(2), middle, np.zeros((2, 2))
    height = float(patch.mean()) - 2.0 / 3.0 * (c3 + c5) + 0.5 * (c1 * float(peak[0]) + c2 * float(peak[1]))
    return peak, height, -np.array([[2.0 * c3, c4], [c4, 2.0 * c5]])


def _peak_covariance(height: float, curvature: Float, n_pixels: int) -> Float:
    """Covariance (2, 2), px^2, of :func:`find_peak`."""
    freedom = n_pixels - _FITTED
    if freedom <= 0 or not height > 0.0 or float(np.linalg.det(curvature)) <= 0.0:
        return np.diag([np.inf, np.inf])
    height = min(height, 1.0 - _LEAST_NOISE)
    scale = (1.0 - height**2) / (height * freedom)
    return np.asarray(scale * np.linalg.inv(curvature), dtype=np.float64)
