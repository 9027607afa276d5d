"""Estimators on the limb of a body in haze, whose image sums single scattering along rays."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike import ApparentGeometry, Camera, Detector, GaussianPsf, Image, InputError, PositionFix, Scene, Target
from giantlike.atmosphere import Atmosphere
from giantlike.camera_models import PinholeModel
from giantlike.core.causes import Cause
from giantlike.independent import Haze, PinholeView, Pose, Recorder, hazy_sphere, record
from giantlike.relative import ESTIMATORS
from giantlike.scene import TargetGeometry
from giantlike.shapes import Ellipsoid
from giantlike.terrain import HeightMap
from tests.sizes import slow

RADIUS_KM, SCALE_KM, DEPTH = 6371.0, 7.0, 0.2
RANGE_KM, FOCAL_PX, SIZE_PX = 350_000.0, 3300.0, 230  # 60 px of radius
POSITION_KM = np.array([400.0, -700.0, RANGE_KM])
PHASE_RAD = 1.2
AIR = Atmosphere(scale_height_km=SCALE_KM, optical_depth=DEPTH, sigma_km=SCALE_KM)
LIMB = ("limb_matching", "ellipsoid_cra", "sigmoid_limb")


def sun(phase_rad: float) -> NDArray[np.float64]:
    return np.array([math.sin(phase_rad), 0.0, -math.cos(phase_rad)])


@cache
def hazy(
    scale_km: float = SCALE_KM,
    depth: float = DEPTH,
    law: str = "lambert",
    phase_rad: float = PHASE_RAD,
    *,
    twilight: bool = False,
) -> Image:
    view = PinholeView(focal_px=FOCAL_PX, center_px=(114.5, 114.5), columns=SIZE_PX, rows=SIZE_PX)
    pose = Pose(POSITION_KM, Rotation.identity(), sun(phase_rad))
    haze = Haze(scale_height_km=scale_km, vertical_depth=depth, twilight=twilight)
    light = hazy_sphere(RADIUS_KM, haze, view, pose, law=law)
    recorder = Recorder(gain_e_per_dn=5.0, read_noise_e=25.0)
    pixels = record(light * (3000.0 / light.max()), np.random.default_rng(1), recorder).pixels
    return Image(pixels=pixels, camera_from_inertial=Rotation.identity(), name="earth")


def target(phase_rad: float = PHASE_RAD, **more: object) -> Target:
    apparent = ApparentGeometry(
        position_inertial_km=POSITION_KM * 1.002,
        inertial_from_body=Rotation.identity(),
        sun_direction_inertial=sun(phase_rad),
    )
    shape = Ellipsoid(radii_km=np.full(3, RADIUS_KM))
    return Target(name="EARTH", shape=shape, ephemeris=apparent, **more)  # type: ignore[arg-type]


def radius_error_km(
    name: str,
    air: Atmosphere | None,
    image: Image | None = None,
    phase_rad: float = PHASE_RAD,
    *,
    airless: bool = False,
) -> tuple[float, float, PositionFix]:
    """Radius by which the limb of a fix is too large, and its sigma, km: the range over range and radius."""
    camera = Camera(
        name="c",
        columns=SIZE_PX,
        rows=SIZE_PX,
        model=PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=114.5, cy_px=114.5),
        psf=GaussianPsf(sigma_px=0.7),
        detector=Detector(gain_e_per_dn=5.0, read_noise_e=25.0),
    )
    body = target(phase_rad, atmosphere=air, air=False if airless else None)
    found = ESTIMATORS[name]().estimate(image or hazy(), camera, Scene(targets=(body,)))
    assert isinstance(found, PositionFix), found
    line = POSITION_KM / np.linalg.norm(POSITION_KM)
    error = float((POSITION_KM - found.position_camera_km) @ line)
    sigma = math.sqrt(line @ found.covariance_camera_km2 @ line)
    return error * RADIUS_KM / RANGE_KM, sigma * RADIUS_KM / RANGE_KM, found


@pytest.mark.parametrize("name", [slow("limb_matching"), slow("ellipsoid_cra"), "sigmoid_limb"])
def test_a_limb_in_haze_gives_the_range_within_its_sigma_when_the_atmosphere_is_told(name: str) -> None:
    before, _, _ = radius_error_km(name, None)
    error, sigma, found = radius_error_km(name, AIR)
    assert abs(error) < 2.0 * sigma
    assert abs(error) < 0.6 * abs(before)
    assert sigma > 0.7 * AIR.sigma_km
    assert abs((found.corrections.limb_altitude_km or 0.0) - AIR.limb_altitude_km(RADIUS_KM)) < SCALE_KM
    assert not found.flags.suspect


def test_a_full_disk_in_thick_haze_that_is_not_declared_is_within_its_sigma() -> None:
    """In fine cells markings took up the haze: the limb was 3.3 sigma off."""
    phase_rad = math.radians(15.0)
    image = hazy(100.0, DEPTH, "mcewen", phase_rad)
    error, sigma, _ = radius_error_km("limb_matching", None, image, phase_rad)
    assert abs(error) < 2.5 * sigma


@pytest.mark.parametrize("name", LIMB)
def test_a_limb_that_is_higher_toward_the_terminator_leaves_the_center_within_its_sigma(name: str) -> None:
    """Horizons were 2.2 sigma off toward the Sun with an altitude that is the same all around."""
    _, _, found = radius_error_km(name, AIR)
    off_px = found.center_px - (0.5 * (SIZE_PX - 1) + FOCAL_PX * POSITION_KM[:2] / RANGE_KM)
    assert math.sqrt(off_px @ np.linalg.solve(found.covariance_px2, off_px)) < 1.8


@pytest.mark.slow
@pytest.mark.parametrize(("name", "phase_deg"), [("limb_matching", 15.0), ("ellipse_fit", 60.0), ("ellipse_fit", 90.0)])
def test_what_haze_does_to_the_light_at_a_limb_leaves_the_center_within_its_sigma(name: str, phase_deg: float) -> None:
    """Lines of laws alone took its darker limb for the law, 2.3 sigma off; an even altitude left edges 2.4 to 2.7."""
    air, phase_rad = Atmosphere(scale_height_km=32.0, optical_depth=0.05, sigma_km=16.0), math.radians(phase_deg)
    image = hazy(32.0, 0.05, "mcewen", phase_rad, twilight=True)
    _, _, found = radius_error_km(name, air, image, phase_rad)
    off_px = found.center_px - (0.5 * (SIZE_PX - 1) + FOCAL_PX * POSITION_KM[:2] / RANGE_KM)
    assert math.sqrt(off_px @ np.linalg.solve(found.covariance_px2, off_px)) < 2.0
    assert not found.flags.suspect


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cross_correlation", *LIMB])
def test_light_beyond_the_terminator_does_not_pull_a_center_away_from_the_sun(name: str) -> None:
    """Told the same altitude without a scale height, centers are 0.5 to 0.8 px off, 5 sigma and more."""
    phase_rad = math.radians(10.0)
    image = hazy(16.0, 0.1, "lambert", phase_rad, twilight=True)
    air = Atmosphere(scale_height_km=16.0, optical_depth=0.1, sigma_km=16.0)
    dark = Atmosphere.at(air.limb_altitude_km(RADIUS_KM), sigma_km=16.0)
    true_px = 0.5 * (SIZE_PX - 1) + FOCAL_PX * POSITION_KM[:2] / RANGE_KM
    lit, unlit = (radius_error_km(name, each, image, phase_rad)[2] for each in (air, dark))
    off_px = lit.center_px - true_px
    assert math.sqrt(off_px @ np.linalg.solve(lit.covariance_px2, off_px)) < 2.5
    assert 4.0 * abs(off_px[0]) < true_px[0] - unlit.center_px[0]


@pytest.mark.parametrize("told", [slow(False), True])
def test_a_template_of_a_body_in_thin_haze_is_within_its_sigma_told_of_it_or_not(told: bool) -> None:
    """A template without haze is off by 0.3 px toward the Sun and 0.7 % of the range, 15 sigma."""
    air, phase_rad = Atmosphere(scale_height_km=32.0, optical_depth=0.05, sigma_km=16.0), math.radians(120.0)  # 0.3 px
    image = hazy(32.0, 0.05, "mcewen", phase_rad)
    _, _, found = radius_error_km("cross_correlation", air if told else None, image, phase_rad)
    error_km = found.position_camera_km - POSITION_KM
    sigmas = math.sqrt(error_km @ np.linalg.solve(found.covariance_camera_km2, error_km))
    assert sigmas < 3.0
    assert Cause.ALTITUDE in found.parts
    assert (found.corrections.limb_altitude_km is not None) is told
    assert not found.flags.suspect


@pytest.mark.parametrize("phase_deg", [slow(15.0), 120.0])
@pytest.mark.parametrize("name", [*map(slow, LIMB), "auto"])
def test_a_limb_in_thin_haze_that_nobody_told_is_within_its_sigma(name: str, phase_deg: float) -> None:
    """A horizon that knows of no haze is off by 0.7 % of the range, 20 sigma; at full phase its strain is suspect."""
    phase_rad = math.radians(phase_deg)
    image = hazy(32.0, 0.05, "mcewen", phase_rad)
    _, _, found = radius_error_km(name, None, image, phase_rad)
    error_km = found.position_camera_km - POSITION_KM
    assert math.sqrt(error_km @ np.linalg.solve(found.covariance_camera_km2, error_km)) < 3.5
    assert not found.flags.suspect
    assert Cause.ALTITUDE in found.parts
    assert found.corrections.altitude_sigma_km


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ellipsoid_cra", "auto"])
def test_a_crescent_in_thin_haze_that_nobody_told_is_within_its_sigma(name: str) -> None:
    """Cells of 3 px do not show it: its light is that of a wider point spread function, and the horizon 6 sigma off."""
    phase_rad = math.radians(135.0)
    _, _, found = radius_error_km(name, None, hazy(32.0, 0.05, "mcewen", phase_rad), phase_rad)
    error_km = found.position_camera_km - POSITION_KM
    assert math.sqrt(error_km @ np.linalg.solve(found.covariance_camera_km2, error_km)) < 3.5
    assert not found.flags.suspect
    assert found.corrections.altitude_sigma_km


@pytest.mark.parametrize("phase_deg", [slow(15.0), 120.0])
@pytest.mark.parametrize("name", LIMB)
def test_a_limb_without_haze_has_no_error_of_its_altitude(name: str, phase_deg: float) -> None:
    phase_rad = math.radians(phase_deg)
    _, _, found = radius_error_km(name, None, hazy(32.0, 1e-6, "mcewen", phase_rad), phase_rad)
    assert not found.parts.get(Cause.ALTITUDE, np.zeros(1)).any()
    assert found.corrections.altitude_sigma_km is None


def test_a_template_of_a_body_without_haze_has_next_to_no_error_of_its_altitude() -> None:
    phase_rad = math.radians(120.0)
    _, _, found = radius_error_km("cross_correlation", None, hazy(32.0, 1e-6, "mcewen", phase_rad), phase_rad)
    altitude = found.parts.get(Cause.ALTITUDE, np.zeros((3, 3)))
    assert np.all(np.diag(altitude) < 0.01 * np.diag(sum(found.parts.values(), np.zeros((3, 3)))))
    assert found.corrections.altitude_sigma_km is None


def test_the_ellipse_fit_takes_the_altitude_off_the_radius() -> None:
    """Its windows of 7 pixels leave 0.3 px on a hazy disk of 60 px whatever is told: two of its sigmas, 34 km."""
    before, _, _ = radius_error_km("ellipse_fit", None)
    error, _, found = radius_error_km("ellipse_fit", AIR)
    altitude_km = AIR.limb_altitude_km(RADIUS_KM)
    assert abs(before - error - altitude_km) < 0.02 * altitude_km
    assert abs(error) < 0.35 * RANGE_KM / FOCAL_PX
    assert not found.flags.suspect


def test_an_altitude_among_the_options_wins_over_that_of_the_atmosphere() -> None:
    kind = ESTIMATORS["sigmoid_limb"]
    options = type(kind().options)(limb_altitude_km=5.0)
    assert options.altitude(_geometry()).altitude_km == 5.0
    assert type(kind().options)().altitude(_geometry()).altitude_km == AIR.limb_altitude_km(RADIUS_KM)


def _geometry() -> TargetGeometry:
    geometry = Scene(targets=(target(atmosphere=AIR),)).geometry(hazy())
    assert isinstance(geometry, TargetGeometry)
    return geometry


def test_a_target_has_relief_or_an_atmosphere_and_not_both() -> None:
    terrain = HeightMap.from_array(np.zeros((4, 8)), reference_radii_km=np.full(3, RADIUS_KM))
    with pytest.raises(InputError, match="either terrain or an atmosphere"):
        target(atmosphere=AIR, terrain=terrain)


@pytest.mark.parametrize("name", [*LIMB, "cross_correlation", "auto"])
def test_what_looks_like_haze_is_none_on_an_airless_body(name: str) -> None:
    """The image is hazy on purpose: nothing but the declaration keeps the haze from being seen."""
    phase_rad = math.radians(120.0)
    _, _, found = radius_error_km(name, None, hazy(32.0, 0.05, "mcewen", phase_rad), phase_rad, airless=True)
    assert not found.parts.get(Cause.ALTITUDE, np.zeros(1)).any()
    assert "altitude_sigma_km" not in found.provenance
