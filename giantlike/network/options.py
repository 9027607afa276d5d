"""Options of the adjustment of a network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from giantlike.calibration.options import Loss, Treatment
from giantlike.core.arrays import require, require_number

GROUPS = ("points", "poses", "pole", "w", "rate", "size", "camera")


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkOptions:
    """Options of :func:`~giantlike.network.adjust`.

    Parameters
    ----------
    points, poses, pole, w, rate, size, camera : Treatment
        Estimated, considered (kept, while their a priori covariance enters that of the others), or fixed. ``pole``,
        ``w`` (angle of the prime meridian at the mean epoch of the images) and ``rate`` need a ``body``; ``size``
        scales the a priori positions of the points.
    sigma_pole_deg : float, deg; a priori standard deviation of the pole, toward the east and toward the north
    sigma_w_deg : float, deg; of the angle about the pole
    sigma_rate : float; of the rate, relative to it
    sigma_size : float; of the size, relative
    sigma_camera : mapping of str to float; sigmas, in their units, of camera parameters that are not fixed
    loss : Loss; loss function of the fit that finds outliers; a fit by least squares to the other measures follows
    outlier_sigmas : float
        Measures with residuals beyond this many standard deviations (of the stated noise, or of the noise found where
        that is larger) are rejected; infinite: none, and ``loss`` is then that of the result.
    scale_by_residuals : bool; multiply all covariances by chi-square per degree of freedom, as jigsaw does
    max_rounds, max_steps : int; bounds of the rounds of rejection, and of the Levenberg-Marquardt steps in each

    Raises
    ------
    InputError
        A value is out of range.
    """

    points: Treatment = Treatment.ESTIMATE
    poses: Treatment = Treatment.ESTIMATE
    pole: Treatment = Treatment.FIXED
    w: Treatment = Treatment.FIXED
    rate: Treatment = Treatment.FIXED
    size: Treatment = Treatment.FIXED
    camera: Treatment = Treatment.FIXED
    sigma_pole_deg: float = 2.0
    sigma_w_deg: float = 2.0
    sigma_rate: float = 1e-4
    sigma_size: float = 0.01
    sigma_camera: Mapping[str, float] = field(default_factory=dict)
    loss: Loss = Loss.CAUCHY
    outlier_sigmas: float = 3.5
    scale_by_residuals: bool = False
    max_rounds: int = 10
    max_steps: int = 100

    def __post_init__(self) -> None:
        for name in GROUPS:
            known = getattr(self, name) in list(Treatment)
            require(known, f"{name} must be one of {', '.join(Treatment)}, got {getattr(self, name)!r}")
            object.__setattr__(self, name, Treatment(getattr(self, name)))
        for name in ("sigma_pole_deg", "sigma_w_deg", "sigma_rate", "sigma_size"):
            require_number(getattr(self, name), name, above=0.0)
        for name, sigma in self.sigma_camera.items():
            require_number(sigma, f"sigma_camera[{name!r}]", above=0.0)
        require(bool(self.sigma_camera) or self.camera is Treatment.FIXED, "camera needs sigma_camera: its parameters")
        require(self.loss in list(Loss), f"loss must be one of {', '.join(Loss)}, got {self.loss!r}")
        object.__setattr__(self, "loss", Loss(self.loss))
        require(self.outlier_sigmas > 0.0, f"outlier_sigmas must be > 0, got {self.outlier_sigmas}")
        for name in ("max_rounds", "max_steps"):
            require_number(getattr(self, name), name, least=1)
