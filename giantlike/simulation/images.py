"""Images with truth: bodies and stars through a real camera, with noise."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import ifov_rad
from giantlike.catalogs import StarCatalog
from giantlike.core.arrays import Float, require
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.time import et_from_time
from giantlike.image import AttitudeSource, Image, ObserverState
from giantlike.ray_tracing import RenderOptions, Template, render
from giantlike.scene import Scene, TargetGeometry
from giantlike.simulation.detector import HotPixels, expose
from giantlike.simulation.stars import StarField, point_sources, star_field

if TYPE_CHECKING:
    from astropy.time import Time

SUN_MAGNITUDE_G = -26.90
"""Apparent magnitude of the Sun at 1 au in Gaia G."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Photometry:
    """What ties the light of bodies to that of stars.

    Parameters
    ----------
    zero_point_e_s : float, electron/s
        Signal of a star of magnitude 0, in the band of the catalogue.
    albedo : float
        Radiance factor of the surfaces seen and lit along their normal.
    sun_distance_au : float, au
        Of the bodies.
    """

    zero_point_e_s: float = 2.0e5
    albedo: float = 0.045
    sun_distance_au: float = 1.0

    def __post_init__(self) -> None:
        for name in ("zero_point_e_s", "albedo", "sun_distance_au"):
            require(getattr(self, name) > 0, f"photometry {name} must be > 0, got {getattr(self, name)}")

    def star_rate_e_s(self, magnitudes: Float) -> Float:
        """Electrons per second (n,) of stars of magnitudes (n,)."""
        rate: Float = self.zero_point_e_s * 10.0 ** (-0.4 * magnitudes)
        return rate

    def surface_rate_e_s(self, camera: Camera) -> float:
        """Electrons per second in a pixel that sees a surface of brightness 1 (lit and seen along its normal)."""
        sun_e_s = self.zero_point_e_s * math.pow(10.0, -0.4 * SUN_MAGNITUDE_G) / self.sun_distance_au**2
        pixel_sr = float(ifov_rad(camera.model, camera.center_px)) ** 2
        return sun_e_s * self.albedo * pixel_sr / math.pi


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shot:
    """An exposure as it really happens.

    Parameters
    ----------
    name : str
    epoch : astropy Time
        Mid-exposure.
    exposure_s : float, s
    camera_from_inertial : Rotation
        The true attitude at mid-exposure; the camera does not turn while it exposes.
    observer : ObserverState
        True state of the spacecraft.
    """

    name: str
    epoch: Time
    exposure_s: float
    camera_from_inertial: Rotation
    observer: ObserverState


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulationOptions:
    """How an image is made.

    Parameters
    ----------
    rays_per_pixel_side : int
        Each ray goes through a random place of its cell, so that no estimator's template shares the sampling.
    max_magnitude : float, optional
        Faintest star; as deep as the catalogue goes by default.
    """

    rays_per_pixel_side: int = 5
    max_magnitude: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimulatedImage:
    """An image and the truth behind it.

    Parameters
    ----------
    image : Image
        Pixels uint16; carries the true attitude and observer state.
    bodies : mapping of str to TargetGeometry
        True apparent geometry of every target of which light falls on the frame, by name.
    templates : mapping of str to Template
        Those bodies as rendered, noise-free, PSF in.
    stars : StarField
        Stars on the detector that no body hides, true places.
    """

    image: Image
    bodies: Mapping[str, TargetGeometry]
    templates: Mapping[str, Template]
    stars: StarField = field(repr=False)


