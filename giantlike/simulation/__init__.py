"""Simulated images with their truth, and a whole simulated approach to a small body."""

from giantlike.simulation.approach import ApproachOptions, Visit, demo_camera, plan_approach
from giantlike.simulation.images import simulate_image
from giantlike.simulation.incident import Sources
from giantlike.simulation.shot import Shot
from giantlike.simulation.write import write_approach

__all__ = [
    "ApproachOptions",
    "Shot",
    "Sources",
    "Visit",
    "demo_camera",
    "plan_approach",
    "simulate_image",
    "write_approach",
]
