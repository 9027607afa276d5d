"""The work on one image, as a worker process does it: stars first, bodies later.

Whatever goes wrong with an image ends in its record; nothing that an image holds can end a run.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ParamSpec, TypeVar

import numpy as np

from giantlike.calibration import identify_first
from giantlike.camera import Camera
from giantlike.campaign.calibration.solve import NO_STAR_IMAGE, record_of_stars, temperature_of
from giantlike.campaign.file.config import Campaign, ImageEntry
from giantlike.campaign.file.inputs import TargetSetup
from giantlike.campaign.run.image_loading import PreparedImage, open_image, scene_of, targets_in
from giantlike.campaign.store.observables import (
    attitude_fields,
    attitude_value,
    fix_fields,
    predicted_fields,
    rotation_of,
    rows,
    status_of,
)
from giantlike.campaign.store.records import (
    Attitude,
    AttitudeRecord,
    CalibrationRecord,
    ObservationRecord,
    ObservationsRecord,
    Problem,
    StarMatches,
    TargetView,
)
from giantlike.catalogs import load_catalog
from giantlike.core.errors import OpNavError
from giantlike.core.frames import quaternion_xyzw
from giantlike.core.outcomes import CenterFix, Failure, Reason
from giantlike.core.time import utc_text
from giantlike.core.values import Value
from giantlike.image import AttitudeSource, Image
from giantlike.io.spice import CoverageError, SpiceKernels, load_kernels
from giantlike.ray_tracing import trace_silhouette
from giantlike.relative import Estimator
from giantlike.relative.estimator import apparent_radius_px
from giantlike.scene import Scene, TargetGeometry
from giantlike.shapes import Shape
from giantlike.stars import StarNavigation

Answer = TypeVar("Answer")
Arguments = ParamSpec("Arguments")

_OUTLINE_ANGLES = 120
_OUTLINE_MIN_RADIUS_PX = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Workbench(Value):
    """What every image of a campaign needs: loaded once per process.

    Parameters
    ----------
    campaign : Campaign
    navigation : StarNavigation or None
    shapes : dict of str to Shape
        By target name.
    kernels : SpiceKernels or None
        Those that were loaded.
    """

    campaign: Campaign
    navigation: StarNavigation | None
    shapes: dict[str, Shape]
    kernels: SpiceKernels | None

    @classmethod
    def load(cls, campaign: Campaign) -> Workbench:
        """Load catalog, shapes and kernels.

        Raises
        ------
        DataError
            One of the files is damaged.
        """
        navigation = None
        if campaign.stars is not None:
            navigation = StarNavigation(
                campaign.camera,
                load_catalog(campaign.stars.catalog),
                campaign.stars.options,
                detection=campaign.stars.detection,
            )
        shapes = {target.name: target.load_shape() for target in campaign.targets}
        kernels = None if campaign.spice is None else load_kernels(campaign.spice.kernels, ".")
        return cls(campaign, navigation, shapes, kernels)

    def with_camera(self, camera: Camera) -> Workbench:
        """Return the workbench for a calibrated camera: only attitudes are left to find, anywhere on the sky.

        They rest on stars as bright as those of the calibration, so that residuals of the two compare.
        """
        stars, navigation, setup = self.campaign.stars, self.navigation, self.campaign.calibration
        if stars is not None and navigation is not None:
            least = max(stars.options.min_snr, 0.0 if setup is None else setup.min_snr)
            options = replace(stars.options, lost_in_space=True, estimate_scale=False, min_snr=least)
            stars = replace(stars, options=options)
            navigation = StarNavigation(camera, navigation.catalog, stars.options, detection=stars.detection)
        return replace(self, campaign=replace(self.campaign, camera=camera, stars=stars), navigation=navigation)

    def with_warning(self, text: str) -> Workbench:
        """Return the workbench for a campaign with one more warning."""
        return replace(self, campaign=replace(self.campaign, warnings=(*self.campaign.warnings, text)))

    def for_image(self, image: Image) -> Workbench:
        """Return the workbench with the camera as it is at the temperature of an image."""
        setup = self.campaign.calibration
        if setup is None or setup.temperature_keyword is None or self.campaign.camera.uncertainty is None:
            return self
        camera = self.campaign.camera
        model = camera.model.at_temperature(temperature_of(image, setup.temperature_keyword))
        return self.with_camera(replace(camera, model=model))

    def close(self) -> None:
        """Take the kernels out of SPICE's pool."""
        if self.kernels is not None:
            self.kernels.unload()


