"""The ground test as a simulation: a site, the sky above it, refraction by shells of air, stars and the Moon."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.catalogs import MemoryCatalog, apparent_directions, load_catalog
from giantlike.core.arrays import Float, unit
from giantlike.core.frames import rotate
from giantlike.core.light import boosted
from giantlike.core.observer import ObserverState
from giantlike.core.time import time_from_et
from giantlike.core.units import AU_KM, RAD_PER_ARCSEC, SECONDS_PER_DAY, SPEED_OF_LIGHT_KM_S
from giantlike.core.values import Value
from giantlike.image import Image
from giantlike.independent import EllipsoidBody, PinholeView, Pose, Psf, StarField, bumps, render_body, star_image
from giantlike.missions.odin.paper import PSF_SIGMA_PX, narrow_camera, narrow_view, read_out

MOON_RADIUS_KM = 1737.4  # IAU
LATITUDE_DEG, LONGITUDE_DEG, EARTH_RADIUS_KM = 33.78, -84.40, 6371.6  # Atlanta; the paper names no site
ET_OF_J2000_TT = 2451545.0  # Julian date
DELTA_T_S = 69.2  # TT minus UT1 of 2025, to 0.1 s: 1.5 arcsec of the site, the same in truth and reference
AIR_AT_SITE = 2.77e-4  # refractivity at 1,010 hPa and 15 C in visible light, Edlen's formula
SCALE_HEIGHT_KM = 8.2  # of the density of the lowest 10 km of the standard atmosphere, one exponential
LOWEST_RAD, _STEPS = np.radians(8.0), 4000
ELECTRONS_PER_S = 2.9e6
"""Of a star of magnitude 0 in the narrow camera at full aperture: 3e10 photons m^-2 s^-1 in 0.4 to 0.9 um, 2.5e-4 m^2,
0.39 of them detected (quantum efficiency 0.6, optics 0.8, air 0.8)."""
SKY_E_PER_S = 100.0  # a pixel: moonlit sky of 18.5 mag a square arcsecond
EXPOSURE_STARS_S, EXPOSURE_MOON_S = 0.5, 2e-4
IMAGE_MOTION_RAD = 0.7 * RAD_PER_ARCSEC  # seeing moves an image of 18 mm aperture by about this in 0.5 s, per axis
FAINTEST = 7.5  # magnitude of stars drawn
MOON_PEAK = 0.6  # of the full well


@dataclass(frozen=True, eq=False)
class GroundStates(Value):
    """States at an epoch, ICRF axes, barycentric, and the vertical of the site."""

    et: float
    observer: ObserverState
    zenith: Float
    moon_km: Float
    sun_from_moon: Float

    def elevation(self, direction: Float) -> float:
        """Elevation of a vector (3,), rad."""
        return float(np.arcsin(np.clip(unit(direction) @ self.zenith, -1.0, 1.0)))


def sky_at(et: float) -> GroundStates:
    """Site, Moon and Sun by the series of ERFA that need no kernel."""
    import erfa  # slow to import

    tt = et / SECONDS_PER_DAY
    helio, bary = erfa.epv00(ET_OF_J2000_TT, tt)
    terrestrial = np.asarray(
        erfa.c2t06a(ET_OF_J2000_TT, tt, ET_OF_J2000_TT, tt - DELTA_T_S / SECONDS_PER_DAY, 0.0, 0.0)
    )
    latitude, longitude = np.radians([LATITUDE_DEG, LONGITUDE_DEG])
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    zenith = terrestrial.T @ up
    spin = 7.292115e-5 * (terrestrial.T @ np.array([0.0, 0.0, 1.0]))  # rad/s, WGS 84
    site = EARTH_RADIUS_KM * zenith
    earth = np.asarray(bary["p"]) * AU_KM
    earth_velocity = np.asarray(bary["v"]) * AU_KM / SECONDS_PER_DAY
    observer = ObserverState(position_km=earth + site, velocity_km_s=earth_velocity + np.cross(spin, site))
    light_time = 384_400.0 / SPEED_OF_LIGHT_KM_S
    for _ in range(3):
        then = tt - light_time / SECONDS_PER_DAY
        moon = erfa.moon98(ET_OF_J2000_TT, then)
        earth_then = np.asarray(erfa.epv00(ET_OF_J2000_TT, then)[1]["p"])
        vector = (np.asarray(moon["p"]) + earth_then) * AU_KM - observer.position_km
        light_time = float(np.linalg.norm(vector)) / SPEED_OF_LIGHT_KM_S
    sun = -np.asarray(helio["p"]) * AU_KM - site - vector
    return GroundStates(
        et=et,
        observer=observer,
        zenith=zenith,
        moon_km=boosted(vector, observer.velocity_km_s),
        sun_from_moon=unit(sun),
    )


@lru_cache(maxsize=1)
def shell_refraction() -> tuple[Float, Float]:
    """Observed zenith distances (n,) and refraction (n,), rad, by Snell's law through shells of air.

    Returns ``zenith_rad``, ``refraction_rad`` (n,).

    Bending along a path with ``n r sin(angle)`` constant, integrated over height in an exponential atmosphere; it has
    no formula in common with ERFA's constants, by which the estimators correct.
    """
    observed = np.linspace(0.0, np.pi / 2 - LOWEST_RAD, 400)
    height = np.linspace(0.0, 12.0 * SCALE_HEIGHT_KM, _STEPS)
    index = 1.0 + AIR_AT_SITE * np.exp(-height / SCALE_HEIGHT_KM)
    slope = (1.0 - index) / SCALE_HEIGHT_KM  # dn/dh
    sine = index[0] * EARTH_RADIUS_KM * np.sin(observed)[:, None] / (index * (EARTH_RADIUS_KM + height))
    bending = -slope / index * sine / np.sqrt(1.0 - sine**2)
    return observed, np.asarray(np.trapezoid(bending, height, axis=1))


@dataclass(frozen=True)
class RefractedView(PinholeView):
    """A camera on the ground: it sees every direction raised toward the zenith."""

    zenith_camera: tuple[float, float, float] = (0.0, 0.0, 1.0)  # (3,)

    def _refract(self, vectors: Float, sign: float) -> Float:
        up = np.asarray(self.zenith_camera)
        towards = unit(np.asarray(vectors, dtype=float))
        distance = np.arccos(np.clip(towards @ up, -1.0, 1.0))
        observed, bending = shell_refraction()
        at = observed if sign > 0 else observed + bending  # raising starts from true, lowering from observed
        shift = np.interp(distance, at, bending) if sign > 0 else -np.interp(distance, at, bending)
        across = towards - (towards @ up)[..., None] * up
        flat = across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-300)
        new = distance + shift
        return np.asarray(np.cos(new)[..., None] * up + np.sin(new)[..., None] * flat)

    def project(self, vectors_camera: object) -> Float:
        """Pixels (..., 2) of vectors (..., 3) outside the atmosphere, in camera axes."""
        return super().project(self._refract(np.asarray(vectors_camera, dtype=float), -1.0))

    def directions(self, pixels: object) -> Float:
        """Vectors (..., 3) outside the atmosphere that fall on pixels (..., 2)."""
        return self._refract(np.asarray(super().directions(np.asarray(pixels, dtype=float)), dtype=float), 1.0)


def ground_view(sky: GroundStates, camera_from_inertial: Rotation, *, air: bool) -> PinholeView:
    """Narrow camera at the site, with the atmosphere or without it."""
    view = narrow_view()
    if not air:
        return view
    up = rotate(camera_from_inertial, sky.zenith)
    return RefractedView(**vars(view), zenith_camera=(float(up[0]), float(up[1]), float(up[2])))


@cache
def catalog() -> MemoryCatalog:
    """The default catalog, loaded once."""
    return load_catalog("default")


def _moved_by_air(camera_from_inertial: Rotation, rng: np.random.Generator, *, air: bool) -> Rotation:
    """Attitude by which an image is seen."""
    if not air:
        return camera_from_inertial
    return Rotation.from_rotvec(rng.normal(0.0, IMAGE_MOTION_RAD, 3) * [1.0, 1.0, 0.0]) * camera_from_inertial


def star_frame(
    sky: GroundStates, attitude: Rotation, rng: np.random.Generator, *, air: bool = True, name: str = "stars"
) -> Image:
    """Image of the stars by a narrow camera."""
    moved = _moved_by_air(attitude, rng, air=air)
    axis = rotate(moved.inv(), [0.0, 0.0, 1.0])
    stars = catalog().cone(axis, np.radians(13.5), max_magnitude=FAINTEST)
    directions = apparent_directions(stars, sky.et, observer_position_km=sky.observer.position_km)
    # a star whose magnitude in the catalog's band is G gives as many electrons here: the colors of lenses are not known
    light, _ = star_image(
        StarField(directions=directions, magnitudes=stars.magnitude),
        ground_view(sky, moved, air=air),
        moved,
        observer_velocity_km_s=sky.observer.velocity_km_s,
        psf=Psf(sigma_px=PSF_SIGMA_PX),
        zero_point_dn=ELECTRONS_PER_S * EXPOSURE_STARS_S,
    )
    return _read_out(light + SKY_E_PER_S * EXPOSURE_STARS_S, sky, rng, name, EXPOSURE_STARS_S)


@cache
def _moon() -> EllipsoidBody:
    return EllipsoidBody(MOON_RADIUS_KM, albedo=bumps(5, rms=0.15, count=80, widths_deg=(6.0, 25.0)))


def moon_frame(sky: GroundStates, attitude: Rotation, rng: np.random.Generator, *, air: bool = True) -> Image:
    """Image of the Moon by a narrow camera: a smooth sphere with maria, lunar-Lambert, by the independent renderer."""
    moved = _moved_by_air(attitude, rng, air=air)
    view = ground_view(sky, moved, air=air)
    position = rotate(moved, sky.moon_km)
    center = np.round(view.project(position)).astype(int)
    radius_px = view.focal_px * MOON_RADIUS_KM / float(np.linalg.norm(position))
    half = int(1.2 * radius_px + 20.0)
    corner = np.clip(center - half, 0, [view.columns - 2 * half, view.rows - 2 * half])
    middle = (view.center_px[0] - float(corner[0]), view.center_px[1] - float(corner[1]))
    window = replace(view, center_px=middle, columns=2 * half, rows=2 * half)
    electrons = narrow_camera().detector
    full = electrons.saturation_dn * electrons.gain_e_per_dn
    light = render_body(
        _moon(),
        window,
        Pose(position, moved, rotate(moved, sky.sun_from_moon)),
        law="lunar_lambert",
        peak_dn=MOON_PEAK * full,
        psf=Psf(sigma_px=PSF_SIGMA_PX),
    )
    frame = np.zeros((view.rows, view.columns))
    frame[corner[1] : corner[1] + 2 * half, corner[0] : corner[0] + 2 * half] = light
    return _read_out(frame, sky, rng, "moon", EXPOSURE_MOON_S)


def _read_out(electrons: Float, sky: GroundStates, rng: np.random.Generator, name: str, exposure_s: float) -> Image:
    """Read out: noise, converter, saturation."""
    return Image(
        pixels=read_out(electrons.astype(np.float32), narrow_camera().detector, rng),
        epoch=time_from_et(sky.et),
        exposure_s=exposure_s,
        observer=sky.observer,
        name=name,
    )
