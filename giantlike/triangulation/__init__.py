"""Position of the spacecraft from lines of sight to two or more planets, moons or stars."""

from giantlike.triangulation.positions import TriangulatedPosition, TriangulationOptions, locate, triangulate
from giantlike.triangulation.sightlines import Sightline, StarEphemeris, sightline_of_fix, sightline_of_pixel

__all__ = [
    "Sightline",
    "StarEphemeris",
    "TriangulatedPosition",
    "TriangulationOptions",
    "locate",
    "sightline_of_fix",
    "sightline_of_pixel",
    "triangulate",
]
