"""A campaign from its file to its run folder: calibration, attitudes, transfer, bodies, tables and report."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeAlias, TypeVar

from giantlike.camera import Camera
from giantlike.campaign.calibration.page import write_calibration_page
from giantlike.campaign.calibration.solve import (
    CampaignCalibration,
    calibrate_campaign,
    calibration_summary,
    write_calibration,
)
from giantlike.campaign.file.config import Campaign, ImageEntry
from giantlike.campaign.report.run_page import write_report
from giantlike.campaign.run.attitude_transfer import attitude_to_use, transfer_attitudes
from giantlike.campaign.run.image_loading import targets_in
from giantlike.campaign.run.pool import WorkerPool
from giantlike.campaign.run.provenance import environment_of, inputs_of
from giantlike.campaign.run.worker import (
    ImageJob,
    Workbench,
    estimate_image,
    failed_image,
    failed_observations,
    failed_stars,
    find_first_stars,
    solve_image,
)
from giantlike.campaign.store.log import RunLog
from giantlike.campaign.store.observables import write_run_observables
from giantlike.campaign.store.records import (
    AttitudeRecord,
    CalibrationRecord,
    ImageRecord,
    ObservationRecord,
    ObservationsRecord,
    Problem,
    RunSummary,
)
from giantlike.campaign.store.results import RunResult
from giantlike.campaign.store.run_folder import Record, RunFolder, stamp_of
from giantlike.campaign.store.tables import write_tables
from giantlike.core.outcomes import Reason
from giantlike.core.processes import process_count

Made = TypeVar("Made", bound=ImageRecord)
Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with the name of the step, the number of images done, and of all."""

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
    If calibration fails or is not accepted, the run goes on with the given camera and a warning.

    Parameters
    ----------
    campaign : Campaign
    workers : int, optional
        Number of processes; default one per CPU, never more than images.
    resume : bool
        Continue a run that was interrupted.
    bodies : bool
        Run the estimators of bodies too; without them the run ends with the attitudes (and can be continued).
    progress : callable, optional
        Called with the name of the step, the number of images done, and of all.

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
        with RunLog(folder.path):
            folder.log("run_started", resume=resume, images=len(campaign.images))
            for warning in campaign.warnings:
                folder.log("warning", detail=warning)
            # Taken before any image is read: a file that changes later is noticed when the run is continued.
            stamps = tuple(stamp_of(entry.path) for entry in campaign.images)
            run = _Run(bench, folder, progress or silent, stamps)
            processes = process_count(workers, len(campaign.images))
            calibration = None
            if campaign.calibration is not None:
                with WorkerPool(bench, processes) as pool:
                    calibration = run.calibrate(pool)
                run = run.with_calibration(calibration)
            with WorkerPool(run.bench, processes) as pool:
                attitudes = run.transfer_attitudes(run.solve_images(pool))
                records = run.estimate_images(attitudes, pool) if bodies else []
            result = RunResult(
                folder=folder.path,
                name=campaign.name,
                attitudes=tuple(attitudes),
                bodies=tuple(records),
                hdu=campaign.hdu,
                bottom_up=campaign.bottom_up,
                max_overlays=campaign.max_overlays,
                warnings=run.bench.campaign.warnings,
                time_s=time.perf_counter() - start,
                calibration=None if calibration is None else calibration_summary(calibration),
            )
            _finish(folder, result)
    finally:
        bench.close()
    return result


def _finish(folder: RunFolder, result: RunResult) -> None:
    write_tables(folder.path, result.attitudes, result.observations)
    run = RunSummary(
        name=result.name,
        hdu=result.hdu,
        bottom_up=result.bottom_up,
        max_overlays=result.max_overlays,
        warnings=list(result.warnings),
        time_s=round(result.time_s, 3),
    )
    images = {record.file: record.sha256 for record in result.attitudes}
    folder.write_provenance(folder.provenance() | {"images_sha256": images, "run": run.model_dump()})
    write_run_observables(result)
    write_report(result)
    folder.log("run_finished", failed_images=len(result.failed_images), time_s=run.time_s)


@dataclass(frozen=True, slots=True)
class _Step(Generic[Made]):
    """Work on every image: its name, the function of the workers, and the record of an image whose worker died."""

    name: str
    function: Callable[[Workbench, ImageJob], Made]
    record_of_lost: Callable[[ImageEntry], Made]


