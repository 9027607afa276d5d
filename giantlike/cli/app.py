"""Commands of ``giantlike``; their modules are imported when they run."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from giantlike.cli.camera_app import camera_app
from giantlike.cli.catalog_app import catalog_app
from giantlike.cli.outcome import ExitCode, command
from giantlike.cli.shape_app import shape_app

app = typer.Typer(
    name="giantlike",
    help="Ground workbench for optical navigation: spacecraft images in, navigation observables out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Exit codes: 0 done, 1 some images failed, 2 bad input, 130 interrupted.",
)
app.add_typer(shape_app)
app.add_typer(camera_app)
app.add_typer(catalog_app)


class ExportOption(StrEnum):
    """Formats of ``giantlike export``."""

    CSV = "csv"
    CK = "ck"
    AEM = "aem"
    WCS = "wcs"


class PsfOption(StrEnum):
    """Values of ``giantlike.processing.psf.profile.PsfKind``."""

    GAUSSIAN = "gaussian"
    ELONGATED = "elongated"
    MOFFAT = "moffat"


class NoiseOption(StrEnum):
    """Values of ``giantlike.processing.detection.noise.NoiseSource``."""

    LOCAL = "local"
    IMAGE = "image"
    COVERED = "covered"
    DETECTOR = "detector"


Json = Annotated[bool, typer.Option("--json", help="Write JSON to stdout.")]
Sequence = Annotated[
    bool,
    typer.Option(
        "--sequence",
        help="Images of one camera and other stars each: remove their fixed pattern; detect compares them too.",
    ),
]
Workers = Annotated[int | None, typer.Option(min=1, help="Number of processes; default: one per CPU.")]


def _version(wanted: bool) -> None:
    if wanted:
        from giantlike.core.version import VERSION

        typer.echo(f"giantlike {VERSION}")
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    pass


@app.command("run")
@command
def run(
    campaign: Annotated[Path, typer.Argument(metavar="CAMPAIGN.toml", help="Campaign file.")],
    workers: Workers = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted run.")] = False,
    json: Json = False,
) -> ExitCode:
    """Run a campaign: attitudes from stars, then every estimator on every image.

    Writes the run folder that the campaign names: tables, report.html, provenance.json, log.jsonl.
    """
    from giantlike.cli.run_command import run_command

    return run_command(campaign, workers=workers, resume=resume, json=json)


@app.command("calibrate")
@command
def calibrate(
    inputs: Annotated[
        list[Path],
        typer.Argument(
            metavar="CAMPAIGN.toml | IMAGE...", help="A campaign with [calibration], or images of stars or of a board."
        ),
    ],
    fov: Annotated[float | None, typer.Option(help="For images: rough field of view along x.", metavar="DEG")] = None,
    model: Annotated[str, typer.Option(help="For images: type of the camera model.")] = "brown",
    estimate: Annotated[
        str | None,
        typer.Option(
            help="For images: parameters to estimate; default fx_px,fy_px,k1,p1,p2; with a board cx_px,cy_px,k2 too.",
            metavar="NAME,NAME,...",
        ),
    ] = None,
    board: Annotated[
        str | None,
        typer.Option(help="Images show a checkerboard with so many inner corners.", metavar="COLUMNSxROWS"),
    ] = None,
    max_magnitude: Annotated[float | None, typer.Option(help="For images: faintest catalog star.")] = None,
    output: Annotated[Path, typer.Option(help="For images: output folder.", metavar="DIR")] = Path("calibration"),
    workers: Workers = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted run.")] = False,
    json: Json = False,
) -> ExitCode:
    """Calibrate a camera from images of stars, or of a checkerboard.

    Stars are identified anywhere on the sky and the camera is estimated, by turns; writes camera.toml with its
    covariance, calibration.html, calibration.json and the attitudes with the calibrated camera.
    """
    from giantlike.cli.calibrate_command import calibrate_command

    return calibrate_command(
        inputs,
        fov_deg=fov,
        model=model,
        estimate=estimate,
        board=board,
        max_magnitude=max_magnitude,
        output=output,
        workers=workers,
        resume=resume,
        json=json,
    )


@app.command("stars")
@command
def stars(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="Image files of any readable format.")],
    camera: Annotated[Path | None, typer.Option(help="Camera file.", metavar="CAMERA.toml")] = None,
    fov: Annotated[
        float | None, typer.Option(help="Rough field of view along x, instead of a camera file.", metavar="DEG")
    ] = None,
    fov_error: Annotated[
        float, typer.Option(help="Error that --fov may have, percent (at most 20).", metavar="PERCENT")
    ] = 20.0,
    lost_in_space: Annotated[
        bool, typer.Option("--lost-in-space", help="Search the whole sky if the a priori attitude does not help.")
    ] = False,
    max_magnitude: Annotated[float | None, typer.Option(help="Faintest catalog star.")] = None,
    catalog: Annotated[str, typer.Option(help="default, a built catalog, or one in CSV.")] = "default",
    sequence: Sequence = False,
    bottom_up: Annotated[
        bool, typer.Option("--bottom-up", help="The first stored row is the bottom of the picture: turn the rows.")
    ] = False,
    review: Annotated[
        Path | None, typer.Option(help="Folder for pictures of detections, matches and residuals.", metavar="DIR")
    ] = None,
    hdu: Annotated[str | None, typer.Option(help="Number or name of the FITS extension.")] = None,
    json: Json = False,
) -> ExitCode:
    """Solve the attitude of star images, without a campaign file.

    An image whose header has no a priori attitude is always solved lost-in-space.
    """
    from giantlike.cli.stars_command import stars_command

    return stars_command(
        images,
        camera_file=camera,
        fov_deg=fov,
        fov_error=fov_error / 100,
        lost_in_space=lost_in_space,
        max_magnitude=max_magnitude,
        catalog=catalog,
        sequence=sequence,
        bottom_up=bottom_up,
        review=review,
        hdu=int(hdu) if hdu is not None and hdu.isdecimal() else hdu,
        json=json,
    )


@app.command("detect")
@command
def detect(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="Image files of any readable format.")],
    camera: Annotated[
        Path | None, typer.Option(help="Camera file: its PSF and detector are used.", metavar="CAMERA.toml")
    ] = None,
    psf_sigma: Annotated[
        float | None, typer.Option(help="Sigma of the PSF; default: the camera's, or as estimated.", metavar="PX")
    ] = None,
    min_snr: Annotated[float, typer.Option(help="Leave out sources of lower signal-to-noise ratio.")] = 0.0,
    threshold: Annotated[float, typer.Option(help="Detection limit in units of the noise.", metavar="SIGMA")] = 5.0,
    noise: Annotated[
        NoiseOption, typer.Option(help="Source of the noise of a pixel.", case_sensitive=False)
    ] = NoiseOption.LOCAL,
    covered: Annotated[
        tuple[int, int, int, int] | None,
        typer.Option(help="For --noise covered: pixels without light.", metavar="X Y COLUMNS ROWS"),
    ] = None,
    streak: Annotated[
        bool | None, typer.Option("--streak/--no-streak", help="Stars are streaks; by default this is detected.")
    ] = None,
    psf: Annotated[
        PsfOption | None, typer.Option(help="Estimate the PSF from each image, and fit sources with it.")
    ] = None,
    psf_degree: Annotated[int, typer.Option(help="Degree of the variation of that PSF over the field, 0 to 3.")] = 0,
    sequence: Sequence = False,
    hdu: Annotated[str | None, typer.Option(help="Number or name of the FITS extension.")] = None,
    json: Json = False,
) -> ExitCode:
    """Find stars and other point sources, with their positions and covariances.

    With --json all of them are listed, brightest first, with quality flags.
    """
    from giantlike.cli.detect_command import detect_command

    return detect_command(
        images,
        camera_file=camera,
        psf_sigma_px=psf_sigma,
        min_snr=min_snr,
        search={"threshold_sigma": threshold, "streak": streak, "noise": noise, "covered": covered},
        psf=psf,
        psf_degree=psf_degree,
        sequence=sequence,
        hdu=int(hdu) if hdu is not None and hdu.isdecimal() else hdu,
        json=json,
    )


@app.command("render")
@command
def render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Scene file.")],
    output: Annotated[
        Path | None, typer.Option(help="Folder, or the FITS file of an only image.", metavar="DIR|FILE")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace images that exist.")] = False,
    json: Json = False,
) -> ExitCode:
    """Make images of bodies and stars, with noise and with the truth in the file."""
    from giantlike.cli.render_command import render_command

    return render_command(scene, output=output, overwrite=overwrite, json=json)


@app.command("estimators")
@command
def estimators(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Show the options of this one.")] = None,
    json: Json = False,
) -> ExitCode:
    """List the estimators of bodies, or show one with its options and their defaults."""
    from giantlike.cli.estimators_command import estimators_command

    return estimators_command(name, json=json)


@app.command("report")
@command
def report(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    json: Json = False,
) -> ExitCode:
    """Write report.html of a finished run again."""
    from giantlike.cli.run_command import report_command

    return report_command(folder, json=json)


@app.command("export")
@command
def export(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    format_name: Annotated[ExportOption, typer.Option("--format", help="What to write.")],
    output: Annotated[
        Path | None, typer.Option(help="New file; for wcs a folder. Default: in the run folder.", metavar="FILE|DIR")
    ] = None,
    suspect: Annotated[bool, typer.Option("--suspect", help="Suspect attitudes as well.")] = False,
    stars_only: Annotated[
        bool, typer.Option("--stars-only", help="Leave out attitudes transferred from neighbors.")
    ] = False,
    max_gap: Annotated[float, typer.Option(help="ck, aem: longest gap to interpolate over, s.")] = 600.0,
    instrument: Annotated[int | None, typer.Option(help="ck: NAIF code of the camera frame.", metavar="ID")] = None,
    frame: Annotated[str | None, typer.Option(help="ck, aem: name of the camera frame.", metavar="NAME")] = None,
    sclk: Annotated[
        Path | None, typer.Option(help="ck: clock kernel of the spacecraft; default: one is made.", metavar="FILE.tsc")
    ] = None,
    object_name: Annotated[str, typer.Option(help="aem: spacecraft.")] = "UNKNOWN",
    object_id: Annotated[str, typer.Option(help="aem: its international designator.")] = "UNKNOWN",
    originator: Annotated[str, typer.Option(help="aem: who writes the message.")] = "UNKNOWN",
    sip_order: Annotated[int, typer.Option(help="wcs: order of the polynomials.", min=2, max=9)] = 5,
    json: Json = False,
) -> ExitCode:
    """Write the attitudes of a run for other programs.

    csv: quaternions and covariances. ck: SPICE C-kernel of type 3. aem: CCSDS attitude ephemeris. wcs: a FITS header
    with TAN-SIP world coordinates for each image.
    """
    from giantlike.campaign.export import ExportOptions
    from giantlike.cli.export_command import export_command

    options = ExportOptions(
        suspect=suspect,
        stars_only=stars_only,
        max_gap_s=max_gap,
        instrument_id=instrument,
        frame_name=frame,
        sclk=sclk,
        object_name=object_name,
        object_id=object_id,
        originator=originator,
        sip_order=sip_order,
    )
    return export_command(folder, output, format_name.value, options, json=json)


@app.command("interlock")
@command
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
    from giantlike.cli.interlock_command import interlock_command

    return interlock_command(first, second, output, tolerance_s=tolerance, json=json)


@app.command("demo")
@command
def demo(
    output: Annotated[Path, typer.Option(help="Folder for images, campaign and run.", metavar="DIR")] = Path(
        "demo-output"
    ),
    workers: Workers = None,
    json: Json = False,
) -> ExitCode:
    """Simulate an approach to a small body, run it as a campaign, and compare with the truth."""
    from giantlike.cli.demo_command import demo_command

    return demo_command(output, workers=workers, json=json)
