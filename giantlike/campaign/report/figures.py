"""Figures of the report of a run, made from its records."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from giantlike.campaign.report.templates import PageFigure
from giantlike.campaign.store.fix_differences import difference_of
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord
from giantlike.campaign.store.results import RunResult
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.core.arrays import Float
from giantlike.core.frames import rotation_between
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.plotting import star_residual_charts
from giantlike.plotting.residuals import Series, series_charts

_BODY_PANELS = ("x, px", "y, px", "range, %")
_MAX_STAR_IMAGES = 500  # images whose stars are in the residual figure: about 50,000 points; no result depends on it
_PERCENT = np.array([1.0, 1.0, 100.0])  # scale of center and logarithm of the range
_TIME_UNITS = ((86400.0, "days"), (3600.0, "hours"), (60.0, "minutes"), (1.0, "seconds"))
"""Units of a time axis, s, with their names; the largest that the axis holds more than twice is used."""


def attitude_figures(result: RunResult) -> list[PageFigure]:
    """Star residuals of all images, quality of the solutions, and corrections of the a priori attitudes."""
    figures = []
    solved = [record for record in result.attitudes if record.n_matched and not record.problems]
    at, label = _time_axis(result)
    if solved:
        figures.append(_star_figure(result, solved))
        unknown = np.full(2, np.nan)
        samples: list[_Sample] = [
            (at(record.index), np.array([record.rms_px, record.n_matched]), unknown, record.status == "suspect")
            for record in solved
        ]
        quality = _series({"star images": samples})
        figure = series_charts(quality, ["radial rms, px", "matched stars"], label, "Star solutions")
        figures.append(PageFigure.from_figure(figure, "quality", "Fit and number of stars of every solution."))
    corrections = _series({source: _corrections(result, source, at) for source in ("stars", "interpolated")})
    if corrections:
        panels = ["about x, arcsec", "about y, arcsec", "about z, arcsec"]
        figure = series_charts(corrections, panels, label, "Attitude minus a priori attitude, camera axes")
        caption = "Corrections by the stars, with one-sigma bars of the new attitude; hollow: suspect."
        figures.append(PageFigure.from_figure(figure, "corrections", caption))
    return figures


def body_figures(result: RunResult) -> list[PageFigure]:
    """Observed minus predicted and the difference between estimators, for each target."""
    at, label = _time_axis(result)
    measured: dict[str, dict[str, dict[int, ObservationRecord]]] = {}
    for record in result.observations:
        if record.center_px and record.predicted_px:
            measured.setdefault(record.target, {}).setdefault(record.estimator, {})[record.index] = record
    figures = []
    for target, by_estimator in measured.items():
        offsets = _series({name: _offsets(records, at) for name, records in by_estimator.items()})
        figure = series_charts(offsets, _BODY_PANELS, label, f"{target}: observed minus predicted")
        caption = (
            f"{target}: measured center (and range, where it is measured) against the a priori geometry, with one-sigma"
            " bars of the measurement; hollow: suspect. What all estimators share is the error of the a priori."
        )
        figures.append(PageFigure.from_figure(figure, f"target {target}", caption))
        reference = max(by_estimator, key=lambda name: len(by_estimator[name]))
        others = {name: records for name, records in by_estimator.items() if name != reference}
        differences = _series(
            {name: _differences(records, by_estimator[reference], at) for name, records in others.items()}
        )
        if differences:
            figure = series_charts(differences, _BODY_PANELS, label, f"{target}: minus {reference}")
            caption = f"{target}: the other estimators minus {reference}; the bars are one sigma of the difference."
            figures.append(PageFigure.from_figure(figure, f"difference {target}", caption))
    return figures


def _time_axis(result: RunResult) -> tuple[Callable[[int], float], str]:
    """Abscissa of an image by its index, and the label: time since the first image, or its number."""
    times = {record.index: record.et for record in result.attitudes if record.et is not None}
    readable = [record for record in result.attitudes if record.readable]
    first = min(times, key=lambda index: times[index], default=None)
    span = max(times.values(), default=0.0) - min(times.values(), default=0.0)
    if first is None or span <= 0 or any(record.index not in times for record in readable):
        return float, "image number"
    unit_s, unit = next(((size, name) for size, name in _TIME_UNITS if span > 2 * size), _TIME_UNITS[-1])
    start, text = times[first], result.attitudes[first].epoch_utc or ""
    return lambda index: (times.get(index, start) - start) / unit_s, f"{unit} since {text[:19]} UTC"


_Sample = tuple[float, Float, Float, bool]  # one point of a series: abscissa, values (k,), sigmas (k,), True if suspect


def _series(samples: Mapping[str, Sequence[_Sample]]) -> list[Series]:
    """Series by label, of those that have a sample."""
    series = []
    for label, points in samples.items():
        if points:
            at, values, sigma, suspect = map(np.array, zip(*points, strict=True))
            series.append(Series(label=label, at=at, values=values, sigma=sigma, suspect=suspect))
    return series


def _corrections(result: RunResult, source: str, at: Callable[[int], float]) -> list[_Sample]:
    samples: list[_Sample] = []
    for record in result.attitudes:
        attitude = record.attitude
        if attitude is not None and attitude.source == source and record.apriori is not None:
            change = ARCSEC_PER_RAD * rotation_between(record.apriori, attitude.rotation)
            samples.append((at(record.index), change, ARCSEC_PER_RAD * attitude.sigma_rad, record.status == "suspect"))
    return samples


def _offsets(records: Mapping[int, ObservationRecord], at: Callable[[int], float]) -> list[_Sample]:
    return [(at(index), *_find_offsets(record), record.status == "suspect") for index, record in records.items()]


def _differences(
    records: Mapping[int, ObservationRecord], reference: Mapping[int, ObservationRecord], at: Callable[[int], float]
) -> list[_Sample]:
    samples: list[_Sample] = []
    for index in sorted(records.keys() & reference.keys()):
        apart = difference_of(records[index], reference[index])
        if apart is not None:
            value, sigma = (
                np.concatenate([each, np.full(3 - len(each), np.nan)]) for each in (apart.offset, apart.sigma)
            )
            suspect = "suspect" in (records[index].status, reference[index].status)
            samples.append((at(index), value * _PERCENT, sigma * _PERCENT, suspect))
    return samples


def _find_offsets(record: ObservationRecord) -> tuple[Float, Float]:
    """Observed minus predicted x, y (px) and range (percent), (3,), and their sigmas; NaN where unknown."""
    offset, sigma = np.full(3, np.nan), np.full(3, np.nan)
    if record.center_px is not None and record.predicted_px is not None:
        offset[:2] = np.subtract(record.center_px, record.predicted_px)
    if record.covariance_px2 is not None:
        sigma[:2] = np.sqrt(np.diag(record.covariance_px2))
    if record.range_km is not None and record.predicted_camera_km is not None:
        predicted = math.hypot(*record.predicted_camera_km) or np.nan
        offset[2] = 100 * (record.range_km / predicted - 1)
        sigma[2] = 100 * (record.sigma_range_km or np.nan) / predicted
    return offset, sigma


def points_of(values: ArrayLike) -> Float:
    """Points (n, 2) of a list of pairs, which may be empty. ``values`` (n, 2)."""
    return np.asarray(values, dtype=np.float64).reshape(-1, 2)


def _star_figure(result: RunResult, records: Sequence[AttitudeRecord]) -> PageFigure:
    """Residuals of the stars of all images, or of many, evenly chosen."""
    step = -(-len(records) // _MAX_STAR_IMAGES)
    folder = RunFolder(result.folder)
    with folder.reading():
        parts = [stars for record in records[::step] if (stars := folder.points(record).get("stars")) is not None]
    observed = np.concatenate([points_of(part["observed_px"]) for part in parts])
    predicted = np.concatenate([points_of(part["predicted_px"]) for part in parts])
    figure = star_residual_charts(
        observed,
        observed - predicted,
        np.concatenate([part["magnitudes"] for part in parts]),
        np.concatenate([part["sigma_px"] for part in parts]),
        records[0].columns,
        records[0].rows,
    )
    caption = f"Observed minus predicted positions of {len(observed)} stars in {len(parts)} images, as fitted."
    return PageFigure.from_figure(figure, "stars", caption)
