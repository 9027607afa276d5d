"""A priori geometry of images in a table: ``geometry.csv``.

One row per image and target. Every column but ``file`` may be absent or empty:

=============================================  ==========================================================
``file``                                       image file: its base name, or its path relative to the
                                               campaign file where two images share one base name
``epoch_utc``, ``exposure_s``                  mid-exposure, ISO 8601; seconds
``qx``, ``qy``, ``qz``, ``qw``                 a priori camera_from_inertial, scalar last
``target``                                     target name
``target_x_km``, ``target_y_km``,              camera to target center, inertial axes, apparent (light time
``target_z_km``                                and aberration already in; length: light-time distance times
                                               the Doppler factor, which SPICE's LT+S leaves out)
``body_qx``, ``body_qy``, ``body_qz``,         body_from_inertial at the time the light left, scalar last
``body_qw``
``sun_x``, ``sun_y``, ``sun_z``                unit vector target to Sun, inertial
``observer_x_km``, ``observer_y_km``,          spacecraft with respect to the solar system barycenter, inertial axes:
``observer_z_km``, ``observer_vx_km_s``,       position and velocity, all six or none; with them stars get parallax
``observer_vy_km_s``, ``observer_vz_km_s``     and aberration
``target_vx_km_s``, ``target_vy_km_s``,        velocity of the target with respect to the solar system barycenter when
``target_vz_km_s``                             the light left it, inertial axes: with it and the observer, observables
                                               are given with light time removed, too
=============================================  ==========================================================
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float
from giantlike.core.errors import DataError
from giantlike.core.frames import quaternion_xyzw
from giantlike.core.observer import ObserverState
from giantlike.core.time import utc_text
from giantlike.core.values import Value
from giantlike.io.csv_rows import CsvRow, read_csv_rows, write_csv_rows
from giantlike.io.viewing_geometry import StatedGeometry

if TYPE_CHECKING:
    from astropy.time import Time

Cell = TypeVar("Cell")

_ATTITUDE = ("qx", "qy", "qz", "qw")
_TARGET = ("target_x_km", "target_y_km", "target_z_km")
_BODY = ("body_qx", "body_qy", "body_qz", "body_qw")
_SUN = ("sun_x", "sun_y", "sun_z")
_OBSERVER = (
    "observer_x_km", "observer_y_km", "observer_z_km", "observer_vx_km_s", "observer_vy_km_s", "observer_vz_km_s",
)  # fmt: skip
_TARGET_VELOCITY = ("target_vx_km_s", "target_vy_km_s", "target_vz_km_s")
COLUMNS = (
    "file", "epoch_utc", "exposure_s", *_ATTITUDE, "target", *_TARGET, *_BODY, *_SUN, *_OBSERVER, *_TARGET_VELOCITY,
)  # fmt: skip
"""Columns of ``geometry.csv``, in the order in which they are written."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GeometryRow(Value):
    """One row of a geometry table; None for cells that are empty."""

    file: str  # as written in the table
    epoch: Time | None = None  # Mid-exposure
    exposure_s: float | None = None
    camera_from_inertial: Rotation | None = None  # a priori attitude
    target: str | None = None
    target_position_inertial_km: Float | None = None  # apparent vector from camera to target center
    body_from_inertial: Rotation | None = None  # orientation of the target when the light left it
    sun_direction_inertial: Float | None = None  # unit vector from target to Sun
    observer: ObserverState | None = None  # state of the spacecraft with respect to the solar system barycenter
    target_velocity_inertial_km_s: Float | None = None  # from the barycenter, when the light left the target
    line: int = 0  # line in the file, 0 for a row that was not read from one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageGeometry(Value):
    """Geometry of one image, from all its rows of a table."""

    epoch: Time | None
    exposure_s: float | None
    camera_from_inertial: Rotation | None
    observer: ObserverState | None
    targets: Mapping[str, GeometryRow]  # the rows with a target, by its name
    # geometry in camera axes of targets without a row, by name
    seen: Mapping[str, StatedGeometry] = field(default_factory=dict)
    covariance_attitude_rad2: Float | None = None  # of the attitude that follows from them, about the camera axes
    in_body_axes: bool = False  # SPICE gives the attitude, or axes of the body are inertial


