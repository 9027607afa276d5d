"""Point sources detected in an image, with their measurements and flags."""

from __future__ import annotations

import enum
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value, select_rows


class DetectionFlag(enum.IntFlag):
    """Reasons to doubt a detection; several may be set."""

    NONE = 0
    SATURATED = 1
    """Saturated pixels lie within the core; the fit uses them as lower bounds."""
    MASKED = 2
    """Bad pixels lie within the core; the fit does not use them."""
    CUT_BY_FRAME = 4
    """The core reaches over the edge of the image."""
    EXTENDED = 8
    """Wider or longer than a star: a resolved body, an edge, a trail, a galaxy."""
    SHARP = 16
    """Narrower than the PSF: a hot pixel or a cosmic ray."""
    BLENDED = 32
    """Another detection lies so close that the two fits have common pixels."""
    FIT_FAILED = 64
    """The fit did not converge near the peak; the position is the peak, with a wide covariance."""
    COSMIC_RAY = 128
    """The track of a charged particle: light in a few pixels, unlike a point through the PSF."""
    HOT_PIXEL = 256
    """Stays at its pixel from image to image while the stars move."""
    STREAK = 512
    """A line as wide as the PSF: a star or another source that moved; the position is its middle."""

    def names(self) -> tuple[str, ...]:
        """Lower-case names of the flags that are set, in order of definition.

        >>> (DetectionFlag.BLENDED | DetectionFlag.SATURATED).names()
        ('saturated', 'blended')
        """
        return tuple(str(flag.name).lower() for flag in DetectionFlag if flag in self)


NOT_A_STAR = (
    DetectionFlag.EXTENDED
    | DetectionFlag.SHARP
    | DetectionFlag.FIT_FAILED
    | DetectionFlag.COSMIC_RAY
    | DetectionFlag.HOT_PIXEL
)
"""Flags of detections that cannot be used as stars; see :attr:`Detections.clean`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UnmeasuredSources(Value):
    """Sources found in an image and not fitted."""

    peaks_px: NDArray[np.int64]  # (n, 2); brightest pixels of the filtered image
    sigma_px: Float  # (n,); standard deviation per axis that a fit of a star so bright would have


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Detections(Value):
    """Point sources of one image, brightest first.

    Parameters
    ----------
    points_px : (n, 2) float64, px; centroids (x, y)
    covariance_px2 : (n, 2, 2) float64, px^2; of each centroid
    flux_dn : (n,) float64, DN; integral of the fitted Gaussian
    snr : (n,) float64
        Signal-to-noise ratio of a matched filter: ``flux / (noise * 2 sqrt(pi) sigma)`` with the noise at the source
        and the recorded width of a star, ``sigma^2 = psf_sigma_px^2 + 1/12``.
    peak_dn : (n,) float64, DN; brightest pixel of the core above background
    area_px : (n,) int64, px; connected pixels of the source above the detection threshold
    background_dn : (n,) float64, DN; level under the source, from the fit
    width_px : (n,) float64, px; fitted sigma before the pixels integrate it; ``psf_sigma_px`` for a star
    flags : (n,) uint16; combinations of :class:`DetectionFlag`
    psf_sigma_px : float, px; point spread function used, given or estimated from the image
    noise_dn : float, DN; background noise of a pixel, median over the image
    halves_px : (n, 2) float64, px, optional
        Vector from the middle of a streak to one end, zero where there is no streak; None where streaks were not
        fitted. The ends are ``points_px`` plus and minus this.
    half_sigma_px : (n,) float64, px, optional; standard deviation of half the length
    moments : (n, 2) float64, optional
        Second moments along the longest and the shortest axis in a Gaussian window as wide as a star, in units of the
        window's; 0.5 for a star; None where streaks were fitted.
    left_out : UnmeasuredSources, optional; left unmeasured by ``DetectionOptions.information``; None: none
    """

    points_px: Float
    covariance_px2: Float
    flux_dn: Float
    snr: Float
    peak_dn: Float
    area_px: NDArray[np.int64]
    background_dn: Float
    width_px: Float
    flags: NDArray[np.uint16]
    psf_sigma_px: float
    noise_dn: float
    halves_px: Float | None = None
    half_sigma_px: Float | None = None
    moments: Float | None = None
    left_out: UnmeasuredSources | None = None

    def __len__(self) -> int:
        return int(self.flags.size)

    @property
    def sigma_px(self) -> Float:
        """Standard deviation per axis (n,), px: the root of the mean of the two variances."""
        result: Float = np.sqrt(np.trace(self.covariance_px2, axis1=1, axis2=2) / 2.0)
        return result

    @property
    def clean(self) -> Mask:
        """True (n,) for detections that look like stars, blended ones included: no flag of ``NOT_A_STAR``."""
        result: Mask = (self.flags & np.uint16(NOT_A_STAR)) == 0
        return result

    def select(self, which: Mask | NDArray[np.integer]) -> Detections:
        """Detections of a mask (n,) or of indices (k,), in their order."""
        return select_rows(self, which)

    def joined(self, other: Detections) -> Detections:
        """These detections, then those of other sources of the same image, without streaks; nothing is left out."""
        parts: dict[str, Any] = {
            field.name: np.concatenate([getattr(self, field.name), getattr(other, field.name)])
            for field in fields(self)
            if isinstance(getattr(self, field.name), np.ndarray)
        }
        return replace(self, **parts, left_out=None)

    @classmethod
    def empty(cls, *, psf_sigma_px: float, noise_dn: float) -> Detections:
        """Result of an image without sources."""
        none = np.zeros(0)
        return cls(
            points_px=np.zeros((0, 2)),
            covariance_px2=np.zeros((0, 2, 2)),
            flux_dn=none,
            snr=none,
            peak_dn=none,
            area_px=np.zeros(0, dtype=np.int64),
            background_dn=none,
            width_px=none,
            flags=np.zeros(0, dtype=np.uint16),
            psf_sigma_px=psf_sigma_px,
            noise_dn=noise_dn,
        )
