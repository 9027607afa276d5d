"""What comes after single images: passes, filters, covariance analysis, positions from several bodies."""

from giantlike.navigation.limb_modes import limb_waves, wave_amplitudes
from giantlike.navigation.pass_estimator import estimate_pass
from giantlike.navigation.pass_fix import PassFix, TermTest, TimetagJitter, WeakCombination
from giantlike.navigation.pass_images import LimbPoints, MeasuredPosition, NavigationPass, PassImage
from giantlike.navigation.pass_run import RunPass, pass_from_rows, pass_from_run
from giantlike.navigation.pass_terms import PassOptions, PassTerm, Treatment
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
    "LimbPoints",
    "MeasuredPosition",
    "NavigationPass",
    "PassFix",
    "PassImage",
    "PassOptions",
    "PassTerm",
    "RunPass",
    "Sightline",
    "StarEphemeris",
    "TermTest",
    "TimetagJitter",
    "Treatment",
    "TriangulatedPosition",
    "TriangulationMethod",
    "TriangulationOptions",
    "WeakCombination",
    "estimate_pass",
    "limb_waves",
    "locate",
    "pass_from_rows",
    "pass_from_run",
    "position_at_emission",
    "sightline_of_fix",
    "sightline_of_pixel",
    "triangulate",
    "wave_amplitudes",
    "without_aberration",
]
