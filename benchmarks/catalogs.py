"""Speed and completeness of star catalogs; prints JSON.

Run with ``OMP_NUM_THREADS=1 python benchmarks/catalogs.py [--stars N] [--quick]`` (a minute). A synthetic sky of 2.5
million stars, twice as dense in the plane of the galaxy and ten times as many of them 2.2 magnitudes fainter, about as
Tycho-2 has them, is written into a catalog file and asked for cones in random directions. ``cpu_ms`` is processor
time of a whole ``cone`` call, which returns all columns, brightest first: the median over directions, each asked a
second time, so that the pages of the file are in memory. The reference finds the same stars with scipy's ``cKDTree``
(of two million nodes, in memory) and then gathers and sorts the same columns. Completeness: stars whose apparent
place is in the cone, after up to 125 years and from up to 100 au, and that ``cone`` does not return. Astrometry is
compared with ERFA's ``pmsafe`` and ``ldsun``.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import erfa
import numpy as np
from scipy.spatial import cKDTree

from giantlike.catalogs import MemoryCatalog, StarTable, apparent_directions
from giantlike.catalogs.astrometry import deflect_light
from giantlike.catalogs.stored import catalog_header, open_catalog, save_catalog
from giantlike.catalogs.table import et_of_julian_year
from giantlike.core.arrays import Float, unit
from giantlike.core.frames import direction_from_radec
from giantlike.core.units import AU_KM, RAD_PER_MAS

CONES = ((4.0, None), (4.0, 9.0), (20.0, None), (20.0, 9.0))
"""Radius in degrees, and faintest magnitude."""
TARGET_MS = {4.0: 3.0, 20.0: 10.0}


def synthetic_sky(count: int) -> StarTable:
    """Stars as in an all-sky survey to magnitude 11.5: the numbers grow tenfold in 2.2 magnitudes."""
    rng = np.random.default_rng(1)
    sine = rng.uniform(-1.0, 1.0, 2 * count)
    latitude = np.arcsin(sine)
    dense = rng.random(2 * count) < np.where(np.abs(latitude) < 0.35, 1.0, 0.5)  # toward the plane of the galaxy
    dec = np.degrees(latitude[dense][:count])
    parallax = np.where(rng.random(count) < 1e-3, rng.uniform(20.0, 300.0, count), rng.exponential(2.5, count))
    speed_km_s = rng.normal(0.0, 30.0, (3, count))
    return StarTable(
        ids=np.arange(count) + 1,
        ra_deg=rng.uniform(0.0, 360.0, count),
        dec_deg=dec,
        pm_ra_mas_yr=speed_km_s[0] * parallax / 4.74,
        pm_dec_mas_yr=speed_km_s[1] * parallax / 4.74,
        parallax_mas=parallax,
        radial_velocity_km_s=np.where(rng.random(count) < 0.1, speed_km_s[2], 0.0),
        epoch_jyear=np.full(count, 2016.0),
        magnitude=11.5 + 2.2 * np.log10(rng.uniform(1e-7, 1.0, count)),
        color_bv=np.full(count, np.nan),
        sigma_mas=rng.uniform(0.01, 0.5, count),
        sigma_pm_mas_yr=rng.uniform(0.01, 0.5, count),
        color_bp_rp=rng.normal(1.0, 0.4, count),
        is_double=rng.random(count) < 0.03,
    )


def cpu_ms(call: Callable[[], object]) -> float:
    """Return the processor time of the second of two calls."""
    call()
    start = time.process_time()
    call()
    return (time.process_time() - start) * 1e3


def with_tree(tree: cKDTree, stars: StarTable, axis: Float, radius: float, faintest: float | None) -> StarTable:
    """Return the same stars as a cone, without its margins."""
    found = np.array(tree.query_ball_point(axis, 2.0 * np.sin(radius / 2.0)), dtype=np.intp)
    if faintest is not None:
        found = found[stars.magnitude[found] <= faintest]
    return stars.select(found[np.argsort(stars.magnitude[found])])


def speed(catalog: MemoryCatalog, stars: StarTable, directions: int) -> list[dict[str, Any]]:
    tree = cKDTree(direction_from_radec(stars.ra_deg, stars.dec_deg))
    axes = unit(np.random.default_rng(2).normal(size=(directions, 3)))
    rows = []
    for radius_deg, faintest in CONES:
        radius = np.radians(radius_deg)
        times = [
            (
                cpu_ms(partial(catalog.cone, axis, radius, max_magnitude=faintest)),
                cpu_ms(partial(with_tree, tree, stars, axis, radius, faintest)),
                len(catalog.cone(axis, radius, max_magnitude=faintest)),
            )
            for axis in axes
        ]
        ours, other, found = np.median(times, axis=0)
        rows.append(
            {
                "radius_deg": radius_deg,
                "max_magnitude": faintest,
                "stars": int(found),
                "cpu_ms": round(float(ours), 2),
                "cpu_ms_worst": round(float(np.max(times, axis=0)[0]), 2),
                "target_ms": TARGET_MS[radius_deg],
                "ckdtree_cpu_ms": round(float(other), 2),
            }
        )
    return rows


def completeness(catalog: MemoryCatalog, stars: StarTable, directions: int) -> dict[str, Any]:
    """Count stars that brute force finds in cones and the catalog does not."""
    rng = np.random.default_rng(3)
    missed, found = 0, 0
    for year in (1891.0, 2016.0, 2141.0):
        seen = apparent_directions(
            stars,
            et_of_julian_year(year),
            observer_position_km=unit(rng.normal(size=3)) * 100.0 * AU_KM,
            observer_velocity_km_s=unit(rng.normal(size=3)) * 44.0,
        )
        for axis, radius in zip(
            unit(rng.normal(size=(directions, 3))), rng.uniform(0.001, 0.3, directions), strict=True
        ):
            inside = stars.ids[np.linalg.norm(seen - axis, axis=1) <= 2.0 * np.sin(radius / 2.0)]
            missed += int((~np.isin(inside, catalog.cone(axis, radius).ids)).sum())
            found += len(inside)
    return {"cones": 3 * directions, "stars_by_brute_force": found, "missed": missed}


def astrometry() -> dict[str, float]:
    """Largest differences from ERFA, mas."""
    rng = np.random.default_rng(4)
    count = 20_000
    fast = synthetic_sky(count)
    stars = StarTable(
        **{name: getattr(fast, name) for name in ("ids", "ra_deg", "dec_deg", "epoch_jyear", "magnitude", "color_bv")},
        pm_ra_mas_yr=rng.normal(0.0, 1500.0, count),
        pm_dec_mas_yr=rng.normal(0.0, 1500.0, count),
        parallax_mas=rng.uniform(1.0, 750.0, count),
        radial_velocity_km_s=rng.normal(0.0, 100.0, count),
        sigma_mas=np.zeros(count),
        sigma_pm_mas_yr=np.zeros(count),
    )
    ra, dec = np.radians(stars.ra_deg), np.radians(stars.dec_deg)
    worst: dict[str, float] = {}
    for year in (1900.0, 2000.0, 2100.0):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", erfa.ErfaWarning)
            moved = erfa.pmsafe(
                ra, dec, stars.pm_ra_mas_yr * RAD_PER_MAS / np.cos(dec), stars.pm_dec_mas_yr * RAD_PER_MAS,
                stars.parallax_mas / 1e3, stars.radial_velocity_km_s, 2451545.0, 16.0 * 365.25,
                2451545.0, (year - 2000.0) * 365.25,
            )  # fmt: skip
        expected = direction_from_radec(np.degrees(moved[0]), np.degrees(moved[1]))
        away = np.linalg.norm(apparent_directions(stars, et_of_julian_year(year)) - expected, axis=1)
        worst[f"pmsafe_{year:.0f}_mas"] = float(f"{away.max() / RAD_PER_MAS:.2g}")
    directions, from_sun = unit(rng.normal(size=(count, 3))), unit(rng.normal(size=3))
    bent = deflect_light(directions, from_sun * AU_KM) - unit(erfa.ldsun(directions, from_sun, 1.0))
    worst["ldsun_mas"] = float(f"{np.abs(bent).max() / RAD_PER_MAS:.2g}")
    start = time.process_time()
    apparent_directions(stars, 1e9, observer_position_km=[1e8, 0, 0], observer_velocity_km_s=[0, 30, 0])
    worst["apparent_us_per_star"] = round((time.process_time() - start) / count * 1e6, 2)
    return worst


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stars", type=int, default=2_500_000)
    parser.add_argument("--quick", action="store_true", help="a tenth of the directions")
    arguments = parser.parse_args()
    directions = 10 if arguments.quick else 100
    stars = synthetic_sky(arguments.stars)
    start = time.process_time()
    catalog = MemoryCatalog(stars, name="synthetic", band="V", version="1")
    sorted_s = time.process_time() - start
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "synthetic.stars"
        save_catalog(catalog, path)
        start = time.process_time()
        mapped = open_catalog(path)
        opened_ms = (time.process_time() - start) * 1e3
        start = time.process_time()
        catalog_header(path, check=True)
        result = {
            "stars": len(stars),
            "fast_stars_kept_apart": int(mapped.index.fast_margin_rad.size),
            "file_mb": round(path.stat().st_size / 1e6, 1),
            "threads": os.environ.get("OMP_NUM_THREADS", "default"),
            "sort_cpu_s": round(sorted_s, 2),
            "open_cpu_ms": round(opened_ms, 2),
            "hash_cpu_s": round(time.process_time() - start, 2),
            "cones": speed(mapped, stars, directions),
            "completeness": completeness(mapped, stars, max(directions // 10, 3)),
            "astrometry": astrometry(),
        }
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
