"""What comes after single images: passes, filters, covariance analysis, positions from several bodies."""

from __future__ import annotations

from giantlike.navigation.sightlines import (
    Sightline,
    StarEphemeris,
    sightline_of_fix,
    sightline_of_pixel,
    without_aberration,
)
from giantlike.navigation.triangulation import (
    TriangulatedPosition,
    TriangulationMethod,
    TriangulationOptions,
    locate,
    position_at_emission,
    triangulate,
)

__all__ = [
    "Sightline",
    "StarEphemeris",
    "TriangulatedPosition",
    "TriangulationMethod",
    "TriangulationOptions",
    "locate",
    "position_at_emission",
    "sightline_of_fix",
    "sightline_of_pixel",
    "triangulate",
    "without_aberration",
]
