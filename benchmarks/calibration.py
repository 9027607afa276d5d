"""Accuracy and speed of camera calibration on simulated star campaigns and real frames; prints JSON.

Run with ``OMP_NUM_THREADS=1 python benchmarks/calibration.py [SECTION...]``; sections are ``models`` (every camera
model, 200 trials of 20 images of 50 stars at 0.1 px, from focal lengths 5 % off and no distortion), ``table`` (the five
cameras of the OSIRIS-REx paper, Table 1), ``artemis`` (30 calibrations of 20 images with k2 and k3 that a narrow field
does not support), ``boards`` (a checkerboard through the fisheye of the ODIN paper, Table 2, its corners found in
rendered images), ``speed`` (500 images of 100 stars) and ``real``. Stars are simulated directly in pixels.
``nees_band`` is the 95 % band of the mean over the trials; map errors are rms over the field, modulo a rotation.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike.calibration import (
    CalibrationResult,
    ImageObservations,
    calibrate,
    calibrate_stars,
    identify_first,
)
from giantlike.calibration.boards import board_corners, board_observations
from giantlike.calibration.field_map import map_difference
from giantlike.camera import Camera
from giantlike.camera_models import CameraModel, ScaramuzzaModel
from giantlike.camera_models.registry import model_from_mapping
from giantlike.catalogs import load_catalog
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure
from giantlike.image import Image
from giantlike.stars import StarNavigation

SIGMA_PX, IMAGES, STARS, TRIALS = 0.1, 20, 50, 200
BESIDE = Path(__file__).resolve().parents[2] / "shared" / "data"
STARS_DIR = Path(os.environ.get("GIANTLIKE_TEST_DATA", BESIDE)) / "stars"
CENTER = {"cx_px": 1268.7, "cy_px": 949.6}
NAVCAM_FRAME, MAPCAM_FRAME = (2592, 1944), (1024, 1024)
TRUTHS: Mapping[str, dict[str, float]] = {
    "pinhole": {"fx_px": 3473.3, "fy_px": 3470.1, "skew_px": 2.0, **CENTER},
    "brown": {"fx_px": 3473.3, "fy_px": 3473.4, "k1": -0.539, "k2": 0.388, "k3": -0.214, "p1": 2.55e-4, "p2": 8.64e-4,
              **CENTER},
    "opencv": {"fx_px": 3473.3, "fy_px": 3473.4, "k1": -0.3, "k2": 0.2, "k4": 0.24, "p1": 2.55e-4, "p2": 8.64e-4,
               "s1": 1e-3, "s3": -2e-3, **CENTER},
    "owen": {"fx_px": 3473.3, "fy_px": 3473.4, "e1": 1e-4, "e2": -0.5, "e3": 2e-3, "e4": 0.3, "e5": 1e-3, "e6": -2e-3,
             **CENTER},
    "equidistant": {"fx_px": 900.0, "fy_px": 901.0, "k1": -0.02, "k2": 0.004, **CENTER},
    "equisolid": {"fx_px": 900.0, "fy_px": 901.0, "k1": 0.03, "k2": -0.002, **CENTER},
    "scaramuzza": {"fx_px": 1500.0, "fy_px": 1502.0, "b2": -0.2, "b3": 0.01, "b4": -0.03, **CENTER},
}  # fmt: skip
"""One camera of every type; every parameter named here is estimated."""
TABLE: Mapping[str, tuple[tuple[int, int], dict[str, float], dict[str, float]]] = {
    "PolyCam": (MAPCAM_FRAME, {"cx_px": 511.5, "cy_px": 511.5},
                {"fx_px": 73881.8, "fy_px": 73890.1, "k1": 13.761, "p1": -2.38e-4, "p2": -6.90e-4}),
    "MapCam Pan": (MAPCAM_FRAME, {"cx_px": 511.5, "cy_px": 511.5},
                   {"fx_px": 14737.0, "fy_px": 14736.5, "k1": 0.967, "p1": 3.77e-3, "p2": 1.20e-3,
                    "a1_per_c": -2.22e-5}),
    "MapCam V": (MAPCAM_FRAME, {"cx_px": 511.5, "cy_px": 511.5},
                 {"fx_px": 14719.9, "fy_px": 14720.3, "k1": 0.952, "p1": 3.99e-3, "p2": 1.09e-3, "a1_per_c": 1.06e-5}),
    "NavCam 1": (NAVCAM_FRAME, {},
                 {"fx_px": 3473.3, "fy_px": 3473.4, "cx_px": 1268.7, "cy_px": 949.6, "k1": -0.539, "k2": 0.388,
                  "k3": -0.214, "p1": 2.55e-4, "p2": 8.64e-4, "a1_per_c": 2.37e-5}),
    "NavCam 2": (NAVCAM_FRAME, {},
                 {"fx_px": 3462.6, "fy_px": 3462.6, "cx_px": 1309.7, "cy_px": 968.3, "k1": -0.539, "k2": 0.389,
                  "k3": -0.219, "p1": -6.00e-4, "p2": -1.34e-4, "a1_per_c": 1.97e-5}),
}  # fmt: skip
"""Frame, what the paper did not estimate, and what it did. The paper's y axis points the other way: f_y and p1 have
the other sign here. MapCam V's f_y is taken as -14720.3 (printed -14620.3, 0.7 % off f_x)."""


