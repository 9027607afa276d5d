"""Processing of one image by a worker process: stars first, bodies later.

Whatever goes wrong with an image ends in its record; nothing that an image holds can end a run.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ParamSpec, TypeVar

import numpy as np

from giantlike.calibration import identify_first
from giantlike.camera import Camera
from giantlike.campaign.calibration.solve import NO_STAR_IMAGE, record_of_stars, temperature_of
from giantlike.campaign.file.config import Campaign, ImageEntry
from giantlike.campaign.file.inputs import TargetSetup
from giantlike.campaign.run.image_loading import PreparedImage, open_image, scene_of, targets_in
from giantlike.campaign.run.observables import (
    attitude_of,
    sighting_of,
    with_attitude,
    with_fix,
    with_observer,
    with_prediction,
    with_stars,
)
from giantlike.campaign.store.record_values import SightingRecord
from giantlike.campaign.store.records import (
    Attitude,
    AttitudeRecord,
    CalibrationRecord,
    ObservationRecord,
    ObservationsRecord,
    Problem,
    TargetView,
)
from giantlike.catalogs import load_catalog
from giantlike.core.errors import OpNavError
from giantlike.core.frames import quaternion_xyzw
from giantlike.core.outcomes import CenterFix, Failure, Reason
from giantlike.core.time import utc_text
from giantlike.core.values import Value
from giantlike.image import AttitudeSource, Image
from giantlike.io.geometry_table import ImageGeometry
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
"""Points of a predicted outline in an overlay: one every 3 deg, drawn as a polygon; no result rests on it."""
_OUTLINE_MIN_RADIUS_PX = 2.0
"""Apparent radius, px, below which an overlay shows a cross alone: an outline would be hidden by it."""


@dataclass(frozen=True, slots=True, eq=False)
class Workbench(Value):
    """Campaign with catalog, shapes and kernels loaded, once per process.

    Parameters
    ----------
    campaign : Campaign
    navigation : StarNavigation or None
    shapes : dict of str to Shape
        By target name.
    kernels : SpiceKernels or None
    """

    campaign: Campaign
    navigation: StarNavigation | None
    shapes: dict[str, Shape]
    kernels: SpiceKernels | None

    @classmethod
    def load(cls, campaign: Campaign, *, trusted: bool = False) -> Workbench:
        """Load catalog, shapes and kernels.

        Parameters
        ----------
        campaign : Campaign
        trusted : bool
            Another process of this run loaded the kernels before.

        Returns
        -------
        Workbench

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
        kernels = None if campaign.spice is None else load_kernels(campaign.spice.kernels, ".", trusted=trusted)
        return cls(campaign, navigation, shapes, kernels)

    def with_camera(self, camera: Camera) -> Workbench:
        """Return the workbench for a calibrated camera: only attitudes are left to find, anywhere on the sky.

        They rest on stars as bright as those of the calibration where that has a limit, so that residuals of the two
        compare.

        Parameters
        ----------
        camera : Camera

        Returns
        -------
        Workbench
        """
        stars, navigation, setup = self.campaign.stars, self.navigation, self.campaign.calibration
        if stars is not None and navigation is not None:
            least = max(stars.options.min_snr, 0.0 if setup is None else setup.min_snr)
            options = replace(stars.options, lost_in_space=True, estimate_scale=False, min_snr=least)
            stars = replace(stars, options=options)
            navigation = StarNavigation(camera, navigation.catalog, stars.options, detection=stars.detection)
        return replace(self, campaign=replace(self.campaign, camera=camera, stars=stars), navigation=navigation)

    def with_warning(self, text: str) -> Workbench:
        """Return the workbench for a campaign with one more warning.

        Parameters
        ----------
        text : str

        Returns
        -------
        Workbench
        """
        return replace(self, campaign=replace(self.campaign, warnings=(*self.campaign.warnings, text)))

    def for_image(self, image: Image) -> Workbench:
        """Return the workbench with the camera at the temperature of an image.

        Parameters
        ----------
        image : Image

        Returns
        -------
        Workbench

        Raises
        ------
        DataError
            The header of the image does not hold the temperature that the calibration needs.
        """
        setup = self.campaign.calibration
        if setup is None or setup.temperature_keyword is None or self.campaign.camera.uncertainty is None:
            return self
        camera = self.campaign.camera
        model = camera.model.at_temperature(temperature_of(image, setup.temperature_keyword))
        return self.with_camera(replace(camera, model=model))

    def close(self) -> None:
        """Unload the kernels."""
        if self.kernels is not None:
            self.kernels.unload()


@dataclass(frozen=True, slots=True)
class ImageJob:
    """Work on one image.

    Parameters
    ----------
    entry : ImageEntry
    attitude : Attitude or None
        For the estimators of bodies; None: there is none.
    """

    entry: ImageEntry
    attitude: Attitude | None = None


