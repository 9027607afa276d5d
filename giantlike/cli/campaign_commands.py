"""Commands on runs and scenes: ``export``, ``interlock``, ``render`` and ``demo``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from giantlike.campaign.export import (
    EXPORT_NAMES,
    ExportFormat,
    ExportOptions,
    InertialFrame,
    PointingSource,
    export_run,
)
from giantlike.campaign.interlock import interlock_of, write_interlock
from giantlike.campaign.render.plan import RenderPlan
from giantlike.campaign.render.run import RenderedImage, render_images
from giantlike.cli.arguments import Json, Overwrite, Run, Workers
from giantlike.cli.outcome import ExitCode, say, show_result
from giantlike.cli.progress import progress_bar
from giantlike.core.arrays import require
from giantlike.observables.exchange import Angles


def export(
    folder: Run,
    kind: Annotated[ExportFormat, typer.Option("--format", help="Format to write.")],
    output: Annotated[
        Path | None,
        typer.Option(help="New file; for wcs, sumfile a folder. Default: in the run folder.", metavar="FILE|DIR"),
    ] = None,
    overwrite: Overwrite = False,
    pointing: Annotated[PointingSource, typer.Option(help="What attitudes are from.")] = PointingSource.STARS,
    suspect: Annotated[bool, typer.Option("--suspect", help="Suspect attitudes as well.")] = False,
    stars_only: Annotated[
        bool, typer.Option("--stars-only", help="Leave out attitudes transferred from neighbors.")
    ] = False,
    max_gap: Annotated[float, typer.Option(help="ck, aem, spk: longest gap to interpolate over, s.")] = 600.0,
    instrument: Annotated[int | None, typer.Option(help="ck: NAIF code of the camera frame.", metavar="ID")] = None,
    frame: Annotated[str | None, typer.Option(help="ck, aem: name of the camera frame.", metavar="NAME")] = None,
    sclk: Annotated[
        Path | None, typer.Option(help="ck: clock kernel of the spacecraft; default: one is made.", metavar="FILE.tsc")
    ] = None,
    ck_type: Annotated[int, typer.Option(help="ck: 3, continuous, or 1, discrete.", min=1, max=3)] = 3,
    object_name: Annotated[str, typer.Option(help="aem, tdm, psf: spacecraft.")] = "UNKNOWN",
    object_id: Annotated[str, typer.Option(help="aem: its international designator.")] = "UNKNOWN",
    originator: Annotated[str, typer.Option(help="aem, tdm: creator of the message.")] = "UNKNOWN",
    angles: Annotated[Angles, typer.Option(help="tdm: what is removed of the angles.")] = Angles.ASTROMETRIC,
    inertial: Annotated[InertialFrame, typer.Option(help="aem, tdm: name of the inertial axes.")] = InertialFrame.ICRF,
    sip_order: Annotated[int, typer.Option(help="wcs: order of the polynomials.", min=2, max=9)] = 5,
    ades: Annotated[
        Path | None, typer.Option(help="ades: file with a table [ades]: the campaign file, say.", metavar="FILE.toml")
    ] = None,
    spacecraft: Annotated[int | None, typer.Option(help="spk: NAIF code of the spacecraft.", metavar="ID")] = None,
    body: Annotated[int | None, typer.Option(help="spk: NAIF code of the target.", metavar="ID")] = None,
    landmarks: Annotated[
        Path | None,
        typer.Option(help="sumfile: landmarks that the run used, for LMK files as well.", metavar="FILE.npz|DIR"),
    ] = None,
    json: Json = False,
) -> ExitCode:
    """Write the attitudes or observables of a run for other programs.

    csv: quaternions and covariances. ck: SPICE C-kernel of type 3 or 1. aem: CCSDS attitude ephemeris. wcs: a FITS
    header with TAN-SIP world coordinates for each image. observables: bodies, landmarks and stars as JSON lines, or as
    the Parquet file that every run writes. tdm: CCSDS tracking data message of the preferred fixes. psf: JPL picture
    sequence file. sumfile: SUMFILEs of stereophotoclinometry. spk: SPICE SPK of the spacecraft relative to the
    targets. ades: astrometry for the Minor Planet Center, .xml or .psv.
    """
    options = ExportOptions(
        pointing=pointing,
        suspect=suspect,
        stars_only=stars_only,
        max_gap_s=max_gap,
        instrument_id=instrument,
        frame_name=frame,
        sclk=sclk,
        ck_type=ck_type,
        object_name=object_name,
        object_id=object_id,
        originator=originator,
        angles=angles,
        inertial=inertial,
        sip_order=sip_order,
        ades=ades,
        spacecraft_id=spacecraft,
        target_id=body,
        landmarks=landmarks,
    )
    target = output or folder / EXPORT_NAMES[kind]
    there = any(target.iterdir()) if target.is_dir() else target.exists()
    require(overwrite or not there, f"{target} exists: give --output another name, or --overwrite")
    exported = export_run(folder, target, kind, options)
    lines = [f"wrote {file}" for file in exported.files[:10]]
    if len(exported.files) > 10:
        lines.append(f"and {len(exported.files) - 10} more")
    skipped = "".join(f"; left out: {count} {reason}" for reason, count in exported.left_out.items())
    made = f"{exported.n_observations} observations" if exported.n_observations else f"{exported.n_attitudes} attitudes"
    return show_result({"format": kind} | asdict(exported), [*lines, f"{made}{skipped}"], json=json)


def interlock(
    first: Annotated[Path, typer.Argument(metavar="FIRST", help="Run folder, or a table of attitudes.")],
    second: Annotated[Path, typer.Argument(metavar="SECOND", help="The other sensor's.")],
    output: Annotated[Path, typer.Option(help="Output folder.", metavar="DIR")] = Path("interlock"),
    tolerance: Annotated[float, typer.Option(help="Largest time difference of a pair, s.")] = 0.05,
    json: Json = False,
) -> ExitCode:
    """Estimate the rotation between two cameras, or a camera and a star tracker.

    Attitudes of the same time are paired. A table of attitudes has the columns of giantlike export
    --format csv.
    """
    result = interlock_of(first, second, tolerance_s=tolerance)
    files = write_interlock(result, output)
    summary = result.summary()
    sigma, scatter = summary["sigma_arcsec"], summary["scatter_arcsec"]
    lines = [
        f"{summary['n_used']} of {summary['n_pairs']} pairs used; {summary['n_unpaired']} attitudes unpaired",
        f"angle of the rotation {summary['rotation_angle_deg']:.6f} deg, between boresights "
        f"{summary['boresight_angle_deg']:.6f} deg",
        "second_from_first (x, y, z, w): " + ", ".join(f"{q:.9f}" for q in summary["second_from_first_xyzw"]),
    ]
    for axis in sigma:
        spread = "unknown" if scatter[axis] is None else f"{scatter[axis]:.3g} arcsec"
        lines.append(f"about {axis}: sigma of the mean {sigma[axis]:.3g} arcsec, scatter of the pairs {spread}")
    lines.append(f"reduced chi-square {summary['reduced_chi2']:.3g}; wrote {', '.join(str(file) for file in files)}")
    return show_result(summary | {"files": files}, lines, json=json)


def render(
    path: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Scene file.")],
    output: Annotated[
        Path | None, typer.Option(help="Folder, or the FITS file of an only image.", metavar="DIR|FILE")
    ] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> ExitCode:
    """Make images of bodies and stars, with noise and with the truth in the file."""
    plan = RenderPlan.load(path)
    for warning in plan.warnings:
        say(f"giantlike: {warning}")
    with progress_bar() as progress:
        images = render_images(plan, output, overwrite=overwrite, progress=progress)
    return show_result([_fields(image) for image in images], map(_line, images), json=json)


def demo(
    output: Annotated[Path, typer.Option(help="Folder for images, campaign and run.", metavar="DIR")] = Path(
        "demo-output"
    ),
    workers: Workers = None,
    json: Json = False,
) -> ExitCode:
    """Simulate an approach to a small body, run it as a campaign, and compare with the truth.

    The exit code is 1 if a goal is missed.
    """
    from giantlike.campaign.demo import run_demo

    with progress_bar() as progress:
        done = run_demo(output, workers=workers, progress=progress)
    typer.echo(done.to_json() if json else done.text())
    return ExitCode.DONE if done.met else ExitCode.GOALS_MISSED


def _fields(image: RenderedImage) -> dict[str, object]:
    values = asdict(image)
    return {"file": values.pop("path")} | values | {"time_s": round(image.time_s, 3)}


def _line(image: RenderedImage) -> str:
    places = "".join(f", {name} at ({x:.1f}, {y:.1f})" for name, (x, y) in image.targets.items())
    light = f"peak {image.peak_dn:.0f} DN, {image.saturated_px} px saturated"
    return f"{image.path}: {image.stars} stars{places}; {light} ({image.time_s:.1f} s)"
