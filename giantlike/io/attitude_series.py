"""Attitudes of a camera at many times, in memory and as CSV files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, as_finite, require
from giantlike.core.errors import DataError
from giantlike.core.frames import INERTIAL_FRAME, FrameRotation, quaternion_xyzw
from giantlike.core.time import time_from_et, utc_text
from giantlike.core.values import Value
from giantlike.io.csv_rows import CsvRow, read_csv_rows, write_csv_rows

_UPPER = np.triu_indices(3)
_QUATERNION = ("qx", "qy", "qz", "qw")
_COVARIANCE = ("cov_xx_rad2", "cov_xy_rad2", "cov_xz_rad2", "cov_yy_rad2", "cov_yz_rad2", "cov_zz_rad2")
_COLUMNS = ("name", "epoch_utc", "et", *_QUATERNION, *_COVARIANCE)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AttitudeSeries(Value):
    """Attitudes in order of time."""

    et: Float  # (n,); increasing; no two are equal
    camera_from_inertial: Rotation  # n of them
    covariance_rad2: Float  # (n, 3, 3); of the small rotations about the camera axes; not a number where unknown
    names: tuple[str, ...]  # names of the images
    frame: str = ""  # name of the axes that the attitudes refer to; empty when unknown

    def __post_init__(self) -> None:
        count = len(self.names)
        require(count > 0, "no attitude: there is nothing to write")
        object.__setattr__(self, "et", as_finite(self.et, (count,), "et"))
        covariance = np.asarray(self.covariance_rad2, dtype=np.float64)
        require(covariance.shape == (count, 3, 3), f"covariance_rad2 must be ({count}, 3, 3), got {covariance.shape}")
        require(len(self.camera_from_inertial) == count, f"{count} names, {len(self.camera_from_inertial)} rotations")
        for index in np.flatnonzero(np.diff(self.et) <= 0.0):
            first, second = self.names[index], self.names[index + 1]
            require(False, f"times must increase: {first!r} and {second!r} are at et {self.et[index]:.6f} and before")
        Value.__post_init__(self)

    @property
    def quaternions_xyzw(self) -> Float:
        """(n, 4) ``camera_from_inertial``, scalar last; neighbors have the same sign."""
        quaternions = quaternion_xyzw(self.camera_from_inertial)
        turns = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
        quaternions[1:][np.cumsum(turns) % 2 == 1] *= -1.0
        return quaternions

    def attitudes(self, index: slice | NDArray[np.intp] = slice(None)) -> FrameRotation:
        """Return attitudes (all by default) with the names of their frames. ``index`` slice or (k,)."""
        return FrameRotation(rotation=self.camera_from_inertial[index], target=self.frame, source=INERTIAL_FRAME)

    def rotate(self, turn: FrameRotation) -> AttitudeSeries:
        """Return the series of another frame that is fixed with respect to this one."""
        product, matrix = turn * self.attitudes(), turn.rotation.as_matrix()
        return replace(
            self,
            camera_from_inertial=product.rotation,
            covariance_rad2=matrix @ self.covariance_rad2 @ matrix.T,
            frame=product.target,
        )

    def segments(self, max_gap_s: float) -> tuple[slice, ...]:
        """Runs of attitudes without long gaps, over which one may interpolate.

        >>> import numpy as np
        >>> still = Rotation.from_rotvec(np.zeros((3, 3)))
        >>> unknown = np.full((3, 3, 3), np.nan)
        >>> et = np.array([0.0, 1.0, 9.0])
        >>> series = AttitudeSeries(et=et, camera_from_inertial=still, covariance_rad2=unknown, names=("a", "b", "c"))
        >>> series.segments(2.0)
        (slice(0, 2, None), slice(2, 3, None))
        """
        require(max_gap_s >= 0.0, f"max_gap_s must be >= 0, got {max_gap_s}")
        breaks = (np.flatnonzero(np.diff(self.et) > max_gap_s) + 1).tolist()
        return tuple(slice(a, b) for a, b in zip([0, *breaks], [*breaks, len(self.et)], strict=True))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UntimedAttitude(Value):
    """Attitude of an image whose time is not known."""

    name: str  # of the image
    camera_from_inertial: Rotation
    covariance_rad2: Float  # not a number where unknown


def write_attitude_csv(
    path: str | Path, series: AttitudeSeries | None, untimed: Sequence[UntimedAttitude] = ()
) -> None:
    """Write attitudes as a table: image, UTC, et, quaternion ``camera_from_inertial`` (scalar last), covariance.

    The covariance is the upper triangle by rows, rad^2, about the camera axes; empty where unknown.
    """
    rows: list[list[str | float | None]] = []
    if series is not None:
        columns = (series.names, series.et.tolist(), series.quaternions_xyzw.tolist(), series.covariance_rad2)
        for name, et, quaternion, covariance in zip(*columns, strict=True):
            rows.append([name, utc_text(time_from_et(et)), et, *quaternion, *_terms(covariance)])
    for one in untimed:
        quaternion = quaternion_xyzw(one.camera_from_inertial).tolist()
        rows.append([one.name, None, None, *quaternion, *_terms(one.covariance_rad2)])
    write_csv_rows(path, _COLUMNS, rows)


def read_attitude_csv(path: str | Path) -> AttitudeSeries:
    """Read a table of attitudes, in any order of time, with columns of :func:`write_attitude_csv`.

    ``epoch_utc`` or ``et`` and the quaternion are needed.
    """
    series, untimed = read_attitude_table(path)
    if untimed or series is None:
        raise DataError(Path(path), f"{untimed[0].name}: an epoch is needed in every row, in epoch_utc or et")
    return series


def read_attitude_table(path: str | Path) -> tuple[AttitudeSeries | None, tuple[UntimedAttitude, ...]]:
    """Read a table of attitudes of which some, or all, may have no epoch."""
    rows = read_csv_rows(path, _COLUMNS, _QUATERNION)
    untimed = tuple(_parse_untimed(row) for row in rows if not _has_epoch(row))
    parts = sorted((_parse_row(row) for row in rows if _has_epoch(row)), key=lambda part: part[0])
    if untimed and not parts:
        return None, untimed
    series = AttitudeSeries(
        et=np.array([et for et, _, _, _ in parts]),
        camera_from_inertial=Rotation.from_quat(
            np.reshape([rotation.as_quat() for _, rotation, _, _ in parts], (-1, 4))
        ),
        covariance_rad2=np.reshape([covariance for _, _, covariance, _ in parts], (-1, 3, 3)),
        names=tuple(name for _, _, _, name in parts),
    )
    return series, untimed


def _terms(covariance: Float) -> list[float | None]:
    """Upper triangle (6,) of a covariance (3, 3), None where it is unknown."""
    return covariance[_UPPER].tolist() if bool(np.isfinite(covariance).all()) else [None] * 6


def _has_epoch(row: CsvRow) -> bool:
    return bool(row.text("epoch_utc") or row.text("et"))


def _parse_untimed(row: CsvRow) -> UntimedAttitude:
    rotation, covariance = _parse_attitude(row)
    name = row.text("name")
    if name is None:
        raise row.error("name", "a row needs epoch_utc or et, or the name of its image")
    return UntimedAttitude(name=name, camera_from_inertial=rotation, covariance_rad2=covariance)


def _parse_row(row: CsvRow) -> tuple[float, Rotation, Float, str]:
    """Epoch, attitude, covariance (3, 3) and name of a row."""
    rotation, covariance = _parse_attitude(row)
    return row.et(), rotation, covariance, row.text("name") or f"line {row.line}"


def _parse_attitude(row: CsvRow) -> tuple[Rotation, Float]:
    """Attitude of a row and its covariance (3, 3), not a number where unknown."""
    rotation, terms = row.require(row.rotation(_QUATERNION), _QUATERNION), row.vector(_COVARIANCE)
    covariance = np.full((3, 3), np.nan)
    if terms is not None:
        covariance[_UPPER] = terms
        covariance.T[_UPPER] = terms
        if not np.linalg.eigvalsh(covariance)[0] > 0.0:
            raise row.error("cov_xx_rad2", "the covariance must be positive definite")
    return rotation, covariance
