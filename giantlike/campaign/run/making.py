"""Steps of a run: results that are missing or depend on changed inputs are computed, all others are kept."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

from giantlike.camera import Camera
from giantlike.campaign.calibration.page import write_calibration_page
from giantlike.campaign.calibration.solve import (
    calibrate_campaign,
    calibration_summary,
    kept_calibration,
    write_calibration,
)
from giantlike.campaign.file.config import Campaign, ImageEntry
from giantlike.campaign.run.attitude_transfer import attitude_to_use, transfer_attitudes
from giantlike.campaign.run.bodies import BodyRecord, failed_bodies, work_in
from giantlike.campaign.run.pool import Pool
from giantlike.campaign.run.provenance import Identities
from giantlike.campaign.run.steps import Steps, digest
from giantlike.campaign.run.worker import (
    ImageAnswer,
    ImageJob,
    failed_stars,
    find_first_stars,
    lost_image,
    process_image,
)
from giantlike.campaign.run.worker_context import Workbench
from giantlike.campaign.store.edits import EditList, Measuring
from giantlike.campaign.store.packing import PackedRecord
from giantlike.campaign.store.records import (
    Attitude,
    AttitudeRecord,
    CalibrationRecord,
    ImageRecord,
    ObservationRecord,
    Problem,
    TargetRecord,
)
from giantlike.campaign.store.results import StepCount
from giantlike.campaign.store.run_folder import TRANSFER, RunFolder
from giantlike.core.outcomes import Reason

Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with the name of the step, the number of images done, and of all."""
Announce: TypeAlias = Callable[[str], None]  # called with a line for users

_DIED = Problem(
    reason=Reason.INTERNAL_ERROR,
    detail="the worker process died twice on this image (killed from outside, out of memory, or a crash in a library)",
)
_FIRST_STARS, _ATTITUDES, _TARGETS = "calibration", "attitudes", "geometry"  # names of the steps other than estimators


