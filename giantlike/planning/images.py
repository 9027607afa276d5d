"""Plan of images: what each candidate will show, and how well."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
from giantlike.planning.drawn import FixForecast, TruthOptions, can_be_drawn, draw_fixes, forecast_fix
from giantlike.planning.light import (
    BrightnessDraws,
    LightForecast,
    choose_exposure,
    electrons_per_s,
    forecast_light,
    sun_distance_au,
)
from giantlike.planning.selection import SelectOptions, choose_images, measurement_of, unknown_orbit
from giantlike.planning.stars import StarForecast, expect_stars
from giantlike.processing.detection.options import DetectionOptions
from giantlike.relative import ESTIMATORS
from giantlike.scene import Scene, Target, TargetGeometry
from giantlike.shapes import Point
from giantlike.simulation import Sources
from giantlike.stars.options import StarOptions

_CELL_LOG_SIZE, _CELL_PHASE_RAD, _CELL_LOG_SNR, _CELL_SATURATED = math.log(1.4), math.radians(15.0), math.log(2.5), 0.05
"""Cells of the table of drawn images: ratios of sizes and of signal to noise ratios, phases, and saturated fraction."""
_GLARE_RADII = 1.1  # radius of the disk in which a body hides stars, over its own: the PSF draws the limb out


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanOptions:
    """Options of a plan.

    Parameters
    ----------
    target : str, optional; body to navigate by; may be left out when there is only one
    seed : int; of everything random
    exposures_s : tuple of float, s; exposure times to choose from, for candidates that have none
    keep_out_deg : float, deg; smallest angle of the boresight from the Sun
    well_fraction : (float, float)
        Brightest pixel of the body over full scale, between which an exposure is chosen: its 95 % quantile is at most
        the second, and it is no longer than the first needs.
    min_snr : float; smallest signal to noise ratio of the whole signal of the body
    max_blur_px : float, px; largest motion of the body during an exposure that is chosen
    estimators : tuple of str; their fixes are predicted by drawn images; the first decides; none: no images are drawn
    draws : int; drawn images of each size, phase and brightness; the candidates of one share them
    truth : TruthOptions; errors of the drawn images, in addition to the uncertainties of the target
    albedo : float; normal albedo of a target without one
    sun_distance_au : float, au; distance of the Sun where no ephemeris gives it
    stars : StarOptions; options of the run that is planned
    detection : DetectionOptions; options of the run that is planned

    Raises
    ------
    InputError
        A value is out of range.
    """

    target: str | None = None
    seed: int = 0
    exposures_s: tuple[float, ...] = ()
    keep_out_deg: float = 0.0
    well_fraction: tuple[float, float] = (0.4, 0.8)
    min_snr: float = 5.0
    max_blur_px: float = 0.5
    estimators: tuple[str, ...] = ("auto",)
    draws: int = 3
    truth: TruthOptions = field(default_factory=TruthOptions)
    albedo: float = 0.045
    sun_distance_au: float = 1.0
    stars: StarOptions = field(default_factory=StarOptions)
    detection: DetectionOptions = field(default_factory=DetectionOptions)

    def __post_init__(self) -> None:
        object.__setattr__(self, "exposures_s", tuple(sorted(float(value) for value in self.exposures_s)))
        for value in self.exposures_s:
            require_number(value, "exposures_s", above=0.0)
        require(self.seed >= 0, f"seed must be >= 0, got {self.seed}")
        require_number(self.keep_out_deg, "keep_out_deg", least=0.0, most=180.0)
        low, high = self.well_fraction
        require(0.0 <= low < high <= 1.0, f"well_fraction must be (low, high) within 0 and 1, got {self.well_fraction}")
        require_number(self.min_snr, "min_snr", least=0.0)
        require_number(self.max_blur_px, "max_blur_px", above=0.0)
        require(self.draws >= 1, f"draws must be >= 1, got {self.draws}")
        for name in self.estimators:
            require(self.estimators.count(name) == 1, f"estimators: {name} is named twice")
            require(name in ESTIMATORS, f"estimators: unknown estimator {name!r}; there are {', '.join(ESTIMATORS)}")
        require_number(self.albedo, "albedo", above=0.0)
        require_number(self.sun_distance_au, "sun_distance_au", above=0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlannedImage(Value):
    """A candidate, and what its image will show.

    Parameters
    ----------
    candidate : Candidate
    exposure_s : float, s; given or chosen
    geometry : TargetGeometry, optional; of the target
    center_px : (2,) float64, px; center of the target; NaN where it is behind the camera
    diameter_px : float, px; of the sphere of the volume of the target
    elongation_rad : float, rad; angle of the boresight from the Sun
    rate_px_s : (2,) float64, px/s; motion of the target over the image
    star_rate_px_s : (2,) float64, px/s; motion of the stars at the center of the image
    light : LightForecast, optional; signal of the target
    stars : StarForecast, optional
    fixes : mapping of str to FixForecast; by estimator
    gain : float
        Half the logarithm of the ratio of the determinants of the orbit's covariance without and with the image, when
        it was chosen; NaN for an image that was not.
    failure : Failure, optional; reason for which the image is of no use
    """

    candidate: Candidate
    exposure_s: float
    geometry: TargetGeometry | None = None
    center_px: Float = field(default_factory=lambda: np.full(2, np.nan))
    diameter_px: float = math.nan
    elongation_rad: float = math.nan
    rate_px_s: Float = field(default_factory=lambda: np.zeros(2))
    star_rate_px_s: Float = field(default_factory=lambda: np.zeros(2))
    light: LightForecast | None = None
    stars: StarForecast | None = None
    fixes: Mapping[str, FixForecast] = field(default_factory=dict)
    gain: float = math.nan
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
    images : tuple of PlannedImage; one a candidate, in their order
    camera : Camera
    scene : Scene
    target : str
    options : PlanOptions
    orbit_covariance : (6, 6) float64, km and km/s, ICRF axes, optional; of the state, with the chosen images
    """

    images: tuple[PlannedImage, ...]
    camera: Camera
    scene: Scene
    target: str
    options: PlanOptions

    orbit_covariance: Float | None = None

    @property
    def usable(self) -> tuple[PlannedImage, ...]:
        """Images without a failure."""
        return tuple(image for image in self.images if image.failure is None)

    @property
    def gain(self) -> Float:
        """Gains (n,) of the images; NaN for images that were not chosen by their gain."""
        return np.array([image.gain for image in self.images])

    def select(self, count: int, options: SelectOptions | None = None) -> Plan:
        """Choose the images that determine the orbit best.

        Parameters
        ----------
        count : int; number of images; fewer are chosen where no more are usable or far enough apart
        options : SelectOptions, optional

        Returns
        -------
        Plan
            The chosen images in order of time, each with its gain.

        Raises
        ------
        InputError
            No image has a predicted fix, an attitude and an epoch; or the count is below 1.

        Notes
        -----
        Greedy: each choice lowers the determinant of the covariance of the state most (D-optimal), with the size of the
        target, which all ranges share, estimated beside it. A fix that may fail counts by its probability.
        """
        options = options or SelectOptions()
        orbit, name = options.orbit, options.estimator or next(iter(self.options.estimators), "")
        ready = [
            image
            for image in sorted(self.usable, key=lambda image: image.candidate.image().et or 0.0)
            if name in image.fixes and image.fixes[name].covariance is not None
        ]
        require(bool(ready), f"no image has a predicted fix of {name or 'an estimator'}: nothing can be chosen")
        states = []
        for image in ready:
            seen, candidate = image.candidate.image(), image.candidate
            known = candidate.scene(self.scene).circumstances(seen, self.target)
            assert image.geometry is not None
            assert seen.et is not None
            assert candidate.camera_from_inertial is not None
            states.append(
                (seen.et, candidate.camera_from_inertial.as_matrix(), image.geometry.position_camera_km, known)
            )
        if orbit is None:
            et, matrix, position, known = states[0]
            velocity = np.zeros(3)
            if known is not None and known.target_velocity_km_s is not None:
                velocity = known.observer_velocity_km_s - known.target_velocity_km_s
            orbit = unknown_orbit(et, -(matrix.T @ position), velocity, states[-1][0] - et)
        measurements = [
            measurement_of(
                et,
                self.camera,
                position,
                matrix,
                known,
                image.fixes[name],
                None if image.stars is None else image.stars.covariance_rad2,
                orbit,
            )
            for image, (et, matrix, position, known) in zip(ready, states, strict=True)
        ]
        chosen, gains, covariance = choose_images(measurements, count, orbit, options.min_gap_s)
        by_number = dict(zip(chosen, gains, strict=True))
        images = tuple(replace(ready[number], gain=by_number[number]) for number in sorted(by_number))
        return replace(self, images=images, orbit_covariance=covariance)


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
    camera : Camera; with its photometry; without it there are no signals, and all stars of the catalog count
    scene : Scene; bodies with their declared uncertainties, and the Sun
    catalog : StarCatalog, optional; None: no stars
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
    images = _with_light(images, camera, scene, scene.target(target), options)
    images = [_with_stars(image, camera, catalog, options, number) for number, image in enumerate(images)]
    images = _with_fixes(images, camera, scene, scene.target(target), options)
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


