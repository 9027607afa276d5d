"""``giantlike catalog build``, ``join``, ``query`` and ``info``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from giantlike._system.reading import file_sha256
from giantlike.catalogs import apparent_directions, load_catalog, proper_names
from giantlike.catalogs.catalog import MemoryCatalog
from giantlike.catalogs.join import join_catalogs
from giantlike.catalogs.readers import FORMATS, build_catalog, column_map
from giantlike.catalogs.stored import SUFFIX, Source, catalog_header, is_catalog_file, save_catalog
from giantlike.catalogs.table import StarTable, et_of_julian_year
from giantlike.cli.arguments import Json, Overwrite
from giantlike.cli.outcome import ExitCode, rows_of, show_result
from giantlike.cli.progress import progress_bar
from giantlike.core.arrays import Float, finite_or_none, require
from giantlike.core.errors import InputError
from giantlike.core.frames import direction_from_radec, radec_from_direction
from giantlike.core.units import RAD_PER_DEG

_SHOWN = 40  # number of stars listed by default


Catalog = Annotated[str, typer.Argument(metavar="CATALOG", help="default, a built catalog, or a CSV catalog.")]
Name = Annotated[str | None, typer.Option(help="Name of the catalog; default: that of the output file.")]


def build(
    paths: Annotated[
        list[Path], typer.Argument(metavar="SOURCE... OUTPUT", help="Published files, then the new catalog (.stars).")
    ],
    form: Annotated[str, typer.Option("--format", help=f"Format of the source files: {', '.join(FORMATS)}.")],
    column: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=COLUMN", help="For tables: a column, such as ra_deg=RAJ2000; repeatable."),
    ] = None,
    columns: Annotated[
        Path | None, typer.Option(metavar="COLUMNS.toml", help="For tables: the same from a file.")
    ] = None,
    band: Annotated[str | None, typer.Option(metavar="BAND", help="For tables: band of the magnitudes.")] = None,
    name: Name = None,
    max_magnitude: Annotated[float | None, typer.Option(help="Leave out fainter stars.")] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> ExitCode:
    """Make one catalog of published files.

    hipparcos: hip_main.dat or hip2.dat. tycho2: tyc2.dat and suppl_1.dat. ucac4: zone files or their folder.
    usno-gnc: its CSV file. gaia: extracts of the archive in CSV, ECSV, FITS, Parquet or VOTable. table: any table in
    one of these, with --column for names that differ; NAME=COLUMN*FACTOR changes the unit, NAME=NUMBER is a constant.
    """
    require(
        len(paths) >= 2, "SOURCE... OUTPUT are needed: at least one published file, and the new catalog as the last"
    )
    *sources, target = paths
    _target(target, overwrite)
    if form != "table" and (column or columns is not None or band is not None):
        raise InputError("--column, --columns and --band are for --format table")
    mapping = column_map(column or [], file=columns, band=band) if form == "table" else None
    with progress_bar() as show:
        built = build_catalog(
            sources,
            form,
            name=name or target.stem,
            mapping=mapping,
            max_magnitude=max_magnitude,
            progress=partial(show, "reading"),
        )
        save_catalog(built.catalog, target, sources=built.sources)
    shown = _written(target, built.catalog) | {"left_out": built.left_out, "repeated": built.repeated}
    lines = [f"wrote {target}: {len(built.catalog)} stars, magnitudes in {built.catalog.band}"]
    if built.left_out:
        lines.append(f"left out {built.left_out} entries without a place or a magnitude")
    if built.repeated:
        lines.append(f"left out {built.repeated} entries whose identifier an earlier one has")
    return show_result(shown, lines, json=json)


def join(
    names: Annotated[
        list[str],
        typer.Argument(metavar="CATALOG... OUTPUT", help="default, built or CSV catalogs, then the new one (.stars)."),
    ],
    name: Name = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> ExitCode:
    """Put catalogs together, such as your own stars on top of the default.

    Where two have the same star, within 3 arcsec, the later one has it. Magnitudes are in the band of the first.
    """
    require(len(names) >= 2, "CATALOG... OUTPUT are needed: at least one catalog, and the new one as the last")
    target = _target(Path(names[-1]), overwrite)
    catalogs = [load_catalog(one) for one in names[:-1]]
    made = join_catalogs(catalogs, name=name or target.stem)
    sources = [source for one in names[:-1] for source in _sources(one)]
    save_catalog(made, target, sources=sources)
    shown = _written(target, made) | {"replaced": sum(len(one) for one in catalogs) - len(made)}
    return show_result(shown, f"wrote {target}: {len(made)} stars, magnitudes in {made.band}", json=json)


def query(
    name: Catalog,
    ra: Annotated[float, typer.Option(metavar="DEG", help="Right ascension, ICRS.")],
    dec: Annotated[float, typer.Option(metavar="DEG", help="Declination, ICRS.")],
    radius: Annotated[float, typer.Option(metavar="DEG", help="Radius of the cone.")],
    max_magnitude: Annotated[float | None, typer.Option(help="Faintest star.")] = None,
    epoch: Annotated[
        float | None, typer.Option(metavar="YEAR", help="Julian year to move stars to, seen from the barycenter.")
    ] = None,
    band: Annotated[str | None, typer.Option(metavar="BAND", help="Give magnitudes in this band: G or V.")] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Show so many, the brightest.")] = None,
    json: Json = False,
) -> ExitCode:
    """List the stars of a cone at an epoch, brightest first; by default at their catalog epochs."""
    require(0.0 < radius <= 180.0, f"--radius must be in (0, 180] degrees, got {radius:g}")
    require(-90.0 <= dec <= 90.0, f"--dec must be in [-90, 90] degrees, got {dec:g}")
    catalog = load_catalog(name, band=band)
    axis = direction_from_radec(ra, dec)
    stars = catalog.cone(axis, radius * RAD_PER_DEG, max_magnitude=max_magnitude)
    if epoch is None:
        directions = direction_from_radec(stars.ra_deg, stars.dec_deg)
    else:
        directions = apparent_directions(stars, et_of_julian_year(epoch))
    distance_deg = 2.0 * np.degrees(np.arcsin(np.minimum(np.linalg.norm(directions - axis, axis=-1) / 2.0, 1.0)))
    inside = np.flatnonzero(distance_deg <= radius)
    shown = inside[: limit if json else limit or _SHOWN]
    rows = _rows(stars.select(shown), directions[shown], distance_deg[shown], epoch)
    lines = [f"{len(inside)} stars in {catalog.name}, magnitudes in {catalog.band}"]
    if rows:
        lines.append(f"{'id':>20} {'ra_deg':>14} {'dec_deg':>14} {'mag':>7} {'distance_deg':>12}  double  name")
    lines += [
        f"{row['id']:>20} {row['ra_deg']:>14.8f} {row['dec_deg']:>14.8f} {row['magnitude']:>7.3f} "
        f"{row['distance_deg']:>12.6f}  {'yes' if row['is_double'] else '':6}  {row['name']}".rstrip()
        for row in rows
    ]
    if limit is None and len(inside) > _SHOWN:
        lines.append(f"... and {len(inside) - _SHOWN} fainter ones: give --limit or --json")
    return show_result(rows, lines, json=json)


def info(
    name: Catalog,
    check: Annotated[bool, typer.Option("--check", help="Read all of a built catalog and compare its hash.")] = False,
    json: Json = False,
) -> ExitCode:
    """Show the contents and sources of a catalog."""
    catalog = load_catalog(name)
    magnitude, epoch = catalog.column("magnitude"), catalog.column("epoch_jyear")
    moving = (catalog.column("pm_ra_mas_yr") != 0.0) | (catalog.column("pm_dec_mas_yr") != 0.0)
    colored = np.isfinite(catalog.column("color_bv")) | np.isfinite(catalog.column("color_bp_rp"))
    shown: dict[str, Any] = {
        "catalog": name,
        "name": catalog.name,
        "version": catalog.version,
        "stars": len(catalog),
        "band": catalog.band,
        "magnitudes": [float(magnitude.min()), float(np.median(magnitude)), float(magnitude.max())],
        "epochs": [float(epoch.min()), float(epoch.max())],
        "with_proper_motion": int(moving.sum()),
        "with_parallax": int((catalog.column("parallax_mas") > 0.0).sum()),
        "with_radial_velocity": int((catalog.column("radial_velocity_km_s") != 0.0).sum()),
        "with_color": int(colored.sum()),
        "doubles": int(catalog.column("is_double").sum()),
        "sources": [],
        "checked": False,
    }
    path = Path(name)
    if name != "default" and is_catalog_file(path):
        shown |= {"sources": catalog_header(path, check=check)["sources"], "checked": check}
    elif check:
        raise InputError(f"{name}: only built catalogs have a hash to check")
    lines = [f"{key.replace('_', ' '):<22}{_text(value)}" for key, value in shown.items() if key != "sources"]
    lines += [f"{'source':<22}{source['name']} sha256:{source['sha256']}" for source in shown["sources"]]
    return show_result(shown, lines, json=json)


def _target(path: Path, overwrite: bool) -> Path:
    """The path of a new catalog, which must be called so and not be there."""
    require(path.suffix == SUFFIX, f"{path}: the last name is that of the new catalog and must end in {SUFFIX}")
    require(overwrite or not path.exists(), f"{path} exists: give --overwrite to replace it")
    return path


def _written(target: Path, catalog: MemoryCatalog) -> dict[str, Any]:
    return {"file": str(target), "stars": len(catalog), "band": catalog.band, "version": catalog.version}


def _sources(name: str) -> list[Source]:
    """Return the sources of a catalog file, or the file itself; none for the default, whose version names them."""
    path = Path(name)
    if name == "default":
        return []
    if is_catalog_file(path):
        return [Source(**source) for source in catalog_header(path)["sources"]]
    return [Source(name=path.name, sha256=file_sha256(path))]


def _rows(stars: StarTable, directions: Float, distance_deg: Float, epoch: float | None) -> list[dict[str, Any]]:
    """One object of the JSON list for each star; unknown values are None."""
    ra, dec = radec_from_direction(directions)
    measured = ("magnitude", "pm_ra_mas_yr", "pm_dec_mas_yr", "parallax_mas", "radial_velocity_km_s")
    colors = ("color_bv", "color_bp_rp")
    return rows_of(
        {
            "id": [str(number) for number in stars.ids.tolist()],
            "name": list(proper_names(stars)),
            "ra_deg": ra.tolist(),
            "dec_deg": dec.tolist(),
            "epoch_jyear": stars.epoch_jyear.tolist() if epoch is None else [epoch] * len(stars),
            **{key: getattr(stars, key).tolist() for key in measured},
            **{key: [finite_or_none(color) for color in getattr(stars, key).tolist()] for key in colors},
            "is_double": stars.is_double.tolist(),
            "distance_deg": distance_deg.tolist(),
        }
    )


def _text(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(f"{number:g}" for number in value)
    return str(value)
