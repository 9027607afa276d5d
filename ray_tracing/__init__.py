"""Ray tracing: light from the Sun over a body to the camera, and the outline of the body.

``render`` makes a template of a ``Body`` and ``trace_silhouette`` finds its limb.
"""

from giantlike.core.deprecation import forward_names
from giantlike.ray_tracing.backplanes import Backplanes, trace_backplanes
from giantlike.ray_tracing.body import Body
from giantlike.ray_tracing.disk import disk_integrated
from giantlike.ray_tracing.footprint import FocalPlane
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
from giantlike.ray_tracing.render import Template, render
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
    "Silhouette",
    "TabulatedReflectance",
    "Template",
    "UserReflectance",
    "disk_integrated",
    "reflectance_from_mapping",
    "render",
    "trace_backplanes",
    "trace_silhouette",
]

__getattr__ = forward_names(
    __name__,
    {
        "giantlike.ray_tracing.air": "Air Black",
        "giantlike.ray_tracing.cached_trace": "Trace trace_body",
        "giantlike.ray_tracing.disk": "disk_photocenter",
        "giantlike.ray_tracing.near_outline": "outline_brightness render_near",
        "giantlike.ray_tracing.render": "SceneRender render_scene",
        "giantlike.ray_tracing.trace": "surface_albedo",
    },
    until="0.4",
)
