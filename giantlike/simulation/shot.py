"""True state of an exposure: epoch, observer, attitude, rate."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.core.arrays import Float, as_finite, require_number
from giantlike.core.time import et_from_time, time_from_et
from giantlike.core.values import Value
from giantlike.image import AttitudeSource, Image, ObserverState

if TYPE_CHECKING:
    from astropy.time import Time

_STILL_PX = 0.05  # px of motion; less adds under 2e-4 px^2 (a uniform motion L adds L^2 / 12) to the variance of a star
_NODES_PER_SIGMA = 1.5  # Gauss-Legendre nodes per PSF sigma of motion: the mean of a Gaussian is then accurate to 1e-7
_SHARPEST_PX = 0.4  # px, least width of an image: integration over a pixel adds 1/12 px^2, a sigma of 0.29 px


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shot(Value):
    """True state of an exposure.

    Parameters
    ----------
    name : str; name of the image
    epoch : astropy Time; mid-exposure
    exposure_s : float, s; exposure time
    camera_from_inertial : Rotation; true attitude at mid-exposure
    observer : ObserverState, optional; true state; without it stars have no parallax or aberration
    angular_rate_camera_rad_s : (3,) float64, rad/s, camera axes; constant; stars move the other way

    Raises
    ------
    InputError
        The exposure time is negative, or the rate is not three finite numbers.
    """

    name: str
    epoch: Time
    exposure_s: float
    camera_from_inertial: Rotation
    observer: ObserverState | None = None
    angular_rate_camera_rad_s: Float = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        rate = as_finite(self.angular_rate_camera_rad_s, (3,), "angular_rate_camera_rad_s")
        object.__setattr__(self, "angular_rate_camera_rad_s", rate)
        require_number(self.exposure_s, f"{self.name}: exposure_s", least=0.0)
        Value.__post_init__(self)

    def at(self, since_middle_s: float) -> Shot:
        """Return the exposure with the epoch, attitude and observer of a time within it."""
        if since_middle_s == 0.0:
            return self
        turn = Rotation.from_rotvec(-since_middle_s * self.angular_rate_camera_rad_s)
        observer = self.observer
        if observer is not None:
            moved_km = observer.position_km + since_middle_s * observer.velocity_km_s
            observer = ObserverState(position_km=moved_km, velocity_km_s=observer.velocity_km_s)
        return dataclasses.replace(
            self,
            epoch=time_from_et(et_from_time(self.epoch) + since_middle_s),
            camera_from_inertial=turn * self.camera_from_inertial,
            observer=observer,
        )


def make_black_image(shot: Shot, camera: Camera) -> Image:
    """Return the image of a shot with black pixels and the true epoch, attitude and observer."""
    return Image(
        pixels=np.zeros((camera.rows, camera.columns), np.uint16),
        epoch=shot.epoch,
        exposure_s=shot.exposure_s,
        camera_from_inertial=shot.camera_from_inertial,
        attitude_source=AttitudeSource.A_PRIORI,
        observer=shot.observer,
        name=shot.name,
        camera_name=camera.frame_name,
    )


@dataclass(frozen=True, slots=True)
class Instant:
    """A moment of an exposure, s after its middle, and its weight in the mean over the exposure."""

    since_middle_s: float
    share: float


def instants(exposure_s: float, smear_px: float, sigma_px: float) -> tuple[Instant, ...]:
    """Nodes and weights that average a moving scene over its exposure."""
    if smear_px < _STILL_PX:
        return (Instant(0.0, 1.0),)
    count = 2 + math.ceil(_NODES_PER_SIGMA * smear_px / max(sigma_px, _SHARPEST_PX))
    nodes, weights = leggauss(count)
    return tuple(
        Instant(0.5 * exposure_s * float(node), 0.5 * float(weight))
        for node, weight in zip(nodes, weights, strict=True)
    )
