"""Observables for orbit determination: what a fix says in inertial axes, with light time and aberration in and out.

``apparent`` removes light time and aberration and gives their derivatives, ``rows`` makes rows of bodies, landmarks and
stars, ``preference`` chooses the fix of a target that a filter should take.
"""

from giantlike.observables.apparent import Removed, apparent_by_position, removed
from giantlike.observables.preference import Preference, preferred
from giantlike.observables.rows import (
    ImageContext,
    LandmarkSeen,
    Sighting,
    StarsSeen,
    row_of_body,
    row_of_landmark,
    rows_of_stars,
)

__all__ = [
    "ImageContext",
    "LandmarkSeen",
    "Preference",
    "Removed",
    "Sighting",
    "StarsSeen",
    "apparent_by_position",
    "preferred",
    "removed",
    "row_of_body",
    "row_of_landmark",
    "rows_of_stars",
]
