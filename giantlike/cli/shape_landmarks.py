"""``giantlike shape landmarks``: a catalog of landmarks chosen on a shape model, or collected from maplets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import typer

from giantlike.cli.outcome import ExitCode, print_json
from giantlike.cli.shape_command import units_said
from giantlike.core.errors import InputError
from giantlike.relative.landmarks.selection import LandmarkBuildOptions, build_landmarks
from giantlike.shapes import load_shape
from giantlike.shapes.landmarks import MAPLET_SUFFIX, LandmarkCatalog, load_landmarks, save_landmarks


def shape_landmarks(
    source: Path,
    target: Path,
    *,
    units: str,
    count: int | None,
    size_km: float | None,
    samples: int | None,
    overwrite: bool,
    json: bool,
) -> ExitCode:
    """Choose landmarks on a shape, or collect maplets, and write them."""
    given = {"count": count, "size_km": size_km, "samples": samples}
    chosen = {name: value for name, value in given.items() if value is not None}
    if source.is_dir() or source.suffix.lower() == MAPLET_SUFFIX:
        if chosen:
            raise InputError(f"{source}: maplets are taken as they are, leave out --count, --size-km and --samples")
        catalog = load_landmarks(source)
    else:
        with units_said():
            mesh = load_shape(source, units=units)
        catalog = build_landmarks(mesh, LandmarkBuildOptions(**chosen))  # type: ignore[arg-type]
    save_landmarks(catalog, target, overwrite=overwrite)
    _show(catalog, target, json=json)
    return ExitCode.DONE


def _show(catalog: LandmarkCatalog, target: Path, *, json: bool) -> None:
    sizes = np.array([landmark.size_km for landmark in catalog.landmarks])
    texture = np.array([landmark.texture for landmark in catalog.landmarks])
    if json:
        print_json(
            {
                "file": str(target),
                "landmarks": len(catalog),
                "body_name": catalog.body_name,
                "shape_sha256": catalog.shape_sha256,
                "size_km": [float(sizes.min()), float(sizes.max())],
                "texture": [float(texture.min()), float(np.median(texture)), float(texture.max())],
                "sha256": catalog.sha256,
            }
        )
        return
    typer.echo(f"texture {texture.min():.3f} to {texture.max():.3f}, median {np.median(texture):.3f} (rad of tilt)")
    typer.echo(f"wrote {target}: {len(catalog)} landmarks of {sizes.min():.4g} to {sizes.max():.4g} km")