def _sources(image: PlannedImage, camera: Camera, scene: Scene, options: PlanOptions) -> Sources:
    """Light of an image whose geometry is known."""
    assert camera.photometry is not None
    assert image.geometry is not None
    seen = image.candidate.scene(scene)
    au = sun_distance_au(image.candidate.image(), seen, image.geometry, options.sun_distance_au)
    return Sources(photometry=camera.photometry, albedo=options.albedo, sun_distance_au=au)


def _with_light(
    images: Sequence[PlannedImage], camera: Camera, scene: Scene, target: Target, options: PlanOptions
) -> list[PlannedImage]:
    """Images with the signal of the target and, where none is given, the exposure that suits it."""
    if camera.photometry is None or isinstance(target.shape, Point):
        return list(images)
    draws = BrightnessDraws.of_law(target.reflectance, options.truth, options.seed)
    full_dn = min(camera.detector.saturation_dn, float(np.iinfo(np.uint16).max)) - camera.detector.bias_dn
    seen = []
    for image in images:
        if image.failure is not None or image.geometry is None:
            seen.append(image)
            continue
        rate_e_s = electrons_per_s(camera, image.geometry, _sources(image, camera, scene, options))
        if isinstance(rate_e_s, Failure):
            seen.append(replace(image, failure=Failure(rate_e_s.reason, f"{image.candidate.name}: {rate_e_s.detail}")))
            continue
        given = image.candidate.exposure_s
        exposures_s = options.exposures_s if given is None else (given,)
        sigma_mag = float(camera.photometry.sigma_mag())
        forecasts = [
            forecast_light(rate_e_s, exposure_s, camera, draws, image.phase_rad, sigma_mag)
            for exposure_s in exposures_s
        ]
        chosen = choose_exposure(
            exposures_s,
            forecasts,
            full_dn=full_dn,
            well_fraction=options.well_fraction,
            min_snr=options.min_snr,
            longest_s=options.max_blur_px / max(float(np.hypot(*image.rate_px_s)), 1e-12),
        )
        light = forecasts[chosen]
        faint = None
        if light.snr < options.min_snr:
            text = f"{image.candidate.name}: signal to noise ratio {light.snr:.2g} in {exposures_s[chosen]:g} s"
            text = f"{text}, min_snr is {options.min_snr:g}: expose longer, or lower min_snr"
            faint = Failure(Reason.NO_SIGNAL, text)
        seen.append(replace(image, exposure_s=exposures_s[chosen], light=light, failure=faint))
    return seen


