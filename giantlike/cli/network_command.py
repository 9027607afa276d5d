"""Commands on control networks: ``network adjust`` and ``network read``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from shutil import copytree
from typing import Annotated, Any

import numpy as np
import typer

from giantlike.calibration.options import Loss
from giantlike.campaign import Campaign, run_campaign
from giantlike.campaign.file.schema import NetworkSection
from giantlike.campaign.store.run_folder import NETWORK_FILE, RunFolder
from giantlike.cli.arguments import Json
from giantlike.cli.outcome import ExitCode, show_result
from giantlike.cli.progress import progress_bar
from giantlike.core.arrays import require
from giantlike.core.errors import InputError
from giantlike.io.isis_network import read_control_network
from giantlike.network import NetworkFix, NetworkOptions, Photo, Tracks, adjust, read_isis, read_spc, write_network

Network = Annotated[Path, typer.Argument(metavar="NET.pvl", help="ISIS control network in PVL.")]


def read(network: Network, json: Json = False) -> ExitCode:
    """Show what a control network holds: points, measures, views, and what is left out."""
    content = read_control_network(network)
    views = np.array([len(point.measures) for point in content.points])
    images: dict[str, int] = {}
    for point in content.points:
        for measure in point.measures:
            images[measure.serial_number] = images.get(measure.serial_number, 0) + 1
    types = [point.type for point in content.points]
    summary: dict[str, Any] = {
        "target": content.target,
        "points": {name: types.count(name) for name in dict.fromkeys(types)},
        "measures": int(views.sum()),
        "views_per_point": {int(count): int((views == count).sum()) for count in np.unique(views)},
        "measures_per_image": dict(sorted(images.items())),
        "ignored_points": content.ignored_points,
        "ignored_measures": content.ignored_measures,
        "without_position": sum(not np.isfinite(point.position_km).all() for point in content.points),
    }
    lines = [
        f"{network}: {len(types)} points on {content.target or 'an unnamed body'} "
        f"({', '.join(f'{count} {name}' for name, count in summary['points'].items())}), "
        f"{summary['measures']} measures",
        "views per point: " + ", ".join(f"{count}: {number}" for count, number in summary["views_per_point"].items()),
        *(f"{count:6d} measures in {name}" for name, count in summary["measures_per_image"].items()),
        f"left out: {content.ignored_points} points and {content.ignored_measures} measures ignored or rejected; "
        f"{summary['without_position']} points have no a priori position",
    ]
    return show_result(summary, lines, json=json)


def adjust_network(
    network: Annotated[
        Path,
        typer.Argument(metavar="RUN|NET.pvl|SUMFILES", help="Run folder, ISIS control network, or folder of SUMFILEs."),
    ],
    images: Annotated[
        list[Path] | None,
        typer.Option("--images", help="ISD of an image, or a folder of *.isd and *.json.", metavar="ISD"),
    ] = None,
    shape: Annotated[
        Path | None, typer.Option(help="Of a run: mesh of the landmarks; default: that of the target.", metavar="FILE")
    ] = None,
    lmkfiles: Annotated[
        Path | None, typer.Option(help="Folder of LMK files; default: LMKFILES beside the SUMFILEs.", metavar="DIR")
    ] = None,
    target: Annotated[str | None, typer.Option(help="Of a run: target, where it has several.")] = None,
    reduction: Annotated[float, typer.Option(help="Detector pixels along a pixel of the measured images.")] = 1.0,
    sigma_px: Annotated[
        float | None, typer.Option(help="Sigma of measures, px per axis; default 1.4 of the detector, of SUMFILEs 0.5.")
    ] = None,
    sigma_position_km: Annotated[float, typer.Option(help="A priori sigma of positions per axis.")] = 1.0,
    sigma_angles_deg: Annotated[float, typer.Option(help="A priori sigma of RA, DEC and TWIST.")] = 2.0,
    loss: Annotated[Loss, typer.Option(help="Loss of the fit that finds outliers.")] = Loss.CAUCHY,
    outlier_sigmas: Annotated[float, typer.Option(help="Limit of rejection; inf rejects none.")] = 3.5,
    scale_by_residuals: Annotated[
        bool, typer.Option("--scale-by-residuals", help="Multiply covariances by chi-square per degree of freedom.")
    ] = False,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder of results.", metavar="DIR")] = None,
    json: Json = False,
) -> ExitCode:
    """Adjust the points and poses of a control network, and show what its images do not determine.

    The folder gets result.json, points.csv (body axes, with covariance) and poses.csv (ICRF, with covariance). A run
    goes on with the step network: landmarks of a shape are found in its images and adjusted, in its folder network.
    """
    if RunFolder(network).has_results():
        return _adjust_run(network, NetworkSection(shape=None if shape is None else str(shape.absolute()),
                                                   target=target, loss=loss), output, json=json)  # fmt: skip
    options = NetworkOptions(loss=loss, outlier_sigmas=outlier_sigmas, scale_by_residuals=scale_by_residuals)
    if network.is_dir():
        photos, tracks = read_spc(network, _lmkfiles(network, lmkfiles), sigma_px=0.5 if sigma_px is None else sigma_px)
        return _adjust(photos, tracks, options, output, json=json)
    require(images is not None, f"{network}: an ISIS network needs the support data of its images: give --images ISD")
    assert images is not None
    files = [file for path in images for file in (_isds(path) if path.is_dir() else [path])]
    photos, tracks = read_isis(
        network,
        files,
        reduction=reduction,
        sigma_px=1.4 if sigma_px is None else sigma_px,
        sigma_position_km=sigma_position_km,
        sigma_angles_deg=sigma_angles_deg,
    )
    return _adjust(photos, tracks, options, output, json=json)


def _lmkfiles(sumfiles: Path, given: Path | None) -> Path | None:
    """Folder of LMK files: the one given, one beside the SUMFILEs, or theirs."""
    near = (sumfiles.parent / "LMKFILES", sumfiles)
    return given or next((folder for folder in near if any(folder.glob("*.LMK"))), None)


def _adjust(
    photos: list[Photo], tracks: Tracks, options: NetworkOptions, output: Path | None, *, json: bool
) -> ExitCode:
    """Adjust a network that was read, write it and show it."""
    fix = adjust(photos, tracks, options=options)
    if not isinstance(fix, NetworkFix):
        failed = {"status": "failed", "reason": str(fix.reason), "detail": fix.detail}
        return show_result(failed, f"failed: {fix.reason}: {fix.detail}", json=json, failed=True)
    summary = {"status": "ok", **fix.summary()}
    if output is not None:
        write_network(output, fix)
    return show_result(summary, _lines(summary), json=json)


def _adjust_run(folder: Path, section: NetworkSection, output: Path | None, *, json: bool) -> ExitCode:
    """Go on with a run, with the step ``network``."""
    named = RunFolder.open(folder).provenance().get("environment", {}).get("campaign_file")
    path = None if named is None else (folder / named).resolve()
    require(path is not None and path.is_file(), f"{folder}: its campaign file is not at {path}")
    assert path is not None
    campaign = Campaign.load(path)
    known = campaign.network
    if known is not None:
        given = {name: value for name in ("shape", "target") if (value := getattr(section, name)) is not None}
        section = known.section.model_copy(update=given)
    with progress_bar(lines=True) as progress:
        result = run_campaign(replace(campaign.with_network(section), output=folder), progress=progress)
    summary = result.network or {}
    if output is not None:
        copytree((folder / NETWORK_FILE).parent, output, dirs_exist_ok=True)
    if summary.get("status") != "ok":
        text = f"failed: {summary.get('reason')}: {summary.get('detail')}"
        return show_result(summary, text, json=json, failed=True)
    return show_result(summary, _lines(summary), json=json)


def _isds(folder: Path) -> list[Path]:
    found = sorted([*folder.glob("*.isd"), *folder.glob("*.json")])
    if not found:
        raise InputError(f"{folder}: there is no *.isd and no *.json")
    return found


def _lines(summary: dict[str, Any]) -> list[str]:
    status, scaled = summary["point_status"], summary["covariance_scale"] != 1.0
    lines = [
        f"{summary['points']} points ({', '.join(f'{count} {name}' for name, count in status.items())}), "
        f"{len(summary['images'])} images, {summary['measures']} measures, {len(summary['rejected'])} rejected",
        f"noise {summary['noise_over_stated']:.3g} of the stated sigma (robust), sigma0 {summary['sigma0']:.4g} with "
        f"{summary['freedom']} degrees of freedom{'; covariances are scaled by it' if scaled else ''}",
        f"frame: {summary['datum']}",
    ]
    for one in summary["images"]:
        sigma = max(one["sigma_position_km"])
        rms = "no" if one["rms_px"] is None else f"{one['rms_px']:.3f} px"
        lines.append(
            f"  {one['name']}: {one['measures']} measures, {one['rejected']} rejected, rms {rms}, "
            f"position sigma {sigma:.3g} km, attitude {max(one['sigma_attitude_deg']):.3g} deg"
        )
    for each in summary["frame"]:
        unit = {"shift": " km", "rotation": " rad"}.get(each["name"].split()[0], "")
        sigma_text = "not known a priori: held" if each["sigma"] is None else f"sigma {each['sigma']:.3g}{unit}"
        lines.append(f"  {each['name']}: {sigma_text}, {100.0 * each['share']:.0f} % of the variance of the points")
    lines += [
        f"  {one['name']}: {one['departure']:.4g} +- {one['sigma']:.2g}, {one['verdict']}" for one in summary["shared"]
    ]
    return lines + [f"not determined: {each}" for each in summary["weak"]]
