"""Light of bodies and stars on the pixels, with the motion of the camera during the exposure."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from giantlike.camera import Camera
from giantlike.catalogs import StarCatalog
from giantlike.core.arrays import Float, Mask, require_number
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.photometry import Photometry
from giantlike.core.values import Value
from giantlike.image import Image
from giantlike.ray_tracing import RenderOptions, Template
from giantlike.ray_tracing.render import SceneRender, render_scene
from giantlike.scene import Scene, Target, TargetGeometry
from giantlike.simulation.shot import Shot, instants, make_black_image
from giantlike.simulation.stars import DetectorStars, point_sources, star_field

_SMEAR_STEPS = np.linspace(-0.5, 0.5, 5)  # fractions of the exposure at which the motion of the image is sampled
_HIDES = 0.5  # fraction of a pixel that bodies cover, above which they hide a star in it: the nearer answer


@dataclass(frozen=True, slots=True, kw_only=True)
class Sources:
    """Sources of light in front of a camera: the bodies of a scene and the stars of a catalog.

    Parameters
    ----------
    scene : Scene, optional; true geometry; it sets light time and aberration; None: no bodies
    catalog : StarCatalog, optional; None: no stars
    photometry : Photometry; zero point of the camera
    albedo : float; radiance factor along the normal of targets without one; as dark as Bennu by default
    sun_distance_au : float, au; distance of the bodies from the Sun

    Raises
    ------
    InputError
        Albedo or distance is not positive.
    """

    scene: Scene | None = None
    catalog: StarCatalog | None = None
    photometry: Photometry = field(default_factory=Photometry)
    albedo: float = 0.045
    sun_distance_au: float = 1.0

    def __post_init__(self) -> None:
        for name in ("albedo", "sun_distance_au"):
            require_number(getattr(self, name), name, above=0.0)

    def surface_rate_e_s(self, camera: Camera, target: Target | None = None) -> float:
        """Signal, electron/s, of a pixel that sees a surface lit and seen along its normal."""
        albedo = self.albedo if target is None or target.normal_albedo is None else target.normal_albedo
        pixel_sr = float(camera.ifov_rad()) ** 2
        return float(self.photometry.surface_rate_e_s(albedo, pixel_sr, sun_distance_au=self.sun_distance_au))


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulationOptions:
    """Sampling of simulated images."""

    rays_per_pixel_side: int = 5  # each through a random position in its cell, unlike those of templates
    max_magnitude: float | None = None  # faintest star; by default all stars of the catalog
    sun_radius_rad: float = 0.0  # rad; angular radius of the Sun at the bodies, for penumbrae; 0 is a point
    min_rays_across: int = 256  # least number of rays across the narrow side of a body

    def shared_among(self, moments: int) -> SimulationOptions:
        """Return options that spend the rays of one image on several moments, each with its own random rays."""
        fewer = 1.0 / math.sqrt(moments)
        return dataclasses.replace(
            self,
            rays_per_pixel_side=math.ceil(fewer * self.rays_per_pixel_side),
            min_rays_across=math.ceil(fewer * self.min_rays_across),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IncidentLight(Value):
    """Light on the pixels and its sources."""

    electrons: Float  # (rows, columns); mean number of photoelectrons of the exposure
    bodies: Mapping[str, TargetGeometry]  # true, apparent, at mid-exposure, of targets in the frame, by name
    templates: Mapping[str, Template]  # those bodies as rendered at mid-exposure
    stars: DetectorStars  # stars whose light falls on the frame, with true positions at mid-exposure
    star_electrons: Float  # (n,); light of each star, without the part that bodies hide


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _SeenBodies(Value):
    """Bodies at one moment: light, electron/s (rows, columns), covered pixels (rows, columns), geometry, renders."""

    rate_e_s: Float
    covered: Mask
    geometry: Mapping[str, TargetGeometry]
    templates: Mapping[str, Template]


def incident_light(
    shot: Shot,
    camera: Camera,
    sources: Sources,
    random: np.random.Generator,
    *,
    options: SimulationOptions = SimulationOptions(),
) -> IncidentLight:
    """Gather the light of bodies and stars on the pixels of a camera.

    Where the image moves, all are drawn at several moments: a body may hide a star for a part of the exposure.
    """
    if camera.psf is None:
        raise InputError(f"camera {camera.name!r} has no psf; simulated images need one: add [psf] to its file")
    columns, rows, sigma_px = camera.columns, camera.rows, camera.psf.sigma_px
    smear_px = _smear_px(shot, camera, sources.scene)
    stars = star_field(sources.catalog, camera, shot, max_magnitude=options.max_magnitude, smear_px=smear_px)
    axis = rotate(shot.camera_from_inertial.inv(), np.array([0.0, 0.0, 1.0]))
    angles = np.arccos(np.clip(stars.directions_inertial @ axis, -1.0, 1.0))
    star_e = sources.photometry.star_rate_e_s(stars.magnitudes, angle_rad=angles) * shot.exposure_s
    electrons, free = np.zeros((rows, columns)), np.zeros(len(star_e))
    moments = instants(shot.exposure_s, smear_px, sigma_px)
    coarse = options.shared_among(len(moments))
    for instant in moments:
        now = shot.at(instant.since_middle_s)
        seen = _seen_bodies(now, camera, sources, coarse, random)
        electrons += instant.share * shot.exposure_s * seen.rate_e_s
        points = camera.model.project(rotate(now.camera_from_inertial, stars.directions_inertial))
        shown = np.isfinite(points).all(axis=1) & ~_hidden(points, seen.covered, camera)
        free += instant.share * shown
        electrons += point_sources(
            points[shown], instant.share * star_e[shown], sigma_px=sigma_px, columns=columns, rows=rows
        )
    middle = seen if len(moments) == 1 else _seen_bodies(shot, camera, sources, options, random)
    return IncidentLight(
        electrons=electrons,
        bodies=middle.geometry,
        templates=middle.templates,
        stars=stars.select(free > 0),
        star_electrons=(star_e * free)[free > 0],
    )


def _smear_px(shot: Shot, camera: Camera, scene: Scene | None) -> float:
    """Longest path of the corners, the center and the bodies over the image during the exposure, px."""
    right, bottom = camera.columns - 0.5, camera.rows - 0.5
    corners = [[-0.5, -0.5], [right, -0.5], [-0.5, bottom], [right, bottom]]
    fixed = camera.model.unproject(np.vstack([corners, camera.center_px]))
    inertial = rotate(shot.camera_from_inertial.inv(), fixed)
    path = []
    for since_s in shot.exposure_s * _SMEAR_STEPS:
        now = shot.at(float(since_s))
        places = [rotate(now.camera_from_inertial, inertial)]
        if scene is not None:
            frame = make_black_image(now, camera)
            bodies = [true_geometry(scene, frame, target.name).position_camera_km for target in scene.targets]
            places.append(np.array(bodies))
        path.append(camera.model.project(np.concatenate(places)))
    steps = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    return float(np.nanmax(np.append(steps.sum(axis=0), 0.0)))


def _hidden(points_px: Float, covered: Mask, camera: Camera) -> Mask:
    """Mask (n,) of the points (n, 2) that lie in pixels covered by a body."""
    on_detector = camera.contains(points_px)
    x, y = np.rint(points_px[on_detector]).astype(np.int64).T
    hidden = np.zeros(len(points_px), dtype=bool)
    hidden[on_detector] = covered[np.minimum(y, camera.rows - 1), np.minimum(x, camera.columns - 1)]
    return hidden


def true_geometry(scene: Scene, frame: Image, target: str) -> TargetGeometry:
    """Return the apparent geometry of a target, or raise."""
    geometry = scene.geometry(frame, target)
    if isinstance(geometry, Failure):
        raise InputError(geometry.detail)
    return geometry


def _seen_bodies(
    shot: Shot, camera: Camera, sources: Sources, options: SimulationOptions, random: np.random.Generator
) -> _SeenBodies:
    """Every target that is seen in the frame at mid-exposure of a shot."""
    scene = sources.scene
    if scene is None:
        dark = np.zeros((camera.rows, camera.columns))
        return _SeenBodies(rate_e_s=dark, covered=dark > _HIDES, geometry={}, templates={})
    frame = make_black_image(shot, camera)
    geometries = [true_geometry(scene, frame, target.name) for target in scene.targets]
    image = _render_bodies(geometries, camera, options, seed=int(random.integers(2**31)))
    found, templates = {}, {}
    covered = np.zeros((camera.rows, camera.columns))
    for number, (geometry, template) in enumerate(zip(geometries, image.templates, strict=True)):
        if isinstance(template, Failure) and template.reason is Reason.DEGENERATE_GEOMETRY:
            raise InputError(f"{shot.name}: target {geometry.target.name!r}: {template.detail}")
        if isinstance(template, Template):
            found[geometry.target.name], templates[geometry.target.name] = geometry, template
            covered += image.coverage(number)
    rates = [sources.surface_rate_e_s(camera, geometry.target) for geometry in geometries]
    return _SeenBodies(rate_e_s=image.weighted(rates), covered=covered > _HIDES, geometry=found, templates=templates)


def visible_peak(shot: Shot, camera: Camera, scene: Scene, target: str) -> float:
    """Brightness of the brightest pixel of a target over that of a surface lit and seen along its normal, or 0."""
    geometry = scene.geometry(make_black_image(shot, camera), target)
    if isinstance(geometry, Failure):
        return 0.0
    image = _render_bodies([geometry], camera, SimulationOptions(rays_per_pixel_side=1), seed=0)
    return float(image.brightness.max())


def _render_bodies(
    geometries: Sequence[TargetGeometry], camera: Camera, options: SimulationOptions, *, seed: int
) -> SceneRender:
    """Render of the bodies through the camera."""
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
