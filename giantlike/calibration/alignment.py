"""Alignment of one sensor with respect to another: the mean of many rotations, and its drift with temperature."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from scipy.special import gammainc

from giantlike._system.processes import one_thread
from giantlike.core.arrays import Float, Mask, as_finite, require
from giantlike.core.frames import FrameRotation
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.statistics import squared_residuals
from giantlike.core.values import Estimate

_STEPS = 20  # of Gauss-Newton and rejection
_SMALL_RAD = 1e-14  # last step, rad (or rad/Celsius): the rounding of float64
_NOISE_EXPLAINS = 0.9999  # chi-square probability up to which noise explains the residuals: 1 false alarm in 10,000
_MEDIAN_CHI2 = 2.365973884375338  # of chi-square with three degrees of freedom


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AlignmentResult(Estimate):
    """A rotation between two sensors: ``rotation_at(t) = from_rotvec(rate * (t - reference)) * rotation``."""

    rotation: Rotation  # ``second_from_first`` at the reference temperature
    rate_rad_per_c: Float  # (3,), rad/Celsius; about the axes of the second sensor; zero for a static alignment
    reference_c: float  # Celsius; mean temperature of the observations
    covariance_rad2: Float  # (3, 3), rad^2; of the small rotation, second sensor, reference temperature
    rate_covariance: Float  # (3, 3), (rad/Celsius)^2; zero for a static alignment
    residuals_rad: Float  # (n, 3), rad; observed minus fitted, axes of the second sensor
    used: Mask  # (n,); False for outliers
    reduced_chi2: float  # of the measurements used; covariances are scaled with an excess
    first: str = ""  # first, second: names of the two frames; empty when unknown
    second: str = ""

    def rotation_at(self, temperature_c: float) -> Rotation:
        """Return ``second_from_first`` at a temperature."""
        turn = self.rate_rad_per_c * (temperature_c - self.reference_c)
        return Rotation.from_rotvec(turn) * self.rotation

    def frame_rotation_at(self, temperature_c: float) -> FrameRotation:
        """Return ``second_from_first`` at a temperature with the names of the two frames, which products check."""
        return FrameRotation(rotation=self.rotation_at(temperature_c), target=self.second, source=self.first)


@one_thread()
def align(
    rotations: Rotation,
    covariances_rad2: ArrayLike,
    *,
    temperatures_c: ArrayLike | None = None,
    outlier_sigma: float = 5.0,
) -> AlignmentResult | Failure:
    """Weighted mean of n measured alignments, with a drift linear in temperature where temperatures are given.

    ``covariances_rad2`` (n, 3, 3), of small rotations about the axes of the second sensor; ``temperatures_c`` (n,).
    """
    count = len(rotations)
    covariances = as_finite(covariances_rad2, (count, 3, 3), "covariances_rad2")
    temperatures = np.zeros(count) if temperatures_c is None else as_finite(temperatures_c, (count,), "temperatures_c")
    require(outlier_sigma > 0, f"outlier_sigma must be > 0, got {outlier_sigma}")
    drifts = temperatures_c is not None
    if count < (needed := 1 + 2 * drifts):
        return Failure(Reason.TOO_FEW_MATCHES, f"{count} rotations were given, {needed} are needed")
    reference = float(temperatures.mean())
    offsets: Float = temperatures - reference
    if drifts and not np.ptp(temperatures) > 0:
        detail = f"all rotations were measured at {reference:g} C: omit temperatures_c for a static alignment"
        return Failure(Reason.DEGENERATE_GEOMETRY, detail)
    rotation, rate, used = _fit_rotation(rotations, covariances, offsets, drifts, outlier_sigma)
    residuals = _residuals(rotations, rotation, rate, offsets)
    _, covariance = _step(residuals, covariances, offsets, used, drifts)
    freedom = max(3 * int(used.sum()) - (6 if drifts else 3), 1)
    chi2 = float(squared_residuals(residuals, covariances)[used].sum())
    if gammainc(freedom / 2.0, chi2 / 2.0) > _NOISE_EXPLAINS:
        covariance *= chi2 / freedom
    return AlignmentResult(
        rotation=rotation,
        rate_rad_per_c=rate,
        reference_c=reference,
        covariance_rad2=covariance[:3, :3],
        rate_covariance=covariance[3:, 3:],
        residuals_rad=residuals,
        used=used,
        reduced_chi2=chi2 / freedom,
    )


def interlock(
    first_from_inertial: FrameRotation | Rotation,
    first_covariance_rad2: ArrayLike,
    second_from_inertial: FrameRotation | Rotation,
    second_covariance_rad2: ArrayLike,
    *,
    temperatures_c: ArrayLike | None = None,
) -> AlignmentResult | Failure:
    """Alignment ``second_from_first`` from n attitudes of two sensors at the same times.

    Source: Inman and Holt, Artemis I Optical Navigation System Performance, IV.A (interlock of camera and trackers).
    """
    one, other = _as_frame_rotation(first_from_inertial), _as_frame_rotation(second_from_inertial)
    count = len(one.rotation)
    require(
        len(other.rotation) == count,
        f"both sensors need the same number of attitudes, got {count} and {len(other.rotation)}",
    )
    first = as_finite(first_covariance_rad2, (count, 3, 3), "first_covariance_rad2")
    second = as_finite(second_covariance_rad2, (count, 3, 3), "second_covariance_rad2")
    between = other * one.inv()
    turn = between.rotation.as_matrix()
    covariances = second + turn @ first @ np.swapaxes(turn, 1, 2)
    found = align(between.rotation, covariances, temperatures_c=temperatures_c)
    return found if isinstance(found, Failure) else replace(found, first=between.source, second=between.target)


def _as_frame_rotation(attitudes: FrameRotation | Rotation) -> FrameRotation:
    if isinstance(attitudes, FrameRotation):
        return attitudes
    return FrameRotation(rotation=attitudes, target="", source="")


def _fit_rotation(
    rotations: Rotation, covariances: Float, offsets_c: Float, drifts: bool, outlier_sigma: float
) -> tuple[Rotation, Float, Mask]:
    """Rotation at the reference temperature, rate, and mask (n,) of the measurements that agree with them."""
    used: Mask = np.ones(len(rotations), dtype=bool)
    rotation: Rotation = rotations.mean()
    rate: Float = np.zeros(3)
    for _ in range(_STEPS):
        residuals = _residuals(rotations, rotation, rate, offsets_c)
        step, _ = _step(residuals, covariances, offsets_c, used, drifts)
        rotation, rate = Rotation.from_rotvec(step[:3]) * rotation, rate + step[3:]
        before = used
        squares = squared_residuals(residuals, covariances)
        spread = max(float(np.median(squares)) / _MEDIAN_CHI2, 1.0)
        used = np.asarray(squares <= outlier_sigma**2 * spread)
        if np.abs(step).max() < _SMALL_RAD and np.array_equal(before, used):
            break
    return rotation, rate, used


def _residuals(rotations: Rotation, rotation: Rotation, rate: Float, offsets_c: Float) -> Float:
    """Small rotations (n, 3) by which the measurements differ from the fit."""
    fitted = Rotation.from_rotvec(offsets_c[:, None] * rate) * rotation
    return np.asarray((rotations * fitted.inv()).as_rotvec(), dtype=np.float64)


def _step(residuals: Float, covariances: Float, offsets_c: Float, used: Mask, drifts: bool) -> tuple[Float, Float]:
    """Correction (6,) of rotation and rate, and their covariance (6, 6); zero for a rate not estimated."""
    size = 6 if drifts else 3
    design = np.concatenate(
        [np.broadcast_to(np.eye(3), covariances.shape), offsets_c[:, None, None] * np.eye(3)], axis=2
    )
    design = design[used][:, :, :size]
    weighted = np.swapaxes(design, 1, 2) @ np.linalg.inv(covariances[used])
    normal = np.sum(weighted @ design, axis=0)
    units = 1.0 / np.sqrt(np.diag(normal))
    inverse = np.linalg.inv(normal * np.outer(units, units)) * np.outer(units, units)
    step = inverse @ np.sum(weighted @ residuals[used][..., None], axis=0)[:, 0]
    return np.pad(step, (0, 6 - size)), np.pad(inverse, (0, 6 - size))
