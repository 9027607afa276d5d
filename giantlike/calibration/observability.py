"""Observability of parameters: classification of each of them, and combinations that are hardly determined."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from giantlike.calibration.bundle_adjustment import Data
from giantlike.calibration.field_map import FieldSensitivity
from giantlike.core.arrays import Float

_SIGNIFICANT = 3.0  # sigma from zero: p-value 1/370
MOSTLY_PRIOR = 0.9  # ratio of sigma to a priori sigma: the observations contribute a fifth of the information or less
ENTANGLED = 0.99  # correlation: the sigma of the parameter alone is 7 times smaller

SINGULAR = 1e-12
"""Eigenvalue of a scaled information matrix below which it is zero but for rounding of sums of about ten thousand
terms."""
_SMALL_WEIGHT = 0.1  # weights in a combination that are not named


class ParameterVerdict(StrEnum):
    """Verdict of the observations on a parameter."""

    SUPPORTED = "supported"
    NOT_SIGNIFICANT = "not_significant"
    """A distortion or temperature term within three sigma of zero: the data do not need it."""
    ENTANGLED = "entangled"  # correlated above 0.99 with another parameter: only their combination is known
    PRIOR_ONLY = "prior_only"  # its sigma equals the a priori sigma: the observations add hardly any information


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterSupport:
    """Estimate, effect and classification of one parameter."""

    name: str
    value: float  # value, start, sigma: in the unit of the parameter
    start: float
    sigma: float
    effect_px: float  # largest effect of the value over the field (focal length, principal point: of its change)
    sigma_effect_px: float  # largest effect of its sigma alone, far above the map's if others compensate
    partner: str  # parameter with the highest correlation; empty for a single parameter
    correlation: float  # correlation with the partner
    verdict: ParameterVerdict


def parameter_support(
    names: Sequence[str], values: Float, data: Data, covariance: Float, sensitivity: FieldSensitivity
) -> tuple[ParameterSupport, ...]:
    """Judge every estimated parameter. ``values`` (k,), each in the unit of its parameter; ``covariance`` (k, k)."""
    reach = np.linalg.norm(sensitivity.by_parameter[..., data.estimated], axis=1).max(axis=0)
    scales = frozenset(name for name in names if name.endswith("_px"))
    return support_of(names, values, data.prior, data.prior_sigma, covariance, reach, scales)


def support_of(
    names: Sequence[str],
    values: Float,
    start: Float,
    prior_sigma: Float,
    covariance: Float,
    reach: Float,
    scales: Set[str],
) -> tuple[ParameterSupport, ...]:
    """Judge the first k of n parameters, which may be entangled with the others.

    ``values``, ``start``, ``prior_sigma``, ``reach`` (k,): the last is the largest derivative of a measurement by each
    parameter; ``covariance`` (n, n); ``scales``: names for which zero is no meaningful value.
    """
    sigma = np.sqrt(np.diag(covariance))
    units = np.where(sigma > 0.0, sigma, 1.0)
    correlation = covariance / np.outer(units, units)
    np.fill_diagonal(correlation, 0.0)
    found = []
    for k, name in enumerate(names[: len(values)]):
        partner = int(np.argmax(np.abs(correlation[k]))) if len(names) > 1 else -1
        shared = float(correlation[k, partner]) if partner >= 0 else 0.0
        is_scale = name in scales
        change = values[k] - start[k] if is_scale else values[k]
        if sigma[k] > MOSTLY_PRIOR * prior_sigma[k]:
            verdict = ParameterVerdict.PRIOR_ONLY
        elif not is_scale and abs(values[k]) < _SIGNIFICANT * sigma[k]:
            verdict = ParameterVerdict.NOT_SIGNIFICANT
        elif abs(shared) > ENTANGLED:
            verdict = ParameterVerdict.ENTANGLED
        else:
            verdict = ParameterVerdict.SUPPORTED
        found.append(
            ParameterSupport(
                name=name,
                value=float(values[k]),
                start=float(start[k]),
                sigma=float(sigma[k]),
                effect_px=float(abs(change) * reach[k]),
                sigma_effect_px=float(sigma[k] * reach[k]),
                partner=names[partner] if partner >= 0 else "",
                correlation=shared,
                verdict=verdict,
            )
        )
    return tuple(found)


@dataclass(frozen=True, slots=True, kw_only=True)
class WeakCombination:
    """A combination of parameters that the measurements of a pass hardly determine."""

    # fraction of each parameter, in units of the standard deviation that it would have were all others known; the
    # largest first, small ones left out
    weights: Mapping[str, float]
    # ratio of the standard deviation of the combination by the measurements alone to the standard deviation of one of
    # its parameters with all others known; infinite where the measurements do not determine it
    inflation: float

    def __str__(self) -> str:
        terms = " ".join(f"{weight:+.2f} {name}" for name, weight in self.weights.items())
        if math.isinf(self.inflation):
            return f"{terms} at all"
        return f"{terms} (known {self.inflation:.3g} times worse than its parts alone)"


def weak_combinations(names: tuple[str, ...], information: Float, *, above: float) -> tuple[WeakCombination, ...]:
    """Find combinations of parameters that measurements determine much worse than their parts, by (k, k)."""
    scale = np.sqrt(np.diagonal(information))
    measured = scale > 0.0
    found = [
        WeakCombination(weights={name: 1.0}, inflation=np.inf)
        for name, known in zip(names, measured, strict=True)
        if not known
    ]
    if not measured.any():
        return tuple(found)
    kept = [name for name, known in zip(names, measured, strict=True) if known]
    values, vectors = np.linalg.eigh(
        information[np.ix_(measured, measured)] / np.outer(scale[measured], scale[measured])
    )
    for value, vector in zip(values, vectors.T, strict=True):
        inflation = np.inf if value <= SINGULAR else float(1.0 / np.sqrt(value))
        if inflation > above:
            order = [k for k in np.argsort(-np.abs(vector)) if abs(vector[k]) > _SMALL_WEIGHT]
            found.append(WeakCombination(weights={kept[k]: float(vector[k]) for k in order}, inflation=inflation))
    return tuple(found)
