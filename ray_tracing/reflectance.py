"""How bright a piece of surface looks, by the directions of the Sun and of the camera.

A law is scaled to 1 at normal incidence and emission and zero phase. Laws come by name from ``REFLECTANCES``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, require
from giantlike.core.errors import InputError


class Reflectance(Protocol):
    """A reflectance law; an immutable value."""

    type_name: ClassVar[str]
    """Name in campaign files."""

    def __call__(self, cos_incidence: ArrayLike, cos_emission: ArrayLike, phase_rad: ArrayLike) -> Float:
        """Brightness relative to normal incidence; 0 where the Sun or the camera is below the horizon.

        Parameters
        ----------
        cos_incidence, cos_emission : (...) float64
            Cosines of the angles from the surface normal to Sun and camera.
        phase_rad : (...) float64, rad
            Angle Sun - surface - camera.
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Lambert:
    """Brightness by the cosine of incidence alone."""

    type_name: ClassVar[str] = "lambert"

    def __call__(self, cos_incidence: ArrayLike, cos_emission: ArrayLike, phase_rad: ArrayLike) -> Float:
        """Return mu0."""
        mu0, _, visible = _cosines(cos_incidence, cos_emission)
        return np.where(visible, mu0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LommelSeeliger:
    """Single scattering in a dark half-space, without a phase function."""

    type_name: ClassVar[str] = "lommel_seeliger"

    def __call__(self, cos_incidence: ArrayLike, cos_emission: ArrayLike, phase_rad: ArrayLike) -> Float:
        """Return 2 mu0 / (mu0 + mu)."""
        mu0, mu, visible = _cosines(cos_incidence, cos_emission)
        return np.where(visible, 2.0 * mu0 / np.where(visible, mu0 + mu, 1.0), 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class McEwen:
    """Mixture of Lommel-Seeliger (at full phase) and Lambert (at large phase).

    ``A 2 mu0 / (mu0 + mu) + (1 - A) mu0`` with ``A = exp(-phase / phase_scale_deg)``.

    Parameters
    ----------
    phase_scale_deg : float, deg
        Phase angle at which the Lommel-Seeliger share has fallen to 1/e.
    """

    type_name: ClassVar[str] = "mcewen"

    phase_scale_deg: float = 60.0

    def __post_init__(self) -> None:
        require(
            math.isfinite(self.phase_scale_deg) and self.phase_scale_deg > 0,
            f"mcewen phase_scale_deg must be > 0, got {self.phase_scale_deg}",
        )

    def __call__(self, cos_incidence: ArrayLike, cos_emission: ArrayLike, phase_rad: ArrayLike) -> Float:
        """Return A 2 mu0 / (mu0 + mu) + (1 - A) mu0."""
        mu0, mu, visible = _cosines(cos_incidence, cos_emission)
        share = np.exp(np.asarray(phase_rad, dtype=np.float64) * (-1.0 / math.radians(self.phase_scale_deg)))
        return np.where(visible, mu0 * (1.0 + share * (2.0 / np.where(visible, mu0 + mu, 1.0) - 1.0)), 0.0)


REFLECTANCES: Mapping[str, type[McEwen | Lambert | LommelSeeliger]] = MappingProxyType(
    {law.type_name: law for law in (McEwen, Lambert, LommelSeeliger)}
)
"""Reflectance laws by the ``model`` they have in campaign files."""


def reflectance_from_mapping(table: Mapping[str, Any]) -> Reflectance:
    """Build a law from a ``reflectance`` table such as ``{"model": "mcewen"}``.

    Raises
    ------
    InputError
        The model or a key is unknown, or a value is no number or out of range.
    """
    values = dict(table)
    name = values.pop("model", None)
    if not isinstance(name, str) or name not in REFLECTANCES:
        raise InputError(f"reflectance model must be one of {', '.join(sorted(REFLECTANCES))}, got {name!r}")
    law = REFLECTANCES[name]
    known = [field.name for field in fields(law)]
    for key, value in values.items():
        if key not in known:
            keys = ", ".join(["model", *known])
            raise InputError(f"reflectance: unknown key {key!r} for model {name!r}; keys are {keys}")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"reflectance: {key} must be a number, got {value!r}")
    return law(**{key: float(value) for key, value in values.items()})


def _cosines(cos_incidence: ArrayLike, cos_emission: ArrayLike) -> tuple[Float, Float, Any]:
    """Both cosines as arrays and where both are above the horizon."""
    mu0, mu = np.asarray(cos_incidence, dtype=np.float64), np.asarray(cos_emission, dtype=np.float64)
    return mu0, mu, (mu0 > 0.0) & (mu > 0.0)
