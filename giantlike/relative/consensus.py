"""Agreement of several fixes of one body within errors that they do not share, and their fusion."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy.special import chdtrc

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float
from giantlike.core.causes import IN_IMAGE, Cause, sum_parts
from giantlike.core.outcomes import CenterFix, Failure, PositionFix
from giantlike.core.statistics import nearest_covariance
from giantlike.relative.budget import DECLARED, position_covariance, with_larger_errors
from giantlike.relative.judge import inflation

_WEAK_PX, _WEAK_SIGMAS = 1.0, 20.0
"""Standard deviation, px and relative to the fix, above both of which a check is too weak to confirm it."""
_OWN = tuple(cause for cause in IN_IMAGE if cause is not Cause.SHAPE_SCALE)
"""Causes of errors that two estimators on one image do not share altogether."""
_WEIGHTS = np.linspace(0.0, 1.0, 21)
"""Trial weights of the first of two fixes: an error of a weight by 0.025 costs less than a percent of sigma."""


def find_confirming(fix: CenterFix, seconds: Iterable[tuple[str, CenterFix | Failure]]) -> tuple[str, CenterFix] | None:
    """Return the first of other fixes of the same body that can check one, in order.

    Returns None where none is both precise enough and not suspect; a suspect one cannot confirm the first.
    """
    for name, second in seconds:
        if not isinstance(second, Failure) and not second.flags.suspect and _certain_enough(second, fix):
            return name, second
    return None


def _certain_enough(second: CenterFix, fix: CenterFix) -> bool:
    """Return True if a second fix is precise enough to check the first."""
    sigmas = [math.sqrt(float(np.linalg.eigvalsh(one.covariance_px2)[-1])) for one in (second, fix)]
    return sigmas[0] <= max(_WEAK_PX, _WEAK_SIGMAS * sigmas[1])


def agreement_of(first: CenterFix, second: CenterFix) -> float:
    """p-value of the difference of two independent fixes of one body."""
    squared, size = _squared_difference(first, second, _OWN)
    return float(chdtrc(size, squared))


def _growth(first: CenterFix, second: CenterFix) -> float:
    """Factor by which the variances of two fixes are too small for their difference, without declared errors.

    With these, a small declared error would explain a part of the difference and make the fix surer.
    """
    return inflation(*_squared_difference(first, second, tuple(cause for cause in _OWN if cause not in DECLARED)))


def _squared_difference(first: CenterFix, second: CenterFix, causes: tuple[Cause, ...]) -> tuple[float, int]:
    """Squared Mahalanobis distance of two fixes under errors of some causes, and its degrees of freedom."""
    difference = first.center_px - second.center_px
    if isinstance(first, PositionFix) and isinstance(second, PositionFix):
        difference = np.append(difference, math.log(first.range_km / second.range_km))
    size = len(difference)
    covariance = _covariance_of(first, causes)[:size, :size] + _covariance_of(second, causes)[:size, :size]
    scale = np.sqrt(np.diag(covariance))
    whitened = np.linalg.solve(covariance / np.outer(scale, scale), difference / scale)
    return float(whitened @ (difference / scale)), size


def _covariance_of(fix: CenterFix, causes: tuple[Cause, ...]) -> Float:
    """Covariance of a fix by some causes; all of it where it has no parts."""
    if fix.parts:
        return sum_parts(fix.parts, causes)
    if not isinstance(fix, PositionFix):
        return fix.covariance_px2
    covariance = np.diag([0.0, 0.0, (fix.sigma_range_km / fix.range_km) ** 2])
    covariance[:2, :2] = fix.covariance_px2
    return covariance


def confirm(first: CenterFix, second: CenterFix, model: CameraModel) -> CenterFix:
    """Return the first of two fixes, with larger errors where they differ by more than their covariances."""
    return with_larger_errors(first, model, _growth(first, second), _OWN)


def fuse(first: CenterFix, second: CenterFix, model: CameraModel) -> CenterFix:
    """Fuse two fixes that agree.

    The position is a weighted mean of both; its covariance, cause by cause, holds for any correlation of their errors.
    A cause of only one of them counts by the square of its weight. A cause of both (noise of the same pixels, the law,
    the shape, camera and attitude) is treated as the same error in both, which does not average out: the variance of a
    mean of two errors is at most the mean of their variances. The weight minimizes the determinant of the covariance
    without the scale of the shape, which both share. Where the two differ by more than their own errors, these grow as
    far as declared errors do not cover the difference, see :func:`~giantlike.relative.budget.with_larger_errors`.
    """
    if not first.parts or not second.parts or isinstance(first, PositionFix) != isinstance(second, PositionFix):
        return confirm(first, second, model)
    fusions = [_fused_parts(first, second, float(weight)) for weight in _WEIGHTS]
    sizes = [float(np.linalg.slogdet(sum_parts(parts, _OWN))[1]) for parts in fusions]
    best = int(np.argmin(sizes))
    weight, parts = float(_WEIGHTS[best]), fusions[best]
    if weight == 1.0:
        return confirm(first, second, model)
    center_px = weight * first.center_px + (1.0 - weight) * second.center_px
    changes: dict[str, object] = {
        "center_px": center_px,
        "covariance_px2": sum_parts(parts)[:2, :2],
        "parts": parts,
        "partials": _fused_partials(first, second, weight),
        "flags": first.flags | second.flags,
        "findings": replace(first.findings, weight=weight),
    }
    if isinstance(first, PositionFix) and isinstance(second, PositionFix):
        range_km = math.exp(weight * math.log(first.range_km) + (1.0 - weight) * math.log(second.range_km))
        position_km = range_km * model.unproject(center_px)
        by_camera = weight * _camera_covariance(first, model) + (1.0 - weight) * _camera_covariance(second, model)
        changes["position_camera_km"] = position_km
        changes["covariance_camera_km2"] = position_covariance(model, position_km, sum_parts(parts)) + by_camera
    fused = replace(first, **changes)  # type: ignore[arg-type]
    return with_larger_errors(fused, model, _growth(first, second), _OWN)


def _fused_parts(first: CenterFix, second: CenterFix, weight: float) -> dict[Cause, Float]:
    """Parts of a weighted mean of two fixes, with full correlation of common causes."""
    parts = dict[Cause, Float]()
    for cause in Cause:
        one, other = first.parts.get(cause), second.parts.get(cause)
        if one is not None and other is not None:
            parts[cause] = weight * one + (1.0 - weight) * other
        elif one is not None:
            parts[cause] = weight**2 * one
        elif other is not None:
            parts[cause] = (1.0 - weight) ** 2 * other
    return parts


def _fused_partials(first: CenterFix, second: CenterFix, weight: float) -> dict[Cause, Float]:
    """Derivatives of a weighted mean of two fixes, by causes of which both have derivatives."""
    both = [cause for cause in first.partials if cause in second.partials]
    return {cause: weight * first.partials[cause] + (1.0 - weight) * second.partials[cause] for cause in both}


def _camera_covariance(fix: PositionFix, model: CameraModel) -> Float:
    """Covariance (3, 3), km^2, of a position by the camera model."""
    if Cause.CAMERA not in fix.parts:
        return np.zeros((3, 3))
    in_image = position_covariance(model, fix.position_camera_km, sum_parts(fix.parts))
    return nearest_covariance(fix.covariance_camera_km2 - in_image)
