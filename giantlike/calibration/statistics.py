"""Residuals of a calibration by image, magnitude, distance from the image center and temperature."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from giantlike.calibration.result import CalibrationResult
from giantlike.core.arrays import Float, Mask

_BINS = 6  # groups per quantity
_FEWEST = 2  # observations that can be grouped


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualGroup:
    """Statistics of the residuals of a group of observations."""

    kind: str  # ``image``, ``magnitude``, ``radius_px`` (from the image center) or ``temperature_c``
    label: str  # name of the image, or the range
    middle: float  # median of the quantity in the group; for images their number, from 0
    count: int
    rms_px: float  # radial
    mean_x_px: float  # mean_x_px, mean_y_px: observed minus predicted
    mean_y_px: float
    noise_px: float  # radial rms expected from the sigmas


def residual_statistics(result: CalibrationResult) -> tuple[ResidualGroup, ...]:
    """Residuals in groups of equal size: by image, magnitude, distance from the image center and temperature."""
    center = (np.array([result.columns, result.rows]) - 1.0) / 2.0
    temperatures = np.array([image.temperature_c for image in result.images])[result.image_index]
    groups = []
    for number, image in enumerate(result.images):
        mine = result.used & (result.image_index == number)
        if mine.any():
            groups.append(_group(result, "image", image.name, float(number), mine))
    quantities = {
        "magnitude": result.magnitudes,
        "radius_px": np.linalg.norm(result.observed_px - center, axis=1),
        "temperature_c": temperatures,
    }
    for kind, values in quantities.items():
        groups += _bin_residuals(result, kind, values)
    return tuple(groups)


def _bin_residuals(result: CalibrationResult, kind: str, values: Float) -> list[ResidualGroup]:
    known = result.used & np.isfinite(values)
    if int(known.sum()) < _FEWEST or np.ptp(values[known]) == 0:
        return []
    edges = np.unique(np.quantile(values[known], np.linspace(0.0, 1.0, _BINS + 1)))
    number = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    groups = []
    for k, (low, high) in enumerate(itertools.pairwise(edges)):
        mine = known & (number == k)
        if mine.any():
            groups.append(_group(result, kind, f"{low:.4g} to {high:.4g}", float(np.median(values[mine])), mine))
    return groups


def _group(result: CalibrationResult, kind: str, label: str, middle: float, mine: Mask) -> ResidualGroup:
    residuals = result.residuals_px[mine]
    mean = residuals.mean(axis=0)
    return ResidualGroup(
        kind=kind,
        label=label,
        middle=middle,
        count=len(residuals),
        rms_px=float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)))),
        mean_x_px=float(mean[0]),
        mean_y_px=float(mean[1]),
        noise_px=float(np.sqrt(2.0 * np.mean(result.sigma_px[mine] ** 2))),
    )
