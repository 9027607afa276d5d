"""Images with truth: bodies and stars through a real camera with noise, and a whole made-up approach."""

from giantlike.simulation.approach import Approach, ApproachOptions, Frame, Visit, demo_camera, plan_approach
from giantlike.simulation.detector import HotPixels, expose
from giantlike.simulation.images import Photometry, Shot, SimulatedImage, SimulationOptions, simulate_image
from giantlike.simulation.stars import StarField, point_sources, star_field
from giantlike.simulation.write import write_approach

__all__ = [
    "Approach",
    "ApproachOptions",
    "Frame",
    "HotPixels",
    "Photometry",
    "Shot",
    "SimulatedImage",
    "SimulationOptions",
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
