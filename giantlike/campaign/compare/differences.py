"""Differences between two results of the same thing, and their summary."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from giantlike.campaign.store.results import group_by
from giantlike.core.arrays import Float
from giantlike.io.csv_rows import write_csv_rows

_BEYOND = 3.0  # combined sigmas beyond which a difference is counted apart: of correct ones, 3 in 1,000
_COLUMNS = ("file", "what", "axis", "difference", "sigma", "ratio", "unit")


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """A difference along one axis, first minus second."""

    file: str  # image
    what: str  # ``attitude``, or target and estimator
    axis: str
    value: float
    sigma: float | None  # of both results without common errors; None where one is unknown
    unit: str

    @property
    def ratio(self) -> float | None:
        """The difference over its sigma; None where there is none, or it is 0."""
        return self.value / self.sigma if self.sigma else None


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultComparison:
    """Two sets of results, compared."""

    first: str  # first, second: names of the compared results
    second: str
    differences: tuple[Difference, ...]
    shared: tuple[str, ...]  # errors common to both, which cancel in the differences and are not in the sigmas
    only_first: int  # only_first, only_second: results without a counterpart
    only_second: int
    notes: tuple[str, ...] = ()

    def summary(self) -> dict[str, Any]:
        """Statistics by thing and axis, as JSON has them."""
        groups = group_by(self.differences, lambda one: (one.what, one.axis, one.unit))
        return {
            "first": self.first,
            "second": self.second,
            "shared_errors": list(self.shared),
            "only_first": self.only_first,
            "only_second": self.only_second,
            "notes": list(self.notes),
            "differences": [
                {"what": what, "axis": axis, "unit": unit} | _statistics(members)
                for (what, axis, unit), members in groups.items()
            ],
        }

    def write_csv(self, path: Path) -> None:
        """Write every difference as a row of a table."""
        rows = ([d.file, d.what, d.axis, d.value, d.sigma, d.ratio, d.unit] for d in self.differences)
        write_csv_rows(path, _COLUMNS, rows)


def differences_of(
    file: str, what: str, axes: Sequence[str], values: Float, covariance: Float | None, unit: str
) -> Iterable[Difference]:
    """Yield the components of a difference. ``values`` (k,); ``covariance`` (k, k)."""
    for k, axis in enumerate(axes):
        variance = math.nan if covariance is None else float(covariance[k, k])
        sigma = math.sqrt(max(variance, 0.0)) if math.isfinite(variance) else None
        yield Difference(file=file, what=what, axis=axis, value=float(values[k]), sigma=sigma, unit=unit)


def _statistics(members: Sequence[Difference]) -> dict[str, Any]:
    values = np.array([one.value for one in members])
    ratios = np.array([one.ratio for one in members if one.ratio is not None])
    sigmas = [one.sigma for one in members if one.sigma is not None]
    return {
        "n": len(members),
        "mean": float(values.mean()),
        "rms": float(np.sqrt(np.mean(values**2))),
        "largest": float(np.abs(values).max()),
        "median_sigma": float(np.median(sigmas)) if sigmas else None,
        "rms_over_sigma": float(np.sqrt(np.mean(ratios**2))) if ratios.size else None,
        "beyond_3_sigma": int((np.abs(ratios) > _BEYOND).sum()),
    }
