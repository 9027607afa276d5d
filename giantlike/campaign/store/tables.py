"""Records of a run to the rows of its tables."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from giantlike.campaign.store.record_values import Matrix
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord
from giantlike.core.arrays import require
from giantlike.core.causes import IN_IMAGE, Cause, sum_parts
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.io.run_tables import AttitudeRow, ObservationRow
from giantlike.io.tables import columns_of, write_rows

if TYPE_CHECKING:
    from astropy.table import QTable

Row = TypeVar("Row", AttitudeRow, ObservationRow)

_TOTAL = tuple(cause for cause in Cause if cause is not Cause.EPHEMERIS)  # causes in ``covariance_with_attitude_px2``


_UNITS = MappingProxyType({"px": "pix", "arcsec": "arcsec", "deg": "deg", "km": "km", "s": "s"})
"""Units of columns, as astropy writes them."""
TABLE_FILES = tuple(f"{table}.{form}" for table in ("attitudes", "observations") for form in ("csv", "parquet"))
"""Names of the tables in the run folder."""


def write_tables(folder: Path, attitudes: Sequence[AttitudeRecord], observations: Sequence[ObservationRecord]) -> None:
    """Write ``attitudes`` and ``observations``, each as CSV and as Parquet."""
    write_rows(folder / "attitudes", AttitudeRow, [_attitude_row(record) for record in attitudes])
    write_rows(folder / "observations", ObservationRow, [_observation_row(record) for record in observations])


def table_of(name: str, attitudes: Iterable[AttitudeRecord], observations: Iterable[ObservationRecord]) -> QTable:
    """Return a table of a run in memory."""
    from astropy.table import MaskedColumn, QTable

    require(name in ("attitudes", "observations"), f"there is no table {name!r}; there are attitudes and observations")
    kind: type[AttitudeRow] | type[ObservationRow]
    rows: list[Any]
    if name == "attitudes":
        kind, rows = AttitudeRow, [_attitude_row(record) for record in attitudes]
    else:
        kind, rows = ObservationRow, [_observation_row(record) for record in observations]
    table = QTable(meta={"name": name})
    for column in columns_of(kind):
        if not column.csv:
            continue
        cells = [getattr(row, column.name) for row in rows]
        missing = [cell is None for cell in cells]
        blank = {"text": "", "integer": 0, "number": np.nan}.get(column.kind, False)
        values = [blank if cell is None else cell for cell in cells]
        table[column.name] = MaskedColumn(values, mask=missing, description=column.description)
        if column.unit in _UNITS:
            table[column.name].unit = _UNITS[column.unit]
    return table


def _attitude_row(record: AttitudeRecord) -> AttitudeRow:
    attitude = record.attitude
    covariance = None if attitude is None else attitude.covariance_rad2
    sigmas = None if covariance is None else (ARCSEC_PER_RAD * np.sqrt(np.diag(covariance))).tolist()
    return _row(
        AttitudeRow,
        record,
        source=attitude.source if attitude is not None else record.wanted_source,
        **_name_cells("qx qy qz qw", None if attitude is None else attitude.quaternion_xyzw),
        **_name_cells("sigma_x_arcsec sigma_y_arcsec sigma_z_arcsec", sigmas),
        covariance_rad2=_triangle(covariance),
    )


def _observation_row(record: ObservationRecord) -> ObservationRow:
    attitude, covariance, total = record.attitude, record.covariance_px2, record.covariance_with_attitude_px2
    return _row(
        ObservationRow,
        record,
        **_name_cells("predicted_x_px predicted_y_px", record.predicted_px),
        **_name_cells("x_px y_px", record.center_px),
        **_name_cells("sigma_x_px sigma_y_px", _sigmas(covariance)),
        rho_xy=_correlation(covariance),
        **_name_cells("sigma_x_total_px sigma_y_total_px", _sigmas(total)),
        rho_xy_total=_correlation(total),
        **_name_cells("rho_x_range rho_y_range", _range_correlations(record, IN_IMAGE)),
        **_name_cells(
            "rho_x_range_total rho_y_range_total", None if total is None else _range_correlations(record, _TOTAL)
        ),
        parts=json.dumps(record.parts) if record.parts else None,
        **_name_cells("x_camera_km y_camera_km z_camera_km", record.position_camera_km),
        attitude_source=None if attitude is None else attitude.source,
        camera_from_inertial_xyzw=None if attitude is None else attitude.quaternion_xyzw,
        attitude_covariance_rad2=_triangle(None if attitude is None else attitude.covariance_rad2),
        covariance_px2=_triangle(covariance),
        covariance_with_attitude_px2=_triangle(total),
        partial_position_inertial_px_km=_flat(record.partial_position_inertial_px_km),
        partial_attitude_px_rad=_flat(record.partial_attitude_px_rad),
        covariance_camera_km2=_triangle(record.covariance_camera_km2),
        covariance_inertial_km2=_triangle(record.covariance_inertial_km2),
    )


def _sigmas(covariance: Matrix | None) -> list[float] | None:
    """Square roots of the diagonal."""
    return None if covariance is None else [math.sqrt(row[k]) for k, row in enumerate(covariance)]


def _correlation(covariance: Matrix | None) -> float | None:
    """Correlation of x and y; None where it is not defined."""
    sigmas = _sigmas(covariance)
    product = 0.0 if sigmas is None else sigmas[0] * sigmas[1]
    return covariance[0][1] / product if covariance is not None and product > 0.0 else None


def _range_correlations(record: ObservationRecord, causes: Iterable[Cause]) -> list[float] | None:
    """Correlations of x and y with the range, by some causes; None where no range was estimated."""
    if record.range_km is None or not record.parts:
        return None
    total = sum_parts({cause: np.array(part) for cause, part in record.parts.items()}, causes)
    sigmas = np.sqrt(np.diag(total))
    product = sigmas[:2] * sigmas[2]
    return (total[:2, 2] / product).tolist() if (product > 0.0).all() else None


def _row(kind: type[Row], record: AttitudeRecord | ObservationRecord, **cells: Any) -> Row:
    """Row of the given cells, of those that both tables have, and of the fields of the record of the same name."""
    problem = record.problem
    cells |= {
        "reason": None if problem is None else str(problem.reason),
        "detail": None if problem is None else problem.detail,
        "outcome": str(record.outcome),
        "accepted_by": None if record.accepted is None else record.accepted.who,
        "accepted_why": None if record.accepted is None else record.accepted.why,
        "flags": "|".join(record.flags) or None,
        "provenance": json.dumps(record.provenance) if record.provenance else None,
        "time_s": round(record.time_s, 4),
    }
    names = [field.name for field in fields(kind)]
    return kind(**{name: cells[name] if name in cells else getattr(record, name) for name in names})


def _name_cells(names: str, values: Sequence[float] | None) -> dict[str, float | None]:
    """Cells of several columns; empty where there are no values."""
    keys = names.split()
    return dict(zip(keys, [None] * len(keys) if values is None else values, strict=True))


def _triangle(matrix: Matrix | None) -> list[float] | None:
    """Upper triangle by rows."""
    return None if matrix is None else [value for k, row in enumerate(matrix) for value in row[k:]]


def _flat(matrix: Matrix | None) -> list[float] | None:
    """Elements by rows."""
    return None if matrix is None else [value for row in matrix for value in row]
