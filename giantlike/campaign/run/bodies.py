"""Estimators of bodies on one image, and the outlines for its picture in the report."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import TypeAlias

import numpy as np

from giantlike._system.threads import at_once
from giantlike.camera import Camera
from giantlike.camera_models import ifov_rad
from giantlike.campaign.file.config import Campaign, ImageEntry
from giantlike.campaign.run.border import attempt
from giantlike.campaign.run.image_loading import mask_areas, scene_of, targets_in
from giantlike.campaign.run.observables import sighting_of, with_fix, with_prediction
from giantlike.campaign.run.worker_context import Workbench
from giantlike.campaign.store.edits import Measuring, Start
from giantlike.campaign.store.records import Attitude, ObservationRecord, Problem, TargetRecord, TargetView
from giantlike.core.arrays import unit
from giantlike.core.frames import rotate
from giantlike.core.outcomes import CenterFix, Failure, Outcome, Reason
from giantlike.core.time import utc_text
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import AttitudeSource, Image
from giantlike.ray_tracing.silhouette import lit_outline
from giantlike.relative import Estimator, SurfaceFeatures
from giantlike.relative.place import apparent_radius_px
from giantlike.scene import Scene, TargetGeometry

_OUTLINE_ANGLES = 120  # points of a predicted outline in an overlay, a polygon; no result rests on it
_OUTLINE_MIN_RADIUS_PX = 2.0  # radius below which an overlay shows a cross alone, which would hide an outline

_SEARCHES = 3.0  # multiple of ``search_px``: estimators of limbs widen their search to this where they find none
_SURE = 3.0  # number of standard deviations of the prediction beyond which a body is not expected

Work: TypeAlias = tuple[str, str]  # target and estimator; an empty estimator denotes the a priori record of the target
BodyRecord: TypeAlias = ObservationRecord | TargetRecord


def work_in(campaign: Campaign, key: str) -> list[Work]:
    """Everything that is to be made of the bodies in an image, in the order of the tables."""
    return [
        (target.name, name)
        for target in targets_in(campaign, key)
        for name in [*(estimator.name for estimator in target.estimators), ""]
    ]


def estimate_bodies(
    bench: Workbench,
    entry: ImageEntry,
    image: Image,
    attitude: Attitude | None,
    work: Iterable[Work],
    measuring: Measuring,
) -> list[BodyRecord]:
    """Run estimators on targets of an image."""
    campaign, wanted, image = bench.campaign, set(work), with_attitude_used(image, attitude)
    epoch_utc = None if image.epoch is None else utc_text(image.epoch)
    records: list[BodyRecord] = []
    for target in targets_in(campaign, entry.key):
        todo = [estimator for estimator in target.estimators if (target.name, estimator.name) in wanted]
        if not todo and (target.name, "") not in wanted:
            continue
        scene = attempt(scene_of, campaign, image, target, bench.shapes[target.name])
        geometry = attempt(scene.geometry, image) if isinstance(scene, Scene) else scene
        jobs = dict[str, Callable[[], ObservationRecord]]()
        for estimator in todo:
            record = make_pending_record(entry, epoch_utc, target.name, estimator.name).replace(attitude=attitude)
            if isinstance(scene, Scene) and isinstance(geometry, TargetGeometry):
                record = with_prediction(record, campaign.camera, geometry)
                jobs[estimator.name] = partial(
                    _run_estimator, record, estimator, image, campaign.camera, scene, measuring
                )
            else:
                problem = Problem.from_failure(geometry) if isinstance(geometry, Failure) else geometry
                jobs[estimator.name] = partial(record.replace, problem=problem)
        with at_once(jobs) as made:
            records.extend(map(made, jobs))
        if (target.name, "") in wanted:
            known = TargetRecord(index=entry.index, file=entry.key, target=target.name)
            if isinstance(scene, Scene) and isinstance(geometry, TargetGeometry):
                known = known.replace(sighting=sighting_of(scene, image, geometry))
                known = _add_outline(known, campaign, geometry) if campaign.max_overlays > 0 else known
            records.append(known)
    return records


def with_attitude_used(image: Image, attitude: Attitude | None) -> Image:
    """Image with the attitude of its record, where there is one."""
    if attitude is None:
        return image
    return image.with_attitude(
        attitude.rotation,
        source=AttitudeSource(attitude.source),
        covariance_rad2=attitude.covariance_rad2,
        errors=attitude.errors,
    )


def failed_bodies(
    entry: ImageEntry, work: Iterable[Work], problem: Problem, *, epoch_utc: str | None = None
) -> list[BodyRecord]:
    """Failed records of an image that could not be worked on."""
    return [
        make_pending_record(entry, epoch_utc, target, estimator).replace(problem=problem)
        for target, estimator in work
        if estimator
    ]


def make_pending_record(entry: ImageEntry, epoch_utc: str | None, target: str, estimator: str) -> ObservationRecord:
    """Record of an estimator that has not run yet."""
    return ObservationRecord(
        index=entry.index, file=entry.key, epoch_utc=epoch_utc, target=target, estimator=estimator, status="failed"
    )


def _add_outline(record: TargetRecord, campaign: Campaign, geometry: TargetGeometry) -> TargetRecord:
    """Record with the outline of the target."""
    view = attempt(_view, campaign, geometry)
    if isinstance(view, Problem):
        return record.replace(note=f"no outline of {record.target}: {view.detail}")
    return record.replace(view=view)


def _run_estimator(
    record: ObservationRecord, estimator: Estimator, image: Image, camera: Camera, scene: Scene, measuring: Measuring
) -> ObservationRecord:
    """Record, which has the prediction, with the result of one estimator."""
    began, of = time.perf_counter(), record.subject
    geometry = scene.geometry(image, record.target)
    assert isinstance(geometry, TargetGeometry)
    start, by_hand = measuring.starts.get(record.target), measuring.provenance(*of)
    if start is not None:
        scene, geometry = move_target(scene, geometry, image, camera, start)
    image = mask_areas(image, measuring.areas.get(of, ()))
    if of in measuring.landmarks and isinstance(estimator, SurfaceFeatures):
        estimator = estimator.exclude(measuring.landmarks[of])
    outcome = attempt(estimator.estimate, image, camera, scene, record.target)
    done = attempt(with_fix, record, camera, geometry, outcome) if isinstance(outcome, CenterFix) else outcome
    if not isinstance(done, ObservationRecord):
        problem = Problem.from_failure(done) if isinstance(done, Failure) else done
        if problem.outcome is Outcome.FAILED and problem.reason is not Reason.INTERNAL_ERROR:
            problem = _out_of_field(record, estimator, image, camera, geometry) or problem
        done = record.replace(problem=problem)
    changes: dict[str, object] = {"time_s": time.perf_counter() - began}
    if by_hand:
        changes |= {"provenance": done.provenance | by_hand, "predicted_px": record.predicted_px}
    return done.model_copy(update=changes)  # all else is checked already


def move_target(
    scene: Scene, geometry: TargetGeometry, image: Image, camera: Camera, start: Start
) -> tuple[Scene, TargetGeometry]:
    """Scene with a target at a start, at the predicted range, and its geometry; sigma at least as declared."""
    assert image.camera_from_inertial is not None
    inertial_from_camera, target = image.camera_from_inertial.inv(), geometry.target
    position_camera_km = geometry.range_km * unit(camera.model.unproject(np.array(start.center_px)))
    sigma_km, known = start.sigma_px * ifov_rad(camera.model, camera.center_px) * geometry.range_km, target.uncertainty
    if known.ephemeris_km > 0.0:
        known = replace(known, ephemeris_km=max(known.ephemeris_km, float(sigma_km)))
    moved = ApparentGeometry(
        position_inertial_km=rotate(inertial_from_camera, position_camera_km),
        inertial_from_body=inertial_from_camera * geometry.camera_from_body,
        sun_direction_inertial=rotate(inertial_from_camera, geometry.sun_direction_camera),
    )
    target = replace(target, ephemeris=moved, uncertainty=known)
    return (
        replace(scene, targets=tuple(target if one.name == target.name else one for one in scene.targets)),
        replace(geometry, target=target, position_camera_km=position_camera_km),
    )


def _out_of_field(
    record: ObservationRecord, estimator: Estimator, image: Image, camera: Camera, geometry: TargetGeometry
) -> Problem | None:
    """Problem of a target whose outline is predicted beyond the image by more than any search; None for another one."""
    pixel_rad = float(ifov_rad(camera.model, camera.center_px))
    attitude = image.attitude_covariance_rad2
    sigma_rad = 0.0 if attitude is None else float(np.sqrt(np.max(np.diag(attitude)[:2])))
    sigma_rad += geometry.target.uncertainty.ephemeris_km / geometry.range_km
    search_px = max(_SEARCHES * getattr(estimator.options, "search_px", 0.0), _SURE * sigma_rad / pixel_rad)
    apart_px = outside_px(camera, geometry, pixel_rad)
    if not apart_px > search_px:
        return None
    detail = f"the body is predicted {apart_px:.0f} px outside of the image, beyond the search of {search_px:.0f} px"
    detail = f"{record.file}: {record.target}: {record.estimator}: {detail}"
    return Problem(reason=Reason.OUT_OF_FRAME, detail=detail, kind=Outcome.NOT_IN_FIELD)


def outside_px(camera: Camera, geometry: TargetGeometry, pixel_rad: float) -> float:
    """Distance of the sphere around a body from the image, px (by its angle if not imaged); negative inside."""
    last_px = np.array([camera.columns - 1.0, camera.rows - 1.0])
    radius_km, center_px = (
        geometry.target.shape.circumscribing_radius_km,
        camera.model.project(geometry.position_camera_km),
    )
    if np.isfinite(center_px).all():
        beyond = np.maximum(np.maximum(-center_px, center_px - last_px), 0.0)
        return float(np.hypot(*beyond)) - apparent_radius_px(camera, center_px, radius_km, geometry.range_km)
    corners = camera.model.unproject(last_px * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]))
    middle = camera.model.unproject(camera.center_px)
    cosines = np.append(corners @ middle, unit(geometry.position_camera_km) @ middle)
    *field_rad, angle_rad = np.arccos(np.clip(cosines, -1.0, 1.0)).tolist()
    outside_rad: float = angle_rad - math.asin(min(radius_km / geometry.range_km, 1.0)) - max(field_rad)
    return outside_rad / pixel_rad


def _view(campaign: Campaign, geometry: TargetGeometry) -> TargetView | None:
    """Predicted outline of a target; None if its center cannot be imaged."""
    model = campaign.camera.model
    predicted_px = model.project(geometry.position_camera_km)
    if not np.isfinite(predicted_px).all():
        return None
    shape = geometry.target.shape
    radius_px, mean_radius_px = (
        apparent_radius_px(campaign.camera, predicted_px, radius_km, geometry.range_km)
        for radius_km in (shape.circumscribing_radius_km, shape.mean_radius_km)
    )
    outline, lit = np.zeros((0, 2)), np.zeros(0, dtype=bool)
    if radius_px >= _OUTLINE_MIN_RADIUS_PX:
        angles = np.linspace(0.0, 2 * np.pi, _OUTLINE_ANGLES, endpoint=False)
        outline, lit = lit_outline(geometry.body(), model, angles, sun_direction_camera=geometry.sun_direction_camera)
    return TargetView(
        target=geometry.target.name,
        predicted_px=predicted_px.tolist(),
        radius_px=radius_px,
        diameter_px=2.0 * mean_radius_px,
        outline_px=outline.tolist(),
        outline_lit=lit.tolist(),
    )
