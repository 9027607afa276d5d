"""Refinement of a first attitude with all stars of an image: matching, fitting, and a test of random matches."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.processes import one_thread
from giantlike.camera import Camera
from giantlike.camera_models import BrownModel, CameraModel, PinholeModel, ifov_rad
from giantlike.core.arrays import Float
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
    predicted_in_frame,
)
from giantlike.stars.options import StarOptions

_MAX_ROUNDS = 8  # of matching and fitting
_SETTLED = 0.05
"""Largest move of a star by a fit, relative to the match radius, below which stars are not matched again: only matches
at the edge of the radius or ambiguous ones could change, and the fit rejects these."""
_STARS_FOR_FOCAL_LENGTH = 5  # 10 equations for 4 unknowns
_STARS_FOR_RADIAL = 12  # 24 equations for 5 unknowns: k1 needs stars all over the field
SMALLEST_GATE_PX = 0.5
"""Smallest match radius, px, in the probability of random matches: bounds the gain of a lucky close match."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RefinedAttitude(Value):
    """An attitude, its stars, and the probability that their matches are random."""

    field: StarField  # stars that detections could be matched with
    solution: AttitudeSolution  # arrays in the order of ``matches``
    matches: Matches  # indices into the star field and the detections; ``solution.used`` is False for outliers
    n_detections: int  # number of detections that could be matched
    false_match_probability: float  # upper bound of the probability that the matches are random


@one_thread()
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
    """Refine an attitude by alternately matching stars with detections and fitting the matches.

    The number of brightest stars used is the one that makes the matches least likely to be random.
    """
    refinement = _Refinement(field, points_px, covariance_px2, trials, options)
    rotation, radius = camera_from_inertial, radius_px
    solution: AttitudeSolution
    previous: tuple[bytes, bytes] | None = None
    for _ in range(_MAX_ROUNDS):
        predicted = predicted_in_frame(field.directions_inertial, camera, rotation, margin_px=radius)
        matches = significant_matches(predicted, points_px, radius, float(camera.columns * camera.rows))
        if len(matches) < options.min_matches:
            return Failure(
                Reason.TOO_FEW_MATCHES,
                f"{len(matches)} of {len(points_px)} detections match a star to {radius:.3g} px, "
                f"{options.min_matches} are needed",
            )
        now = (matches.star_indices.tobytes(), matches.detection_indices.tobytes())
        if now == previous and radius == options.inlier_px:
            break  # the same stars give the same attitude
        fitted = refinement.fit(matches, predicted, camera)
        if isinstance(fitted, Failure):
            return fitted
        solution, rotation = fitted, fitted.camera_from_inertial
        camera = dataclasses.replace(camera, model=solution.model)
        moved = np.abs(solution.predicted_px - predicted[matches.star_indices]).max()
        if radius == options.inlier_px and moved <= _SETTLED * radius:
            break
        previous, radius = now, options.inlier_px
    return refinement.judge(matches, solution, camera)


def significant_matches(predicted_px: Float, points_px: Float, radius_px: float, area_px2: float) -> Matches:
    """Nearest-neighbor pairs with the number of brightest stars that makes them least likely to be random."""
    matches = match_nearest(predicted_px, points_px, radius_px)
    if len(matches) == 0:
        return matches
    visible = np.flatnonzero(np.isfinite(predicted_px[:, 0]))
    is_matched = np.isin(visible, matches.star_indices)
    chance = np.minimum(np.arange(1, visible.size + 1) * np.pi * radius_px**2 / area_px2, 0.5)
    log_tail = log_chance(np.cumsum(is_matched), len(points_px), chance)
    depth = int(np.argmin(np.where(is_matched, log_tail, np.inf))) + 1
    if depth == visible.size:
        return matches
    limited = np.full_like(predicted_px, np.nan)
    limited[visible[:depth]] = predicted_px[visible[:depth]]
    return match_nearest(limited, points_px, radius_px)


def scaled_model(model: CameraModel, scale: float) -> CameraModel:
    """Scale the focal lengths of a camera model."""
    values = dict(zip(model.parameter_names, model.parameters.tolist(), strict=True))
    values |= {name: values[name] * scale for name in ("fx_px", "fy_px", "skew_px")}
    if isinstance(model, PinholeModel):
        return BrownModel(**values)
    return model.with_parameters(list(values.values()))


def depth_for(n_detections: int) -> int:
    """Number of brightest catalog stars to match with so many detections, of which some are false."""
    return 3 * n_detections + 100


def scale_for(n_matched: int, model: CameraModel, options: StarOptions) -> Scale:
    """Parameters of the camera model that so many stars can determine."""
    if not options.estimate_scale or n_matched < _STARS_FOR_FOCAL_LENGTH:
        return Scale.FIXED
    radial = n_matched >= _STARS_FOR_RADIAL and "k1" in model.parameter_names
    return Scale.RADIAL if radial else Scale.FOCAL_LENGTH


@dataclass(frozen=True, slots=True, eq=False)
class _Refinement(Value):
    """Stars and detections of one image, and the test of random matches."""

    field: StarField
    points_px: Float
    covariance_px2: Float
    trials: Callable[[float], float]
    options: StarOptions

    def fit(self, matches: Matches, predicted_px: Float, camera: Camera) -> AttitudeSolution | Failure:
        """Attitude from matches, each weighted with the errors of centroid, catalog and blended neighbors."""
        stars, points_px = matches.star_indices, self.points_px[matches.detection_indices]
        catalog_px = self.field.sigma_rad[stars] / ifov_rad(camera.model, points_px)
        blend_px = confusion_px(predicted_px, self.field.stars.magnitude)[stars]
        extra_px2 = (catalog_px**2 + blend_px**2)[:, None, None] * np.eye(2)
        return fit_attitude(
            self.field.directions_inertial[stars],
            points_px,
            self.covariance_px2[matches.detection_indices] + extra_px2,
            camera.model,
            scale=scale_for(len(matches), camera.model, self.options),
            outlier_sigma=self.options.outlier_sigma,
            method=self.options.attitude_method,
            uncertain=() if camera.uncertainty is None else camera.uncertainty.estimated,
        )

    def judge(self, matches: Matches, solution: AttitudeSolution, camera: Camera) -> RefinedAttitude | Failure:
        """Refined attitude, or a failure if so many random matches this close are too probable."""
        options, points_px, used = self.options, self.points_px, solution.used
        n_used = int(used.sum())
        residuals = points_px[matches.detection_indices[used]] - solution.predicted_px[used]
        gate = max(float(np.linalg.norm(residuals, axis=1).max()), SMALLEST_GATE_PX)
        predicted = predicted_in_frame(
            self.field.directions_inertial, camera, solution.camera_from_inertial, margin_px=gate
        )
        predicted[int(matches.star_indices.max()) + 1 :] = np.nan
        chance = chance_of_match(predicted, points_px, gate, float(camera.columns * camera.rows))
        n_depths = int(np.isfinite(predicted[:, 0]).sum())
        probability = false_match_probability(n_used, len(points_px), chance, self.trials(gate) * n_depths)
        if n_used < options.min_matches or probability > options.max_false_match_probability:
            return Failure(
                Reason.AMBIGUOUS,
                f"{n_used} of {len(points_px)} detections match one of {n_depths} stars within {gate:.2g} px; "
                f"the probability of this by chance is up to {probability:.1e}",
            )
        return RefinedAttitude(
            field=self.field,
            solution=solution,
            matches=matches,
            n_detections=len(points_px),
            false_match_probability=probability,
        )
