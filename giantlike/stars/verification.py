"""From an attitude that patterns suggest to one that all stars of the image agree with, or not."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel, CameraModel, PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.processing.geometry.wahba import davenport_quaternions
from giantlike.stars.field import Sky, StarField
from giantlike.stars.matching import false_match_probability
from giantlike.stars.options import StarOptions
from giantlike.stars.pattern_search import Hypothesis
from giantlike.stars.refine import SMALLEST_GATE_PX, RefinedAttitude, refine_attitude, significant_matches

_GAINED = 3  # matches that a fit may add
_FIRST_RADIUS = 0.008  # of the image width: distortion that a pinhole of the right focal length leaves


def verify(
    hypothesis: Hypothesis,
    points_px: Float,
    covariance_px2: Float,
    camera: Camera,
    sky: Sky,
    options: StarOptions,
    trials: Callable[[float], float],
) -> RefinedAttitude | Failure:
    """Match all stars of the image with an attitude that patterns suggest, and fit.

    Parameters
    ----------
    hypothesis : Hypothesis
    points_px, covariance_px2 : (m, 2), (m, 2, 2) float64
        Detections, brightest first.
    camera : Camera
    sky : Sky
    options : StarOptions
        With ``estimate_scale`` the focal length of the hypothesis is taken.
    trials : callable
        As for :func:`refine_attitude`.
    """
    if options.estimate_scale:
        camera = dataclasses.replace(camera, model=scaled_model(camera.model, hypothesis.scale))
    field = sky.field(camera, hypothesis.camera_from_inertial, count=depth_for(len(points_px)))
    rough = options.estimate_scale or not len(hypothesis.star_ids)
    radius = max(options.inlier_px, _FIRST_RADIUS * camera.columns) if rough else options.inlier_px
    rotation = _apparent(hypothesis, field, points_px, camera)
    hopeless = _hopeless(field, points_px, camera, rotation, radius, options, trials)
    if isinstance(hopeless, Failure):
        return hopeless
    return refine_attitude(
        field,
        points_px,
        covariance_px2,
        camera,
        rotation,
        radius_px=radius,
        trials=trials,
        options=options,
    )


def _hopeless(
    field: StarField,
    points_px: Float,
    camera: Camera,
    rotation: Rotation,
    radius_px: float,
    options: StarOptions,
    trials: Callable[[float], float],
) -> Failure | None:
    """The failure of an attitude that could not be believed even if the matches came as close as they ever do."""
    area = float(camera.columns * camera.rows)
    predicted = camera.model.project(rotate(rotation, field.directions_inertial))
    predicted[~camera.contains(predicted, margin_px=-radius_px)] = np.nan
    found = len(significant_matches(predicted, points_px, radius_px, area)) + _GAINED
    chance = float(np.pi * SMALLEST_GATE_PX**2 * min(found, len(field)) / area)
    probability = false_match_probability(min(found, len(points_px)), len(points_px), chance, trials(SMALLEST_GATE_PX))
    if probability <= options.max_false_match_probability:
        return None
    return Failure(
        Reason.AMBIGUOUS,
        f"{found - _GAINED} of {len(points_px)} detections match a star to {radius_px:.3g} px, which chance does too",
    )


def scaled_model(model: CameraModel, scale: float) -> CameraModel:
    """The model with its focal lengths times ``scale``; a pinhole as a Brown model, whose ``k1`` can be estimated."""
    values = dict(zip(model.parameter_names, model.parameters.tolist(), strict=True))
    values |= {name: values[name] * scale for name in ("fx_px", "fy_px", "skew_px")}
    if isinstance(model, PinholeModel):
        return BrownModel(**values)
    return model.with_parameters(list(values.values()))


def depth_for(n_detections: int) -> int:
    """How many catalog stars, brightest first, to hold against so many detections."""
    return 3 * n_detections + 100


def _apparent(hypothesis: Hypothesis, field: StarField, points_px: Float, camera: Camera) -> Rotation:
    """Attitude of the stars of a hypothesis where they appear: an index knows neither aberration nor the epoch."""
    _, mine, theirs = np.intersect1d(hypothesis.star_ids, field.stars.ids, return_indices=True)
    seen = camera.model.unproject(points_px[hypothesis.detection_indices[mine]])
    good = np.isfinite(seen).all(axis=1)
    if int(good.sum()) < 3:
        return hypothesis.camera_from_inertial
    directions = field.directions_inertial[theirs[good]]
    return Rotation.from_quat(
        davenport_quaternions(directions[None], seen[good][None], np.ones((1, len(directions))))[0]
    )
