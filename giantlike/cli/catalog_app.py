"""``giantlike catalog``: the arguments of its commands; what they need is imported when they run."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from giantlike.cli.outcome import ExitCode, command

catalog_app = typer.Typer(
    name="catalog",
    help="Build star catalogs from published files, look into them, and ask them for stars.",
    no_args_is_help=True,
    epilog="Exit codes: 0 done, 2 bad input, 130 interrupted.",
)


class Format(StrEnum):
    """Form of the source files."""

    HIPPARCOS = "hipparcos"
    TYCHO2 = "tycho2"
    UCAC4 = "ucac4"
    USNO_GNC = "usno-gnc"
    GAIA = "gaia"
    TABLE = "table"


Catalog = Annotated[str, typer.Argument(metavar="CATALOG", help="default, a built catalog, or a CSV catalog.")]
Json = Annotated[bool, typer.Option("--json", help="Write JSON to stdout, for machines.")]
BandOption = Annotated[str | None, typer.Option(metavar="BAND", help="Give magnitudes in this band: G or V.")]


@catalog_app.command("build")
@command
def build(
    paths: Annotated[
        list[Path], typer.Argument(metavar="SOURCE... OUTPUT", help="Published files, then the new catalog (.stars).")
    ],
    form: Annotated[Format, typer.Option("--format", help="Form of the source files.")],
    column: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=COLUMN", help="For tables: which column is what, such as ra_deg=RAJ2000; repeatable."
        ),
    ] = None,
    columns: Annotated[
        Path | None, typer.Option(metavar="COLUMNS.toml", help="For tables: the same from a file.")
    ] = None,
    band: Annotated[str | None, typer.Option(metavar="BAND", help="For tables: band of the magnitudes.")] = None,
    name: Annotated[str | None, typer.Option(help="What to call the catalog; default: name of the output.")] = None,
    max_magnitude: Annotated[float | None, typer.Option(help="Leave out fainter stars.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUTPUT where it exists.")] = False,
    json: Json = False,
) -> ExitCode:
    """Make one catalog of published files.

    hipparcos: hip_main.dat or hip2.dat. tycho2: tyc2.dat and suppl_1.dat. ucac4: zone files or their folder.
    usno-gnc: its CSV file. gaia: extracts of the archive in CSV, ECSV, FITS, Parquet or VOTable. table: any table in
    one of these, with --column for names that differ; NAME=COLUMN*FACTOR changes the unit, NAME=NUMBER is a constant.
    """
    from giantlike.cli.catalog_command import catalog_build

    return catalog_build(
        paths,
        form=form.value,
        settings=column or [],
        columns=columns,
        band=band,
        name=name,
        max_magnitude=max_magnitude,
        overwrite=overwrite,
        json=json,
    )


@catalog_app.command("join")
@command
def join(
    catalogs: Annotated[
        list[str],
        typer.Argument(metavar="CATALOG... OUTPUT", help="default, built or CSV catalogs, then the new one (.stars)."),
    ],
    name: Annotated[str | None, typer.Option(help="What to call the catalog; default: name of the output.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUTPUT where it exists.")] = False,
    json: Json = False,
) -> ExitCode:
    """Put catalogs together, such as stars of one's own on top of the default.

    Where two have the same star, within 3 arcsec, the later one has it. Magnitudes are in the band of the first.
    """
    from giantlike.cli.catalog_command import catalog_join

    return catalog_join(catalogs, name=name, overwrite=overwrite, json=json)


@catalog_app.command("query")
@command
def query(
    catalog: Catalog,
    ra: Annotated[float, typer.Option(metavar="DEG", help="Right ascension, ICRS.")],
    dec: Annotated[float, typer.Option(metavar="DEG", help="Declination, ICRS.")],
    radius: Annotated[float, typer.Option(metavar="DEG", help="Radius of the cone.")],
    max_magnitude: Annotated[float | None, typer.Option(help="Faintest star.")] = None,
    epoch: Annotated[
        float | None,
        typer.Option(metavar="YEAR", help="Julian year to move stars to, seen from the barycenter."),
    ] = None,
    band: BandOption = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Show so many, the brightest.")] = None,
    json: Json = False,
) -> ExitCode:
    """List the stars of a cone, brightest first."""
    from giantlike.cli.catalog_command import catalog_query

    return catalog_query(
        catalog,
        ra_deg=ra,
        dec_deg=dec,
        radius_deg=radius,
        max_magnitude=max_magnitude,
        epoch=epoch,
        band=band,
        limit=limit,
        json=json,
    )


@catalog_app.command("info")
@command
def info(
    catalog: Catalog,
    check: Annotated[bool, typer.Option("--check", help="Read all of a built catalog and compare its hash.")] = False,
    json: Json = False,
) -> ExitCode:
    """Say what a catalog holds and what it was made of."""
    from giantlike.cli.catalog_command import catalog_info

    return catalog_info(catalog, check=check, json=json)
