"""Differences between the fixes that two estimators made of one body in one image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from giantlike.campaign.store.records import ObservationRecord
from giantlike.core.arrays import Float
from giantlike.core.causes import IN_POSITION, Cause
from giantlike.core.values import Value

_OF_THE_BODY = (Cause.SHAPE_SCALE, Cause.POLE, Cause.SPIN, Cause.SUN)
"""Causes of one value for a body, in all images: each moves both fixes together."""
_LEAST_SHARE = 1e-12  # variance relative to the largest one, below which the difference has none but rounding


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FixDifference(Value):
    """First minus second fix."""

    offset: Float  # (k,); of x and y, px, and, where both have a range (k = 3), of its natural logarithm
    covariance: Float  # (k, k); of the offset

    @property
    def sigma(self) -> Float:
        """Standard deviations (k,) of the offset, each coordinate by itself."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def squared_distance(self) -> float:
        """Squared Mahalanobis distance, ``offset^T covariance^-1 offset``; about k for correct fixes."""
        scale = np.maximum(self.sigma, np.finfo(float).tiny)
        values, axes = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        along = axes.T @ (self.offset / scale)
        known = values > _LEAST_SHARE * values[-1]
        return float(np.sum(along[known] ** 2 / values[known]))

    @property
    def sigmas(self) -> float:
        """Mahalanobis distance: the difference over its sigma in the direction in which it lies."""
        return math.sqrt(self.squared_distance)

    @property
    def chance(self) -> float:
        """p-value of the difference, for correct fixes."""
        return float(chdtrc(len(self.offset), self.squared_distance))


def difference_of(one: ObservationRecord, other: ObservationRecord) -> FixDifference | None:
    """Compare two fixes of one body in one image; None if one of the two has no fix.

    Camera and attitude do not change a position in the image, and are left out; the camera's part of a range is
    included. Errors of scale, pole and spin have one value for both fixes, ``(P1 - P2) S (P1 - P2)^T`` where the
    records hold partials. Noise, law, albedo and relief count as independent, although both use the same pixels:
    conservative.
    """
    first, second = _place(one), _place(other)
    if first is None or second is None:
        return None
    size = min(len(first), len(second))
    covariance = np.zeros((size, size))
    shared = [cause for cause in _OF_THE_BODY if cause in one.partials and cause in other.partials]
    for cause in shared:
        covariance += _of_the_body(cause, one, other, size)
    for record in (one, other):
        covariance += _covariance(record, size, shared)
    return FixDifference(offset=first[:size] - second[:size], covariance=covariance)


def _place(record: ObservationRecord) -> Float | None:
    """Center, px, and, where there is one, the logarithm of the range; None without a fix."""
    if record.center_px is None or record.covariance_px2 is None:
        return None
    if record.range_km is None or record.sigma_range_km is None:
        return np.array(record.center_px)
    return np.array([*record.center_px, math.log(record.range_km)])


def _of_the_body(cause: Cause, one: ObservationRecord, other: ObservationRecord, size: int) -> Float:
    """Covariance of the difference by a cause with the same value for both; its own is one variance for all axes."""
    partial = np.array(one.partials[cause])
    reach = float((partial**2).sum())
    variance = float(np.trace(np.array(one.parts[cause]))) / reach if reach > 0.0 and cause in one.parts else 0.0
    apart = partial[:size] - np.array(other.partials[cause])[:size]
    result: Float = variance * apart @ apart.T
    return result


def _covariance(record: ObservationRecord, size: int, without: list[Cause]) -> Float:
    """Covariance of a position in the image from the causes specific to it."""
    if not record.parts:
        covariance = np.zeros((3, 3))
        covariance[:2, :2] = np.array(record.covariance_px2)
        if record.range_km is not None and record.sigma_range_km is not None:
            covariance[2, 2] = (record.sigma_range_km / record.range_km) ** 2
        return covariance[:size, :size]
    total = np.zeros((size, size))
    for cause in IN_POSITION:
        if cause in without or cause not in record.parts:
            continue
        part = np.array(record.parts[cause])[:size, :size]
        if cause is Cause.CAMERA:
            part[:2] = part[:, :2] = 0.0
        total += part
    return total
