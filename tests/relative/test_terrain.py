"""Estimators on limbs of a body with relief, whose images come from the independent renderer."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike import ApparentGeometry, Camera, Detector, GaussianPsf, Image, InputError, PositionFix, Scene, Target
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.outcomes import Quality
from giantlike.independent import PinholeView, Pose, Psf, Recorder, ReliefBody, record, render_body, rough
from giantlike.relative import ESTIMATORS
from giantlike.shapes import Ellipsoid, irregular_body
from giantlike.terrain import HeightMap

RADIUS_KM = 1737.4
POSITION_KM = np.array([150.0, -90.0, 68_000.0])
SUN = np.array([0.8, 0.3, -0.5]) / math.sqrt(0.98)
CAMERA_FROM_BODY = Rotation.from_euler("xyz", [40.0, -20.0, 130.0], degrees=True)
FOCAL_PX, SIZE_PX = 3800.0, 300
LIMB = ("limb_matching", "ellipsoid_cra", "sigmoid_limb", "ellipse_fit")
CAMERA = Camera(
    name="c",
    columns=SIZE_PX,
    rows=SIZE_PX,
    model=PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=149.5, cy_px=149.5),
    psf=GaussianPsf(sigma_px=0.7),
    detector=Detector(gain_e_per_dn=5.0, read_noise_e=25.0),
)


@cache
def moon() -> tuple[Image, Float]:
    """A body of 97 px with relief of 6 km rms, 0.3 px: an image, and its heights, km, on a grid of 1 deg."""
    field = rough(3, rms=6.0 / RADIUS_KM, degrees=(2.5, 90.0), count=160, cells=256)
    view = PinholeView(focal_px=FOCAL_PX, center_px=(149.5, 149.5), columns=SIZE_PX, rows=SIZE_PX)
    pose = Pose(POSITION_KM, CAMERA_FROM_BODY, SUN)
    light = render_body(ReliefBody(radii_km=RADIUS_KM, relief=field), view, pose, law="mcewen", psf=Psf(sigma_px=0.7))
    pixels = record(light, np.random.default_rng(1), Recorder(gain_e_per_dn=5.0, read_noise_e=25.0)).pixels
    latitude, longitude = np.radians(89.5 - np.arange(180.0))[:, None], np.radians(0.5 + np.arange(360.0))
    parts = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)
    directions = np.stack(np.broadcast_arrays(*parts), axis=-1).reshape(-1, 3)
    image = Image(pixels=pixels, camera_from_inertial=Rotation.identity(), name="moon")
    return image, RADIUS_KM * field(directions).reshape(180, 360)


@cache
def fix(name: str, terrain: str) -> PositionFix:
    """Fix of an estimator with no map, the right one, a coarse one or that of another side."""
    image, heights = moon()
    radii = np.full(3, RADIUS_KM)
    maps = {
        "none": None,
        "right": HeightMap.from_array(heights, reference_radii_km=radii),
        "coarse": HeightMap.from_array(heights[5::10, 5::10], reference_radii_km=radii),
        "wrong": HeightMap.from_array(np.roll(heights, 70, axis=1), reference_radii_km=radii),
    }
    apparent = ApparentGeometry(
        position_inertial_km=POSITION_KM * 1.003 + np.array([60.0, -40.0, 0.0]),
        inertial_from_body=CAMERA_FROM_BODY,
        sun_direction_inertial=SUN,
    )
    target = Target(name="MOON", shape=Ellipsoid(radii_km=radii), ephemeris=apparent, terrain=maps[terrain])
    found = ESTIMATORS[name]().estimate(image, CAMERA, Scene(targets=(target,)))
    assert isinstance(found, PositionFix), found
    return found


def range_error(found: PositionFix) -> tuple[float, float]:
    """Error of the range, and its standard deviation, km."""
    line = POSITION_KM / np.linalg.norm(POSITION_KM)
    sigma = math.sqrt(line @ found.covariance_camera_km2 @ line)
    return float((found.position_camera_km - POSITION_KM) @ line), sigma


@pytest.mark.parametrize("name", LIMB)
def test_with_the_map_of_its_relief_a_limb_gives_the_position_within_a_smaller_sigma(name: str) -> None:
    smooth, mapped = fix(name, "none"), fix(name, "right")
    (error, sigma), (_, before) = range_error(mapped), range_error(smooth)
    assert abs(error) < 3.0 * sigma
    assert sigma < 0.6 * before
    off = mapped.position_camera_km - POSITION_KM
    assert float(off @ np.linalg.solve(mapped.covariance_camera_km2, off)) < 14.2  # 99.7 % of chi-square, 3
    assert mapped.score < 0.6 * smooth.score
    assert not mapped.flags.suspect
    assert {"terrain", "terrain_sha256", "terrain_mean_km"} <= set(mapped.provenance)
    assert "terrain" not in smooth.provenance


def test_the_limb_points_of_a_fix_are_those_in_the_image_with_the_relief() -> None:
    smooth, mapped = fix("limb_matching", "none"), fix("limb_matching", "right")
    assert smooth.limb_px is not None
    assert mapped.limb_px is not None
    apart = np.linalg.norm(mapped.limb_px[:, None] - smooth.limb_px, axis=2).min(axis=1)
    assert float(np.median(apart)) < 0.1


@pytest.mark.parametrize("name", LIMB)
def test_a_coarse_map_leaves_a_larger_sigma_that_holds(name: str) -> None:
    error, sigma = range_error(fix(name, "coarse"))
    assert abs(error) < 3.0 * sigma
    assert sigma > range_error(fix(name, "right"))[1]


@pytest.mark.parametrize("name", LIMB)
def test_the_map_of_another_side_makes_a_fix_suspect_or_its_sigma_as_large_as_its_error(name: str) -> None:
    wrong = fix(name, "wrong")
    error_km = wrong.position_camera_km - POSITION_KM
    squared = float(error_km @ np.linalg.solve(wrong.covariance_camera_km2, error_km))
    assert Quality.WRONG_FIGURE in wrong.flags or squared < 9.0  # 3 sigma
    assert wrong.findings.terrain_log_odds is not None
    assert wrong.findings.terrain_log_odds < math.log(1000.0)
    assert (wrong.findings.terrain_misfit or 0.0) > 3.0
    assert range_error(wrong)[1] > range_error(fix(name, "right"))[1]


def test_a_map_goes_with_an_ellipsoid() -> None:
    apparent = ApparentGeometry(position_inertial_km=POSITION_KM, inertial_from_body=CAMERA_FROM_BODY)
    terrain = HeightMap.from_array(np.zeros((4, 8)), reference_radii_km=np.full(3, RADIUS_KM))
    with pytest.raises(InputError, match="ellipsoid"):
        Target(name="ROCK", shape=irregular_body(seed=1), ephemeris=apparent, terrain=terrain)


def test_a_flat_map_above_the_shape_is_the_same_as_a_larger_shape() -> None:
    """A map tells the surface, whatever the radii of the shape: both give the same range."""
    image, _ = moon()
    found = []
    for radius, height in ((RADIUS_KM, 5.0), (RADIUS_KM + 5.0, 0.0)):
        apparent = ApparentGeometry(
            position_inertial_km=POSITION_KM, inertial_from_body=CAMERA_FROM_BODY, sun_direction_inertial=SUN
        )
        terrain = HeightMap.from_array(np.full((18, 36), height), reference_radii_km=np.full(3, RADIUS_KM))
        shape = Ellipsoid(radii_km=np.full(3, radius))
        raised = Target(name="MOON", shape=shape, ephemeris=apparent, terrain=terrain if height else None)
        answer = ESTIMATORS["limb_matching"]().estimate(image, CAMERA, Scene(targets=(raised,)))
        assert isinstance(answer, PositionFix)
        found.append(answer.position_camera_km)
    # Lines are laid 0.3 px from the limb, or on it: 0.02 px of radius. Without the map ranges would differ by 195 km.
    assert_allclose(found[0], found[1], rtol=0, atol=0.02 * 68_000.0 / 97.0)
