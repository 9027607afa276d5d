"""Calibration from star images: identification and camera model alternately, until the matches stop changing."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike._system.processes import one_thread
from giantlike.calibration.calibrate import calibrate
from giantlike.calibration.criteria import CalibrationCriteria
from giantlike.calibration.observations import ImageObservations
from giantlike.calibration.options import CalibrationOptions
from giantlike.calibration.result import CalibrationResult
from giantlike.camera import Camera
from giantlike.camera_models import BrownModel, CameraModel, model_from_mapping, model_to_mapping
from giantlike.core.arrays import Float, require
from giantlike.core.errors import InputError
from giantlike.core.outcomes import AttitudeFix, Failure, Reason
from giantlike.core.values import Estimate
from giantlike.image import Image
from giantlike.stars.field import Sky, StarField
from giantlike.stars.matching import attitudes_of_sky
from giantlike.stars.navigation import StarNavigation, sky_of
from giantlike.stars.options import StarOptions, bright_enough
from giantlike.stars.refine import RefinedAttitude, depth_for, refine_attitude, scaled_model

DEFAULT_MIN_SNR = 0.0
"""Lowest signal to noise ratio of the stars that a camera is calibrated from: all, each by its weight."""
_MAX_ROUNDS = 8  # of identification and calibration
_MARGIN = 0.2  # of the image size: a rough camera may see a star of its solution so far outside the predicted field


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StarImage(Estimate):
    """Sources, sky and first identification of a star image for calibration."""

    name: str
    sky: Sky
    points_px: Float  # (m, 2), with covariance_px2, snr: sources without flags of ``NOT_A_STAR``, brightest first
    covariance_px2: Float
    snr: Float
    camera_from_inertial: Rotation  # first solution
    focal_length_px: float  # focal length that the first solution found
    star_ids: NDArray[np.int64]  # star_ids, source_indices: (k,); of the first solution, and of its sources
    source_indices: NDArray[np.int64]
    sigma_px: Float  # (k,); standard deviation of these stars per axis
    temperature_c: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class AllStars:
    """Stars of all brightnesses that agree with the attitudes found with a calibrated camera."""

    min_snr: float  # limit of the stars used for calibration; the others here include fainter ones
    count: int
    rms_px: float  # radial residual; larger than in the calibration, because faint stars have more noise
    noise_px: float  # radial rms expected from their sigmas


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StarCalibration(Estimate):
    """A calibration from star images."""

    result: CalibrationResult
    rounds: int  # of identification and calibration
    settled: bool  # True if the matches stopped changing
    failed: tuple[tuple[str, Failure], ...]  # images not identified with the calibrated camera, and why
    all_stars: AllStars | None = None  # residuals of stars of all brightnesses; None for other targets than stars

    @property
    def fix(self) -> CalibrationResult:
        """Old name of :attr:`result`."""
        warnings.warn("StarCalibration.fix is now StarCalibration.result; it goes in 0.4", DeprecationWarning, 2)
        return self.result


@one_thread()
def identify_first(
    image: Image, camera: Camera, navigation: StarNavigation, *, scale_error: float, temperature_c: float = 0.0
) -> StarImage | Failure:
    """Identify the stars of an image with a roughly known camera.

    The focal length (and, with enough stars, k1 of models that have it) is estimated too. The whole sky is searched
    if there is no a priori attitude or no stars are found with it.

    Parameters
    ----------
    image : Image
    camera : Camera
    navigation : StarNavigation; catalog and options; its camera is not used
    scale_error : float; largest relative error of the focal length, in (0, 0.2]
    temperature_c : float, Celsius
    """
    options = replace(navigation.options, lost_in_space=True, estimate_scale=True, scale_error=scale_error)
    camera = replace(camera, model=scaled_model(camera.model, 1.0))
    solver = StarNavigation(camera, navigation.catalog, options, detection=navigation.detection)
    detections = solver.detect(image)
    if isinstance(detections, Failure):
        return detections
    fix = solver.solve_detections(image, detections)
    if isinstance(fix, Failure):
        return fix
    offered = detections.clean & np.isfinite(detections.covariance_px2).all(axis=(1, 2))
    offered[fix.detection_indices] = True
    return StarImage(
        name=image.name,
        sky=sky_of(image, navigation.catalog, options),
        points_px=detections.points_px[offered],
        covariance_px2=detections.covariance_px2[offered],
        snr=detections.snr[offered],
        camera_from_inertial=fix.camera_from_inertial,
        focal_length_px=fix.focal_length_px,
        star_ids=fix.star_ids,
        source_indices=np.cumsum(offered)[fix.detection_indices] - 1,
        sigma_px=fix.sigma_px,
        temperature_c=temperature_c,
    )


def observations_of_fix(
    fix: AttitudeFix, sky: Sky, camera: Camera, *, name: str, temperature_c: float = 0.0
) -> ImageObservations:
    """Observations for :func:`~giantlike.calibration.calibrate` from an attitude solution."""
    field = _stars_of_ids(sky, camera, fix.camera_from_inertial, fix.star_ids, name)
    return _observations(name, field, fix.camera_from_inertial, fix.observed_px, fix.sigma_px, temperature_c)


def start_model(model: CameraModel, estimate: Sequence[str], type_name: str | None, focal_ratio: float) -> CameraModel:
    """Starting model of a calibration: of a type with every parameter to estimate, with scaled focal lengths."""
    have = set(model.parameter_names)
    if type_name is None:
        other = model.type_name == "pinhole" and not set(estimate) <= have
        type_name = BrownModel.type_name if other else model.type_name
    if type_name != model.type_name:
        if model.type_name != "pinhole":
            raise InputError(
                f"calibration.model: a camera of type {model.type_name!r} cannot start a {type_name!r} model: "
                f"give the camera that type, or start from pinhole"
            )
        values = {key: value for key, value in model_to_mapping(model).items() if value or key != "skew_px"}
        model = model_from_mapping(values | {"type": type_name})
    for name in estimate:
        known = ", ".join(model.parameter_names)
        require(
            name in model.parameter_names,
            f"calibration.estimate: a {type_name!r} model has no parameter {name!r}; it has {known}",
        )
    values = dict(zip(model.parameter_names, model.parameters.tolist(), strict=True))
    for name in ("fx_px", "fy_px"):
        if name in estimate:
            values[name] *= focal_ratio
    return model.with_parameters(list(values.values()))


@one_thread()
def calibrate_stars(
    images: Sequence[StarImage],
    camera: Camera,
    *,
    estimate: Sequence[str],
    model_type: str | None = None,
    min_snr: float = DEFAULT_MIN_SNR,
    stars: StarOptions | None = None,
    options: CalibrationOptions | None = None,
    criteria: CalibrationCriteria | None = None,
) -> StarCalibration | Failure:
    """Calibrate a camera from identified star images, alternating calibration and identification.

    Parameters
    ----------
    images : sequence of StarImage
    camera : Camera; a rough camera
    estimate : sequence of str; parameters to estimate, as in :func:`~giantlike.calibration.calibrate`
    model_type : str, optional; type of the model to estimate, see :func:`start_model`
    min_snr : float; lowest ratio of stars used; by default all; the 20 brightest of each image always are
    stars : StarOptions, optional
    options : CalibrationOptions, optional
    criteria : CalibrationCriteria, optional
    """
    if not images:
        return Failure(Reason.TOO_FEW_MATCHES, "no image has identified stars: a calibration needs at least one")
    ratio = float(np.median([image.focal_length_px for image in images])) / camera.model.focal_length_px
    start = start_model(camera.model, estimate, model_type, ratio)
    stars = replace(stars or StarOptions(), estimate_scale=False)
    rough = replace(camera, model=start)
    estimator = partial(
        calibrate, model=start, estimate=estimate, columns=camera.columns, rows=camera.rows, options=options,
        criteria=criteria,
    )  # fmt: skip
    observations = [_first_observations(image, rough, min_snr) for image in images]
    result = estimator(observations)
    rounds, settled, failed = 1, False, list[tuple[str, Failure]]()
    while isinstance(result, CalibrationResult) and not settled and rounds < _MAX_ROUNDS:
        before = _matches(observations)
        observations, failed = _identified_with(result, images, camera, stars, min_snr)
        if not observations:
            return Failure(
                Reason.TOO_FEW_MATCHES,
                f"no image keeps its stars with the calibrated camera; {failed[0][0]}: {failed[0][1].detail}",
            )
        result = estimator(observations)
        settled = _matches(observations) == before
        rounds += 1
    if isinstance(result, Failure):
        return result
    return StarCalibration(
        result=result,
        rounds=rounds,
        settled=settled,
        failed=tuple(failed),
        all_stars=_all_stars(result, images, camera, stars, min_snr),
    )


def _all_stars(
    result: CalibrationResult, images: Sequence[StarImage], camera: Camera, options: StarOptions, min_snr: float
) -> AllStars | None:
    attitudes = {image.name: image.camera_from_reference for image in result.images}
    residuals, sigmas = [], []
    for image in images:
        if image.name not in attitudes:
            continue
        refined = _refine_attitude(image, replace(camera, model=result.model), attitudes[image.name], options)
        if isinstance(refined, RefinedAttitude):
            used = refined.solution.used
            seen = image.points_px[refined.matches.detection_indices]
            residuals.append((seen - refined.solution.predicted_px)[used])
            sigmas.append(refined.solution.sigma_px[used])
    if not residuals:
        return None
    left, sigma = np.concatenate(residuals), np.concatenate(sigmas)
    return AllStars(
        min_snr=min_snr,
        count=len(left),
        rms_px=float(np.sqrt(np.mean(np.sum(left**2, axis=1)))),
        noise_px=float(np.sqrt(2.0 * np.mean(sigma**2))),
    )


def _matches(observations: Sequence[ImageObservations]) -> list[tuple[str, bytes, bytes]]:
    """Names of the images, and which stars are matched with which sources."""
    return [(one.name, one.labels.tobytes(), one.points_px.tobytes()) for one in observations]


def _identified_with(
    result: CalibrationResult, images: Sequence[StarImage], camera: Camera, options: StarOptions, min_snr: float
) -> tuple[list[ImageObservations], list[tuple[str, Failure]]]:
    """Observations of all images, identified again with a better camera, and the images in which that failed."""
    better = replace(camera, model=result.model)
    attitudes = {image.name: image.camera_from_reference for image in result.images}
    found = [
        _identify_stars(image, better, attitudes.get(image.name, image.camera_from_inertial), options, min_snr)
        for image in images
    ]
    failed = [(image.name, one) for image, one in zip(images, found, strict=True) if isinstance(one, Failure)]
    return [one for one in found if not isinstance(one, Failure)], failed


def _first_observations(image: StarImage, camera: Camera, min_snr: float) -> ImageObservations:
    """Observations of the bright stars of the first identification."""
    bright = bright_enough(image.snr[image.source_indices], min_snr)
    rotation = image.camera_from_inertial
    field = _stars_of_ids(image.sky, camera, rotation, image.star_ids[bright], image.name)
    points_px = image.points_px[image.source_indices[bright]]
    return _observations(image.name, field, rotation, points_px, image.sigma_px[bright], image.temperature_c)


def _observations(
    name: str, field: StarField, rotation: Rotation, points_px: Float, sigma_px: Float, temperature_c: float
) -> ImageObservations:
    """Observations of the stars of a field, which are its targets."""
    return ImageObservations(
        name=name,
        targets=field.directions_inertial,
        points_px=points_px,
        sigma_px=sigma_px,
        camera_from_reference=rotation,
        temperature_c=temperature_c,
        labels=field.stars.ids,
        magnitudes=field.stars.magnitude,
    )


def _stars_of_ids(
    sky: Sky, camera: Camera, camera_from_inertial: Rotation, star_ids: NDArray[np.int64], name: str
) -> StarField:
    """Stars of the given identifiers (k,), in their order, from the sky that a camera sees."""
    margin_px = _MARGIN * max(camera.columns, camera.rows)
    field = sky.field(camera, camera_from_inertial, margin_px=margin_px)
    order = np.argsort(field.stars.ids)
    place = order[np.minimum(np.searchsorted(field.stars.ids, star_ids, sorter=order), len(order) - 1)]
    missing = star_ids[field.stars.ids[place] != star_ids]
    require(missing.size == 0, f"{name}: star {missing[:1].tolist()} is not in the catalog where the camera points")
    return field.select(place)


def _refine_attitude(
    image: StarImage, camera: Camera, camera_from_inertial: Rotation, options: StarOptions
) -> RefinedAttitude | Failure:
    camera = replace(camera, model=camera.model.at_temperature(image.temperature_c))
    return refine_attitude(
        image.sky.field(camera, camera_from_inertial, count=depth_for(len(image.points_px))),
        image.points_px,
        image.covariance_px2,
        camera,
        camera_from_inertial,
        radius_px=options.inlier_px,
        trials=lambda radius_px: attitudes_of_sky(radius_px, camera),
        options=options,
    )


def _identify_stars(
    image: StarImage, camera: Camera, camera_from_inertial: Rotation, options: StarOptions, min_snr: float
) -> ImageObservations | Failure:
    """Bright matches of an image with a camera, those that the attitude fit leaves out included: calibration judges."""
    refined = _refine_attitude(image, camera, camera_from_inertial, options)
    if isinstance(refined, Failure):
        return refined
    solution, detected = refined.solution, refined.matches.detection_indices
    bright = bright_enough(image.snr[detected], min_snr)
    field = refined.field.select(refined.matches.star_indices[bright])
    points_px, rotation = image.points_px[detected[bright]], solution.camera_from_inertial
    return _observations(image.name, field, rotation, points_px, solution.sigma_px[bright], image.temperature_c)
