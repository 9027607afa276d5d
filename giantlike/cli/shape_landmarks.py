"""``giantlike shape landmarks``: a catalog of landmarks chosen on a shape model, or collected from maplets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from giantlike.cli.arguments import Json, Overwrite, Units, UnitsOption
from giantlike.cli.outcome import ExitCode, show_result
from giantlike.cli.shape_commands import units_said
from giantlike.core.arrays import require
from giantlike.relative.landmarks.selection import LandmarkBuildOptions, build_landmarks
from giantlike.shapes import load_shape
from giantlike.shapes.landmarks import MAPLET_SUFFIX, load_landmarks, save_landmarks


def landmarks(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Shape file, SPC maplet (.MAP) or folder of maplets.")],
    target: Annotated[Path, typer.Argument(metavar="OUT.npz", help="New catalog of landmarks.")],
    units: UnitsOption = Units.KM,
    count: Annotated[int | None, typer.Option(metavar="N", help="Largest number of landmarks.  [default: 150]")] = None,
    size_km: Annotated[
        float | None, typer.Option(metavar="KM", help="Side of a landmark.  [default: a fifth of the mean radius]")
    ] = None,
    samples: Annotated[
        int | None, typer.Option(metavar="N", help="Heights along each side of a landmark.  [default: 33]")
    ] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> ExitCode:
    """Choose landmarks for surface_features: positions with strong relief or albedo, distributed over the shape."""
    given = {"count": count, "size_km": size_km, "samples": samples}
    chosen = {name: value for name, value in given.items() if value is not None}
    if source.is_dir() or source.suffix.lower() == MAPLET_SUFFIX:
        require(not chosen, f"{source}: maplets are taken as they are, leave out --count, --size-km and --samples")
        catalog = load_landmarks(source)
    else:
        with units_said():
            mesh = load_shape(source, units=units)
        catalog = build_landmarks(mesh, LandmarkBuildOptions(**chosen))  # type: ignore[arg-type]
    save_landmarks(catalog, target, overwrite=overwrite)
    sizes = np.array([landmark.size_km for landmark in catalog.landmarks])
    texture = np.array([landmark.texture for landmark in catalog.landmarks])
    summary = {
        "file": str(target),
        "landmarks": len(catalog),
        "body_name": catalog.body_name,
        "shape_sha256": catalog.shape_sha256,
        "size_km": [float(sizes.min()), float(sizes.max())],
        "texture": [float(texture.min()), float(np.median(texture)), float(texture.max())],
        "sha256": catalog.sha256,
    }
    lines = [
        f"texture {texture.min():.3f} to {texture.max():.3f}, median {np.median(texture):.3f} (rad of tilt)",
        f"wrote {target}: {len(catalog)} landmarks of {sizes.min():.4g} to {sizes.max():.4g} km",
    ]
    return show_result(summary, lines, json=json)
