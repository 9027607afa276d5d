"""Plan of images: what each candidate will show, and how well."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from giantlike.camera import Camera
from giantlike.catalogs import StarCatalog
from giantlike.core.arrays import Float, require, require_number, unit
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import rotate, turned_about
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.units import RAD_PER_DEG
from giantlike.core.values import Value
from giantlike.ephemeris import Ephemeris
from giantlike.image import Image
from giantlike.planning.candidates import Candidate
from giantlike.planning.stars import StarForecast, expect_stars
from giantlike.processing.detection.options import DetectionOptions
from giantlike.scene import Scene, TargetGeometry
from giantlike.stars.options import StarOptions

_GLARE_RADII = 1.1
"""Radius of the disk in which a body hides stars, over its own: the limb is drawn out by the point spread function."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanOptions:
    """Options of a plan.

    Parameters
    ----------
    target : str, optional
        Body that is navigated by; may be left out when there is only one.
    seed : int
        Of everything random.
    exposures_s : tuple of float, s
        Exposure times to choose from, for candidates that have none.
    keep_out_deg : float, deg
        Smallest angle of the boresight from the Sun.
    stars : StarOptions
        Options of the run that is planned.
    detection : DetectionOptions
        Options of the run that is planned.

    Raises
    ------
    InputError
        A value is out of range.
    """

    target: str | None = None
    seed: int = 0
    exposures_s: tuple[float, ...] = ()
    keep_out_deg: float = 0.0
    stars: StarOptions = field(default_factory=StarOptions)
    detection: DetectionOptions = field(default_factory=DetectionOptions)

    def __post_init__(self) -> None:
        object.__setattr__(self, "exposures_s", tuple(sorted(float(value) for value in self.exposures_s)))
        for value in self.exposures_s:
            require_number(value, "exposures_s", above=0.0)
        require(self.seed >= 0, f"seed must be >= 0, got {self.seed}")
        require_number(self.keep_out_deg, "keep_out_deg", least=0.0, most=180.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlannedImage(Value):
    """A candidate, and what its image will show.

    Parameters
    ----------
    candidate : Candidate
    exposure_s : float, s
        Given or chosen.
    geometry : TargetGeometry, optional
        Of the target.
    center_px : (2,) float64, px
        Center of the target; NaN where it is behind the camera.
    diameter_px : float, px
        Of the sphere of the volume of the target.
    elongation_rad : float, rad
        Angle of the boresight from the Sun.
    rate_px_s : (2,) float64, px/s
        Motion of the target over the image.
    star_rate_px_s : (2,) float64, px/s
        Motion of the stars at the center of the image.
    stars : StarForecast, optional
    failure : Failure, optional
        Reason for which the image is of no use.
    """

    candidate: Candidate
    exposure_s: float
    geometry: TargetGeometry | None = None
    center_px: Float = field(default_factory=lambda: np.full(2, np.nan))
    diameter_px: float = math.nan
    elongation_rad: float = math.nan
    rate_px_s: Float = field(default_factory=lambda: np.zeros(2))
    star_rate_px_s: Float = field(default_factory=lambda: np.zeros(2))
    stars: StarForecast | None = None
    failure: Failure | None = None

    @property
    def phase_rad(self) -> float:
        """Phase angle of the target, rad; NaN without a geometry."""
        return math.nan if self.geometry is None else self.geometry.phase_angle_rad

    @property
    def blur_px(self) -> float:
        """Motion of the target over the image during the exposure, px."""
        return float(np.hypot(*self.rate_px_s)) * self.exposure_s


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plan(Value):
    """Planned images, with the camera and the scene that they were planned for.

    Parameters
    ----------
    images : tuple of PlannedImage
        One a candidate, in their order.
    camera : Camera
    scene : Scene
    target : str
    options : PlanOptions
    """

    images: tuple[PlannedImage, ...]
    camera: Camera
    scene: Scene
    target: str
    options: PlanOptions

    @property
    def usable(self) -> tuple[PlannedImage, ...]:
        """Images without a failure."""
        return tuple(image for image in self.images if image.failure is None)


def plan_images(
    candidates: Sequence[Candidate],
    camera: Camera,
    scene: Scene,
    catalog: StarCatalog | None,
    options: PlanOptions = PlanOptions(),
) -> Plan | Failure:
    """Predict what images will show.

    Parameters
    ----------
    candidates : sequence of Candidate
    camera : Camera
        With its photometry; without it there are no signals, and all stars of the catalog count.
    scene : Scene
        Bodies with their declared uncertainties, and the Sun.
    catalog : StarCatalog, optional
        None: no stars.
    options : PlanOptions

    Returns
    -------
    Plan or Failure
        One image a candidate; those of no use have a failure: no_geometry, not_lit, out_of_frame, sun_keep_out. The
        plan itself fails, with the reason of its first image, where no image is of use.

    Raises
    ------
    InputError
        There is no candidate, no such target, or no exposure time; or two candidates have one name.
    """
    require(len(candidates) > 0, "a plan needs at least one candidate")
    names = [candidate.name for candidate in candidates]
    twice = next((name for name in names if names.count(name) > 1), "") if len(set(names)) < len(names) else ""
    require(not twice, f"two candidates have the name {twice!r}")
    target = scene.target(options.target).name
    for candidate in candidates:
        known = candidate.exposure_s is not None or options.exposures_s
        require(bool(known), f"{candidate.name}: no exposure time: give exposures_s, or exposure_s in the table")
    images = [_see(candidate, camera, scene, target, options) for candidate in candidates]
    images = [_with_stars(image, camera, catalog, options, number) for number, image in enumerate(images)]
    if all(image.failure is not None for image in images):
        first = images[0].failure
        assert first is not None
        return Failure(first.reason, f"none of {len(images)} candidates is of use, the first because: {first.detail}")
    return Plan(images=tuple(images), camera=camera, scene=scene, target=target, options=options)


def _see(candidate: Candidate, camera: Camera, scene: Scene, target: str, options: PlanOptions) -> PlannedImage:
    """Geometry of a candidate, or the reason for which it is of no use."""
    exposure_s = options.exposures_s[0] if candidate.exposure_s is None else candidate.exposure_s
    planned, seen = PlannedImage(candidate=candidate, exposure_s=exposure_s), candidate.scene(scene)
    if candidate.failure is not None:
        return replace(planned, failure=candidate.failure)
    image, attitude = candidate.image(), candidate.camera_from_inertial
    try:
        geometry = seen.geometry(image, target)
        if isinstance(geometry, Failure):
            return replace(planned, failure=geometry)
        assert attitude is not None
        states = seen.circumstances(image, target)
        elongation_rad = _elongation_rad(image, camera, seen, geometry)
    except (InputError, DataError) as error:
        return replace(planned, failure=Failure(Reason.NO_GEOMETRY, f"{candidate.name}: {error}"))
    position, motion_km_s = geometry.position_camera_km, np.zeros(3)
    if states is not None and states.target_velocity_km_s is not None:
        motion_km_s = rotate(attitude, states.target_velocity_km_s - states.observer_velocity_km_s)
    center_px = camera.model.project(position)
    vectors = np.stack([position, geometry.range_km * camera.model.unproject(camera.center_px)])
    jacobians = camera.model.project_jacobian(vectors)
    of_body, of_stars = -turned_about(vectors, jacobians) @ candidate.angular_rate_camera_rad_s
    planned = replace(
        planned,
        geometry=geometry,
        center_px=center_px,
        diameter_px=2.0 * geometry.target.shape.mean_radius_km / geometry.range_km * camera.model.focal_length_px,
        elongation_rad=elongation_rad,
        rate_px_s=of_body + jacobians[0] @ motion_km_s,
        star_rate_px_s=of_stars,
    )
    return replace(planned, failure=_objection(planned, camera, options))


def _elongation_rad(image: Image, camera: Camera, scene: Scene, geometry: TargetGeometry) -> float:
    """Angle of the boresight from the Sun; the Sun is as far away as stars where no ephemeris tells."""
    sun, axis = geometry.sun_direction_camera, unit(camera.model.unproject(camera.center_px))
    observer, et, attitude = image.observer, image.et, image.camera_from_inertial
    if isinstance(scene.light, Ephemeris) and observer is not None and et is not None and attitude is not None:
        sun = unit(rotate(attitude, scene.light.state(et)[0] - observer.position_km))
    return float(np.arccos(np.clip(sun @ axis, -1.0, 1.0)))


def _objection(image: PlannedImage, camera: Camera, options: PlanOptions) -> Failure | None:
    """Reason for which an image whose geometry is known is of no use."""
    name, geometry = image.candidate.name, image.geometry
    assert geometry is not None
    keep_out = options.keep_out_deg
    if image.elongation_rad < keep_out * RAD_PER_DEG:
        elongation = f"{image.elongation_rad / RAD_PER_DEG:.1f} deg"
        text = f"{name}: the boresight is {elongation} from the Sun, keep_out_deg is {keep_out:g}: point elsewhere"
        return Failure(Reason.SUN_KEEP_OUT, text)
    body = geometry.target.name
    if geometry.range_km <= geometry.target.shape.circumscribing_radius_km:
        return Failure(Reason.DEGENERATE_GEOMETRY, f"{name}: the camera is within the sphere around {body}")
    if not np.isfinite(image.center_px).all() or geometry.position_camera_km[2] <= 0.0:
        return Failure(Reason.OUT_OF_FRAME, f"{name}: {body} is behind the camera: check the attitude")
    if not camera.contains(image.center_px, margin_px=-0.5 * image.diameter_px):
        place = ", ".join(f"{value:.0f}" for value in image.center_px)
        return Failure(Reason.OUT_OF_FRAME, f"{name}: {body} is predicted at ({place}) px, outside of the image")
    return None


def _with_stars(
    image: PlannedImage, camera: Camera, catalog: StarCatalog | None, options: PlanOptions, number: int
) -> PlannedImage:
    """Image with the stars that it will show, also where the target is of no use."""
    refused = image.failure is not None and image.failure.reason in (Reason.NO_GEOMETRY, Reason.SUN_KEEP_OUT)
    if catalog is None or refused:
        return image
    blur = image.star_rate_px_s * image.exposure_s
    disk = (image.center_px, 0.5 * _GLARE_RADII * image.diameter_px)
    stars = expect_stars(
        image.candidate.image(image.exposure_s),
        camera,
        catalog,
        blur_px=(float(blur[0]), float(blur[1])),
        body=disk if np.isfinite(disk[0]).all() else None,
        options=options.stars,
        detection=options.detection,
        seed=options.seed + number,
    )
    return replace(image, stars=stars)
