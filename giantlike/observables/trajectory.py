"""Trajectory of the spacecraft relative to a target from the preferred fixes of a run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.io.observables_file import ObservableRow

_MIN_EPOCHS = 4  # epochs of an arc whose velocities follow from positions: a cubic spline with free ends


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RelativeArc(Value):
    """Measured states of the spacecraft relative to a target."""

    target: str
    estimators: tuple[str, ...]  # names, each once
    et: Float  # (n,); strictly increasing, n >= 2
    # (n, 6), km and km/s, geometric, ICRF axes; the velocities are a priori or, where these are not known, the
    # derivative of a spline through the positions
    states: Float
    covariances_km2: Float  # (n, 3, 3); of the positions, NaN where unknown


def relative_arcs(rows: Iterable[ObservableRow], *, max_gap_s: float) -> tuple[list[RelativeArc], dict[str, int]]:
    """Arcs without gaps longer than a limit, and the number of preferred fixes left out by reason."""
    by_target: dict[str, dict[float, ObservableRow]] = {}
    left_out = Counter[str]()
    for row in rows:
        if row.kind != "body" or not row.preferred or row.target is None:
            continue
        if row.epoch_et_s is None or row.geometric_position_icrf_km is None:
            left_out["no epoch, or no geometric position"] += 1
        elif row.epoch_et_s in by_target.setdefault(row.target, {}):
            left_out["another fix of the same epoch"] += 1
        else:
            by_target[row.target][row.epoch_et_s] = row
    arcs = []
    for target, found in by_target.items():
        times = np.array(sorted(found))
        for et in np.split(times, np.flatnonzero(np.diff(times) > max_gap_s) + 1):
            arc = _arc(target, et, [found[each] for each in et.tolist()])
            if arc is None:
                left_out[f"fewer than {_MIN_EPOCHS} epochs without a gap"] += et.size
            else:
                arcs.append(arc)
    return arcs, dict(left_out)


def _arc(target: str, et: Float, rows: Sequence[ObservableRow]) -> RelativeArc | None:
    """States of consecutive fixes; None where they are too few."""
    position = -np.array([row.geometric_position_icrf_km for row in rows], dtype=np.float64)
    observer, body = (
        np.array([getattr(row, f"{name}_velocity_icrf_km_s") or [np.nan] * 3 for row in rows], dtype=np.float64)
        for name in ("observer", "target")
    )
    velocity = observer - body
    if not np.isfinite(velocity).all() and et.size >= _MIN_EPOCHS:
        velocity = CubicSpline(et, position).derivative()(et)
    if et.size < 2 or not np.isfinite(velocity).all():
        return None
    unknown = [np.nan] * 9
    covariances = np.array([row.covariance_position_icrf_km2 or unknown for row in rows], dtype=np.float64)
    return RelativeArc(
        target=target,
        estimators=tuple(dict.fromkeys(row.estimator or "" for row in rows)),
        et=et,
        states=np.hstack([position, velocity]),
        covariances_km2=covariances.reshape(-1, 3, 3),
    )
