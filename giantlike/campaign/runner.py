"""A campaign from its file to its run folder."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from giantlike.campaign.carry import attitude_to_use, carry_attitudes
from giantlike.campaign.config import Campaign, ImageEntry
from giantlike.campaign.pool import WorkerPool
from giantlike.campaign.prepare import targets_in
from giantlike.campaign.provenance import environment_of, inputs_of
from giantlike.campaign.records import AttitudeRecord, ObservationRecord, ObservationsRecord, Problem
from giantlike.campaign.report import write_report
from giantlike.campaign.results import RunResult
from giantlike.campaign.store import Record, RunFolder, stamp_of
from giantlike.campaign.tables import write_tables
from giantlike.campaign.work import (
    BodyJob,
    Workbench,
    estimate_image,
    failed_image,
    failed_observations,
    solve_image,
)
from giantlike.core.outcomes import Reason

Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with what is being done, how many images are done, and of how many."""

_DIED = Problem(
    reason=Reason.INTERNAL_ERROR,
    detail="the worker process died twice on this image (killed from outside, out of memory, or a crash in a library)",
)


def run_campaign(
    campaign: Campaign, *, workers: int | None = None, resume: bool = False, progress: Progress | None = None
) -> RunResult:
    """Run a campaign and write its run folder.

    Parameters
    ----------
    campaign : Campaign
    workers : int, optional
        Number of processes; default one per CPU, never more than images.
    resume : bool
        Go on with a run that was interrupted.
    progress : callable, optional

    Returns
    -------
    RunResult

    Raises
    ------
    InputError
        The run folder holds another run.
    DataError
        A kernel, shape or catalogue is damaged, or the run folder cannot be written.
    """
    start = time.perf_counter()
    bench = Workbench.load(campaign)
    try:
        folder = RunFolder.start(campaign.output, inputs_of(campaign, bench), environment_of(campaign), resume=resume)
        folder.log("run_started", resume=resume, images=len(campaign.images))
        for warning in campaign.warnings:
            folder.log("warning", detail=warning)
        count = max(1, min(_cpus() if workers is None else workers, len(campaign.images)))
        with WorkerPool(bench, count) as pool:
            # Taken before any image is read: a file that changes later is noticed when the run is continued.
            stamps = tuple(stamp_of(entry.path) for entry in campaign.images)
            run = _Run(campaign, folder, pool, progress or _silent, stamps)
            attitudes = run.carry(run.solve_images())
            bodies = run.estimate_images(attitudes)
    finally:
        bench.close()
    result = RunResult(
        folder=folder.path,
        name=campaign.name,
        attitudes=tuple(attitudes),
        bodies=tuple(bodies),
        hdu=campaign.hdu,
        max_overlays=campaign.max_overlays,
        warnings=campaign.warnings,
        time_s=time.perf_counter() - start,
    )
    _finish(folder, result)
    return result


def _finish(folder: RunFolder, result: RunResult) -> None:
    write_tables(folder.path, result.attitudes, result.observations)
    run = {
        "name": result.name,
        "hdu": result.hdu,
        "max_overlays": result.max_overlays,
        "warnings": result.warnings,
        "time_s": round(result.time_s, 3),
    }
    images = {record.file: record.sha256 for record in result.attitudes}
    folder.write_provenance(folder.provenance() | {"images_sha256": images, "run": run})
    write_report(result)
    folder.log("run_finished", failed_images=len(result.failed_images), time_s=run["time_s"])


@dataclass(frozen=True, slots=True)
class _Run:
    """The two passes over the images; what is in the run folder is not done again."""

    campaign: Campaign
    folder: RunFolder
    pool: WorkerPool
    progress: Progress
    stamps: tuple[str, ...]

    def _save(self, record: AttitudeRecord | ObservationsRecord) -> None:
        self.folder.save(record, self.stamps[record.index])

    def _done(self, kind: type[Record], entry: ImageEntry) -> Record | None:
        return self.folder.load_valid(kind, entry.index, entry.key, self.stamps[entry.index])

    def solve_images(self) -> list[AttitudeRecord]:
        entries = self.campaign.images
        records = {
            entry.index: record.light()
            for entry in entries
            if (record := self._done(AttitudeRecord, entry)) is not None
        }
        todo = [entry for entry in entries if entry.index not in records]
        stage = "reading images" if self.campaign.stars is None else "solving stars"
        self.progress(stage, len(records), len(entries))
        for position, answer in self.pool.run(solve_image, todo):
            entry = todo[position]
            record = answer or failed_image(self.campaign, entry, _DIED)
            self._save(record)
            self._log("image", record, record.problem)
            records[entry.index] = record.light()
            self.progress(stage, len(records), len(entries))
        return [records[entry.index] for entry in entries]

    def carry(self, solved: Sequence[AttitudeRecord]) -> list[AttitudeRecord]:
        carried = carry_attitudes(self.campaign, solved)
        for before, record in zip(solved, carried, strict=True):
            if record != before:
                self._save(record)
                self._log("attitude_carried", record, record.problem)
        return carried

    def estimate_images(self, attitudes: Sequence[AttitudeRecord]) -> list[ObservationsRecord]:
        results: dict[int, ObservationsRecord] = {}
        todo: list[BodyJob] = []
        for entry, image in zip(self.campaign.images, attitudes, strict=True):
            if not image.body_image or not targets_in(self.campaign, entry.key):
                self.folder.drop_observations(entry.index)
                continue
            attitude = attitude_to_use(image)
            done = self._done(ObservationsRecord, entry)
            if not image.readable and image.problem is not None:
                record = failed_observations(self.campaign, entry, image.problem, epoch_utc=image.epoch_utc)
                self._save(record)
                results[entry.index] = record
            elif done is not None and all(record.attitude == attitude for record in done.observations):
                results[entry.index] = done.light()
            else:
                todo.append(BodyJob(entry, attitude))
        total = len(results) + len(todo)
        if todo:
            self.progress("finding bodies", len(results), total)
        for position, answer in self.pool.run(estimate_image, todo):
            entry = todo[position].entry
            record = answer or failed_observations(self.campaign, entry, _DIED)
            self._save(record)
            for observation in record.observations:
                self._log("observation", observation, observation.problem)
            results[entry.index] = record.light()
            self.progress("finding bodies", len(results), total)
        return [results[index] for index in sorted(results)]

    def _log(self, event: str, record: AttitudeRecord | ObservationRecord, problem: Problem | None) -> None:
        names = ("file", "status", "target", "estimator", "notes", "time_s")
        values = {name: value for name in names if (value := getattr(record, name, None)) not in (None, [])}
        if problem is not None:
            values |= problem.model_dump(mode="json", exclude_none=True)
        self.folder.log(event, **values)


def _cpus() -> int:
    """CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _silent(stage: str, done: int, total: int) -> None:
    """Report nothing."""
