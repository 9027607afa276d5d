"""Plans of images before they are taken: what each will show, how well it will do, which to take."""

from giantlike.planning.candidates import Candidate, candidates_from_table, candidates_in_window
from giantlike.planning.drawn import FixForecast, TruthOptions
from giantlike.planning.images import Plan, PlannedImage, PlanOptions, plan_images
from giantlike.planning.light import LightForecast
from giantlike.planning.selection import OrbitPrior, SelectOptions
from giantlike.planning.stars import StarForecast, expect_stars

__all__ = [
    "Candidate",
    "FixForecast",
    "LightForecast",
    "OrbitPrior",
    "Plan",
    "PlanOptions",
    "PlannedImage",
    "SelectOptions",
    "StarForecast",
    "TruthOptions",
    "candidates_from_table",
    "candidates_in_window",
    "expect_stars",
    "plan_images",
]
