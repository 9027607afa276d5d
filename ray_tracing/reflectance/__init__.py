"""Reflectance laws: brightness of a piece of surface by the directions of the Sun and of the camera.

A law is an immutable function of the cosines of incidence and emission and the phase angle, scaled to 1 at normal
incidence and emission and zero phase. Laws come by name from ``REFLECTANCES``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from types import MappingProxyType
from typing import Any

from giantlike.core.errors import InputError
from giantlike.core.tables import checked_table
from giantlike.ray_tracing.reflectance.custom import TabulatedReflectance, UserReflectance
from giantlike.ray_tracing.reflectance.empirical import Akimov, Lambert, LommelSeeliger, LunarLambert, McEwen, Minnaert
from giantlike.ray_tracing.reflectance.hapke import Hapke
from giantlike.ray_tracing.reflectance.law import Reflectance, SurfaceLaw
from giantlike.ray_tracing.reflectance.oren_nayar import OrenNayar

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


REFLECTANCES: Mapping[str, type[SurfaceLaw]] = MappingProxyType(
    {
        law.type_name: law
        for law in (
            McEwen,
            Lambert,
            LommelSeeliger,
            LunarLambert,
            Minnaert,
            Akimov,
            OrenNayar,
            Hapke,
            TabulatedReflectance,
        )
    }
)
"""Reflectance laws by the ``model`` they have in campaign files."""


def reflectance_from_mapping(table: Mapping[str, Any]) -> Reflectance:
    """Build a law from a ``reflectance`` table such as ``{"model": "hapke", "w": 0.1, "theta_bar_deg": 20.0}``.

    Parameters
    ----------
    table : mapping; the ``model`` and its parameters

    Raises
    ------
    InputError
        The model or a key is unknown, a key is missing, or a value is not a number or out of range.
    """
    values = dict(table)
    name = values.pop("model", None)
    if not isinstance(name, str) or name not in REFLECTANCES:
        raise InputError(f"reflectance model must be one of {', '.join(sorted(REFLECTANCES))}, got {name!r}")
    law = REFLECTANCES[name]
    parameters = fields(law)  # type: ignore[arg-type]
    required = [field.name for field in parameters if field.default is MISSING]
    checked_table(values, f"reflectance {name}", [field.name for field in parameters], required)
    return law(**{key: _as_value(value) for key, value in values.items()})


def _as_value(value: Any) -> Any:
    """Convert a value of a file to a parameter of a law: floats, and tuples for lists; the law checks the rest."""
    if isinstance(value, list | tuple):
        return tuple(_as_value(item) for item in value)
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value
