"""An exposure as it really happens: when, from where, how the camera turns, and how bright things are."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import ifov_rad
from giantlike.core.arrays import Float, as_finite, require
from giantlike.core.time import et_from_time, time_from_et
from giantlike.core.values import Value
from giantlike.image import AttitudeSource, Image, ObserverState

if TYPE_CHECKING:
    from astropy.time import Time

SUN_MAGNITUDE_G = -26.90
"""Apparent magnitude of the Sun at 1 au in Gaia G."""
_STILL_PX = 0.05  # a shorter smear widens a star by less than 2e-4 px^2
_NODES_PER_SIGMA = 1.5  # Gauss-Legendre on a Gaussian: then right to 1e-7
_SHARPEST_PX = 0.4  # no image is sharper than its pixels


@dataclass(frozen=True, slots=True, kw_only=True)
class Photometry:
    """What ties the light of bodies to that of stars.

    Parameters
    ----------
    zero_point_e_s : float, electron/s
        Signal of a star of magnitude 0, in the band of the catalog.
    albedo : float
        Radiance factor of the surfaces seen and lit along their normal.
    sun_distance_au : float, au
        Of the bodies.
    albedos : mapping of str to float
        Radiance factor of targets that differ from ``albedo``, by name.
    """

    zero_point_e_s: float = 2.0e5
    albedo: float = 0.045
    sun_distance_au: float = 1.0
    albedos: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("zero_point_e_s", "albedo", "sun_distance_au"):
            require(getattr(self, name) > 0, f"photometry {name} must be > 0, got {getattr(self, name)}")
        for name, albedo in self.albedos.items():
            require(albedo > 0, f"photometry albedo of {name} must be > 0, got {albedo}")

    def star_rate_e_s(self, magnitudes: Float) -> Float:
        """Electrons per second (n,) of stars of magnitudes (n,)."""
        rate: Float = self.zero_point_e_s * 10.0 ** (-0.4 * magnitudes)
        return rate

    def surface_rate_e_s(self, camera: Camera, target: str | None = None) -> float:
        """Electrons per second in a pixel that sees a surface of brightness 1 (lit and seen along its normal)."""
        sun_e_s = self.zero_point_e_s * math.pow(10.0, -0.4 * SUN_MAGNITUDE_G) / self.sun_distance_au**2
        pixel_sr = float(ifov_rad(camera.model, camera.center_px)) ** 2
        albedo = self.albedo if target is None else self.albedos.get(target, self.albedo)
        return sun_e_s * albedo * pixel_sr / math.pi


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shot(Value):
    """An exposure as it really happens.

    Parameters
    ----------
    name : str
    epoch : astropy Time
        Mid-exposure.
    exposure_s : float, s
    camera_from_inertial : Rotation
        The true attitude at mid-exposure.
    observer : ObserverState, optional
        True state of the spacecraft; without one stars have neither parallax nor aberration.
    angular_rate_camera_rad_s : (3,) float64, rad/s, camera axes
        Turn of the camera, steady during the exposure: a star moves the other way.
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
        require(
            math.isfinite(self.exposure_s) and self.exposure_s >= 0,
            f"{self.name}: exposure_s must be >= 0, got {self.exposure_s}",
        )
        Value.__post_init__(self)

    def at(self, since_middle_s: float) -> Shot:
        """The same exposure as it stands some seconds after its middle: epoch, attitude and place of the camera."""
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


def unexposed(shot: Shot, camera: Camera) -> Image:
    """The image of a shot before any light fell on it: what is true of it, and black pixels."""
    return Image(
        pixels=np.zeros((camera.rows, camera.columns), np.uint16),
        epoch=shot.epoch,
        exposure_s=shot.exposure_s,
        camera_from_inertial=shot.camera_from_inertial,
        attitude_source=AttitudeSource.A_PRIORI,
        observer=shot.observer,
        name=shot.name,
    )


@dataclass(frozen=True, slots=True)
class Instant:
    """A moment of an exposure, seconds after its middle, and its share of the light."""

    since_middle_s: float
    share: float


def instants(exposure_s: float, smear_px: float, sigma_px: float) -> tuple[Instant, ...]:
    """Moments at which to look at a moving scene so that the mean over them is the mean over the exposure.

    Parameters
    ----------
    exposure_s : float, s
    smear_px : float, px
        How far the image moves during the exposure.
    sigma_px : float, px
        Width of the PSF.

    Returns
    -------
    tuple of Instant
        Nodes and weights of Gauss and Legendre; the middle alone where hardly anything moves.
    """
    if smear_px < _STILL_PX:
        return (Instant(0.0, 1.0),)
    count = 2 + math.ceil(_NODES_PER_SIGMA * smear_px / max(sigma_px, _SHARPEST_PX))
    nodes, weights = leggauss(count)
    return tuple(
        Instant(0.5 * exposure_s * float(node), 0.5 * float(weight))
        for node, weight in zip(nodes, weights, strict=True)
    )
