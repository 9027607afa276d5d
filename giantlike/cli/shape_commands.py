"""``giantlike shape info``, ``convert`` and ``decimate``."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, fields
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
import typer

from giantlike.cli.arguments import Json, Overwrite, Units, UnitsOption
from giantlike.cli.outcome import ExitCode, Results, say, show_result, show_results
from giantlike.core.errors import InputError, OpNavError
from giantlike.shapes import TriangleMesh, load_shape, save_shape
from giantlike.shapes.decimate import decimate_mesh, deviation
from giantlike.shapes.defects import defects_of
from giantlike.shapes.files.dsk import DskIdentity
from giantlike.shapes.load import UnitsWarning, mesh_of, read_surface
from giantlike.shapes.measure import Measures, measure_mesh
from giantlike.shapes.repair import repair_surface
from giantlike.shapes.save import keeps_albedo

_KEYS = MappingProxyType(
    dict.fromkeys([field.name for field in fields(Measures)] + ["watertight", "defects", "sha256"])
)
_SHOWN = MappingProxyType(
    {
        "extents_km": "extents x, y, z (km)",
        "volume_km3": "volume (km^3)",
        "area_km2": "area (km^2)",
        "center_of_figure_km": "center of figure (km)",
        "best_fit_radii_km": "best-fit ellipsoid radii (km)",
        "principal_moments": "principal moments, density 1 (km^5)",
        "circumscribing_radius_km": "circumscribing radius (km)",
        "mean_radius_km": "mean radius (km)",
    }
)
"""Measures in the text output, and their names there."""


Input = Annotated[Path, typer.Argument(metavar="IN", help="Shape file.")]
Output = Annotated[Path, typer.Argument(metavar="OUT", help="New shape file; the end of its name is its format.")]
DskCenter = Annotated[int | None, typer.Option(metavar="ID", help="NAIF number of the body, for a DSK.")]
DskFrame = Annotated[str | None, typer.Option(metavar="NAME", help="Body-fixed frame SPICE knows, for a DSK.")]
DskKernels = Annotated[
    list[Path] | None,
    typer.Option("--dsk-kernel", metavar="PATH", help="Kernel that defines the frame of a DSK; repeatable."),
]
DskSurface = Annotated[int, typer.Option(metavar="ID", help="Number of the surface, for a DSK.")]


def info(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Shape files of any readable format.")],
    units: UnitsOption = Units.KM,
    json: Json = False,
) -> ExitCode:
    """Measure shapes and list their defects.

    A file fails when it is damaged, or holds a surface that no body can be rendered from. One that fails does not
    stop the others.
    """
    return show_results([_info(path, units) for path in files], _lines, json=json)


def convert(
    source: Input,
    target: Output,
    units: UnitsOption = Units.KM,
    repair: Annotated[
        bool, typer.Option("--repair", help="Drop broken facets, wind them alike and outward, close small holes.")
    ] = False,
    overwrite: Overwrite = False,
    dsk_center: DskCenter = None,
    dsk_frame: DskFrame = None,
    dsk_surface: DskSurface = 1,
    dsk_kernel: DskKernels = None,
    json: Json = False,
) -> ExitCode:
    """Write a shape in another format, in km.

    OBJ, PLY, plate tables (.tab, .plt) and .npz keep every digit, STL single precision; an ICQ model (.icq, .txt) only
    shapes read from one.
    """
    dsk = _dsk_identity(target, dsk_center, dsk_frame, dsk_surface)
    with units_said():
        surface = read_surface(source, units=units)
    lines: list[str] = []
    if repair:
        mended = repair_surface(surface)
        surface = mended.surface
        lines = [
            f"found: {mended.before.text() or 'no defects'}",
            f"turned {mended.facets_turned} facets, closed {mended.holes_filled} holes by {mended.facets_added} facets",
            f"left: {mended.after.text() or 'no defects'}",
        ]
    mesh = mesh_of(source, surface)
    with _kernels_loaded(dsk_kernel):
        save_shape(mesh, target, overwrite=overwrite, dsk=dsk)
    if not keeps_albedo(mesh, target):
        say(f"giantlike: {target}: the albedo is left out, this format has no room for it; .npz keeps it")
    return _written(mesh, target, lines, json=json)


def decimate(
    source: Input,
    target: Output,
    facets: Annotated[int, typer.Option(metavar="N", help="Number of facets to keep.")],
    units: UnitsOption = Units.KM,
    overwrite: Overwrite = False,
    dsk_center: DskCenter = None,
    dsk_frame: DskFrame = None,
    dsk_surface: DskSurface = 1,
    dsk_kernel: DskKernels = None,
    json: Json = False,
) -> ExitCode:
    """Write a shape with fewer facets, and show how far its surface moved."""
    dsk = _dsk_identity(target, dsk_center, dsk_frame, dsk_surface)
    with units_said():
        mesh = load_shape(source, units=units)
    coarse = decimate_mesh(mesh, facets)
    change = deviation(mesh, coarse)
    with _kernels_loaded(dsk_kernel):
        save_shape(coarse, target, overwrite=overwrite, dsk=dsk)
    if mesh.albedo is not None:
        say(f"giantlike: {target}: the albedo is left out, it belongs to the facets of {source}")
    share = change.max_km / mesh.mean_radius_km
    lines = [
        f"{len(mesh.faces)} facets before, {len(coarse.faces)} after",
        f"volume changed by {change.volume_change:+.4%}",
        f"distance between the surfaces {change.rms_km:.4g} km rms, {change.max_km:.4g} km at most ({share:.3%} of the "
        "mean radius)",
    ]
    return _written(coarse, target, lines, json=json, more=asdict(change))


def _dsk_identity(target: Path, center: int | None, frame: str | None, surface: int) -> DskIdentity | None:
    """Return the identity written into a DSK, or None if the output is another format."""
    if target.suffix.lower() not in (".bds", ".dsk"):
        return None
    if center is None or frame is None:
        raise InputError(f"{target}: a DSK names its body and frame: give --dsk-center ID and --dsk-frame NAME")
    return DskIdentity(center=center, frame=frame, surface=surface)


def _kernels_loaded(paths: Sequence[Path] | None) -> AbstractContextManager[object]:
    """Load SPICE kernels, where there are any, for as long as the block runs."""
    if not paths:
        return nullcontext()
    from giantlike.io.spice import load_kernels

    return load_kernels(paths, Path())


@contextmanager
def units_said() -> Iterator[None]:
    """Turn warnings about guessed units into lines on stderr."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UnitsWarning)
        yield
    for warning in caught:
        say(f"giantlike: {warning.message}")


