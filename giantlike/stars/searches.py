"""Which detections make patterns with which others, and in what order they are tried."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.stars.index_store import cap_radius_rad
from giantlike.stars.star_index import Pattern, caps

_INSIDE = 0.9  # of the half field of view: caps of the index then lie in the image
_PER_CAP = 16  # detections: a third of the brightest may be false and one in five stars missing
_WIDER = 1.2  # image caps over index caps: a cap of the index lies inside wherever it is
_LEAST = {Pattern.TRIAD: (16, 26), Pattern.QUAD: (16, 22)}  # detections of a narrow image, at first and later
_CAPS_AT_ONCE, _CAPS_AT_MOST = 4, 32


@dataclass(frozen=True, slots=True, eq=False)
class Search(Value):
    """Detections that make patterns, group by group, and the caps of the index to use.

    Groups hold indices of detections, brightest first.
    """

    radius_rad: float
    groups: tuple[NDArray[np.intp], ...]


def searches(vectors: Float, half_fov_rad: float, pattern: Pattern) -> Iterator[Search]:
    """Searches for patterns, the likeliest to succeed first.

    In a narrow image the brightest detections make patterns; then more of them; those of each half (trees, a planet
    or a limb may fill the other); and patterns of other sizes. In a wide image, and for patterns much smaller than it,
    the brightest of every part of the image do, from the middle outwards.

    Parameters
    ----------
    vectors : (m, 3) float64, unitless, camera
        Lines of sight of the detections, brightest first; NaN where the camera sees nothing.
    half_fov_rad : float, rad
        Half the smaller field of view.
    pattern : Pattern
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
        yield Search(radius, tuple(half[:at_first] for half in _halves(vectors, seen)))
    if len(seen) > 2 * later:
        yield from _in_parts(vectors, seen, min(crowded, radius / np.sqrt(2.0)))
    yield Search(cap_radius_rad(2.0 * radius), (seen[:at_first],))


def _halves(vectors: Float, seen: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    x, y = vectors[seen, 0], vectors[seen, 1]
    for half in (x < 0.0, x >= 0.0, y < 0.0, y >= 0.0):
        yield seen[half]


def _in_parts(vectors: Float, seen: NDArray[np.intp], radius_rad: float) -> Iterator[Search]:
    """The brightest detections of caps over the image, some caps at a time, from the middle outwards."""
    if not len(seen):
        return
    reach = np.arccos(np.clip(vectors[seen, 2].min(), -1.0, 1.0))
    centers = caps(radius_rad, (0.0, 0.0, 1.0), reach)
    inside = vectors[seen] @ centers.T >= np.cos(_WIDER * radius_rad)
    groups = [seen[column][:_PER_CAP] for column in inside.T]
    groups = [group for group in groups if len(group) >= 4]
    for start in range(0, min(len(groups), _CAPS_AT_MOST), _CAPS_AT_ONCE):
        yield Search(radius_rad, tuple(groups[start : start + _CAPS_AT_ONCE]))
