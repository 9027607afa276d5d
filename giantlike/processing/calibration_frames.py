"""Bias, dark, flat and bad-pixel frames: many exposures into one, and images corrected by them.

A raw number is ``bias + dark rate * exposure + flat * light``, which is solved for the light. The noise of the frames
is included in the detector of the corrected pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, as_image, require, require_number
from giantlike.core.detector import Detector
from giantlike.core.errors import InputError
from giantlike.core.pixel_noise import sky_noise
from giantlike.core.statistics import quartile_sigma
from giantlike.core.values import Value

_CLIP_SIGMA = 4.0  # from the median, in noise of an exposure, beyond which a pixel is left out (particle, star)
_HOT_SIGMA = 8.0  # excess of a dark pixel over its neighbors, in noise of the frame, that no white noise has
_DEAD_RESPONSE = 0.5  # response relative to the neighbors below which a pixel is bad: dust dims by up to a third
_SAME_EXPOSURE = 0.01  # relative difference of exposures up to which a dark frame needs no scaling
_CALM = 0.999  # fraction of the pixels, lowest scatter first, whose scatter counts as noise: the others flicker
_NO_SHOT_NOISE = 1e30  # gain that leaves the noise of the frames alone: scatter of flats holds their shot noise
_BLOCK_ROWS = 64  # rows of all exposures that are combined at a time, to bound the memory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CombinedFrame(Value):
    """Several exposures of the same thing as one."""

    pixels: NDArray[np.float32]  # in DN; their mean; 0 where every exposure is bad
    mask: Mask  # True where every exposure is bad
    noise: float  # in DN; standard deviation of a pixel of the mean, root mean square over the frame
    count: int  # number of exposures


def combine_frames(
    frames: Sequence[NDArray[Any]] | NDArray[Any], masks: Sequence[Mask] | None = None, *, normalize: bool = False
) -> CombinedFrame:
    """Average exposures pixel by pixel, without particles and stars.

    ``frames`` sequence of (rows, columns) DN; ``masks`` sequence of (rows, columns).

    >>> exposures = np.random.default_rng(1).normal(100.0, 3.0, (9, 50, 50))
    >>> exposures[4, 10, 10] = 5000.0  # a particle
    >>> bias = combine_frames(exposures)
    >>> round(bias.noise, 1), bool(abs(bias.pixels[10, 10] - 100.0) < 5.0)
    (1.0, True)
    """
    require(len(frames) > 0, "there are no frames to combine")
    shape = as_image(frames[0], "frame 0").shape
    stack = np.empty((len(frames), *shape), dtype=np.float32)
    for number, frame in enumerate(frames):
        array = as_image(frame, f"frame {number}")
        require(array.shape == shape, f"frame {number} has the shape {array.shape}, the first one {shape}")
        bad = ~np.isfinite(array)
        if masks is not None and np.size(masks[number]):
            bad |= np.asarray(masks[number], dtype=bool)
        stack[number] = np.where(bad, np.nan, array)
        if normalize:
            level = float(np.median(array[~bad])) if not bad.all() else 0.0
            require(
                level > 0.0,
                f"frame {number} has the median {level:g}, and a flat must be > 0 once bias and dark are off",
            )
            stack[number] /= np.float32(level)
    if len(frames) == 1:
        bad = np.isnan(stack[0])
        pixels = np.where(bad, 0.0, stack[0]).astype(np.float32)
        return CombinedFrame(pixels=pixels, mask=bad, noise=sky_noise(pixels, bad), count=1)
    return _average(stack)


def _average(stack: NDArray[np.float32]) -> CombinedFrame:
    """Clipped mean of exposures (n, rows, columns), whose bad pixels are NaN."""
    count, rows, columns = stack.shape
    steps = np.diff(stack[:, ::3, ::3], axis=0)
    steps = steps[np.isfinite(steps)]
    sigma = quartile_sigma(steps) / math.sqrt(2.0) if steps.size else 0.0
    pixels, number = np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.int64)
    squares = np.zeros((rows, columns))
    for first in range(0, rows, _BLOCK_ROWS):
        part = slice(first, first + _BLOCK_ROWS)
        block = stack[:, part].astype(np.float64)
        kept = _is_near_median(block, sigma) if count >= 3 else np.isfinite(block)
        number[part] = kept.sum(axis=0)
        pixels[part] = np.where(kept, block, 0.0).sum(axis=0) / np.maximum(number[part], 1)
        squares[part] = np.where(kept, (block - pixels[part]) ** 2, 0.0).sum(axis=0)
    calm = (squares <= np.quantile(squares, _CALM)) & (number > 1)
    variance = float(squares[calm].sum()) / max(float((number[calm] - 1).sum()), 1.0)
    return CombinedFrame(pixels=pixels, mask=number == 0, noise=math.sqrt(variance / count), count=count)


def _is_near_median(block: Float, sigma: float) -> Mask:
    """True where a value (n, rows, columns) is finite and near the median of its pixel."""
    finite = np.isfinite(block)
    middle = np.maximum((finite.sum(axis=0) - 1) // 2, 0)[None]
    median = np.take_along_axis(np.sort(block, axis=0), middle, axis=0)  # NaN comes last
    away = np.abs(block - median)
    spread = 1.4826 * np.take_along_axis(np.sort(away, axis=0), middle, axis=0)
    return finite & (away <= _CLIP_SIGMA * np.fmax(sigma, spread))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibratedPixels(Value):
    """Pixels corrected for bias, dark current and differences of response, with their mask and detector."""

    pixels: NDArray[np.float32]  # in DN; 0 where the mask is True
    mask: Mask  # True where a pixel is bad
    detector: Detector  # with the noise of the frames, without the subtracted bias; saturation as raw


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibrationFrames(Value):
    """Frames that correct the images of one detector: ``(raw - bias - dark * exposure ratio) / flat``."""

    bias: CombinedFrame | None = None  # exposures of zero length
    dark: CombinedFrame | None = None  # exposures without light
    dark_exposure_s: float | None = None  # exposure of the dark; needed with a dark
    dark_has_bias: bool = True  # as raw exposures have; without a bias frame, only for images of this exposure
    flat: CombinedFrame | None = None  # response to uniform light, without bias and dark, median 1
    bad: Mask = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))  # True if bad, hot in dark, dead in flat

    def __post_init__(self) -> None:
        named = {"bias": self.bias, "dark": self.dark, "flat": self.flat}
        shapes = {name: frame.pixels.shape for name, frame in named.items() if frame is not None}
        if self.bad.size:
            shapes["bad pixels"] = self.bad.shape
        require(bool(shapes), "there are no calibration frames: give at least one of bias, dark, flat and bad pixels")
        require(len(set(shapes.values())) == 1, f"calibration frames differ in size (rows, columns): {shapes}")
        bad = np.zeros(next(iter(shapes.values())), dtype=bool) | (self.bad if self.bad.size else False)
        for frame in named.values():
            bad |= False if frame is None else frame.mask
        if self.dark is not None:
            if self.dark_exposure_s is None:
                raise InputError("the exposure of the dark frames is not known: give it in s")
            require_number(self.dark_exposure_s, "exposure of the dark, s", above=0.0)
            hot = self.dark.pixels - (0.0 if self.bias is None or not self.dark_has_bias else self.bias.pixels)
            noise = math.hypot(self.dark.noise, 0.0 if self.bias is None else self.bias.noise)
            excess = hot - _around(hot)
            bad |= excess > _HOT_SIGMA * max(noise, quartile_sigma(excess))
        if self.flat is not None:
            level = float(np.median(self.flat.pixels[~bad])) if not bad.all() else 0.0
            require(level > 0.0, f"the median of the flat is {level:g}, it must be > 0 once bias and dark are off")
            pixels = self.flat.pixels / np.float32(level)
            bad |= pixels < _DEAD_RESPONSE * _around(pixels)
            bad |= pixels <= 0.0
            object.__setattr__(self, "flat", replace(self.flat, pixels=pixels, noise=self.flat.noise / level))
        self._keep(bad=bad)

    def apply(
        self, pixels: NDArray[Any], detector: Detector, *, exposure_s: float | None = None, mask: Mask | None = None
    ) -> CalibratedPixels:
        """Correct the pixels of an image.

        The detector gets the noise of bias and dark as one number, and the noise of the flat relative to the signal.
        Shot noise of the dark current is that of its median; pixels far above it are hot and bad. Gain and read noise
        refer to a response of 1: where a lens passes half of the light, noise is understated by up to 1.4 (shot) and 2
        (read noise) times.
        """
        array = as_image(pixels, "pixels")
        require(
            array.shape == self.bad.shape,
            f"the image has {array.shape} rows and columns, the calibration frames {self.bad.shape}: "
            "use frames of the same window and binning",
        )
        offset, dark_dn, variance = self._offset(exposure_s, detector.bias_dn)
        flat = 1.0 if self.flat is None else np.where(self.bad, np.float32(1.0), self.flat.pixels)
        bad = self.bad | ~np.isfinite(array)
        if mask is not None and mask.size:
            bad |= mask
        sound = np.where(bad, 0, array).astype(array.dtype)
        corrected = np.asarray((sound - offset) / flat, dtype=np.float32)
        clipped = ~bad & (sound >= _full_dn(array, detector))
        corrected[bad] = 0.0
        bias_is_off = self.bias is not None or (self.dark is not None and self.dark_has_bias)
        known = detector if detector.estimated else detector.of_image(sound, bad)
        return CalibratedPixels(
            pixels=corrected,
            mask=bad,
            detector=replace(
                known,
                bias_dn=0.0 if bias_is_off else known.bias_dn,
                saturation_dn=float(corrected[clipped].min()) if clipped.any() else math.inf,
                frame_noise_dn=0.0 if known.estimated else math.sqrt(variance + dark_dn / known.gain_e_per_dn),
                relative_noise=0.0 if self.flat is None else self.flat.noise,
            ),
        )

    def _offset(self, exposure_s: float | None, bias_dn: float) -> tuple[Float | NDArray[np.float32], float, float]:
        """Sum of the subtracted frames, DN; the median of its dark current, DN; the variance of the sum, DN^2."""
        off = np.zeros((1, 1)) if self.bias is None else self.bias.pixels
        bias_variance = 0.0 if self.bias is None else self.bias.noise**2
        if self.dark is None or self.dark_exposure_s is None:
            return off, 0.0, bias_variance
        if exposure_s is None:
            raise InputError("the exposure of the image is not known, so the dark cannot be scaled to it")
        ratio = exposure_s / self.dark_exposure_s
        dark = self.dark.pixels
        if self.dark_has_bias and self.bias is None:
            if abs(ratio - 1.0) > _SAME_EXPOSURE:
                raise InputError(
                    f"a dark of {self.dark_exposure_s:g} s with its bias cannot be scaled to the {exposure_s:g} s of "
                    "an image: add bias frames, or darks of that exposure"
                )
            level = float(np.median(dark[~self.bad])) - bias_dn if not self.bad.all() else 0.0
            return dark, max(level, 0.0), self.dark.noise**2
        current = (dark - off if self.dark_has_bias else dark) * np.float32(ratio)
        level = float(np.median(current[~self.bad])) if not self.bad.all() else 0.0
        bias_share = 1.0 - ratio if self.dark_has_bias else 1.0  # the same bias is in both
        variance = bias_share**2 * bias_variance + (ratio * self.dark.noise) ** 2
        return off + current, max(level, 0.0), variance


def flat_from(
    exposures: Sequence[NDArray[Any]],
    masks: Sequence[Mask] | None = None,
    *,
    offsets: CalibrationFrames | None = None,
    exposures_s: Sequence[float | None] | None = None,
) -> CombinedFrame:
    """Combine exposures of even light, (rows, columns) DN each, into a flat."""
    if offsets is None:
        return combine_frames(exposures, masks, normalize=True)
    noiseless = Detector(gain_e_per_dn=_NO_SHOT_NOISE, read_noise_e=0.0, step_dn=0.0)
    done = [
        offsets.apply(
            exposure,
            noiseless,
            exposure_s=None if exposures_s is None else exposures_s[number],
            mask=None if masks is None else masks[number],
        )
        for number, exposure in enumerate(exposures)
    ]
    flat = combine_frames([one.pixels for one in done], [one.mask for one in done], normalize=True)
    common = [one.detector.frame_noise_dn / float(np.median(one.pixels[~one.mask])) for one in done]
    return replace(flat, noise=math.hypot(flat.noise, float(np.mean(common))))


def _around(pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Median of the 5 x 5 pixels around each."""
    return np.asarray(cv2.medianBlur(np.ascontiguousarray(pixels, dtype=np.float32), 5), dtype=np.float32)


def _full_dn(pixels: NDArray[Any], detector: Detector) -> float:
    """Raw number at which a pixel is saturated."""
    limit = float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind in "iu" else math.inf
    return min(detector.saturation_dn, limit)
