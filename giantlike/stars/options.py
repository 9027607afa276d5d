"""Options of star identification and attitude."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float, Mask, require, require_number
from giantlike.stars.attitude import AttitudeMethod

_ALWAYS_KEPT = 20  # detections of an image kept at any signal to noise ratio: 40 equations for 3 unknowns


@dataclass(frozen=True, slots=True, kw_only=True)
class StarOptions:
    """Options of star identification and attitude.

    Parameters
    ----------
    max_magnitude : float, optional; faintest star, in the band of the catalog; default: by number of detections
    lost_in_space : bool; search the whole sky if there is no a priori attitude or no stars are found with it
    estimate_scale : bool
        Estimate focal length and radial distortion k1 together with the attitude, for cameras of which only
        a rough field of view is known. Principal point and distortion center stay at the image center.
    scale_error : float
        Relative error that the rough field of view may have, in (0, 0.2]; used with ``estimate_scale``. Default 5 %:
        benchmarks/identification.py solves all of 30 fields with it.
    max_pixel_distance : float, px
        Search radius around the predicted position of a star in the first attempt with the a priori attitude (RANSAC
        over nearest neighbors). Default 100 px: 0.2 degrees for a camera of 4 degrees and 2,000 pixels; larger errors
        are left to the patterns of stars.
    attitude_error_deg : float, deg
        Largest error of the a priori attitude about any axis, in (0, 180]. If nearest neighbors find no stars, patterns
        of stars are searched among all attitudes within this angle. Default 5: benchmarks/identification.py solves all
        fields with errors up to 3 degrees.
    inlier_px : float, px
        Largest distance of a star from its position under the correct attitude. Default 3: below the 4 px at which
        stars blend; no study yet, see benchmarks/sensitivity.py.
    ransac_iterations : int
        Number of random samples of four stars. Default 300: with half of the pairs wrong, all samples contain a wrong
        one with probability 4e-9.
    seed : int; of the samples: equal input gives equal output; the default is arbitrary
    min_snr : float
        Detections of a lower signal to noise ratio are left out, but never the brightest 20. Default 0 uses all: each
        is weighted with its covariance.
    all_stars : bool; measure all, not only until the rest would shrink the covariance by less than 5 %
    min_matches : int; fewest stars of a solution, 3 or more; default 4: one more than an attitude needs
    outlier_sigma : float
        A star further from its position than this many standard deviations is rejected. Default 4: of 100 good stars, a
        two-dimensional normal error exceeds it once in 30 images.
    max_false_match_probability : float
        An identification that is random with a higher probability is refused. Default 1e-6: one wrong attitude
        in a million images at most.
    attitude_method : AttitudeMethod; default ``weighted``: full covariances; the others need a known scale
    light_deflection : bool
        Apply the deflection of light by the Sun, where the position of the spacecraft is known. Default off: it
        exceeds 0.01 arcsec only within 44 degrees of the Sun (4.07 mas / tan(angle / 2) at 1 au).
    unknown_speed_km_s : float, km/s
        Root mean square speed, with respect to the solar system barycenter and in any direction, of an observer whose
        velocity is not known: its aberration enters the covariance. Default 30: the Earth moves with 29.8, Venus
        with 35, Mars with 24; that is 12 arcsec about each axis across the line of sight.
    unknown_epoch_years : float, years
        Standard deviation of the time from J2016.0 of an image without an epoch: the proper motion of its stars enters
        the covariance. Default 15: images of this century lie within one of them, images of Voyager within three.

    time_limit_s : float, s
        Computing time after which the search for patterns in an image ends with the reason ``time_limit``. Default 60:
        images that are solved take a few seconds, and indices of patterns that are made first up to 10.

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
    all_stars: bool = False
    min_matches: int = 4
    outlier_sigma: float = 4.0
    max_false_match_probability: float = 1e-6
    attitude_method: AttitudeMethod = AttitudeMethod.WEIGHTED
    light_deflection: bool = False
    unknown_speed_km_s: float = 30.0
    unknown_epoch_years: float = 15.0
    time_limit_s: float = 60.0

    def __post_init__(self) -> None:
        if self.max_magnitude is not None:
            require_number(self.max_magnitude, "max_magnitude")
        require_number(self.scale_error, "scale_error", above=0.0, most=0.2)
        require_number(self.max_pixel_distance, "max_pixel_distance", above=0.0)
        require_number(self.attitude_error_deg, "attitude_error_deg", above=0.0, most=180.0)  # which is any attitude
        require_number(self.inlier_px, "inlier_px", above=0.0)
        require_number(self.time_limit_s, "time_limit_s", above=0.0)
        require_number(self.unknown_speed_km_s, "unknown_speed_km_s", least=0.0)
        require_number(self.unknown_epoch_years, "unknown_epoch_years", least=0.0)
        for name, least in (
            ("ransac_iterations", 1),
            ("seed", 0),
            ("min_snr", 0),
            ("min_matches", 3),
            ("outlier_sigma", 2),
        ):
            require(getattr(self, name) >= least, f"{name} must be >= {least}, got {getattr(self, name)}")
        chance = self.max_false_match_probability
        require(0.0 < chance < 1.0, f"max_false_match_probability must be in (0, 1), got {chance}")
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
    """Select detections (k,) by signal to noise ratio; the 20 brightest at any ratio."""
    bright: Mask = snr >= min_snr
    bright[np.argsort(-snr, kind="stable")[:_ALWAYS_KEPT]] = True
    return bright
