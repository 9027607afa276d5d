"""Ray tracing: light from the Sun over a body to the camera, and the outline of the body.

``render`` makes a template of a ``Body`` and ``trace_silhouette`` finds its limb.
"""

from giantlike.ray_tracing.air import Air, Black
from giantlike.ray_tracing.backplanes import Backplanes, trace_backplanes
from giantlike.ray_tracing.body import Body
from giantlike.ray_tracing.cached_trace import Trace, trace_body
from giantlike.ray_tracing.disk import disk_integrated, disk_photocenter
from giantlike.ray_tracing.footprint import FocalPlane
from giantlike.ray_tracing.near_outline import NearRender, outline_brightness, render_near
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
from giantlike.ray_tracing.render import SceneRender, Template, render, render_scene
from giantlike.ray_tracing.silhouette import Silhouette, trace_silhouette
from giantlike.ray_tracing.trace import surface_albedo

__all__ = [
    "REFLECTANCES",
    "Air",
    "Akimov",
    "Backplanes",
    "Black",
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
    "NearRender",
    "render_near",
    "render_scene",
    "surface_albedo",
    "trace_backplanes",
    "trace_body",
    "trace_silhouette",
]