def star_images(
    model: CameraModel,
    frame: tuple[int, int],
    seed: int,
    *,
    images: int = IMAGES,
    stars: int = STARS,
    temperature_span_c: float = 0.0,
) -> list[ImageObservations]:
    """Stars all over the frame of images with random attitudes."""
    rng = np.random.default_rng(seed)
    observations = []
    for number in range(images):
        temperature = temperature_span_c * (number / max(images - 1, 1) - 0.5)
        there = model.at_temperature(temperature)
        pixels = rng.uniform((-0.5, -0.5), np.array(frame) - 0.5, (stars, 2))
        vectors = there.unproject(pixels)
        seen = np.isfinite(vectors).all(axis=1)
        attitude = Rotation.from_quat(rng.normal(size=4))
        measured = pixels + rng.normal(0.0, SIGMA_PX, pixels.shape)
        known = Rotation.from_rotvec(rng.normal(0.0, 1e-3, 3)) * attitude
        observations.append(
            ImageObservations(
                name=f"image {number}",
                targets=rotate(attitude.inv(), vectors[seen]),
                points_px=measured[seen],
                sigma_px=np.array(SIGMA_PX),
                camera_from_reference=known,
                temperature_c=temperature,
            )
        )
    return observations


def rough(kind: str, truth: Mapping[str, float], frame: tuple[int, int], fixed: Mapping[str, float]) -> CameraModel:
    """Manufacturer's values: focal lengths 5 % off, principal point in the middle, no distortion."""
    start = {"fx_px": 0.95 * truth["fx_px"], "fy_px": 0.95 * truth["fy_px"]}
    middle = {"cx_px": (frame[0] - 1) / 2, "cy_px": (frame[1] - 1) / 2}
    return model_from_mapping({"type": kind} | start | middle | dict(fixed))


def errors_of(fix: CalibrationResult, truth: CameraModel) -> np.ndarray[Any, np.dtype[np.float64]]:
    values = dict(zip(truth.parameter_names, truth.parameters.tolist(), strict=True))
    found = dict(zip(fix.model.parameter_names, fix.model.parameters.tolist(), strict=True))
    return np.array([found[name] - values[name] for name in fix.estimated])