@dataclass(frozen=True, slots=True, kw_only=True)
class RunExecutor:
    """The steps of a run."""

    bench: Workbench
    folder: RunFolder
    progress: Progress  # progress, announce: see :func:`~giantlike.campaign.run.runner.run_campaign`
    announce: Announce
    edits: EditList
    measuring: Mapping[str, Measuring]
    identities: Identities
    goes_on: bool  # the folder held a run before
    camera: Camera | None = None  # the calibrated camera
    counts: dict[str, StepCount] = field(default_factory=dict)  # results computed and kept so far, by step

    @property
    def campaign(self) -> Campaign:
        """The campaign, with the calibrated camera where there is one."""
        return self.bench.campaign

    # --- calibration -------------------------------------------------------------------------------------------------

    def calibrate(self, pool: Pool) -> tuple[RunExecutor, dict[str, Any] | None]:
        """Identify the stars of all star images and calibrate. Returns ``run`` and ``summary``."""
        setup, navigation = self.campaign.calibration, self.bench.navigation
        if setup is None or navigation is None:
            return self, None
        rejected, keys = self.edits.rejected_images(), self._first_stars(pool)
        inputs = digest(replace(self.campaign.camera, photometry=None).to_mapping(), setup, keys, sorted(rejected))
        kept = kept_calibration(self.folder.path, inputs)
        if kept is None:
            records = [
                record
                for entry in self.campaign.images
                if entry.key not in rejected and (record := self.folder.load(CalibrationRecord, entry.key)) is not None
            ]
            result = calibrate_campaign(self.campaign, setup, records, navigation.catalog)
            write_calibration(self.folder.path, result, inputs)
            write_calibration_page(self.folder.path, self.campaign.name, self.campaign.camera, result)
            self.folder.log("calibrated", accepted=result.camera is not None, problem=result.problem)
            # Read back, so that a run that keeps the calibration has the very same camera.
            kept = kept_calibration(self.folder.path, inputs)
            assert kept is not None, calibration_summary(result)
            self.counts["camera"] = StepCount(redone=1)
        else:
            self.counts["camera"] = StepCount(kept=1)
        bench = self.bench
        if kept.problem is not None:
            bench = bench.with_warning(kept.problem)
        if kept.camera is not None:
            bench = bench.with_camera(kept.camera)
        return replace(self, bench=bench, camera=kept.camera), kept.summary

    def _first_stars(self, pool: Pool) -> list[tuple[str, str]]:
        """Make the records of stars that are missing; names and hashes of all of them."""
        setup = self.campaign.calibration
        assert setup is not None
        steps = Steps(self.bench)

        def key_of(entry: ImageEntry) -> str:
            stars = self._measuring(entry).of_stars
            limits = (setup.scale_error, None if self.campaign.stars is None else self.campaign.stars.long_exposure_s)
            return steps.first_stars(entry, self.identities.find_hash(entry), limits, stars)

        known = self.folder.keys(CalibrationRecord)
        todo = [
            entry
            for entry in self.campaign.images
            if not self.identities.find_hash(entry) or known.get((entry.key, "", "")) != key_of(entry)
        ]
        self._say_first({_FIRST_STARS: StepCount(redone=len(todo), kept=len(self.campaign.images) - len(todo))})
        jobs = [ImageJob(entry=entry, measuring=self._measuring(entry)) for entry in todo]
        for done, (position, answer) in enumerate(pool.run(find_first_stars, jobs)):
            self.progress("finding stars", len(self.campaign.images) - len(jobs) + done, len(self.campaign.images))
            entry = todo[position]
            packed = answer or PackedRecord.from_record(failed_stars(entry, _DIED))
            self.identities.find_hash(entry)
            self.identities.read(entry, packed.light.sha256)
            self.folder.save(packed, key_of(entry))
        known = self.folder.keys(CalibrationRecord)
        return [(entry.key, known.get((entry.key, "", ""), "")) for entry in self.campaign.images]

    # --- attitudes and bodies ----------------------------------------------------------------------------------------

    def make_all(self, pool: Pool, *, bodies: bool) -> None:
        """Make attitudes, carry them to short exposures, and find bodies."""
        plan = _Plan.from_run(self)
        transfers = self.campaign.stars is not None and self.campaign.stars.long_exposure_s is not None
        if transfers or not bodies:
            jobs = [self.job(entry, solve=True) for entry in plan.unsolved]
            self._say_first({_ATTITUDES: StepCount(redone=len(jobs), kept=len(plan.solved))})
            self._process(pool, plan, jobs, "reading images" if self.campaign.stars is None else "solving stars")
            self._transfer(plan)
        else:
            self._drop_transfers(())
        if bodies:
            self._process(pool, plan, self._body_jobs(plan), "finding bodies")
        self._place(plan, bodies=bodies)

    def _body_jobs(self, plan: _Plan) -> list[ImageJob]:
        """Jobs of all images on which estimators, or a solution with estimators, are to run."""
        jobs, counts = list[ImageJob](), dict[str, StepCount]()
        unsolved = {entry.key for entry in plan.unsolved} - plan.solved.keys()
        for entry in self.campaign.images:
            record = plan.solved.get(entry.key) or plan.stale.get(entry.key)
            if entry.key in plan.rejected or (
                record is not None and entry.key not in unsolved and not record.body_image
            ):
                if entry.key in unsolved:
                    jobs.append(self.job(entry, solve=True))
                continue
            work = work_in(self.campaign, entry.key)
            attitude = None if record is None else attitude_to_use(self.campaign, record)
            known = [
                one for one in work if plan.keys.get((entry.key, *one)) == self._key(plan, entry, *one, attitude) != ""
            ]
            todo = tuple(one for one in work if one not in known)
            for one in work:
                name = _step_name(*one)
                counts[name] = counts.get(name, StepCount()).plus(redone=one in todo, kept=one in known)
            if record is not None and not record.readable and entry.key not in unsolved and record.problem is not None:
                failed = failed_bodies(entry, todo, record.problem, epoch_utc=record.epoch_utc)
                self._save_bodies(plan, entry, None, map(PackedRecord.from_record, failed))
            elif entry.key in unsolved:
                job = self.job(entry, solve=True)
                jobs.append(replace(job, attitude=attitude, bodies=todo, bodies_if_turned=tuple(known)))
            elif todo:
                jobs.append(replace(self.job(entry, solve=False), attitude=attitude, bodies=todo))
        if unsolved or _ATTITUDES not in self.counts:
            counts = {_ATTITUDES: StepCount(redone=len(unsolved), kept=len(plan.solved))} | counts
        self._say_first(counts)
        return jobs

    def job(self, entry: ImageEntry, *, solve: bool) -> ImageJob:
        """Work on an image, with the calibrated camera and what users decided."""
        return ImageJob(entry=entry, camera=self.camera, measuring=self._measuring(entry), solve=solve)

    def _measuring(self, entry: ImageEntry) -> Measuring:
        return self.measuring.get(entry.key, Measuring())

    def _process(self, pool: Pool, plan: _Plan, jobs: list[ImageJob], name: str) -> None:
        """Run jobs; save and log their results."""
        total = len(self.campaign.images)
        done = total - len(jobs)
        if jobs:
            self.progress(name, done, total)
        for position, answer in pool.run(process_image, jobs):
            job = jobs[position]
            answer = answer or lost_image(self.campaign, job, _DIED)
            self._save_answer(plan, job, answer)
            done += 1
            self.progress(name, done, total)

    def _save_answer(self, plan: _Plan, job: ImageJob, answer: ImageAnswer) -> None:
        entry, attitude = job.entry, job.attitude
        if answer.attitude is not None:
            record = answer.attitude.light
            self.identities.find_hash(entry)
            self.identities.read(entry, record.sha256)
            plan.solved[entry.key] = record
            self._save(answer.attitude, self._attitude_key(plan, entry, record))
            attitude = attitude_to_use(self.campaign, record)
        self._save_bodies(plan, entry, attitude, answer.bodies)
        made = {packed.light.subject for packed in answer.bodies}
        for one in job.bodies_if_turned:
            if one in made:
                self.counts[_step_name(*one)] = self.counts[_step_name(*one)].plus(redone=1, kept=-1)

    def _save_bodies(
        self, plan: _Plan, entry: ImageEntry, attitude: Attitude | None, records: Iterable[PackedRecord[BodyRecord]]
    ) -> None:
        for packed in records:
            self._save(packed, self._key(plan, entry, *packed.light.subject, attitude))

    def _save(self, packed: PackedRecord[Any], key: str, *, step: str | None = None) -> None:
        record: ImageRecord = packed.light
        self.folder.save(packed, key, step=step)
        event = {"attitude": "image", "observation": "observation"}.get(record.part)
        if event is not None:
            names = ("file", "status", "target", "estimator", "notes", "time_s")
            values = {name: value for name in names if (value := getattr(record, name, None)) not in (None, [])}
            for problem in record.problems:
                values |= problem.model_dump(mode="json", exclude_none=True)
            self.folder.log(event if step is None else "attitude_carried", **values)

    def _transfer(self, plan: _Plan) -> None:
        """Give short exposures the attitudes of their neighbors in time."""
        solved = self.edits.attitudes([plan.solved[entry.key] for entry in self.campaign.images])
        carried = list[str]()
        redone = 0
        for record in transfer_attitudes(self.campaign, solved):
            if record.transferred and record.file not in plan.rejected:
                plan.solved[record.file] = record
                carried.append(record.file)
                held = self.folder.load(AttitudeRecord, record.file, step=TRANSFER)
                if held is None or held.replace(index=record.index, path=record.path) != record:
                    self._save(PackedRecord.from_record(record), "", step=TRANSFER)
                    redone += 1
        self._drop_transfers(carried)
        if carried:
            self.counts[TRANSFER] = StepCount(redone=redone, kept=len(carried) - redone)

    def _drop_transfers(self, carried: Iterable[str]) -> None:
        held = {file for file, _, _ in self.folder.keys(AttitudeRecord, step=TRANSFER)}
        self.folder.drop(AttitudeRecord, held - set(carried), step=TRANSFER)

    def _place(self, plan: _Plan, *, bodies: bool) -> None:
        """Say which records are the results of this campaign, and in which order."""
        places: dict[type[ImageRecord], dict[tuple[str, str, str], int]] = {ObservationRecord: {}, TargetRecord: {}}
        for entry in self.campaign.images if bodies else ():
            record = plan.solved.get(entry.key)
            if record is None or record.body_image:
                for place, (target, estimator) in enumerate(work_in(self.campaign, entry.key)):
                    places[ObservationRecord if estimator else TargetRecord][entry.key, target, estimator] = place
        for kind, of_kind in places.items():
            self.folder.set_places(kind, of_kind)

    def _attitude_key(self, plan: _Plan, entry: ImageEntry, record: AttitudeRecord) -> str:
        stars = self._measuring(entry).of_stars
        return plan.steps.attitude(entry, self.identities.find_hash(entry), stars, star_image=record.star_image)

    def _key(self, plan: _Plan, entry: ImageEntry, target: str, estimator: str, attitude: Attitude | None) -> str:
        sha256 = self.identities.find_hash(entry)
        decided = self._measuring(entry).of_fix(target, estimator) if estimator else []
        return plan.steps.observation(entry, sha256, target, estimator, attitude, decided) if sha256 else ""

    def _say_first(self, counts: dict[str, StepCount]) -> None:
        """Announce the pending work, where there was a run before; and count it."""
        self.counts.update(counts)
        if self.goes_on:
            words = [f"{name}: {count.redone} to do, {count.kept} kept" for name, count in counts.items()]
            self.announce("; ".join(words))


