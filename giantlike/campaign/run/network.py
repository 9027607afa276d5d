"""Step ``network`` of a run: landmarks of a shape in all images, and their adjustment."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from giantlike._system.atomic import make_folder, write_text_atomic
from giantlike.calibration.options import Treatment
from giantlike.camera import Camera
from giantlike.campaign.file.config import Campaign, NetworkSetup
from giantlike.campaign.run.attitude_transfer import attitude_to_use
from giantlike.campaign.run.bodies import with_attitude_used
from giantlike.campaign.run.border import attempt
from giantlike.campaign.run.image_loading import scene_of, targets_in
from giantlike.campaign.run.pool import Pool
from giantlike.campaign.run.steps import Steps, digest
from giantlike.campaign.run.worker import ImageJob, open_image_of_job
from giantlike.campaign.run.worker_context import NETWORK_SHAPE, Workbench
from giantlike.campaign.store.packing import PackedRecord
from giantlike.campaign.store.records import AttitudeRecord, NetworkRecord, Problem
from giantlike.campaign.store.results import StepCount
from giantlike.campaign.store.run_folder import NETWORK_FILE
from giantlike.core.frames import quaternion_xyzw, rotation_from_xyzw
from giantlike.core.outcomes import Failure, Reason
from giantlike.io.spice import body_id, rotation_coefficients
from giantlike.network import (
    FoundTracks,
    LandmarkMeasures,
    NetworkFix,
    NetworkOptions,
    Photo,
    Rotating,
    TrackOptions,
    adjust,
    photo_of,
    write_network,
)
from giantlike.network.landmarks import adjust_tracks, catalog_of, has_moved, measure_landmarks
from giantlike.scene import Scene
from giantlike.shapes.landmarks import LandmarkCatalog

if TYPE_CHECKING:
    from giantlike.campaign.run.making import RunExecutor

_PASSES = 3  # at the a priori pose, at the adjusted one, and once more where that changed again
_SAME_ORIENTATION_RAD = 1e-6  # of the formulas of a PCK and of its kernels: rounding of epochs
OPTIONS = TrackOptions()


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkJob:
    """Landmarks of an image: at the a priori pose, or at an adjusted one."""

    image: ImageJob
    pose: Photo | None = None


def find_landmarks(bench: Workbench, job: NetworkJob) -> PackedRecord[NetworkRecord]:
    """Find the landmarks of the network in an image."""
    found = attempt(_find, bench, job)
    return PackedRecord.from_record(
        _make_failed_record(bench.campaign, job, found) if isinstance(found, Problem) else found
    )


def _make_failed_record(campaign: Campaign, job: NetworkJob, problem: Problem) -> NetworkRecord:
    assert campaign.network is not None
    entry = job.image.entry
    return NetworkRecord(index=entry.index, file=entry.key, target=campaign.network.target.name, problem=problem)


def _find(bench: Workbench, job: NetworkJob) -> NetworkRecord | Problem:
    opened = open_image_of_job(bench, job.image)
    if isinstance(opened, Problem):
        return opened
    (fitted, prepared), setup = opened, bench.campaign.network
    assert setup is not None
    image, camera = with_attitude_used(prepared.image, job.image.attitude), fitted.campaign.camera
    scene = scene_of(fitted.campaign, image, setup.target, fitted.shapes[NETWORK_SHAPE])
    photo = photo_of(image, camera, scene) if isinstance(scene, Scene) else scene
    if isinstance(photo, Failure) or isinstance(scene, Failure):
        return Problem.from_failure(photo if isinstance(photo, Failure) else scene)  # type: ignore[arg-type]
    found = measure_landmarks(image, camera, scene, pose=job.pose, options=OPTIONS)
    if isinstance(found, Failure):
        return Problem.from_failure(found)
    blocks = [np.asarray(photo.covariance_pose)[part, part] for part in (slice(0, 3), slice(3, 6))]
    attitude, position = (block.tolist() if np.isfinite(block).all() else None for block in blocks)
    entry = job.image.entry
    return NetworkRecord(
        index=entry.index,
        file=entry.key,
        target=setup.target.name,
        pose=_numbers(photo),
        rendered=_numbers(found.rendered),
        camera=list(photo.model.parameters),
        covariance_attitude_rad2=attitude,
        covariance_position_km2=position,
        numbers=found.numbers.tolist(),
        points_px=found.points_px.tolist(),
        covariance_px2=found.covariance_px2.reshape(-1, 4).tolist(),
        scores=found.scores.tolist(),
    )


def _numbers(photo: Photo) -> list[float]:
    turns = [quaternion_xyzw(each).tolist() for each in (photo.camera_from_inertial, photo.inertial_from_body)]
    return [*turns[0], *photo.position_km.tolist(), *turns[1], photo.et, *np.asarray(photo.sun_direction).tolist()]


def _photo(record: NetworkRecord, numbers: Sequence[float], camera: Camera) -> Photo:
    covariance = np.diag([np.inf] * 6)
    for part, block in ((slice(0, 3), record.covariance_attitude_rad2), (slice(3, 6), record.covariance_position_km2)):
        if block is not None:
            covariance[part, part] = block
    return Photo(
        name=record.file,
        model=camera.model.with_parameters(np.array(record.camera)),
        camera_from_inertial=rotation_from_xyzw(numbers[:4], "pose"),
        position_km=np.array(numbers[4:7]),
        covariance_pose=covariance,
        inertial_from_body=rotation_from_xyzw(numbers[7:11], "pose"),
        et=numbers[11],
        columns=camera.columns,
        rows=camera.rows,
        sun_direction=np.array(numbers[12:15]),
    )


def _measures(record: NetworkRecord, camera: Camera) -> LandmarkMeasures:
    return LandmarkMeasures(
        numbers=np.array(record.numbers),
        points_px=np.array(record.points_px),
        covariance_px2=np.array(record.covariance_px2).reshape(-1, 2, 2),
        scores=np.array(record.scores),
        rendered=_photo(record, record.rendered, camera),
    )


def make_network(run: RunExecutor, pool: Pool, attitudes: Sequence[AttitudeRecord]) -> dict[str, Any] | None:
    """Find landmarks where they are not known, adjust them, and write the folder ``network``; returns the summary."""
    setup, path = run.campaign.network, run.folder.path / NETWORK_FILE
    if setup is None:
        path.unlink(missing_ok=True)
        return None
    jobs = _jobs(run, setup, attitudes)
    catalog, camera = catalog_of(setup.target.name, run.bench.shapes[NETWORK_SHAPE]), run.campaign.camera
    keys = {file: key for (file, *_), key in run.folder.keys(NetworkRecord).items()}
    todo = {file: job for file, (job, key) in jobs.items() if not key or keys.get(file) != key}
    count = StepCount(redone=len(todo), kept=len(jobs) - len(todo))
    adjusted: tuple[FoundTracks, NetworkFix] | Failure = Failure(Reason.TOO_FEW_MATCHES, "no image has landmarks")
    failures = dict[str, str]()
    for _ in range(_PASSES):
        run.progress("finding landmarks", 0, len(todo))
        names = list(todo)
        for done, (position, answer) in enumerate(pool.run(find_landmarks, list(todo.values())), start=1):
            job = todo[names[position]]
            lost = Problem(reason=Reason.INTERNAL_ERROR, detail="the worker process died on this image")
            run.folder.save(answer or _make_failed_record(run.campaign, job, lost), jobs[names[position]][1])
            run.progress("finding landmarks", done, len(todo))
        records = [record for file in jobs if (record := run.folder.load(NetworkRecord, file)) is not None]
        failures = {one.file: one.problem.detail for one in records if one.problem is not None}
        good = [record for record in records if record.problem is None]
        if isinstance(catalog, Failure) or len(good) < 2:
            detail = catalog.detail if isinstance(catalog, Failure) else f"landmarks are found in {len(good)} images"
            adjusted = Failure(Reason.TOO_FEW_MATCHES, f"{detail}, needed 2" if good else detail)
            break
        measures = [_measures(record, camera) for record in good]
        adjusted = adjust_tracks([_photo(record, record.pose, camera) for record in good], measures, catalog, OPTIONS)
        if isinstance(adjusted, Failure):
            break
        todo = {
            record.file: replace(jobs[record.file][0], pose=pose)
            for record, one, pose in zip(good, measures, adjusted[1].photos, strict=True)
            if has_moved(one, pose, catalog)
        }
        if not todo:
            break
    run.counts["network"] = count
    return _finish(run, setup, None if isinstance(catalog, Failure) else catalog, adjusted, failures)


def _jobs(
    run: RunExecutor, setup: NetworkSetup, attitudes: Sequence[AttitudeRecord]
) -> dict[str, tuple[NetworkJob, str]]:
    """Job and key of each image that may show the target."""
    steps, entries, name = Steps(run.bench), {entry.key: entry for entry in run.campaign.images}, setup.target.name
    shape, found = run.bench.shapes[NETWORK_SHAPE].sha256, dict[str, tuple[NetworkJob, str]]()
    for record in attitudes:
        entry, attitude = entries[record.file], attitude_to_use(run.campaign, record)
        shows = name in (one.name for one in targets_in(run.campaign, entry.key))
        if attitude is None or not shows or not record.readable or not record.body_image:
            continue
        job = replace(run.job(entry, solve=False), attitude=attitude)
        sha256 = run.identities.find_hash(entry)
        decided = sorted(job.measuring.areas.get(("", ""), ()), key=repr)
        key = digest(steps.observation(entry, sha256, name, "", attitude, [*decided]), shape, OPTIONS) if sha256 else ""
        found[entry.key] = NetworkJob(image=job), key
    return found


def _finish(
    run: RunExecutor,
    setup: NetworkSetup,
    catalog: LandmarkCatalog | None,
    adjusted: tuple[FoundTracks, NetworkFix] | Failure,
    failures: dict[str, str],
) -> dict[str, Any]:
    """Adjust with the options of the section, and write the results."""
    path, section = run.folder.path / NETWORK_FILE, setup.section
    fix: NetworkFix | Failure
    more: dict[str, Any] = {"target": setup.target.name, "without_landmarks": failures}
    if isinstance(adjusted, Failure):
        fix = adjusted
    else:
        tracks, uncertain = adjusted[0], run.campaign.camera.uncertainty
        body = _rotation(run.campaign, setup, tracks.photos)
        sigmas = {} if uncertain is None else {
            name: float(np.sqrt(uncertain.covariance[k, k]))
            for k, name in enumerate(uncertain.estimated) if uncertain.covariance[k, k] > 0.0
        }  # fmt: skip
        one_camera = len({tuple(photo.model.parameters) for photo in tracks.photos}) == 1
        turns = Treatment.FIXED if body is None or not section.sigma_pole_deg else Treatment.ESTIMATE
        rates = Treatment.FIXED if body is None or not section.sigma_rate else Treatment.ESTIMATE
        more |= {
            "floor_px": tracks.floor_px,
            "sigma_points_km": tracks.sigma_points_km,
            "rotation": "as declared" if body is None else "by the coefficients of the planetary constants kernel",
        }
        fix = adjust(
            tracks.photos,
            tracks.tracks,
            body=body,
            options=NetworkOptions(
                poses=section.pose,
                pole=turns,
                w=turns,
                rate=rates,
                size=Treatment.ESTIMATE if section.sigma_size else Treatment.FIXED,
                camera=section.camera if sigmas and one_camera else Treatment.FIXED,
                sigma_pole_deg=section.sigma_pole_deg or 1.0,
                sigma_w_deg=section.sigma_pole_deg or 1.0,
                sigma_rate=section.sigma_rate or 1.0,
                sigma_size=section.sigma_size or 1.0,
                sigma_camera=sigmas,
                loss=section.loss,
            ),
        )
    if isinstance(fix, NetworkFix):
        write_network(path.parent, fix, more, naif_id=body_id(setup.target.spice_body), catalog=catalog)
    else:
        make_folder(path.parent)
        failed = {"status": "failed", "reason": str(fix.reason), "detail": fix.detail, **more}
        write_text_atomic(path, json.dumps(failed, indent=1) + "\n")
    run.folder.log("network", status="ok" if isinstance(fix, NetworkFix) else "failed")
    return dict(json.loads(path.read_text(encoding="utf-8")))


def _rotation(campaign: Campaign, setup: NetworkSetup, photos: Sequence[Photo]) -> Rotating | None:
    """Rotation of the target by a planetary constants kernel; None where that is not its orientation in the images."""
    found = None if campaign.spice is None else rotation_coefficients(setup.target.spice_body)
    if found is None:
        return None
    body = Rotating(pole_ra_deg=found[0], pole_dec_deg=found[1], pm_deg=found[2])
    off = max((body.inertial_from_body(one.et).inv() * one.inertial_from_body).magnitude() for one in photos)
    return body if off < _SAME_ORIENTATION_RAD and body.pm_deg[1] else None
