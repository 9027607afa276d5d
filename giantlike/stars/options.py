"""What a user may choose in star processing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float, Mask, require
from giantlike.stars.attitude import AttitudeMethod

_NEVER_LEFT_OUT = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class StarOptions:
    """Options of star identification and attitude.

    Parameters
    ----------
    max_magnitude : float, optional
        Faintest catalog star, in the catalog's band. Default: as deep as the number of detections asks for.
    lost_in_space : bool
        Search the whole sky when there is no a priori attitude or it does not lead to stars.
    estimate_scale : bool
        Estimate focal length and radial distortion k1 together with the attitude: for cameras of which only
        a rough field of view is known. Principal point and distortion center stay at the image center.
    scale_error : float
        Relative error that the rough field of view may have, in (0, 0.2]; used with ``estimate_scale``.
    max_pixel_distance : float, px
        How far from its predicted place a star is looked for first with the a priori attitude (RANSAC over nearest
        neighbors).
    attitude_error_deg : float, deg
        How wrong the a priori attitude may be, about any axis, in (0, 180]. Where nearest neighbors do not lead to
        stars, patterns of stars are looked for among all attitudes within this angle.
    inlier_px : float, px
        Largest distance of a star from its place under the right attitude.
    ransac_iterations : int
        Number of four-star samples.
    seed : int
        Of the samples: equal input gives equal output.
    min_snr : float
        Detections of a lower signal-to-noise ratio are left out, but never the brightest 20.
    min_matches : int
        Fewest stars that make a solution, at least 3.
    outlier_sigma : float
        A star further from its place than this many standard deviations is rejected.
    max_false_match_probability : float
        An identification more likely than this to be chance is refused.

    attitude_method : AttitudeMethod
        How the attitude follows from the stars identified; all but ``weighted`` need a scale that is known.
    light_deflection : bool
        Bend the light of stars in the field of the Sun, where the place of the spacecraft is known.

    Raises
    ------
    InputError
        A value is out of range.
    """

    max_magnitude: float | None = None
    lost_in_space: bool = False
    estimate_scale: bool = False
    scale_error: float = 0.05
    max_pixel_distance: float = 100.0
    attitude_error_deg: float = 5.0
    inlier_px: float = 3.0
    ransac_iterations: int = 300
    seed: int = 20181203
    min_snr: float = 0.0
    min_matches: int = 4
    outlier_sigma: float = 4.0
    max_false_match_probability: float = 1e-6
    attitude_method: AttitudeMethod = AttitudeMethod.WEIGHTED
    light_deflection: bool = False

    def __post_init__(self) -> None:
        limit = self.max_magnitude
        require(limit is None or math.isfinite(limit), f"max_magnitude must be finite, got {limit}")
        require(0.0 < self.scale_error <= 0.2, f"scale_error must be in (0, 0.2], got {self.scale_error}")
        require(
            math.isfinite(self.max_pixel_distance) and self.max_pixel_distance > 0,
            f"max_pixel_distance must be > 0 px, got {self.max_pixel_distance}",
        )
        require(
            0.0 < self.attitude_error_deg <= 180.0,
            f"attitude_error_deg must be in (0, 180], got {self.attitude_error_deg}",
        )
        require(math.isfinite(self.inlier_px) and self.inlier_px > 0, f"inlier_px must be > 0 px, got {self.inlier_px}")
        require(self.ransac_iterations >= 1, f"ransac_iterations must be >= 1, got {self.ransac_iterations}")
        require(self.seed >= 0, f"seed must be >= 0, got {self.seed}")
        require(self.min_snr >= 0.0, f"min_snr must be >= 0, got {self.min_snr}")
        require(self.min_matches >= 3, f"min_matches must be >= 3, got {self.min_matches}")
        require(self.outlier_sigma >= 2.0, f"outlier_sigma must be >= 2, got {self.outlier_sigma}")
        require(
            0.0 < self.max_false_match_probability < 1.0,
            f"max_false_match_probability must be in (0, 1), got {self.max_false_match_probability}",
        )
        known = [str(method) for method in AttitudeMethod]
        require(
            self.attitude_method in known,
            f"attitude_method must be one of {', '.join(known)}, got {self.attitude_method!r}",
        )
        object.__setattr__(self, "attitude_method", AttitudeMethod(self.attitude_method))
        require(
            not self.estimate_scale or self.attitude_method is AttitudeMethod.WEIGHTED,
            f"attitude_method {self.attitude_method} cannot estimate the scale; use 'weighted'",
        )


def bright_enough(snr: Float, min_snr: float) -> Mask:
    """Which of some stars (k,) reach a signal-to-noise ratio, or are among the 20 brightest anyway."""
    bright: Mask = snr >= min_snr
    bright[np.argsort(-snr, kind="stable")[:_NEVER_LEFT_OUT]] = True
    return bright
