"""Limbs with relief and atmosphere: what a height map and a limb altitude make of biases; prints JSON.

``passes``: a made-up Moon (waves by Kaula's rule, 1.8 km rms, some 14 km from lowest to highest), rendered by
``giantlike.independent``, which shares no code with the estimators, at ranges and phases of Artemis I (Inman et al.),
each from another side: range and center of every estimator on limbs with the smooth sphere, with the map, with maps
that are too coarse, and with the map of another side. ``haze``: an Earth in haze of some optical depths, whose light
is summed along rays, with and without its atmosphere told.

Usage: python benchmarks/terrain.py [passes haze] [--sides 16] [--images 1] [--seed 1]
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import time
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike import ApparentGeometry, Camera, Detector, Failure, GaussianPsf, Image, PositionFix, Scene, Target
from giantlike.atmosphere import Atmosphere
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.independent import (
    Haze,
    PinholeView,
    Pose,
    Psf,
    Recorder,
    ReliefBody,
    SphereField,
    hazy_sphere,
    record,
    render_body,
    rough,
)
from giantlike.relative import EllipseFit, EllipsoidCRA, Estimator, LimbMatching, SigmoidLimb
from giantlike.shapes import Ellipsoid
from giantlike.terrain import HeightMap, limb_profile

MOON_KM = 1737.4
EARTH_KM, EARTH_AT_KM, HAZE_KM = 6371.0, 350_000.0, 7.0
RELIEF_KM = 1.8  # rms; LOLA's shape has 2.2 with the South Pole-Aitken basin
IFOV_RAD = math.radians(28.2 / 3600.0)  # Inman et al., section IV.B
RANGES_KM = (60_000.0, 400_000.0)  # passes of the Moon in Inman et al., Table 1
PHASES_DEG = (20.0, 110.0)
ESTIMATORS: tuple[Estimator, ...] = (LimbMatching(), EllipsoidCRA(), SigmoidLimb(), EllipseFit())


def grid_of(field: SphereField, per_degree: float) -> Float:
    """Heights, km, of the made-up Moon on an equirectangular grid."""
    rows, columns = round(180 * per_degree), round(360 * per_degree)
    latitude = np.radians(90.0 - (np.arange(rows) + 0.5) / per_degree)[:, None]
    longitude = np.radians((np.arange(columns) + 0.5) / per_degree)
    directions = np.stack(
        np.broadcast_arrays(
            np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)
        ),
        axis=-1,
    )
    return MOON_KM * field(directions.reshape(-1, 3)).reshape(rows, columns)


@dataclass(frozen=True)
class Side:
    """One pass: where the camera is, and one pose of its images."""

    pose: Pose
    camera: Camera
    view: PinholeView
    image_dn: Float

    @classmethod
    def of(cls, body: ReliefBody, rng: np.random.Generator, camera: Camera) -> Side:
        """Draw a pass and render it."""
        distance = float(np.exp(rng.uniform(*np.log(RANGES_KM))))
        model = camera.model
        off = rng.uniform(-20.0, 20.0, size=2) + 0.5 * (camera.columns - 1)
        position = distance * model.unproject(off)
        phase, azimuth = np.radians(rng.uniform(*PHASES_DEG)), rng.uniform(0.0, 2.0 * np.pi)
        line = position / distance
        side = np.cross(line, [math.cos(azimuth), math.sin(azimuth), 0.3])
        sun = -line * math.cos(phase) + side / np.linalg.norm(side) * math.sin(phase)
        pose = Pose(position, Rotation.random(random_state=rng), sun)
        focal = float(1.0 / IFOV_RAD)
        middle = 0.5 * (camera.columns - 1)
        view = PinholeView(focal_px=focal, center_px=(middle, middle), columns=camera.columns, rows=camera.rows)
        return cls(pose, camera, view, render_body(body, view, pose, law="mcewen", psf=Psf(sigma_px=0.7)))

    def fixes(self, rng: np.random.Generator, maps: dict[str, HeightMap | None]) -> list[dict[str, object]]:
        """Every estimator on a new image with every map."""
        pixels = record(self.image_dn, rng, Recorder(gain_e_per_dn=5.0, read_noise_e=25.0)).pixels
        image = Image(pixels=pixels, camera_from_inertial=Rotation.identity(), name="pass")
        error = rng.normal(size=3) * np.array([2.0, 2.0, 0.0]) * IFOV_RAD * np.linalg.norm(self.pose.position_camera_km)
        rows = []
        for name, heights in maps.items():
            apparent = ApparentGeometry(
                position_inertial_km=np.asarray(self.pose.position_camera_km) * (1.0 + 2e-3 * rng.normal()) + error,
                inertial_from_body=self.pose.camera_from_body,
                sun_direction_inertial=np.asarray(self.pose.sun_direction_camera),
            )
            shape = Ellipsoid(radii_km=np.full(3, MOON_KM))
            scene = Scene(targets=(Target(name="MOON", shape=shape, ephemeris=apparent, terrain=heights),))
            for estimator in ESTIMATORS:
                start = time.process_time()
                fix = estimator.estimate(image, self.camera, scene)
                row: dict[str, object] = {"map": name, "estimator": estimator.name}
                row["cost_s"] = time.process_time() - start
                rows.append(row | ({"failed": str(fix)} if isinstance(fix, Failure) else self.errors(fix)))
        return rows

    def errors(self, fix: object) -> dict[str, object]:
        """Errors of a fix along and across the line of sight, km, px and in units of its sigmas."""
        truth = np.asarray(self.pose.position_camera_km)
        line = truth / np.linalg.norm(truth)
        off, covariance = fix.position_camera_km - truth, fix.covariance_camera_km2  # type: ignore[attr-defined]
        center = fix.center_px - self.view.project(truth)  # type: ignore[attr-defined]
        return {
            "range_km": float(off @ line),
            "range_sigma_km": float(math.sqrt(line @ covariance @ line)),
            "range_km_per_km": float(np.linalg.norm(truth)) / MOON_KM,
            "center_px": center.tolist(),
            "nees_center": float(center @ np.linalg.solve(fix.covariance_px2, center)),  # type: ignore[attr-defined]
            "nees": float(off @ np.linalg.solve(covariance, off)),
            "suspect": bool(fix.flags.suspect),  # type: ignore[attr-defined]
            "flags": fix.flags.names(),  # type: ignore[attr-defined]
        }


def orion(size_px: int) -> Camera:
    """The middle of the Orion camera's frame."""
    focal, middle = 1.0 / IFOV_RAD, 0.5 * (size_px - 1)
    return Camera(
        name="Orion",
        columns=size_px,
        rows=size_px,
        model=PinholeModel(fx_px=focal, fy_px=focal, cx_px=middle, cy_px=middle),
        psf=GaussianPsf(sigma_px=0.7),
        detector=Detector(gain_e_per_dn=5.0, read_noise_e=25.0, saturation_dn=16000.0),
    )


