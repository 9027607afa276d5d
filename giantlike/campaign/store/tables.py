"""Records to ``attitudes`` and ``observations``, as CSV by the contract and as Parquet with all there is."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from giantlike.campaign.store.records import AttitudeRecord, Matrix, ObservationRecord
from giantlike.core.atomic import write_bytes_atomic, write_text_atomic
from giantlike.core.units import ARCSEC_PER_RAD

Kinds = Mapping[str, str]
Cells = Mapping[str, Any]


def _kinds(**columns: str) -> Kinds:
    """Column names, in order, to their kind; names are given as one text per kind."""
    return MappingProxyType({name: kind for kind, names in columns.items() for name in names.split()})


def _ordered(order: str, kinds: Kinds) -> Kinds:
    return MappingProxyType({name: kinds[name] for name in order.split()})


ATTITUDE_COLUMNS = _ordered(
    "file epoch_utc status reason source n_detected n_matched rms_px qx qy qz qw ra_deg dec_deg roll_deg fov_deg "
    "sigma_x_arcsec sigma_y_arcsec sigma_z_arcsec flags time_s",
    _kinds(
        text="file epoch_utc status reason source flags",
        integer="n_detected n_matched",
        number="rms_px qx qy qz qw ra_deg dec_deg roll_deg fov_deg sigma_x_arcsec sigma_y_arcsec sigma_z_arcsec time_s",
    ),
)
"""Columns of ``attitudes.csv``, in order, and what they hold."""

ATTITUDE_EXTRAS = _kinds(
    text="detail sha256 provenance",
    number="et exposure_s false_match_probability",
    integer="n_rejected",
    texts="notes",
    numbers="covariance_rad2 apriori_xyzw",
)
"""What ``attitudes.parquet`` holds besides."""

OBSERVATION_COLUMNS = _ordered(
    "file epoch_utc target estimator status reason predicted_x_px predicted_y_px x_px y_px sigma_x_px sigma_y_px "
    "rho_xy x_camera_km y_camera_km z_camera_km range_km sigma_range_km score n_used n_rejected flags time_s",
    _kinds(
        text="file epoch_utc target estimator status reason flags",
        integer="n_used n_rejected",
        number="predicted_x_px predicted_y_px x_px y_px sigma_x_px sigma_y_px rho_xy x_camera_km y_camera_km "
        "z_camera_km range_km sigma_range_km score time_s",
    ),
)
"""Columns of ``observations.csv``, in order, and what they hold."""

OBSERVATION_EXTRAS = _kinds(
    text="detail attitude_source provenance",
    numbers="camera_from_inertial_xyzw attitude_covariance_rad2 predicted_camera_km covariance_px2 "
    "covariance_with_attitude_px2 partial_position_inertial_px_km partial_attitude_px_rad covariance_camera_km2 "
    "position_inertial_km covariance_inertial_km2",
)
"""What ``observations.parquet`` holds besides."""


def write_tables(folder: Path, attitudes: Sequence[AttitudeRecord], observations: Sequence[ObservationRecord]) -> None:
    """Write the four tables of a run folder.

    Notes
    -----
    CSV numbers keep all their digits; a cell without a value is empty. The Parquet files hold the same columns, and
    what CSV has no room for: texts (``provenance`` is JSON) and lists. A symmetric matrix is the list of its upper
    triangle by rows, (3, 3) as xx, xy, xz, yy, yz, zz; the partials are 2 x 3 by rows. Units are in the names;
    frames as in :mod:`giantlike.campaign.store.records`.
    """
    _write(folder / "attitudes", ATTITUDE_COLUMNS, ATTITUDE_EXTRAS, [_attitude_cells(r) for r in attitudes])
    _write(
        folder / "observations", OBSERVATION_COLUMNS, OBSERVATION_EXTRAS, [_observation_cells(r) for r in observations]
    )


def _write(stem: Path, columns: Kinds, extras: Kinds, table: Sequence[Cells]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for cells in table:
        writer.writerow([_csv_text(cells[name]) for name in columns])
    write_text_atomic(stem.with_suffix(".csv"), text.getvalue())
    write_bytes_atomic(stem.with_suffix(".parquet"), _parquet({**columns, **extras}, table))


def _csv_text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return repr(value)
    return str(value)


def _parquet(columns: Kinds, table: Sequence[Cells]) -> bytes:
    import pyarrow as pa
    from pyarrow import parquet

    types = {
        "text": pa.string(),
        "number": pa.float64(),
        "integer": pa.int64(),
        "texts": pa.list_(pa.string()),
        "numbers": pa.list_(pa.float64()),
    }
    schema = pa.schema([(name, types[kind]) for name, kind in columns.items()])
    arrays = [pa.array([cells[name] for cells in table], type=types[kind]) for name, kind in columns.items()]
    sink = pa.BufferOutputStream()
    parquet.write_table(pa.Table.from_arrays(arrays, schema=schema), sink)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def _attitude_cells(record: AttitudeRecord) -> Cells:
    attitude = record.attitude
    covariance = None if attitude is None else attitude.covariance_rad2
    sigmas = [None] * 3 if covariance is None else (ARCSEC_PER_RAD * np.sqrt(np.diag(covariance))).tolist()
    return {
        **_same(record, "file epoch_utc status n_detected n_matched rms_px ra_deg dec_deg roll_deg fov_deg"),
        **_same(record, "sha256 et exposure_s false_match_probability n_rejected notes apriori_xyzw"),
        **_shared(record),
        "source": _source(record),
        **_named("qx qy qz qw", None if attitude is None else attitude.quaternion_xyzw),
        **_named("sigma_x_arcsec sigma_y_arcsec sigma_z_arcsec", sigmas),
        "covariance_rad2": _triangle(covariance),
    }


def _source(record: AttitudeRecord) -> str | None:
    """Where the attitude comes from; for a failed one, where it was looked for."""
    if record.attitude is not None:
        return record.attitude.source
    if not record.readable:
        return None
    return "stars" if record.star_image else "interpolated" if record.transferred else "a_priori"


def _observation_cells(record: ObservationRecord) -> Cells:
    attitude, covariance = record.attitude, record.covariance_px2
    sigmas: list[float] | None = None
    correlation = None
    if covariance is not None:
        sigmas = np.sqrt(np.diag(covariance)).tolist()
        spread = sigmas[0] * sigmas[1]
        correlation = covariance[0][1] / spread if spread > 0 else None
    return {
        **_same(record, "file epoch_utc target estimator status range_km sigma_range_km score n_used n_rejected"),
        **_same(record, "predicted_camera_km position_inertial_km"),
        **_shared(record),
        **_named("predicted_x_px predicted_y_px", record.predicted_px),
        **_named("x_px y_px", record.center_px),
        **_named("sigma_x_px sigma_y_px", sigmas),
        "rho_xy": correlation,
        **_named("x_camera_km y_camera_km z_camera_km", record.position_camera_km),
        "attitude_source": None if attitude is None else attitude.source,
        "camera_from_inertial_xyzw": None if attitude is None else attitude.quaternion_xyzw,
        "attitude_covariance_rad2": _triangle(None if attitude is None else attitude.covariance_rad2),
        "covariance_px2": _triangle(covariance),
        "covariance_with_attitude_px2": _triangle(record.covariance_with_attitude_px2),
        "partial_position_inertial_px_km": _flat(record.partial_position_inertial_px_km),
        "partial_attitude_px_rad": _flat(record.partial_attitude_px_rad),
        "covariance_camera_km2": _triangle(record.covariance_camera_km2),
        "covariance_inertial_km2": _triangle(record.covariance_inertial_km2),
    }


def _same(record: AttitudeRecord | ObservationRecord, names: str) -> dict[str, Any]:
    return {name: getattr(record, name) for name in names.split()}


def _named(names: str, values: Sequence[float | None] | None) -> dict[str, float | None]:
    keys = names.split()
    return dict(zip(keys, [None] * len(keys) if values is None else values, strict=True))


def _shared(record: AttitudeRecord | ObservationRecord) -> dict[str, Any]:
    """Cells that both tables have."""
    problem = record.problem
    return {
        "reason": None if problem is None else str(problem.reason),
        "detail": None if problem is None else problem.detail,
        "flags": "|".join(record.flags) or None,
        "provenance": json.dumps(record.provenance) if record.provenance else None,
        "time_s": round(record.time_s, 4),
    }


def _triangle(matrix: Matrix | None) -> list[float] | None:
    """Upper triangle by rows."""
    return None if matrix is None else [value for k, row in enumerate(matrix) for value in row[k:]]


def _flat(matrix: Matrix | None) -> list[float] | None:
    return None if matrix is None else [value for row in matrix for value in row]
