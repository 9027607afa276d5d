"""A finished run: its records, counts and camera, read back from the run folder."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.campaign.store.edits import read_edits
from giantlike.campaign.store.lock import at_work_text, is_locked
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord, ObservationsRecord, RunSummary
from giantlike.campaign.store.run_folder import CALIBRATION_FILE, CAMERA_FILE, NETWORK_FILE, RunFolder
from giantlike.core.arrays import require
from giantlike.core.display import Pictured
from giantlike.core.errors import DataError
from giantlike.core.outcomes import Reason
from giantlike.core.reasons import Outcome
from giantlike.core.values import Value
from giantlike.io.attitude_series import AttitudeSeries

if TYPE_CHECKING:
    from astropy.table import QTable


Item = TypeVar("Item")
Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusCounts:
    """Number of records by outcome, and of those without a result by reason."""

    ok: int
    accepted: int
    suspect: int
    failed: int
    rejected: int
    not_applicable: int
    not_in_field: int
    reasons: dict[str, int]

    @classmethod
    def from_records(cls, records: Sequence[AttitudeRecord | ObservationRecord]) -> StatusCounts:
        """Count records."""
        outcomes = Counter(record.outcome for record in records)
        reasons = Counter(str(record.problem.reason) for record in records if record.problem is not None)
        return cls(**{str(one): outcomes[one] for one in Outcome}, reasons=dict(reasons))

    @property
    def other_counts(self) -> dict[str, int]:
        """Numbers of records that are neither ok, suspect nor failed, by outcome in words; those that are not 0."""
        usual = (Outcome.OK, Outcome.SUSPECT, Outcome.FAILED)
        counts = {one.words: int(getattr(self, one)) for one in Outcome if one not in usual}
        return {words: count for words, count in counts.items() if count}


@dataclass(frozen=True, slots=True)
class StepCount:
    """Number of results of a step that a run made, and of those that it found made."""

    redone: int = 0
    kept: int = 0

    def plus(self, *, redone: int = 0, kept: int = 0) -> StepCount:
        """Return the count with more results."""
        return StepCount(self.redone + redone, self.kept + kept)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunResult(Pictured, Value):
    """A finished run.

    Parameters
    ----------
    folder : Path; the run folder
    name : str; of the campaign
    attitudes : tuple of AttitudeRecord; one per image, in input order; lists of stars stay in the run folder
    bodies : tuple of ObservationsRecord; one per image of a body; limb points and outlines stay in the folder
    hdu : int or str or None; FITS extension that was read
    bottom_up : bool; True if the rows were reversed on reading
    max_overlays : int; number of images shown in the report
    warnings : tuple of str
    time_s : float, s; duration of the last part of the run
    calibration : dict, optional; content of ``calibration.json``, if the campaign calibrates
    empty_images : frozenset of str; images that are expected to hold nothing
    network : dict, optional; content of ``network/result.json``, if the campaign adjusts a network
    steps : mapping of str to StepCount; results computed and kept by this run, by step; empty if read back
    """

    folder: Path
    name: str
    attitudes: tuple[AttitudeRecord, ...]
    bodies: tuple[ObservationsRecord, ...]
    hdu: int | str | None
    bottom_up: bool
    max_overlays: int
    warnings: tuple[str, ...]
    time_s: float
    calibration: dict[str, Any] | None = None
    empty_images: frozenset[str] = frozenset()
    network: dict[str, Any] | None = None
    steps: Mapping[str, StepCount] = field(default_factory=dict)

    def __repr__(self) -> str:
        images, fixes = StatusCounts.from_records(self.attitudes), StatusCounts.from_records(self.observations)
        return (
            f"RunResult({self.name!r}, {len(self.attitudes)} images: {images.ok} ok, {images.suspect} suspect, "
            f"{images.failed} failed; {len(self.observations)} observations: {fixes.ok} ok, {fixes.suspect} suspect, "
            f"{fixes.failed} failed)"
        )

    def table(self, name: str = "observations") -> QTable:
        """Return a table of the run, with units; InputError for an unknown name.

        It has a column for each of docs/tables.md that a CSV file has; cells without a value are masked.
        ``table.to_pandas()`` makes a data frame of it where pandas is installed.
        """
        from giantlike.campaign.store.tables import table_of

        return table_of(name, self.attitudes, self.observations)

    @property
    def observations(self) -> tuple[ObservationRecord, ...]:
        """One record per image, target and estimator, in input order."""
        return tuple(record for image in self.bodies for record in image.observations)

    @property
    def by_estimator(self) -> dict[tuple[str, str], list[ObservationRecord]]:
        """Observations by target and estimator."""
        return group_by(self.observations, lambda record: (record.target, record.estimator))

    @property
    def failed_images(self) -> tuple[str, ...]:
        """Images without an attitude, with a body for which no estimator made a fix, or with an internal error.

        Results rejected by a user, estimators that do not suit a body, and targets that are not in the field are no
        failures. Of images that are expected to hold nothing, those with a fix that is not suspect are failures, and
        those without are none.
        """
        failed = {record.file for record in self.observations if record.outcome is Outcome.FAILED}
        fixed = {record.file for record in self.observations if record.status != "failed"}
        broken = {record.file for record in self.observations if _has_internal_error(record)}
        found = {record.file for record in self.observations if record.outcome.is_usable}
        unreadable = {record.file for record in self.attitudes if not record.readable}
        missed = {record.file for record in self.attitudes if record.outcome is Outcome.FAILED} | (failed - fixed)
        wrong = (missed - self.empty_images) | (found & self.empty_images) | broken | unreadable
        return tuple(record.file for record in self.attitudes if record.file in wrong)

    def summary(self) -> dict[str, Any]:
        """Counts of the run, as JSON has them."""
        return {
            "campaign": self.name,
            "output": str(self.folder),
            "images": len(self.attitudes),
            "failed_images": list(self.failed_images),
            "attitudes": asdict(StatusCounts.from_records(self.attitudes)),
            "observations": [
                {"target": target, "estimator": estimator} | asdict(StatusCounts.from_records(records))
                for (target, estimator), records in self.by_estimator.items()
            ],
            "calibration": self.calibration,
            "steps": {name: asdict(count) for name, count in self.steps.items()},
            "warnings": list(self.warnings),
            "time_s": round(self.time_s, 3),
        }


def group_by(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """Items by key, keys and items in the order in which they come."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def load_result(path: Path) -> RunResult:
    """Read a finished run back from its folder.

    Parameters
    ----------
    path : Path; the run folder

    Raises
    ------
    DataError
        It is not a run folder, or the run in it is not finished.
    InputError
        A run is at work in it.
    """
    folder = RunFolder.open(path)
    run = folder.provenance().get("run")
    if not isinstance(run, dict):
        require(not is_locked(path), at_work_text(path))
        raise DataError(path, "the run in this folder is not finished: go on with giantlike run")
    try:
        summary = RunSummary.model_validate(run)
    except ValidationError as error:
        raise DataError(path, f"provenance.json is damaged: {' '.join(str(error).split())[:200]}") from error
    edits = read_edits(path)
    return RunResult(
        folder=path,
        attitudes=tuple(edits.attitudes(folder.attitudes())),
        bodies=tuple(edits.bodies(folder.bodies())),
        **dict(summary) | {"warnings": tuple(summary.warnings), "empty_images": frozenset(summary.empty_images)},
        calibration=_calibration(path / CALIBRATION_FILE),
        network=_calibration(path / NETWORK_FILE),
    )


