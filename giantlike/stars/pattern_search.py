"""Search for patterns of detections in an index of star patterns, and attitudes shared by many of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, Mask, unit
from giantlike.core.values import Value, select_rows
from giantlike.processing.geometry.wahba import davenport_quaternions
from giantlike.stars.star_index import (
    Pattern,
    StarIndex,
    cap_radius_rad,
    caps,
    describe_quads,
    describe_triads,
    hash_rows,
    subsets,
)

_INSIDE = 0.9  # radius of a cap over the half field of view: caps of the index then lie inside the image
_PER_CAP = 16  # detections: a third of the brightest may be false and one in five stars missing
_WIDER = 1.2  # radius of image caps over index caps: some image cap then contains any index cap
_LEAST = {Pattern.TRIAD: (16, 26), Pattern.QUAD: (16, 22)}  # detections of a narrow image, first and second search
_CAPS_AT_ONCE, _CAPS_AT_MOST = 4, 32  # caps of an image searched together, and in all: bounds the time of failures
_NARROWEST = 0.1  # width of a pattern relative to the widest: the relative error of narrower ones is too large


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scope(Value):
    """Tolerances and focal lengths of a search for patterns."""

    tolerance_rad: float  # largest error of the angle between two stars
    half_size_rad: float  # angle from the center of the image to its edge: the lever arm of a roll error
    scales: Float  # (s,); focal lengths to try, relative to the camera's, ascending; a single 1 where it is known


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hypothesis(Value):
    """An attitude shared by several patterns of detections."""

    camera_from_inertial: Rotation  # in directions of the index, without aberration and epoch
    scale: float  # focal length relative to the camera's
    star_ids: NDArray[np.int64]  # (k,); catalog identifiers
    detection_indices: NDArray[np.intp]  # (k,); detections of these stars


@dataclass(frozen=True, slots=True, eq=False)
class PatternCandidates(Value):
    """Patterns (k, size) of detections and of stars of the index that match, attitude (k, 3, 3) and scale of each."""

    detections: NDArray[np.intp]
    stars: NDArray[np.intp]
    matrices: Float
    scales: Float

    def __len__(self) -> int:
        return len(self.matrices)

    def union(self, other: PatternCandidates) -> PatternCandidates:
        """Union with other candidates, each once."""
        both = PatternCandidates(
            np.concatenate([self.detections, other.detections]),
            np.concatenate([self.stars, other.stars]),
            np.concatenate([self.matrices, other.matrices]),
            np.concatenate([self.scales, other.scales]),
        )
        number = hash_rows(np.concatenate([both.detections, both.stars], axis=1))
        return both.select(np.sort(np.unique(number, return_index=True)[1]))

    def select(self, chosen: Mask | NDArray[np.intp]) -> PatternCandidates:
        """Candidates of a mask (k,) or of indices."""
        return select_rows(self, chosen)


def find_candidates(index: StarIndex, vectors: Float, chosen: NDArray[np.intp], scope: Scope) -> PatternCandidates:
    """Match patterns of detections with patterns of the index. ``vectors`` (s, m, 3), camera axes; ``chosen`` (k,)."""
    sets = chosen[subsets(len(chosen), index.pattern.stars)]
    if index.pattern is Pattern.QUAD:
        return _quads(index, vectors, sets, scope)
    return _triads(index, vectors[len(vectors) // 2], sets, scope)


def _triads(index: StarIndex, vectors: Float, triads: NDArray[np.intp], scope: Scope) -> PatternCandidates:
    tolerance = scope.tolerance_rad
    sides, ordered, right_handed = describe_triads(vectors, triads)
    fits = (sides[:, 0] <= index.widest + tolerance) & (sides[:, 0] >= _NARROWEST * index.widest)
    sides, ordered, right_handed = sides[fits], ordered[fits], right_handed[fits]
    asked, found = index.find(sides / index.widest, tolerance / index.widest)
    stars = index.patterns[found].astype(np.intp)
    theirs, _, their_sense = describe_triads(index.directions, stars)
    good = (np.abs(theirs - sides[asked]) <= tolerance).all(axis=1)
    good &= their_sense == right_handed[asked]
    asked, stars = asked[good], stars[good]
    detections = ordered[asked]
    first, second = detections[:, 1], detections[:, 2]  # the ends of the longest side
    matrices = _from_pairs(
        vectors[first], vectors[second], index.directions[stars[:, 1]], index.directions[stars[:, 2]]
    )
    return PatternCandidates(detections, stars, matrices, np.ones(len(stars)))


def _quads(index: StarIndex, vectors: Float, quads: NDArray[np.intp], scope: Scope) -> PatternCandidates:
    middle = vectors[len(vectors) // 2]
    codes, ordered, _ = describe_quads(middle, quads)
    base = np.linalg.norm(middle[ordered[:, 0]] - middle[ordered[:, 1]], axis=1)
    low, high = scope.scales[0], scope.scales[-1]
    fits = (base <= index.widest * high) & (base >= _NARROWEST * index.widest * low)
    codes, ordered, base = codes[fits], ordered[fits], base[fits]
    tolerance = min(2.0 * scope.tolerance_rad / index.widest, 0.03)  # of the codes, for the widest quads
    asked, found = index.find(codes, tolerance)
    stars = index.patterns[found].astype(np.intp)
    ends = index.directions[stars[:, :2]]
    scale = base[asked] / np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    edge = scope.tolerance_rad / np.maximum(base[asked], 1e-12)
    good = (scale >= low * (1.0 - edge)) & (scale <= high * (1.0 + edge))
    asked, stars, scale = asked[good], stars[good], scale[good]
    theirs, again, which = describe_quads(index.directions, stars)
    same = (again == stars[which]).all(axis=1) & (np.abs(theirs - codes[asked[which]]) <= tolerance).all(axis=1)
    keep = which[same]
    asked, stars, scale = asked[keep], stars[keep], scale[keep]
    detections = ordered[asked]
    node = np.abs(scope.scales[None] - scale[:, None]).argmin(axis=1)
    seen = vectors[node[:, None], detections[:, :2]]
    matrices = _from_pairs(seen[:, 0], seen[:, 1], *np.swapaxes(index.directions[stars[:, :2]], 0, 1))
    return PatternCandidates(detections, stars, matrices, scale)


def _from_pairs(b1: Float, b2: Float, a1: Float, a2: Float) -> Float:
    """Rotations (k, 3, 3) that take a1 + a2 and a2 - a1 to b1 + b2 and b2 - b1, unit vectors (k, 3)."""
    frames = []
    for first, second in ((b1, b2), (a1, a2)):
        along, across = unit(first + second), unit(second - first)
        frames.append(np.stack([along, across, np.cross(along, across)], axis=-1))
    return np.asarray(frames[0] @ np.swapaxes(frames[1], 1, 2))


def hypotheses(
    candidates: PatternCandidates, index: StarIndex, vectors: Float, scope: Scope, *, least: int
) -> Iterator[Hypothesis]:
    """Attitudes shared by candidates, most candidates first, lazily, each with four stars or more."""
    if len(candidates) == 0:
        return
    size = np.tan(min(scope.half_size_rad, 1.2))
    places = [candidates.matrices[:, 2], size * candidates.matrices[:, 0]]
    if len(scope.scales) > 1:
        places.append(size * np.log(candidates.scales)[:, None])
    tree = cKDTree(np.concatenate(places, axis=1))
    reach = 2.0 * scope.tolerance_rad
    votes = np.asarray(tree.query_ball_point(tree.data, reach, return_length=True), dtype=np.intp)
    taken = np.zeros(len(votes), dtype=bool)
    for peak in np.argsort(-votes, kind="stable"):
        if votes[peak] < least:
            return
        if taken[peak]:
            continue
        members = np.asarray(tree.query_ball_point(tree.data[peak], reach), dtype=np.intp)
        taken[members] = True
        shared = _pair_stars(candidates, members, index, vectors, scope)
        if len(shared.star_ids) > 3:
            yield shared


def _pair_stars(
    candidates: PatternCandidates, members: NDArray[np.intp], index: StarIndex, vectors: Float, scope: Scope
) -> Hypothesis:
    """One-to-one pairs of stars and detections from candidates that agree, and the attitude of all pairs."""
    n = len(index.ids)
    pair, count = np.unique(candidates.detections[members] * n + candidates.stars[members], return_counts=True)
    pair = pair[np.argsort(-count, kind="stable")]
    detection, star = pair // n, pair % n
    of_detection, of_star = (np.unique(one, return_index=True)[1] for one in (detection, star))  # the most frequent
    strongest = np.intersect1d(of_detection, of_star)
    detection, star = detection[strongest], star[strongest]
    scale = float(np.median(candidates.scales[members]))
    seen = vectors[int(np.abs(scope.scales - scale).argmin()), detection]
    return Hypothesis(
        camera_from_inertial=Rotation.from_quat(davenport_quaternions(index.directions[star], seen)),
        scale=scale,
        star_ids=index.ids[star],
        detection_indices=detection,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Search(Value):
    """Groups of detections that form patterns, and the radius of the caps of the index to use."""

    radius_rad: float
    groups: tuple[NDArray[np.intp], ...]  # tuple of (k,); indices of detections, brightest first


def searches(vectors: Float, half_fov_rad: float, pattern: Pattern) -> Iterator[Search]:
    """Searches for patterns of detections (m, 3), camera axes or NaN, the most likely to succeed first.

    In a narrow image the brightest detections form patterns; then more of them; detections of each half (trees, a
    planet or a limb may fill the other); and patterns of other sizes. In a wide image, and for patterns much smaller
    than it, the brightest detections of each part of the image form patterns, from the center outwards.
    """
    seen = np.flatnonzero(np.isfinite(vectors).all(axis=1))
    at_first, later = _LEAST[pattern]
    radius = cap_radius_rad(_INSIDE * half_fov_rad)
    crowded = cap_radius_rad(half_fov_rad * np.sqrt(_PER_CAP / max(len(seen), 1)))
    if radius < 0.6 * half_fov_rad:  # the widest caps there are cover little of the image
        yield from _in_parts(vectors, seen, min(radius, crowded))
        yield from _in_parts(vectors, seen, radius)
        return
    yield Search(radius, (seen[:at_first],))
    if len(seen) > at_first:
        yield Search(radius, (seen[:later],))
        x, y = vectors[seen, 0], vectors[seen, 1]
        yield Search(radius, tuple(seen[half][:at_first] for half in (x < 0.0, x >= 0.0, y < 0.0, y >= 0.0)))
    if len(seen) > 2 * later:
        yield from _in_parts(vectors, seen, min(crowded, radius / np.sqrt(2.0)))
    yield Search(cap_radius_rad(2.0 * radius), (seen[:at_first],))


def _in_parts(vectors: Float, seen: NDArray[np.intp], radius_rad: float) -> Iterator[Search]:
    """Searches of the brightest detections in caps of the image, several caps at a time, from the center outwards."""
    if not len(seen):
        return
    reach = np.arccos(np.clip(vectors[seen, 2].min(), -1.0, 1.0))
    centers = caps(radius_rad, (0.0, 0.0, 1.0), reach)
    inside = vectors[seen] @ centers.T >= np.cos(_WIDER * radius_rad)
    groups = [seen[column][:_PER_CAP] for column in inside.T]
    groups = [group for group in groups if len(group) >= 4]
    for start in range(0, min(len(groups), _CAPS_AT_MOST), _CAPS_AT_ONCE):
        yield Search(radius_rad, tuple(groups[start : start + _CAPS_AT_ONCE]))
