"""Terms that the images of a pass share: estimated ones, considered ones, and their a priori uncertainties."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from giantlike.calibration.options import Treatment
from giantlike.core.arrays import require, require_number


class PassTerm(StrEnum):
    """Error that the images of a pass have in common; the values name parameters."""

    LIMB_ALTITUDE = "limb_altitude"
    """Altitude above the shape at which the limb is seen, km."""
    RANGE_SCALE = "range_scale"
    """Relative error of all predicted ranges: true is predicted times one plus this."""
    LIMB_OFFSET = "limb_offset"
    """Distance, px, by which edges are found outside the limb, in all images alike."""
    EXPOSURE_STEPS = "exposure_steps"
    """The same, px, for each exposure but the shortest, for which LIMB_OFFSET or LIMB_ALTITUDE accounts."""
    EXPOSURE_LOG = "exposure_log"
    """The same as a slope, px, by the natural logarithm of the exposure over the shortest."""
    POINTING_BIAS = "pointing_bias"
    """Small rotation about the camera axes, rad: true camera is ``Exp(e)`` times the predicted one."""
    POINTING_DRIFT = "pointing_drift"
    """Its rate about the middle of the pass, rad/s."""
    INTERLOCK = "interlock"
    """The same rotation, rad, for each attitude sensor but the first."""
    TIMETAG_BIAS = "timetag_bias"
    """Time, s, by which exposures are later than their tags."""


TRAJECTORY = "trajectory"  # name of the term whose parameters and covariance come with the pass


@dataclass(frozen=True, slots=True, kw_only=True)
class PassOptions:
    """Options of :func:`~giantlike.passes.estimate_pass`.

    Parameters
    ----------
    estimate : mapping of PassTerm to float; terms, a priori sigma of their parameters; infinite where unknown
    consider : mapping of PassTerm to float; terms not estimated, whose sigmas enter the covariance
    trajectory : Treatment; of the trajectory, where the pass has its covariance
    limb_errors : Treatment
        Of the errors that limbs share (blur, law, relief): estimated with their a priori covariance, which weights
        the points as their full covariance would, or considered.
    timetag_jitter_s : float, s; sigma of each tag in addition to the bias; first guess where estimated
    estimate_jitter : bool; find that standard deviation, by the restricted likelihood
    pointing_jitter_rad : float, rad; sigma about each axis of an attitude error new in every image
    scale_noise : bool; enlarge the part of the noise where residuals are larger than it explains
    outlier_sigmas : float; points, or positions, with larger residuals are left out
    max_iterations : int
    tolerance : float; the fit has converged when no parameter moves by more than this times its standard deviation
    """

    estimate: Mapping[PassTerm, float] = field(
        default_factory=lambda: {PassTerm.LIMB_ALTITUDE: math.inf, PassTerm.POINTING_BIAS: math.inf}
    )
    consider: Mapping[PassTerm, float] = field(default_factory=dict)
    trajectory: Treatment = Treatment.CONSIDER
    limb_errors: Treatment = Treatment.ESTIMATE
    timetag_jitter_s: float = 0.0
    estimate_jitter: bool = False
    pointing_jitter_rad: float = 0.0
    scale_noise: bool = True
    outlier_sigmas: float = 6.0
    max_iterations: int = 15
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        for name in ("estimate", "consider"):
            terms = {}
            for term, sigma in getattr(self, name).items():
                require(term in list(PassTerm), f"{name}: there is no term {term!r}; there are {', '.join(PassTerm)}")
                known = sigma == math.inf and name == "estimate"
                if not known:
                    require_number(sigma, f"{name}[{str(term)!r}]", above=0.0)
                terms[PassTerm(term)] = float(sigma)
            object.__setattr__(self, name, terms)
        both = set(self.estimate) & set(self.consider)
        require(not both, f"estimate and consider both name {', '.join(sorted(both))}: choose one")
        object.__setattr__(self, "trajectory", Treatment(self.trajectory))
        object.__setattr__(self, "limb_errors", Treatment(self.limb_errors))
        require_number(self.timetag_jitter_s, "timetag_jitter_s", least=0.0)
        require_number(self.pointing_jitter_rad, "pointing_jitter_rad", least=0.0)
        require_number(self.outlier_sigmas, "outlier_sigmas", above=0.0)
        require_number(self.max_iterations, "max_iterations", least=1)
        require_number(self.tolerance, "tolerance", above=0.0)
        require(
            not self.estimate_jitter or self.timetag_jitter_s > 0.0,
            "estimate_jitter needs a first guess: give timetag_jitter_s > 0",
        )
