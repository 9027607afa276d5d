"""Figures of the replay: residuals of stars, centers and ranges, and the study of wrong ranges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from giantlike.campaign.store.results import group_by
from giantlike.missions.osiris_rex.calibrations import CameraCalibration
from giantlike.missions.osiris_rex.campaigns import CampaignResult
from giantlike.missions.osiris_rex.range_error import RangeErrorStudy
from giantlike.plotting import charts_figure, star_residual_charts
from giantlike.plotting.residuals import Series, series_charts
from giantlike.plotting.style import GRAY, MARKERS, SERIES, drawing, new_panels
from giantlike.simulation.compare import ObservationError

_HALF_IN, _HEIGHT_IN = 3.8, 2.2
"""Size of two panels side by side, inches, so that they are legible in half the width of a page."""


def calibration_figure(calibration: CameraCalibration) -> Figure:
    """Post-fit residuals of the stars that a camera was calibrated from."""
    result = calibration.result
    used = result.used
    charts = star_residual_charts(
        result.observed_px[used],
        result.residuals_px[used],
        result.magnitudes[used],
        result.sigma_px[used],
        result.columns,
        result.rows,
    )
    return charts_figure(charts)


def star_figure(result: CampaignResult) -> Figure:
    """Post-fit residuals of the stars of the attitudes of a campaign."""
    stars = result.stars
    charts = star_residual_charts(
        stars.points_px, stars.residuals_px, stars.magnitudes, stars.sigma_px, result.columns, result.rows
    )
    return charts_figure(charts)


def center_figure(result: CampaignResult, errors: Sequence[ObservationError], title: str) -> Figure:
    """Residuals of centers, by estimator."""
    groups = group_by(errors, lambda error: error.estimator)
    series = [
        _series(result, name, mine, [error.error_px for error in mine], [error.sigma_px for error in mine])
        for name, mine in groups.items()
    ]
    sheet = series_charts(series, ("x, px", "y, px"), "days since the first image", title)
    return charts_figure(replace(sheet, width_in=_HALF_IN, height_in=_HEIGHT_IN))


def range_figure(result: CampaignResult, errors: Sequence[ObservationError], title: str) -> Figure:
    """Residuals of ranges, in percent."""
    values, sigmas = (
        100.0 * np.array(each)[:, None] for each in zip(*((e.range_error, e.range_sigma) for e in errors), strict=True)
    )
    series = _series(result, "limb_matching", errors, values, sigmas)
    return charts_figure(series_charts([series], ("range, %",), "days since the first image", title))


def _series(result: CampaignResult, label: str, errors: Sequence[ObservationError], values: Any, sigma: Any) -> Series:
    """Residuals of an estimator over time."""
    return Series(
        label=label,
        at=np.array([result.days[error.file] for error in errors]),
        values=np.array(values),
        sigma=np.array(sigma),
        suspect=np.array([error.status == "suspect" for error in errors]),
    )


def range_error_figure(study: RangeErrorStudy) -> Figure:
    """Shift of the center against the error of the predicted range, by the two ways of matching."""
    with drawing():
        figure, (left, right) = new_panels(9.0, 3.4, columns=2)
        percent = 100.0 * study.range_errors
        for number, phase_deg in enumerate(study.phases_deg):
            for axis, shifts in ((left, study.correlation_px), (right, study.fitted_px)):
                axis.plot(
                    percent,
                    np.linalg.norm(shifts[number], axis=1),
                    color=SERIES[number],
                    marker=MARKERS[number],
                    markersize=4.0,
                    label=f"{phase_deg:.0f} deg phase",
                )
        for axis, title in ((left, "Peak of the correlation"), (right, "Range fitted with the center")):
            axis.set(xlabel="error of the predicted range, %", ylabel="error of the center, px", title=title)
            axis.axvline(0.0, color=GRAY, linewidth=0.9)
            axis.set_ylim(bottom=0.0)
        left.legend(loc="upper center")
    return figure
