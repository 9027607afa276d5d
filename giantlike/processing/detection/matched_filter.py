"""Matched filter for stars and streaks, and the noise of the filtered image: the basis of the detection threshold.

The kernel is the Gaussian of a star minus a box of the same sum. It adds up to zero, so that levels and
gradients of the background drop out without a model of it, and it is mirror symmetric, so that nothing moves.
The noise is measured on the filtered image, box by box: at the scale of a star, so that correlated noise (JPEG,
interpolation) has its actual effect on detection and centroids, and texture (trees, terrain) is noise too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, Scalar
from giantlike.core.statistics import IQR_PER_SIGMA
from giantlike.core.values import Value

NOISE_BOX_PX = 48  # side of a box in which the noise is measured, px: it contains at least 100 samples
_BOX_HALF_WIDTHS = 6.0  # half side of the background box in star widths: loses 3 % of the signal to noise
_KERNEL_HALF_WIDTHS = 3.0  # half side of the Gaussian in star widths: 99.5 % of its sum
_MIN_NOISE_SAMPLES = 100  # per box: the quartiles give its sigma to 12 %
_MAX_EXCLUDED = 0.8  # fraction of the samples of a box near sources, above which all samples are used

Image32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilteredImage(Value):
    """Image after a zero-sum matched filter."""

    response: Image32  # (rows, columns); times ``flux_per_response`` the flux of a star at that pixel
    noise_dn: Image32  # (rows, columns); local noise of a pixel: white noise of the same effect on the filtered image
    response_noise: float  # standard deviation of the response to white noise of 1 DN per pixel
    flux_per_response: float  # in DN
    width_px: float  # Gaussian width of a recorded star that the filter matches
    reach_px: int  # distance over which a source changes the response: half the side of the background box


def recorded_width_px(psf_sigma_px: float) -> float:
    """Gaussian width of a star as recorded by pixels, ``sqrt(sigma^2 + 1/12)``."""
    return math.sqrt(psf_sigma_px**2 + 1.0 / 12.0)


def matched_filter(
    image: Image32,
    bad: Mask | None,
    *,
    psf_sigma_px: float,
    noise_floor_dn: float,
    half_streak_px: tuple[float, float] | None = None,
    stored: NDArray[Any] | None = None,
) -> FilteredImage:
    """Filter an image for stars, or for streaks of one direction and length, and measure the noise of the result.

    ``half_streak_px``: vector (x, y) from the middle of a streak to one end (stars by default).
    """
    width = recorded_width_px(psf_sigma_px)
    length = 0.0 if half_streak_px is None else math.hypot(*half_streak_px)
    half, box_half = math.ceil(_KERNEL_HALF_WIDTHS * width), math.ceil(_BOX_HALF_WIDTHS * width + length)
    box = (2 * box_half + 1, 2 * box_half + 1)
    if bad is not None:
        image = _fill_bad_pixels(image, bad, box)
    if half_streak_px is None:
        taps = np.exp(-0.5 * (np.arange(-half, half + 1) / width) ** 2)
        taps /= taps.sum()
        star = cv2.sepFilter2D(image, cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REFLECT_101)
        kernel = np.outer(taps, taps)
    else:
        kernel = _line_kernel(half_streak_px, width, half + math.ceil(length))
        star = cv2.filter2D(image, cv2.CV_32F, kernel, borderType=cv2.BORDER_REFLECT_101)
    response = np.asarray(star, dtype=np.float32)
    around = _box_means(image, stored if bad is None else None, box)
    np.subtract(response, around, out=response)
    pedestal = 1.0 / (box[0] * box[1])
    response_noise = math.sqrt(float(np.sum(kernel**2)) - pedestal)
    grid = NoiseGrid.from_shape(response.shape, width)
    sigma = grid.robust_sigma(response, bad, np.zeros((0, 2), dtype=np.int64), 0)
    if bad is not None:
        response[bad] = 0.0
    return FilteredImage(
        response=response,
        noise_dn=grid.spread(np.maximum(sigma / response_noise, noise_floor_dn), out=around),
        response_noise=response_noise,
        # a star as wide as the kernel, anywhere in its pixel: 1 / (4 pi width^2), minus the box.
        flux_per_response=1.0
        / ((1.0 / (4.0 * math.pi * width**2) if half_streak_px is None else float(np.sum(kernel**2))) - pedestal),
        width_px=width,
        reach_px=box_half,
    )


def _box_means(image: Image32, stored: NDArray[Any] | None, box: tuple[int, int]) -> Image32:
    """Means of the boxes around all pixels of ``image``, which may differ from ``stored`` by a constant."""
    if stored is None or stored.dtype not in (np.uint8, np.uint16, np.int16):
        return np.asarray(cv2.blur(image, box, borderType=cv2.BORDER_REFLECT_101), dtype=np.float32)
    whole = cv2.boxFilter(np.ascontiguousarray(stored), cv2.CV_32F, box, borderType=cv2.BORDER_REFLECT_101)
    means = np.asarray(whole, dtype=np.float32)
    means -= np.float32(stored[0, 0]) - image[0, 0]
    return means


def noise_between(
    filtered: FilteredImage, bad: Mask | None, sources_px: NDArray[np.integer], noise_floor_dn: float
) -> tuple[float, Float]:
    """Noise of a pixel without the pixels near sources (n, 2): ``median`` and ``at_sources`` (n,), DN.

    The first estimate includes stars, and the dip of the background box around them: too large for a covariance.
    """
    grid = NoiseGrid.from_shape(filtered.response.shape, filtered.width_px)
    sigma = grid.robust_sigma(filtered.response, bad, sources_px, filtered.reach_px)
    noise = np.maximum(sigma / filtered.response_noise, noise_floor_dn)
    return float(np.median(noise)), grid.at(noise, sources_px)


def _line_kernel(half_streak_px: tuple[float, float], width_px: float, half: int) -> Float:
    """Gaussian (k, k) drawn along a line, with the sum 1."""
    steps = np.linspace(-1.0, 1.0, 2 * math.ceil(2.0 * math.hypot(*half_streak_px) / width_px) + 1)
    pixels = np.arange(-half, half + 1)
    across, down = (np.exp(-0.5 * ((pixels - steps[:, None] * h) / width_px) ** 2) for h in half_streak_px)
    kernel: Float = down.T @ across
    kernel /= kernel.sum()
    return kernel


def _fill_bad_pixels(image: Image32, bad: Mask, box: tuple[int, int]) -> Image32:
    """Return ``image`` with bad pixels replaced by the mean of the good ones in the box, or of all good ones."""
    good = (~bad).astype(np.float32)
    total = cv2.blur(np.where(bad, np.float32(0.0), image), box)
    share = cv2.blur(good, box)
    overall = float(image[~bad].mean())
    near = np.where(share > 0.5 * good.mean() / (box[0] * box[1]), total / np.maximum(share, 1e-6), overall)
    return np.where(bad, near.astype(np.float32), image)


@dataclass(frozen=True, slots=True)
class NoiseGrid:
    """Coarse grid of boxes, and the pixels sampled in each: every ``step``-th, since neighbors are correlated."""

    shape: tuple[int, int]
    step: int
    rows: int
    columns: int
    height: int
    breadth: int

    @classmethod
    def from_shape(cls, shape: tuple[int, ...], width_px: float) -> NoiseGrid:
        """Grid for an image of ``shape`` (rows, columns) filtered for stars of ``width_px``."""
        rows, columns = (max(1, round(n / NOISE_BOX_PX)) for n in shape)
        finest = math.isqrt(max(1, shape[0] * shape[1] // (rows * columns * _MIN_NOISE_SAMPLES)))
        step = max(1, min(round(3.0 * width_px), finest))
        n_rows, n_columns = -(-shape[0] // step), -(-shape[1] // step)
        height, breadth = max(1, n_rows // rows), max(1, n_columns // columns)
        return cls((shape[0], shape[1]), step, n_rows // height, n_columns // breadth, height, breadth)

    def boxes(self, sampled: NDArray[Scalar]) -> NDArray[Scalar]:
        """Sampled pixels (rows, columns, pixels per box) of each box; incomplete boxes on the far sides are omitted."""
        cut = sampled[: self.rows * self.height, : self.columns * self.breadth]
        cut = cut.reshape(self.rows, self.height, self.columns, self.breadth)
        return cut.swapaxes(1, 2).reshape(self.rows, self.columns, self.height * self.breadth)

    def robust_sigma(
        self, response: Image32, bad: Mask | None, sources_px: NDArray[np.integer], reach_px: int
    ) -> Image32:
        """Normalized interquartile range of each box, away from sources where possible, smoothed by a 3 x 3 median."""
        values = self.boxes(response[:: self.step, :: self.step])
        count = np.full(values.shape[:-1], values.shape[-1], dtype=np.int64)
        if bad is not None or len(sources_px):
            excluded = self._exclude(bad, sources_px, reach_px)
            kept = values.shape[-1] - np.count_nonzero(excluded, axis=-1)
            some = kept > (1.0 - _MAX_EXCLUDED) * values.shape[-1]
            values = np.where(excluded & some[..., None], np.float32(np.inf), values)
            count[some] = kept[some]
        sigma = _quartile_sigma(np.sort(values, axis=-1), count)
        if min(sigma.shape) >= 3:
            return np.asarray(cv2.medianBlur(sigma, 3), dtype=np.float32)
        return sigma

    def _exclude(self, bad: Mask | None, sources_px: NDArray[np.integer], reach_px: int) -> Mask:
        step = self.step
        taken = np.zeros((-(-self.shape[0] // step), -(-self.shape[1] // step)), dtype=np.uint8)
        taken[sources_px[:, 1] // step, sources_px[:, 0] // step] = 1
        side = 2 * math.ceil(reach_px / step) + 1
        taken = np.asarray(cv2.dilate(taken, np.ones((side, side), dtype=np.uint8)), dtype=np.uint8)
        if bad is not None:
            taken |= bad[::step, ::step]
        return self.boxes(taken.astype(bool))

    def spread(self, values: Image32, out: Image32 | None = None) -> Image32:
        """Values of the boxes (rows, columns) interpolated to every pixel, in ``out`` if it is given."""
        size = (self.shape[1], self.shape[0])
        return np.asarray(cv2.resize(values, size, dst=out, interpolation=cv2.INTER_LINEAR), dtype=np.float32)

    def at(self, values: Image32, pixels_px: NDArray[np.integer]) -> Float:
        """Values of the boxes (rows, columns) interpolated to pixels (x, y), (n, 2), as :meth:`spread` does."""
        low, share = [], []
        for pixels, size, boxes in zip(pixels_px.T, self.shape[::-1], values.shape[::-1], strict=True):
            place = np.clip((pixels + 0.5) * (boxes / size) - 0.5, 0.0, boxes - 1.0)
            low.append(np.minimum(place.astype(np.intp), max(boxes - 2, 0)))
            share.append(place - low[-1])
        (x, y), (p, q) = low, share
        right, below = np.minimum(x + 1, values.shape[1] - 1), np.minimum(y + 1, values.shape[0] - 1)
        upper = values[y, x] * (1.0 - p) + values[y, right] * p
        lower = values[below, x] * (1.0 - p) + values[below, right] * p
        result: Float = upper * (1.0 - q) + lower * q
        return result


def _quartile_sigma(ordered: Image32, count: NDArray[np.int64] | np.int64) -> Image32:
    """Interquartile range, normalized by that of a unit normal, of the first ``count`` of sorted values (..., k)."""
    low, high = (np.broadcast_to(count * k // 4, ordered.shape[:-1])[..., None] for k in (1, 3))
    spread = np.take_along_axis(ordered, high, axis=-1) - np.take_along_axis(ordered, low, axis=-1)
    return np.asarray(spread[..., 0] / np.float32(IQR_PER_SIGMA), dtype=np.float32)
