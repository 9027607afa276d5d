"""Comparison of a run with the truth: errors and the sigmas that the run reported for them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.core.arrays import Float, unit
from giantlike.core.errors import DataError
from giantlike.core.frames import rotate, rotation_between, rotation_from_xyzw
from giantlike.core.units import RAD_PER_ARCSEC
from giantlike.core.values import Value
from giantlike.io.run_tables import AttitudeRow, ObservationRow
from giantlike.io.tables import read_rows
from giantlike.simulation.write import TruthRow

_GRID = 5  # points along each side of the frame over which the shift of an attitude error is averaged


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AttitudeError(Value):
    """Error of the attitude of one image."""

    file: str  # as in ``attitudes.csv``
    source: str  # as in ``attitudes.csv``
    status: str  # as in ``attitudes.csv``
    reason: str  # as in ``attitudes.csv``
    error_px: Float | None = None  # (2,); rms shift of the image by the error, over the frame, per axis
    sigma_px: Float | None = None  # (2,); as above, by the three reported sigmas about the camera axes
    normalized: Float | None = None  # (3,); errors about the camera axes over their reported sigmas


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObservationError(Value):
    """Error of one estimator on one image."""

    file: str  # as in ``observations.csv``
    target: str  # as in ``observations.csv``
    estimator: str  # as in ``observations.csv``
    status: str  # as in ``observations.csv``
    reason: str  # as in ``observations.csv``
    diameter_px: float  # diameter_px, phase_deg: True apparent diameter and phase angle
    phase_deg: float
    error_px: Float | None = None  # error_px, sigma_px: (2,); measured minus true center; reported sigmas
    sigma_px: Float | None = None
    nees: float | None = None  # squared error by the reported covariance (2 x 2): 2 on average where correct
    range_error: float | None = None  # range_error, range_sigma: relative: measured minus true, and reported
    range_sigma: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TruthComparison(Value):
    """Errors of a whole run: one entry per row of its tables, and the truth that they are counted from."""

    truth: tuple[TruthRow, ...]  # every image, whether the run holds it or not
    attitudes: tuple[AttitudeError, ...]
    observations: tuple[ObservationError, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ErrorSummary(Value):
    """Errors of many fixes and their reported sigmas."""

    n_images: int  # rows in the table
    n_fixes: int  # number of fixes with status ``ok``; only these count below
    n_suspect: int  # number of fixes with status ``suspect``
    failures: Mapping[str, int]  # number of failed rows by reason
    rms_px: Float  # rms_px, sigma_px: (2,); rms of errors and of reported sigmas, per axis; NaN without fixes
    sigma_px: Float
    chi2: float  # chi2, dof: sum of squared normalized errors and number of them, without the range
    dof: int
    range_rms: float  # range_rms, range_sigma, range_chi2: relative errors, relative sigmas, sum of squares; or NaN
    range_sigma: float
    range_chi2: float
    n_ranges: int  # number of ranges


def compare_run(run: Path, truth: Path, camera: Camera) -> TruthComparison:
    """Read the tables of a run folder and compare them with a truth table."""
    true_rows = {row.file: row for row in read_rows(truth, TruthRow)}
    return TruthComparison(
        truth=tuple(true_rows.values()),
        attitudes=tuple(
            _attitude_error(row, _true_row(true_rows, row.file, truth), camera)
            for row in read_rows(run / "attitudes.csv", AttitudeRow)
        ),
        observations=tuple(
            _observation_error(row, _true_row(true_rows, row.file, truth))
            for row in read_rows(run / "observations.csv", ObservationRow)
        ),
    )


def score_attitudes(errors: Sequence[AttitudeError]) -> ErrorSummary:
    """Summarize attitudes; normalized errors count one by one, about three axes."""
    good = [error for error in errors if error.status == "ok" and error.error_px is not None]
    normalized = np.array([error.normalized for error in good if error.normalized is not None])
    return _score(
        errors,
        np.array([error.error_px for error in good]).reshape(-1, 2),
        np.array([error.sigma_px for error in good if error.sigma_px is not None]).reshape(-1, 2),
        chi2=float(np.sum(normalized**2)),
        dof=int(normalized.size),
        ranges=np.zeros((0, 2)),
    )


def score_observations(errors: Sequence[ObservationError]) -> ErrorSummary:
    """Summarize centers and ranges."""
    good = [error for error in errors if error.status == "ok" and error.error_px is not None]
    ranges = [[error.range_error, error.range_sigma] for error in good if error.range_error is not None]
    return _score(
        errors,
        np.array([error.error_px for error in good]).reshape(-1, 2),
        np.array([error.sigma_px for error in good]).reshape(-1, 2),
        chi2=float(sum(error.nees for error in good if error.nees is not None)),
        dof=2 * len(good),
        ranges=np.array(ranges, dtype=np.float64).reshape(-1, 2),
    )


def _score(
    errors: Sequence[AttitudeError] | Sequence[ObservationError],
    error_px: Float,
    sigma_px: Float,
    *,
    chi2: float,
    dof: int,
    ranges: Float,
) -> ErrorSummary:
    failures = Counter(error.reason for error in errors if error.status == "failed")
    return ErrorSummary(
        n_images=len(errors),
        n_fixes=len(error_px),
        n_suspect=sum(error.status == "suspect" for error in errors),
        failures=MappingProxyType(dict(sorted(failures.items()))),
        rms_px=_rms(error_px),
        sigma_px=_rms(sigma_px),
        chi2=chi2,
        dof=dof,
        range_rms=float(_rms(ranges)[0]),
        range_sigma=float(_rms(ranges)[1]),
        range_chi2=float(np.sum((ranges[:, 0] / ranges[:, 1]) ** 2)) if len(ranges) else np.nan,
        n_ranges=len(ranges),
    )


def _rms(values: Float) -> Float:
    """Root mean square (2,) of values (n, 2); NaN where there are none."""
    return np.sqrt(np.mean(values**2, axis=0)) if len(values) else np.full(2, np.nan)


def _attitude_error(row: AttitudeRow, true_row: TruthRow, camera: Camera) -> AttitudeError:
    entry = AttitudeError(file=row.file, source=row.source or "", status=row.status, reason=row.reason or "")
    if row.status == "failed" or row.qx is None:
        return entry
    found, true = (rotation_from_xyzw(_floats(each.qx, each.qy, each.qz, each.qw)) for each in (row, true_row))
    error_rad = rotation_between(found, true)
    entry = replace(entry, error_px=_shift_px(camera, error_rad))
    if row.sigma_x_arcsec is None:
        return entry
    sigma_rad = _floats(row.sigma_x_arcsec, row.sigma_y_arcsec, row.sigma_z_arcsec) * RAD_PER_ARCSEC
    by_axis = [_shift_px(camera, axis) for axis in np.diag(sigma_rad)]
    return replace(entry, sigma_px=np.sqrt(np.sum(np.square(by_axis), axis=0)), normalized=error_rad / sigma_rad)


def _shift_px(camera: Camera, rotvec_rad: Float) -> Float:
    """Root mean square shift (2,) of the image by a small rotation (3,) about the camera axes, px."""
    x = np.linspace(0.0, camera.columns - 1.0, _GRID)
    y = np.linspace(0.0, camera.rows - 1.0, _GRID)
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    directions = camera.model.unproject(points)
    moved = camera.model.project(unit(rotate(Rotation.from_rotvec(rotvec_rad), directions)))
    return _rms(moved - points)


def _observation_error(row: ObservationRow, true_row: TruthRow) -> ObservationError:
    entry = ObservationError(
        file=row.file,
        target=row.target,
        estimator=row.estimator,
        status=row.status,
        reason=row.reason or "",
        diameter_px=true_row.diameter_px,
        phase_deg=true_row.phase_deg,
    )
    if row.status == "failed":
        return entry
    error = _floats(row.x_px, row.y_px) - _floats(true_row.x_px, true_row.y_px)
    sigma = _floats(row.sigma_x_px, row.sigma_y_px)
    cross = (row.rho_xy or 0.0) * sigma[0] * sigma[1]
    covariance = np.array([[sigma[0] ** 2, cross], [cross, sigma[1] ** 2]])
    nees = float(error @ np.linalg.solve(covariance, error))
    entry = replace(entry, error_px=error, sigma_px=sigma, nees=nees)
    if row.range_km is None or row.sigma_range_km is None:
        return entry
    true_km = true_row.range_km
    return replace(entry, range_error=row.range_km / true_km - 1.0, range_sigma=row.sigma_range_km / true_km)


def _true_row(true_rows: Mapping[str, TruthRow], file: str, truth: Path) -> TruthRow:
    if file not in true_rows:
        raise DataError(truth, f"has no row for {file!r}, which the run holds")
    return true_rows[file]


def _floats(*values: float | None) -> Float:
    """Values of cells (n,); NaN where a cell is empty."""
    return np.array(values, dtype=np.float64)
