"""Geometry in labels: made-up labels of known scenes, and real ones beside what the images show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike import Image
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.independent import PinholeView
from giantlike.io.label_geometry import geometry_of_label
from giantlike.presets import camera_preset

SSI = camera_preset("galileo_ssi").camera
VIEW = PinholeView(SSI.model.focal_length_px, (399.0, 399.0), 800, 800)
FLOAT64 = 1e-9
POLE_RAD = 1e-4  # a pole 100 km away is projected in perspective


def angles_deg(direction: np.ndarray) -> tuple[float, float]:
    """Planetocentric latitude and west longitude."""
    return float(np.degrees(np.arcsin(direction[2]))), float(
        np.degrees(-np.arctan2(direction[1], direction[0])) % 360.0
    )


def test_a_galileo_label_gives_place_orientation_and_sun_back() -> None:
    turn = Rotation.from_euler("xyz", [1.9, 0.4, -2.2])
    sight = VIEW.directions([610.0, 215.0])
    position = 83266.1 * sight / np.linalg.norm(sight)
    sun = np.array([0.4, -0.2, -0.9]) / np.linalg.norm([0.4, -0.2, -0.9])
    viewer, lit = (rotate(turn.inv(), vector) for vector in (-position / 83266.1, sun))
    pole = VIEW.project(position + rotate(turn, np.array([0.0, 0.0, 100.0]))) - [610.0, 215.0]
    below, above = angles_deg(viewer), angles_deg(lit)
    label: dict[str, str | float] = {
        "TARGET": "EUROPA",
        "SUB_SPACECRAFT_SAMPLE": 611.0,
        "SUB_SPACECRAFT_LINE": 216.0,
        "TARGET_CENTER_DISTANCE": 83266.1,
        "SUB_SPACECRAFT_LATITUDE": below[0],
        "SUB_SPACECRAFT_LONGITUDE": below[1],
        "SUB_SOLAR_LATITUDE": above[0],
        "SUB_SOLAR_LONGITUDE": above[1],
        "NORAZ": float(np.degrees(np.arctan2(pole[1], pole[0]))),
    }
    found = geometry_of_label(label, SSI.model)
    assert found is not None
    assert found.camera_from_body is not None
    assert_allclose(found.position_camera_km, position, rtol=0, atol=1e-6)
    assert (found.camera_from_body * turn.inv()).magnitude() < POLE_RAD
    assert_allclose(found.sun_direction_camera, sun, rtol=0, atol=POLE_RAD)
    with pytest.raises(InputError, match="NORAZ must be a number"):
        geometry_of_label(label | {"NORAZ": "UNK"}, SSI.model)


def test_a_near_label_gives_the_attitude_and_the_vector_to_the_target() -> None:
    attitude = Rotation.from_euler("xyz", [0.3, -1.2, 2.0])  # spacecraft from J2000
    quaternion = attitude.as_quat(scalar_first=True)
    values = [*quaternion, 2.0e8, 5.4e7, 6.7e7, 1, 2.0e8 + 12.0, 5.4e7 - 27.0, 6.7e7 - 21.0]
    label = {f"NEAR-{19 + k:03d}": str(value) for k, value in enumerate(values)} | {"NEAR-047": "EROS    "}
    found = geometry_of_label(label, SSI.model)
    assert found is not None
    assert found.target == "EROS"
    spacecraft = rotate(attitude, np.array([12.0, -27.0, -21.0]))
    # boresight along +X of the spacecraft, samples along +Z, lines along -Y
    assert_allclose(found.position_camera_km, [spacecraft[2], -spacecraft[1], spacecraft[0]], rtol=0, atol=1e-6)
    assert found.camera_from_inertial is not None
    assert_allclose(np.linalg.norm(found.sun_direction_camera), 1.0, rtol=0, atol=FLOAT64)


def test_other_labels_have_no_geometry() -> None:
    assert geometry_of_label({"LAB02": "VGR-1   FDS 34403.46   PICNO 1790S1-019"}, SSI.model) is None


@pytest.mark.real_data
def test_labels_of_real_images_point_at_their_targets(data_dir: Path) -> None:
    europa = geometry_of_label(Image.open(data_dir / "bodies" / "galileo_ssi" / "4600R.IMG").metadata, SSI.model)
    assert europa is not None
    phase_deg = np.degrees(np.arccos(-europa.sun_direction_camera @ europa.position_camera_km / 83266.1))
    assert phase_deg == pytest.approx(36.4126, abs=0.5)  # PHA of the label, at the middle of the frame
    msi = camera_preset("near_msi").camera
    for path in sorted((data_dir / "bodies" / "near_msi").glob("*.fit")):
        image = Image.open(path)
        eros = geometry_of_label(image.metadata, msi.model)
        assert eros is not None
        assert eros.camera_from_inertial is not None
        boresight = eros.camera_from_inertial.inv().apply([0.0, 0.0, 1.0])
        ra_deg, dec_deg = (float(str(image.metadata[f"NEAR-{item:03d}"])) for item in (84, 85))
        stated = np.array([np.cos(np.radians(ra_deg)), np.sin(np.radians(ra_deg)), np.tan(np.radians(dec_deg))])
        off_deg = np.degrees(np.arccos(boresight @ stated / np.linalg.norm(stated)))
        assert off_deg < 0.2  # 20 px: the label's own pointing has an alignment that the quaternion has not
        assert np.linalg.norm(eros.position_camera_km) == pytest.approx(float(str(image.metadata["NEAR-030"])), abs=0.1)