@dataclass(frozen=True, slots=True, eq=False)
class GeometryTable(Value):
    """A geometry table."""

    path: Path
    # in file order; no two have the same ``file`` and ``target``, and all rows of a file agree on epoch, exposure,
    # attitude and observer where they give them
    rows: tuple[GeometryRow, ...]
    # geometry of images in a folder of SUMFILEs, in place of rows
    images: Mapping[Path, ImageGeometry] = field(default_factory=dict)

    def image(self, file: str) -> ImageGeometry | None:
        """Geometry of one image. Returns None when it is not there."""
        rows = [row for row in self.rows if row.file == file]
        return _merge_rows(rows) if rows else None

    def match(self, images: Sequence[str | Path], base: str | Path) -> dict[Path, ImageGeometry]:
        """Geometry of each of a campaign's images; images that the table does not name are left out."""
        groups: dict[str, list[GeometryRow]] = {}
        for row in self.rows:
            groups.setdefault(row.file, []).append(row)
        by_path = {_absolute(Path(base) / file): file for file in groups}
        chosen: dict[Path, str] = {}
        by_name: dict[str, list[Path]] = {}
        for image in map(Path, images):
            if _absolute(image) in by_path:
                chosen[image] = by_path[_absolute(image)]
            elif image.name in groups:
                by_name.setdefault(image.name, []).append(image)
        for name, sharing in by_name.items():
            if len(sharing) > 1:
                raise DataError(
                    self.path,
                    f"line {groups[name][0].line}, column file: {name!r} is the base name of {len(sharing)} images "
                    f"({sharing[0]}, {sharing[1]}): write their paths relative to the campaign file",
                )
            chosen[sharing[0]] = name
        return {image: _merge_rows(groups[file]) for image, file in chosen.items()} | dict(self.images)


def read_geometry(path: str | Path, *, default_target: str | None = None) -> GeometryTable:
    """Read a geometry table.

    Parameters
    ----------
    path : path-like
    default_target : str, optional; name for rows that leave ``target`` empty; for campaigns with one target

    Raises
    ------
    DataError
        Names file, line, column and value: unknown, repeated or missing columns; cells that are not a number or
        epoch; groups that are half filled; a quaternion or Sun vector that is not unit to 1e-3; target
        geometry without a target name; two rows for one file and target, or rows of one file that disagree.
    """
    rows = [_row(row, default_target) for row in read_csv_rows(path, COLUMNS, ("file",))]
    table = GeometryTable(Path(path), tuple(rows))
    _check_consistency(table)
    return table


def write_geometry(path: str | Path, rows: Iterable[GeometryRow]) -> None:
    """Write a geometry table atomically, with numbers at full precision and epochs to the microsecond.

    The columns of the observer and of the target's velocity are there only when a row has one.

    Parameters
    ----------
    path : path-like
    rows : iterable of GeometryRow

    Raises
    ------
    DataError
        The file cannot be written.
    """
    rows = list(rows)
    unused: set[str] = set()
    if all(row.observer is None for row in rows):
        unused |= set(_OBSERVER)
    if all(row.target_velocity_inertial_km_s is None for row in rows):
        unused |= set(_TARGET_VELOCITY)
    kept = [index for index, name in enumerate(COLUMNS) if name not in unused]
    write_csv_rows(path, [COLUMNS[index] for index in kept], ([_cells(row)[index] for index in kept] for row in rows))


