"""Ray tracing: how light gets from the Sun over a body to the camera, and where the body's outline lies.

``Body`` is what is seen; ``render`` makes a template of it and ``trace_silhouette`` finds its limb.
"""

from giantlike.ray_tracing.backplanes import Backplanes, trace_backplanes
from giantlike.ray_tracing.body import Body
from giantlike.ray_tracing.cached_trace import Trace, trace_body
from giantlike.ray_tracing.disk import disk_integrated, disk_photocenter
from giantlike.ray_tracing.footprint import FocalPlane
from giantlike.ray_tracing.near_outline import outline_brightness, render_near
from giantlike.ray_tracing.options import RenderOptions
from giantlike.ray_tracing.reflectance import (
    REFLECTANCES,
    Akimov,
    Hapke,
    Lambert,
    LommelSeeliger,
    LunarLambert,
    McEwen,
    Minnaert,
    OrenNayar,
    Reflectance,
    TabulatedReflectance,
    UserReflectance,
    reflectance_from_mapping,
)
from giantlike.ray_tracing.render import render
from giantlike.ray_tracing.scene_render import SceneRender, render_scene
from giantlike.ray_tracing.shade import Template
from giantlike.ray_tracing.silhouette import Silhouette, trace_silhouette

__all__ = [
    "REFLECTANCES",
    "Akimov",
    "Backplanes",
    "Body",
    "FocalPlane",
    "Hapke",
    "Lambert",
    "LommelSeeliger",
    "LunarLambert",
    "McEwen",
    "Minnaert",
    "OrenNayar",
    "Reflectance",
    "RenderOptions",
    "SceneRender",
    "Silhouette",
    "TabulatedReflectance",
    "Template",
    "Trace",
    "UserReflectance",
    "disk_integrated",
    "disk_photocenter",
    "outline_brightness",
    "reflectance_from_mapping",
    "render",
    "render_near",
    "render_scene",
    "trace_backplanes",
    "trace_body",
    "trace_silhouette",
]
