"""``calibration.html``: page of a camera calibration, in one self-contained file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from giantlike._system.atomic import write_text_atomic
from giantlike.calibration.field_map import field_grid
from giantlike.calibration.observability import ParameterVerdict
from giantlike.calibration.result import CalibrationResult
from giantlike.calibration.star_images import StarCalibration
from giantlike.calibration.statistics import residual_statistics
from giantlike.camera import Camera
from giantlike.camera_models import CameraModel, EquidistantModel, EquisolidModel, GridCorrectedModel, PinholeModel
from giantlike.camera_models.affine import AFFINE_NAMES
from giantlike.camera_models.axial import AxialModel
from giantlike.campaign.calibration.solve import CampaignCalibration, calibration_summary
from giantlike.campaign.report.templates import PageFigure, render_page
from giantlike.campaign.store.run_folder import CALIBRATION_PAGE
from giantlike.core.arrays import Float
from giantlike.core.version import VERSION

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from giantlike.plotting.charts import ChartSheet

_MAX_REJECTED = 200  # rejected observations listed in the page, the worst first; ``calibration.json`` holds all
_TRENDS = {
    "image": "image",
    "magnitude": "magnitude",
    "radius_px": "distance from center, px",
    "temperature_c": "temperature, C",
}
_MEANING = {
    ParameterVerdict.SUPPORTED: "supported by the data",
    ParameterVerdict.NOT_SIGNIFICANT: "not significantly different from zero: the data do not need it",
    ParameterVerdict.ENTANGLED: "known in combination with others only; its own value fluctuates",
    ParameterVerdict.PRIOR_ONLY: "the a priori value; the data add nothing",
}


def write_calibration_page(folder: Path, name: str, camera: Camera, result: CampaignCalibration) -> Path:
    """Write ``calibration.html`` into a folder."""
    solution = result.outcome.result if isinstance(result.outcome, StarCalibration) else None
    summary = calibration_summary(result)
    rejected = [] if solution is None else summary["rejected"]
    page = render_page(
        "calibration.html.j2",
        name=name,
        camera=camera.name,
        version=VERSION,
        summary=summary,
        meaning={str(verdict): text for verdict, text in _MEANING.items()},
        rejected=rejected[:_MAX_REJECTED],
        n_rejected=len(rejected),
        figures=[] if solution is None else calibration_figures(solution),
    )
    path = folder / CALIBRATION_PAGE
    write_text_atomic(path, page)
    return path


def calibration_figures(solution: CalibrationResult) -> list[PageFigure]:
    """Figures of a calibration."""
    from giantlike.plotting import star_residual_charts
    from giantlike.plotting.calibration import correlation_figure, distortion_figure, residual_trend_figure

    used, columns, rows = solution.used, solution.columns, solution.rows
    points, shifts = distortion_of(solution.model, columns, rows)
    residuals = star_residual_charts(
        solution.observed_px[used],
        solution.residuals_px[used],
        solution.magnitudes[used],
        solution.sigma_px[used],
        columns,
        rows,
    )
    trends = residual_trend_figure(_trends(solution))
    distortion = distortion_figure(points, shifts, solution.map_points_px, solution.map_sigma_px, columns, rows)
    captions: list[tuple[ChartSheet | Figure, str, str]] = [
        (residuals, "residuals", "Residuals of the observations used, over the field and by size."),
        (
            trends,
            "trends",
            "Residual rms in groups of equal size against what it might depend on, and the noise that sigmas promise.",
        ),
        (
            distortion,
            "distortion",
            "Left: where the camera puts a direction, minus where an ideal lens (pinhole, or fisheye) of the same "
            "focal lengths and principal point would. Right: uncertainty of the camera map, a rotation of the whole "
            "camera taken out.",
        ),
    ]
    if len(solution.estimated) > 1:
        caption = (
            "Parameters that are strongly correlated are known in combination only: their own values may fluctuate."
        )
        captions.append((correlation_figure(solution.estimated, solution.correlation), "correlation", caption))
    return [PageFigure.from_figure(figure, f"calibration {name}", caption) for figure, name, caption in captions]


def distortion_of(model: CameraModel, columns: int, rows: int) -> tuple[Float, Float]:
    """Shifts (n, 2) px, at points (n, 2) px, from the pinhole or plain fisheye of the same affine parameters."""
    values = dict(zip(model.parameter_names, model.parameters.tolist(), strict=True))
    affine = {name: values[name] for name in AFFINE_NAMES}
    base = model.base if isinstance(model, GridCorrectedModel) else model
    fisheye = EquisolidModel if isinstance(base, EquisolidModel) else EquidistantModel
    ideal = fisheye(**affine) if isinstance(base, AxialModel) else PinholeModel(**affine)
    pixels = field_grid(columns, rows)
    shifts = pixels - ideal.project(model.unproject(pixels))
    good = np.isfinite(shifts).all(axis=1)
    return pixels[good], shifts[good]


def _trends(solution: CalibrationResult) -> dict[str, tuple[Float, Float, Float]]:
    groups = residual_statistics(solution)
    trends = {}
    for kind, label in _TRENDS.items():
        mine = [(group.middle, group.rms_px, group.noise_px) for group in groups if group.kind == kind]
        if mine:
            middle, rms, noise = np.array(mine).T
            trends[label] = (middle, rms, noise)
    return trends
