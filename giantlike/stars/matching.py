"""Matches of catalog stars and detections in the image plane, and the probability that they are random."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import betainc, rel_entr

from giantlike._system.compiled import compiled
from giantlike.camera import Camera
from giantlike.core.arrays import Float
from giantlike.core.frames import rotate
from giantlike.core.values import Value
from giantlike.stars.field import half_diagonal_px

_MOST_CELLS = 256  # along each axis: cells of a few pixels, and a table of them that stays in the cache
BLEND_PX = 4.0  # distance below which two stars shift each other's centroid, px: five widths of a star of 0.8 px
_SHIFTS = 24  # displacements at which random matches are counted: 24 samples of every detection
_SAMPLES = 2500  # maximum of these: a probability of 1 % is then known to 20 % of itself
_DISTORTION = 0.05  # of the half size of the image: bound on the distortion that a fit of k1 can absorb


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matches(Value):
    """Pairs of a star and a detection, each in at most one pair."""

    star_indices: NDArray[np.intp]  # (k,)
    detection_indices: NDArray[np.intp]  # (k,)
    distance_px: Float  # (k,)

    def __len__(self) -> int:
        return int(self.star_indices.size)


def predicted_in_frame(
    directions_inertial: Float, camera: Camera, camera_from_inertial: Rotation, *, margin_px: float
) -> Float:
    """Pixels (n, 2) of stars (n, 3), NaN for those that fall further than ``margin_px`` outside the image."""
    predicted = camera.model.project(rotate(camera_from_inertial, directions_inertial))
    predicted[~camera.contains(predicted, margin_px=-margin_px)] = np.nan
    return predicted


def match_nearest(predicted_px: Float, points_px: Float, radius_px: float, *, ambiguous_px: float = 0.0) -> Matches:
    """Pair stars (n, 2), NaN if not imaged, and detections (m, 2) that are each other's nearest neighbor."""
    visible = np.flatnonzero(np.isfinite(predicted_px).all(axis=1))
    none = np.zeros(0, dtype=np.intp)
    if visible.size == 0 or len(points_px) == 0:
        return Matches(star_indices=none, detection_indices=none, distance_px=np.zeros(0))
    stars, points_px = (np.array(places, order="C") for places in (predicted_px[visible], points_px))
    reach = radius_px + ambiguous_px
    count = 1 if ambiguous_px == 0.0 else 2  # without it the next nearest do not matter
    to_points, point_of_star = nearest(points_px, stars, count, reach)
    paired = np.flatnonzero(to_points[:, 0] <= radius_px)
    mine, distance = point_of_star[paired, 0], to_points[paired, 0]
    to_stars, star_of_point = nearest(stars, points_px[mine], count, reach)
    good = star_of_point[:, 0] == paired
    if count > 1:
        good &= np.minimum(to_points[paired, 1], to_stars[:, 1]) - distance >= ambiguous_px
    return Matches(star_indices=visible[paired[good]], detection_indices=mine[good], distance_px=distance[good])


