"""Calibration: camera model, temperature terms and orientation of every image estimated together."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import gammainc

from giantlike._system.processes import one_thread
from giantlike.calibration.bundle_adjustment import Data, Minimum, State, covariance_of, minimize, predict
from giantlike.calibration.criteria import CalibrationCriteria
from giantlike.calibration.field_map import FieldSensitivity
from giantlike.calibration.observability import parameter_support
from giantlike.calibration.observations import ImageObservations
from giantlike.calibration.options import CalibrationOptions, Loss
from giantlike.calibration.result import CalibrationResult, ImageCalibration, RejectedObservation
from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask, require
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.statistics import MEDIAN_CHI2
from giantlike.core.values import Value
from giantlike.core.version import VERSION
from giantlike.processing.geometry.wahba import solve_wahba

_LOG = logging.getLogger("giantlike.calibration")

_NOISE_EXPLAINS = 0.9999  # chi-square probability up to which noise explains the residuals: 1 false alarm in 10,000
_SMALLEST_SPREAD = 1e-4  # of squares: residuals a hundred times below their sigmas are rounding, not a scale
_MIN_PER_IMAGE = 2  # observations that determine the orientation of an image
_ROUGH_STEPS = 40  # of the fits that search for outliers; these may end before convergence
_LEAST_SHARE = 0.5  # of the observations of an image that must agree: if most disagree, its identification is wrong


@one_thread()
def calibrate(
    observations: Sequence[ImageObservations],
    model: CameraModel,
    *,
    estimate: Sequence[str],
    columns: int,
    rows: int,
    options: CalibrationOptions | None = None,
    criteria: CalibrationCriteria | None = None,
) -> CalibrationResult | Failure:
    """Estimate parameters of a camera model together with the orientation of every image.

    Parameters
    ----------
    observations : sequence of ImageObservations; all of directions, or all of finite targets
    model : CameraModel; start; a rough focal length without distortion suffices
    estimate : sequence of str
        Names of the parameters to estimate; the others keep their values in ``model``. Without ``cx_px, cy_px`` the
        principal point is fixed: in a narrow field it is degenerate with the orientation.
    columns, rows : int; size of the detector, over which the uncertainty of the map is evaluated
    options : CalibrationOptions, optional
    criteria : CalibrationCriteria, optional

    Returns
    -------
    CalibrationResult or Failure
        A result that misses a criterion has the reasons in ``problems``. Failure reasons: degenerate_geometry (names
        the parameters that cannot be separated), not_converged, too_few_matches.

    Raises
    ------
    InputError
        A parameter is unknown or named twice, or there are no observations.

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, Camera Calibration.
    .. [2] Inman and Holt, Artemis I Optical Navigation System Performance, IV.A (outliers, fixed principal point).
    """
    options = CalibrationOptions() if options is None else options
    criteria = CalibrationCriteria() if criteria is None else criteria
    _check(observations, model, estimate, options)
    rotations = _start_rotations(observations, model)
    if isinstance(rotations, Failure):
        return rotations
    estimated = np.array([model.parameter_names.index(name) for name in estimate], dtype=np.intp)
    prior_sigma = np.array([options.prior_sigma.get(name, math.inf) for name in estimate])
    data = Data.from_images(observations, rotations, estimated, model.parameters[estimated], prior_sigma)
    positions = np.array(
        [np.zeros(3) if image.position_reference is None else image.position_reference for image in observations]
    )
    fit = _fit_without_outliers(State(model, rotations, positions), data, options)
    if isinstance(fit, Failure):
        return fit
    result = _result(fit, observations, model, tuple(estimate), (columns, rows))
    return result if isinstance(result, Failure) else replace(result, problems=criteria.missed_by(result))


def _check(
    observations: Sequence[ImageObservations], model: CameraModel, estimate: Sequence[str], options: CalibrationOptions
) -> None:
    require(len(observations) > 0, "calibrate needs at least one image with observations")
    require(
        len({image.finite for image in observations}) == 1,
        "directions and finite targets cannot be calibrated together: give observations of one kind",
    )
    require(len(set(estimate)) == len(estimate), f"estimate names a parameter twice: {list(estimate)}")
    for name in (*estimate, *options.prior_sigma):
        known = ", ".join(model.parameter_names)
        require(name in model.parameter_names, f"model {model.type_name!r} has no parameter {name!r}; it has {known}")


def _start_rotations(observations: Sequence[ImageObservations], model: CameraModel) -> Rotation | Failure:
    rotations = []
    for image in observations:
        found = image.camera_from_reference
        if found is None:
            vectors = model.at_temperature(image.temperature_c).unproject(image.points_px)
            seen = np.isfinite(vectors).all(axis=1)
            outcome = solve_wahba(image.targets[seen], vectors[seen], 1.0 / model.focal_length_px)
            if isinstance(outcome, Failure):
                return Failure(outcome.reason, f"{image.name}: {outcome.detail}")
            found = outcome[0]
        rotations.append(found)
    return Rotation.concatenate(rotations)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit(Value):
    """Minimum of the cost, the observations that it rests on, and the number of steps and rounds it took."""

    data: Data
    minimum: Minimum
    used: Mask
    kept_images: Mask
    steps: int
    rounds: int


def _fit_without_outliers(state: State, data: Data, options: CalibrationOptions) -> _Fit | Failure:
    """Robust fits and rejection until the selection no longer changes, then the fit with the chosen loss.

    Residuals are compared with their median spread by a chi-square test that is expected to reject
    ``options.false_rejections`` good ones in all. An image of which less than half agrees is rejected as a whole.
    """
    used = np.asarray(np.isfinite(predict(state, data)).all(axis=1))
    guard = Loss.HUBER if options.loss is Loss.LINEAR else options.loss
    kept_images: Mask = np.ones(len(data.offsets) - 1, dtype=bool)
    steps = rounds = 0
    for rounds in range(1, options.max_rounds + 1):
        minimum = minimize(state, data, used, guard, max_steps=_ROUGH_STEPS, rough=True)
        if isinstance(minimum, Failure):
            return minimum
        state, steps = minimum.state, steps + minimum.steps
        before = used
        used, kept_images = _agreeing(state, data, used, options)
        _LOG.debug("round %d: %d of %d observations agree, %d steps", rounds, int(used.sum()), len(used), steps)
        if int(used.sum()) * 2 <= len(data.estimated) + 3 * int(kept_images.sum()):
            return Failure(
                Reason.TOO_FEW_MATCHES,
                f"only {int(used.sum())} of {len(used)} observations agree with one camera model",
            )
        if np.array_equal(used, before):
            break
    minimum = minimize(state, data, used, options.loss, max_steps=options.max_steps)
    if isinstance(minimum, Failure):
        return minimum
    return _Fit(data, minimum, used, kept_images, steps + minimum.steps, rounds)


def _agreeing(state: State, data: Data, used: Mask, options: CalibrationOptions) -> tuple[Mask, Mask]:
    """Masks of the observations (n,) that agree with the fit, and of the images (m,) that keep any."""
    residuals = data.points_px - predict(state, data)
    squares = np.sum(residuals**2, axis=1) / data.sigma_px**2
    squares = np.where(np.isfinite(squares), squares, np.inf)
    count, free = int(used.sum()), len(data.estimated) + data.pose * (len(data.offsets) - 1)
    spread = float(np.median(squares[used])) / MEDIAN_CHI2 * 2 * count / max(2 * count - free, 1)
    spread = max(spread, _SMALLEST_SPREAD)
    limit = 2.0 * math.log(max(len(squares) / options.false_rejections, 2.0))  # chi-square with two degrees
    keep = np.asarray(squares <= limit * spread)
    index = data.image_index
    share = np.bincount(index, keep, len(data.offsets) - 1) / np.diff(data.offsets)
    enough = np.bincount(index, keep, len(data.offsets) - 1) >= np.where(data.attitude_weight > 0, 1, _MIN_PER_IMAGE)
    kept_images = np.asarray((share >= _LEAST_SHARE) & enough)
    return keep & kept_images[index], kept_images


def _result(
    fit: _Fit,
    observations: Sequence[ImageObservations],
    start: CameraModel,
    names: tuple[str, ...],
    size: tuple[int, int],
) -> CalibrationResult | Failure:
    """Covariances and statistics of a fit; ``size`` are the columns and rows of the detector."""
    data, state, used = fit.data, fit.minimum.state, fit.used
    found = covariance_of(fit.minimum.normal, names)
    if isinstance(found, Failure):
        return found
    covariance, condition = found
    predicted = predict(state, data)
    squares = np.sum((data.points_px - predicted)[used] ** 2, axis=1)
    freedom = _degrees_of_freedom(fit, covariance)
    chi2 = float(np.sum(squares / data.sigma_px[used] ** 2))
    explained = float(gammainc(freedom / 2.0, chi2 / 2.0)) <= _NOISE_EXPLAINS
    scale = 1.0 if explained else chi2 / freedom
    temperature_c = float(np.mean(data.temperatures_c))
    sensitivity = FieldSensitivity.from_model(state.model, columns=size[0], rows=size[1], temperature_c=temperature_c)
    values = state.model.parameters[data.estimated]
    return CalibrationResult(
        model=state.model,
        start=start,
        columns=size[0],
        rows=size[1],
        estimated=names,
        covariance=covariance * scale,
        covariance_scale=scale,
        images=_images(fit, observations, predicted, covariance, scale, sensitivity),
        image_index=data.image_index,
        observed_px=data.points_px,
        predicted_px=predicted,
        sigma_px=data.sigma_px,
        magnitudes=np.concatenate([image.magnitudes for image in observations]),
        labels=np.concatenate([image.labels for image in observations]),
        used=used,
        rejected=_list_rejected(fit, observations, predicted),
        residual_sigma_px=math.sqrt(float(squares.sum()) / freedom),
        reduced_chi2=chi2 / freedom,
        condition_number=condition,
        support=parameter_support(names, values, data, covariance * scale, sensitivity),
        map_points_px=sensitivity.points_px,
        map_sigma_px=sensitivity.sigma_px(data.estimated, covariance * scale),
        problems=(),
        steps=fit.steps,
        rounds=fit.rounds,
        provenance={"giantlike": VERSION, "model": state.model.type_name},
    )


def _degrees_of_freedom(fit: _Fit, covariance: Float) -> float:
    """Number of observations minus number of unknowns, without the fraction determined a priori."""
    data = fit.data
    poses = fit.minimum.normal.pose_covariance(covariance)[:, :3, :3]
    from_priors = float(data.prior_weight @ np.diag(covariance))
    from_priors += float(data.attitude_weight @ np.trace(poses, axis1=1, axis2=2))
    unknowns = len(data.estimated) + data.pose * int(fit.kept_images.sum())
    return max(2 * int(fit.used.sum()) - unknowns + from_priors, 1.0)


def _images(
    fit: _Fit,
    observations: Sequence[ImageObservations],
    predicted_px: Float,
    covariance: Float,
    scale: float,
    sensitivity: FieldSensitivity,
) -> tuple[ImageCalibration, ...]:
    """Pose, residuals and influence of every image."""
    data, state, normal = fit.data, fit.minimum.state, fit.minimum.normal
    poses = normal.pose_covariance(covariance) * scale
    shifts = normal.shifts_without_image()
    weights = normal.information()
    residuals = data.points_px - predicted_px
    result = []
    for number, image in enumerate(observations):
        mine = (data.image_index == number) & fit.used
        shift, kept = shifts[number], bool(mine.any())
        known = bool(np.isfinite(shift).all())  # else the other images do not determine a parameter
        moved = sensitivity.unrotated[..., data.estimated] @ shift if known else np.array([[math.inf]])
        result.append(
            ImageCalibration(
                name=image.name,
                temperature_c=image.temperature_c,
                camera_from_reference=state.rotation[number],
                covariance_rad2=poses[number, :3, :3] if kept else np.full((3, 3), math.nan),
                position_reference=state.position[number],
                n_used=int(mine.sum()),
                n_rejected=len(image) - int(mine.sum()),
                rms_px=float(np.sqrt(np.mean(np.sum(residuals[mine] ** 2, axis=1)))) if kept else math.nan,
                influence_px=float(np.sqrt(np.mean(np.sum(moved**2, axis=-1)))),
                influence=float(shift @ weights @ shift) / scale / max(len(shift), 1) if known else math.inf,
            )
        )
    return tuple(result)


def _list_rejected(
    fit: _Fit, observations: Sequence[ImageObservations], predicted_px: Float
) -> tuple[RejectedObservation, ...]:
    """Observations left out, worst first."""
    data, found = fit.data, []
    for index in np.flatnonzero(~fit.used):
        number = int(data.image_index[index])
        image = observations[number]
        distance = float(np.linalg.norm(data.points_px[index] - predicted_px[index]))
        imaged = math.isfinite(distance)
        cause = "not_imaged" if not imaged else "outlier" if fit.kept_images[number] else "image"
        found.append(
            RejectedObservation(
                image=image.name,
                label=int(image.labels[index - data.offsets[number]]),
                observed_px=(float(data.points_px[index, 0]), float(data.points_px[index, 1])),
                predicted_px=(float(predicted_px[index, 0]), float(predicted_px[index, 1])),
                distance_px=distance,
                sigmas=distance / float(data.sigma_px[index]),
                cause=cause,
            )
        )
    return tuple(sorted(found, key=lambda one: -one.sigmas if math.isfinite(one.sigmas) else -math.inf))
