"""``giantlike calibrate``: a camera from a campaign, or from images of stars or of a board."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from giantlike._system.atomic import write_text_atomic
from giantlike.campaign.calibration.boards import BoardSetup, calibrate_boards
from giantlike.campaign.calibration.solve import calibration_summary
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.store.run_folder import CALIBRATION_PAGE
from giantlike.cli.arguments import Frames, Json, Resume, Workers
from giantlike.cli.frames_input import frames_table
from giantlike.cli.outcome import ExitCode, print_json, say
from giantlike.cli.progress import progress_bar
from giantlike.core.arrays import require
from giantlike.core.errors import InputError, OpNavError
from giantlike.image import Image

_CAMPAIGN = "campaign.toml"
_ESTIMATE = "fx_px,fy_px,k1,p1,p2"


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
        str | None, typer.Option(help="Images show a checkerboard with so many inner corners.", metavar="COLUMNSxROWS")
    ] = None,
    max_magnitude: Annotated[float | None, typer.Option(help="For images: faintest catalog star.")] = None,
    frames: Frames = None,
    output: Annotated[Path, typer.Option(help="For images: output folder.", metavar="DIR")] = Path("calibration"),
    workers: Workers = None,
    resume: Resume = False,
    json: Json = False,
) -> ExitCode:
    """Calibrate a camera from images of stars, or of a checkerboard.

    Identification of stars anywhere on the sky and estimation of the camera alternate; writes camera.toml with its
    covariance, calibration.html, calibration.json and the attitudes with the calibrated camera. Images are made a
    campaign first, whose file is kept.
    """
    path = inputs[0]
    if board is not None:
        if fov is None:
            raise InputError("--board needs --fov DEG, the rough field of view along x")
        require(max_magnitude is None, "--max-magnitude is for stars")
        require(frames is None, "--frames is for images of stars: give images of a board with frames taken off")
        return _calibrate_board(inputs, _board_setup(board, fov, model, estimate), output, json=json)
    if len(inputs) == 1 and path.suffix.lower() == ".toml":
        require(fov is None, "--fov goes with images; a campaign file has its own [camera]")
        require(frames is None, "--frames goes with images; a campaign file has its own [calibration_frames]")
    else:
        require(fov is not None, "give a campaign file, or images with --fov DEG")
        tables: dict[str, Any] = {
            "stars": {"lost_in_space": True} | ({} if max_magnitude is None else {"max_magnitude": max_magnitude}),
            "calibration": {"model": model, "estimate": _names(estimate or _ESTIMATE)},
        }
        if frames is not None:
            tables["calibration_frames"] = frames_table(frames)
        path = _campaign_of_images(inputs, fov, tables, output)
    try:
        campaign = Campaign.load(path)
    except OpNavError:
        if path not in inputs:  # ours, which would be in the way of the next attempt
            path.unlink()
        raise
    require(
        campaign.calibration is not None,
        f'{path}: there is no [calibration] section; give one, such as estimate = ["fx_px", "fy_px", "k1"]',
    )
    for warning in campaign.warnings:
        say(f"giantlike: {warning}")
    with progress_bar(lines=True) as progress:
        result = run_campaign(campaign, workers=workers, bodies=False, progress=progress)
    summary = result.summary()
    _show(summary, f"{result.folder / CALIBRATION_PAGE} ({result.time_s:.1f} s)", json=json)
    done = summary["calibration"]["status"] == "ok" and not result.failed_images
    return ExitCode.DONE if done else ExitCode.SOME_IMAGES_FAILED


def _campaign_of_images(images: Sequence[Path], fov_deg: float | None, tables: dict[str, Any], output: Path) -> Path:
    """Write a campaign file for images that lie anywhere, and return its path."""
    import tomli_w

    first = Image.open(images[0])
    table = {
        "campaign": {"name": output.name or "calibration", "output": "run"},
        "images": {"files": [str(image.resolve()) for image in images]},
        "camera": {"columns": first.columns, "rows": first.rows, "fov_deg": fov_deg},
        **tables,
    }
    path = output / _CAMPAIGN
    require(not path.exists(), f"{path}: there is a calibration already; give --output another folder")
    output.mkdir(parents=True, exist_ok=True)
    write_text_atomic(path, tomli_w.dumps(table))
    return path


def _board_setup(board: str, fov_deg: float, model: str, estimate: str | None) -> BoardSetup:
    across, _, down = board.lower().partition("x")
    require(across.isdecimal() and down.isdecimal(), f"--board must be COLUMNSxROWS, such as 8x6, got {board!r}")
    return BoardSetup(
        across=int(across),
        down=int(down),
        fov_deg=fov_deg,
        model_type=model,
        estimate=None if estimate is None else tuple(_names(estimate)),
    )


def _calibrate_board(images: Sequence[Path], setup: BoardSetup, output: Path, *, json: bool) -> ExitCode:
    summary = calibration_summary(calibrate_boards(images, setup, output))
    _show({"output": output, "calibration": summary}, str(output / CALIBRATION_PAGE), json=json)
    return ExitCode.DONE if summary["status"] == "ok" and not summary["images_lost"] else ExitCode.SOME_IMAGES_FAILED


def _names(estimate: str) -> list[str]:
    return [name.strip() for name in estimate.split(",")]


def _show(summary: dict[str, Any], page: str, *, json: bool) -> None:
    """Write JSON; or the table, the excluded images, why the camera is not used, and the path of the page."""
    if json:
        print_json(summary)
        return
    calibration = summary["calibration"]
    _print_table(calibration)
    for row in calibration["images_lost"]:
        say(f"giantlike: {row['file']}: {row['problem']}")
    if calibration["problem"]:
        say(f"giantlike: {calibration['problem']}")
    typer.echo(page)


def _print_table(calibration: dict[str, Any]) -> None:
    """Parameters with sigma and verdict, and the residuals."""
    if "parameters" not in calibration:
        return
    for row in calibration["parameters"]:
        typer.echo(f"{row['name']:<10}{row['value']:>16.8g}  +- {row['sigma']:<10.3g}{row['verdict']}")
    targets, every = calibration["targets"], calibration["all_stars"]
    typer.echo(
        f"{calibration['n_used']} {targets} of {len(calibration['images'])} images, "
        f"{calibration['n_rejected']} rejected; residual rms {calibration['rms_px']:.3f} px radial, "
        f"{calibration['residual_sigma_px']:.3f} px per axis; map known to {calibration['map_sigma_max_px']:.3f} px"
    )
    if every and every["min_snr"] > 0:
        typer.echo(
            f"all {every['count']} stars, also those of SNR < {every['min_snr']:g}: "
            f"residual rms {every['rms_px']:.3f} px radial (their sigmas promise {every['noise_px']:.3f} px)"
        )
    for row in calibration["rejected"][:5]:
        off = row["distance_px"] or float("nan")
        typer.echo(f"rejected: {targets[:-1]} {row['label']} in {row['image']}, {off:.2f} px off")