def chance_of_match(predicted_px: Float, points_px: Float, radius_px: float, area_px2: float) -> float:
    """Probability that a detection has a random star within ``radius_px``.

    The larger of two estimates: by the mean density of stars, and by the matches after shifting all detections (of
    many, parts) by 24 displacements, which includes the clustering of stars and detections.
    """
    stars = predicted_px[np.isfinite(predicted_px).all(axis=1)]
    if len(stars) == 0 or len(points_px) == 0:
        return 0.0
    uniform = len(stars) * np.pi * radius_px**2 / area_px2
    angles = 2.0 * np.pi * np.arange(_SHIFTS) / _SHIFTS
    steps = radius_px * np.linspace(4.0, 12.0, _SHIFTS)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    moved = (points_px[None] + steps[:, None]).reshape(-1, 2)
    moved = np.ascontiguousarray(moved[:: -(-len(moved) // _SAMPLES)])
    hits = np.isfinite(nearest(np.ascontiguousarray(stars), moved, 1, radius_px)[0]).sum()
    return float(min(1.0, max(uniform, hits / len(moved))))


def false_match_probability(n_matched: int, n_detected: int, chance: float, trials: float) -> float:
    """Bound on the probability that any of ``trials`` wrong attitudes matches this many detections."""
    tail = float(betainc(n_matched, n_detected - n_matched + 1, chance)) if n_matched > 0 else 1.0
    return min(1.0, trials * tail)


def log_chance(n_matched: NDArray[np.intp], n_detected: int, chance: Float) -> Float:
    """Chernoff bound (k,), at most 0, of the logarithm of the binomial tail: finite where the tail underflows."""
    share = n_matched / n_detected
    exponent: Float = -n_detected * (rel_entr(share, chance) + rel_entr(1.0 - share, 1.0 - chance))
    return np.where(share > chance, exponent, 0.0)


def attitudes_of_sky(radius_px: float, camera: Camera, *, scale_error: float = 0.0) -> float:
    """Number of attitudes on the whole sky (times cameras) that move stars by a match radius from each other."""
    directions = 4.0 * np.pi * (camera.model.focal_length_px / radius_px) ** 2
    rolls = max(2.0 * np.pi * half_diagonal_px(camera) / radius_px, 1.0)
    return float(directions * rolls * _cameras(radius_px, camera, scale_error))


def attitudes_within_angle(radius_px: float, camera: Camera, angle_rad: float, *, scale_error: float = 0.0) -> float:
    """Number of attitudes (times cameras) within ``angle_rad`` about every axis, a match radius from each other."""
    directions = max(2.0 * angle_rad * camera.model.focal_length_px / radius_px, 1.0) ** 2
    rolls = max(2.0 * angle_rad * half_diagonal_px(camera) / radius_px, 1.0)
    return float(directions * rolls * _cameras(radius_px, camera, scale_error))


def _cameras(radius_px: float, camera: Camera, scale_error: float) -> float:
    """Number of focal lengths and radial distortions that move the corner of the image by a match radius."""
    scales = max(2.0 * scale_error * half_diagonal_px(camera) / radius_px, 1.0)
    bends = max(2.0 * _DISTORTION * half_diagonal_px(camera) / radius_px, 1.0) if scale_error > 0.0 else 1.0
    return scales * bends


def attitudes_within(radius_px: float, max_pixel_distance: float) -> float:
    """Number of attitudes that move no star by more than ``max_pixel_distance``, a match radius from each other."""
    return max(2.0 * max_pixel_distance / radius_px, 1.0) ** 3


def confusion_px(predicted_px: Float, magnitudes: Float) -> Float:
    """Largest shift (n,) of the centroids of stars (n, 2) by neighbors within ``BLEND_PX``.

    A neighbor of flux ratio q at distance d shifts a blended centroid by d q / (1 + q).
    """
    shift = np.zeros(len(predicted_px))
    visible = np.flatnonzero(np.isfinite(predicted_px).all(axis=1))
    pairs = cKDTree(predicted_px[visible]).query_pairs(BLEND_PX, output_type="ndarray")
    first, second = visible[pairs[:, 0]], visible[pairs[:, 1]]
    distance = np.linalg.norm(predicted_px[first] - predicted_px[second], axis=1)
    share = 1.0 / (1.0 + 10.0 ** (0.4 * (magnitudes[second] - magnitudes[first])))  # of the second in the sum
    np.add.at(shift, first, distance * share)
    np.add.at(shift, second, distance * (1.0 - share))
    return shift


@compiled
def nearest(among_px: Float, of_px: Float, count: int, reach_px: float) -> tuple[Float, NDArray[np.intp]]:
    """Distances (m, count), infinite beyond reach, and indices of the points (n, 2) nearest to others (m, 2)."""
    n = len(among_px)
    (low_x, low_y), (high_x, high_y) = among_px[0], among_px[0]
    for x, y in among_px:
        low_x, high_x = min(low_x, x), max(high_x, x)
        low_y, high_y = min(low_y, y), max(high_y, y)
    side = max((1.0 + 1e-9) * reach_px, max(high_x - low_x, high_y - low_y) / (_MOST_CELLS - 1), 1e-9)
    columns, rows = int((high_x - low_x) / side) + 1, int((high_y - low_y) / side) + 1
    cells = np.empty(n, np.int64)
    first = np.zeros(columns * rows + 1, np.int64)
    for k in range(n):
        cells[k] = int((among_px[k, 1] - low_y) / side) * columns + int((among_px[k, 0] - low_x) / side)
        first[cells[k] + 1] += 1
    for cell in range(columns * rows):
        first[cell + 1] += first[cell]
    filled, members = first[:-1].copy(), np.empty(n, np.int64)
    for k in range(n):
        members[filled[cells[k]]] = k
        filled[cells[k]] += 1
    distance, index = np.full((len(of_px), count), np.inf), np.full((len(of_px), count), n, np.intp)
    for m in range(len(of_px)):
        x, y = of_px[m]
        column, row = math.floor((x - low_x) / side), math.floor((y - low_y) / side)
        for other_row in range(max(row - 1, 0), min(row + 2, rows)):
            for other_column in range(max(column - 1, 0), min(column + 2, columns)):
                cell = other_row * columns + other_column
                for member in range(first[cell], first[cell + 1]):
                    k = members[member]
                    away = math.hypot(among_px[k, 0] - x, among_px[k, 1] - y)
                    if away > reach_px or away > distance[m, count - 1]:
                        continue
                    if away < distance[m, 0] or (away == distance[m, 0] and k < index[m, 0]):
                        for place in range(count - 1, 0, -1):
                            distance[m, place], index[m, place] = distance[m, place - 1], index[m, place - 1]
                        distance[m, 0], index[m, 0] = away, k
                    elif count > 1 and (away < distance[m, 1] or k < index[m, 1]):
                        distance[m, 1], index[m, 1] = away, k
    return distance, index
