"""Plans of images before they are taken: what each will show, how well it will do, which to take."""

from giantlike.planning.candidates import Candidate, candidates_from_table, candidates_in_window
from giantlike.planning.images import Plan, PlannedImage, PlanOptions, plan_images
from giantlike.planning.stars import StarForecast, expect_stars

__all__ = [
    "Candidate",
    "Plan",
    "PlanOptions",
    "PlannedImage",
    "StarForecast",
    "candidates_from_table",
    "candidates_in_window",
    "expect_stars",
    "plan_images",
]