def camera_of_run(path: Path) -> Camera:
    """Camera whose attitudes a run holds: the calibrated one if the run calibrated."""
    calibrated = path / CAMERA_FILE
    if calibrated.exists():
        return Camera.load(calibrated)
    inputs = RunFolder.open(path).provenance().get("inputs")
    table = inputs.get("camera") if isinstance(inputs, dict) else None
    if not isinstance(table, dict):
        raise DataError(path, "provenance.json does not hold the camera: run the campaign again")
    return Camera.from_mapping(table)


def attitude_series(records: Sequence[AttitudeRecord], camera: Camera) -> AttitudeSeries:
    """Attitudes of the records that have one and an epoch, in order of time."""
    known = sorted(
        ((r.et, r.file, r.attitude) for r in records if r.et is not None and r.attitude is not None),
        key=lambda item: item[0],
    )
    unknown = np.full((3, 3), np.nan).tolist()
    return AttitudeSeries(
        et=np.array([et for et, _, _ in known]),
        camera_from_inertial=Rotation.from_quat(np.reshape([a.quaternion_xyzw for _, _, a in known], (-1, 4))),
        covariance_rad2=np.reshape([a.covariance_rad2 or unknown for _, _, a in known], (-1, 3, 3)),
        names=tuple(file for _, file, _ in known),
        frame=camera.frame_name,
    )


def _has_internal_error(record: ObservationRecord) -> bool:
    return record.problem is not None and record.problem.reason == Reason.INTERNAL_ERROR


def _calibration(path: Path) -> dict[str, Any] | None:
    """Content of ``calibration.json``; None if there is none."""
    if not path.exists():
        return None
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise DataError(path, "is damaged: delete it, and giantlike run calibrates again") from error


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Names of the inputs that differ, dotted for changes within tables.

    >>> changes({"a": {"b": 1, "c": 2}, "d": 3}, {"a": {"b": 1, "c": 5}})
    ['a.c', 'd']
    """
    names: list[str] = []
    for key in dict.fromkeys([*before, *now]):
        old, new = before.get(key), now.get(key)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            names += [f"{key}.{name}" for name in changes(old, new)]
        elif old != new:
            names.append(key)
    return names
