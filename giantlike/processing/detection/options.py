"""Options of the detection of point sources."""

from __future__ import annotations

from dataclasses import dataclass

from giantlike.core.arrays import require, require_number
from giantlike.processing.detection.noise import NoiseSource, Region


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionOptions:
    """Options of the detection of point sources.

    Parameters
    ----------
    threshold_sigma : float
        Detection limit of the filtered image in units of its local noise. Default 5: of white noise about one pixel in
        three million exceeds it.
    max_sources : int
        Keep at most this many, the most significant ones. Default 2000: bounds the time of crowded or noisy images;
        the attitude from 100 bright stars is within 0.0013 px of that from 2000.
    information : float
        Fraction of the information on position (the sum of 1 / sigma^2 per axis) that the measured sources must have,
        in (0, 1]: the most significant are measured until the rest, as predicted from noise before a fit, has no more
        than the remainder. Sources flagged as not stars do not count. Default 1 measures all.
    min_area_px : int, px; fewest connected pixels above the limit; default 1, as of undersampled stars
    max_saturated_fraction : float
        An image with a larger fraction of saturated pixels is refused. Default one half: the median of such an image is
        not the background.
    noise : NoiseSource; by default the image around a pixel, which needs no calibrated detector
    covered : (x, y, columns, rows), px, optional; pixels shielded from light, for ``NoiseSource.COVERED``
    streak : bool, optional
        True if the stars are trails of one direction and length, False if they are points; found from the image by
        default. With True an image without a common streak is a failure.
    searches : int
        How often to search: all but the first time in what the stars found so far leave of the image, whose noise is
        not raised by them. Default 1. A second one finds faint sources in crowded fields and beside brighter ones.

    Raises
    ------
    InputError
        A value is out of its range.
    """

    threshold_sigma: float = 5.0
    max_sources: int = 2000
    information: float = 1.0
    min_area_px: int = 1
    max_saturated_fraction: float = 0.5
    noise: NoiseSource = NoiseSource.LOCAL
    covered: Region | None = None
    streak: bool | None = None
    searches: int = 1

    def __post_init__(self) -> None:
        require_number(self.threshold_sigma, "threshold_sigma", above=0.0)
        require(self.max_sources >= 1, f"max_sources must be >= 1, got {self.max_sources}")
        require_number(self.information, "information", above=0.0, most=1.0)
        require(self.searches >= 1, f"searches must be >= 1, got {self.searches}")
        require(self.min_area_px >= 1, f"min_area_px must be >= 1, got {self.min_area_px}")
        require_number(self.max_saturated_fraction, "max_saturated_fraction", above=0.0, most=1.0)
        require(
            (self.covered is not None) == (self.noise is NoiseSource.COVERED),
            "noise from covered pixels and their region go together",
        )
