"""Simulated images with their truth, and a whole simulated approach to a small body."""

from giantlike.core.deprecation import forward_names
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

__getattr__ = forward_names(
    __name__,
    {
        "giantlike.simulation.approach": "Approach Frame:ApproachFrame",
        "giantlike.simulation.detector": "DetectorModel HotPixels expose",
        "giantlike.simulation.images": "SimulatedImage",
        "giantlike.simulation.incident": "SimulationOptions",
        "giantlike.core.photometry": "Photometry",
        "giantlike.simulation.stars": "StarField:DetectorStars point_sources star_field",
    },
    until="0.4",
)
