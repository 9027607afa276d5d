"""A campaign from its file to its run folder."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from giantlike.camera import Camera
from giantlike.campaign.calibration.report import write_calibration_report
from giantlike.campaign.calibration.solve import (
    CampaignCalibration,
    calibrate_campaign,
    calibration_summary,
    write_calibration,
)
from giantlike.campaign.file.config import Campaign, ImageEntry
from giantlike.campaign.file.schema import CalibrationSection
from giantlike.campaign.report.report import write_report
from giantlike.campaign.run.attitude_transfer import attitude_to_use, carry_attitudes
from giantlike.campaign.run.image_loading import targets_in
from giantlike.campaign.run.pool import WorkerPool
from giantlike.campaign.run.worker import (
    BodyJob,
    Workbench,
    estimate_image,
    failed_image,
    failed_observations,
    find_first_stars,
    solve_image,
)
from giantlike.campaign.store.parts import AnyRecord, Record, RunFolder, stamp_of
from giantlike.campaign.store.provenance import environment_of, inputs_of
from giantlike.campaign.store.records import (
    AttitudeRecord,
    CalibrationRecord,
    ObservationRecord,
    ObservationsRecord,
    Problem,
)
from giantlike.campaign.store.results import RunResult
from giantlike.campaign.store.tables import write_tables
from giantlike.core.outcomes import Reason

Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with what is being done, how many images are done, and of how many."""

_DIED = Problem(
    reason=Reason.INTERNAL_ERROR,
    detail="the worker process died twice on this image (killed from outside, out of memory, or a crash in a library)",
)


def run_campaign(
    campaign: Campaign,
    *,
    workers: int | None = None,
    resume: bool = False,
    bodies: bool = True,
    progress: Progress | None = None,
) -> RunResult:
    """Run a campaign and write its run folder.

    With a ``[calibration]`` section the camera is calibrated first, and everything else uses the calibrated camera.
    Where calibration fails or is not accepted, the run goes on with the camera it was given, and says so.

    Parameters
    ----------
    campaign : Campaign
    workers : int, optional
        Number of processes; default one per CPU, never more than images.
    resume : bool
        Go on with a run that was interrupted.
    bodies : bool
        Run the estimators of bodies too; without, the run ends with the attitudes (and can be continued).
    progress : callable, optional

    Returns
    -------
    RunResult

    Raises
    ------
    InputError
        The run folder holds another run.
    DataError
        A kernel, shape or catalog is damaged, or the run folder cannot be written.
    """
    start = time.perf_counter()
    bench = Workbench.load(campaign)
    try:
        folder = RunFolder.start(campaign.output, inputs_of(campaign, bench), environment_of(campaign), resume=resume)
        folder.log("run_started", resume=resume, images=len(campaign.images))
        for warning in campaign.warnings:
            folder.log("warning", detail=warning)
        count = max(1, min(_cpus() if workers is None else workers, len(campaign.images)))
        calibration, campaign, attitudes, records = _work_through(bench, folder, count, bodies, progress or _silent)
    finally:
        bench.close()
    result = RunResult(
        folder=folder.path,
        name=campaign.name,
        attitudes=tuple(attitudes),
        bodies=tuple(records),
        hdu=campaign.hdu,
        bottom_up=campaign.bottom_up,
        max_overlays=campaign.max_overlays,
        warnings=campaign.warnings,
        time_s=time.perf_counter() - start,
        calibration=None if calibration is None else calibration_summary(calibration),
    )
    _finish(folder, result)
    return result


def _work_through(
    bench: Workbench, folder: RunFolder, workers: int, bodies: bool, progress: Progress
) -> tuple[CampaignCalibration | None, Campaign, list[AttitudeRecord], list[ObservationsRecord]]:
    """All passes over the images; the campaign that comes back has the camera that was used."""
    campaign = bench.campaign
    # Taken before any image is read: a file that changes later is noticed when the run is continued.
    stamps = tuple(stamp_of(entry.path) for entry in campaign.images)
    calibration = None
    if campaign.calibration is not None:
        with WorkerPool(bench, workers) as pool:
            calibration = _Run(campaign, folder, pool, progress, stamps).calibrate(bench, campaign.calibration)
        bench, stamps = _with_calibration(bench, calibration, stamps)
        campaign = bench.campaign
    with WorkerPool(bench, workers) as pool:
        run = _Run(campaign, folder, pool, progress, stamps)
        attitudes = run.carry(run.solve_images())
        records = run.estimate_images(attitudes) if bodies else []
    return calibration, campaign, attitudes, records


def _with_calibration(
    bench: Workbench, calibration: CampaignCalibration, stamps: tuple[str, ...]
) -> tuple[Workbench, tuple[str, ...]]:
    """Workbench to go on with, and stamps that no record made with another camera has."""
    if calibration.problem is not None:
        bench = bench.with_warning(calibration.problem)
    if calibration.camera is None:
        return bench, stamps
    digest = _digest(calibration.camera)
    return bench.with_camera(calibration.camera), tuple(f"{stamp} {digest}" for stamp in stamps)


def _finish(folder: RunFolder, result: RunResult) -> None:
    write_tables(folder.path, result.attitudes, result.observations)
    run = {
        "name": result.name,
        "hdu": result.hdu,
        "bottom_up": result.bottom_up,
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

    def _save(self, record: AnyRecord) -> None:
        self.folder.save(record, self.stamps[record.index])

    def _done(self, kind: type[Record], entry: ImageEntry) -> Record | None:
        return self.folder.load_valid(kind, entry.index, entry.key, self.stamps[entry.index])

    def calibrate(self, bench: Workbench, setup: CalibrationSection) -> CampaignCalibration:
        """Identify the stars of all star images, calibrate, and write what comes out."""
        entries = self.campaign.images
        records = {
            entry.index: record for entry in entries if (record := self._done(CalibrationRecord, entry)) is not None
        }
        todo = [entry for entry in entries if entry.index not in records]
        stage = "finding stars"
        self.progress(stage, len(records), len(entries))
        for position, answer in self.pool.run(find_first_stars, todo):
            entry = todo[position]
            record = answer or CalibrationRecord(index=entry.index, file=entry.key, problem=_DIED)
            self._save(record)
            records[entry.index] = record
            self.progress(stage, len(records), len(entries))
        assert bench.navigation is not None
        ordered = [records[entry.index] for entry in entries]
        result = calibrate_campaign(self.campaign, setup, ordered, bench.navigation.catalog)
        if write_calibration(self.folder.path, result):
            write_calibration_report(self.folder.path, self.campaign.name, self.campaign.camera, result)
        self.folder.log("calibrated", accepted=result.camera is not None, problem=result.problem)
        return result

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


def _digest(camera: Camera) -> str:
    """Short hash of a camera."""
    return hashlib.sha256(json.dumps(camera.to_mapping(), sort_keys=True).encode()).hexdigest()[:16]


def _cpus() -> int:
    """CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _silent(stage: str, done: int, total: int) -> None:
    """Report nothing."""