def solve_image(bench: Workbench, job: ImageJob) -> AttitudeRecord:
    """Read an image and, if it is a star image, solve its stars.

    Parameters
    ----------
    bench : Workbench
    job : ImageJob

    Returns
    -------
    AttitudeRecord
    """
    start = time.perf_counter()
    record = _attempt(_solved, bench, job.entry)
    if isinstance(record, Problem):
        record = failed_image(bench.campaign, job.entry, record)
    return record.replace(time_s=time.perf_counter() - start)


def find_first_stars(bench: Workbench, job: ImageJob) -> CalibrationRecord:
    """Read a star image and identify its stars with a camera that is known roughly, for calibration.

    Parameters
    ----------
    bench : Workbench
    job : ImageJob

    Returns
    -------
    CalibrationRecord
    """
    record = _attempt(_first_stars, bench, job.entry)
    return failed_stars(job.entry, record) if isinstance(record, Problem) else record


def failed_stars(entry: ImageEntry, problem: Problem) -> CalibrationRecord:
    """Record of an image that calibration cannot use.

    Parameters
    ----------
    entry : ImageEntry
    problem : Problem

    Returns
    -------
    CalibrationRecord
    """
    return CalibrationRecord(index=entry.index, file=entry.key, problem=problem)


def _first_stars(bench: Workbench, entry: ImageEntry) -> CalibrationRecord | Problem:
    campaign, setup = bench.campaign, bench.campaign.calibration
    assert setup is not None
    assert bench.navigation is not None
    prepared = _read(open_image, campaign, entry)
    if isinstance(prepared, Problem):
        return prepared
    image = prepared.image
    if not campaign.is_star_image(image.exposure_s):
        return Problem(reason=Reason.NO_SIGNAL, detail=NO_STAR_IMAGE)
    temperature_c = _read(temperature_of, image, setup.temperature_keyword)
    if isinstance(temperature_c, Problem):
        return temperature_c
    found = identify_first(
        image, campaign.camera, bench.navigation, scale_error=setup.scale_error, temperature_c=temperature_c
    )
    if isinstance(found, Failure):
        return Problem.of(found)
    return record_of_stars(entry, found, image.camera_from_inertial)


def failed_image(campaign: Campaign, entry: ImageEntry, problem: Problem) -> AttitudeRecord:
    """Record of an image that could not be processed.

    Parameters
    ----------
    campaign : Campaign
    entry : ImageEntry
    problem : Problem

    Returns
    -------
    AttitudeRecord
    """
    return _unsolved(campaign, entry, campaign.geometry.get(entry.key)).replace(problem=problem)


def _unsolved(campaign: Campaign, entry: ImageEntry, known: Image | ImageGeometry | None) -> AttitudeRecord:
    """Record of an image before its attitude, of what is known of its exposure."""
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


def _opened(bench: Workbench, entry: ImageEntry) -> tuple[Workbench, PreparedImage]:
    """Image, and the workbench with the camera at its temperature."""
    prepared = open_image(bench.campaign, entry)
    return bench.for_image(prepared.image), prepared


def _solved(bench: Workbench, entry: ImageEntry) -> AttitudeRecord | Problem:
    opened = _read(_opened, bench, entry)
    if isinstance(opened, Problem):
        return opened
    bench, prepared = opened
    campaign, image = bench.campaign, prepared.image
    apriori = image.camera_from_inertial
    record = with_observer(_unsolved(campaign, entry, image), image.observer).replace(
        sha256=image.sha256,
        columns=image.columns,
        rows=image.rows,
        et=image.et,
        apriori_xyzw=None if apriori is None else quaternion_xyzw(apriori).tolist(),
        notes=_notes(campaign, prepared),
    )
    if bench.navigation is not None and record.star_image:
        return _from_stars(record, bench.navigation, image)
    if apriori is not None:
        attitude = attitude_of(apriori, AttitudeSource.A_PRIORI, campaign.apriori_covariance_rad2)
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
    """Record with what the stars of an image give."""
    detections, fix = navigation.detect_and_solve(image)
    if isinstance(detections, Failure):
        return record.replace(problem=Problem.of(detections))
    record = record.replace(detected_px=detections.points_px.tolist(), n_detected=int(detections.clean.sum()))
    if isinstance(fix, Failure):
        return record.replace(problem=Problem.of(fix))
    return with_stars(record, navigation.camera, fix)


def estimate_image(bench: Workbench, job: ImageJob) -> ObservationsRecord:
    """Run every estimator on every target of an image.

    Parameters
    ----------
    bench : Workbench
    job : ImageJob

    Returns
    -------
    ObservationsRecord
    """
    record = _attempt(_estimated, bench, job)
    return failed_observations(bench.campaign, job.entry, record) if isinstance(record, Problem) else record