@dataclass(frozen=True, slots=True)
class BodyJob:
    """An image on which estimators are to run, and the attitude to use (None: there is none)."""

    entry: ImageEntry
    attitude: Attitude | None


def solve_image(bench: Workbench, entry: ImageEntry) -> AttitudeRecord:
    """Read an image and, where it is a star image, solve its stars."""
    start = time.perf_counter()
    record = _attempt(_solved, bench, entry, start)
    if isinstance(record, Problem):
        return failed_image(bench.campaign, entry, record, time.perf_counter() - start)
    return record


def find_first_stars(bench: Workbench, entry: ImageEntry) -> CalibrationRecord:
    """Read a star image and identify its stars with a camera that is known roughly, for calibration."""
    record = _attempt(_first_stars, bench, entry)
    if isinstance(record, Problem):
        return CalibrationRecord(index=entry.index, file=entry.key, problem=record)
    return record


def _first_stars(bench: Workbench, entry: ImageEntry) -> CalibrationRecord | Problem:
    campaign, setup = bench.campaign, bench.campaign.calibration
    assert setup is not None
    assert bench.navigation is not None
    try:
        image = open_image(campaign, entry).image
    except OpNavError as error:
        return Problem(reason=Reason.UNREADABLE_IMAGE, detail=str(error))
    if not campaign.is_star_image(image.exposure_s):
        return Problem(reason=Reason.NO_SIGNAL, detail=NO_STAR_IMAGE)
    try:
        temperature_c = temperature_of(image, setup.temperature_keyword)
    except OpNavError as error:
        return Problem(reason=Reason.UNREADABLE_IMAGE, detail=str(error))
    found = identify_first(
        image, campaign.camera, bench.navigation, scale_error=setup.scale_error, temperature_c=temperature_c
    )
    if isinstance(found, Failure):
        return Problem(reason=found.reason, detail=found.detail)
    return record_of_stars(entry, found, image.camera_from_inertial)


def failed_image(campaign: Campaign, entry: ImageEntry, problem: Problem, time_s: float = 0.0) -> AttitudeRecord:
    """Record of an image that nothing could be done with."""
    known = campaign.geometry.get(entry.key)
    exposure_s = None if known is None else known.exposure_s
    return AttitudeRecord(
        index=entry.index,
        file=entry.key,
        path=campaign.path_from_output(entry.path),
        epoch_utc=None if known is None or known.epoch is None else utc_text(known.epoch),
        exposure_s=exposure_s,
        star_image=campaign.is_star_image(exposure_s),
        body_image=campaign.is_body_image(exposure_s),
        status="failed",
        problem=problem,
        time_s=time_s,
    )


def _solved(bench: Workbench, entry: ImageEntry, start: float) -> AttitudeRecord | Problem:
    campaign = bench.campaign
    try:
        prepared = open_image(campaign, entry)
        bench = bench.for_image(prepared.image)
    except OpNavError as error:
        return Problem(reason=Reason.UNREADABLE_IMAGE, detail=str(error))
    campaign, image = bench.campaign, prepared.image
    apriori = image.camera_from_inertial
    values: dict[str, Any] = {
        "index": entry.index,
        "file": entry.key,
        "path": campaign.path_from_output(entry.path),
        "sha256": image.sha256,
        "columns": image.columns,
        "rows": image.rows,
        "epoch_utc": None if image.epoch is None else utc_text(image.epoch),
        "et": image.et,
        "exposure_s": image.exposure_s,
        "star_image": campaign.is_star_image(image.exposure_s),
        "body_image": campaign.is_body_image(image.exposure_s),
        "apriori_xyzw": None if apriori is None else quaternion_xyzw(apriori).tolist(),
        "notes": _notes(campaign, prepared),
    }
    if bench.navigation is not None and values["star_image"]:
        values |= _star_fields(bench.navigation, image)
    elif apriori is not None:
        values |= attitude_fields(campaign.camera, attitude_value(apriori, AttitudeSource.A_PRIORI))
    else:
        values |= {
            "status": "failed",
            "problem": Problem(reason=Reason.NO_ATTITUDE, detail=f"{entry.key}: no attitude in table, header or SPICE"),
        }
    return AttitudeRecord(**values, time_s=time.perf_counter() - start)


