"""What all images of a pass share: altitude of the limb, pointing bias, errors of the clock."""

from giantlike.passes.estimator import estimate_pass
from giantlike.passes.fix import PassFix
from giantlike.passes.images import LimbPoints, NavigationPass, PassImage
from giantlike.passes.run import RunPass, pass_from_run
from giantlike.passes.terms import PassOptions, PassTerm
from giantlike.relative.horizon.geometry import Figure

__all__ = [
    "Figure",
    "LimbPoints",
    "NavigationPass",
    "PassFix",
    "PassImage",
    "PassOptions",
    "PassTerm",
    "RunPass",
    "estimate_pass",
    "pass_from_run",
]
