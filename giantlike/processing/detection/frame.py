"""Input of the detection: pixels and mask checked, images without information refused."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.core.arrays import Mask, as_image, require
from giantlike.core.detector import Detector
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.processing.detection.matched_filter import Image32
from giantlike.processing.detection.noise import NoiseSource, predicted_noise_dn
from giantlike.processing.detection.options import DetectionOptions
from giantlike.processing.detection.patches import Patches, cut_patches

_FLOAT_FLOOR = 1e-6  # of the range of the image: noise below it is rounding in single precision


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame(Value):
    """An image to search for sources."""

    pixels: NDArray[Any]  # in DN; as stored, finite
    bad: Mask | None
    flat: Image32  # (rows, columns) DN; the image minus its median, in single precision: input of the matched filter
    detector: Detector  # an integer image also saturates at the end of its dtype
    noise_floor_dn: float  # lower bound of the noise of a pixel: quantization
    noise_dn: Image32 | None  # (rows, columns); noise of a pixel; None where it is measured on the filtered image
    any_saturated: bool  # True if a good pixel is saturated

    def patches(self, points_px: NDArray[np.int64], half_px: int, noise_dn: ArrayLike = 1.0) -> Patches:
        """Cut-outs of ``2 half_px + 1`` pixels around pixels (n, 2), of background noise (n,), DN."""
        return cut_patches(self.pixels, self.bad, points_px, half_px, noise_dn=noise_dn, detector=self.detector)


def frame_of(
    pixels: ArrayLike, mask: ArrayLike | None, detector: Detector, options: DetectionOptions
) -> Frame | Failure:
    """Check the pixels, DN, and mask of an image for detection; pixels that are not finite are bad too."""
    array = as_image(pixels, "pixels")
    bad = np.zeros((0, 0), dtype=bool) if mask is None else np.asarray(mask, dtype=bool)
    require(bad.size == 0 or bad.shape == array.shape, f"mask shape {bad.shape} differs from pixels {array.shape}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        bad = ~np.isfinite(array) | (bad if bad.size else False)
        array = np.where(bad, 0, array)
    masked = bad if bad.any() else None
    good = array if masked is None else array[~masked]
    if not good.size:
        return Failure(Reason.NO_SIGNAL, "every pixel is masked or not finite")
    low, high = float(good.min()), float(good.max())
    saturation = saturation_of(array.dtype, detector.saturation_dn)
    saturated = float(np.count_nonzero(good >= saturation)) / good.size if high >= saturation else 0.0
    if saturated > options.max_saturated_fraction:
        return Failure(
            Reason.SATURATED,
            f"{saturated:.0%} of the pixels are at or above saturation ({saturation:g} DN), "
            f"at most {options.max_saturated_fraction:.0%} may be: use a shorter exposure",
        )
    if low == high:
        return Failure(Reason.NO_SIGNAL, f"every pixel has the value {low:g} DN: there is nothing to detect")
    sample = good[::7, ::7] if good.ndim == 2 else good[::49]
    detector = detector.of_image(array, masked)
    return Frame(
        pixels=array,
        bad=masked,
        flat=np.subtract(array, np.median(sample), dtype=np.float32),
        detector=replace(detector, saturation_dn=saturation),
        any_saturated=saturated > 0.0,
        noise_floor_dn=max((detector.step_dn or 0.0) / math.sqrt(12.0), _FLOAT_FLOOR * (high - low)),
        noise_dn=None
        if options.noise is NoiseSource.LOCAL
        else predicted_noise_dn(array, masked, source=options.noise, detector=detector, covered=options.covered),
    )


def saturation_of(dtype: np.dtype[Any], saturation_dn: float) -> float:
    """Value at which pixels of a dtype saturate, DN: the limit of the detector or the end of an integer type."""
    return min(saturation_dn, float(np.iinfo(dtype).max)) if dtype.kind in "iu" else saturation_dn