def _notes(campaign: Campaign, prepared: PreparedImage) -> list[str]:
    notes = list(prepared.notes)
    stars = campaign.stars
    if stars is not None and stars.long_exposure_s is not None and prepared.image.exposure_s is None:
        notes.append("exposure time unknown: taken as a short exposure")
    return notes


def _star_fields(navigation: StarNavigation, image: Image) -> dict[str, Any]:
    """Fields of a record that the stars of an image give."""
    detections = navigation.detect(image)
    if isinstance(detections, Failure):
        return {"status": "failed", "problem": Problem(reason=detections.reason, detail=detections.detail)}
    fields: dict[str, Any] = {"detected_px": rows(detections.points_px), "n_detected": int(detections.clean.sum())}
    fix = navigation.solve_detections(image, detections)
    if isinstance(fix, Failure):
        return fields | {"status": "failed", "problem": Problem(reason=fix.reason, detail=fix.detail)}
    attitude = attitude_value(fix.camera_from_inertial, AttitudeSource.STARS, fix.covariance_rad2)
    fields |= attitude_fields(navigation.camera, attitude) | {
        "status": status_of(fix.flags),
        "n_detected": fix.n_detected,
        "n_matched": fix.n_used,
        "n_rejected": fix.n_rejected,
        "rms_px": fix.rms_px,
        "false_match_probability": fix.false_match_probability,
        "fov_deg": fix.fov_deg,
        "flags": list(fix.flags.names()),
        "provenance": dict(fix.provenance),
        "stars": StarMatches(
            star_ids=fix.star_ids.tolist(),
            observed_px=rows(fix.observed_px),
            predicted_px=rows(fix.predicted_px),
            sigma_px=fix.sigma_px.tolist(),
            magnitudes=fix.magnitudes.tolist(),
            rejected_px=rows(fix.rejected_px),
        ),
    }
    return fields


def estimate_image(bench: Workbench, job: BodyJob) -> ObservationsRecord:
    """Run every estimator on every target of an image."""
    record = _attempt(_estimated, bench, job)
    return failed_observations(bench.campaign, job.entry, record) if isinstance(record, Problem) else record


def failed_observations(
    campaign: Campaign, entry: ImageEntry, problem: Problem, *, epoch_utc: str | None = None
) -> ObservationsRecord:
    """Failed rows for every estimator that would have run on an image."""
    return ObservationsRecord(
        index=entry.index,
        file=entry.key,
        observations=[
            ObservationRecord(
                index=entry.index,
                file=entry.key,
                epoch_utc=epoch_utc,
                target=target.name,
                estimator=estimator.name,
                status="failed",
                problem=problem,
                time_s=0.0,
            )
            for target in targets_in(campaign, entry.key)
            for estimator in target.estimators
        ],
    )


