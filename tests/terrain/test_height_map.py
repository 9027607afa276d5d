"""Height maps: lookup by direction, what is not resolved, the limb that relief makes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike import DataError, InputError
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.terrain import HeightMap, limb_profile

MOON = np.full(3, 1737.4)
SINGLE_KM = 1e-4  # float32 of some km
LINEAR_KM = 2e-3  # linear interpolation of a wave of 4 km and 90 deg on a grid of 1 deg


def direction(latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> Float:
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    parts = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


def waves(latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> Float:
    """Heights, km, without a seam at any longitude."""
    return np.asarray(4.0 * np.sin(2.0 * np.radians(latitude_deg)) * np.cos(4.0 * np.radians(longitude_deg)))


def sampled(rows: int = 180) -> HeightMap:
    step = 180.0 / rows
    latitude = 90.0 - step * (np.arange(rows)[:, None] + 0.5)
    return HeightMap.from_array(waves(latitude, step * (np.arange(2 * rows) + 0.5)), reference_radii_km=MOON)


def test_heights_are_those_of_the_function_that_was_sampled_also_across_the_seam_and_between_tiles() -> None:
    latitude, longitude = np.meshgrid(np.linspace(-88.0, 88.0, 41), np.linspace(-180.0, 540.0, 97))
    found = sampled(540).heights_km(7.0 * direction(latitude, longitude))
    assert_allclose(found, waves(latitude, longitude), rtol=0, atol=LINEAR_KM)


def test_radii_are_heights_above_the_reference_ellipsoid() -> None:
    radii = np.array([6378.0, 6378.0, 6356.0])
    flat = HeightMap.from_array(np.full((90, 180), 3.0), reference_radii_km=radii)
    assert_allclose(flat.radii_km(np.eye(3)), radii + 3.0, rtol=0, atol=SINGLE_KM)


def test_a_map_with_holes_and_one_of_a_part_hold_no_heights_there(tmp_path: Path) -> None:
    heights = np.zeros((18, 36))
    heights[4, 7] = np.nan
    assert np.isnan(HeightMap.from_array(heights, reference_radii_km=MOON).heights_km(direction(45.0, 75.0)))
    path = tmp_path / "part.npz"
    np.savez(path, heights_km=np.ones((20, 40)), reference_radii_km=MOON, bounds_deg=[-10.0, 10.0, 20.0, 60.0])
    part = HeightMap.open(path)
    inside = [[0.0, 20.1], [9.9, 59.9], [-9.9, 40.0]]
    outside = [[0.0, 19.5], [10.5, 40.0], [0.0, 61.0], [-90.0, 0.0], [0.0, -140.0]]
    assert_allclose(part.heights_km(direction(*np.array(inside).T)), 1.0)
    assert np.isnan(part.heights_km(direction(*np.array(outside).T))).all()


@pytest.mark.slow
def test_a_map_says_how_much_relief_it_does_not_resolve() -> None:
    """Fields of waves by Kaula's rule, sampled 4 and 16 times as coarsely as they are."""
    rng = np.random.default_rng(3)
    latitude = 90.0 - 0.25 * (np.arange(720)[:, None] + 0.5)
    places = direction(latitude, 0.25 * (np.arange(1440) + 0.5))
    heights = np.zeros((720, 1440))
    for wave in np.geomspace(3.0, 400.0, 120):
        axis = rng.normal(size=3)
        heights += wave**-0.5 * np.cos(wave * (places @ axis) / np.linalg.norm(axis) + rng.uniform(0.0, 6.3))
    for every in (4, 16):
        coarse = HeightMap.from_array(heights[every // 2 :: every, every // 2 :: every], reference_radii_km=MOON)
        band = slice(200, 520)  # within 40 deg of the equator, where the grid is nearly even
        off = heights[band] - coarse.heights_km(places[band])
        assert 0.6 < coarse.unresolved_km() / off.std() < 1.6


def test_a_mesh_of_a_map_is_closed_and_lies_on_its_surface() -> None:
    relief = sampled()
    mesh = relief.mesh(3.0)
    assert_allclose(np.linalg.norm(mesh.vertices_km, axis=1), relief.radii_km(mesh.vertices_km), rtol=0, atol=1e-6)
    assert_allclose(
        mesh.mean_radius_km, 1737.4, rtol=0, atol=2.0
    )  # facets of 3 deg lie 0.6 km below, and relief is even


def test_the_limb_of_a_higher_sphere_stands_as_much_higher() -> None:
    """On an ellipsoid that the heights of a sphere surround: what is seen is the limb of the sphere."""
    sphere = HeightMap.from_array(np.full((90, 180), 2.5), reference_radii_km=MOON)
    profile = limb_profile(sphere, MOON, np.array([20_000.0, 4000.0, -9000.0]))
    # Higher limb stands a little nearer: sin(a) = R / d to second order, 2.5^2 / 1737 / 2 km.
    assert_allclose(profile.altitude_km, 2.5, rtol=0, atol=0.01)
    assert profile.common_sigma_km == 0.0
    assert_allclose(profile.unresolved_km, 0.0)


def test_the_limb_of_a_mountain_is_where_a_ray_grazes_it() -> None:
    """The whole outline against the least distance of rays from ground that is sampled densely all over."""
    relief, camera = sampled(90), np.array([8000.0, 3000.0, 5000.0])
    profile = limb_profile(relief, MOON, camera, angles=720)
    rng = np.random.default_rng(1)
    ground = rng.normal(size=(400_000, 3))
    ground *= (relief.radii_km(ground) / np.linalg.norm(ground, axis=1))[:, None]
    ray = ground - camera
    distance = np.linalg.norm(camera)
    depth = -(ray @ camera) / distance
    place = np.arctan2(ground @ profile.second_body, ground @ profile.first_body)
    across = np.linalg.norm(np.cross(ray, camera / distance), axis=1)
    angle = np.arctan2(across, depth)
    # Of 400,000 places some hundred lie within a bin of 3 deg near the limb: the highest misses the top by little.
    bins = np.floor((place % (2.0 * np.pi)) / np.radians(3.0)).astype(int)
    highest = np.zeros(120)
    np.maximum.at(highest, bins, angle)
    limb = np.arcsin(1737.4 / distance)
    seen_km = np.tan(highest - limb) * np.sqrt(distance**2 - 1737.4**2)
    predicted = profile.altitude_km.reshape(120, 6).max(axis=1)
    assert_allclose(seen_km, predicted, rtol=0, atol=0.25)
    assert abs(np.mean(seen_km - predicted)) < 0.1


def test_the_outline_in_an_image_is_the_smooth_one_moved_out_by_the_altitude_in_pixels() -> None:
    turn = Rotation.from_euler("xyz", [30.0, 50.0, -70.0], degrees=True)
    place = np.array([200.0, -100.0, 30_000.0])
    model = PinholeModel(fx_px=5000.0, fy_px=5000.0, cx_px=511.5, cy_px=511.5)
    profile = limb_profile(sampled(90), MOON, turn.inv().apply(-place))
    points, altitude_px = profile.in_image(model, turn, place)
    rays = model.unproject(points)
    away = np.arccos(rays @ place / np.linalg.norm(place)) - np.arcsin(1737.4 / np.linalg.norm(place))
    assert_allclose(away * 5000.0, altitude_px, rtol=0, atol=0.01)
    assert_allclose(altitude_px, profile.altitude_km * 5000.0 / 30_000.0, rtol=0, atol=0.01)


def test_the_bias_of_a_sphere_that_is_larger_and_off_its_place_is_told_from_any_part_of_its_limb() -> None:
    """Heights of a sphere of 1740 km about a point 3 km from the origin: to first order 2.6 km + u . offset."""
    offset = np.array([0.0, 2.0, -1.0])
    latitude = 89.5 - np.arange(180.0)[:, None]
    moved = HeightMap.from_array(direction(latitude, 0.5 + np.arange(360.0)) @ offset + 2.6, reference_radii_km=MOON)
    profile = limb_profile(moved, MOON, np.array([1e5, 0.0, 0.0]))
    expected = [profile.first_body @ offset, profile.second_body @ offset]
    for sun in (None, [0.0, 1.0, 0.0], [-0.5, 0.2, -0.84]):
        radius, center = profile.bias(sun)
        assert_allclose(radius, 2.6, rtol=0, atol=0.02)
        assert_allclose(center, expected, rtol=0, atol=0.02)
    with pytest.raises(InputError, match="lights none"):
        profile.bias([-1.0, 0.0, 0.0])


def test_only_what_is_high_is_seen_so_that_the_mean_limb_stands_above_the_mean_surface() -> None:
    rng = np.random.default_rng(5)
    rough = HeightMap.from_array(rng.normal(size=(180, 360)), reference_radii_km=MOON)
    profile = limb_profile(rough, MOON, np.array([0.0, 0.0, 1e5]))
    assert profile.mean_km > 0.5  # half the root mean square of the heights


@pytest.mark.slow
def test_a_coarse_map_predicts_the_mean_limb_of_the_fine_one_within_its_sigma() -> None:
    rng = np.random.default_rng(8)
    latitude = 90.0 - 0.25 * (np.arange(720)[:, None] + 0.5)
    places = direction(latitude, 0.25 * (np.arange(1440) + 0.5))
    heights = np.zeros((720, 1440))
    for wave in np.geomspace(3.0, 300.0, 120):
        axis = rng.normal(size=3)
        heights += wave**-0.5 * np.cos(wave * (places @ axis) / np.linalg.norm(axis) + rng.uniform(0.0, 6.3))
    fine = HeightMap.from_array(heights, reference_radii_km=MOON)
    coarse = HeightMap.from_array(heights[4::8, 4::8], reference_radii_km=MOON)
    camera = np.array([2e5, 1e5, 3e4])
    truth, told = (limb_profile(one, MOON, camera, angles=1440) for one in (fine, coarse))
    without = float(np.mean(told.altitude_km - told.unresolved_km))
    assert abs(told.mean_km - truth.mean_km) < 2.0 * told.common_sigma_km
    assert abs(told.mean_km - truth.mean_km) < 0.5 * abs(without - truth.mean_km)


def test_where_a_map_holds_nothing_the_limb_is_the_mean_of_the_rest_and_its_sigma_grows() -> None:
    heights = np.full((90, 180), 1.0)
    heights[:, :20] = np.nan
    heights[::2, 30::2] += 0.5
    profile = limb_profile(HeightMap.from_array(heights, reference_radii_km=MOON), MOON, np.array([0.0, 0.0, 1e5]))
    assert 0.8 < profile.known.mean() < 0.95
    assert profile.sigma_km > 0.05
    assert np.isfinite(profile.altitude_km).all()


def test_an_average_over_position_angles_is_that_of_the_profile() -> None:
    profile = limb_profile(sampled(90), MOON, np.array([9000.0, 0.0, 0.0]), angles=360)
    where = np.radians(np.arange(360.0))
    rays = np.cos(where)[:, None] * profile.first_body + np.sin(where)[:, None] * profile.second_body
    assert_allclose(profile.at(rays), profile.altitude_km, rtol=0, atol=1e-9)
    for count in (5, 6):
        wide = profile.at(rays, width_rad=np.radians(count))
        around = [np.roll(profile.altitude_km, shift) for shift in range(-2, 3)]
        around = (
            around
            if count == 5
            else [*around, 0.5 * (np.roll(profile.altitude_km, 3) + np.roll(profile.altitude_km, -3))]
        )
        assert_allclose(wide, np.mean(around, axis=0), rtol=0, atol=0.01)


def test_a_map_in_tiles_is_the_same_when_it_is_opened_again(tmp_path: Path) -> None:
    relief = sampled(300)
    relief.save(tmp_path / "map.npz")
    again = HeightMap.open(tmp_path / "map.npz", sigma_km=0.1)
    places = direction(np.linspace(-89.0, 89.0, 50), np.linspace(0.0, 359.0, 50))
    assert_allclose(again.heights_km(places), relief.heights_km(places), rtol=0, atol=0)
    assert (again.sigma_km, again.name) == (0.1, "map.npz")
    assert again.sha256 != relief.sha256


@pytest.mark.parametrize(
    ("heights", "radii", "error", "text"),
    [
        (np.zeros(8), MOON, InputError, "grid"),
        (np.zeros((4, 8)), [1.0, 2.0], InputError, "reference_radii_km"),
        (np.full((4, 8), np.nan), MOON, DataError, "no heights"),
        (np.full((4, 8), 1737.0), MOON, DataError, "another unit"),
    ],
)
def test_what_is_no_map_is_refused(heights: Float, radii: Float, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        HeightMap.from_array(heights, reference_radii_km=radii)


def test_a_limb_is_not_predicted_from_inside_the_body() -> None:
    with pytest.raises(InputError, match="outside the body"):
        limb_profile(sampled(90), MOON, np.array([0.0, 0.0, 1730.0]))