def _cells(row: GeometryRow) -> list[str | float | None]:
    """Values of a row in the order of :data:`COLUMNS`."""
    attitude, body, observer = row.camera_from_inertial, row.body_from_inertial, row.observer
    return [
        row.file,
        None if row.epoch is None else utc_text(row.epoch),
        None if row.exposure_s is None else float(row.exposure_s),
        *_numbers(None if attitude is None else quaternion_xyzw(attitude), 4),
        row.target,
        *_numbers(row.target_position_inertial_km, 3),
        *_numbers(None if body is None else quaternion_xyzw(body), 4),
        *_numbers(row.sun_direction_inertial, 3),
        *_numbers(None if observer is None else observer.position_km, 3),
        *_numbers(None if observer is None else observer.velocity_km_s, 3),
        *_numbers(row.target_velocity_inertial_km_s, 3),
    ]


def _numbers(vector: Float | None, count: int) -> list[float | None]:
    return [None] * count if vector is None else np.asarray(vector, dtype=np.float64).tolist()


def _row(row: CsvRow, default_target: str | None) -> GeometryRow:
    exposure_s = row.number("exposure_s")
    if exposure_s is not None and exposure_s < 0:
        raise row.error("exposure_s", "an exposure time >= 0 is needed")
    position = row.vector(_TARGET)
    if position is not None and not np.any(position):
        raise row.error(_TARGET[0], "a vector from camera to target is needed, not zero")
    body_from_inertial, sun = row.rotation(_BODY), row.direction(_SUN)
    state = row.vector(_OBSERVER)
    velocity = row.vector(_TARGET_VELOCITY)
    described = any(known is not None for known in (position, body_from_inertial, sun, velocity))
    target = row.text("target") or (default_target if described else None)
    if described and target is None:
        raise row.error("target", "a target name is needed where its geometry is given")
    return GeometryRow(
        file=row.require(row.text("file"), ("file",)),
        epoch=row.utc("epoch_utc"),
        exposure_s=exposure_s,
        camera_from_inertial=row.rotation(_ATTITUDE),
        target=target,
        target_position_inertial_km=position,
        body_from_inertial=body_from_inertial,
        sun_direction_inertial=sun,
        observer=None if state is None else ObserverState(position_km=state[:3], velocity_km_s=state[3:]),
        target_velocity_inertial_km_s=velocity,
        line=row.line,
    )


def _check_consistency(table: GeometryTable) -> None:
    uses = Counter(row.file for row in table.rows)
    seen: dict[tuple[str, str | None], int] = {}
    first: dict[tuple[str, str], tuple[str, int]] = {}
    for row in table.rows:
        earlier = seen.setdefault((row.file, row.target), row.line)
        if earlier != row.line:
            raise DataError(
                table.path,
                f"line {row.line}, column target: {row.file!r} with target {row.target or ''!r} is already in "
                f"line {earlier}",
            )
        if uses[row.file] == 1:
            continue
        attitude, observer = row.camera_from_inertial, row.observer
        shared = {
            "epoch_utc": "" if row.epoch is None else utc_text(row.epoch),
            "exposure_s": "" if row.exposure_s is None else repr(row.exposure_s),
            "qx": "" if attitude is None else str(quaternion_xyzw(attitude).round(12).tolist()),
            "observer_x_km": "" if observer is None else str([*observer.position_km, *observer.velocity_km_s]),
        }
        for column, value in shared.items():
            if not value:
                continue
            known, line = first.setdefault((row.file, column), (value, row.line))
            if known != value:
                raise DataError(
                    table.path,
                    f"line {row.line}, column {column}: {row.file!r} has {known} in line {line}, got {value}",
                )


def _merge_rows(rows: list[GeometryRow]) -> ImageGeometry:
    return ImageGeometry(
        epoch=_first(row.epoch for row in rows),
        exposure_s=_first(row.exposure_s for row in rows),
        camera_from_inertial=_first(row.camera_from_inertial for row in rows),
        observer=_first(row.observer for row in rows),
        targets={row.target: row for row in rows if row.target is not None},
    )


def _first(values: Iterable[Cell | None]) -> Cell | None:
    return next((value for value in values if value is not None), None)


def _absolute(path: Path) -> str:
    return os.path.abspath(path)
