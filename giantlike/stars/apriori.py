"""Star identification with an a priori attitude: nearest neighbors and RANSAC."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from giantlike._system.processes import one_thread
from giantlike.camera import Camera
from giantlike.core.arrays import Float
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.processing.geometry.wahba import davenport_quaternions
from giantlike.stars.field import half_diagonal_px
from giantlike.stars.matching import (
    Matches,
    attitudes_within,
    chance_of_match,
    false_match_probability,
    match_nearest,
    predicted_in_frame,
)
from giantlike.stars.options import StarOptions

_SAMPLE = 4  # stars of a random sample, as in the paper: two fix an attitude, four show a wrong pair among them
_RANSAC_PAIRS = 128
"""Maximum number of pairs, of all brightnesses, from which random samples are drawn and by which they are scored. An
attitude is found where a quarter of the pairs are correct, 32 of these."""
_RANSAC_CHUNK = 50  # samples tried at a time
_RANSAC_MISSED = 4e-9
"""Probability that every sample so far holds a wrong pair, if as many are correct as agree with the best; below it
sampling stops. It is the value for all 300 where half of the pairs are wrong (``StarOptions.ransac_iterations``)."""
_VOTING_STARS, _VOTING_POINTS = 150, 100  # brightest stars and detections that vote for a common shift; bounds its time


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Identification(Value):
    """Attitude and matches found with an a priori attitude."""

    camera_from_inertial: Rotation  # attitude accurate enough for matching; the stars are not yet weighted
    matches: Matches  # indices into the stars and detections that were given
    false_match_probability: float  # upper bound of the probability that the matches are random


@one_thread()
def identify_apriori(
    directions_inertial: Float,
    points_px: Float,
    camera: Camera,
    camera_from_inertial: Rotation,
    *,
    options: StarOptions,
) -> Identification | Failure:
    """Identify stars near where an a priori attitude predicts them.

    Predict, pair nearest neighbors, drop distant and ambiguous pairs, solve for the attitude of random samples of four
    and keep the one with most inliers (on a tie: the smaller sum of squares). If that fails, the shift shared by most
    star-detection pairs within ``max_pixel_distance`` is subtracted and the steps are repeated. Shifts are compared
    first to ``inlier_px`` (for crowded fields), then to the spread that an error of roll gives them.

    ``directions_inertial`` (n, 3), apparent, and ``points_px`` (m, 2): brightest first.

    Source: Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, Matching Potential
    Stars with Known Stars From a Star Catalog, steps 1-10.
    """
    predicted = predicted_in_frame(
        directions_inertial, camera, camera_from_inertial, margin_px=options.max_pixel_distance
    )
    near = np.flatnonzero(np.isfinite(predicted[:, 0]))
    if near.size < options.min_matches:
        return Failure(
            Reason.NO_CATALOG_STARS, f"{near.size} catalog stars in the field of view, {options.min_matches} are needed"
        )
    if len(points_px) < options.min_matches:
        return Failure(Reason.TOO_FEW_DETECTIONS, f"{len(points_px)} detections, {options.min_matches} are needed")
    # a rotation of the camera moves stars alike but for roll, which moves the corners most
    spread = options.inlier_px + options.max_pixel_distance * half_diagonal_px(camera) / camera.model.focal_length_px
    voters, points = predicted[near[:_VOTING_STARS]], points_px[:_VOTING_POINTS]
    outcome = _identify_shifted(directions_inertial, points_px, camera, predicted, spread, options)
    for radius in (min(options.inlier_px, spread), spread):
        if isinstance(outcome, Failure):
            shift = common_shift_px(voters, points, options.max_pixel_distance, radius)
            outcome = _identify_shifted(directions_inertial, points_px, camera, predicted + shift, spread, options)
    return outcome


def _identify_shifted(
    directions_inertial: Float,
    points_px: Float,
    camera: Camera,
    predicted_px: Float,
    spread_px: float,
    options: StarOptions,
) -> Identification | Failure:
    """Identify by steps 3-10 from predicted pixels (n, 2), NaN for stars far outside the image."""
    radius = options.inlier_px + spread_px
    pairs = match_nearest(predicted_px, points_px, radius, ambiguous_px=options.inlier_px)
    if len(pairs) < options.min_matches:
        return Failure(
            Reason.TOO_FEW_MATCHES,
            f"{len(pairs)} of {len(points_px)} detections pair with a star within {options.max_pixel_distance:g} px of "
            f"its place by the a priori attitude, {options.min_matches} are needed",
        )
    rotation, n_inliers = ransac_attitude(
        directions_inertial[pairs.star_indices], points_px[pairs.detection_indices], camera, options
    )
    if n_inliers < options.min_matches:
        return Failure(
            Reason.TOO_FEW_MATCHES,
            f"the best of {options.ransac_iterations} samples agrees with {n_inliers} of {len(pairs)} pairs to "
            f"{options.inlier_px:g} px, {options.min_matches} are needed",
        )
    return _verify(directions_inertial, points_px, camera, rotation, options)


def common_shift_px(predicted_px: Float, points_px: Float, max_distance_px: float, spread_px: float) -> Float:
    """Shift (2,) shared by most pairs of a predicted star (n, 2) and a detection (m, 2); zero if no pair is close."""
    tree, other = cKDTree(points_px), cKDTree(predicted_px)
    pairs = tree.sparse_distance_matrix(other, max_distance_px, output_type="ndarray")
    if pairs.size == 0:
        return np.zeros(2)
    displacements = points_px[pairs["i"]] - predicted_px[pairs["j"]]
    tree = cKDTree(displacements)
    votes = tree.query_ball_point(displacements, spread_px, return_length=True)
    most = np.flatnonzero(votes == votes.max())
    center = displacements[most[np.argmin(np.sum(displacements[most] ** 2, axis=1))]]
    shift: Float = displacements[tree.query_ball_point(center, spread_px)].mean(axis=0)
    return shift


def ransac_attitude(
    directions_inertial: Float, points_px: Float, camera: Camera, options: StarOptions
) -> tuple[Rotation, int]:
    """Attitude of the random sample of four of k pairs that agrees with most pairs (RANSAC), and their number."""
    vectors_camera = camera.model.unproject(points_px)
    seen = np.isfinite(vectors_camera).all(axis=1)
    directions, vectors, points = directions_inertial[seen], vectors_camera[seen], points_px[seen]
    size = min(_SAMPLE, len(points))
    if size < 2:
        return Rotation.identity(), 0
    if len(points) > _RANSAC_PAIRS:
        some = np.linspace(0, len(points) - 1, _RANSAC_PAIRS).astype(np.intp)
        directions, vectors, points = directions[some], vectors[some], points[some]
    rng = np.random.default_rng(options.seed)
    most, least, chosen = -1, np.inf, np.zeros(len(points), dtype=bool)
    for tried in range(0, options.ransac_iterations, _RANSAC_CHUNK):
        count = min(_RANSAC_CHUNK, options.ransac_iterations - tried)
        samples = np.argpartition(rng.random((count, len(points))), size - 1, axis=1)[:, :size]
        rotations = Rotation.from_quat(davenport_quaternions(directions[samples], vectors[samples]))
        predicted = camera.model.project(directions @ rotations.as_matrix().swapaxes(1, 2))
        squares = np.sum((predicted - points) ** 2, axis=-1)
        inside = squares <= options.inlier_px**2  # NaN compares false
        counts = inside.sum(axis=1)
        costs = np.where(inside, squares, 0.0).sum(axis=1)
        best = int(np.lexsort((costs, -counts))[0])
        if (-counts[best], costs[best]) < (-most, least):
            most, least, chosen, rotation = int(counts[best]), float(costs[best]), inside[best], rotations[best]
        if (1.0 - (most / len(points)) ** size) ** (tried + count) < _RANSAC_MISSED:
            break
    if most < 2:
        return rotation, most
    return Rotation.from_quat(davenport_quaternions(directions[chosen], vectors[chosen])), most


def _verify(
    directions_inertial: Float, points_px: Float, camera: Camera, rotation: Rotation, options: StarOptions
) -> Identification | Failure:
    """Match all stars with an attitude, and refuse it if the matches may be random."""
    predicted = predicted_in_frame(directions_inertial, camera, rotation, margin_px=options.inlier_px)
    matches = match_nearest(predicted, points_px, options.inlier_px)
    area = float(camera.columns * camera.rows)
    chance = chance_of_match(predicted, points_px, options.inlier_px, area)
    trials = attitudes_within(options.inlier_px, options.max_pixel_distance)
    probability = false_match_probability(len(matches), len(points_px), chance, trials)
    if len(matches) < options.min_matches or probability > options.max_false_match_probability:
        return Failure(
            Reason.AMBIGUOUS,
            f"{len(matches)} of {len(points_px)} detections match one of {int(np.isfinite(predicted[:, 0]).sum())} "
            f"stars within {options.inlier_px:g} px; the probability of this by chance is up to {probability:.1e}",
        )
    return Identification(camera_from_inertial=rotation, matches=matches, false_match_probability=probability)
