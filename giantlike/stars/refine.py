"""From a first attitude to all stars of an image: match, fit, match again, and ask whether it could be chance."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import CameraModel, ifov_rad
from giantlike.core.arrays import Float, Mask
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.stars.attitude import AttitudeSolution, Scale, fit_attitude
from giantlike.stars.field import StarField
from giantlike.stars.matching import (
    Matches,
    chance_of_match,
    confusion_px,
    false_match_probability,
    log_chance,
    match_nearest,
)
from giantlike.stars.options import StarOptions

_MAX_ROUNDS = 8
_STARS_FOR_FOCAL_LENGTH = 5
_STARS_FOR_RADIAL = 12
SMALLEST_GATE_PX = 0.5
"""Matches are never held to be closer than this when chance is asked."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RefinedAttitude(Value):
    """An attitude, the stars that it rests on, and how likely chance would do as well.

    Parameters
    ----------
    field : StarField
        The stars offered.
    solution : AttitudeSolution
        Its arrays follow ``matches``.
    matches : Matches
        Indices into the star field and the detections; which were kept is in ``solution.used``.
    n_detections : int
        How many were offered.
    false_match_probability : float
    """

    field: StarField
    solution: AttitudeSolution
    matches: Matches
    n_detections: int
    false_match_probability: float


def refine_attitude(
    field: StarField,
    points_px: Float,
    covariance_px2: Float,
    camera: Camera,
    camera_from_inertial: Rotation,
    *,
    radius_px: float,
    trials: Callable[[float], float],
    options: StarOptions,
) -> RefinedAttitude | Failure:
    """Match every detection that a star explains and fit the attitude to the pairs, in turns.

    How deep the catalog is used is decided by the evidence: as many of the brightest stars as make the
    matches least likely to be chance.

    Parameters
    ----------
    field : StarField
        Brightest first.
    points_px, covariance_px2 : (m, 2), (m, 2, 2) float64
        Detections.
    camera : Camera
    camera_from_inertial : Rotation
        First attitude.
    radius_px : float, px
        Match radius of the first round; ``options.inlier_px`` afterwards.
    trials : callable
        Number of attitudes that a search could have tried, as a function of the match radius in px.
    options : StarOptions

    Returns
    -------
    RefinedAttitude or Failure
        Reasons: too_few_matches, ambiguous (chance would do as well), and those of the fit.
    """
    solution: AttitudeSolution
    rotation, radius = camera_from_inertial, radius_px
    previous: tuple[bytes, bytes] | None = None
    for _ in range(_MAX_ROUNDS):
        predicted = _predicted_in_frame(field, camera, rotation, radius)
        matches = significant_matches(predicted, points_px, radius, float(camera.columns * camera.rows))
        if len(matches) < options.min_matches:
            return Failure(
                Reason.TOO_FEW_MATCHES,
                f"{len(matches)} of {len(points_px)} detections match a star to {radius:.3g} px, "
                f"{options.min_matches} are needed",
            )
        fitted = _fit(field, matches, points_px, covariance_px2, predicted, camera, options)
        if isinstance(fitted, Failure):
            return fitted
        solution = fitted
        rotation = solution.camera_from_inertial
        camera = dataclasses.replace(camera, model=solution.model)
        now = (matches.star_indices.tobytes(), matches.detection_indices.tobytes())
        if now == previous and radius == options.inlier_px:
            break
        previous, radius = now, options.inlier_px
    return _judged(field, matches, solution, points_px, camera, trials, options)


def significant_matches(predicted_px: Float, points_px: Float, radius_px: float, area_px2: float) -> Matches:
    """Nearest-neighbor pairs with as many of the brightest stars as make chance least likely.

    Parameters
    ----------
    predicted_px : (n, 2) float64, px
        Stars, brightest first, NaN where not in the image.
    points_px : (m, 2) float64, px
    radius_px, area_px2 : float
        Match radius and area of the image.
    """
    matches = match_nearest(predicted_px, points_px, radius_px)
    if len(matches) == 0:
        return matches
    visible = np.flatnonzero(np.isfinite(predicted_px[:, 0]))
    is_matched = np.isin(visible, matches.star_indices)
    chance = np.minimum(np.arange(1, visible.size + 1) * np.pi * radius_px**2 / area_px2, 0.5)
    log_tail = log_chance(np.cumsum(is_matched), len(points_px), chance)
    depth = int(np.argmin(np.where(is_matched, log_tail, np.inf))) + 1
    limited = np.full_like(predicted_px, np.nan)
    limited[visible[:depth]] = predicted_px[visible[:depth]]
    return match_nearest(limited, points_px, radius_px)


def scale_for(n_matched: int, model: CameraModel, options: StarOptions) -> Scale:
    """What of the camera model so many stars can determine."""
    if not options.estimate_scale or n_matched < _STARS_FOR_FOCAL_LENGTH:
        return Scale.FIXED
    radial = n_matched >= _STARS_FOR_RADIAL and "k1" in model.parameter_names
    return Scale.RADIAL if radial else Scale.FOCAL_LENGTH


def _predicted_in_frame(field: StarField, camera: Camera, rotation: Rotation, margin_px: float) -> Float:
    predicted = camera.model.project(rotate(rotation, field.directions_inertial))
    predicted[~camera.contains(predicted, margin_px=-margin_px)] = np.nan
    return predicted


def _fit(
    field: StarField,
    matches: Matches,
    points_px: Float,
    covariance_px2: Float,
    predicted_px: Float,
    camera: Camera,
    options: StarOptions,
) -> AttitudeSolution | Failure:
    stars, chosen = matches.star_indices, matches.detection_indices
    catalog_px = field.sigma_rad[stars] / ifov_rad(camera.model, points_px[chosen])
    blend_px = confusion_px(predicted_px, field.stars.magnitude)[stars]
    return fit_attitude(
        field.directions_inertial[stars],
        points_px[chosen],
        covariance_px2[chosen] + (catalog_px**2 + blend_px**2)[:, None, None] * np.eye(2),
        camera.model,
        scale=scale_for(len(matches), camera.model, options),
        outlier_sigma=options.outlier_sigma,
        method=options.attitude_method,
    )


def _judged(
    field: StarField,
    matches: Matches,
    solution: AttitudeSolution,
    points_px: Float,
    camera: Camera,
    trials: Callable[[float], float],
    options: StarOptions,
) -> RefinedAttitude | Failure:
    """Ask the last question: how likely are so many matches, that close, by chance."""
    used: Mask = solution.used
    n_used = int(used.sum())
    residuals = points_px[matches.detection_indices[used]] - solution.predicted_px[used]
    gate = max(float(np.linalg.norm(residuals, axis=1).max()), SMALLEST_GATE_PX)
    predicted = _predicted_in_frame(field, camera, solution.camera_from_inertial, gate)
    predicted[int(matches.star_indices.max()) + 1 :] = np.nan
    chance = chance_of_match(predicted, points_px, gate, float(camera.columns * camera.rows))
    n_depths = int(np.isfinite(predicted[:, 0]).sum())
    probability = false_match_probability(n_used, len(points_px), chance, trials(gate) * n_depths)
    if n_used < options.min_matches or probability > options.max_false_match_probability:
        return Failure(
            Reason.AMBIGUOUS,
            f"{n_used} of {len(points_px)} detections match one of {n_depths} stars to {gate:.2g} px; "
            f"chance does that with probability up to {probability:.1e}",
        )
    return RefinedAttitude(
        field=field,
        solution=solution,
        matches=matches,
        n_detections=len(points_px),
        false_match_probability=probability,
    )
