"""``giantlike shape``: the arguments of its commands; what they need is imported when they run."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from giantlike.cli.outcome import ExitCode, command

shape_app = typer.Typer(
    name="shape",
    help="Look at shape models, convert them, make them coarser, make pictures of them.",
    no_args_is_help=True,
    epilog="Exit codes: 0 done, 1 some files failed, 2 bad input, 130 interrupted.",
)


class Units(StrEnum):
    """Unit of the coordinates in a shape file."""

    KM = "km"
    M = "m"
    AUTO = "auto"


Input = Annotated[Path, typer.Argument(metavar="IN", help="Shape file.")]
Output = Annotated[Path, typer.Argument(metavar="OUT", help="New shape file; the end of its name is its format.")]
UnitsOption = Annotated[
    Units, typer.Option(help="Unit of coordinates; auto guesses from the size and says so. DSK and npz are always km.")
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace OUT where it exists.")]
Json = Annotated[bool, typer.Option("--json", help="Write JSON to stdout, for machines.")]
DskCenter = Annotated[int | None, typer.Option(metavar="ID", help="NAIF number of the body, for a DSK.")]
DskFrame = Annotated[str | None, typer.Option(metavar="NAME", help="Body-fixed frame SPICE knows, for a DSK.")]
DskKernels = Annotated[
    list[Path] | None,
    typer.Option("--dsk-kernel", metavar="PATH", help="Kernel that defines the frame of a DSK; repeatable."),
]
DskSurface = Annotated[int, typer.Option(metavar="ID", help="Number of the surface, for a DSK.")]


@shape_app.command("info")
@command
def info(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Shape files of any readable format.")],
    units: UnitsOption = Units.KM,
    json: Json = False,
) -> ExitCode:
    """Measure shapes and list what is wrong with them.

    A file fails when it is damaged, or holds a surface that no body can be rendered from.
    """
    from giantlike.cli.shape_command import shape_info

    return shape_info(files, units=units, json=json)


@shape_app.command("convert")
@command
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

    OBJ, PLY, plate tables (.tab, .plt) and .npz keep every digit, STL single precision; an ICQ model (.icq, .txt)
    takes only what came from one.
    """
    from giantlike.cli.shape_command import dsk_identity, kernels_loaded, shape_convert

    dsk = dsk_identity(target, dsk_center, dsk_frame, dsk_surface)
    with kernels_loaded(dsk_kernel):
        return shape_convert(source, target, units=units, repair=repair, overwrite=overwrite, dsk=dsk, json=json)


@shape_app.command("decimate")
@command
def decimate(
    source: Input,
    target: Output,
    facets: Annotated[int, typer.Option(metavar="N", help="How many facets to keep.")],
    units: UnitsOption = Units.KM,
    overwrite: Overwrite = False,
    dsk_center: DskCenter = None,
    dsk_frame: DskFrame = None,
    dsk_surface: DskSurface = 1,
    dsk_kernel: DskKernels = None,
    json: Json = False,
) -> ExitCode:
    """Write a shape with fewer facets, and say how far its surface moved."""
    from giantlike.cli.shape_command import dsk_identity, kernels_loaded, shape_decimate

    dsk = dsk_identity(target, dsk_center, dsk_frame, dsk_surface)
    with kernels_loaded(dsk_kernel):
        return shape_decimate(source, target, facets=facets, units=units, overwrite=overwrite, dsk=dsk, json=json)


@shape_app.command("render")
@command
def render(
    source: Annotated[Path, typer.Argument(metavar="FILE", help="Shape file.")],
    target: Annotated[Path, typer.Argument(metavar="OUT.png", help="Picture, 8 bit gray.")],
    units: UnitsOption = Units.KM,
    phase: Annotated[float, typer.Option(metavar="DEG", help="Phase angle, 0 to 180; the Sun is to the right.")] = 45.0,
    sub_observer: Annotated[
        tuple[float, float], typer.Option(metavar="LON LAT", help="Point seen in the middle, degrees east and north.")
    ] = (0.0, 0.0),
    size: Annotated[int, typer.Option(metavar="PX", help="Width and height of the picture.")] = 512,
    reflectance: Annotated[str, typer.Option(metavar="LAW", help="Reflectance law with its standard parameters.")] = (
        "mcewen"
    ),
    overwrite: Overwrite = False,
    json: Json = False,
) -> ExitCode:
    """Make a picture of a shape, body north up, seen from a hundred radii away."""
    from giantlike.cli.shape_picture import View, shape_render

    view = View(
        phase_deg=phase, longitude_deg=sub_observer[0], latitude_deg=sub_observer[1], size_px=size, law=reflectance
    )
    return shape_render(source, target, units=units, view=view, overwrite=overwrite, json=json)


@shape_app.command("landmarks")
@command
def landmarks(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Shape file, SPC maplet (.MAP) or folder of maplets.")],
    target: Annotated[Path, typer.Argument(metavar="OUT.npz", help="New catalog of landmarks.")],
    units: UnitsOption = Units.KM,
    count: Annotated[int | None, typer.Option(metavar="N", help="How many landmarks, at most.  [default: 150]")] = None,
    size_km: Annotated[
        float | None, typer.Option(metavar="KM", help="Side of a landmark.  [default: a fifth of the mean radius]")
    ] = None,
    samples: Annotated[
        int | None, typer.Option(metavar="N", help="Heights along each side of a landmark.  [default: 33]")
    ] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> ExitCode:
    """Choose landmarks for surface_features: places with strong relief or albedo, spread over the shape."""
    from giantlike.cli.shape_landmarks import shape_landmarks

    return shape_landmarks(
        source,
        target,
        units=units,
        count=count,
        size_km=size_km,
        samples=samples,
        overwrite=overwrite,
        json=json,
    )