def study(kind: str, trials: int) -> dict[str, Any]:
    values, frame = TRUTHS[kind], NAVCAM_FRAME
    truth = model_from_mapping({"type": kind} | values)
    start = rough(kind, values, frame, {})
    residuals, maps, nees, failures, seconds = [], [], [], [], 0.0
    for trial in range(trials):
        observations = star_images(truth, frame, trial)
        begin = time.process_time()
        fix = calibrate(observations, start, estimate=tuple(values), columns=frame[0], rows=frame[1])
        seconds += time.process_time() - begin
        if isinstance(fix, Failure):
            failures.append(fix.detail)
            continue
        error = errors_of(fix, truth)
        residuals.append(fix.residual_sigma_px)
        nees.append(float(error @ np.linalg.solve(fix.covariance, error)))
        maps.append(map_difference(truth, fix.model, columns=frame[0], rows=frame[1]).rms_px)
    count = len(nees)
    if count == 0:
        return {"failures": len(failures), "first_failure": failures[0]}
    return {
        "parameters": len(values),
        "trials": count,
        "failures": len(failures),
        "residual_sigma_px": round(float(np.mean(residuals)), 5),
        "map_rms_px_mean": round(float(np.mean(maps)), 4),
        "map_rms_px_max": round(float(np.max(maps)), 4),
        "nees": round(float(np.mean(nees)), 3),
        "nees_band": np.round(chi2.ppf([0.025, 0.975], count * len(values)) / count, 3).tolist(),
        "cpu_s_per_calibration": round(seconds / trials, 3),
    }


def models() -> dict[str, Any]:
    results = {}
    for kind in TRUTHS:
        results[kind] = study(kind, TRIALS)
        print(f"{kind}: {results[kind]}", file=sys.stderr, flush=True)  # each takes a minute or more
    return results


def table() -> dict[str, Any]:
    results = {}
    for number, (name, (frame, fixed, values)) in enumerate(TABLE.items()):
        truth = model_from_mapping({"type": "brown"} | fixed | values)
        observations = star_images(truth, frame, 1000 + number, temperature_span_c=40.0)
        start = rough("brown", values, frame, fixed)
        fix = calibrate(observations, start, estimate=tuple(values), columns=frame[0], rows=frame[1]).unwrap()
        error, sigma = errors_of(fix, truth), np.sqrt(np.diag(fix.covariance))
        results[name] = {
            "parameters": {
                one: {"paper": values[one], "found": float(f"{values[one] + e:.7g}"), "sigma": float(f"{s:.2g}")}
                for one, e, s in zip(fix.estimated, error, sigma, strict=True)
            },
            "nees": round(float(error @ np.linalg.solve(fix.covariance, error)), 2),
            "residual_sigma_px": round(fix.residual_sigma_px, 4),
            "map_rms_px": round(map_difference(truth, fix.model, columns=frame[0], rows=frame[1]).rms_px, 4),
        }
    return results


def artemis() -> dict[str, Any]:
    frame = NAVCAM_FRAME
    middle = {"cx_px": 1295.5, "cy_px": 971.5}
    values = {"fx_px": 7312.5, "fy_px": 7312.5, "k1": -0.12, "k2": 0.0, "k3": 0.0, "p1": 2e-4, "p2": -1e-4}
    truth = model_from_mapping({"type": "brown"} | middle | values)
    start = rough("brown", values, frame, middle)
    fixes = [
        calibrate(
            star_images(truth, frame, 2000 + k), start, estimate=tuple(values), columns=frame[0], rows=frame[1]
        ).unwrap()
        for k in range(30)
    ]
    found = np.array([[values[name] for name in fix.estimated] + errors_of(fix, truth) for fix in fixes])
    reach = {one.name: one.sigma_effect_px / one.sigma for one in fixes[0].support}
    maps = [map_difference(truth, fix.model, columns=frame[0], rows=frame[1]) for fix in fixes]
    return {
        "parameters": {
            name: {
                "scatter": float(f"{found[:, k].std(ddof=1):.3g}"),
                "median_sigma": float(f"{np.median([fix.support[k].sigma for fix in fixes]):.3g}"),
                "scatter_alone_at_corner_px": float(f"{found[:, k].std(ddof=1) * reach[name]:.3g}"),
                "verdicts": {str(v): sum(fix.support[k].verdict is v for fix in fixes)
                             for v in {fix.support[k].verdict for fix in fixes}},
            }
            for k, name in enumerate(values)
        },
        "map_error_rms_px_median": round(float(np.median([one.rms_px for one in maps])), 4),
        "map_error_rms_px_max": round(max(one.rms_px for one in maps), 4),
        "map_error_worst_corner_px_median": round(float(np.median([one.max_px for one in maps])), 4),
        "accepted": sum(fix.accepted for fix in fixes),
    }  # fmt: skip