def passes(sides: int, images: int, seed: int) -> dict[str, object]:
    """Errors with the smooth body and with maps, over passes."""
    field = rough(seed, rms=RELIEF_KM / MOON_KM)
    body = ReliefBody(radii_km=MOON_KM, relief=field)
    radii = [MOON_KM] * 3
    fine = grid_of(field, 8.0)
    maps: dict[str, HeightMap | None] = {
        "smooth": None,
        "8 per deg": HeightMap.from_array(fine, reference_radii_km=radii),
        "1 per deg": HeightMap.from_array(grid_of(field, 1.0), reference_radii_km=radii),
        "1 per 5 deg": HeightMap.from_array(grid_of(field, 0.2), reference_radii_km=radii),
        "wrong": HeightMap.from_array(np.roll(fine, fine.shape[1] // 5, axis=1), reference_radii_km=radii),
    }
    rng = np.random.default_rng(seed)
    camera = orion(512)
    rows = []
    for number in range(sides):
        side = Side.of(body, rng, camera)
        for _ in range(images):
            told = predicted_bias(side.pose, maps["8 per deg"])
            rows += [row | {"side": number, "told_km": told} for row in side.fixes(rng, maps)]
    return {
        "maps_unresolved_km": {n: m.unresolved_km() for n, m in maps.items() if m},
        "prediction": prediction(rows),
        "table": table(rows, maps),
    }


def predicted_bias(pose: Pose, heights: HeightMap | None) -> float:
    """Radius, km, by which the body of a pass will seem too large, by the map and the geometry alone."""
    assert heights is not None
    turn = pose.camera_from_body.inv()
    camera = turn.apply(-np.asarray(pose.position_camera_km))
    profile = limb_profile(heights, np.full(3, MOON_KM), camera, angles=1440)
    return profile.bias(turn.apply(np.asarray(pose.sun_direction_camera)))[0]


def prediction(rows: list[dict[str, object]]) -> list[dict[str, object]]:
    """Biases of passes as found with the smooth sphere, beside those predicted before there was an image."""
    result = []
    for estimator in ESTIMATORS:
        good = [
            row for row in rows if row["map"] == "smooth" and row["estimator"] == estimator.name and "failed" not in row
        ]
        found = np.array([-row["range_km"] / row["range_km_per_km"] for row in good])  # type: ignore[operator]
        told = np.array([row["told_km"] for row in good], dtype=np.float64)
        result.append(
            {
                "estimator": estimator.name,
                "found_rms_km": float(np.sqrt(np.mean(found**2))),
                "left_rms_km": float(np.sqrt(np.mean((found - told) ** 2))),
                "correlation": float(np.corrcoef(found, told)[0, 1]),
            }
        )
    return result


def table(rows: list[dict[str, object]], maps: dict[str, HeightMap | None]) -> list[dict[str, object]]:
    """Means by map and estimator; errors of range as limb altitudes, km: that of the range over range over radius."""
    result = []
    for name in maps:
        for estimator in ESTIMATORS:
            all_of = [row for row in rows if row["map"] == name and row["estimator"] == estimator.name]
            good = [row for row in all_of if "failed" not in row]
            if not good:
                continue

            def column(key: str, good: list[dict[str, object]] = good) -> Float:
                return np.array([row[key] for row in good], dtype=np.float64)

            scale = column("range_km_per_km")
            error, sigma = column("range_km") / scale, column("range_sigma_km") / scale
            result.append(
                {
                    "map": name,
                    "estimator": estimator.name,
                    "fixes": f"{len(good)} of {len(all_of)}",
                    "radius_bias_km": float(-error.mean()),
                    "radius_rms_km": float(np.sqrt(np.mean(error**2))),
                    "radius_sigma_km": float(np.sqrt(np.mean(sigma**2))),
                    "range_rms_km": float(np.sqrt(np.mean(column("range_km") ** 2))),
                    "range_nees": float(np.mean((error / sigma) ** 2)),
                    "center_rms_px": float(np.sqrt(np.mean(column("center_px") ** 2))),
                    "center_nees_per_dof": float(np.mean(column("nees_center")) / 2.0),
                    "nees_per_dof": float(np.mean(column("nees")) / 3.0),
                    "suspect": float(np.mean(column("suspect"))),
                    "cost_s": float(np.mean([row["cost_s"] for row in all_of])),
                }
            )
    return result


def haze() -> list[dict[str, object]]:
    """Limbs of an Earth of 133 px in haze: how much too high they are, with and without the atmosphere told."""
    camera, rows = orion(330), list[dict[str, object]]()
    middle = 0.5 * (camera.columns - 1)
    view = PinholeView(focal_px=1.0 / IFOV_RAD, center_px=(middle, middle), columns=330, rows=330)
    position, shape = np.array([300.0, -500.0, EARTH_AT_KM]), Ellipsoid(radii_km=np.full(3, EARTH_KM))
    for phase, depth in itertools.product((60.0, 100.0), (0.04, 0.098, 0.22)):
        sun = np.array([math.sin(math.radians(phase)), 0.0, -math.cos(math.radians(phase))])
        air = Haze(scale_height_km=HAZE_KM, vertical_depth=depth)
        light = hazy_sphere(EARTH_KM, air, view, Pose(position, Rotation.identity(), sun))
        recorder = Recorder(gain_e_per_dn=5.0, read_noise_e=25.0)
        pixels = record(light * (3000.0 / light.max()), np.random.default_rng(1), recorder).pixels
        image = Image(pixels=pixels, camera_from_inertial=Rotation.identity(), name="haze")
        told = Atmosphere(scale_height_km=HAZE_KM, optical_depth=depth, sigma_km=HAZE_KM)
        apparent = ApparentGeometry(
            position_inertial_km=1.002 * position,
            inertial_from_body=Rotation.identity(),
            sun_direction_inertial=sun,
        )
        for estimator, known in itertools.product(ESTIMATORS, (None, told)):
            target = Target(name="EARTH", shape=shape, ephemeris=apparent, atmosphere=known)
            fix = estimator.estimate(image, camera, Scene(targets=(target,)))
            row: dict[str, object] = {"phase_deg": phase, "depth": depth, "estimator": estimator.name}
            row |= {"told": known is not None, "predicted_km": told.limb_altitude_km(EARTH_KM)}
            if isinstance(fix, PositionFix):
                line = position / np.linalg.norm(position)
                scale = EARTH_KM / EARTH_AT_KM
                row["too_high_km"] = float((position - fix.position_camera_km) @ line) * scale
                row["sigma_km"] = math.sqrt(line @ fix.covariance_camera_km2 @ line) * scale
            rows.append(row)
    return rows


def main() -> None:
    """Run the parts that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=["passes"])
    parser.add_argument("--sides", type=int, default=16)
    parser.add_argument("--images", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    result: dict[str, object] = {}
    if "passes" in arguments.parts:
        result["passes"] = passes(arguments.sides, arguments.images, arguments.seed)
    if "haze" in arguments.parts:
        result["haze"] = haze()
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
