"""``giantlike interlock``: the rotation between two sensors."""

from __future__ import annotations

from pathlib import Path

import typer

from giantlike.campaign.interlock import interlock_of, write_interlock
from giantlike.cli.outcome import ExitCode, print_json


def interlock_command(first: Path, second: Path, output: Path, *, tolerance_s: float, json: bool) -> ExitCode:
    """Estimate the interlock, write it with its pairs, and show it."""
    result = interlock_of(first, second, tolerance_s=tolerance_s)
    files = write_interlock(result, output)
    summary = result.summary()
    if json:
        print_json(summary | {"files": [str(file) for file in files]})
        return ExitCode.DONE
    sigma, scatter = summary["sigma_arcsec"], summary["scatter_arcsec"]
    typer.echo(f"{summary['n_used']} of {summary['n_pairs']} pairs used; {summary['n_unpaired']} attitudes unpaired")
    typer.echo(f"angle of the rotation {summary['rotation_angle_deg']:.6f} deg, between boresights "
               f"{summary['boresight_angle_deg']:.6f} deg")  # fmt: skip
    typer.echo("second_from_first (x, y, z, w): " + ", ".join(f"{q:.9f}" for q in summary["second_from_first_xyzw"]))
    for axis in sigma:
        spread = "unknown" if scatter[axis] is None else f"{scatter[axis]:.3g} arcsec"
        typer.echo(f"about {axis}: sigma of the mean {sigma[axis]:.3g} arcsec, scatter of the pairs {spread}")
    typer.echo(f"reduced chi-square {summary['reduced_chi2']:.3g}; wrote {', '.join(str(file) for file in files)}")
    return ExitCode.DONE