ODIN_FRAME, ODIN_CENTER = (1280, 960), (642.0, 477.0)
ODIN = {"a0_px": 533.039, "a2": -7.764e-4, "a3": 4.340e-7, "a4": -8.639e-10}
BOARD, BOARD_VIEWS, BOARD_TRIALS, BOARD_NOISE_DN = (9, 6), 10, 4, 2.0


def board_images(model: CameraModel, seed: int) -> list[Image]:
    """Pictures of a checkerboard in random places, from a few rays per pixel where the board is."""
    rng = np.random.default_rng(seed)
    corners = board_corners(across=BOARD[0], down=BOARD[1])
    steps = [(np.arange(2 * n) + 0.5) / 2 - 0.5 for n in ODIN_FRAME]
    rays = model.unproject(np.stack(np.meshgrid(*steps), axis=-1))
    images: list[Image] = []
    while len(images) < BOARD_VIEWS:
        angle, azimuth = rng.uniform(0.0, 1.0), rng.uniform(0.0, 2.0 * np.pi)
        away = np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])
        facing = Rotation.from_euler("ZY", [azimuth, angle]) * Rotation.from_euler("Z", -azimuth)
        turn = facing * Rotation.from_rotvec(rng.normal(0.0, 0.3, 3))
        position = rng.uniform(6.0, 9.0) * away - rotate(turn, corners.mean(axis=0))
        at = model.project(rotate(turn, corners) + position)
        if not bool(np.all((at > 25) & (at < np.array(ODIN_FRAME) - 26))):
            continue
        inverse = turn.inv().as_matrix()
        origin, along = -inverse @ position, rays @ inverse.T
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -origin[2] / along[..., 2]
            square = np.floor(origin[:2] + distance[..., None] * along[..., :2] + 1.0)
        margin = (distance > 0) & np.all((square >= -1) & (square <= np.array(BOARD) + 1), axis=-1)
        dark = margin & np.all((square >= 0) & (square <= BOARD), axis=-1) & (square.sum(axis=-1) % 2 == 0)
        light = np.where(dark, 20.0, np.where(margin, 220.0, 110.0))
        pixels = light.reshape(ODIN_FRAME[1], 2, ODIN_FRAME[0], 2).mean(axis=(1, 3))
        noisy = pixels + rng.normal(0.0, BOARD_NOISE_DN, pixels.shape)
        images.append(Image(pixels=noisy, name=f"board {len(images)}"))
    return images