def _with_fixes(
    images: Sequence[PlannedImage], camera: Camera, scene: Scene, target: Target, options: PlanOptions
) -> list[PlannedImage]:
    """Images with the fixes of drawn images of about their size, phase and brightness."""
    if not options.estimators or not can_be_drawn(target):
        return list(images)
    cells: dict[tuple[int, ...], list[int]] = {}
    for number, image in enumerate(images):
        if image.failure is None and image.light is not None:
            cells.setdefault(_cell_of(image, camera), []).append(number)
    found = list(images)
    for cell in cells.values():
        drawn = []
        for draw in range(options.draws):
            number = cell[int((draw + 0.5) * len(cell) / options.draws)]
            image = images[number]
            assert image.geometry is not None
            drawn.append(
                draw_fixes(
                    image.candidate,
                    image.geometry,
                    image.exposure_s,
                    camera,
                    scene,
                    options.estimators,
                    truth=options.truth,
                    sources=_sources(image, camera, scene, options),
                    seed=(options.seed, number, draw),
                )
            )
        for number in cell:
            image = images[number]
            assert image.geometry is not None
            fixes = {
                name: forecast_fix(name, [one[name] for one in drawn], camera, image.geometry, image.diameter_px)
                for name in options.estimators
            }
            found[number] = replace(image, fixes=fixes)
    return found


def _cell_of(image: PlannedImage, camera: Camera) -> tuple[int, ...]:
    """Numbers of the size, the phase, the brightness and the cut by the frame of an image in the table of draws."""
    assert image.light is not None
    cut = not camera.contains(image.center_px, margin_px=0.5 * image.diameter_px)
    sizes = math.log(image.diameter_px) / _CELL_LOG_SIZE, image.phase_rad / _CELL_PHASE_RAD
    snr = math.log(max(image.light.snr_peak, 1e-3)) / _CELL_LOG_SNR
    return (*(round(value) for value in (*sizes, snr)), int(cut), int(image.light.saturated > _CELL_SATURATED))
