"""Patterns of stars, their index, and identification from them with nothing else known."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel, EquidistantModel
from giantlike.catalogs import MemoryCatalog, StarTable, load_catalog
from giantlike.core.arrays import Float
from giantlike.core.frames import rotate, rotation_between
from giantlike.core.outcomes import Failure, Reason
from giantlike.stars import StarOptions
from giantlike.stars.field import Sky
from giantlike.stars.lost_in_space import identify_in_cone, identify_lost_in_space
from giantlike.stars.refine import RefinedAttitude
from giantlike.stars.star_index import (
    Pattern,
    build_index,
    cap_radius_rad,
    caps,
    describe_quads,
    describe_triads,
    sky_index,
    subsets,
)
from tests.sizes import slow
from tests.tolerances import FLOAT64_SUM, SETTLED

SIGMA_PX = 0.2
RIGHT_RAD_PX = 3.0  # of attitude at the corner: 20 stars at 0.2 px give 0.1 px, 5 stars 0.5 px


@pytest.fixture(scope="module", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GIANTLIKE_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def catalog() -> MemoryCatalog:
    """The bright stars of the default catalog: enough for wide fields, and quick to index."""
    table: StarTable = load_catalog("default").cone([0.0, 0.0, 1.0], np.pi, max_magnitude=7.5)
    return MemoryCatalog(table, name="bright", band="Gaia G", version="test")


def _points(
    rng: np.random.Generator, sky: Sky, camera: Camera, *, n_stars: int = 30, missing: float = 0.2, n_false: int = 15
) -> tuple[Rotation, Float]:
    attitude = Rotation.random(rng=rng)
    field = sky.field(camera, attitude)
    places = camera.model.project(rotate(attitude, field.directions_inertial))
    seen = places[camera.contains(places)][:n_stars]
    seen = seen[rng.random(len(seen)) >= missing] + 0.0
    seen += SIGMA_PX * rng.normal(size=seen.shape)
    false = rng.uniform(0, [camera.columns - 1.0, camera.rows - 1.0], (n_false, 2))
    points = np.concatenate([seen, false])
    rank = np.concatenate([np.arange(len(seen)), rng.uniform(0, len(seen), n_false)])
    return attitude, points[np.argsort(rank)]


def _identify(points: Float, camera: Camera, sky: Sky, **options: float | bool) -> RefinedAttitude | Failure:
    covariance = np.tile(SIGMA_PX**2 * np.eye(2), (len(points), 1, 1))
    return identify_lost_in_space(points, covariance, camera, sky, options=StarOptions(**options))  # type: ignore[arg-type]


def _right(outcome: RefinedAttitude, truth: Rotation, camera: Camera) -> bool:
    error = np.linalg.norm(rotation_between(outcome.solution.camera_from_inertial, truth))
    return bool(error * camera.model.focal_length_px < RIGHT_RAD_PX * max(1.0, 1.0 / np.tan(camera.half_diagonal_rad)))


# --- invariants --------------------------------------------------------------------------------------------------


def _some_directions(n: int = 9) -> Float:
    rng = np.random.default_rng(1)
    near = np.array([0.0, 0.0, 1.0]) + 0.2 * rng.normal(size=(n, 3))
    return np.asarray(near / np.linalg.norm(near, axis=1)[:, None])


def test_triads_keep_their_sides_order_and_sense_under_rotation_and_turn_over_in_a_mirror() -> None:
    stars, triads = _some_directions(), subsets(9, 3)
    sides, ordered, sense = describe_triads(stars, triads)
    turned = describe_triads(rotate(Rotation.random(rng=np.random.default_rng(2)), stars), triads[:, ::-1])
    np.testing.assert_allclose(turned[0], sides, rtol=0, atol=FLOAT64_SUM)
    assert (turned[1] == ordered).all()
    assert (turned[2] == sense).all()
    mirrored = describe_triads(stars * [-1.0, 1.0, 1.0], triads)
    np.testing.assert_allclose(mirrored[0], sides, rtol=0, atol=FLOAT64_SUM)
    assert (mirrored[2] != sense).all()
    ends = stars[ordered[:, 1]], stars[ordered[:, 2]]
    angle = np.arctan2(np.linalg.norm(np.cross(*ends), axis=1), np.einsum("ij,ij->i", *ends))
    np.testing.assert_allclose(sides[:, 0], 2.0 * np.sin(angle / 2.0), rtol=0, atol=FLOAT64_SUM)


def test_quads_keep_their_code_when_turned_scaled_or_listed_otherwise() -> None:
    stars, quads = _some_directions(), subsets(9, 4)
    codes, ordered, which = describe_quads(stars, quads)
    assert 0 < len(codes) < len(quads)
    assert (codes >= -FLOAT64_SUM).all()
    assert (codes <= 1.0 + FLOAT64_SUM).all()
    turned = describe_quads(rotate(Rotation.random(rng=np.random.default_rng(3)), stars), quads[:, ::-1])
    assert (turned[2] == which).all()
    np.testing.assert_allclose(turned[0], codes, rtol=0, atol=FLOAT64_SUM)
    assert (turned[1] == ordered).all()
    small = np.array([0.0, 0.0, 1.0]) + 1e-4 * (stars / stars[:, 2:] - [0.0, 0.0, 1.0])
    smaller = np.array([0.0, 0.0, 1.0]) + 1e-6 * (stars / stars[:, 2:] - [0.0, 0.0, 1.0])
    first, second = (describe_quads(s / np.linalg.norm(s, axis=1)[:, None], quads) for s in (small, smaller))
    np.testing.assert_allclose(first[0], second[0], rtol=0, atol=SETTLED)  # the curvature of 1e-4 rad, and rounding


def test_caps_cover_the_part_of_the_sky_that_they_should() -> None:
    rng = np.random.default_rng(4)
    axis = np.array([0.6, 0.0, -0.8])
    centers = caps(0.1, axis, 0.5)
    places = rotate(Rotation.random(2000, rng=rng), [0.0, 0.0, 1.0])
    distance, _ = cKDTree(centers).query(places[places @ axis > np.cos(0.45)])
    assert np.max(distance) < 0.1
    assert (centers @ axis).min() > np.cos(0.5) - 0.01
    assert abs(len(caps(0.1)) * 0.1**2 / (4 * np.pi) - 1.0) < 0.01


@pytest.mark.parametrize("pattern", list(Pattern))
def test_an_index_finds_what_brute_force_finds(pattern: Pattern) -> None:
    rng = np.random.default_rng(5)
    stars = rotate(Rotation.random(400, rng=rng), [0.0, 0.0, 1.0])
    index = build_index(pattern, np.arange(400) + 7, stars, 0.4)
    assert (index.cells[1:] >= index.cells[:-1]).all()
    describe = describe_quads if pattern is Pattern.QUAD else describe_triads
    codes = describe(index.directions, index.patterns.astype(np.intp))[0]
    codes = codes if pattern is Pattern.QUAD else codes / index.widest
    chosen = rng.choice(len(index), 30, replace=False)
    asked, found = index.find(codes[chosen], 0.004)
    for row, place in enumerate(chosen):
        near = np.flatnonzero((np.abs(codes - codes[place]) <= 0.004).all(axis=1))
        assert set(near) <= set(found[asked == row])
    np.testing.assert_allclose(index.directions, stars[index.ids - 7], rtol=0, atol=0)


# --- identification ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_fields_of_10_to_20_degrees_are_found_among_false_and_missing_stars_and_never_wrongly(
    catalog: MemoryCatalog,
) -> None:
    rng, sky, right = np.random.default_rng(6), Sky(catalog=catalog), 0
    for _ in range(40):
        camera = Camera.from_fov(float(rng.uniform(10.0, 20.0)), 1024, 1024)
        attitude, points = _points(rng, sky, camera)
        outcome = _identify(points, camera, sky)
        if isinstance(outcome, RefinedAttitude):
            assert _right(outcome, attitude, camera)
            right += 1
    assert right >= 38  # 99.5 % of many: 3 failures of 40 have a chance of 1e-3


@pytest.mark.parametrize("n", [slow(5), slow(8), 15, slow(25), slow(40), slow(60)])
def test_fields_without_stars_are_never_solved(catalog: MemoryCatalog, n: int) -> None:
    rng, sky = np.random.default_rng([7, n]), Sky(catalog=catalog)
    camera = Camera.from_fov(15.0, 1024, 1024)
    outcome = _identify(rng.uniform(0, 1023, (n, 2)), camera, sky)
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.NO_PATTERN_MATCH


@pytest.mark.parametrize("ratio", [slow(0.83), slow(1.0), 1.18])
def test_an_unknown_focal_length_and_distortion_are_found(catalog: MemoryCatalog, ratio: float) -> None:
    rng, sky, right = np.random.default_rng(8), Sky(catalog=catalog), 0
    guess = Camera.from_fov(15.0, 1024, 1024)
    focal = guess.model.focal_length_px * ratio
    k1 = 10.0 * focal**2 / 724.0**3  # 10 px in the corner
    model = BrownModel(fx_px=focal, fy_px=focal, cx_px=511.5, cy_px=511.5, k1=k1)
    camera = dataclasses.replace(guess, model=model)
    for _ in range(6):
        attitude, points = _points(rng, sky, camera, n_stars=40)
        outcome = _identify(points, guess, sky, estimate_scale=True, scale_error=0.2)
        if isinstance(outcome, RefinedAttitude):
            assert _right(outcome, attitude, camera)
            assert abs(outcome.solution.model.focal_length_px / focal - 1.0) < 2e-3
            right += 1
    assert right >= 4


def test_a_fisheye_of_180_degrees_is_found(catalog: MemoryCatalog) -> None:
    rng, sky = np.random.default_rng(9), Sky(catalog=catalog)
    focal = 1024 / np.pi
    model = EquidistantModel(fx_px=focal, fy_px=focal, cx_px=511.5, cy_px=511.5)
    camera = Camera(name="fisheye", columns=1024, rows=1024, model=model)
    attitude, points = _points(rng, sky, camera, n_stars=120)
    outcome = _identify(points, camera, sky)
    assert isinstance(outcome, RefinedAttitude)
    assert _right(outcome, attitude, camera)


def test_an_attitude_wrong_by_3_degrees_is_enough_for_a_deep_catalog_of_a_small_field() -> None:
    """A field of half a degree, and a user's catalog of that part of the sky."""
    rng = np.random.default_rng(10)
    axis = np.array([0.48, -0.6, 0.64])
    offsets = rng.uniform(-0.08, 0.08, (20_000, 3))
    directions = axis + offsets - (offsets @ axis)[:, None] * axis
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    zeros = np.zeros(len(directions))
    table = StarTable(
        ids=np.arange(1, len(directions) + 1),
        ra_deg=np.degrees(np.arctan2(directions[:, 1], directions[:, 0])) % 360.0,
        dec_deg=np.degrees(np.arcsin(directions[:, 2])),
        pm_ra_mas_yr=zeros, pm_dec_mas_yr=zeros, parallax_mas=zeros, radial_velocity_km_s=zeros,
        epoch_jyear=zeros + 2016.0, magnitude=rng.uniform(10.0, 15.0, len(directions)), color_bv=zeros,
        sigma_mas=zeros + 1.0, sigma_pm_mas_yr=zeros,
    )  # fmt: skip
    sky = Sky(catalog=MemoryCatalog(table, name="deep", band="user", version="1"))
    camera = Camera.from_fov(0.5, 1024, 1024)
    truth = Rotation.align_vectors([[0.0, 0.0, 1.0]], [axis])[0]
    field = sky.field(camera, truth)
    places = camera.model.project(rotate(truth, field.directions_inertial))
    points = places[camera.contains(places)][:25][rng.random(25) > 0.1]
    points = np.concatenate([points, rng.uniform(0, 1023, (5, 2))])
    covariance = np.tile(SIGMA_PX**2 * np.eye(2), (len(points), 1, 1))
    apriori = Rotation.from_rotvec(np.radians([1.5, -1.8, 1.6])) * truth
    outcome = identify_in_cone(points, covariance, camera, sky, apriori, options=StarOptions())
    assert isinstance(outcome, RefinedAttitude), outcome
    assert len(outcome.matches) >= 20
    assert outcome.false_match_probability < 1e-6


def test_an_index_is_kept_on_disk_and_belongs_to_its_stars(catalog: MemoryCatalog) -> None:
    from giantlike.catalogs import cache_folder
    from giantlike.stars import star_index

    radius = cap_radius_rad(np.radians(12.0))
    assert np.degrees(radius) == pytest.approx(11.31, abs=0.01)  # two decimals
    made = sky_index(catalog, Pattern.TRIAD, radius)
    star_index._memory.clear()
    read = sky_index(catalog, Pattern.TRIAD, radius)
    assert read is not made
    assert (read.patterns == made.patterns).all()
    files = len(list(cache_folder().glob("star-index-*")))
    fewer = MemoryCatalog(catalog.stars.select(catalog.stars.dec_deg > 0.0), name="bright", band="G", version="test")
    north = sky_index(fewer, Pattern.TRIAD, radius)
    assert len(north) < len(made)
    assert len(list(cache_folder().glob("star-index-*"))) == files + 1