@dataclass(frozen=True, slots=True)
class _Plan:
    """Stored attitudes and bodies of a campaign: valid attitudes in ``solved``, those to be made in ``stale``."""

    steps: Steps
    keys: dict[tuple[str, str, str], str]
    rejected: frozenset[str]
    solved: dict[str, AttitudeRecord]
    stale: dict[str, AttitudeRecord]
    unsolved: list[ImageEntry]

    @classmethod
    def from_run(cls, run: RunExecutor) -> _Plan:
        campaign, folder = run.campaign, run.folder
        keys = folder.keys(ObservationRecord) | folder.keys(TargetRecord)
        plan = cls(Steps(run.bench), keys, frozenset(run.edits.rejected_images()), {}, {}, [])
        attitude_keys = folder.keys(AttitudeRecord)
        for entry in campaign.images:
            key = attitude_keys.get((entry.key, "", ""))
            record = None if not key else folder.load(AttitudeRecord, entry.key, light=True)
            if record is not None:
                record = record.replace(index=entry.index, path=campaign.path_from_output(entry.path))
                if (
                    run.identities.find_hash(entry)
                    and key == run._attitude_key(plan, entry, record)
                    and _as_used(campaign, record)
                ):
                    plan.solved[entry.key] = record
                    continue
                plan.stale[entry.key] = record
            run.identities.find_hash(entry)  # before the file is read: the next run then detects later changes
            plan.unsolved.append(entry)
        return plan


def _as_used(campaign: Campaign, record: AttitudeRecord) -> bool:
    """True if the campaign still makes the same use of an image of this exposure."""
    return (record.star_image, record.body_image) == (
        campaign.is_star_image(record.exposure_s),
        campaign.is_body_image(record.exposure_s),
    )


def _step_name(target: str, estimator: str) -> str:
    return f"{target}: {estimator}" if estimator else _TARGETS