def _estimated(bench: Workbench, job: BodyJob) -> ObservationsRecord | Problem:
    campaign, entry = bench.campaign, job.entry
    try:
        prepared = open_image(campaign, entry)
        bench = bench.for_image(prepared.image)
    except OpNavError as error:
        return Problem(reason=Reason.UNREADABLE_IMAGE, detail=str(error))
    campaign, image = bench.campaign, prepared.image
    if job.attitude is not None:
        image = image.with_attitude(
            rotation_of(job.attitude),
            source=AttitudeSource(job.attitude.source),
            covariance_rad2=job.attitude.covariance_rad2,
        )
    observations: list[ObservationRecord] = []
    views: list[TargetView] = []
    notes: list[str] = []
    for target in targets_in(campaign, entry.key):
        scene = _attempt(scene_of, campaign, image, target, bench.shapes[target.name])
        geometry = _attempt(scene.geometry, image) if isinstance(scene, Scene) else scene
        for estimator in target.estimators:
            observations.append(_observed(bench, job, image, target, estimator, scene, geometry))
        if isinstance(geometry, TargetGeometry) and campaign.max_overlays > 0:
            view = _attempt(_view, campaign, geometry)
            if isinstance(view, Problem):
                notes.append(f"no outline of {target.name}: {view.detail}")
            elif view is not None:
                views.append(view)
    return ObservationsRecord(index=entry.index, file=entry.key, observations=observations, views=views, notes=notes)


def _observed(
    bench: Workbench,
    job: BodyJob,
    image: Image,
    target: TargetSetup,
    estimator: Estimator,
    scene: Scene | Failure | Problem,
    geometry: TargetGeometry | Failure | Problem,
) -> ObservationRecord:
    """Run one estimator on one target of an image."""
    camera = bench.campaign.camera
    values: dict[str, Any] = {
        "index": job.entry.index,
        "file": job.entry.key,
        "epoch_utc": None if image.epoch is None else utc_text(image.epoch),
        "target": target.name,
        "estimator": estimator.name,
        "attitude": job.attitude,
    }
    start = time.perf_counter()
    outcome: CenterFix | Failure | Problem
    if not isinstance(scene, Scene):
        outcome = scene
    elif not isinstance(geometry, TargetGeometry):
        outcome = geometry
    else:
        values |= predicted_fields(camera, geometry)
        outcome = _attempt(estimator.estimate, image, camera, scene, target.name)
        if isinstance(outcome, CenterFix):
            fields = _attempt(fix_fields, camera, geometry, job.attitude, outcome)
            if isinstance(fields, Problem):
                outcome = fields
            else:
                values |= fields
    if isinstance(outcome, Failure):
        outcome = Problem(reason=outcome.reason, detail=outcome.detail)
    if isinstance(outcome, Problem):
        values |= {"status": "failed", "problem": outcome}
    return ObservationRecord(**values, time_s=time.perf_counter() - start)


def _view(campaign: Campaign, geometry: TargetGeometry) -> TargetView | None:
    """Predicted outline of a target, None where its center cannot be imaged."""
    model = campaign.camera.model
    predicted_px = model.project(geometry.position_camera_km)
    if not np.isfinite(predicted_px).all():
        return None
    radius_px = apparent_radius_px(
        campaign.camera, predicted_px, geometry.target.shape.circumscribing_radius_km, geometry.range_km
    )
    outline, lit = np.zeros((0, 2)), np.zeros(0, dtype=bool)
    if radius_px >= _OUTLINE_MIN_RADIUS_PX:
        angles = np.linspace(0.0, 2 * np.pi, _OUTLINE_ANGLES, endpoint=False)
        edge = trace_silhouette(geometry.body(), model, angles, sun_direction_camera=geometry.sun_direction_camera)
        outline, lit = edge.points_px[edge.valid], edge.lit[edge.valid]
    return TargetView(
        target=geometry.target.name,
        predicted_px=predicted_px.tolist(),
        radius_px=radius_px,
        outline_px=rows(outline),
        outline_lit=lit.tolist(),
    )


def _attempt(
    function: Callable[Arguments, Answer], *args: Arguments.args, **kwargs: Arguments.kwargs
) -> Answer | Problem:
    """Call a function; an exception becomes a :class:`Problem`."""
    try:
        return function(*args, **kwargs)
    except CoverageError as error:
        return Problem(reason=Reason.NO_GEOMETRY, detail=str(error))
    except OpNavError as error:
        return Problem(reason=Reason.INTERNAL_ERROR, detail=str(error))
    except Exception as error:  # noqa: BLE001 - the border of a worker: one image must never end a run
        detail = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Problem(reason=Reason.INTERNAL_ERROR, detail=detail, traceback=traceback.format_exc())
