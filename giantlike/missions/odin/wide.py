"""Wide cameras: fisheye images of Earth, Moon and Sun, and which body is which by its brightness."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from giantlike.autonomy import find_patches, identify_body
from giantlike.autonomy.body_photometry import BodyLight, PatchOfLight, chandrasekhar_sphere
from giantlike.autonomy.body_search import SIZE_SIGMA, SearchOptions, SeenPatch
from giantlike.camera import Camera
from giantlike.core.arrays import Float, unit
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure
from giantlike.core.photometry import Photometry
from giantlike.core.time import time_from_et
from giantlike.core.units import AU_KM
from giantlike.core.values import Value
from giantlike.image import Image
from giantlike.independent import LAWS
from giantlike.missions.odin.paper import FULL_WELL_E, PSF_SIGMA_PX, paper, read_out, wide_camera
from giantlike.ray_tracing import Lambert
from giantlike.ray_tracing.disk import disk_photocenter

RADII_KM = {"EARTH": 6371.0, "MOON": 1737.4, "SUN": 695_700.0}
GEOMETRIC_ALBEDO = {"EARTH": 0.434, "MOON": 0.12}  # NASA planetary fact sheets
LAW_OF_TRUTH = {"EARTH": "lambert", "MOON": "lunar_lambert"}
ALBEDO_SIGMA = {"EARTH": 0.15, "MOON": 0.05}  # true scatter: clouds; maria on the side that is seen
CALIBRATION_SIGMA = 0.05  # of the photometric calibration
MOON_SCATTERING = 0.604  # Single-scattering albedo of a Chandrasekhar sphere with the Moon's geometric albedo of 0.12
MODEL_SIGMA = {"EARTH": 0.25, "MOON": 0.15}
"""Relative errors of the models given to the identification: clouds, and the side of the Moon that is seen."""
SUNLIT_EFFICIENCY = 0.397  # by which eq. 23 equals eq. 22 for sunlight on the sensor assumed here
STEEPEST_RAD = np.radians(87.0)  # from the boresight: beyond, the foreshortened aperture is not a measure of light
EXPOSURES_S = (4e-6, 4e-5)
"""For the sunlit Earth, which fills 60 % of the well through 1.45 mm in the shorter one, and for the Moon."""
SAME_BODY_RAD = np.radians(2.0)  # patches of two exposures that are closer are one body
LEAST_PIXELS = 6  # area of the disk: a smaller body has no size to compare its brightness with
SUN_HALO_PX = 6.0  # width of the light that the lens scatters around the Sun
SUPERSAMPLES, SUPERSAMPLES_OF_LARGE, LARGE_PX = 7, 2, 30.0  # rays along the side of a pixel, by radius of the disk
OUTWARD = (Rotation.identity(), Rotation.from_euler("x", 180.0, degrees=True))
"""The two wide cameras from the axes of the instrument: they look to opposite ends."""


def moon_phase_law(phase_rad: Float) -> Float:
    """Brightness of the Moon relative to full phase, as observed: 0.026 mag a degree and 4e-9 mag a fourth power."""
    degrees = np.degrees(phase_rad)
    return np.asarray(10.0 ** (-0.4 * (0.026 * degrees + 4e-9 * degrees**4)))


def lambert_phase_law(phase_rad: Float) -> Float:
    """Brightness of a Lambert sphere relative to full phase."""
    return np.asarray((np.sin(phase_rad) + (np.pi - phase_rad) * np.cos(phase_rad)) / np.pi)


PHASE_OF_TRUTH: dict[str, Callable[[Float], Float]] = {"EARTH": lambert_phase_law, "MOON": moon_phase_law}


@cache
def wide_photometry() -> Photometry:
    """Zero point of the wide camera: the mean quantum efficiency is one calibrated on sunlight."""
    return Photometry.from_aperture(wide_aperture_m2(), quantum_efficiency=SUNLIT_EFFICIENCY)


def wide_aperture_m2() -> float:
    """Area of the aperture of the wide camera."""
    return float(np.pi / 4.0 * (paper()["wide"]["aperture_mm"] * 1e-3) ** 2)


def electrons_of_spectrum(irradiance_of_sun: float) -> float:
    """Electrons per second of a body that reflects this fraction of the Sun's light at 1 au: eq. 22 with spectra.

    ``irradiance_of_sun``: irradiance at the camera relative to the Sun at 1 au, the same at all wavelengths. The Sun is
    a blackbody and the sensor peaks at 0.52 um: the mean values of eq. 23 stand for that.
    """
    h, c, boltzmann = 6.62607015e-34, 299_792_458.0, 1.380649e-23
    wavelengths = np.linspace(0.35e-6, 1.0e-6, 400)
    radiance = 2 * h * c**2 / wavelengths**5 / np.expm1(h * c / (wavelengths * boltzmann * 5772.0))
    sun = np.pi * radiance * (695_700.0 / AU_KM) ** 2
    efficiency = 0.66 * np.exp(-(((wavelengths * 1e6 - 0.52) / 0.22) ** 2))
    area = wide_aperture_m2()
    return float(irradiance_of_sun * area * np.trapezoid(efficiency * wavelengths * sun, wavelengths) / (h * c))


@dataclass(frozen=True, eq=False)
class CislunarScene:
    """Places of bodies from the spacecraft, instrument axes, km, and their true geometric albedos."""

    bodies_km: dict[str, Float]
    albedo: dict[str, float]


def random_scene(rng: np.random.Generator, *, exchanged: bool = False) -> CislunarScene:
    """Spacecraft somewhere between low and twice lunar distance, attitude at random, albedos of Earth and Moon."""
    earth_from_moon = unit(rng.normal(size=3)) * 384_400.0
    far = rng.uniform(15_000.0, 500_000.0)
    earth = unit(rng.normal(size=3)) * far
    sun = unit(rng.normal(size=3)) * AU_KM
    turn = Rotation.random(rng=rng)
    places = {"EARTH": earth, "MOON": earth - earth_from_moon, "SUN": sun}
    other = {"EARTH": "MOON", "MOON": "EARTH"}
    return CislunarScene(
        bodies_km={name: rotate(turn, place) for name, place in places.items()},
        albedo={
            name: GEOMETRIC_ALBEDO[other[name] if exchanged else name] * float(np.exp(rng.normal(0.0, sigma)))
            for name, sigma in ALBEDO_SIGMA.items()
        },
    )


def wide_image(scene: CislunarScene, index: int, rng: np.random.Generator, exposure_s: float) -> Image:
    """Image of a wide camera."""
    camera = wide_camera(f"wide {index}")
    gain = float(np.exp(rng.normal(0.0, CALIBRATION_SIGMA)))
    electrons = np.full((camera.rows, camera.columns), 2.0)
    sun = unit(scene.bodies_km["SUN"])
    for name, place in scene.bodies_km.items():
        add_body(electrons, camera, rotate(OUTWARD[index], place), name, rotate(OUTWARD[index], sun), scene, exposure_s)
    light = np.minimum(electrons * gain, 4.0 * FULL_WELL_E).astype(np.float32)
    pixels = read_out(light, camera.detector, rng)
    return Image(pixels=pixels, name=camera.name, epoch=time_from_et(0.0), exposure_s=exposure_s)


def add_body(
    electrons: Float, camera: Camera, place: Float, name: str, sun: Float, scene: CislunarScene, exposure_s: float
) -> None:
    """Add the light of a body to an image, its illuminated part by rays, where the camera sees it."""
    center = camera.model.project(place)
    half_angle = float(np.arcsin(min(RADII_KM[name] / float(np.linalg.norm(place)), 1.0)))
    reach = int(np.ceil(half_angle * camera.model.focal_length_px * 1.1 + 8.0 + (60.0 if name == "SUN" else 0.0)))
    if (
        not np.isfinite(center).all()
        or (center < -reach).any()
        or (center > [camera.columns + reach, camera.rows + reach]).any()
    ):
        return
    left, top = (max(int(value) - reach, 0) for value in center)
    right, bottom = min(int(center[0]) + reach, camera.columns - 1), min(int(center[1]) + reach, camera.rows - 1)
    if right <= left or bottom <= top:
        return
    rays = SUPERSAMPLES if half_angle * camera.model.focal_length_px < LARGE_PX else SUPERSAMPLES_OF_LARGE
    steps = (np.arange(rays) + 0.5) / rays - 0.5
    x = (np.arange(left, right + 1)[:, None] + steps).ravel()
    y = (np.arange(top, bottom + 1)[:, None] + steps).ravel()
    columns, rows = np.meshgrid(x, y)
    shape = (bottom - top + 1, rays, right - left + 1, rays)
    seen = unit(camera.model.unproject(np.stack([columns, rows], axis=-1)))
    lit_from, law = None if name == "SUN" else sun, LAW_OF_TRUTH.get(name, "")
    light = disk_light(seen, unit(place), half_angle, lit_from, law)
    light = np.nan_to_num(light).reshape(shape).mean(axis=(1, 3))
    whole = whole_disk(half_angle, unit(place), lit_from, law, camera, center)
    if light.sum() <= 0.0 or whole <= 0.0:
        return
    total = electrons_of_spectrum(share_of_sun(name, place, sun, scene)) * exposure_s
    total *= float(unit(place)[2]) if unit(place)[2] > 0.0 else 0.0
    patch = gaussian_filter(light * (total / whole), PSF_SIGMA_PX)
    if name == "SUN":
        rows_px, columns_px = np.mgrid[top : bottom + 1, left : right + 1]
        distance = np.hypot(columns_px - center[0], rows_px - center[1])
        patch = patch + 2.0 * FULL_WELL_E / (1.0 + (distance / SUN_HALO_PX) ** 2) ** 1.5
    electrons[top : bottom + 1, left : right + 1] += patch


def disk_light(seen: Float, toward: Float, half_angle: float, sun: Float | None, law: str) -> Float:
    """Relative brightness (...) of directions (..., 3) on the disk of a sphere; a disk of even light without a Sun."""
    offset = seen - (seen @ toward)[..., None] * toward
    radius = np.linalg.norm(offset, axis=-1) / np.sin(half_angle)
    on = (radius < 1.0) & (seen @ toward > 0.0)
    if sun is None:
        return np.asarray(on, dtype=np.float64)
    depth = np.sqrt(np.clip(1.0 - radius**2, 0.0, None))
    normal = offset / np.sin(half_angle) - depth[..., None] * toward
    incidence = normal @ sun
    lit = on & (incidence > 0.0)
    light: Float = np.zeros(radius.shape)
    phase = np.full(int(lit.sum()), float(-toward @ sun))
    light[lit] = LAWS[law](incidence[lit], np.maximum(depth[lit], 1e-6), phase)
    return light


def whole_disk(half_angle: float, toward: Float, sun: Float | None, law: str, camera: Camera, center: Float) -> float:
    """Sum of the relative brightness over the rays that meet the body, were all of it inside the frame."""
    side = np.linspace(-1.0, 1.0, 401)[:-1] + 1.0 / 400.0
    first = unit(np.cross(toward, np.eye(3)[int(np.argmin(np.abs(toward)))]))
    second = np.cross(toward, first)
    x, y = np.meshgrid(side, side)
    plane = toward + np.sin(half_angle) * (x[..., None] * first + y[..., None] * second)
    inside = x**2 + y**2 < 1.0
    light = np.where(inside, disk_light(unit(plane), toward, half_angle, sun, law), 0.0).mean() * 4.0
    by_pixel = camera.model.unproject_jacobian(center) / float(np.linalg.norm(camera.model.unproject(center)))
    pixel_rad2 = float(np.linalg.norm(np.cross(by_pixel[:, 0], by_pixel[:, 1])))
    return float(light * np.sin(half_angle) ** 2 / pixel_rad2)


def share_of_sun(name: str, place: Float, sun: Float, scene: CislunarScene) -> float:
    """Irradiance of a body at the camera relative to the Sun at 1 au."""
    if name == "SUN":
        return 1.0
    ratio = RADII_KM[name] / float(np.linalg.norm(place))
    phase = float(np.arccos(np.clip(-unit(place) @ sun, -1.0, 1.0)))
    return float(scene.albedo[name] * PHASE_OF_TRUTH[name](np.asarray(phase)) * ratio**2)


def models(*, measured: bool) -> tuple[BodyLight, BodyLight]:
    """Brightness that the identification expects of a Lambert Earth and of the Moon.

    ``measured``: the Moon by its observed phase curve (else as the Chandrasekhar sphere of the paper).
    """
    curves: dict[str, Callable[[Float], Float]] = {
        "EARTH": lambda phase: GEOMETRIC_ALBEDO["EARTH"] * lambert_phase_law(phase),
        "MOON": (lambda phase: GEOMETRIC_ALBEDO["MOON"] * moon_phase_law(phase))
        if measured
        else partial(chandrasekhar_sphere, MOON_SCATTERING),
    }
    earth, moon = (
        BodyLight(name=name, brightness=curve, relative_sigma=MODEL_SIGMA[name]) for name, curve in curves.items()
    )
    return earth, moon


@dataclass(frozen=True, eq=False)
class FoundBody(Value):
    """A body that the search found: its name, the direction in instrument axes, or why it has no name."""

    name: str | None
    direction: Float
    patch: SeenPatch
    why: str = ""


def search(images: Sequence[Image], sun_direction: Float | None, *, measured: bool = True) -> tuple[FoundBody, ...]:
    """Search wide images and identify bodies by their brightness.

    ``sun_direction`` in instrument axes; ``measured`` as in :func:`models`.
    """
    seen: list[tuple[SeenPatch, Float, float]] = []
    for k, image in enumerate(images):
        patches = find_patches(image, wide_camera(image.name), SearchOptions())
        if not isinstance(patches, Failure) and image.exposure_s is not None:
            turn = OUTWARD[k % 2].inv()
            seen += [(patch, rotate(turn, patch.direction_camera), image.exposure_s) for patch in patches]
    suns = sorted((each for each in seen if each[0].saturated), key=lambda each: -each[0].dn / each[2])
    if sun_direction is None and not suns:
        why = "the direction of the Sun is not known"
        return tuple(FoundBody(None, direction, patch, why) for patch, direction, _ in seen)
    sun = suns[0][1] if sun_direction is None else sun_direction
    found = []
    for patch, direction, exposure_s in _drop_repeated(seen):
        if float(direction @ sun) > np.cos(np.radians(1.0)):
            found.append(FoundBody("SUN", direction, patch))
        else:
            found.append(identify_patch(patch, direction, sun, exposure_s, measured=measured))
    return tuple(found)


def _drop_repeated(seen: list[tuple[SeenPatch, Float, float]]) -> list[tuple[SeenPatch, Float, float]]:
    """One patch per position: longest exposure not saturated, else the shortest; brightest first."""
    best = sorted(seen, key=lambda each: (each[0].saturated, each[2] if each[0].saturated else -each[2]))
    kept: list[tuple[SeenPatch, Float, float]] = []
    for each in best:
        if all(float(each[1] @ other[1]) < np.cos(SAME_BODY_RAD + _reach(each[0], other[0])) for other in kept):
            kept.append(each)
    return sorted(kept, key=lambda each: -each[0].dn / each[2])


def _reach(first: SeenPatch, second: SeenPatch) -> float:
    """Angular radius of the larger of two patches."""
    return max(float(np.sqrt(max(np.trace(patch.second_moment_rad2), 0.0))) for patch in (first, second))


def identify_patch(patch: SeenPatch, direction: Float, sun: Float, exposure_s: float, *, measured: bool) -> FoundBody:
    """Name of one patch, and the direction of its center by the offset of the center of light."""
    axes = wide_axes(patch, direction)
    half_angle = patch.half_angle_rad(rotate(axes, sun))
    pixels = np.pi * (half_angle * wide_camera().model.focal_length_px) ** 2
    phase = float(np.pi - np.arccos(np.clip(direction @ sun, -1.0, 1.0)))
    along = sun - direction * float(direction @ sun)
    direction = unit(direction - unit(along) * float(disk_photocenter(Lambert(), phase)) * np.tan(half_angle))
    why = (
        "cut by the frame" * patch.on_edge or "saturated" * patch.saturated or "too small" * bool(pixels < LEAST_PIXELS)
    )
    angle = float(np.arccos(np.clip(patch.direction_camera[2], -1.0, 1.0)))
    why = why or "too far from the boresight" * bool(angle > STEEPEST_RAD)
    if why:
        return FoundBody(None, direction, patch, why)
    light = PatchOfLight(
        dn=patch.dn,
        relative_sigma=float(np.hypot(CALIBRATION_SIGMA, patch.sigma_dn / patch.dn)),
        half_angle_rad=half_angle,
        half_angle_sigma_rad=half_angle * float(np.hypot(SIZE_SIGMA, 1.5 / pixels)),
        phase_rad=phase,
        angle_rad=angle,
        exposure_s=exposure_s,
    )
    gain = wide_camera().detector.gain_e_per_dn
    answer = identify_body(light, models(measured=measured), wide_photometry(), gain_e_per_dn=gain)
    if isinstance(answer, Failure):
        return FoundBody(None, direction, patch, answer.detail)
    return FoundBody(answer.name, direction, patch)


def wide_axes(patch: SeenPatch, direction: Float) -> Rotation:
    """Axes of the wide camera that saw a patch, from the axes of the instrument."""
    errors = [float(np.linalg.norm(rotate(turn, direction) - patch.direction_camera)) for turn in OUTWARD]
    return OUTWARD[int(np.argmin(errors))]


@dataclass(frozen=True, eq=False)
class WideStudy(Value):
    """Searches of many scenes, for each body that a camera saw whole.

    True name, name given by the observed curve of the Moon and by the paper's sphere, why there is none, error of the
    direction (rad), diameter (px) and phase (rad); diameters of those that were not found.
    """

    true: tuple[str, ...]
    given: tuple[str | None, ...]
    by_sphere: tuple[str | None, ...]
    why: tuple[str, ...]
    error_rad: Float
    diameter_px: Float
    phase_rad: Float
    missed_px: Float
    scenes: int

    def share(self, name: str, *, sphere: bool = False) -> tuple[int, int, int]:
        """Right, wrong and without a name, of the bodies that are ``name``."""
        answers = self.by_sphere if sphere else self.given
        given = [g for t, g in zip(self.true, answers, strict=True) if t == name]
        right, none = sum(g == name for g in given), sum(g is None for g in given)
        return right, len(given) - right - none, none


def wide_study(
    scenes: int, rng: np.random.Generator, progress: Callable[[int], None], *, exchanged: bool = False
) -> WideStudy:
    """Search simulated scenes; the direction of the Sun is from its ephemeris."""
    rows: list[tuple[str, str | None, str | None, str, float, float, float]] = []
    missed = []
    camera = wide_camera()
    for k in range(scenes):
        scene = random_scene(rng, exchanged=exchanged)
        images = [wide_image(scene, index, rng, exposure) for exposure in EXPOSURES_S for index in (0, 1)]
        sun = unit(scene.bodies_km["SUN"])
        observed, sphere = (search(images, sun, measured=measured) for measured in (True, False))
        for name in ("EARTH", "MOON"):
            place = scene.bodies_km[name]
            if not any(in_field(camera, rotate(turn, place)) for turn in OUTWARD):
                continue
            toward = unit(place)
            diameter = 2.0 * RADII_KM[name] / float(np.linalg.norm(place)) * camera.model.focal_length_px
            answer, other = near_to(observed, toward, diameter), near_to(sphere, toward, diameter)
            if answer is None or other is None:
                missed.append(diameter)
                continue
            error = float(np.arccos(np.clip(answer.direction @ toward, -1.0, 1.0)))
            phase = float(np.arccos(np.clip(-toward @ sun, -1.0, 1.0)))
            rows.append((name, answer.name, other.name, answer.why, error, diameter, phase))
        progress(k + 1)
    true, given, by_sphere, why, *numbers = zip(*rows, strict=True)
    errors, diameters, phases, missed_px = (np.array(each, dtype=np.float64) for each in (*numbers, missed))
    return WideStudy(true, given, by_sphere, why, errors, diameters, phases, missed_px, scenes)


def near_to(found: tuple[FoundBody, ...], direction: Float, diameter_px: float) -> FoundBody | None:
    """Brightest body found near a true direction, the Sun apart."""
    reach = np.cos(max(0.02, 0.75 * diameter_px / wide_camera().model.focal_length_px))
    near = [each for each in found if each.name != "SUN" and float(each.direction @ direction) > reach]
    return near[0] if near else None


def in_field(camera: Camera, place: Float) -> bool:
    """True if the whole of a body near a position is in the frame, with a margin of 12 px."""
    pixel = camera.model.project(place)
    return bool(
        np.isfinite(pixel).all()
        and (pixel > 12.0).all()
        and (pixel < [camera.columns - 13.0, camera.rows - 13.0]).all()
    )