@dataclass(frozen=True, slots=True)
class _Run:
    """The steps of a run; a record that the run folder holds with the stamp of today is not made again."""

    bench: Workbench
    folder: RunFolder
    progress: Progress
    stamps: tuple[str, ...]

    @property
    def campaign(self) -> Campaign:
        return self.bench.campaign

    def with_calibration(self, calibration: CampaignCalibration) -> _Run:
        """Return the run with the calibrated camera, and stamps that no record made with another camera has."""
        bench, stamps = self.bench, self.stamps
        if calibration.problem is not None:
            bench = bench.with_warning(calibration.problem)
        if calibration.camera is not None:
            bench, digest = bench.with_camera(calibration.camera), _digest(calibration.camera)
            stamps = tuple(f"{stamp} {digest}" for stamp in stamps)
        return replace(self, bench=bench, stamps=stamps)

    def calibrate(self, pool: WorkerPool) -> CampaignCalibration:
        """Identify the stars of all star images, calibrate, and write camera, summary, residuals and page."""
        campaign, setup, navigation = self.campaign, self.campaign.calibration, self.bench.navigation
        assert setup is not None
        assert navigation is not None
        step = _Step("finding stars", find_first_stars, lambda entry: failed_stars(entry, _DIED))
        records = self._make(pool, step, self._done(CalibrationRecord))
        result = calibrate_campaign(campaign, setup, records, navigation.catalog)
        if write_calibration(self.folder.path, result):
            write_calibration_page(self.folder.path, campaign.name, campaign.camera, result)
        self.folder.log("calibrated", accepted=result.camera is not None, problem=result.problem)
        return result

    def solve_images(self, pool: WorkerPool) -> list[AttitudeRecord]:
        """Read all images and solve the stars of star images."""
        name = "reading images" if self.campaign.stars is None else "solving stars"
        step = _Step(name, solve_image, lambda entry: failed_image(self.campaign, entry, _DIED))
        return self._make(pool, step, self._done(AttitudeRecord))

    def transfer_attitudes(self, solved: Sequence[AttitudeRecord]) -> list[AttitudeRecord]:
        """Give short exposures the attitudes of their neighbors in time."""
        transferred = transfer_attitudes(self.campaign, solved)
        for before, record in zip(solved, transferred, strict=True):
            if record != before:
                self._save(record)
                self._log("attitude_carried", record)
        return transferred

    def estimate_images(self, attitudes: Sequence[AttitudeRecord], pool: WorkerPool) -> list[ObservationsRecord]:
        """Run the estimators on all images of bodies."""
        records: dict[int, ObservationsRecord] = {}
        jobs: list[ImageJob] = []
        for entry, image in zip(self.campaign.images, attitudes, strict=True):
            if not image.body_image or not targets_in(self.campaign, entry.key):
                self.folder.drop_observations(entry.index)
                continue
            attitude = attitude_to_use(self.campaign, image)
            done = self._load(ObservationsRecord, entry)
            if not image.readable and image.problem is not None:
                record = failed_observations(self.campaign, entry, image.problem, epoch_utc=image.epoch_utc)
                self._save(record)
                records[entry.index] = record
            elif done is not None and all(record.attitude == attitude for record in done.observations):
                records[entry.index] = done.light()
            else:
                jobs.append(ImageJob(entry, attitude))
        step = _Step("finding bodies", estimate_image, lambda entry: failed_observations(self.campaign, entry, _DIED))
        return self._make(pool, step, records, jobs)

    def _make(
        self, pool: WorkerPool, step: _Step[Made], records: dict[int, Made], jobs: Sequence[ImageJob] | None = None
    ) -> list[Made]:
        """Run the jobs of a step, by default all images without a record; save and log; records in input order."""
        if jobs is None:
            jobs = [ImageJob(entry) for entry in self.campaign.images if entry.index not in records]
        total = len(records) + len(jobs)
        if jobs:
            self.progress(step.name, len(records), total)
        for position, answer in pool.run(step.function, jobs):
            entry = jobs[position].entry
            record = answer or step.record_of_lost(entry)
            self._save(record)
            if isinstance(record, AttitudeRecord):
                self._log("image", record)
            elif isinstance(record, ObservationsRecord):
                for observation in record.observations:
                    self._log("observation", observation)
            records[entry.index] = record.light()
            self.progress(step.name, len(records), total)
        return [records[index] for index in sorted(records)]

    def _load(self, kind: type[Record], entry: ImageEntry) -> Record | None:
        return self.folder.load(kind, entry.index, entry.key, stamp=self.stamps[entry.index])

    def _done(self, kind: type[Record]) -> dict[int, Record]:
        """Records of a step that need not be made again, by index."""
        found = {entry.index: self._load(kind, entry) for entry in self.campaign.images}
        return {index: record.light() for index, record in found.items() if record is not None}

    def _save(self, record: ImageRecord) -> None:
        self.folder.save(record, self.stamps[record.index])

    def _log(self, event: str, record: AttitudeRecord | ObservationRecord) -> None:
        names = ("file", "status", "target", "estimator", "notes", "time_s")
        values = {name: value for name in names if (value := getattr(record, name, None)) not in (None, [])}
        if record.problem is not None:
            values |= record.problem.model_dump(mode="json", exclude_none=True)
        self.folder.log(event, **values)


def _digest(camera: Camera) -> str:
    """Short hash of a camera."""
    return hashlib.sha256(json.dumps(camera.to_mapping(), sort_keys=True).encode()).hexdigest()[:16]


def silent(stage: str, done: int, total: int) -> None:
    """Report nothing."""
