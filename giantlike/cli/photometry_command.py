"""``giantlike photometry``: light of the stars of a run, and the zero point of its camera."""

from __future__ import annotations

import json as json_text
import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from giantlike._system.atomic import make_folder, write_text_atomic
from giantlike.catalogs import StarTable
from giantlike.cli.arguments import Json, Run
from giantlike.cli.outcome import ExitCode, say, show_result
from giantlike.core.arrays import require
from giantlike.core.errors import DataError, InputError
from giantlike.core.outcomes import Failure
from giantlike.core.photometry import Photometry
from giantlike.io.csv_rows import write_csv_rows
from giantlike.photometry import Fluxes, ZeroPoint, ZeroPointOptions, fit_zero_point, measure_stars
from giantlike.processing.detection.detections import DetectionFlag
from giantlike.viewer.session import Session

_COLUMNS = (
    "file", "star_id", "x_px", "y_px", "flux_dn", "sigma_dn", "magnitude", "color_bp_rp", "expected_dn",
    "residual", "used", "flags",
)  # fmt: skip


def photometry(
    run: Run,
    output: Annotated[
        Path | None, typer.Option(help="Output folder; by default RUN/photometry.", metavar="DIR")
    ] = None,
    json: Json = False,
) -> ExitCode:
    """Measure the light of all catalog stars in the images of a run, and the zero point of the camera.

    Stars are measured at the places that the attitudes give, whether they were detected or not. Writes photometry.json,
    fluxes.csv and camera.toml, the camera of the run with the table [photometry].
    """
    session = Session(run)
    campaign, navigation = session.workbench.campaign, session.workbench.navigation
    require(navigation is not None, f"{run}: the zero point follows from stars, and its campaign has no [stars]")
    assert navigation is not None
    fluxes: list[Fluxes] = []
    stars: list[StarTable] = []
    failed: dict[str, str] = {}
    for record in session.result.attitudes:
        if not record.outcome.is_usable or record.attitude is None or record.attitude.source != "stars":
            continue  # short exposures of bodies; the run lists images whose stars it did not solve
        try:
            image = session.image(record.file)
            found = measure_stars(image, session.camera, navigation.catalog, campaign.fluxes)
        except (InputError, DataError) as error:
            failed[record.file] = str(error)
            continue
        if isinstance(found, Failure):
            failed[record.file] = found.detail
        else:
            fluxes.append(replace(found[0], name=record.file))
            stars.append(found[1])
    why = "; ".join(dict.fromkeys(failed.values())) or "none has an attitude from its stars"
    require(bool(fluxes), f"{run}: no image has stars to measure: {why}")
    answer = fit_zero_point(fluxes, stars, ZeroPointOptions(band=navigation.catalog.band))
    if isinstance(answer, Failure):
        raise InputError(f"{run}: {answer.detail}")
    folder = run / "photometry" if output is None else output
    make_folder(folder)
    summary = answer.to_mapping() | _comparison(answer, campaign.camera.photometry)
    summary["images"] = _images(answer, fluxes) + [{"file": file, "failed": why} for file, why in failed.items()]
    write_text_atomic(folder / "photometry.json", json_text.dumps(summary, indent=1, allow_nan=False) + "\n")
    write_csv_rows(folder / "fluxes.csv", _COLUMNS, _rows(answer, fluxes, stars))
    replace(session.camera, photometry=answer.photometry).save(folder / "camera.toml")
    for file, why in failed.items():
        say(f"giantlike: {file}: {why}")
    lines = _lines(answer, summary, folder)
    return show_result(summary | {"folder": str(folder)}, lines, json=json, failed=bool(failed))


def _comparison(answer: ZeroPoint, known: Photometry | None) -> dict[str, Any]:
    """What the zero point of the camera file or campaign differs by, where there is one in the same band."""
    if known is None or known.band != answer.photometry.band:
        return {}
    sigma = math.hypot(math.sqrt(answer.covariance_mag2[0, 0]), float(known.sigma_mag(color_bp_rp=1.0)))
    return {"change_mag": answer.value_mag - known.zero_point_mag, "change_sigma_mag": sigma}


def _images(answer: ZeroPoint, fluxes: list[Fluxes]) -> list[dict[str, Any]]:
    sigma = np.sqrt(np.diag(answer.covariance_images_mag2))
    return [
        {
            "file": one.name,
            "zero_point_mag": float(answer.images_mag[k]),
            "sigma_mag": float(sigma[k]),
            "n_measured": len(one.flux_dn),
            "n_used": int(answer.used[k].sum()),
            "n_saturated": int(np.count_nonzero(one.flags & np.uint16(DetectionFlag.SATURATED))),
            "width_px": one.width_px,
            "level_dn": float(np.median(one.level_dn)),
            "exposure_s": one.exposure_s,
        }
        for k, one in enumerate(fluxes)
    ]


def _rows(answer: ZeroPoint, fluxes: list[Fluxes], stars: list[StarTable]) -> list[list[str | float | None]]:
    rows: list[list[str | float | None]] = []
    for k, (one, table) in enumerate(zip(fluxes, stars, strict=True)):
        value = replace(answer.photometry, zero_point_e_s=10.0 ** (0.4 * float(answer.images_mag[k])))
        rate = value.star_rate_e_s(table.magnitude, color_bp_rp=table.color_bp_rp, angle_rad=one.angle_rad)
        expected, sigma = rate * one.exposure_s / one.gain_e_per_dn, one.sigma_dn
        for i, flag in enumerate(one.flags):
            color, residual = float(table.color_bp_rp[i]), float(answer.residuals[k][i])
            names = ";".join(DetectionFlag(int(flag)).names())
            rows.append([
                one.name, str(table.ids[i]), *map(float, one.points_px[i]), float(one.flux_dn[i]), float(sigma[i]),
                float(table.magnitude[i]), color if math.isfinite(color) else None, float(expected[i]),
                residual if math.isfinite(residual) else None, str(bool(answer.used[k][i])).lower(), names,
            ])  # fmt: skip
    return rows


def _lines(answer: ZeroPoint, summary: dict[str, Any], folder: Path) -> list[str]:
    value, sigma = answer.photometry, np.sqrt(np.diag(answer.covariance_mag2))
    lines = [
        f"{one['file']}: zero point {one['zero_point_mag']:.3f} +- {one['sigma_mag']:.3f} mag, {one['n_used']} of "
        f"{one['n_measured']} stars, {one['n_saturated']} saturated"
        for one in summary["images"]
        if "failed" not in one
    ]
    lines += [
        f"zero point  {answer.value_mag:.3f} +- {sigma[0]:.3f} mag ({value.band}, 1 electron/s)",
        f"color term  {value.color_term:+.3f} +- {sigma[1]:.3f} mag/mag  {answer.supported['color_term']}",
        f"field term  {value.field_term_mag:+.3f} +- {sigma[2]:.3f} mag at {value.field_angle_deg:.3g} deg  "
        f"{answer.supported['field_term_mag']}",
        f"scatter     {value.scatter_mag:.3f} mag a star; {answer.n_used} stars used, {answer.n_rejected} rejected",
        *answer.notes,
    ]
    if "change_mag" in summary:
        change, error = summary["change_mag"], summary["change_sigma_mag"]
        told = f", {abs(change) / error:.1f} sigma" if error > 0.0 else ""
        lines.append(
            f"the camera is {abs(change):.3f} mag {'more' if change > 0 else 'less'} sensitive than declared{told}"
        )
    return [*lines, f"wrote {folder / 'photometry.json'}, fluxes.csv, camera.toml"]
