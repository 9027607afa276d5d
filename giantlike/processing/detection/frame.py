"""What comes into a detection: pixels checked, bad ones gathered, images without information refused."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.core.arrays import Mask, require
from giantlike.core.detector import Detector
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.processing.detection.matched_filter import Image32
from giantlike.processing.detection.noise import NoiseSource, Region, predicted_noise_dn

_QUANTIZATION_DN = 1.0 / math.sqrt(12.0)
_FLOAT_FLOOR = 1e-6  # of the range of the image: noise below it is rounding in single precision


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame(Value):
    """An image as the steps of a detection need it.

    Parameters
    ----------
    pixels : (rows, columns) real, DN
        As stored, finite.
    bad : (rows, columns) bool or None
    flat : (rows, columns) float32, DN
        In single precision near zero, for the filter.
    saturation_dn, gain_e_per_dn, noise_floor_dn : float
    noise_dn : (rows, columns) float32, DN, or None
        Where it is not measured on the image itself.
    """

    pixels: NDArray[Any]
    bad: Mask | None
    flat: Image32
    saturation_dn: float
    gain_e_per_dn: float
    noise_floor_dn: float
    noise_dn: Image32 | None


def frame_of(
    pixels: ArrayLike,
    mask: ArrayLike | None,
    detector: Detector,
    max_saturated_fraction: float,
    *,
    noise: NoiseSource,
    covered: Region | None,
) -> Frame | Failure:
    """Check what came in, gather bad pixels, refuse images without information."""
    array = np.asarray(pixels)
    require(
        array.ndim == 2 and array.size > 0 and array.dtype.kind in "iuf",
        f"pixels must be a 2-D array of real numbers, got {array.dtype} of shape {array.shape}",
    )
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
    integer = array.dtype.kind in "iu"
    saturation = min(detector.saturation_dn, float(np.iinfo(array.dtype).max) if integer else math.inf)
    saturated = float(np.count_nonzero(good >= saturation)) / good.size if high >= saturation else 0.0
    if saturated > max_saturated_fraction:
        return Failure(
            Reason.SATURATED,
            f"{saturated:.0%} of the pixels are at or above saturation ({saturation:g} DN), "
            f"at most {max_saturated_fraction:.0%} may be: expose shorter",
        )
    if low == high:
        return Failure(Reason.NO_SIGNAL, f"every pixel is {low:g} DN: there is nothing to detect")
    sample = good[::7, ::7] if good.ndim == 2 else good[::49]
    whole = integer or bool((sample == np.round(sample)).all())
    return Frame(
        pixels=array,
        bad=masked,
        flat=np.subtract(array, np.median(sample), dtype=np.float32),
        saturation_dn=saturation,
        gain_e_per_dn=detector.gain_e_per_dn,
        noise_floor_dn=_QUANTIZATION_DN if whole else _FLOAT_FLOOR * (high - low),
        noise_dn=None
        if noise is NoiseSource.LOCAL
        else predicted_noise_dn(array, masked, source=noise, detector=detector, covered=covered),
    )
