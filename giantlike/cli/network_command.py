"""Commands on control networks: ``network adjust`` and ``network read``."""

from __future__ import annotations

import json as json_text
import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from giantlike._system.atomic import write_text_atomic
from giantlike.calibration.options import Loss
from giantlike.cli.arguments import Json
from giantlike.cli.outcome import ExitCode, show_result
from giantlike.core.errors import InputError
from giantlike.io.isis_network import read_control_network
from giantlike.network import NetworkFix, NetworkOptions, adjust, read_isis

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
    network: Network,
    images: Annotated[
        list[Path], typer.Option("--images", help="ISD of an image, or a folder of *.isd and *.json.", metavar="ISD")
    ],
    reduction: Annotated[float, typer.Option(help="Detector pixels along a pixel of the measured images.")] = 1.0,
    sigma_px: Annotated[float, typer.Option(help="Sigma of measures, detector pixels per axis.")] = 1.4,
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

    The folder gets result.json, points.csv (body axes, with covariance) and poses.csv (ICRF, with covariance).
    """
    files = [file for path in images for file in (_isds(path) if path.is_dir() else [path])]
    photos, tracks = read_isis(
        network,
        files,
        reduction=reduction,
        sigma_px=sigma_px,
        sigma_position_km=sigma_position_km,
        sigma_angles_deg=sigma_angles_deg,
    )
    options = NetworkOptions(loss=loss, outlier_sigmas=outlier_sigmas, scale_by_residuals=scale_by_residuals)
    fix = adjust(photos, tracks, options=options)
    if not isinstance(fix, NetworkFix):
        failed = {"status": "failed", "reason": str(fix.reason), "detail": fix.detail}
        return show_result(failed, f"failed: {fix.reason}: {fix.detail}", json=json, failed=True)
    summary = {"status": "ok", **fix.summary()}
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
        write_text_atomic(output / "result.json", json_text.dumps(summary, indent=1) + "\n")
        write_text_atomic(output / "points.csv", "\n".join(_point_rows(fix)) + "\n")
        write_text_atomic(output / "poses.csv", "\n".join(_pose_rows(fix)) + "\n")
    return show_result(summary, _lines(fix, summary), json=json)


def _isds(folder: Path) -> list[Path]:
    found = sorted([*folder.glob("*.isd"), *folder.glob("*.json")])
    if not found:
        raise InputError(f"{folder}: there is no *.isd and no *.json")
    return found


def _lines(fix: NetworkFix, summary: dict[str, Any]) -> list[str]:
    status = summary["point_status"]
    lines = [
        f"{summary['points']} points ({', '.join(f'{count} {name}' for name, count in status.items())}), "
        f"{len(summary['images'])} images, {summary['measures']} measures, {len(summary['rejected'])} rejected",
        f"noise {fix.noise:.3g} of the stated sigma (robust), sigma0 {summary['sigma0']:.4g} with {fix.freedom} "
        f"degrees of freedom{'; covariances are scaled by it' if fix.covariance_scale != 1.0 else ''}",
        f"frame: {fix.datum}",
    ]
    for one in summary["images"]:
        sigma = max(one["sigma_position_km"])
        rms = "no" if one["rms_px"] is None else f"{one['rms_px']:.3f} px"
        lines.append(
            f"  {one['name']}: {one['measures']} measures, {one['rejected']} rejected, rms {rms}, "
            f"position sigma {sigma:.3g} km, attitude {max(one['sigma_attitude_deg']):.3g} deg"
        )
    for each in fix.frame:
        unit = {"shift": " km", "rotation": " rad"}.get(each.name.split()[0], "")
        sigma_text = "not known a priori: held" if math.isinf(each.sigma) else f"sigma {each.sigma:.3g}{unit}"
        lines.append(f"  {each.name}: {sigma_text}, {100.0 * each.share:.0f} % of the variance of the points")
    lines += [
        f"  {one['name']}: {one['departure']:.4g} +- {one['sigma']:.2g}, {one['verdict']}" for one in summary["shared"]
    ]
    return lines + [f"not determined: {each}" for each in summary["weak"]]


def _point_rows(fix: NetworkFix) -> list[str]:
    rows = ["point,status,views,used,x_km,y_km,z_km,xx_km2,xy_km2,xz_km2,yy_km2,yz_km2,zz_km2"]
    used = np.bincount(fix.tracks.point, fix.used, len(fix.tracks.names)).astype(int)
    upper = np.triu_indices(3)
    for k, name in enumerate(fix.tracks.names):
        numbers = [*fix.points_km[k], *fix.covariance_points_km2[k][upper]]
        rows.append(f"{name},{fix.point_status[k]},{fix.tracks.views[k]},{used[k]}," + _csv(numbers))
    return rows


def _pose_rows(fix: NetworkFix) -> list[str]:
    upper = [f"c{i}{j}" for i, j in zip(*np.triu_indices(6), strict=True)]
    rows = ["image,et,qx,qy,qz,qw,x_km,y_km,z_km," + ",".join(upper)]
    for photo, covariance in zip(fix.photos, fix.covariance_poses, strict=True):
        quaternion = photo.camera_from_inertial.as_quat(canonical=True)
        numbers = [photo.et, *quaternion, *photo.position_km, *covariance[np.triu_indices(6)]]
        rows.append(f"{photo.name}," + _csv(numbers))
    return rows


def _csv(numbers: list[float]) -> str:
    return ",".join("" if math.isnan(value) else f"{value:.15g}" for value in numbers)
