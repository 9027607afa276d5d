"""Interlock of two sensors: the rotation between two cameras, or a camera and a star tracker, over a campaign."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike._system.atomic import make_folder, write_text_atomic
from giantlike.calibration.alignment import AlignmentResult, interlock
from giantlike.campaign.store.results import attitude_series, camera_of_run, load_result
from giantlike.core.arrays import Float, finite_or_none, require
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import quaternion_xyzw
from giantlike.core.outcomes import Failure
from giantlike.core.time import time_from_et, utc_text
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.core.values import Value
from giantlike.io.attitude_series import AttitudeSeries, read_attitude_table
from giantlike.io.csv_rows import write_csv_rows

_AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class InterlockResult(Value):
    """Alignment of two sensors from pairs of attitudes taken at the same time."""

    alignment: AlignmentResult  # ``second_from_first``
    et: Float  # (n,); times of the first sensor
    names: tuple[tuple[str, str], ...]  # names of the attitudes of each pair
    rotation_angles_rad: Float  # (n,); angle of ``second_from_first``, pair by pair
    sigma_rad: Float  # (n, 3); standard deviations of each pair about the axes of the second sensor
    unpaired: int  # attitudes of the first sensor without one of the second at their time, or without an epoch

    def summary(self) -> dict[str, Any]:
        """Content of ``interlock.json``."""
        fix = self.alignment
        used = fix.used
        spread = np.std(fix.residuals_rad[used], axis=0, ddof=1) if used.sum() > 1 else np.full(3, np.nan)
        angles = self.rotation_angles_rad[used]
        return {
            "n_pairs": len(self.et),
            "n_used": int(used.sum()),
            "n_unpaired": self.unpaired,
            "second_from_first_xyzw": quaternion_xyzw(fix.rotation).tolist(),
            "rotation_angle_deg": float(np.degrees(fix.rotation.magnitude())),
            "rotation_angle_std_arcsec": _arcsec([float(np.std(angles, ddof=1)) if len(angles) > 1 else np.nan])[0],
            "boresight_angle_deg": float(np.degrees(np.arccos(np.clip(fix.rotation.as_matrix()[2, 2], -1.0, 1.0)))),
            "sigma_arcsec": dict(zip(_AXES, _arcsec(np.sqrt(np.diag(fix.covariance_rad2))), strict=True)),
            "scatter_arcsec": dict(zip(_AXES, _arcsec(spread), strict=True)),
            "reduced_chi2": fix.reduced_chi2,
        }


def interlock_of(first: Path, second: Path, *, tolerance_s: float = 0.05) -> InterlockResult:
    """Estimate the interlock of two sensors."""
    require(tolerance_s >= 0, f"tolerance_s must be >= 0, got {tolerance_s}")
    (one, untimed), (other, _) = _series(first), _series(second)
    pairs = _pairs(one.et, other.et, tolerance_s)
    if not pairs:
        nearest = float(np.abs(one.et - other.et[_nearest(one.et, other.et)]).min())
        raise InputError(
            f"{first} and {second}: no two attitudes within {tolerance_s:g} s, the nearest are {nearest:.6g} s apart"
        )
    left, right = (np.array(indices) for indices in zip(*pairs, strict=True))
    for path, series, indices in ((first, one, left), (second, other, right)):
        for index in indices:
            if not np.isfinite(series.covariance_rad2[index]).all():
                raise DataError(path, f"{series.names[index]}: the covariance is needed to weight the pair")
    first_from_inertial, second_from_inertial = one.attitudes(left), other.attitudes(right)
    fix = interlock(first_from_inertial, one.covariance_rad2[left], second_from_inertial, other.covariance_rad2[right])
    if isinstance(fix, Failure):
        raise InputError(f"{first} and {second}: {fix.detail}")
    between = (second_from_inertial * first_from_inertial.inv()).rotation
    turn = between.as_matrix()
    covariance = other.covariance_rad2[right] + turn @ one.covariance_rad2[left] @ np.swapaxes(turn, 1, 2)
    return InterlockResult(
        alignment=fix,
        et=one.et[left],
        names=tuple((one.names[i], other.names[j]) for i, j in pairs),
        rotation_angles_rad=np.asarray(between.magnitude()),
        sigma_rad=np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)),
        unpaired=len(one.et) - len(pairs) + untimed,
    )


def write_interlock(result: InterlockResult, folder: Path) -> tuple[Path, ...]:
    """Write ``interlock.json``, ``interlock.csv`` (pair by pair) and ``interlock.svg`` (residuals over time)."""
    make_folder(folder)
    files = tuple(folder / f"interlock.{suffix}" for suffix in ("json", "csv", "svg"))
    write_text_atomic(files[0], json.dumps(result.summary(), indent=1, allow_nan=False) + "\n")
    columns = [f"{what}_{axis}_arcsec" for what in ("residual", "sigma") for axis in _AXES]
    write_csv_rows(files[1], ["first", "second", "epoch_utc", "used", "rotation_angle_deg", *columns], _rows(result))
    write_text_atomic(files[2], _figure(result))
    return files


def _series(path: Path) -> tuple[AttitudeSeries, int]:
    """Attitudes with an epoch, and the number of those without."""
    if not path.is_dir():
        series, untimed = read_attitude_table(path)
        if series is None:
            raise DataError(path, "attitudes are paired by time, and no row has an epoch (epoch_utc or et)")
        return series, len(untimed)
    good = [
        (record, attitude)
        for record in load_result(path).attitudes
        if record.outcome.is_usable and (attitude := record.attitude) is not None and attitude.source == "stars"
    ]
    records = [record for record, _ in good if record.et is not None]
    require(bool(records), f"{path}: the run has no attitude from stars with an epoch")
    return attitude_series(records, camera_of_run(path)), len(good) - len(records)


def _pairs(first_et: Float, second_et: Float, tolerance_s: float) -> list[tuple[int, int]]:
    """Indices that are each other's nearest in time, within the tolerance."""
    to_second, to_first = _nearest(first_et, second_et), _nearest(second_et, first_et)
    return [
        (i, j)
        for i, j in enumerate(to_second.tolist())
        if to_first[j] == i and abs(first_et[i] - second_et[j]) <= tolerance_s
    ]


