"""Processing of one image by a worker process: stars first, then bodies, with the image opened once."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from giantlike.calibration import identify_first
from giantlike.camera import Camera
from giantlike.campaign.calibration.solve import NO_STAR_IMAGE, record_of_stars, temperature_of
from giantlike.campaign.file.config import Campaign, ImageEntry
from giantlike.campaign.run.attitude_transfer import attitude_to_use
from giantlike.campaign.run.bodies import BodyRecord, Work, estimate_bodies, failed_bodies
from giantlike.campaign.run.border import attempt, reading
from giantlike.campaign.run.image_loading import PreparedImage, mask_areas, open_image
from giantlike.campaign.run.observables import attitude_of, with_attitude, with_observer, with_stars
from giantlike.campaign.run.worker_context import Workbench
from giantlike.campaign.store.edits import Measuring
from giantlike.campaign.store.packing import PackedRecord
from giantlike.campaign.store.records import Attitude, AttitudeRecord, CalibrationRecord, Problem
from giantlike.core.frames import quaternion_xyzw
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.time import utc_text
from giantlike.image import AttitudeSource, Image
from giantlike.io.geometry_table import ImageGeometry
from giantlike.stars import StarNavigation


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageJob:
    """Work on one image."""

    entry: ImageEntry
    camera: Camera | None = None  # the calibrated camera; None: the camera of the campaign
    measuring: Measuring = field(default_factory=Measuring)  # decisions of users
    solve: bool = True  # the attitude is to be estimated; otherwise it is given
    attitude: Attitude | None = None  # for estimators: the one to use, or used by kept results
    bodies: tuple[Work, ...] = ()  # targets and estimators to run
    bodies_if_turned: tuple[Work, ...] = ()  # those to run only if the estimated attitude differs from ``attitude``


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageAnswer:
    """Results of an image."""

    attitude: PackedRecord[AttitudeRecord] | None  # None if it was not to be estimated
    bodies: list[PackedRecord[BodyRecord]] = field(default_factory=list)

    @classmethod
    def from_records(cls, attitude: AttitudeRecord | None, bodies: Iterable[BodyRecord]) -> ImageAnswer:
        """Answer of records."""
        packed = None if attitude is None else PackedRecord.from_record(attitude)
        return cls(attitude=packed, bodies=[PackedRecord.from_record(record) for record in bodies])


def process_image(bench: Workbench, job: ImageJob) -> ImageAnswer:
    """Read an image, solve its stars if requested, and run the estimators on it."""
    start = time.perf_counter()
    opened = attempt(open_image_of_job, bench, job)
    record, attitude, work = None, job.attitude, job.bodies
    if job.solve:
        solved = opened if isinstance(opened, Problem) else attempt(_solve_attitude, *opened, job.entry)
        record = failed_image(bench.campaign, job.entry, solved) if isinstance(solved, Problem) else solved
        record = record.model_copy(update={"time_s": time.perf_counter() - start})  # all else is checked already
        attitude = attitude_to_use(bench.campaign, record)
        if attitude != job.attitude or not record.readable:
            work += job.bodies_if_turned
    problem = opened if isinstance(opened, Problem) else None
    if record is not None and not record.readable:
        problem = record.problem
    if problem is not None or isinstance(opened, Problem) or not work:
        epoch_utc = None if record is None else record.epoch_utc
        failed = [] if problem is None else failed_bodies(job.entry, work, problem, epoch_utc=epoch_utc)
        return ImageAnswer.from_records(record, failed)
    fitted, prepared = opened
    bodies = attempt(estimate_bodies, fitted, job.entry, prepared.image, attitude, work, job.measuring)
    return ImageAnswer.from_records(
        record, failed_bodies(job.entry, work, bodies) if isinstance(bodies, Problem) else bodies
    )


def lost_image(campaign: Campaign, job: ImageJob, problem: Problem) -> ImageAnswer:
    """Answer for an image whose worker died."""
    record = failed_image(campaign, job.entry, problem) if job.solve else None
    work = (*job.bodies, *job.bodies_if_turned)
    return ImageAnswer.from_records(record, failed_bodies(job.entry, work, problem))


def find_first_stars(bench: Workbench, job: ImageJob) -> PackedRecord[CalibrationRecord]:
    """Read a star image and identify its stars with a camera that is known roughly, for calibration."""
    record = attempt(_first_stars, bench, job)
    return PackedRecord.from_record(failed_stars(job.entry, record) if isinstance(record, Problem) else record)


def failed_stars(entry: ImageEntry, problem: Problem) -> CalibrationRecord:
    """Record of an image that calibration cannot use."""
    return CalibrationRecord(index=entry.index, file=entry.key, problem=problem)


def _first_stars(bench: Workbench, job: ImageJob) -> CalibrationRecord | Problem:
    entry, bench = job.entry, bench.without_stars(job.measuring.rejected_stars)
    campaign, setup = bench.campaign, bench.campaign.calibration
    assert setup is not None
    assert bench.navigation is not None
    prepared = reading(open_image, campaign, entry, bench.frames)
    if isinstance(prepared, Problem):
        return prepared
    image = _without_areas(prepared, job).image
    read = CalibrationRecord(index=entry.index, file=entry.key, sha256=image.sha256)
    if not campaign.is_star_image(image.exposure_s):
        return read.replace(problem=Problem(reason=Reason.NO_SIGNAL, detail=NO_STAR_IMAGE))
    temperature_c = reading(temperature_of, image, setup.temperature_keyword)
    if isinstance(temperature_c, Problem):
        return temperature_c
    found = identify_first(
        image, campaign.camera, bench.navigation, scale_error=setup.scale_error, temperature_c=temperature_c
    )
    if isinstance(found, Failure):
        return read.replace(problem=Problem.from_failure(found))
    return record_of_stars(entry, found, image.camera_from_inertial).replace(sha256=image.sha256)


def failed_image(campaign: Campaign, entry: ImageEntry, problem: Problem) -> AttitudeRecord:
    """Record of an image that could not be processed."""
    return _make_unsolved_record(campaign, entry, campaign.geometry.get(entry.key)).replace(problem=problem)


def _make_unsolved_record(campaign: Campaign, entry: ImageEntry, known: Image | ImageGeometry | None) -> AttitudeRecord:
    """Record of an image before its attitude, with the known data of its exposure."""
    epoch, exposure_s = (None, None) if known is None else (known.epoch, known.exposure_s)
    return AttitudeRecord(
        index=entry.index,
        file=entry.key,
        path=campaign.path_from_output(entry.path),
        epoch_utc=None if epoch is None else utc_text(epoch),
        exposure_s=exposure_s,
        star_image=campaign.is_star_image(exposure_s),
        body_image=campaign.is_body_image(exposure_s),
        status="failed",
    )


def open_image_of_job(bench: Workbench, job: ImageJob) -> tuple[Workbench, PreparedImage] | Problem:
    """Image, and the workbench for it: with the calibrated camera, at its temperature, without rejected stars."""
    if job.camera is not None:
        bench = bench.with_camera(job.camera)
    prepared = reading(open_image, bench.campaign, job.entry, bench.frames)
    if isinstance(prepared, Problem):
        return prepared
    prepared = _without_areas(prepared, job)
    fitted = reading(bench.for_image, prepared.image)
    return fitted if isinstance(fitted, Problem) else (fitted.without_stars(job.measuring.rejected_stars), prepared)


def _without_areas(prepared: PreparedImage, job: ImageJob) -> PreparedImage:
    """The image without the areas that users masked for all estimators."""
    return replace(prepared, image=mask_areas(prepared.image, job.measuring.areas.get(("", ""), ())))


def _solve_attitude(bench: Workbench, prepared: PreparedImage, entry: ImageEntry) -> AttitudeRecord:
    campaign, image = bench.campaign, prepared.image
    apriori, spice = image.camera_from_inertial, campaign.spice
    rate = None if spice is None or image.et is None else spice.camera_rate_rad_s(image.et)
    record = with_observer(_make_unsolved_record(campaign, entry, image), image.observer).replace(
        sha256=image.sha256,
        columns=image.columns,
        rows=image.rows,
        et=image.et,
        rate_rad_s=None if rate is None else rate.tolist(),
        apriori_xyzw=None if apriori is None else quaternion_xyzw(apriori).tolist(),
        notes=_notes(campaign, prepared),
    )
    if bench.navigation is not None and record.star_image:
        return _from_stars(record, bench.navigation, image)
    if apriori is not None:
        attitude = attitude_of(apriori, AttitudeSource.A_PRIORI, campaign.apriori_covariance_rad2(entry.key))
        return with_attitude(record, campaign.camera, attitude)
    missing = Problem(reason=Reason.NO_ATTITUDE, detail=f"{entry.key}: no attitude in table, header or SPICE")
    return record.replace(problem=missing)


def _notes(campaign: Campaign, prepared: PreparedImage) -> list[str]:
    notes = list(prepared.notes)
    stars = campaign.stars
    if stars is not None and stars.long_exposure_s is not None and prepared.image.exposure_s is None:
        notes.append("exposure time unknown: taken as a short exposure")
    return notes


def _from_stars(record: AttitudeRecord, navigation: StarNavigation, image: Image) -> AttitudeRecord:
    """Record with the results from the stars of an image."""
    detections, fix = navigation.detect_and_solve(image)
    if isinstance(detections, Failure):
        return record.replace(problem=Problem.from_failure(detections))
    detected_px = detections.points_px.tolist()
    if isinstance(fix, Failure):
        n_detected = int(detections.clean.sum())
        return record.replace(problem=Problem.from_failure(fix), detected_px=detected_px, n_detected=n_detected)
    notes, zero_point = [*record.notes, *fix.notes], None
    if image.exposure_s:
        detector = image.detector or navigation.camera.detector
        signal_e = detections.flux_dn[fix.detection_indices] * detector.gain_e_per_dn * 10.0 ** (0.4 * fix.magnitudes)
        zero_point = float(np.median(signal_e)) / image.exposure_s
    record = record.replace(notes=notes, star_zero_point_e_s=zero_point)
    return with_stars(record, navigation.camera, fix, detected_px)
