"""The order of a catalog on the sky, and the file that it is kept in."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from giantlike.catalogs import MemoryCatalog, StarTable, apparent_directions, load_catalog
from giantlike.catalogs.cells import ABERRATION_RAD, FAST_RAD, OBSERVER_AU, YEARS_FROM_EPOCH, margins_rad
from giantlike.catalogs.stored import Source, catalog_header, open_catalog, save_catalog
from giantlike.catalogs.table import COLUMN_TYPES, et_of_julian_year, join_tables
from giantlike.core.arrays import Float, unit
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import direction_from_radec
from giantlike.core.units import AU_KM, RAD_PER_MAS
from tests.tolerances import FLOAT32


def sky(count: int, seed: int = 0) -> StarTable:
    """Stars all over the sky, some of them fast and near, with magnitudes that repeat."""
    rng = np.random.default_rng(seed)
    speed = np.where(rng.random(count) < 0.02, 3000.0, 20.0)
    return StarTable(
        ids=rng.permutation(count) + 1,
        ra_deg=rng.uniform(0.0, 360.0, count),
        dec_deg=np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, count))),
        pm_ra_mas_yr=rng.normal(0.0, 1.0, count) * speed,
        pm_dec_mas_yr=rng.normal(0.0, 1.0, count) * speed,
        parallax_mas=np.where(speed > 100.0, rng.uniform(50.0, 700.0, count), rng.uniform(0.0, 20.0, count)),
        radial_velocity_km_s=np.where(speed > 100.0, rng.normal(0.0, 60.0, count), 0.0),
        epoch_jyear=np.full(count, 2016.0),
        magnitude=np.round(rng.uniform(2.0, 11.0, count), 1),
        color_bv=np.where(rng.random(count) < 0.3, np.nan, 0.7),
        sigma_mas=np.full(count, 0.5),
        sigma_pm_mas_yr=rng.uniform(0.0, 1.0, count),
        is_double=rng.random(count) < 0.1,
    )


@pytest.fixture(scope="module")
def stars() -> StarTable:
    return sky(30_000)


@pytest.fixture(scope="module")
def catalog(stars: StarTable) -> MemoryCatalog:
    return MemoryCatalog(stars, name="made up", band="V", version="1")


PLACES = [(0.0, 0.0), (359.99, 45.0), (12.0, 89.9), (200.0, -90.0), (83.0, -5.0), (180.0, 90.0), (0.01, -60.0)]


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("radius_deg", [0.01, 0.7, 4.0, 20.0, 75.0, 89.99, 120.0, 180.0])
def test_a_cone_holds_what_brute_force_finds_and_little_more(
    stars: StarTable, catalog: MemoryCatalog, place: tuple[float, float], radius_deg: float
) -> None:
    axis = direction_from_radec(*place)
    distance = np.linalg.norm(direction_from_radec(stars.ra_deg, stars.dec_deg) - axis, axis=1)
    angle = 2.0 * np.arcsin(np.minimum(distance / 2.0, 1.0))
    got = catalog.cone(axis, np.radians(radius_deg))
    assert set(stars.ids[angle <= np.radians(radius_deg)].tolist()) <= set(got.ids.tolist())
    reach = np.radians(radius_deg) + np.maximum(margins_rad(stars), FAST_RAD) + ABERRATION_RAD + 1e-5
    assert set(got.ids.tolist()) <= set(stars.ids[angle <= reach].tolist())
    assert (np.diff(got.magnitude) >= 0).all()


def test_random_cones_agree_with_a_tree_of_directions(stars: StarTable, catalog: MemoryCatalog) -> None:
    rng = np.random.default_rng(5)
    tree = cKDTree(direction_from_radec(stars.ra_deg, stars.dec_deg))
    for axis, radius in zip(unit(rng.normal(size=(300, 3))), rng.uniform(1e-4, 0.6, 300), strict=True):
        inside = tree.query_ball_point(axis, 2.0 * np.sin(radius / 2.0))
        assert set(stars.ids[inside].tolist()) <= set(catalog.cone(axis, radius).ids.tolist())


@pytest.mark.parametrize("year", [2016.0 - YEARS_FROM_EPOCH, 2016.0 + YEARS_FROM_EPOCH])
def test_no_star_is_missed_after_its_motion_parallax_and_aberration(
    stars: StarTable, catalog: MemoryCatalog, year: float
) -> None:
    rng = np.random.default_rng(6)
    for axis, radius in zip(unit(rng.normal(size=(40, 3))), rng.uniform(0.001, 0.2, 40), strict=True):
        seen = apparent_directions(
            stars,
            et_of_julian_year(year),
            observer_position_km=unit(rng.normal(size=3)) * OBSERVER_AU * AU_KM,
            observer_velocity_km_s=unit(rng.normal(size=3)) * 44.0,
        )
        inside = np.linalg.norm(seen - axis, axis=1) < 2.0 * np.sin(radius / 2.0)
        assert set(stars.ids[inside].tolist()) <= set(catalog.cone(axis, radius).ids.tolist())


def test_fast_stars_do_not_widen_the_cones_of_the_others(catalog: MemoryCatalog) -> None:
    assert catalog.index.slow_margin_rad <= FAST_RAD
    assert catalog.index.fast_margin_rad.min() > FAST_RAD
    assert 100 < catalog.index.fast_margin_rad.size < 2000


def test_barnards_star_is_in_a_cone_around_where_it_will_be_in_2100() -> None:
    barnard = replace(
        sky(3), ids=np.array([1, 2, 3]), ra_deg=np.array([269.4485, 10.0, 20.0]), dec_deg=np.array([4.7394, 0.0, 0.0]),
        pm_ra_mas_yr=np.array([-801.55, 0, 0]), pm_dec_mas_yr=np.array([10362.39, 0, 0]),
        parallax_mas=np.array([546.98, 0, 0]), radial_velocity_km_s=np.array([-110.1, 0, 0]),
    )  # fmt: skip
    catalog = MemoryCatalog(barnard, name="b", band="V", version="1")
    there = apparent_directions(barnard, et_of_julian_year(2100.0))[0]
    assert catalog.cone(there, 5.0 * RAD_PER_MAS).ids.tolist() == [1]


def test_stars_of_one_magnitude_come_in_the_same_order_in_every_cone(catalog: MemoryCatalog) -> None:
    axis = direction_from_radec(120.0, 30.0)
    wide = catalog.cone(axis, 0.4)
    narrow = catalog.cone(axis, 0.2)
    inside = np.isin(wide.ids, narrow.ids)
    assert wide.ids[inside].tolist() == narrow.ids.tolist()


def test_an_empty_table_is_a_catalog_without_stars() -> None:
    empty = MemoryCatalog(sky(5).select([]), name="none", band="V", version="1")
    assert len(empty.cone([0.0, 0.0, 1.0], 1.0)) == 0
    with pytest.raises(InputError):
        join_tables([])


# --- the file ----------------------------------------------------------------------------------------------------


@pytest.fixture
def file(catalog: MemoryCatalog, tmp_path: Path) -> Path:
    path = tmp_path / "made.stars"
    save_catalog(catalog, path, sources=[Source(name="made.csv", sha256="ab" * 32)])
    return path


def test_a_catalog_from_its_file_answers_as_the_one_in_memory(catalog: MemoryCatalog, file: Path) -> None:
    mapped = load_catalog(file)
    assert (mapped.name, mapped.band, mapped.version, len(mapped)) == ("made up", "V", "1", len(catalog))
    for place in PLACES:
        axis = direction_from_radec(*place)
        for limit in (None, 6.0):
            mine, its = (one.cone(axis, 0.15, max_magnitude=limit) for one in (catalog, mapped))
            assert mine.ids.tolist() == its.ids.tolist()
            for name in COLUMN_TYPES:
                np.testing.assert_allclose(getattr(its, name), getattr(mine, name), rtol=FLOAT32 / 5, atol=0)


def test_places_are_kept_with_all_their_digits(stars: StarTable, file: Path) -> None:
    kept = load_catalog(file).stars
    order, mine = np.argsort(kept.ids), np.argsort(stars.ids)
    for name in ("ra_deg", "dec_deg", "epoch_jyear"):
        assert (getattr(kept, name)[order] == getattr(stars, name)[mine]).all()


def test_columns_stay_in_the_file_until_they_are_asked_for(file: Path) -> None:
    columns = open_catalog(file).columns
    owner: object = columns["ra_deg"]
    while isinstance(owner, np.ndarray) and not isinstance(owner, np.memmap) and owner.base is not None:
        owner = owner.base
    assert isinstance(owner, np.memmap)
    assert columns["epoch_jyear"] == 2016.0  # one number for all stars takes no room


def test_the_header_tells_sources_and_its_hash_is_that_of_the_content(file: Path) -> None:
    header = catalog_header(file, check=True)
    assert header["sources"] == [{"name": "made.csv", "sha256": "ab" * 32}]
    assert header["count"] == 30_000


def test_the_same_stars_make_the_same_file_whatever_their_order(stars: StarTable, tmp_path: Path) -> None:
    shuffled = stars.select(np.random.default_rng(9).permutation(len(stars)))
    distinct = [replace(table, magnitude=table.ids.astype(np.float64) * 1e-4) for table in (stars, shuffled)]
    for name, table in zip("ab", distinct, strict=True):
        save_catalog(MemoryCatalog(table, name="x", band="V", version="1"), tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_flipped_bit_is_found_when_asked_for(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[-1000] ^= 1
    file.write_bytes(content)
    assert len(load_catalog(file)) == 30_000
    with pytest.raises(DataError, match="is damaged: sha256"):
        catalog_header(file, check=True)


def test_damaged_catalog_files_are_refused_with_a_remedy(file: Path) -> None:
    whole = file.read_bytes()
    length = int.from_bytes(whole[8:16], "little")
    header = json.loads(whole[16 : 16 + length])

    def with_header(**changes: object) -> bytes:
        text = json.dumps(header | changes).encode()
        return whole[:8] + len(text).to_bytes(8, "little") + text + whole[16 + length :]

    columns = header["columns"]
    for content in (
        whole[: len(whole) // 2],
        whole[:12],
        whole[:8] + (10**12).to_bytes(8, "little") + whole[16:],
        whole[:16] + b"[" + whole[17:],
        with_header(format=1),
        with_header(size=header["size"] + 1),
        with_header(columns=columns[1:], size=len(with_header(columns=columns[1:]))),
        with_header(columns=[columns[0] | {"offset": -64}, *columns[1:]]),
        with_header(columns=[columns[0] | {"shape": [10**9]}, *columns[1:]]),
        with_header(columns=[columns[0] | {"dtype": "|O"}, *columns[1:]]),
    ):
        file.write_bytes(content)
        with pytest.raises(DataError, match="catalog build") as caught:
            open_catalog(file)
        assert caught.value.path == file
    with pytest.raises(DataError, match="no such file"):
        open_catalog(file.with_name("missing.stars"))


def test_a_catalog_travels_to_another_process(file: Path) -> None:
    again = pickle.loads(pickle.dumps(open_catalog(file)))  # noqa: S301
    axis: Float = direction_from_radec(120.0, 30.0)
    assert again.cone(axis, 0.1).ids.tolist() == open_catalog(file).cone(axis, 0.1).ids.tolist()