def _nearest(times: Float, others: Float) -> NDArray[np.intp]:
    """For each time the index of the nearest of ``others``, both increasing."""
    after = np.clip(np.searchsorted(others, times), 1, max(len(others) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(others) - 1)
    return np.where(times - others[before] <= others[after] - times, before, after)


def _rows(result: InterlockResult) -> Iterator[list[str | float]]:
    fix = result.alignment
    for k, (first, second) in enumerate(result.names):
        values = [*fix.residuals_rad[k] * ARCSEC_PER_RAD, *result.sigma_rad[k] * ARCSEC_PER_RAD]
        epoch = utc_text(time_from_et(float(result.et[k])))
        angle = float(np.degrees(result.rotation_angles_rad[k]))
        yield [first, second, epoch, int(fix.used[k]), angle, *(f"{value:.6g}" for value in values)]


def _figure(result: InterlockResult) -> str:
    from giantlike.plotting.charts import charts_svg
    from giantlike.plotting.residuals import Series, series_charts

    fix = result.alignment
    hours = (result.et - result.et[0]) / 3600.0
    series = Series(
        label="pairs",
        at=hours,
        values=fix.residuals_rad * ARCSEC_PER_RAD,
        sigma=result.sigma_rad * ARCSEC_PER_RAD,
        suspect=~fix.used,
    )
    panels = [f"about {axis}, arcsec" for axis in _AXES]
    start = utc_text(time_from_et(float(result.et[0])))
    charts = series_charts([series], panels, f"hours from {start} UTC", "Interlock: pairs minus their weighted mean")
    return '<?xml version="1.0" encoding="utf-8"?>\n' + charts_svg(charts, "interlock")


def _arcsec(values_rad: ArrayLike) -> list[float | None]:
    """Arc seconds; None for NaN, as JSON has it."""
    return [finite_or_none(value) for value in (np.asarray(values_rad) * ARCSEC_PER_RAD).tolist()]
