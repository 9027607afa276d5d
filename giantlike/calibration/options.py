"""What a user may choose in a calibration, and what it must reach to be accepted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from giantlike.calibration.robust import Loss
from giantlike.core.arrays import require


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationOptions:
    """Options of a calibration.

    Parameters
    ----------
    prior_sigma : mapping of str to float
        Standard deviation that the starting value of a parameter has, in its unit: an a priori weight. A narrow
        field cannot tell the principal point from the attitude; give it one here, or leave it out of what is
        estimated (it then stays where it is).
    loss : Loss
        Of the last fit. The fits before, which look for outliers, use Huber's at least.
    false_rejections : float
        How many good observations a whole calibration may be expected to lose as outliers.
    max_rounds : int
        Rounds of fit and rejection.
    max_steps : int
        Of Levenberg-Marquardt, per round.

    Raises
    ------
    InputError
        A value is out of range.
    """

    prior_sigma: Mapping[str, float] = field(default_factory=dict)
    loss: Loss = Loss.LINEAR
    false_rejections: float = 0.01
    max_rounds: int = 10
    max_steps: int = 200

    def __post_init__(self) -> None:
        for name, sigma in self.prior_sigma.items():
            require(sigma > 0, f"prior_sigma of {name} must be > 0, got {sigma}")
        require(0.0 < self.false_rejections < 1.0, f"false_rejections must be in (0, 1), got {self.false_rejections}")
        require(self.max_rounds >= 1, f"max_rounds must be >= 1, got {self.max_rounds}")
        require(self.max_steps >= 1, f"max_steps must be >= 1, got {self.max_steps}")
        object.__setattr__(self, "loss", Loss(self.loss))


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationCriteria:
    """What a calibration must reach; each is checked, and one that is missed is named with both numbers.

    Parameters
    ----------
    max_residual_px : float, px
        Radial residual rms of the observations kept.
    max_image_residual_px : float, px
        The same of every single image.
    max_rejected : float
        Share of observations thrown out.
    max_map_sigma_px : float, px
        Uncertainty of the camera map (radial, modulo a rotation), worst place of the field.
    min_observations_per_parameter : float
        Observations kept over parameters of the camera.
    min_covered : float
        Share of the field (nine equal parts) in which anything was observed.

    Raises
    ------
    InputError
        A value is not positive.
    """

    max_residual_px: float = 0.5
    max_image_residual_px: float = 1.0
    max_rejected: float = 0.25
    max_map_sigma_px: float = 0.5
    min_observations_per_parameter: float = 3.0
    min_covered: float = 0.6

    def __post_init__(self) -> None:
        for name in self.__slots__:
            require(getattr(self, name) > 0, f"{name} must be > 0, got {getattr(self, name)}")
