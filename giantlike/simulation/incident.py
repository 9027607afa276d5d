"""The light that falls on the detector: bodies and stars, with the motion of the camera during the exposure."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from giantlike.camera import Camera
from giantlike.catalogs import StarCatalog
from giantlike.core.arrays import Float, Mask
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.time import et_from_time
from giantlike.core.values import Value
from giantlike.image import Image
from giantlike.ray_tracing import RenderOptions, SceneRender, Template, render_scene
from giantlike.scene import Scene, TargetGeometry
from giantlike.simulation.shot import Photometry, Shot, instants, unexposed
from giantlike.simulation.stars import StarField, point_sources, star_field

_SMEAR_STEPS = np.linspace(-0.5, 0.5, 5)  # of the exposure
_HIDES = 0.5  # covered part of a pixel from which on a star in it is behind the body


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulationOptions:
    """How an image is made.

    Parameters
    ----------
    rays_per_pixel_side : int
        Each ray goes through a random place of its cell, so that no estimator's template shares the sampling.
    max_magnitude : float, optional
        Faintest star; as deep as the catalog goes by default.
    sun_radius_rad : float, rad
        Angular radius of the Sun at the bodies, for penumbrae; 0 is a point.
    min_rays_across : int
        Rays across the narrow side of a body, at least.
    """

    rays_per_pixel_side: int = 5
    max_magnitude: float | None = None
    sun_radius_rad: float = 0.0
    min_rays_across: int = 256

    def shared_among(self, moments: int) -> SimulationOptions:
        """Options that spend the rays of one image on several moments: each has places of its own for its rays."""
        fewer = 1.0 / math.sqrt(moments)
        return dataclasses.replace(
            self,
            rays_per_pixel_side=math.ceil(fewer * self.rays_per_pixel_side),
            min_rays_across=math.ceil(fewer * self.min_rays_across),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IncidentLight(Value):
    """Light on the pixels, and where it comes from.

    Parameters
    ----------
    electrons : (rows, columns) float64, electron
        Mean number that the light sets free during the exposure.
    bodies : mapping of str to TargetGeometry
        True apparent geometry at mid-exposure of every target that is seen in the frame, by name.
    templates : mapping of str to Template
        Those bodies as rendered at mid-exposure.
    stars : StarField
        Stars of which light falls on the frame, true places at mid-exposure.
    star_electrons : (n,) float64, electron
        Light of each, without what bodies hide.
    """

    electrons: Float
    bodies: Mapping[str, TargetGeometry]
    templates: Mapping[str, Template]
    stars: StarField
    star_electrons: Float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _SeenBodies(Value):
    """Bodies at one moment: their light, electron/s (rows, columns), what they cover, and each of them."""

    rate_e_s: Float
    covered: Mask
    geometry: Mapping[str, TargetGeometry]
    templates: Mapping[str, Template]


def incident_light(
    shot: Shot,
    camera: Camera,
    scene: Scene | None,
    random: np.random.Generator,
    *,
    catalog: StarCatalog | None = None,
    photometry: Photometry,
    options: SimulationOptions,
) -> IncidentLight:
    """Gather the light of a scene on the pixels of a camera.

    Parameters
    ----------
    shot : Shot
    camera : Camera
        With its PSF; stars and bodies go through the distorted model.
    scene : Scene or None
        True geometry: light time and stellar aberration are applied as the scene says. None: no bodies.
    random : numpy Generator
        Places the rays inside their cells.
    catalog : StarCatalog, optional
        The sky; without it there are no stars.
    photometry : Photometry
    options : SimulationOptions

    Returns
    -------
    IncidentLight

    Raises
    ------
    InputError
        The scene cannot tell where a target is or where the Sun stands, the camera has no PSF, or lies inside a target.

    Notes
    -----
    Where the image moves, bodies and stars are taken at several moments of the exposure together, so that a star
    that a body hides for half of the exposure gives half of its light.
    """
    if camera.psf is None:
        raise InputError(f"camera {camera.name!r} needs a psf to simulate images")
    columns, rows, sigma_px = camera.columns, camera.rows, camera.psf.sigma_px
    smear_px = _smear_px(shot, camera, scene)
    stars = _stars(shot, camera, catalog, options, smear_px)
    star_e = photometry.star_rate_e_s(stars.magnitudes) * shot.exposure_s
    electrons, free = np.zeros((rows, columns)), np.zeros(len(star_e))
    moments = instants(shot.exposure_s, smear_px, sigma_px)
    coarse = options.shared_among(len(moments))
    for instant in moments:
        now = shot.at(instant.since_middle_s)
        seen = _seen_bodies(now, camera, scene, photometry, coarse, random)
        electrons += instant.share * shot.exposure_s * seen.rate_e_s
        points = camera.model.project(rotate(now.camera_from_inertial, stars.directions_inertial))
        shown = np.isfinite(points).all(axis=1) & ~_hidden(points, seen.covered, camera)
        free += instant.share * shown
        electrons += point_sources(
            points[shown], instant.share * star_e[shown], sigma_px=sigma_px, columns=columns, rows=rows
        )
    middle = seen if len(moments) == 1 else _seen_bodies(shot, camera, scene, photometry, options, random)
    return IncidentLight(
        electrons=electrons,
        bodies=middle.geometry,
        templates=middle.templates,
        stars=stars.select(free > 0),
        star_electrons=(star_e * free)[free > 0],
    )


def _smear_px(shot: Shot, camera: Camera, scene: Scene | None) -> float:
    """How far anything in the image moves during the exposure, px: its corners, its middle and the bodies."""
    right, bottom = camera.columns - 0.5, camera.rows - 0.5
    corners = [[-0.5, -0.5], [right, -0.5], [-0.5, bottom], [right, bottom]]
    fixed = camera.model.unproject(np.vstack([corners, camera.center_px]))
    inertial = rotate(shot.camera_from_inertial.inv(), fixed)
    path = []
    for since_s in shot.exposure_s * _SMEAR_STEPS:
        now = shot.at(float(since_s))
        places = [rotate(now.camera_from_inertial, inertial)]
        if scene is not None:
            frame = unexposed(now, camera)
            bodies = [true_geometry(scene, frame, target.name).position_camera_km for target in scene.targets]
            places.append(np.array(bodies))
        path.append(camera.model.project(np.concatenate(places)))
    steps = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    return float(np.nanmax(np.append(steps.sum(axis=0), 0.0)))


def _stars(
    shot: Shot, camera: Camera, catalog: StarCatalog | None, options: SimulationOptions, smear_px: float
) -> StarField:
    if catalog is None:
        return StarField.empty()
    return star_field(
        catalog,
        camera,
        shot.camera_from_inertial,
        et_from_time(shot.epoch),
        observer=shot.observer,
        max_magnitude=options.max_magnitude,
        smear_px=smear_px,
    )


def _hidden(points_px: Float, covered: Mask, camera: Camera) -> Mask:
    """Which points (n, 2) of the image lie in pixels that a body covers."""
    on_detector = camera.contains(points_px)
    x, y = np.rint(points_px[on_detector]).astype(np.int64).T
    hidden = np.zeros(len(points_px), dtype=bool)
    hidden[on_detector] = covered[np.minimum(y, camera.rows - 1), np.minimum(x, camera.columns - 1)]
    return hidden


def true_geometry(scene: Scene, frame: Image, target: str) -> TargetGeometry:
    """Apparent geometry of a target; ``InputError`` where the scene cannot tell it."""
    geometry = scene.geometry(frame, target)
    if isinstance(geometry, Failure):
        raise InputError(geometry.detail)
    return geometry


def _seen_bodies(
    shot: Shot,
    camera: Camera,
    scene: Scene | None,
    photometry: Photometry,
    options: SimulationOptions,
    random: np.random.Generator,
) -> _SeenBodies:
    """Every target that is seen in the frame, as the scene stands at mid-exposure of a shot."""
    if scene is None:
        dark = np.zeros((camera.rows, camera.columns))
        return _SeenBodies(rate_e_s=dark, covered=dark > _HIDES, geometry={}, templates={})
    frame = unexposed(shot, camera)
    geometries = [true_geometry(scene, frame, target.name) for target in scene.targets]
    image = _rendered(geometries, camera, options, seed=int(random.integers(2**31)))
    found, templates = {}, {}
    covered = np.zeros((camera.rows, camera.columns))
    for number, (geometry, template) in enumerate(zip(geometries, image.templates, strict=True)):
        if isinstance(template, Failure) and template.reason is Reason.DEGENERATE_GEOMETRY:
            raise InputError(f"{shot.name}: target {geometry.target.name!r}: {template.detail}")
        if isinstance(template, Template):
            found[geometry.target.name], templates[geometry.target.name] = geometry, template
            covered += image.coverage(number)
    rates = [photometry.surface_rate_e_s(camera, geometry.target.name) for geometry in geometries]
    return _SeenBodies(rate_e_s=image.weighted(rates), covered=covered > _HIDES, geometry=found, templates=templates)


def visible_peak(shot: Shot, camera: Camera, scene: Scene, target: str) -> float:
    """Brightest pixel of a target in a shot, relative to a surface lit and seen along its normal; 0 if not seen."""
    geometry = scene.geometry(unexposed(shot, camera), target)
    if isinstance(geometry, Failure):
        return 0.0
    image = _rendered([geometry], camera, SimulationOptions(rays_per_pixel_side=1), seed=0)
    return float(image.brightness.max())


def _rendered(
    geometries: Sequence[TargetGeometry], camera: Camera, options: SimulationOptions, *, seed: int
) -> SceneRender:
    """The bodies through the camera."""
    return render_scene(
        [geometry.body() for geometry in geometries],
        camera.model,
        sun_direction_camera=[geometry.sun_direction_camera for geometry in geometries],
        psf=camera.psf,
        columns=camera.columns,
        rows=camera.rows,
        options=RenderOptions(
            rays_per_pixel_side=options.rays_per_pixel_side,
            min_rays_across=options.min_rays_across,
            jitter_seed=seed,
            sun_radius_rad=options.sun_radius_rad,
            sun_seed=seed,
        ),
    )
