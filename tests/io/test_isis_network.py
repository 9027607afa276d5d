"""Control networks and image support data of ISIS: what is read, obeyed and refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.core.errors import DataError
from giantlike.io.isis_network import angles_covariance, read_control_network, read_image_support

CONTROL_NETWORK = """Object = ControlNetwork
  NetworkId  = Test
  TargetName = Moon
  Version    = 5

  Object = ControlPoint
    PointType = Constrained
    PointId   = one
    # AprioriLatitude = 23.9 <degrees>
    AprioriX = 1570593.4 <meters>
    AprioriY = 212384.6 <meters>
    AprioriZ = 705452.0 <meters>
    AprioriCovarianceMatrix = (90000.0, 10.0, 20.0, 90000.0, 30.0,
                               250000.0)
    Group = ControlMeasure
      SerialNumber = A/B/2001-01-01T00:00:00
      Sample       = 12.5
      Line         = 7.25
    End_Group
    Group = ControlMeasure
      SerialNumber = A/B/2001-01-01T00:01:00
      Sample       = 13.5
      Line         = 8.25
      Ignore       = True
    End_Group
    Group = ControlMeasure
      SerialNumber   = A/B/2001-01-01T00:02:00
      Sample         = 14.5
      Line           = 9.25
      JigsawRejected = Yes
    End_Group
  End_Object

  Object = ControlPoint
    PointType = Tie
    PointId   = two
    Ignore    = True
  End_Object

  Object = ControlPoint
    PointType = Tie
    PointId   = three
    Group = ControlMeasure
      SerialNumber = A/B/2001-01-01T00:00:00
      Sample       = 1.0
      Line         = 2.0
    End_Group
  End_Object
End_Object
End
"""

IMAGE_SUPPORT: dict[str, Any] = {
    "name_model": "USGS_ASTRO_FRAME_SENSOR_MODEL",
    "name_platform": "A",
    "name_sensor": "B",
    "image_samples": 100,
    "image_lines": 80,
    "center_ephemeris_time": 31579264.184,
    "focal2pixel_samples": [0.0, 100.0, 0.0],
    "focal2pixel_lines": [0.0, 0.0, 100.0],
    "detector_center": {"sample": 50.0, "line": 40.0},
    "focal_length_model": {"focal_length": 50.0},
    "optical_distortion": {"radial": {"coefficients": [0.0, 1e-3, 0.0]}},
    "instrument_pointing": {"ephemeris_times": [31579264.184], "quaternions": [[0.6, 0.0, 0.0, 0.8]]},
    "body_rotation": {
        "ephemeris_times": [31579264.184],
        "quaternions": [[1.0, 0.0, 0.0, 0.0]],
        "constant_rotation": [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0],
    },
    "instrument_position": {"ephemeris_times": [31579264.184], "positions": [[1.0, 2.0, -300.0]], "reference_frame": 1},
}


def network(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "n.pvl"
    path.write_text(text)
    return path


def support(tmp_path: Path, **changes: Any) -> Path:
    path = tmp_path / "i.isd"
    path.write_text("\n" + json.dumps(IMAGE_SUPPORT | changes))
    return path


def test_a_network_is_read_without_what_it_ignores(tmp_path: Path) -> None:
    content = read_control_network(network(tmp_path, CONTROL_NETWORK))
    assert (content.target, content.ignored_points, content.ignored_measures) == ("Moon", 1, 2)
    one, three = content.points
    assert (one.name, one.type, three.name, three.type) == ("one", "Constrained", "three", "Free")
    assert_allclose(one.position_km, [1570.5934, 212.3846, 705.452], rtol=1e-15)
    assert one.covariance_km2 is not None
    assert_allclose(one.covariance_km2, np.array([[9e4, 10, 20], [10, 9e4, 30], [20, 30, 25e4]]) * 1e-6, rtol=1e-15)
    assert [(m.serial_number, m.sample, m.line) for m in one.measures] == [("A/B/2001-01-01T00:00:00", 12.5, 7.25)]
    assert np.isnan(three.position_km).all()


def test_an_image_state_has_rotations_of_both_parts_and_distortion_toward_ideal(tmp_path: Path) -> None:
    content = read_image_support(support(tmp_path))
    spice = np.array([[-0.28, -0.96, 0.0], [0.96, -0.28, 0.0], [0.0, 0.0, 1.0]])  # q2m of (0.6, 0, 0, 0.8)
    assert_allclose(content.camera_from_inertial.as_matrix(), spice, atol=1e-15)
    assert_allclose(content.body_from_inertial.apply([1.0, 0.0, 0.0]), [0.0, -1.0, 0.0], atol=1e-15)
    (ideal,) = content.ideal_mm(np.array([[350.0, 440.0]]))
    assert_allclose(ideal, np.array([3.0, 4.0]) * (1.0 - 1e-3 * 25.0), rtol=1e-14)


def test_sigmas_of_angles_are_carried_over_by_their_derivatives() -> None:
    camera = Rotation.from_euler("ZXZ", [143.8, 46.1, -168.4], degrees=True).inv()
    steps = np.radians(1e-4) * np.eye(3)
    turns = []
    for step in steps:
        moved = Rotation.from_euler("ZXZ", np.radians([143.8, 46.1, -168.4]) + step).inv()
        turns.append((moved * camera.inv()).as_rotvec() / np.radians(1e-4))
    by_angle = np.stack(turns, axis=1)
    assert_allclose(angles_covariance(camera, 2.0), by_angle @ by_angle.T * np.radians(2.0) ** 2, atol=1e-8)


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        ("Version    = 5", "Version    = 5\n  HeaderStartByte = 65536", "binary network"),
        ("Object = ControlNetwork", "Object = Other", "begins where it should not|no object"),
        ("PointType = Constrained", "PointType = Loose", "PointType must be one of"),
        ("Sample       = 12.5", "Sample       = nan", "Sample must be finite"),
        ("Sample       = 12.5", "", "Sample is missing"),
        ("(90000.0, 10.0", "(-90000.0, 10.0", "negative variance"),
        ("250000.0)", "inf)", "6 finite numbers"),
        ("PointId   = three", "PointId   = one", "one PointId"),
        ("1570593.4 <meters>", "1570593.4 <feet>", "unit"),
    ],
)
def test_damaged_networks_are_refused_in_one_line(before: str, after: str, text: str, tmp_path: Path) -> None:
    assert before in CONTROL_NETWORK
    with pytest.raises(DataError, match=text):
        read_control_network(network(tmp_path, CONTROL_NETWORK.replace(before, after)))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"name_model": "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"}, "line scanners are not"),
        ({"instrument_pointing": {"ephemeris_times": [0.0], "quaternions": [[0.6, 0.0, 0.0, 0.9]]}}, "length 1"),
        ({"instrument_position": {"ephemeris_times": [0.0], "positions": [[1.0, 2.0]]}}, "instrument_position"),
        ({"image_samples": 0}, "image_samples"),
        ({"focal2pixel_lines": [0.0, 100.0, 0.0]}, "must not be parallel"),
        ({"optical_distortion": {"kaguyalism": {}}}, "kaguyalism is not read"),
    ],
)
def test_support_data_of_other_cameras_and_without_sense_are_refused(
    change: dict[str, Any], text: str, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match=text):
        read_image_support(support(tmp_path, **change))
