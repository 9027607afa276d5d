"""Folder of a plan: tables, a page, a scene to render and a campaign to run."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from giantlike._system.atomic import make_folder, write_text_atomic
from giantlike.campaign.report.templates import PageFigure, render_page
from giantlike.core.arrays import Float, finite_or_none
from giantlike.core.frames import rotate
from giantlike.core.time import utc_text
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.io import write_geometry
from giantlike.io.csv_rows import write_csv_rows
from giantlike.io.geometry_table import GeometryRow
from giantlike.io.tables import column, columns_of
from giantlike.planning import PlannedImage
from giantlike.planning.drawn import can_be_drawn, draw_target
from giantlike.planning.images import Plan
from giantlike.plotting.charts import Axis, Chart, ChartSheet
from giantlike.plotting.layers import Layer, MarkShape
from giantlike.plotting.style import SERIES
from giantlike.ray_tracing import Reflectance
from giantlike.scene import Target
from giantlike.shapes import Ellipsoid, TriangleMesh, save_shape
from giantlike.shapes.detail import LevelsOfDetail

PLAN_FILE = "plan.json"
_CAMERA, _GEOMETRY, _SCENE, _CAMPAIGN, _IMAGES = "camera.toml", "geometry.csv", "scene.toml", "campaign.toml", "images"


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanRow:
    """What an image will show; written by `giantlike plan` as CSV alone."""

    file: str = column("Image file.")
    epoch_utc: str | None = column("Mid-exposure, UTC.")
    exposure_s: float | None = column("Exposure.", unit="s")
    reason: str | None = column("Reason for which the image is of no use.")
    detail: str | None = column("What was needed and found.")
    diameter_px: float | None = column("Diameter of the target.", unit="px")
    phase_deg: float | None = column("Angle Sun - target - camera.", unit="deg")
    elongation_deg: float | None = column("Angle of the boresight from the Sun.", unit="deg")
    range_km: float | None = column("Distance of the target.", unit="km")
    x_px: float | None = column("Center of the target, column.", unit="px")
    y_px: float | None = column("Center of the target, row.", unit="px")
    blur_px: float | None = column("Motion of the target during the exposure.", unit="px")
    peak_dn: float | None = column("Expected brightest pixel of the target.", unit="DN")
    peak_05_dn: float | None = column("Its 5 % quantile.", unit="DN")
    peak_95_dn: float | None = column("Its 95 % quantile.", unit="DN")
    saturated: float | None = column("Fraction of the pixels of the target that are saturated.")
    snr_peak: float | None = column("Signal to noise ratio of the brightest pixel.")
    snr: float | None = column("Signal to noise ratio of the whole signal.")
    stars: float | None = column("Expected number of detected stars.")
    stars_low: float | None = column("Lower end of its 95 % interval.")
    stars_high: float | None = column("Upper end.")
    sigma_attitude_arcsec: float | None = column(
        "Expected sigma of the attitude across the line of sight.", unit="arcsec"
    )
    sigma_roll_arcsec: float | None = column("Expected sigma about the line of sight.", unit="arcsec")
    estimator: str | None = column("Estimator of the fix.")
    draws: int | None = column("Drawn images that the fix is predicted by.")
    failure_probability: float | None = column("Probability of no usable fix.")
    sigma_x_px: float | None = column("Expected sigma of the center, column.", unit="px")
    sigma_y_px: float | None = column("Expected sigma of the center, row.", unit="px")
    sigma_range: float | None = column("Expected relative sigma of the range.")
    gain: float | None = column("Gain of the orbit by the image: half the logarithm of the ratio of determinants.")


def plan_row(plan: Plan, image: PlannedImage) -> PlanRow:
    """Row of an image of a plan."""
    light, stars, failure = image.light, image.stars, image.failure
    fix = next(iter(image.fixes.values()), None)
    attitude = None if stars is None or stars.covariance_rad2 is None else np.sqrt(np.diag(stars.covariance_rad2))
    sigmas = [] if fix is None or fix.covariance is None else np.sqrt(np.diag(fix.covariance)).tolist()
    epoch = image.candidate.epoch
    seen = image.geometry is not None
    numbers = {
        "exposure_s": image.exposure_s,
        "diameter_px": image.diameter_px,
        "phase_deg": math.degrees(image.phase_rad),
        "elongation_deg": math.degrees(image.elongation_rad),
        "range_km": math.nan if image.geometry is None else image.geometry.range_km,
        "x_px": float(image.center_px[0]),
        "y_px": float(image.center_px[1]),
        "blur_px": image.blur_px if seen else math.nan,
        "gain": image.gain,
    }
    cells: dict[str, Any] = {name: finite_or_none(value) for name, value in numbers.items()}
    if light is not None:
        cells |= {"peak_dn": light.peak_dn, "saturated": light.saturated, "snr_peak": light.snr_peak, "snr": light.snr}
        cells |= {"peak_05_dn": float(light.quantiles_dn[0]), "peak_95_dn": float(light.quantiles_dn[2])}
    if stars is not None:
        cells |= {"stars": stars.expected, "stars_low": stars.low, "stars_high": stars.high}
    if attitude is not None:
        across, roll = float(np.hypot(*attitude[:2])) / math.sqrt(2.0), float(attitude[2])
        cells |= {"sigma_attitude_arcsec": across * ARCSEC_PER_RAD, "sigma_roll_arcsec": roll * ARCSEC_PER_RAD}
    if fix is not None:
        cells |= {"estimator": fix.estimator, "draws": fix.draws, "failure_probability": fix.failure_probability}
        cells |= dict(zip(("sigma_x_px", "sigma_y_px", "sigma_range"), sigmas, strict=False))
    return PlanRow(
        file=_file_of(image),
        epoch_utc=None if epoch is None else utc_text(epoch),
        reason=None if failure is None else str(failure.reason),
        detail=None if failure is None else failure.detail,
        **cells,
    )


def write_plan(plan: Plan, folder: str | Path, *, catalog: str = "default", max_magnitude: float | None = None) -> Path:
    """Write a plan with all that is needed to render and to run it.

    Parameters
    ----------
    plan : Plan; from :func:`giantlike.planning.plan_images`, or what was chosen of it
    folder : path-like
        Gets ``plan.csv``, ``plan.json``, ``plan.html``, ``camera.toml``, ``geometry.csv``, ``scene.toml`` for
        ``giantlike render`` and ``campaign.toml`` for ``giantlike run``, which finds the rendered images in ``images``.
        The scene shows a body drawn from the declared uncertainties, the campaign has the declared one.
    catalog : str; ``default``, or the file of a star catalog, relative to the folder
    max_magnitude : float, optional; faintest star

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    DataError
        A file cannot be written.
    """
    folder = make_folder(folder)
    rows = [plan_row(plan, image) for image in plan.images]
    write_csv_rows(folder / "plan.csv", [each.name for each in columns_of(PlanRow)], map(astuple, rows))
    content = {
        "target": plan.target,
        "camera": plan.camera.name,
        "orbit_covariance": None if plan.orbit_covariance is None else plan.orbit_covariance.tolist(),
        "images": [asdict(row) | _matrices(plan, image) for row, image in zip(rows, plan.images, strict=True)],
    }
    write_text_atomic(folder / PLAN_FILE, json.dumps(content, indent=1, allow_nan=False))
    write_text_atomic(folder / "plan.html", _page(plan, rows))
    plan.camera.save(folder / _CAMERA)
    write_geometry(folder / _GEOMETRY, [_geometry_row(image) for image in plan.usable])
    targets = [_target_table(folder, target) for target in plan.scene.targets]
    shown = [_target_table(folder, _drawn(plan, target)) for target in plan.scene.targets]
    stars: dict[str, Any] = {"catalog": catalog} | ({} if max_magnitude is None else {"max_magnitude": max_magnitude})
    has_stars = any(image.stars is not None for image in plan.images)
    scene: dict[str, Any] = {
        "render": {"output": _IMAGES, "seed": plan.options.seed, "geometry": _GEOMETRY},
        "camera": {"file": _CAMERA},
        "targets": [
            table | {"albedo": target.normal_albedo or plan.options.albedo}
            for table, target in zip(shown, plan.scene.targets, strict=True)
        ],
    }
    estimators = list(plan.options.estimators or ("auto",))
    campaign: dict[str, Any] = {
        "campaign": {"name": "planned", "output": "run"},
        "images": {"files": [f"{_IMAGES}/{_file_of(image)}" for image in plan.usable], "geometry": _GEOMETRY},
        "camera": {"file": _CAMERA},
        "targets": [
            table | {"estimators": estimators} | _declare(folder, target)
            for table, target in zip(targets, plan.scene.targets, strict=True)
        ],
    }
    if has_stars:
        scene["stars"], campaign["stars"] = stars, stars
    write_text_atomic(folder / _SCENE, tomli_w.dumps(scene))
    write_text_atomic(folder / _CAMPAIGN, tomli_w.dumps(campaign))
    return folder


def _drawn(plan: Plan, target: Target) -> Target:
    """Body to render: the target with drawn relief, albedo, size and orientation, if that can be; others unchanged."""
    if target.name != plan.target or not can_be_drawn(target):
        return target
    truth, random = replace(plan.options.truth, law=0.0), np.random.default_rng([plan.options.seed, 5])
    largest = max(image.diameter_px for image in plan.usable)
    return replace(draw_target(target, truth, largest, random), reflectance=target.reflectance)


def _file_of(image: PlannedImage) -> str:
    """Name of the file of an image, which is written as FITS."""
    return Path(image.candidate.name).with_suffix(".fits").name


def _geometry_row(image: PlannedImage) -> GeometryRow:
    geometry, candidate = image.geometry, image.candidate
    assert geometry is not None
    assert candidate.camera_from_inertial is not None
    inertial_from_camera = candidate.camera_from_inertial.inv()
    return GeometryRow(
        file=_file_of(image),
        epoch=candidate.epoch,
        exposure_s=image.exposure_s,
        camera_from_inertial=candidate.camera_from_inertial,
        target=geometry.target.name,
        target_position_inertial_km=rotate(inertial_from_camera, geometry.position_camera_km),
        body_from_inertial=(inertial_from_camera * geometry.camera_from_body).inv(),
        sun_direction_inertial=rotate(inertial_from_camera, geometry.sun_direction_camera),
        observer=candidate.observer,
    )


def _target_table(folder: Path, target: Target) -> dict[str, Any]:
    """Keys that scene and campaign have in common of a body; a mesh is written beside them."""
    shape = target.shape.finest if isinstance(target.shape, LevelsOfDetail) else target.shape
    table: dict[str, Any] = {"name": target.name, "reflectance": _law_table(target.reflectance)}
    if isinstance(shape, Ellipsoid):
        return table | {"shape": {"radii_km": shape.radii_km.tolist()}}
    assert isinstance(shape, TriangleMesh)
    file = f"{target.name.lower()}{'_drawn' * (shape.name == 'drawn')}.npz"
    save_shape(shape, folder / file, overwrite=True)
    return table | {"shape": file}


def _declare(folder: Path, target: Target) -> dict[str, Any]:
    """Keys of a campaign for what is uncertain of a body, and for what changes its limb; a map is written beside."""
    known = target.uncertainty
    table: dict[str, Any] = {
        "uncertainty": {
            "scale": known.scale,
            "pole_deg": "unknown" if known.pole_unknown else math.degrees(known.pole_rad),
            "spin_deg": math.degrees(known.spin_rad),
            "ephemeris_km": known.ephemeris_km,
            "sun_deg": math.degrees(known.sun_rad),
            "albedo": known.albedo,
        }
    }
    if target.terrain is not None:
        table |= {"terrain": f"{target.name.lower()}_heights.npz", "terrain_sigma_km": target.terrain.sigma_km}
        target.terrain.save(folder / table["terrain"])
    limbs = {"atmosphere": target.atmosphere, "rings": target.rings}
    table |= {name: asdict(value) for name, value in limbs.items() if value is not None}
    return table if target.air is None else table | {"air": target.air}


def _law_table(law: Reflectance) -> dict[str, Any]:
    values = {name: getattr(law, name) for name in getattr(law, "__dataclass_fields__", ())}
    return {"model": law.type_name} | {key: value for key, value in values.items() if isinstance(value, int | float)}


def _matrices(plan: Plan, image: PlannedImage) -> dict[str, Any]:
    """Covariances of an image: of the attitude, and of each fix by cause."""
    stars = image.stars
    return {
        "attitude_covariance_rad2": None
        if stars is None or stars.covariance_rad2 is None
        else stars.covariance_rad2.tolist(),
        "fixes": {
            name: {
                "draws": fix.draws,
                "failures": dict(fix.failures),
                "failure_probability": fix.failure_probability,
                "nees": finite_or_none(fix.nees),
                "covariance": None if fix.covariance is None else fix.covariance.tolist(),
                "parts": {str(cause): part.tolist() for cause, part in fix.parts.items()},
            }
            for name, fix in image.fixes.items()
        },
    }


def _page(plan: Plan, rows: list[PlanRow]) -> str:
    """``plan.html``: tiles, charts over the images and the table."""
    usable = [row for row in rows if row.reason is None]
    times = [et for et in (image.candidate.image().et for image in plan.usable) if et is not None]
    at = np.arange(1.0, len(usable) + 1)
    label = "image"
    if len(times) == len(usable) and len(set(times)) > 1:
        at, label = (np.array(times) - min(times)) / 3600.0, "hours since the first image"
    charts = [
        _chart(quantity, label, at, [_values(usable, name) for name in names], names)
        for quantity, names in (
            ("diameter, px", ("diameter_px",)),
            ("peak, DN", ("peak_dn", "peak_05_dn", "peak_95_dn")),
            ("stars", ("stars", "stars_low", "stars_high")),
            ("sigma of center, px", ("sigma_x_px", "sigma_y_px")),
        )
        if np.isfinite(_values(usable, names[0])).any()
    ]
    figure = None
    if charts:
        sheet = ChartSheet(charts=charts, width_in=7.5, height_in=1.6, stacked=True)
        figure = PageFigure.from_figure(sheet, "plan", "Peaks with their 5 to 95 %, stars with their 95 %.")
    reasons: dict[str, int] = {}
    for row in rows:
        if row.reason is not None:
            reasons[row.reason] = reasons.get(row.reason, 0) + 1
    orbit = None if plan.orbit_covariance is None else np.sqrt(np.diag(plan.orbit_covariance)).tolist()
    return render_page(
        "plan.html.j2",
        "giantlike.campaign.plan",
        target=plan.target,
        camera=plan.camera.name,
        rows=rows,
        usable=len(usable),
        reasons=reasons,
        figure=figure,
        orbit=orbit,
        chosen=any(row.gain is not None for row in rows),
    )


def _values(rows: list[PlanRow], name: str) -> Float:
    return np.array([math.nan if getattr(row, name) is None else getattr(row, name) for row in rows])


def _chart(quantity: str, label: str, at: Float, values: list[Float], names: tuple[str, ...]) -> Chart:
    """Chart of a quantity over the images, with its limits as dashes."""
    layers = []
    for number, (each, name) in enumerate(zip(values, names, strict=True)):
        known = np.isfinite(each)
        dashed = number > 0 and len(values) == 3
        layers.append(
            Layer(
                points=np.column_stack([at[known], each[known]]),
                shape=MarkShape.DASHES if dashed else MarkShape.RING,
                color=SERIES[0 if len(values) == 3 else number],
                size=4.5,
                label=name if len(values) == 2 else "",
            )
        )
    x = Axis.around(label, at, margin=0.03)
    return Chart(title="", x=x, y=Axis.around(quantity, np.concatenate(values)), layers=layers)
