"""Records of the EPIC API: they agree with themselves, and lead to pictures with north up."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.core.errors import DataError
from giantlike.core.frames import rotate
from giantlike.io.epic_metadata import read_epic

# Answers of epic.gsfc.nasa.gov/api/natural (NASA, public domain), the keys that are used
RECORDS: list[dict[str, Any]] = [
    {
        "identifier": "20260520001752",
        "centroid_coordinates": {"lat": 19.138184, "lon": 164.311523},
        "dscovr_j2000_position": {"x": 971331.881252, "y": 1005119.436159, "z": 481733.225691},
        "lunar_j2000_position": {"x": -85179.896155, "y": 313384.899148, "z": 162751.764668},
        "sun_j2000_position": {"x": 78733741.209631, "y": 118609738.979571, "z": 51414974.599961},
    },
    {
        "identifier": "20221221001752",
        "centroid_coordinates": {"lat": -25.664062, "lon": 163.696289},
        "dscovr_j2000_position": {"x": -297071.683483, "y": -1316902.874094, "z": -651446.5875},
        "lunar_j2000_position": {"x": -208322.388447, "y": -275380.726412, "z": -127687.55554},
        "sun_j2000_position": {"x": -3154516.918034, "y": -135009345.027998, "z": -58525488.599999},
    },
]


def written(folder: Path, records: Any) -> Path:
    (folder / "epic.json").write_text(json.dumps(records))
    return folder / "epic.json"


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: record["identifier"])
def test_the_earth_is_in_the_middle_with_north_up_and_the_stated_point_in_front(
    tmp_path: Path, record: dict[str, Any]
) -> None:
    image = Path(f"epic_1b_{record['identifier']}.png")
    table = read_epic(written(tmp_path, RECORDS), [image], {"EARTH": "Earth", "MOON": "MOON"})
    earth, moon = table.rows
    assert (earth.file, earth.target, moon.target) == (image.name, "Earth", "MOON")
    attitude, turn, position = (
        earth.camera_from_inertial, earth.body_from_inertial, earth.target_position_inertial_km
    )  # fmt: skip
    assert attitude is not None
    assert turn is not None
    assert position is not None
    camera_km = np.array([*record["dscovr_j2000_position"].values()], dtype=float)
    range_km = float(np.linalg.norm(camera_km))
    assert_allclose(rotate(attitude, position), [0.0, 0.0, range_km], rtol=0, atol=1e-6)
    pole = rotate(attitude, rotate(turn.inv(), np.array([0.0, 0.0, 1.0])))
    assert_allclose(pole[0], 0.0, rtol=0, atol=1e-12)
    assert pole[1] < -0.8  # up: 20 and 26 degrees from the plane of the picture
    below = rotate(turn, camera_km / range_km)
    stated = record["centroid_coordinates"]
    assert np.degrees(np.arcsin(below[2])) == pytest.approx(stated["lat"], abs=0.15)
    assert np.degrees(np.arctan2(below[1], below[0])) == pytest.approx(stated["lon"], abs=0.15)
    assert moon.target_position_inertial_km is not None
    moon_km = np.array(list(record["lunar_j2000_position"].values()))
    assert_allclose(moon.target_position_inertial_km, moon_km - camera_km, rtol=0, atol=1e-6)
    assert moon.sun_direction_inertial is not None
    sun_km = np.array(list(record["sun_j2000_position"].values())) - moon_km
    assert_allclose(moon.sun_direction_inertial, sun_km / np.linalg.norm(sun_km), rtol=0, atol=1e-12)


def test_east_is_to_the_right(tmp_path: Path) -> None:
    (row,) = read_epic(written(tmp_path, RECORDS), [Path("20260520001752.jpg")], {"EARTH": "EARTH"}).rows
    assert row.camera_from_inertial is not None
    assert row.body_from_inertial is not None
    longitude = np.radians(164.3)
    east = rotate(row.body_from_inertial.inv(), np.array([-np.sin(longitude), np.cos(longitude), 0.0]))
    assert rotate(row.camera_from_inertial, east)[0] > 0.99


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda record: record["centroid_coordinates"].update(lon=150.0), "degrees from the point below the camera"),
        (lambda record: record["dscovr_j2000_position"].update(x=None), "EPIC metadata"),
        (lambda record: record.pop("sun_j2000_position"), "EPIC metadata"),
        (lambda record: record.update(identifier="2026"), "EPIC metadata"),
    ],
)
def test_a_record_that_is_damaged_or_contradicts_itself_is_refused(tmp_path: Path, change: Any, message: str) -> None:
    records = copy.deepcopy(RECORDS)
    change(records[0])
    images = [Path("epic_1b_20260520001752.png")]
    with pytest.raises(DataError, match=message):
        read_epic(written(tmp_path, records), images, {"EARTH": "EARTH"})
    with pytest.raises(DataError, match="list of records"):
        read_epic(written(tmp_path, {"identifier": "1"}), images, {})
