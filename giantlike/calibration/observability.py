"""Observability of the parameters of a calibration: classification of each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from giantlike.calibration.bundle_adjustment import Data
from giantlike.calibration.field_map import FieldSensitivity
from giantlike.core.arrays import Float

_SIGNIFICANT = 3.0  # sigma from zero: p-value 1/370
_MOSTLY_PRIOR = 0.9  # ratio of sigma to a priori sigma: the observations contribute a fifth of the information or less
_ENTANGLED = 0.99  # correlation: the sigma of the parameter alone is 7 times smaller


class ParameterVerdict(StrEnum):
    """Verdict of the observations on a parameter."""

    SUPPORTED = "supported"
    NOT_SIGNIFICANT = "not_significant"
    """A distortion or temperature term within three sigma of zero: the data do not need it."""
    ENTANGLED = "entangled"
    """Correlated above 0.99 with another parameter: only their combination is known."""
    PRIOR_ONLY = "prior_only"
    """Its sigma equals the a priori sigma: the observations add hardly any information."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterSupport:
    """Estimate, effect and classification of one parameter.

    value, start, sigma: in the unit of the parameter.
    effect_px: largest effect of the value over the field (for focal length and principal point: of its change from the
        start).
    sigma_effect_px: largest effect of one sigma of this parameter alone. Far above the uncertainty of the map if other
        parameters compensate it.
    partner: parameter with the highest correlation; empty for a single parameter.
    correlation: correlation with the partner.
    """

    name: str
    value: float
    start: float
    sigma: float
    effect_px: float
    sigma_effect_px: float
    partner: str
    correlation: float
    verdict: ParameterVerdict


def parameter_support(
    names: Sequence[str], values: Float, data: Data, covariance: Float, sensitivity: FieldSensitivity
) -> tuple[ParameterSupport, ...]:
    """Judge every estimated parameter.

    ``values`` (k,), estimates, each in the unit of its parameter; ``covariance`` (k, k).
    """
    start = data.prior
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma) - np.eye(len(names))
    reach = np.linalg.norm(sensitivity.by_parameter[..., data.estimated], axis=1).max(axis=0)
    found = []
    for k, name in enumerate(names):
        partner = int(np.argmax(np.abs(correlation[k]))) if len(names) > 1 else -1
        shared = float(correlation[k, partner]) if partner >= 0 else 0.0
        is_scale = name.endswith("_px")
        change = values[k] - start[k] if is_scale else values[k]
        if sigma[k] > _MOSTLY_PRIOR * data.prior_sigma[k]:
            verdict = ParameterVerdict.PRIOR_ONLY
        elif not is_scale and abs(values[k]) < _SIGNIFICANT * sigma[k]:
            verdict = ParameterVerdict.NOT_SIGNIFICANT
        elif abs(shared) > _ENTANGLED:
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
