"""Reflectance laws: brightness of a piece of surface by the directions of the Sun and of the camera.

A law is an immutable function of the cosines of incidence and emission and the phase angle, scaled to 1 at normal
incidence and emission and zero phase. Laws come by name from ``REFLECTANCES``.
"""

from giantlike.ray_tracing.reflectance.custom import TabulatedReflectance, UserReflectance
from giantlike.ray_tracing.reflectance.empirical import Akimov, Lambert, LommelSeeliger, LunarLambert, McEwen, Minnaert
from giantlike.ray_tracing.reflectance.hapke import Hapke
from giantlike.ray_tracing.reflectance.law import Reflectance
from giantlike.ray_tracing.reflectance.oren_nayar import OrenNayar
from giantlike.ray_tracing.reflectance.registry import REFLECTANCES, reflectance_from_mapping

__all__ = [
    "REFLECTANCES",
    "Akimov",
    "Hapke",
    "Lambert",
    "LommelSeeliger",
    "LunarLambert",
    "McEwen",
    "Minnaert",
    "OrenNayar",
    "Reflectance",
    "TabulatedReflectance",
    "UserReflectance",
    "reflectance_from_mapping",
]
