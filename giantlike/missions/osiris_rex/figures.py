"""Figures of the replay: residuals of stars, centers and ranges, and the study of wrong ranges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
from matplotlib.figure import Figure

from giantlike.missions.osiris_rex.calibrations import CameraCalibration
from giantlike.missions.osiris_rex.campaigns import CampaignResult
from giantlike.missions.osiris_rex.images import TARGET
from giantlike.missions.osiris_rex.phases import PhaseResult, Residual
from giantlike.missions.osiris_rex.range_error import RangeErrorStudy
from giantlike.plotting import charts_figure, overlay_figure, star_residual_charts
from giantlike.plotting.overlays import OverlayPanel, stretch_image
from giantlike.plotting.residuals import Series, series_charts
from giantlike.plotting.style import GRAY, MARKERS, SERIES, drawing, new_panels
from giantlike.viewer.comparison import match_of
from giantlike.viewer.layers import layers_of
from giantlike.viewer.session import Session

_PICTURE_PX = 20.0  # apparent diameter from which Bennu is shown
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


def residual_figure(found: Sequence[Residual], quantity: str, title: str) -> Figure:
    """Residuals over time, by estimator: against the fitted orbit, with sigmas, and against the truth, without."""
    series = []
    for name in dict.fromkeys(each.estimator for each in found):
        mine = [each for each in found if each.estimator == name]
        for against in ("fit", "truth"):
            values = np.array([getattr(each, f"{against}_{quantity}") for each in mine]).reshape(len(mine), -1)
            sigma = np.array([getattr(each, f"sigma_{quantity}") for each in mine]).reshape(len(mine), -1)
            series.append(
                Series(
                    label=f"{name}, {against}",
                    at=np.array([each.days for each in mine]),
                    values=values,
                    sigma=sigma if against == "fit" else np.full_like(sigma, np.nan),
                    suspect=np.array([each.status == "suspect" for each in mine]),
                )
            )
    panels = ("x, px", "y, px") if quantity == "px" else ("range, %",)
    sheet = series_charts(series, panels, "days since the first image", title)
    return charts_figure(replace(sheet, width_in=_HALF_IN, height_in=_HEIGHT_IN) if quantity == "px" else sheet)


def orbit_figure(result: PhaseResult, title: str) -> Figure:
    """Error of the fitted trajectory, and of planned and estimated maneuvers."""
    with drawing():
        figure, (left, right) = new_panels(9.0, 2.8, columns=2)
        orbit, times = result.orbit, np.array(sorted({each.days for each in chain(*result.residuals.values())}))
        left.semilogy(times[-len(orbit.position_error_km) :], 1e3 * orbit.position_error_km, marker="o", markersize=4.0)
        left.set(xlabel="days since the first image", ylabel="error of position, m", title=title)
        for number, (label, errors) in enumerate(
            (("planned", orbit.planned_errors_km_s), ("estimated", orbit.maneuver_errors_km_s))
        ):
            at = np.arange(errors.size) + 0.2 * number
            right.plot(at, 1e6 * errors.ravel(), MARKERS[number], color=SERIES[number], label=label, markersize=5.0)
        if orbit.solution is not None and orbit.maneuver_errors_km_s.size:
            sigma = 1e6 * np.sqrt(np.diag(orbit.solution.covariance)[9:])
            right.errorbar(
                np.arange(len(sigma)) + 0.2,
                1e6 * orbit.maneuver_errors_km_s.ravel(),
                sigma,
                fmt="none",
                color=SERIES[1],
            )
        right.axhline(0.0, color=GRAY, linewidth=0.9)
        right.set(xlabel="component of maneuver", ylabel="minus executed, mm/s", yscale="symlog", title="Maneuvers")
        right.legend()
    return figure


def picture_figure(result: CampaignResult) -> Figure | None:
    """The largest Bennu of a campaign with limb points and landmarks, the template at the fix, and the difference."""
    session = Session(result.folder)
    resolved = {each.file for each in result.every if each.estimator == "cross_correlation"}
    largest = max(resolved, key=lambda file: result.diameters_px[file], default=None)
    if largest is None or result.diameters_px[largest] < _PICTURE_PX:
        return None
    match, seen = match_of(session, largest, TARGET, "cross_correlation"), session.seen(largest)
    rows, columns = np.nonzero(match.region)
    limits = np.array([columns.min(), columns.max(), rows.min(), rows.max()], dtype=np.float64)
    part = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    marks = [each.layer for each in layers_of(seen, ("limb", "landmarks"))]
    panels = [
        OverlayPanel(title=title, gray=stretch_image(pixels[part]), picture_px=limits, limits_px=limits, layers=layers)
        for title, pixels, layers in (
            (largest, match.image_dn, marks),
            ("Template", match.model_dn, marks[:0]),
            ("Image - template", match.difference_dn, marks[:0]),
        )
    ]
    return overlay_figure(panels)


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
