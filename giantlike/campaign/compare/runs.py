"""Comparison of two runs: the same images with another camera, shape, option or version."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from giantlike.campaign.compare.differences import Difference, ResultComparison, differences_of
from giantlike.campaign.store.records import Attitude, AttitudeRecord, ObservationRecord
from giantlike.campaign.store.results import RunResult, load_result
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.core.arrays import Float, require
from giantlike.core.causes import Cause, sum_parts
from giantlike.core.frames import rotation_between
from giantlike.core.units import ARCSEC_PER_RAD

_ROUNDING = 1e-12  # fraction of a variance by rounding: Jacobians leave about 1e-16 in parts that should be zero
_SAME_FILES = "the same image files; in part, where options differ"
_OF_PIXELS = (Cause.NOISE, Cause.BACKGROUND, Cause.ALBEDO)  # in common: the same pixels and estimator
_OF_BODY = (Cause.RELIEF, Cause.SHAPE_SCALE, Cause.POLE, Cause.SPIN, Cause.SUN)
"""Causes that they have in common because the shape is the same."""
_OF_HEADER = (Cause.ABERRATION, Cause.EPOCH)  # in common: one source of time and velocity of the spacecraft


def compare_runs(first: Path, second: Path) -> ResultComparison:
    """Compare fixes of two runs by image name, target and estimator.

    The covariance of a difference is the sum of both, without the causes that provenance shows to be common to both.
    """
    one, other = load_result(first), load_result(second)
    inputs = [RunFolder(path).provenance().get("inputs", {}) for path in (first, second)]
    left, right = _by_file(one), _by_file(other)
    common = [file for file in left if file in right]
    require(bool(common), f"{first} and {second}: no image of one is in the other; images are matched by name")
    shared = _Shared(inputs, one, other)
    differences: list[Difference] = []
    for file in common:
        differences += _attitude(left[file], right[file], shared)
    fixes, others = _fixes(one), _fixes(other)
    for key in fixes:
        if key in others and key[0] in right:
            differences += _fix(fixes[key], others[key], shared, left[key[0]].sha256 == right[key[0]].sha256)
    return ResultComparison(
        first=str(first),
        second=str(second),
        differences=tuple(differences),
        shared=tuple(shared.said),
        only_first=len(left) - len(common) + len(set(fixes) - set(others)),
        only_second=len(right) - len(common) + len(set(others) - set(fixes)),
    )


class _Shared:
    """Causes that the results of two runs have in common, and their names in messages."""

    def __init__(self, inputs: list[Mapping[str, Any]], one: RunResult, other: RunResult) -> None:
        first, second = inputs
        calibrated = one.calibration is not None or other.calibration is not None
        self._camera = first.get("camera") == second.get("camera") and not calibrated
        self._catalog = first.get("catalog") == second.get("catalog")
        self._shapes = {
            name
            for name, digest in first.get("shapes_sha256", {}).items()
            if second.get("shapes_sha256", {}).get(name) == digest
        }
        laws = [run.get("options", {}).get("targets", {}) for run in inputs]
        self._laws = {
            name for name in laws[0] if name in laws[1] and laws[0][name]["reflectance"] == laws[1][name]["reflectance"]
        }
        self.said: dict[str, None] = {}

    def of_attitude(self, *, same_image: bool) -> list[Cause]:
        """Causes that two attitudes have in common."""
        causes = [*(_OF_PIXELS if same_image else ()), *(_OF_HEADER if same_image else ())]
        if same_image:
            self.said[f"noise of the stars ({_SAME_FILES}), velocity of the spacecraft, epoch"] = None
        if self._catalog:
            self.said["catalog (the same)"] = None
        return self._with_camera(causes)

    def of_fix(self, record: ObservationRecord, other: ObservationRecord, *, same_image: bool) -> list[Cause]:
        """Causes that two fixes of a target have in common."""
        causes: list[Cause] = []
        if same_image:
            causes += _OF_PIXELS
            self.said[f"noise, background and markings of bodies ({_SAME_FILES})"] = None
        if record.target in self._shapes:
            causes += _OF_BODY
            self.said[f"{record.target}: shape, its scale, pole and spin (the same file)"] = None
        if record.target in self._laws:
            causes.append(Cause.REFLECTANCE)
            self.said[f"{record.target}: reflectance law (the same)"] = None
        if record.attitude == other.attitude:
            causes.append(Cause.ATTITUDE)
            self.said["attitudes of images (the same)"] = None
        return self._with_camera(causes)

    def _with_camera(self, causes: list[Cause]) -> list[Cause]:
        if self._camera:
            self.said["camera model (the same)"] = None
            return [*causes, Cause.CAMERA, Cause.PSF]
        return causes


def _by_file(result: RunResult) -> dict[str, AttitudeRecord]:
    return {record.file: record for record in result.attitudes}


def _fixes(result: RunResult) -> dict[tuple[str, str, str], ObservationRecord]:
    return {(r.file, r.target, r.estimator): r for r in result.observations if r.center_px is not None}


def _attitude(one: AttitudeRecord, other: AttitudeRecord, shared: _Shared) -> Iterator[Difference]:
    if one.attitude is None or other.attitude is None:
        return
    turn = rotation_between(other.attitude.rotation, one.attitude.rotation)
    causes = shared.of_attitude(same_image=bool(one.sha256) and one.sha256 == other.sha256)
    parts = [_attitude_parts(attitude) for attitude in (one.attitude, other.attitude)]
    covariance = _sum_unshared(parts, causes, 3)
    scaled = None if covariance is None else covariance * ARCSEC_PER_RAD**2
    yield from differences_of(one.file, "attitude", ("x", "y", "z"), turn * ARCSEC_PER_RAD, scaled, "arcsec")


def _attitude_parts(attitude: Attitude) -> dict[Cause, Float] | None:
    if attitude.covariance_rad2 is None:
        return None
    if not attitude.parts:
        return {Cause.NOISE: np.array(attitude.covariance_rad2)}
    return {cause: np.array(part) for cause, part in attitude.parts.items()}


def _fix(one: ObservationRecord, other: ObservationRecord, shared: _Shared, same_image: bool) -> Iterator[Difference]:
    causes = shared.of_fix(one, other, same_image=same_image)
    what = f"{one.target}: {one.estimator}"
    parts = [_fix_parts(record) for record in (one, other)]
    offset = np.subtract(one.center_px or (np.nan,) * 2, other.center_px or (np.nan,) * 2)
    covariance = _sum_unshared([None if p is None else {c: m[:2, :2] for c, m in p.items()} for p in parts], causes, 2)
    yield from differences_of(one.file, what, ("x", "y"), offset, covariance, "px")
    if one.range_km is not None and other.range_km is not None:
        ranges = [None if p is None else {c: m[2:3, 2:3] for c, m in p.items() if len(m) > 2} for p in parts]
        covariance = _sum_unshared(ranges, causes, 1)
        values = np.array([one.range_km - other.range_km])
        yield from differences_of(one.file, what, ("range",), values, covariance, "km")


def _fix_parts(record: ObservationRecord) -> dict[Cause, Float] | None:
    if record.parts:
        return {cause: np.array(part) for cause, part in record.parts.items()}
    return None if record.covariance_px2 is None else {Cause.NOISE: np.array(record.covariance_px2)}


def _sum_unshared(both: Iterable[Mapping[Cause, Float] | None], shared: Iterable[Cause], size: int) -> Float | None:
    """Sum of the covariances of two results, without their common causes; None where one is unknown."""
    causes = [cause for cause in Cause if cause not in set(shared) and cause is not Cause.EPHEMERIS]
    unshared, total = np.zeros((size, size)), np.zeros((size, size))
    for parts in both:
        if not parts:
            return None
        unshared = unshared + sum_parts(parts, causes)
        total = total + sum_parts(parts, Cause)
    nothing = np.diag(unshared) <= _ROUNDING * np.diag(total)
    unshared[nothing, :] = 0.0
    unshared[:, nothing] = 0.0
    return unshared
