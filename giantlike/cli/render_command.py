"""``giantlike render``."""

from __future__ import annotations

from pathlib import Path

import typer

from giantlike.campaign.render.plan import RenderPlan
from giantlike.campaign.render.run import RenderedImage, render_images
from giantlike.cli.outcome import ExitCode, print_json, say
from giantlike.cli.progress import progress_bar


def render_command(path: Path, *, output: Path | None, overwrite: bool, json: bool) -> ExitCode:
    """Render the images of a scene file."""
    plan = RenderPlan.load(path)
    for warning in plan.warnings:
        say(f"giantlike: {warning}")
    with progress_bar() as progress:
        images = render_images(plan, output, overwrite=overwrite, progress=progress)
    if json:
        print_json([_fields(image) for image in images])
    else:
        for image in images:
            typer.echo(_line(image))
    return ExitCode.DONE


def _fields(image: RenderedImage) -> dict[str, object]:
    return {
        "file": str(image.path),
        "targets": image.targets,
        "stars": image.stars,
        "peak_dn": image.peak_dn,
        "background_dn": image.background_dn,
        "saturated_px": image.saturated_px,
        "cosmic_px": image.cosmic_px,
        "time_s": round(image.time_s, 3),
    }


def _line(image: RenderedImage) -> str:
    places = "".join(f", {name} at ({x:.1f}, {y:.1f})" for name, (x, y) in image.targets.items())
    light = f"peak {image.peak_dn:.0f} DN, {image.saturated_px} px saturated"
    return f"{image.path}: {image.stars} stars{places}; {light} ({image.time_s:.1f} s)"
