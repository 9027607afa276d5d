"""Control networks: CPU time and memory of large ones; consistency (NEES) with outliers, with and without rejection.

``python benchmarks/network.py [--scenes N]`` prints one JSON object. Scenes are drawn here, with numpy alone.
``--images N`` instead finds landmarks in images of ``network_truth.py`` of N rocks, and writes a row for each to
``results/network_images.csv`` (``--first``: number of the first one; rows are added). ``--lit N`` counts the visible
landmarks of N rocks of 400 px that are found where each image shows the rock turned by 40 degrees more.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.network_truth import Sequence, Told, sequence
from giantlike.calibration.options import Loss
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.frames import skew
from giantlike.core.outcomes import Failure
from giantlike.network import (
    FoundTracks,
    NetworkFix,
    NetworkOptions,
    Photo,
    TrackOptions,
    Tracks,
    adjust,
    find_tracks,
)
from giantlike.network.landmarks import catalog_of, measure_landmarks
from giantlike.relative.inputs import EstimatorInputs, gather
from giantlike.relative.landmarks.visibility import viewer_for
from giantlike.shapes.landmarks import LandmarkCatalog

CAMERA = PinholeModel(fx_px=4000.0, fy_px=4000.0, cx_px=511.5, cy_px=511.5)
SIGMA_PX = 0.5
PIXEL_KM = 20.0 / 4000.0
SIGMAS = np.array([2e-4] * 3 + [0.02] * 3)  # rad, km: of a priori poses
REJECT_NONE = NetworkOptions(loss=Loss.LINEAR, outlier_sigmas=math.inf)


def scene(
    seed: int, *, images: int, points: int, measures: int, outliers: float = 0.0
) -> tuple[list[Photo], Tracks, Float, Float]:
    """Points on a sphere of 1 km, cameras all around at 20 km, each measure of a visible point.

    Returns photos, tracks, points (p, 3), and errors (m, 6) of the a priori poses: true minus a priori.
    """
    rng = np.random.default_rng(seed)
    truth = rng.normal(size=(points, 3))
    truth /= np.linalg.norm(truth, axis=1)[:, None]
    angle = 2.0 * np.pi * np.arange(images) / images + 0.3
    positions = 20.0 * np.stack([np.cos(angle), np.sin(angle), 0.4 * np.sin(3.0 * angle)], axis=1)
    seen = [(i, k) for k in range(images) for i in np.flatnonzero(truth @ positions[k] > 6.0)]
    chosen = [seen[j] for j in rng.choice(len(seen), min(measures, len(seen)), replace=False)]
    point, photo = np.array(chosen).T
    photos, pixels = [], np.empty((len(chosen), 2))
    errors = rng.normal(size=(images, 6)) * SIGMAS
    for k in range(images):
        z = -positions[k] / np.linalg.norm(positions[k])
        x = np.cross([0.0, 0.0, 1.0], z)
        x /= np.linalg.norm(x)
        attitude = Rotation.from_matrix(np.stack([x, np.cross(z, x), z]))
        mine = photo == k
        look = (truth[point[mine]] - positions[k]) @ attitude.as_matrix().T
        pixels[mine] = 4000.0 * look[:, :2] / look[:, 2:] + 511.5
        photos.append(
            Photo(
                name=str(k),
                model=CAMERA,
                camera_from_inertial=Rotation.from_rotvec(-errors[k, :3]) * attitude,
                position_km=positions[k] - errors[k, 3:],
                covariance_pose=np.diag(SIGMAS**2),
            )
        )
    pixels += rng.normal(0.0, SIGMA_PX, pixels.shape)
    bad = rng.random(len(pixels)) < outliers
    turn = rng.uniform(0.0, 2.0 * np.pi, len(pixels))
    length = np.where(bad, rng.uniform(0.0, 30.0, len(pixels)), 0.0)
    tracks = Tracks(
        names=tuple(str(number) for number in range(points)),
        point=point,
        photo=photo,
        points_px=pixels + length[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1),
        sigma_px=np.array(SIGMA_PX),
    )
    return photos, tracks, truth, errors


def nees(seed: int, options: NetworkOptions | None = None, outliers: float = 0.03) -> tuple[float, float] | None:
    """NEES per degree of freedom of checked points and of poses of one scene; None where the fit fails."""
    photos, tracks, truth, errors = scene(seed, images=12, points=80, measures=400, outliers=outliers)
    fix = adjust(photos, tracks, options=options)
    if not isinstance(fix, NetworkFix):
        return None
    good = fix.point_status == "checked"
    error = (fix.points_km - truth)[good]
    of_points = np.einsum("pi,pij,pj->p", error, np.linalg.inv(fix.covariance_points_km2[good]), error)
    total = 0.0
    for k, photo in enumerate(fix.photos):
        attitude = Rotation.from_rotvec(errors[k, :3]) * photos[k].camera_from_inertial
        turn = (attitude * photo.camera_from_inertial.inv()).as_rotvec()
        pose = np.concatenate([turn, photos[k].position_km + errors[k, 3:] - photo.position_km])
        total += float(pose @ np.linalg.solve(fix.covariance_poses[k], pose))
    return float(of_points.mean()) / 3.0, total / (6.0 * len(photos))


def consistency(scenes: int) -> dict[str, Any]:
    """Mean NEES of many scenes, with and without rejection."""
    found = {}
    for name, options in (("rejection", None), ("no rejection", REJECT_NONE)):
        values = [each for each in (nees(seed, options) for seed in range(scenes)) if each is not None]
        points, poses = np.mean(values, axis=0)
        found[name] = {"scenes": len(values), "points": round(float(points), 3), "poses": round(float(poses), 3)}
    return found


def timing(measures: int) -> dict[str, Any]:
    """CPU time of an adjustment with the covariances of 500 images and 2,000 points."""
    photos, tracks, *_ = scene(1, images=500, points=2000, measures=measures)
    start = time.process_time()
    fix = adjust(photos, tracks)
    seconds = time.process_time() - start
    assert isinstance(fix, NetworkFix), fix
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return {"measures": len(tracks.point), "cpu_s": round(seconds, 1), "steps": fix.steps, "peak_gb": round(memory, 2)}


TOLD = Told(relief=0.004, albedo=0.1, law="lommel_seeliger", timetag_s=0.1, focal=1e-4)


def lit_landmarks(seed: int) -> dict[str, Any]:
    """Visible landmarks of a rock of 400 px that are found within 1 px; it turns by 40 degrees between its images."""
    rock = sequence(seed, told=TOLD, images=9, diameter_px=400.0)
    catalog, options = catalog_of("ROCK", rock.scene.targets[0].shape), TrackOptions()
    assert isinstance(catalog, LandmarkCatalog)
    offered = within = 0
    for k, image in enumerate(rock.images):
        inputs = gather(image, rock.camera, rock.scene, None, estimator="network", options=options)
        found = measure_landmarks(image, rock.camera, rock.scene)
        assert isinstance(inputs, EstimatorInputs), inputs
        seen = viewer_for(catalog, inputs.geometry.target.shape).find_visible(
            inputs.geometry.seen_body(), inputs.focal_plane(),
            sun_direction_camera=inputs.geometry.sun_direction_camera, options=options.visibility,
        )  # fmt: skip
        offered += len(seen.numbers)
        if not isinstance(found, Failure):
            truth = rock.true_point(np.array([catalog.landmarks[number].point_body_km for number in found.numbers]))
            within += int((_off_px(rock, k, image.et or 0.0, truth, found.points_px) < 1.0).sum())
    return image_scene(seed, rock) | {"lit_within_1_px": within / offered}


def _off_px(rock: Sequence, k: int, et: float, truth: Float, points_px: Float) -> Float:
    """Errors (n,) of measures in an image."""
    look = rock.attitudes[k].apply(rock.rotation.inertial_from_body(et).apply(truth) - rock.positions_km[k])
    return np.asarray(np.linalg.norm(points_px - rock.view.project(look), axis=1))


def image_scene(seed: int, rock: Sequence | None = None) -> dict[str, float]:
    """Landmarks of a rock in 16 images over 0.6 revolutions, under a wrong law, with relief and albedo not told."""
    if rock is None:
        rock = sequence(seed, told=TOLD, images=16, diameter_px=150.0, revolutions=0.6)
    start = time.process_time()
    found = find_tracks(rock.images, rock.camera, rock.scene)
    assert isinstance(found, FoundTracks), found
    fix = adjust(found.photos, found.tracks)
    seconds = time.process_time() - start
    assert isinstance(fix, NetworkFix), fix
    tracks, names = found.tracks, [image.name for image in rock.images]
    truth = rock.true_point(np.asarray(tracks.points_km))
    known = [names.index(photo.name) for photo in found.photos]
    off, poses = np.empty(len(tracks.point)), []
    for number, (k, photo) in enumerate(zip(known, fix.photos, strict=True)):
        mine = tracks.photo == number
        off[mine] = _off_px(rock, k, photo.et, truth[tracks.point[mine]], tracks.points_px[mine])
        turn = (rock.attitudes[k] * photo.camera_from_inertial.inv()).as_rotvec()
        error = np.concatenate([turn, rock.positions_km[k] - photo.position_km])
        poses.append(float(error @ np.linalg.solve(fix.covariance_poses[number], error)) / 6.0)
    sound = np.asarray(np.isfinite(fix.points_km).all(axis=1))
    error = np.where(sound[:, None], fix.points_km - truth, 0.0)
    squares = np.einsum("pi,pij,pj->p", error[sound], np.linalg.inv(fix.covariance_points_km2[sound]), error[sound])
    sigmas, checked = np.sqrt(squares), np.asarray(fix.point_status == "checked")[sound]
    views = np.bincount(tracks.point, fix.used, len(tracks.names))[sound]
    design = np.concatenate([np.tile(np.eye(3), (len(truth), 1, 1)), -skew(truth), truth[:, :, None]], axis=2)[
        sound
    ]  # shift, rotation, scale
    left = error[sound].ravel()
    left = left - design.reshape(-1, 7) @ np.linalg.lstsq(design.reshape(-1, 7), left, rcond=None)[0]
    px = rock.camera.model.focal_length_px / float(np.linalg.norm(rock.positions_km[0]))
    aligned = np.linalg.norm(left.reshape(-1, 3), axis=1) * px
    return {
        "seed": seed,
        "images": len(found.photos),
        "landmarks": len(tracks.names),
        "measures": len(off),
        "within_1_px": float(np.mean(off < 1.0)),
        "rejected": float(np.mean(~fix.used)),
        "wrong_survive": float(np.mean(off[fix.used] > 1.0)),
        "median_point_error_px": float(np.median(aligned)),
        "of_6_views_px": float(np.median(aligned[np.flatnonzero(views >= 6)])) if np.any(views >= 6) else math.nan,
        "nees_points": float(np.mean(squares[checked])) / 3.0,
        "nees_poses": float(np.mean(poses)),
        "worst_checked_sigma": float(sigmas[checked].max()),
        "checked_of_within_3_sigma": float(np.mean(checked[sigmas < 3.0])),
        "floor_px": found.floor_px,
        "sigma_points_km": found.sigma_points_km,
        "cpu_s": seconds,
    }


def image_scenes(first: int, count: int) -> None:
    """Add rows of scenes to the table of results."""
    path = Path(__file__).parent / "results" / "network_images.csv"
    for seed in range(first, first + count):
        row = image_scene(seed)
        new = not path.exists()
        with path.open("a") as file:
            file.write((",".join(row) + "\n") if new else "")
            file.write(",".join(f"{value:.4g}" for value in row.values()) + "\n")


def main() -> None:
    """Print all figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--images", type=int, default=0)
    parser.add_argument("--lit", type=int, default=0)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    scenes = options.scenes
    if options.images:
        image_scenes(options.first, options.images)
        return
    if options.lit:
        print(json.dumps([lit_landmarks(seed) for seed in range(options.first, options.first + options.lit)], indent=1))
        return
    adjust(*scene(0, images=4, points=30, measures=100)[:2])  # loops are compiled
    print(json.dumps({"timing": [timing(count) for count in (10_000, 50_000)], "nees": consistency(scenes)}, indent=1))


if __name__ == "__main__":
    main()
