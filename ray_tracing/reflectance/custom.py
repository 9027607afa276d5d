"""Laws that a user brings: a function, or a table of brightness over the three angles."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_floats, require
from giantlike.ray_tracing.reflectance.law import SurfaceLaw, checked_numbers


@dataclass(frozen=True, slots=True, kw_only=True)
class UserReflectance(SurfaceLaw):
    """A law that a function gives.

    Parameters
    ----------
    function : callable
        From arrays (n,) of the cosines of incidence and emission (both > 0) and of the phase angle, rad, to brightness
        (n,), finite and not negative. A function of a module, where bodies go to other processes.
    name : str; name in the provenance

    Raises
    ------
    InputError
        The function is not > 0 at normal incidence and emission and zero phase; when called, that it gave another
        shape, or values that are negative or not finite.

    Notes
    -----
    Scaled by its value at normal incidence and emission and zero phase. Neither reciprocity nor smoothness is checked.
    Campaign files have :class:`TabulatedReflectance` instead.

    Examples
    --------
    >>> import numpy as np
    >>> law = UserReflectance(function=lambda mu0, mu, phase_rad: 3.0 * mu0 * np.exp(-phase_rad), name="mine")
    >>> float(law(0.5, 1.0, 0.0))
    0.5
    """

    type_name: ClassVar[str] = "user"

    function: Callable[[Float, Float, Float], ArrayLike] = field(repr=False)
    name: str

    def __post_init__(self) -> None:
        require(callable(self.function), f"reflectance {self.name}: function must be callable")
        self._scale()

    def above_horizon(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        return self._values(mu0, mu, phase_rad) / self._scale()

    def _scale(self) -> float:
        scale = float(self._values(np.ones(1), np.ones(1), np.zeros(1))[0])
        require(scale > 0.0, f"reflectance {self.name}: function must be > 0 at cosines 1 and phase 0")
        return scale

    def _values(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        values = np.asarray(self.function(mu0, mu, phase_rad), dtype=np.float64)
        require(
            values.shape == mu0.shape and bool(np.all(np.isfinite(values) & (values >= 0.0))),
            f"reflectance {self.name}: function must give finite values >= 0 {mu0.shape}, got {values.shape}",
        )
        return values


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class TabulatedReflectance(SurfaceLaw):
    """Brightness in a table over incidence, emission and phase, linear between its entries.

    Parameters
    ----------
    incidence_deg, emission_deg, phase_deg : tuple of float, deg; nodes, increasing from 0; the last holds beyond
    values : tuple of tuple of tuple of float
        ``values[i][j][k]`` at incidence i, emission j and phase k, >= 0; any unit, since the law is scaled by
        ``values[0][0][0]``. Entries that no geometry has (phase over the sum or under the difference of the other two)
        are used between real ones, so they need sensible values.

    Raises
    ------
    InputError
        A list is not increasing from 0, the shapes disagree, or a value is negative or not finite.

    Notes
    -----
    Continuous with kinks at the entries. Nothing makes it reciprocal but the table. ``repr``, which goes into
    provenance, has a hash instead of the values.
    """

    type_name: ClassVar[str] = "table"

    incidence_deg: tuple[float, ...]
    emission_deg: tuple[float, ...]
    phase_deg: tuple[float, ...]
    values: tuple[tuple[tuple[float, ...], ...], ...]

    def __post_init__(self) -> None:
        for name in ("incidence_deg", "emission_deg", "phase_deg"):
            axis = checked_numbers("table", name, getattr(self, name))
            increasing = axis[0] == 0.0 and all(b > a for a, b in pairwise(axis))
            require(len(axis) > 1 and increasing, f"reflectance table: {name} must increase from 0, got {list(axis)}")
            object.__setattr__(self, name, axis)
        table = self._table()
        shape = (len(self.incidence_deg), len(self.emission_deg), len(self.phase_deg))
        require(table.shape == shape, f"reflectance table: values must have shape {shape}, got {table.shape}")
        good = bool(np.all(np.isfinite(table) & (table >= 0.0))) and table[0, 0, 0] > 0.0
        require(good, "reflectance table: values must be finite and >= 0, and the first one > 0")
        object.__setattr__(self, "values", tuple(tuple(tuple(row) for row in page) for page in table.tolist()))

    def above_horizon(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        from scipy.interpolate import RegularGridInterpolator

        axes = [np.asarray(axis) for axis in (self.incidence_deg, self.emission_deg, self.phase_deg)]
        table = self._table()
        angles = [np.degrees(angle) for angle in (*np.arccos(np.minimum([mu0, mu], 1.0)), phase_rad)]
        points = [np.minimum(angle, axis[-1]) for angle, axis in zip(angles, axes, strict=True)]
        return np.asarray(RegularGridInterpolator(axes, table / table[0, 0, 0])(np.stack(points, axis=-1)))

    def __repr__(self) -> str:
        axes = (self.incidence_deg, self.emission_deg, self.phase_deg)
        digest = hashlib.sha256(repr((axes, self.values)).encode()).hexdigest()
        return f"TabulatedReflectance({' x '.join(str(len(axis)) for axis in axes)}, sha256={digest[:16]})"

    def _table(self) -> Float:
        return as_floats(self.values, (), "reflectance table: values")
