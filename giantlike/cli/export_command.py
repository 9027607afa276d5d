"""``giantlike export``: attitudes of a run for other programs."""

from __future__ import annotations

from pathlib import Path

import typer

from giantlike.campaign.export import ExportFormat, ExportOptions, export_run
from giantlike.cli.outcome import ExitCode, print_json


def export_command(
    folder: Path, output: Path | None, format_name: str, options: ExportOptions, *, json: bool
) -> ExitCode:
    """Write the attitudes of a run folder."""
    kind = ExportFormat(format_name)
    suffix = {ExportFormat.CK: "bc", ExportFormat.WCS: "wcs"}.get(kind, str(kind))
    exported = export_run(folder, output or folder / f"attitudes_export.{suffix}", kind, options)
    if json:
        print_json(
            {
                "format": str(kind),
                "files": [str(file) for file in exported.files],
                "n_attitudes": exported.n_attitudes,
                "left_out": dict(exported.left_out),
            }
        )
        return ExitCode.DONE
    for file in exported.files[:10]:
        typer.echo(f"wrote {file}")
    if len(exported.files) > 10:
        typer.echo(f"and {len(exported.files) - 10} more")
    skipped = "".join(f"; left out: {count} {reason}" for reason, count in exported.left_out.items())
    typer.echo(f"{exported.n_attitudes} attitudes{skipped}")
    return ExitCode.DONE
