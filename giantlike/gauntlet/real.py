"""Real images that do not show the target: any fix that is ok there is an undetected failure.

The folder holds image files of any readable format, in folders below it. Each gets a fictitious target, with random
size, position and illumination direction, and a camera of which only the scale is known.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import require
from giantlike.core.detector import Detector
from giantlike.core.errors import OpNavError
from giantlike.ephemeris import ApparentGeometry
from giantlike.gauntlet.bodies import ROCKS, ellipsoid, rock
from giantlike.gauntlet.plan import FOCAL_PX, log_uniform, sun_at
from giantlike.gauntlet.rule import Verdict
from giantlike.gauntlet.trial import TrialRow, outcome_of
from giantlike.image import Image
from giantlike.relative import ESTIMATORS
from giantlike.scene import Scene, Target
from giantlike.shapes import Shape

REAL_KIND = "real_negative"  # name of the kind in tables
SUFFIXES = (".fits", ".fit", ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".img", ".lbl")
"""Ends of the names of image files."""
_DIAMETER_PX = (30.0, 150.0)
"""Sizes of the targets, px. Bodies on real images are larger or smaller as a rule; one that is alike is a twin."""


def image_files(folder: Path) -> list[Path]:
    """List the image files of a folder and the folders below it, in the order of their names."""
    files = sorted(path for path in folder.rglob("*") if _is_image(path) and path.is_file())
    require(bool(files), f"{folder}: no image file there, of {', '.join(SUFFIXES)}")
    return files


def _is_image(path: Path) -> bool:
    """True for the usual ends of names, and for a version number, as VICAR files have."""
    return path.suffix.lower() in SUFFIXES or path.suffix[1:].isdecimal()


def readable(path: Path) -> Image | None:
    """Read an image file; None where it holds no image that can be read."""
    try:
        image = Image.open(path)
    except OpNavError:
        return None
    return image if min(image.rows, image.columns) > 2 * _DIAMETER_PX[0] else None


def negative(image: Image, seed: int) -> tuple[Image, Camera, Scene]:
    """Say that a body is in an image which does not show it."""
    rng = np.random.default_rng([seed, zlib.crc32(image.name.encode())])
    camera = Camera(
        name="real",
        columns=image.columns,
        rows=image.rows,
        model=PinholeModel(
            fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=0.5 * (image.columns - 1), cy_px=0.5 * (image.rows - 1)
        ),
        detector=Detector(estimated=True),
    )
    shape: Shape = rock(int(rng.integers(ROCKS)))[1]
    if rng.uniform() < 0.5:
        shape = ellipsoid(10.0 * np.array([1.0, rng.uniform(0.85, 1.0), rng.uniform(0.8, 1.0)]))[1]
    most = min(_DIAMETER_PX[1], 0.4 * min(image.rows, image.columns))
    diameter = log_uniform(rng, _DIAMETER_PX[0], max(most, 1.01 * _DIAMETER_PX[0]))
    size = np.array([image.columns - 1, image.rows - 1], dtype=float)
    place = rng.uniform(0.6 * diameter, size - 0.6 * diameter)
    sight = camera.model.unproject(place)
    apparent = ApparentGeometry(
        position_inertial_km=2.0 * shape.mean_radius_km * FOCAL_PX / diameter * sight,
        inertial_from_body=Rotation.random(rng=rng),
        sun_direction_inertial=sun_at(rng, sight, math.radians(rng.uniform(5.0, 120.0))),
    )
    plain = replace(image, observer=None, epoch=None, camera_name="").with_attitude(Rotation.identity())
    return plain, camera, Scene(targets=(Target(name="TARGET", shape=shape, ephemeris=apparent),))


def real_rows(path: Path, index: int, seed: int, estimators: Sequence[str]) -> tuple[Image, list[TrialRow]] | None:
    """Run the estimators on a real image that does not show the target."""
    image = readable(path)
    if image is None:
        return None
    told, camera, scene = negative(image, seed)
    names = [name for name in ESTIMATORS if name != "surface_features" and (not estimators or name in estimators)]
    rows = []
    for name in names:
        _, answer = outcome_of(partial(ESTIMATORS[name]().estimate, told, camera, scene))
        raised = answer.status == "raised" or answer.reason == "internal_error"
        verdict = Verdict.SILENT_WRONG if answer.status == "ok" else Verdict.MISLEADING if raised else Verdict.HONEST
        rows.append(
            TrialRow(
                image=index,
                kind=REAL_KIND,
                estimator=name,
                verdict=str(verdict),
                status=answer.status,
                reason=answer.reason or None,
                solvable=0,
                cpu_s=answer.cpu_s,
                detail=f"{path.name}: {answer.detail}".rstrip(": "),
            )
        )
    return image, rows
