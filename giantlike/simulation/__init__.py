"""Simulated images with their truth, and a whole simulated approach to a small body."""

from giantlike.simulation.approach import Approach, ApproachOptions, Frame, Visit, demo_camera, plan_approach
from giantlike.simulation.detector import DetectorModel, HotPixels, expose
from giantlike.simulation.images import SimulatedImage, simulate_image
from giantlike.simulation.incident import SimulationOptions, Sources
from giantlike.simulation.shot import Photometry, Shot
from giantlike.simulation.stars import StarField, point_sources, star_field
from giantlike.simulation.write import write_approach

__all__ = [
    "Approach",
    "ApproachOptions",
    "DetectorModel",
    "Frame",
    "HotPixels",
    "Photometry",
    "Shot",
    "SimulatedImage",
    "SimulationOptions",
    "Sources",
    "StarField",
    "Visit",
    "demo_camera",
    "expose",
    "plan_approach",
    "point_sources",
    "simulate_image",
    "star_field",
    "write_approach",
]