def boards() -> dict[str, Any]:
    truth = ScaramuzzaModel.from_polynomial(**ODIN, cx_px=ODIN_CENTER[0], cy_px=ODIN_CENTER[1])
    start = Camera.from_fov(130.0, *ODIN_FRAME, type_name="scaramuzza").model
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "b2", "b3", "b4")
    found, maps, nees, sigmas, seen, seconds = [], [], [], [], 0, 0.0
    for trial in range(BOARD_TRIALS):
        images = board_images(truth, 4000 + trial)
        begin = time.process_time()
        observations, failed = board_observations(images, start, across=BOARD[0], down=BOARD[1])
        fix = calibrate(observations, start, estimate=names, columns=ODIN_FRAME[0], rows=ODIN_FRAME[1]).unwrap()
        seconds += time.process_time() - begin
        error = errors_of(fix, truth)
        nees.append(float(error @ np.linalg.solve(fix.covariance, error)) / len(names))
        maps.append(map_difference(truth, fix.model, columns=ODIN_FRAME[0], rows=ODIN_FRAME[1]).rms_px)
        sigmas.append(fix.residual_sigma_px)
        seen += len(images) - len(failed)
        values = dict(zip(fix.model.parameter_names, fix.model.parameters.tolist(), strict=True))
        f = (values["fx_px"] + values["fy_px"]) / 2
        found.append([f, values["b2"] / f, values["b3"] / f**2, values["b4"] / f**3])
    scatter = np.array(found)
    return {
        "polynomial": {
            name: {"paper": value, "mean": float(f"{scatter[:, k].mean():.5g}"),
                   "scatter": float(f"{scatter[:, k].std(ddof=1):.2g}")}
            for k, (name, value) in enumerate(ODIN.items())
        },
        "boards_found": f"{seen} of {BOARD_VIEWS * BOARD_TRIALS}",
        "residual_sigma_px": round(float(np.mean(sigmas)), 4),
        "map_rms_px_mean": round(float(np.mean(maps)), 4),
        "map_rms_px_max": round(float(np.max(maps)), 4),
        "nees_per_parameter": round(float(np.mean(nees)), 2),
        "cpu_s_per_calibration": round(seconds / BOARD_TRIALS, 2),
    }  # fmt: skip


def speed() -> dict[str, Any]:
    values = TRUTHS["brown"]
    truth = model_from_mapping({"type": "brown"} | values)
    start = rough("brown", values, NAVCAM_FRAME, {})
    result = {}
    for name, estimate, span in (
        ("one_temperature", tuple(values), 0.0),
        ("500_temperatures", (*values, "a1_per_c"), 40.0),
    ):
        observations = star_images(truth, NAVCAM_FRAME, 3000, images=500, stars=100, temperature_span_c=span)
        begin = time.process_time()
        fix = calibrate(observations, start, estimate=estimate, columns=NAVCAM_FRAME[0], rows=NAVCAM_FRAME[1]).unwrap()
        result[name] = {"cpu_s": round(time.process_time() - begin, 2), "steps": fix.steps}
    return result


def real() -> dict[str, Any]:
    """Frames of one camera, from nothing but image size and a rough field of view."""
    sets = {
        "tetra3": (sorted(STARS_DIR.glob("tetra3/*.tiff")), 11.4),
        "cedar, 1280 x 960": (
            [STARS_DIR / "cedar" / f"{name}.jpg" for name in ("jan1_g90_e100ms", "test_5mp_g100_e50ms")],
            11.0,
        ),
    }
    names: dict[str, Sequence[str]] = {
        "no distortion": ("fx_px", "fy_px"),
        "brown": ("fx_px", "fy_px", "k1", "p1", "p2"),
    }
    catalog, results = load_catalog("default"), {}
    for name, (files, fov) in sets.items():
        images = [Image.open(file) for file in files]
        camera = Camera.from_fov(fov, images[0].columns, images[0].rows)
        navigation = StarNavigation(camera, catalog)
        stars = [identify_first(image, camera, navigation, scale_error=0.1).unwrap() for image in images]
        found = {}
        for label, estimate in names.items():
            for min_snr in (20.0, 0.0):
                outcome = calibrate_stars(stars, camera, estimate=estimate, min_snr=min_snr).unwrap()
                fix = outcome.result
                found[f"{label}, SNR >= {min_snr:g}"] = {
                    "rms_px": round(fix.rms_px, 4), "stars": fix.n_used, "rejected": fix.n_rejected,
                    "rounds": outcome.rounds, "map_sigma_max_px": round(float(fix.map_sigma_px.max()), 3),
                }  # fmt: skip
        results[name] = found
    return results


def main(sections: Sequence[str]) -> None:
    """Run the sections named, all without a name."""
    every: dict[str, Callable[[], dict[str, Any]]] = {
        "table": table, "artemis": artemis, "boards": boards, "speed": speed, "real": real, "models": models,
    }  # fmt: skip
    for name in sections or every:
        print(json.dumps({name: every[name]()}, indent=1), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