def failed_observations(
    campaign: Campaign, entry: ImageEntry, problem: Problem, *, epoch_utc: str | None = None
) -> ObservationsRecord:
    """Failed rows for every estimator that would have run on an image.

    Parameters
    ----------
    campaign : Campaign
    entry : ImageEntry
    problem : Problem
    epoch_utc : str, optional

    Returns
    -------
    ObservationsRecord
    """
    rows = [
        _unobserved(entry, epoch_utc, target, estimator).replace(problem=problem)
        for target in targets_in(campaign, entry.key)
        for estimator in target.estimators
    ]
    return ObservationsRecord(index=entry.index, file=entry.key, observations=rows)


def _unobserved(
    entry: ImageEntry, epoch_utc: str | None, target: TargetSetup, estimator: Estimator
) -> ObservationRecord:
    """Record of an estimator that has not run yet."""
    return ObservationRecord(
        index=entry.index,
        file=entry.key,
        epoch_utc=epoch_utc,
        target=target.name,
        estimator=estimator.name,
        status="failed",
    )


def _estimated(bench: Workbench, job: ImageJob) -> ObservationsRecord | Problem:
    entry = job.entry
    opened = _read(_opened, bench, entry)
    if isinstance(opened, Problem):
        return opened
    bench, prepared = opened
    campaign, image = bench.campaign, prepared.image
    if job.attitude is not None:
        image = image.with_attitude(
            job.attitude.rotation,
            source=AttitudeSource(job.attitude.source),
            covariance_rad2=job.attitude.covariance_rad2,
            errors=job.attitude.errors,
        )
    epoch_utc = None if image.epoch is None else utc_text(image.epoch)
    observations: list[ObservationRecord] = []
    sightings: list[SightingRecord] = []
    views: list[TargetView] = []
    notes: list[str] = []
    for target in targets_in(campaign, entry.key):
        scene = _attempt(scene_of, campaign, image, target, bench.shapes[target.name])
        geometry = _attempt(scene.geometry, image) if isinstance(scene, Scene) else scene
        for estimator in target.estimators:
            record = _unobserved(entry, epoch_utc, target, estimator).replace(attitude=job.attitude)
            if isinstance(scene, Scene) and isinstance(geometry, TargetGeometry):
                observations.append(_observed(record, estimator, image, campaign.camera, scene, geometry))
            else:
                problem = Problem.of(geometry) if isinstance(geometry, Failure) else geometry
                observations.append(record.replace(problem=problem))
        if isinstance(scene, Scene) and isinstance(geometry, TargetGeometry):
            sightings.append(sighting_of(scene, image, geometry))
        if isinstance(geometry, TargetGeometry) and campaign.max_overlays > 0:
            view = _attempt(_view, campaign, geometry)
            if isinstance(view, Problem):
                notes.append(f"no outline of {target.name}: {view.detail}")
            elif view is not None:
                views.append(view)
    return ObservationsRecord(
        index=entry.index, file=entry.key, observations=observations, sightings=sightings, views=views, notes=notes
    )


def _observed(
    record: ObservationRecord,
    estimator: Estimator,
    image: Image,
    camera: Camera,
    scene: Scene,
    geometry: TargetGeometry,
) -> ObservationRecord:
    """Record with the result of one estimator."""
    start = time.perf_counter()
    record = with_prediction(record, camera, geometry)
    outcome = _attempt(estimator.estimate, image, camera, scene, record.target)
    done = _attempt(with_fix, record, camera, geometry, outcome) if isinstance(outcome, CenterFix) else outcome
    if not isinstance(done, ObservationRecord):
        done = record.replace(problem=Problem.of(done) if isinstance(done, Failure) else done)
    return done.replace(time_s=time.perf_counter() - start)


def _view(campaign: Campaign, geometry: TargetGeometry) -> TargetView | None:
    """Predicted outline of a target; None if its center cannot be imaged."""
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
        outline_px=outline.tolist(),
        outline_lit=lit.tolist(),
    )


def _read(function: Callable[Arguments, Answer], *args: Arguments.args, **kwargs: Arguments.kwargs) -> Answer | Problem:
    """Call a function that reads an image; damage becomes a :class:`Problem`."""
    try:
        return function(*args, **kwargs)
    except OpNavError as error:
        return Problem(reason=Reason.UNREADABLE_IMAGE, detail=str(error))


def _attempt(
    function: Callable[Arguments, Answer], *args: Arguments.args, **kwargs: Arguments.kwargs
) -> Answer | Problem:
    """Call a function; any exception becomes a :class:`Problem`."""
    try:
        return function(*args, **kwargs)
    except CoverageError as error:
        return Problem(reason=Reason.NO_GEOMETRY, detail=str(error))
    except OpNavError as error:
        return Problem(reason=Reason.INTERNAL_ERROR, detail=str(error))
    except Exception as error:  # noqa: BLE001 - the border of a worker: one image must never end a run
        detail = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Problem(reason=Reason.INTERNAL_ERROR, detail=detail, traceback=traceback.format_exc())