def simulate_image(
    shot: Shot,
    camera: Camera,
    scene: Scene,
    rng: np.random.Generator,
    *,
    catalog: StarCatalog | None = None,
    photometry: Photometry = Photometry(),
    hot_pixels: HotPixels | None = None,
    options: SimulationOptions = SimulationOptions(),
) -> SimulatedImage:
    """Take an image of a scene.

    Parameters
    ----------
    shot : Shot
    camera : Camera
        With its PSF; stars and bodies go through the distorted model.
    scene : Scene
        True geometry: light time and stellar aberration are applied as the scene says. Bodies hide stars, but
        not each other.
    rng : numpy Generator
        Equal generators give equal images.
    catalog : StarCatalog, optional
        The sky; without it there are no stars.
    photometry : Photometry
    hot_pixels : HotPixels, optional
    options : SimulationOptions

    Returns
    -------
    SimulatedImage

    Raises
    ------
    InputError
        The scene cannot tell where a target is or where the Sun stands, or the camera has no PSF.
    """
    if camera.psf is None:
        raise InputError(f"camera {camera.name!r} needs a psf to simulate images")
    frame = unexposed(shot, camera)
    hot = HotPixels() if hot_pixels is None else hot_pixels
    signal_e = hot.signal_e(camera.columns, camera.rows, shot.exposure_s)
    hidden = np.zeros(signal_e.shape, dtype=bool)
    surface_e = photometry.surface_rate_e_s(camera) * shot.exposure_s
    bodies = _seen_bodies(frame, camera, scene, options, rng)
    for _, template in bodies.values():
        signal_e += surface_e * template.placed(camera.columns, camera.rows)
        cover = dataclasses.replace(template, brightness=template.coverage)
        hidden |= cover.placed(camera.columns, camera.rows) > 0.5
    stars = _visible_stars(shot, camera, catalog, hidden, options)
    electrons = photometry.star_rate_e_s(stars.magnitudes) * shot.exposure_s
    signal_e += point_sources(
        stars.points_px, electrons, sigma_px=camera.psf.sigma_px, columns=camera.columns, rows=camera.rows
    )
    return SimulatedImage(
        image=dataclasses.replace(frame, pixels=expose(signal_e, camera.detector, rng)),
        bodies={name: geometry for name, (geometry, _) in bodies.items()},
        templates={name: template for name, (_, template) in bodies.items()},
        stars=stars,
    )


def _seen_bodies(
    frame: Image, camera: Camera, scene: Scene, options: SimulationOptions, rng: np.random.Generator
) -> dict[str, tuple[TargetGeometry, Template]]:
    """Geometry and rendering of every target of which light falls on the frame."""
    seen = {}
    for target in scene.targets:
        geometry = scene.geometry(frame, target.name)
        if isinstance(geometry, Failure):
            raise InputError(geometry.detail)
        template = _rendered(geometry, camera, options, seed=int(rng.integers(2**31)))
        if template is not None:
            seen[target.name] = geometry, template
    return seen


def visible_peak(shot: Shot, camera: Camera, scene: Scene, target: str) -> float:
    """Brightest pixel of a target in a shot, relative to a surface lit and seen along its normal; 0 if not seen."""
    geometry = scene.geometry(unexposed(shot, camera), target)
    if isinstance(geometry, Failure):
        return 0.0
    template = _rendered(geometry, camera, SimulationOptions(rays_per_pixel_side=1), seed=0)
    return 0.0 if template is None else float(template.brightness.max())


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


def _rendered(geometry: TargetGeometry, camera: Camera, options: SimulationOptions, *, seed: int) -> Template | None:
    """The body through the camera; None where no light of it falls on the frame."""
    result = render(
        geometry.body(),
        camera.model,
        sun_direction_camera=geometry.sun_direction_camera,
        psf=camera.psf,
        columns=camera.columns,
        rows=camera.rows,
        options=RenderOptions(rays_per_pixel_side=options.rays_per_pixel_side, jitter_seed=seed),
    )
    if not isinstance(result, Failure):
        return result
    require(result.reason in (Reason.OUT_OF_FRAME, Reason.NOT_LIT), f"{geometry.target.name}: {result.detail}")
    return None


def _visible_stars(
    shot: Shot, camera: Camera, catalog: StarCatalog | None, hidden: NDArray[np.bool_], options: SimulationOptions
) -> StarField:
    if catalog is None:
        return StarField(ids=np.zeros(0, np.int64), points_px=np.zeros((0, 2)), magnitudes=np.zeros(0))
    stars = star_field(
        catalog,
        camera,
        shot.camera_from_inertial,
        et_from_time(shot.epoch),
        observer=shot.observer,
        max_magnitude=options.max_magnitude,
    )
    nearest = np.rint(stars.points_px).astype(np.int64)
    x, y = np.clip(nearest, 0, [camera.columns - 1, camera.rows - 1]).T
    return stars.select(~(hidden[y, x] & camera.contains(stars.points_px)))