def _written(
    mesh: TriangleMesh, target: Path, lines: Sequence[str], *, json: bool, more: dict[str, Any] | None = None
) -> ExitCode:
    values = {"file": str(target), "facets": len(mesh.faces), "vertices": len(mesh.vertices_km)}
    values |= {"volume_km3": mesh.volume_km3} | (more or {}) | {"notes": list(lines)}
    last = f"wrote {target}: {len(mesh.faces)} facets, {mesh.volume_km3:.6g} km^3"
    return show_result(values, [*lines, last], json=json)


def _info(path: Path, units: str) -> dict[str, Any]:
    """One object of the JSON list; unknown values are None."""
    values: dict[str, Any] = {"file": str(path), "status": "failed", "detail": ""} | dict(_KEYS)
    try:
        with units_said():
            surface = read_surface(path, units=units)
        found = defects_of(surface)
        values |= {
            "facets": len(surface.faces),
            "vertices": len(surface.vertices),
            "watertight": found.watertight and len(surface.faces) > 0,
            "defects": asdict(found),
        }
        mesh = mesh_of(path, surface)
        measures = measure_mesh(mesh)
    except OpNavError as error:
        return values | {"detail": str(error)}
    for field in fields(measures):
        value = getattr(measures, field.name)
        values[field.name] = value.tolist() if isinstance(value, np.ndarray) else value
    return values | {"status": "suspect" if found else "ok", "detail": found.text(), "sha256": mesh.sha256}


def _lines(results: Results) -> Iterator[str]:
    for result in results:
        yield f"{result['file']}: {result['status']}"
        if result["detail"]:
            yield f"  {result['detail']}"
        if result["facets"] is not None:
            closed = "watertight" if result["watertight"] else "not watertight"
            euler = "" if result["euler_number"] is None else f", Euler number {result['euler_number']}"
            yield f"  {result['facets']} facets, {result['vertices']} vertices, {closed}{euler}"
        for key, label in _SHOWN.items():
            if result[key] is not None:
                numbers = np.atleast_1d(result[key])
                yield f"  {label:<36}" + " ".join(f"{number:>13.7g}" for number in numbers)
        if result["principal_axes"] is not None:
            for label, axis in zip(("long", "middle", "short"), result["principal_axes"], strict=True):
                yield f"  {'principal axis, ' + label:<36}" + " ".join(f"{part:>13.6f}" for part in axis)
