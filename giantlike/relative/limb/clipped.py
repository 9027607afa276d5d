"""Profiles of a limb whose disk is saturated: the rendered body, clipped where the detector was.

A clipped pixel is a lower limit. The template is clipped at the same level before the comparison, so that the limb lies
where the brightness falls below the level. The brightness of the body above it is one more parameter of all lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import ndtr

from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.processing.limb.measurement import pixels_near
from giantlike.processing.limb.scan import Scans, match_profiles, values_on_lines
from giantlike.processing.limb.view import LimbView

_GAINS = np.geomspace(1.03, 16.0, 13)
"""Trial ratios of the brightest rendered pixel to the clipping level. Beyond sixteen the halo of the body, which is not
Gaussian, is as wide as the window."""
_FINER_GAINS = np.geomspace(0.85, 1.18, 9)
"""Trial gains relative to the best of these, 4 % apart, over which a clipped profile is nearly linear."""
LOG_GAIN_SIGMA = 0.5
"""A priori standard deviation of the logarithm of the brightness about the best of these: two of the steps."""
EXTRAPOLATION_ERROR = 0.17
"""Ratio of the standard deviation of the logarithm of the brightness to its squared extrapolation above the level.

The first order is fitted, so that the error is of second order. Maximum likelihood of 80 limbs of the independent
renderer (radii of 30-150 px, phase angles of 15-125 deg, levels of a fifth to five sixths of the peak, three laws):
squared errors per degree of freedom are 0.4 to 2.0 at each level. With a linear error of 0.2 they are 0.1 to 0.3 at
half of the peak and more, 2 at a third, and the log likelihood is lower by 55.
"""
_EACH_LINE = 4  # every so many lines are used to choose among them


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClippedProfiles(Value):
    """Profiles of a clipped body, DN."""

    values: Float  # (n, m) DN
    laws: Float  # (n, m, k) DN; change with the share of each of k other laws
    brightness: Float  # (n, m) DN; change with the logarithm of the brightness
    blur: Float  # (n, m) DN/px^2; change with the variance of the point spread function
    beyond: Float  # (n,); logarithm of the brightness of each line over the level, 0 where it is not clipped


def clipping_level_dn(view: LimbView, scans: Scans) -> float | None:
    """Level at which the pixels on lines across a limb are clipped.

    Returns None where no patch of saturated pixels lies on the lines.
    """
    clipped = view.clipped_pixels
    if clipped.any():
        clipped = clipped & pixels_near(scans.points_px, scans.normals_px, scans.offsets_px, view.usable.shape)
    return float(view.pixels_dn[clipped].min()) if clipped.any() else None


def clipped_profiles(
    images: Sequence[Float], scans: Scans, level_dn: float, view: LimbView, *, window_px: float, search_px: float
) -> ClippedProfiles:
    """Clip a rendered body at a level, with the brightness that fits the image best.

    ``images`` sequence of (rows, columns); ``window_px``, ``search_px`` as for
    :func:`giantlike.processing.limb.scan.match_profiles`.
    """
    variance = view.detector.variance_dn2

    def sample(image: Float) -> Float:
        values: Float = values_on_lines(image[None], scans.points_px, scans.normals_px, scans.offsets_px)[0]
        return values

    few = scans.some(slice(None, None, _EACH_LINE))

    def clip(image: Float) -> tuple[Float, Float]:
        return clipped_mean(image, level_dn, np.sqrt(variance(image)))

    def misfit(gain: float) -> float:
        expected = sample(clip(gain * images[0])[0])[::_EACH_LINE]
        match = match_profiles(few, expected, variance_dn2=variance, window_px=window_px, search_px=search_px)
        counted = match.complete & (match.gain_dn > 0.0)
        return float(np.median(match.unexplained[counted])) if counted.any() else np.inf

    lowest = level_dn / float(images[0].max())
    gain = min(_GAINS * lowest, key=misfit)
    gain = min(gain * _FINER_GAINS, key=misfit)
    body = gain * images[0]
    mean, below = clip(body)
    height = sample(body).max(axis=1)
    others = [sample((gain * law - body) * below) for law in images[1:]]
    return ClippedProfiles(
        values=sample(mean),
        beyond=np.log(np.maximum(height / level_dn, 1.0)),
        laws=np.stack(others, axis=-1) if others else np.zeros((*scans.values_dn.shape, 0)),
        brightness=sample(body * below),
        blur=sample(np.asarray(0.5 * cv2.Laplacian(body, cv2.CV_64F) * below, dtype=np.float64)),
    )


def clipped_mean(mean: Float, level: float, sigma: Float) -> tuple[Float, Float]:
    """Mean of noisy values clipped at a level; below the level even where it equals the mean.

    ``mean``, ``sigma`` (...); returns ``clipped`` (...) and ``below`` (...).

    >>> clipped, below = clipped_mean(np.array([0.0, 5.0, 10.0]), 5.0, np.ones(3))
    >>> abs(clipped).round(3).tolist(), below.round(3).tolist()
    ([0.0, 4.601, 5.0], [1.0, 0.5, 0.0])
    """
    over = (mean - level) / sigma
    density = np.exp(-0.5 * over**2) / np.sqrt(2.0 * np.pi)
    above = ndtr(over)
    return mean - sigma * (over * above + density), 1.0 - above
