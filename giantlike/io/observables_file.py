"""Columns of the observables file, and the file: Parquet with the meaning of each column in it, or JSON lines.

The file is for a filter that estimates an orbit: one row is one observation, lists have fixed lengths, matrices are
given by rows, and a value that is not known is null.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike._system.atomic import replacing
from giantlike._system.reading import check_declared_bytes, reads
from giantlike.core.arrays import require
from giantlike.core.causes import Cause
from giantlike.core.errors import DataError
from giantlike.core.values import Value
from giantlike.io.tables import arrow_schema, column, columns_of

FORMAT, FORMAT_VERSION = "giantlike observables", "1"  # metadata of the file: its kind, and the version of its columns
ROWS_OF_A_GROUP = 4096
_ROW_BYTES = 1000  # of memory of a row: a hundred columns, most of them numbers
"""Rows of a group of the Parquet file: some megabytes, at any number of images."""
_ICRF = "ICRF"
_CAMERA = "camera"
_PLACE = "(pixel, line, apparent range)"
_PLACE_UNITS = "px, px, km"
_MATRIX = "(3 x 3, by rows; without a range the last row and column are null)"


def _part(cause: Cause, what: str, shared: str) -> Any:
    """Column of a part of the covariance."""
    text = f"Part of `covariance` by {what}. Shared by rows with the same `{shared}`."
    return column(text, _PLACE_UNITS, str(cause), size=9)


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservableRow:
    """One row per observation: an image, a target and an estimator (`kind` body), a landmark of one, or a star.

    *Apparent* values are as the camera saw them: light time and stellar aberration are in. *Astrometric* is without
    stellar aberration: from the spacecraft at the epoch to the target when the light left it. *Geometric* is without
    light time, too: from the spacecraft to the target, both at the epoch. `o_minus_c` is observed minus computed by the
    a priori geometry and the attitude of the row. A covariance describes the errors of the measurement; the ephemeris
    of the target, which a filter estimates, is not in it. Partials are derivatives of (pixel, line, apparent range) by
    the true value of something, all else being equal.
    """

    kind: str = column("`body` (the origin of its shape model), `landmark` or `star`.")
    file: str = column("Image file, as in `attitudes`.")
    target: str | None = column("Name of the target; null for a star.")
    estimator: str | None = column("Name of the estimator; null for a star.")
    feature: str | None = column("Name of the landmark; catalog number of the star.")
    status: str = column("`ok`, or `suspect` (a named check objects).")
    accepted_by: str | None = column("User who accepted a suspect result.")
    accepted_why: str | None = column("The reason.")
    flags: str | None = column("Names of quality flags, joined by `|`.")
    preferred: bool = column("True for the one fix of a target in an image that a filter should take.")
    preferred_reason: str | None = column("Why this fix is preferred, or why another is; of bodies.")
    epoch_utc: str | None = column("Mid-exposure, ISO 8601.", "UTC")
    epoch_et_s: float | None = column("Mid-exposure, seconds past J2000.", "TDB s")
    exposure_s: float | None = column("Exposure.", "s")
    light_time_s: float | None = column("Light time, by the measured range or, without one, the predicted.", "s")
    emission_et_s: float | None = column("When the light left the target, seconds past J2000.", "TDB s")

    observed_pixel_px: float = column("Measured column; 0 is the center of the first.", "px", "distorted image")
    observed_line_px: float = column("Measured row; 0 is the center of the first.", "px", "distorted image")
    observed_apparent_range_km: float | None = column("Measured apparent range; null where only a direction is.", "km")
    computed_pixel_px: float | None = column("Computed column.", "px", "distorted image")
    computed_line_px: float | None = column("Computed row.", "px", "distorted image")
    computed_apparent_range_km: float | None = column("Computed apparent range.", "km")
    o_minus_c_pixel_px: float | None = column("Observed less computed column.", "px", "distorted image")
    o_minus_c_line_px: float | None = column("Observed less computed row.", "px", "distorted image")
    o_minus_c_apparent_range_km: float | None = column("Observed less computed apparent range.", "km")

    apparent_direction_icrf: Sequence[float] | None = column("Measured apparent unit vector.", "", _ICRF, size=3)
    apparent_ra_deg: float | None = column("Its right ascension.", "deg", _ICRF)
    apparent_dec_deg: float | None = column("Its declination.", "deg", _ICRF)
    apparent_position_icrf_km: Sequence[float] | None = column(
        "Measured apparent vector from camera to target; its length is the range by which sizes in the image go.",
        "km",
        _ICRF,
        size=3,
    )
    astrometric_direction_icrf: Sequence[float] | None = column("The same without aberration.", "", _ICRF, size=3)
    astrometric_ra_deg: float | None = column("Its right ascension.", "deg", _ICRF)
    astrometric_dec_deg: float | None = column("Its declination.", "deg", _ICRF)
    astrometric_position_icrf_km: Sequence[float] | None = column(
        "Measured vector from the spacecraft at the epoch to the target when the light left it.", "km", _ICRF, size=3
    )
    geometric_direction_icrf: Sequence[float] | None = column(
        "The same without light time either; null where the motion of the target is not known.", "", _ICRF, size=3
    )
    geometric_ra_deg: float | None = column("Its right ascension.", "deg", _ICRF)
    geometric_dec_deg: float | None = column("Its declination.", "deg", _ICRF)
    geometric_position_icrf_km: Sequence[float] | None = column(
        "Measured vector from the spacecraft to the target, both at the epoch.", "km", _ICRF, size=3
    )

    sigma_pixel_px: float | None = column("One sigma of the measured column, of all causes.", "px")
    sigma_line_px: float | None = column("One sigma of the measured row, of all causes.", "px")
    sigma_range_km: float | None = column("One sigma of the measured range, of all causes.", "km")
    correlation_pixel_line: float | None = column("Correlation of column and row.")
    correlation_pixel_range: float | None = column("Correlation of column and range.")
    correlation_line_range: float | None = column("Correlation of row and range.")
    sigma_ra_cos_dec_arcsec: float | None = column("One sigma of the direction to the east.", "arcsec", _ICRF)
    sigma_dec_arcsec: float | None = column("One sigma of the direction to the north.", "arcsec", _ICRF)
    correlation_ra_dec: float | None = column("Correlation of east and north.")
    covariance: Sequence[float] | None = column(
        f"Covariance of {_PLACE} of all causes but the ephemeris of the target {_MATRIX}; null where the uncertainty "
        "of the attitude is not known. Of stars, the noise alone: the attitude follows from them.",
        _PLACE_UNITS,
        size=9,
    )
    covariance_position_icrf_km2: Sequence[float] | None = column(
        "Covariance of the measured position by the same causes (3 x 3, by rows).", "km²", _ICRF, size=9
    )
    part_noise: Sequence[float] | None = _part(Cause.NOISE, "noise of the pixels", "shared_image")
    part_background: Sequence[float] | None = _part(Cause.BACKGROUND, "other light", "shared_image")
    part_psf: Sequence[float] | None = _part(Cause.PSF, "the point spread function", "shared_camera")
    part_edge: Sequence[float] | None = _part(Cause.EDGE, "the profile of the limb", "shared_camera")
    part_camera: Sequence[float] | None = _part(Cause.CAMERA, "the camera model", "shared_camera")
    part_attitude: Sequence[float] | None = _part(Cause.ATTITUDE, "the attitude", "shared_attitude")
    part_aberration: Sequence[float] | None = _part(Cause.ABERRATION, "the observer's velocity", "shared_camera")
    part_epoch: Sequence[float] | None = _part(Cause.EPOCH, "the epoch of the stars", "shared_camera")
    part_reflectance: Sequence[float] | None = _part(Cause.REFLECTANCE, "the reflectance law", "shared_body")
    part_albedo: Sequence[float] | None = _part(Cause.ALBEDO, "markings of the surface", "shared_body")
    part_relief: Sequence[float] | None = _part(Cause.RELIEF, "relief beyond the shape model", "shared_body")
    part_altitude: Sequence[float] | None = _part(Cause.ALTITUDE, "the altitude of the limb", "shared_body")
    part_shape_scale: Sequence[float] | None = _part(Cause.SHAPE_SCALE, "the size of the shape", "shared_body")
    part_pole: Sequence[float] | None = _part(Cause.POLE, "the pole of the body", "shared_body")
    part_spin: Sequence[float] | None = _part(Cause.SPIN, "the rotation of the body about its pole", "shared_body")
    part_sun: Sequence[float] | None = _part(Cause.SUN, "the direction of the Sun", "shared_body")
    part_orientation: Sequence[float] | None = _part(
        Cause.ORIENTATION, "the body being turned in the image with the attitude", "shared_attitude"
    )

    shared_image: str = column("Rows with the same key come from the same pixels: never take two of a target as two.")
    shared_attitude: str | None = column("Rows with the same key have the same attitude and its error.")
    shared_camera: str = column("Rows with the same key have the same camera, its calibration and their errors.")
    shared_body: str | None = column("Rows with the same key have the same shape, pole, reflectance and their errors.")
    shared_landmark: str | None = column("Rows with the same key show the same landmark and have its error.")
    attitude_source: str | None = column("`stars`, `interpolated` or `a_priori`.")
    attitude_images: Sequence[str] | None = column("Star images that the attitude is made of.")
    attitude_weights: Sequence[float] | None = column("Share of each in it.")
    camera_from_icrf_xyzw: Sequence[float] | None = column(
        "Quaternion of the attitude used, scalar last.", "", "camera from ICRF", size=4
    )
    attitude_covariance_rad2: Sequence[float] | None = column(
        "Covariance of the small rotation about the camera axes that `part_attitude` goes back to (3 x 3, by rows).",
        "rad²",
        _CAMERA,
        size=9,
    )
    camera_rate_rad_s: Sequence[float] | None = column(
        "Rotation rate of the camera: by the CK of the campaign, else by the attitudes of the images before and after, "
        "at most 600 s away, where the rates from and to them agree to 10 % or three sigmas. They do not tell a steady "
        "rotation from equal steps with halts.",
        "rad/s",
        _CAMERA,
        size=3,
    )
    sigma_shape_scale: float | None = column("One sigma, relative, that `part_shape_scale` goes back to.")
    sigma_pole_rad: float | None = column("One sigma about each axis that `part_pole` goes back to.", "rad", "body")
    sigma_spin_rad: float | None = column("One sigma that `part_spin` goes back to.", "rad", "body")
    sigma_ephemeris_km: float | None = column(
        "Largest sigma, along any axis, of the a priori position; in no covariance.", "km"
    )
    covariance_ephemeris_icrf_km2: Sequence[float] | None = column(
        "Covariance of the a priori position in this image (3 x 3, by rows); in no covariance.", "km²", _ICRF, size=9
    )
    sigma_sun_rad: float | None = column(
        "One sigma about each axis across the Sun that `part_sun` goes back to.", "rad"
    )

    partial_camera_position: Sequence[float] | None = column(
        "By the position of the spacecraft at the epoch (3 x 3, by rows); the last row, of the range, is computed even "
        "where no range was measured.",
        "px/km, px/km, km/km",
        _ICRF,
        size=9,
    )
    partial_target_position: Sequence[float] | None = column(
        "By the position of the target, moved as a whole along its path (3 x 3, by rows).",
        "px/km, px/km, km/km",
        _ICRF,
        size=9,
    )
    partial_attitude: Sequence[float] | None = column(
        "By the small rotation `e` about the camera axes, camera_true = Exp(e) camera (3 x 3, by rows).",
        "px/rad, px/rad, km/rad",
        _CAMERA,
        size=9,
    )
    partial_time_tag: Sequence[float] | None = column(
        "By the lateness of this exposure after `epoch_et_s`: the motion of target and spacecraft and, unless "
        "the attitude is from its own stars, the rotation of the camera; null where the velocities, or "
        "`camera_rate_rad_s` where it is needed, are not known; of bodies and landmarks.",
        "px/s, px/s, km/s",
        size=3,
    )
    partial_focal_length: Sequence[float] | None = column(
        "By the focal length, relative: pixels grow with the true one, and the range from a size in the image shrinks.",
        "px, px, km",
        size=3,
    )
    partial_shape_scale: Sequence[float] | None = column(
        "By the size of the body, relative: a range from a size in the image is short by what the true body is larger "
        "than the declared one; null where it was not computed (no range, and no sigma declared).",
        "px, px, km",
        size=3,
    )
    partial_pole: Sequence[float] | None = column(
        "By small rotations of the body about its x and y axes (3 x 2, by rows); of landmarks always, of bodies null "
        "where no sigma is declared.",
        "px/rad, px/rad, km/rad",
        "body",
        size=6,
    )
    partial_landmark: Sequence[float] | None = column(
        "By the position of the landmark on the body (3 x 3, by rows; the range is not measured).",
        "px/km, px/km, km/km",
        "body",
        size=9,
    )
    partial_spin: Sequence[float] | None = column(
        "By a small rotation of the body about its z axis; null where no sigma is declared.",
        "px/rad, px/rad, km/rad",
        "body",
        size=3,
    )
    partial_sun: Sequence[float] | None = column(
        "By a small rotation of the direction of the Sun about the camera axes (3 x 3, by rows), zero about that "
        "direction; null where no sigma is declared.",
        "px/rad, px/rad, km/rad",
        _CAMERA,
        size=9,
    )
    partial_camera_parameters: Sequence[float] | None = column(
        "By the uncertain parameters of the camera, with the attitude from stars that follows them (3 x m, by rows); "
        "their names and covariance are in the metadata `camera_parameters`.",
        "px, px, km per unit of each",
    )

    turn_rad: float | None = column(
        "Turn of the body about the line of sight, relative to the declared orientation; null where none was measured.",
        "rad",
    )
    turn_pixel_px: float | None = column("Measured column of the body when it is turned.", "px", "distorted image")
    turn_line_px: float | None = column("Measured row of the body when it is turned.", "px", "distorted image")
    turn_covariance: Sequence[float] | None = column(
        "Covariance of (turn_pixel, turn_line, turn) by image, shape and, of the turn, camera; neither the attitude "
        "nor the pole and spin of the body are in it (3 x 3, by rows).",
        "px, px, rad",
        size=9,
    )
    partial_turn_rotation: Sequence[float] | None = column(
        "Of (turn_pixel, turn_line, turn), by a small rotation of the body about the camera axes where it is (3 x 3, "
        "by rows): what the turn makes of errors of attitude, pole and spin.",
        "px/rad, px/rad, rad/rad",
        _CAMERA,
        size=9,
    )

    states_origin: str | None = column("Origin of the states: its name in SPICE.")
    observer_position_icrf_km: Sequence[float] | None = column("Spacecraft at the epoch, used.", "km", _ICRF, size=3)
    observer_velocity_icrf_km_s: Sequence[float] | None = column(
        "Its velocity, by which aberration was removed.", "km/s", _ICRF, size=3
    )
    target_velocity_icrf_km_s: Sequence[float] | None = column(
        "Velocity of the target when the light left it, by which light time was removed.", "km/s", _ICRF, size=3
    )
    icrf_from_body_xyzw: Sequence[float] | None = column(
        "Orientation of the body when the light left it, quaternion, scalar last.", "", "ICRF from body", size=4
    )
    sun_direction_icrf: Sequence[float] | None = column("Unit vector from the body to the Sun.", "", _ICRF, size=3)
    feature_position_body_km: Sequence[float] | None = column("Landmark.", "km", "body", size=3)
    magnitude: float | None = column("Catalog magnitude of the star.")
    score: float | None = column("Measure of fit of the estimator.")
    n_used: int | None = column("Number of pixels or points used.")
    n_rejected: int | None = column("Number of pixels or points rejected.")

    @property
    def is_usable(self) -> bool:
        """True if it is not suspect, or a user accepted it."""
        return self.status == "ok" or self.accepted_by is not None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObservableBlock(Value):
    """Rows of which many cells are the same, column by column: the stars of an image."""

    count: int  # number of rows, n
    shared: Mapping[str, Any]  # cells that all rows have
    columns: Mapping[str, NDArray[Any]]  # mapping of str to (n,) or (n, size); cells that differ

    def rows(self) -> Iterator[ObservableRow]:
        """Yield the rows one by one."""
        lists = {name: values.tolist() for name, values in self.columns.items()}
        for k in range(self.count):
            yield ObservableRow(**self.shared, **{name: values[k] for name, values in lists.items()})


def write_observables(path: Path, rows: Iterable[ObservableRow | ObservableBlock], metadata: Mapping[str, str]) -> int:
    """Write observables as they come: Parquet, or JSON lines (``.jsonl``) with the metadata in the first."""
    writers = {".parquet": _write_parquet, ".jsonl": _write_json_lines}
    require(path.suffix in writers, f"{path}: observables are written as .parquet or .jsonl, got {path.suffix!r}")
    with replacing(path) as part:
        return writers[path.suffix](part, iter(rows), metadata)


@reads("observables in Parquet")
def read_observables(path: Path) -> tuple[list[ObservableRow], dict[str, str]]:
    """Read observables back from a Parquet file. Returns ``rows`` and ``metadata``."""
    from pyarrow import parquet

    with parquet.ParquetFile(path) as file:
        schema, size = file.schema_arrow, path.stat().st_size
        metadata = {key.decode(): value.decode() for key, value in (schema.metadata or {}).items()}
        found = (metadata.get("format"), metadata.get("format_version"))
        if found != (FORMAT, FORMAT_VERSION) or not schema.equals(_schema()):
            raise DataError(
                path, f"is no file of {FORMAT} version {FORMAT_VERSION}: write it again with giantlike export"
            )
        check_declared_bytes(_ROW_BYTES * file.metadata.num_rows, size)
        table = file.read()
    return [ObservableRow(**row) for row in table.to_pylist()], metadata


def write_observable_tables(path: Path, tables: Iterable[Any], metadata: Mapping[str, str]) -> int:
    """Write observables that are tables already."""
    with replacing(path) as part:
        return _write_tables(part, tables, metadata)


def observables_table(items: Sequence[ObservableRow | ObservableBlock]) -> Any:
    """Rows and blocks as a table: a group of the Parquet file."""
    return _table(_schema(), items)


def _schema(metadata: Mapping[str, str] | None = None) -> Any:
    return arrow_schema(columns_of(ObservableRow), metadata)


def _write_parquet(path: Path, rows: Iterator[ObservableRow | ObservableBlock], metadata: Mapping[str, str]) -> int:
    groups = iter(lambda: list(_group(rows)), [])
    return _write_tables(path, map(observables_table, groups), metadata)


def _write_tables(path: Path, tables: Iterable[Any], metadata: Mapping[str, str]) -> int:
    import pyarrow as pa
    from pyarrow import parquet

    schema, count = _schema({"format": FORMAT, "format_version": FORMAT_VERSION, **metadata}), 0
    repeated = [field.name for field in schema if pa.types.is_string(field.type)]  # numbers hardly ever are
    with parquet.ParquetWriter(path, schema, use_dictionary=repeated) as writer:
        for table in tables:
            writer.write_table(table)
            count += table.num_rows
    return count


def _group(rows: Iterator[ObservableRow | ObservableBlock]) -> Iterator[ObservableRow | ObservableBlock]:
    """Yield items until they have the rows of a group."""
    count = 0
    while count < ROWS_OF_A_GROUP and (item := next(rows, None)) is not None:
        count += item.count if isinstance(item, ObservableBlock) else 1
        yield item


def _table(schema: Any, items: Sequence[ObservableRow | ObservableBlock]) -> Any:
    """Rows and blocks as a table of a schema."""
    import pyarrow as pa

    columns = [item.columns if isinstance(item, ObservableBlock) else {} for item in items]
    counts = [item.count if isinstance(item, ObservableBlock) else 1 for item in items]
    repeats, starts = np.repeat(np.arange(len(items)), counts), np.cumsum([0, *counts[:-1]])
    arrays = []
    for field in schema:
        cells = [_find_shared(item, field.name) for item in items]
        array = pa.array(cells, type=field.type).take(repeats)
        if any(field.name in of_item for of_item in columns):
            pieces = [
                _cells(field, of_item[field.name]) if field.name in of_item else array.slice(start, count)
                for of_item, start, count in zip(columns, starts, counts, strict=True)
            ]
            array = pa.concat_arrays(pieces)
        arrays.append(array)
    return pa.Table.from_arrays(arrays, schema=schema)


def _find_shared(item: ObservableRow | ObservableBlock, name: str) -> Any:
    """Cell that all rows of an item have; None where they differ."""
    return item.shared.get(name) if isinstance(item, ObservableBlock) else getattr(item, name)


def _cells(field: Any, values: NDArray[Any]) -> Any:
    """Column of a block as an array of the type of a field."""
    import pyarrow as pa

    if values.ndim == 1:
        return pa.array(values, type=field.type)
    return pa.FixedSizeListArray.from_arrays(pa.array(np.ascontiguousarray(values).ravel()), values.shape[1]).cast(
        field.type
    )


def _write_json_lines(path: Path, rows: Iterator[ObservableRow | ObservableBlock], metadata: Mapping[str, str]) -> int:
    """Write one object a line, the metadata first; values that are not known are left out."""
    count, columns = 0, columns_of(ObservableRow)
    head = {"kind": "metadata", "format": FORMAT, "format_version": FORMAT_VERSION, **metadata}
    head |= {name: json.loads(head[name]) for name in ("camera", "camera_parameters") if name in head}
    units = {"units": {column.name: column.unit for column in columns if column.unit}}
    frames = {"frames": {column.name: column.frame for column in columns if column.frame}}
    with path.open("w", encoding="utf-8") as file:
        file.write(json.dumps(head | units | frames, allow_nan=False) + "\n")
        for item in rows:
            for row in item.rows() if isinstance(item, ObservableBlock) else (item,):
                cells = ((field.name, getattr(row, field.name)) for field in dataclasses.fields(row))
                known = {name: _json(value) for name, value in cells if value is not None}
                file.write(json.dumps(known, allow_nan=False) + "\n")
                count += 1
    return count


def _json(value: Any) -> Any:
    """Numbers that JSON does not have become null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return [_json(each) for each in value] if isinstance(value, list | tuple) else value
