"""Two near stars from 47 au: how far parallax moves them in images of New Horizons.

Run with the folder that holds ``lorri/*.fits``, ``lorri_stars.csv`` and ``lorri_measured.csv``::

    python examples/new_horizons_parallax.py STARS_FOLDER

The frames hold too few catalog stars to solve, so that the attitude is that of the world coordinates in the header.
LORRI stores its rows from the bottom. The world coordinates were fitted to catalog places of stars: aberration is in
them, and is not applied again.
"""

from __future__ import annotations

import csv
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import giantlike as gl
from giantlike.catalogs import MemoryCatalog, apparent_directions, load_catalog
from giantlike.catalogs.readers import build_catalog, column_map
from giantlike.catalogs.table import join_tables
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector
from giantlike.core.frames import rotate
from giantlike.io.camera_sip import read_sip_camera
from giantlike.processing import NOT_A_STAR, detect_sources

COLUMNS = ("ra_deg", "dec_deg", "parallax_mas", "pm_ra_mas_yr", "pm_dec_mas_yr", "radial_velocity_km_s", "epoch_jyear")
MAGNITUDE = 11.0  # of both, roughly: the table does not say
SEARCH_PX = 3.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sighting:
    """One star in one frame; pixels of the image as stored, counted from 0."""

    file: str
    star: str
    measured_px: Float
    sigma_px: Float
    published_px: Float
    predicted_px: Float
    without_parallax_px: Float

    @property
    def parallax_sigmas(self) -> float:
        """Length of what is left of the parallax after the prediction, in sigmas of the measurement."""
        return float(np.linalg.norm((self.measured_px - self.predicted_px) / self.sigma_px))


def near_stars(table: Path) -> tuple[MemoryCatalog, dict[str, int]]:
    """The default catalog joined with the stars of a table, and their identifiers by name."""
    mapping = column_map([*(f"{column}={column}" for column in COLUMNS), f"magnitude={MAGNITUDE}"])
    near = build_catalog([table], "table", name="near", mapping=mapping).catalog.stars
    rows = csv.DictReader(table.read_text().splitlines())
    ids = {row["name"]: int(near.ids[np.argmin(np.abs(near.ra_deg - float(row["ra_deg"])))]) for row in rows}
    default = load_catalog("default")
    both = join_tables([default.stars, near])
    return MemoryCatalog(both, name="default and near", band=default.band, version="example"), ids


def sighting(path: Path, star: str, star_id: int, catalog: MemoryCatalog, published_px: Float) -> Sighting:
    """Measure a star in a frame and predict where it should be."""
    image = gl.Image.open(path, bottom_up=True)
    told = read_sip_camera(path)
    model = told.camera.model
    stars = catalog.stars.select(np.flatnonzero(catalog.stars.ids == star_id))
    assert image.et is not None
    assert image.observer is not None
    predicted, at_rest = (
        model.project(rotate(told.camera_from_inertial, directions))[0]
        for directions in (
            apparent_directions(stars, image.et, observer_position_km=image.observer.position_km),
            apparent_directions(stars, image.et),
        )
    )
    found = detect_sources(image.pixels, mask=image.mask, detector=Detector())
    assert not isinstance(found, gl.Failure), found.detail
    usable = (found.flags & int(NOT_A_STAR)) == 0
    distance = np.where(usable, np.linalg.norm(found.points_px - predicted, axis=1), np.inf)
    nearest = int(np.argmin(distance))
    if not distance[nearest] < SEARCH_PX:
        raise SystemExit(f"{path}: no source within {SEARCH_PX:g} px of the prediction for {star}")
    stored = np.array([0.0, image.rows - 1.0]), np.array([1.0, -1.0])
    return Sighting(
        file=path.name,
        star=star,
        measured_px=stored[0] + stored[1] * found.points_px[nearest],
        sigma_px=np.sqrt(np.diag(found.covariance_px2[nearest])),
        published_px=published_px,
        predicted_px=stored[0] + stored[1] * predicted,
        without_parallax_px=stored[0] + stored[1] * at_rest,
    )


def sightings(folder: Path) -> list[Sighting]:
    """All frames of the folder, against the published measurements."""
    catalog, ids = near_stars(folder / "lorri_stars.csv")
    found = []
    for row in csv.DictReader((folder / "lorri_measured.csv").read_text().splitlines()):
        published_px = np.array([float(row["x_px"]), float(row["y_px"])])
        found.append(sighting(folder / row["file"], row["star"], ids[row["star"]], catalog, published_px))
    return found


def main() -> None:
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    heads = ("measured, px", "- published", "- predicted", "parallax, px", "sigmas")
    print(f"{'frame':<34}{'star':<13}{heads[0]:>20}{heads[1]:>16}{heads[2]:>16}{heads[3]:>15}{heads[4]:>8}")
    for one in sightings(Path(sys.argv[1])):
        moved = float(np.linalg.norm(one.predicted_px - one.without_parallax_px))
        cells = (one.measured_px, one.measured_px - one.published_px, one.measured_px - one.predicted_px)
        first, second, third = (f"{x:.3f}, {y:.3f}" for x, y in cells)
        print(
            f"{one.file:<34}{one.star:<13}{first:>20}{second:>16}{third:>16}{moved:>15.2f}{one.parallax_sigmas:>8.1f}"
        )


if __name__ == "__main__":
    main()
