"""Metadata of DSCOVR EPIC pictures, the JSON of ``epic.gsfc.nasa.gov/api``, as a geometry table.

``dscovr_j2000_position``, ``lunar_j2000_position`` and ``sun_j2000_position`` are from the center of the Earth.
Pictures of level 1b (``epic_1b_...``, natural and enhanced) were resampled with the Earth in the middle and north up,
which gives their attitude; ``attitude_quaternions`` (scalar last, of the spacecraft, whose +x axis points to the Earth)
is of the exposures before that, and is not used. ``date`` is five minutes before ``identifier``, at which the Earth has
turned to ``centroid_coordinates``, the point below the camera: within 0.2 degrees in five records from 2015 to 2026.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.reading import check, reads
from giantlike.core.arrays import Float, unit
from giantlike.core.frames import direction_from_radec, rotate
from giantlike.core.time import time_from_utc
from giantlike.core.units import RAD_PER_DEG, SECONDS_PER_DAY, SPEED_OF_LIGHT_KM_S
from giantlike.io.geometry_table import GeometryRow, GeometryTable

if TYPE_CHECKING:
    from astropy.time import Time

_SAME_POINT_DEG = 1.0  # between the point below the camera as stated and by positions and rotation of the Earth


@reads("EPIC metadata")
def read_epic(path: str | Path, images: Sequence[Path], targets: Mapping[str, str]) -> GeometryTable:
    """Read the geometry of EPIC pictures. Universal time is taken as UTC: 0.004 degrees of rotation at most."""
    path = Path(path)
    records = json.loads(path.read_text(encoding="utf-8"))
    check(isinstance(records, list) and all(isinstance(one, dict) for one in records), "needed a list of records")
    rows = [
        row
        for record in records
        for image in images
        if str(record["identifier"]) in image.stem
        for row in _rows(record, image.name, targets)
    ]
    return GeometryTable(path, tuple(rows))


def _rows(record: Mapping[str, Any], file: str, targets: Mapping[str, str]) -> list[GeometryRow]:
    name = str(record["identifier"])
    epoch = time_from_utc(datetime.strptime(name, "%Y%m%d%H%M%S").isoformat())
    camera_km, moon_km, sun_km = (_vector(record, f"{body}_j2000_position") for body in ("dscovr", "lunar", "sun"))
    earth = _body_from_inertial(epoch, float(np.linalg.norm(camera_km)))
    _check_point(record, rotate(earth, unit(camera_km)))
    sight, pole = -unit(camera_km), earth.as_matrix()[2]
    down = -unit(pole - (pole @ sight) * sight)
    attitude = Rotation.from_matrix(np.stack([np.cross(down, sight), down, sight]))
    places = {"EARTH": (np.zeros(3), earth), "MOON": (moon_km, None)}
    return [
        GeometryRow(
            file=file,
            epoch=epoch,
            camera_from_inertial=attitude,
            target=target,
            target_position_inertial_km=places[body][0] - camera_km,
            body_from_inertial=places[body][1],
            sun_direction_inertial=unit(sun_km - places[body][0]),
        )
        for body, target in targets.items()
    ]


def _vector(record: Mapping[str, Any], key: str) -> Float:
    vector = np.array(_numbers(record, key, *"xyz"))
    check(bool(vector.any()), f"{key} is no position")
    return vector


def _numbers(record: Mapping[str, Any], key: str, *names: str) -> list[float]:
    table = record[key]
    check(isinstance(table, dict), f"{key} is no table")
    numbers = [table[name] for name in names]
    numeric = all(isinstance(number, int | float) and math.isfinite(number) for number in numbers)
    check(numeric, f"{key}: needed numbers, got {numbers}")
    return [float(number) for number in numbers]


def _body_from_inertial(epoch: Time, range_km: float) -> Rotation:
    """Rotation of the Earth when the light left it."""
    import erfa

    utc, tt, earlier = epoch.utc, epoch.tt, range_km / SPEED_OF_LIGHT_KM_S / SECONDS_PER_DAY
    dates = tt.jd1, tt.jd2 - earlier, utc.jd1, utc.jd2 - earlier
    return Rotation.from_matrix(erfa.c2t06a(*dates, 0.0, 0.0))


def _check_point(record: Mapping[str, Any], below: Float) -> None:
    point = direction_from_radec(*_numbers(record, "centroid_coordinates", "lon", "lat"))
    apart_deg = math.acos(min(1.0, float(point @ below))) / RAD_PER_DEG
    check(
        apart_deg <= _SAME_POINT_DEG,
        f"{record['identifier']}: centroid_coordinates are {apart_deg:.1f} degrees from the point below the camera by "
        "dscovr_j2000_position",
    )
