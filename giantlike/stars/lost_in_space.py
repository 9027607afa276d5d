"""Star identification without an a priori attitude.

tetra3rs proposes attitudes from patterns of four stars; whether one of them is right is decided here, by
matching and fitting all stars of the image with our own catalogue and camera model.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import tetra3rs
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel, CameraModel, PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.outcomes import Failure, Reason
from giantlike.stars.field import Sky
from giantlike.stars.matching import attitudes_of_sky
from giantlike.stars.options import StarOptions
from giantlike.stars.pattern_database import MAX_FOV_DEG, MIN_FOV_DEG, pattern_database
from giantlike.stars.refine import RefinedAttitude, refine_attitude

_MATCH_RADIUS = 0.01  # of the field of view, in tetra3rs
_MATCH_THRESHOLD = 1e-3  # candidates may be weak: each is verified here
_MAX_PATTERNS = 2_000_000
_MANY_PATTERN_STARS = _BRIGHTEST = 40
_DISTORTED_EDGE_ERROR = 0.004  # ratio of pattern edges: a k1 of -0.4 over 14 degrees does so much
_HALF_EDGE_ERROR = 0.002
_FIRST_RADIUS = 0.008  # of the image width: distortion that a pinhole of the right focal length leaves
_SAME_SCALE = 0.005
_MARGIN = 1.3  # of the frame in which patterns are looked for: distorted images reach over it


@dataclass(frozen=True, slots=True, kw_only=True)
class PatternCandidate:
    """An attitude that a pattern of stars suggests.

    Parameters
    ----------
    camera_from_inertial : Rotation
        Single precision.
    scale : float
        Focal length that fits, over that of the camera.
    mirrored : bool
        It holds for the image with its columns reversed.
    """

    camera_from_inertial: Rotation
    scale: float
    mirrored: bool


def identify_lost_in_space(
    points_px: Float, covariance_px2: Float, camera: Camera, sky: Sky, *, options: StarOptions
) -> RefinedAttitude | Failure:
    """Find the attitude of an image anywhere on the sky.

    Parameters
    ----------
    points_px, covariance_px2 : (m, 2), (m, 2, 2) float64
        Detections, brightest first.
    camera : Camera
        With ``options.estimate_scale`` only its field of view matters, to ``options.scale_error``.
    sky : Sky
    options : StarOptions

    Returns
    -------
    RefinedAttitude or Failure
        Reasons: fov_mismatch (out of range, or stars fit another focal length), too_few_detections,
        no_pattern_match, mirrored_image.
    """
    fov_deg = _pattern_fov_deg(camera)
    if fov_deg < MIN_FOV_DEG:
        return Failure(
            Reason.FOV_MISMATCH,
            f"lost-in-space identification works for fields of view from {MIN_FOV_DEG:g} degrees, "
            f"this camera has {fov_deg:.3g}: give an a priori attitude",
        )
    needed = max(options.min_matches, 4)
    if len(points_px) < needed:
        return Failure(Reason.TOO_FEW_DETECTIONS, f"{len(points_px)} detections, {needed} are needed")
    refuted = 0
    for candidate in pattern_candidates(points_px, camera, sky, options=options):
        outcome = _verify(candidate, points_px, covariance_px2, camera, sky, options)
        if isinstance(outcome, RefinedAttitude) or outcome.reason in (Reason.MIRRORED_IMAGE, Reason.FOV_MISMATCH):
            return outcome
        refuted += 1
    return Failure(
        Reason.NO_PATTERN_MATCH,
        f"no pattern of {len(points_px)} detections is found on the sky at a field of view of {camera.fov_deg:.4g} "
        f"degrees to {100 * options.scale_error:.3g} % ({refuted} candidates were tried and refuted)",
    )


def pattern_candidates(
    points_px: Float, camera: Camera, sky: Sky, *, options: StarOptions
) -> Iterator[PatternCandidate]:
    """Attitudes that tetra3rs finds from the brightest detections, in several attempts, lazily.

    All detections with tight and with loose tolerance on the shape of patterns (an unknown lens distorts them),
    those of each half of the image (trees, a planet or a limb may fill the other), the brightest alone (hundreds
    of hot pixels drown a few stars), and patterns from more of all.

    Parameters
    ----------
    points_px : (m, 2) float64, px
        Detections, brightest first.
    camera : Camera
    sky : Sky
    options : StarOptions
    """
    fov_deg = _pattern_fov_deg(camera)
    plane = _undistorted_px(points_px, camera, fov_deg)
    width = 2.0 * camera.model.focal_length_px * math.tan(math.radians(fov_deg) / 2.0)
    database = pattern_database(fov_deg)
    for attempt in _attempts(points_px, camera):
        subset = plane[attempt.chosen & np.isfinite(plane).all(axis=1)]
        if len(subset) < 4:
            continue
        brightness = np.arange(len(subset), 0, -1.0)  # only the order counts
        result = database.solve_from_centroids(
            np.column_stack([subset, brightness]),
            fov_estimate_deg=fov_deg,
            image_width=round(width),
            image_height=round(width * camera.rows / camera.columns),
            fov_max_error_deg=fov_deg * options.scale_error,
            match_radius=_MATCH_RADIUS,
            match_threshold=_MATCH_THRESHOLD,
            solve_timeout_ms=None,  # bounded by work, so that slow machines find the same
            max_patterns_checked=_MAX_PATTERNS,
            pattern_checking_stars=attempt.pattern_stars,
            match_max_error=attempt.edge_error,
            observer_velocity_km_s=None if sky.observer_velocity_km_s is None else list(sky.observer_velocity_km_s),
        )
        if isinstance(result, tetra3rs.SolveResult):
            focal = round(width) / (2.0 * math.tan(math.radians(result.fov_deg) / 2.0))
            yield PatternCandidate(
                camera_from_inertial=Rotation.from_matrix(result.rotation_matrix_icrs_to_camera),
                scale=focal / camera.model.focal_length_px,
                mirrored=result.parity_flip,
            )


def scaled_model(model: CameraModel, scale: float) -> CameraModel:
    """The model with its focal lengths times ``scale``; a pinhole as a Brown model, whose ``k1`` can be estimated."""
    values = dict(zip(model.parameter_names, model.parameters.tolist(), strict=True))
    values |= {name: values[name] * scale for name in ("fx_px", "fy_px", "skew_px")}
    if isinstance(model, PinholeModel):
        return BrownModel(**values)
    return model.with_parameters(list(values.values()))


@dataclass(frozen=True, slots=True)
class _Attempt:
    """Which detections form patterns, how many of them, and how far edge ratios may be off."""

    chosen: NDArray[np.bool_]
    pattern_stars: int = 24
    edge_error: float | None = None  # None: that of the database, 0.001


def _attempts(points_px: Float, camera: Camera) -> Iterator[_Attempt]:
    everything = np.ones(len(points_px), dtype=bool)
    yield _Attempt(everything)
    yield _Attempt(everything, edge_error=_DISTORTED_EDGE_ERROR)
    x, y = points_px.T
    middle_x, middle_y = camera.center_px
    for half in (x < middle_x, x >= middle_x, y < middle_y, y >= middle_y):
        yield _Attempt(half, edge_error=_HALF_EDGE_ERROR)
    yield _Attempt(everything & (np.arange(len(points_px)) < _BRIGHTEST))
    yield _Attempt(everything, pattern_stars=_MANY_PATTERN_STARS)


def _pattern_fov_deg(camera: Camera) -> float:
    """Field of view along x in which patterns are looked for, degrees: what the lens sees, or the inner part of it."""
    middle = camera.center_px[1]
    left, right = camera.model.unproject([[-0.5, middle], [camera.columns - 0.5, middle]])
    seen = math.degrees(math.acos(float(np.clip(left @ right, -1.0, 1.0))))
    return min(seen, MAX_FOV_DEG) if math.isfinite(seen) else MAX_FOV_DEG


def _undistorted_px(points_px: Float, camera: Camera, fov_deg: float) -> Float:
    """Where a pinhole of the same focal length would see the detections, from its principal point (m, 2).

    NaN well outside the field of view asked for, and of what lies behind the camera.
    """
    vectors = camera.model.unproject(points_px)
    depth = np.where(vectors[:, 2] > 0, vectors[:, 2], np.nan)[:, None]
    plane = vectors[:, :2] / depth
    half = math.tan(math.radians(fov_deg) / 2.0) * max(1.0, camera.rows / camera.columns)
    inside = np.abs(plane).max(axis=1) <= _MARGIN * half
    result: Float = np.where(inside[:, None], plane * camera.model.focal_length_px, np.nan)
    return result


def _verify(
    candidate: PatternCandidate,
    points_px: Float,
    covariance_px2: Float,
    camera: Camera,
    sky: Sky,
    options: StarOptions,
) -> RefinedAttitude | Failure:
    points, covariance = points_px, covariance_px2
    if candidate.mirrored:
        flip = np.array([-1.0, 1.0])
        points = points_px * flip + np.array([2.0 * camera.center_px[0], 0.0])
        covariance = covariance_px2 * np.outer(flip, flip)
    if options.estimate_scale:
        camera = dataclasses.replace(camera, model=scaled_model(camera.model, candidate.scale))
    outcome = _refine(candidate, points, covariance, camera, sky, options)
    if isinstance(outcome, RefinedAttitude) and candidate.mirrored:
        return Failure(
            Reason.MIRRORED_IMAGE,
            f"{len(outcome.matches)} stars match the image with its columns reversed: "
            "check how it was read or which way its axes go",
        )
    if isinstance(outcome, Failure) and not options.estimate_scale and abs(candidate.scale - 1.0) > _SAME_SCALE:
        free = dataclasses.replace(options, estimate_scale=True)
        other = _verify(candidate, points_px, covariance_px2, camera, sky, free)
        if isinstance(other, RefinedAttitude):
            fov = math.degrees(2.0 * math.atan(camera.columns / 2.0 / other.solution.model.focal_length_px))
            return Failure(
                Reason.FOV_MISMATCH,
                f"stars fit a field of view of {fov:.5g} degrees, the camera model has {camera.fov_deg:.5g}",
            )
    return outcome


def _refine(
    candidate: PatternCandidate,
    points_px: Float,
    covariance_px2: Float,
    camera: Camera,
    sky: Sky,
    options: StarOptions,
) -> RefinedAttitude | Failure:
    focal, half = camera.model.focal_length_px, float(np.hypot(camera.columns, camera.rows)) / 2.0
    scale_error = options.scale_error if options.estimate_scale else 0.0
    return refine_attitude(
        sky.field(camera, candidate.camera_from_inertial).brightest(depth_for(len(points_px))),
        points_px,
        covariance_px2,
        camera,
        candidate.camera_from_inertial,
        radius_px=max(options.inlier_px, _FIRST_RADIUS * camera.columns),
        trials=lambda radius_px: attitudes_of_sky(radius_px, focal, half, scale_error),
        options=options,
    )


def depth_for(n_detections: int) -> int:
    """How many catalogue stars, brightest first, to hold against so many detections."""
    return 3 * n_detections + 100
