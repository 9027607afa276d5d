"""How bright: fluxes of stars at known places, and the zero point of a camera from them."""

from giantlike.core.photometry import Photometry
from giantlike.photometry.fluxes import Fluxes, FluxOptions, measure_fluxes, measure_stars
from giantlike.photometry.zero_point import ZeroPoint, ZeroPointOptions, fit_zero_point

__all__ = [
    "FluxOptions",
    "Fluxes",
    "Photometry",
    "ZeroPoint",
    "ZeroPointOptions",
    "fit_zero_point",
    "measure_fluxes",
    "measure_stars",
]
