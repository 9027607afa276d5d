"""Speed and accuracy of the camera models, beside OpenCV; prints JSON.

Run with ``OMP_NUM_THREADS=1 python benchmarks/camera_models.py``. One million pixels over a frame of 2592 x 1944;
``cpu_ms`` is processor time on one thread, the least of a few runs. ``round_trip_px`` is the largest error of a pixel
that was turned into a direction and back; ``opencv_*`` are the same for OpenCV, where it has the model, with its usual
settings; ``difference_px`` is the largest between its pixels and ours.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from giantlike.camera_models import (
    BrownModel,
    CameraModel,
    EquidistantModel,
    EquisolidModel,
    GridCorrectedModel,
    OpenCVModel,
    OwenModel,
    PinholeModel,
    ScaramuzzaModel,
)
from giantlike.core.arrays import Float

COLUMNS, ROWS, COUNT, RUNS = 2592, 1944, 1_000_000, 3
AFFINE = {"fx_px": 3473.3, "fy_px": 3473.4, "cx_px": 1268.7, "cy_px": 949.6}
WIDE = {"fx_px": 700.0, "fy_px": 700.0, "cx_px": 1295.5, "cy_px": 971.5}
BROWN = BrownModel(**AFFINE, k1=-0.539, k2=0.388, k3=-0.214, p1=-2.55e-4, p2=8.64e-4)  # NavCam 1 of OSIRIS-REx


def models() -> dict[str, CameraModel]:
    """One model of each type, as strong as such lenses are."""
    waves = np.random.default_rng(1).normal(0.0, 1.0, (2, 14, 17))
    return {
        "pinhole": PinholeModel(**AFFINE),
        "brown": BROWN,
        "opencv": OpenCVModel(**AFFINE, k1=0.31, k2=-0.11, k3=0.02, k4=0.65, k5=0.07, k6=0.01, p1=8e-4, s1=1e-3),
        "owen": OwenModel(**AFFINE, e1=1e-3, e2=-0.08, e3=-2e-3, e4=0.05, e5=2e-3, e6=-3e-3),
        "equidistant": EquidistantModel(**WIDE, k1=-0.02, k2=3e-3, k3=-5e-4, k4=2e-5),
        "equisolid": EquisolidModel(**(WIDE | {"fx_px": 900.0, "fy_px": 900.0}), k1=0.01, k2=-2e-3),
        "scaramuzza": ScaramuzzaModel.from_polynomial(
            a0_px=533.039, a2=-7.764e-4, a3=4.340e-7, a4=-8.639e-10, cx_px=1295.5, cy_px=971.5
        ),
        "grid": GridCorrectedModel(
            base=BROWN, corner_px=np.array([-0.5, -0.5]), step_px=200.0, dx_px=waves[0], dy_px=waves[1]
        ),
    }


def cpu_ms(function: Callable[[], Any]) -> float:
    """Least processor time of a few runs, ms."""
    times = []
    for _ in range(RUNS):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return round(1e3 * min(times), 1)


def opencv(model: CameraModel, directions: Float, pixels: Float) -> dict[str, float]:
    """Speed and round trip of OpenCV with the same parameters; empty where it has no such model."""
    known = dict(zip(model.parameter_names, model.parameters.tolist(), strict=True))
    matrix = np.array([[known["fx_px"], 0, known["cx_px"]], [0, known["fy_px"], known["cy_px"]], [0, 0, 1]])
    zero = np.zeros(3)
    if model.type_name == "equidistant":
        lens = np.array([known[name] for name in ("k1", "k2", "k3", "k4")])
        front = directions[:, 2] > 0.05
        points, seen = directions[front][:, None], pixels[front][:, None]
        ahead = cpu_ms(lambda: cv2.fisheye.projectPoints(points, zero, zero, matrix, lens))
        back = cpu_ms(lambda: cv2.fisheye.undistortPoints(seen, matrix, lens))
        theirs = cv2.fisheye.projectPoints(points, zero, zero, matrix, lens)[0][:, 0]
        plane = cv2.fisheye.undistortPoints(seen, matrix, lens)[:, 0]
    elif model.type_name in ("brown", "opencv"):
        order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
        lens = np.array([known.get(name, 0.0) for name in order])
        points, seen = directions, pixels[:, None]
        ahead = cpu_ms(lambda: cv2.projectPoints(points, zero, zero, matrix, lens))
        back = cpu_ms(lambda: cv2.undistortPoints(seen, matrix, lens))
        theirs = cv2.projectPoints(points, zero, zero, matrix, lens)[0][:, 0]
        plane = cv2.undistortPoints(seen, matrix, lens)[:, 0]
    else:
        return {}
    returned = model.project(np.concatenate([plane, np.ones((len(plane), 1))], axis=1))
    return {
        "opencv_project_cpu_ms": ahead * COUNT / len(points),
        "opencv_unproject_cpu_ms": back * COUNT / len(points),
        "opencv_round_trip_px": float(np.nanmax(np.abs(returned - seen[:, 0]))),
        "difference_px": float(np.abs(theirs - model.project(points).reshape(theirs.shape)).max()),
    }


def measure(model: CameraModel) -> dict[str, float]:
    """Speed, round trip and comparison of one model."""
    pixels = np.random.default_rng(0).uniform([-0.5, -0.5], [COLUMNS - 0.5, ROWS - 0.5], (COUNT, 2))
    seen = pixels[np.isfinite(model.unproject(pixels)).all(axis=1)]
    pixels = np.resize(seen, (COUNT, 2))
    directions = model.unproject(pixels)
    result = {
        "project_cpu_ms": cpu_ms(lambda: model.project(directions)),
        "unproject_cpu_ms": cpu_ms(lambda: model.unproject(pixels)),
        "round_trip_px": float(np.abs(model.project(directions) - pixels).max()),
        "widest_deg": float(np.degrees(np.arccos(directions[:, 2].min()))),
    }
    beside = opencv(model, directions, pixels)
    if beside:
        beside["project_ratio_to_opencv"] = round(result["project_cpu_ms"] / beside["opencv_project_cpu_ms"], 3)
        beside["unproject_ratio_to_opencv"] = round(result["unproject_cpu_ms"] / beside["opencv_unproject_cpu_ms"], 3)
    return result | beside


if __name__ == "__main__":
    cv2.setNumThreads(1)
    print(json.dumps({name: measure(model) for name, model in models().items()}, indent=1))
