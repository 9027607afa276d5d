"""Photometric bands: magnitudes in one from those in another and a color.

A band is a polynomial in one color, added to the magnitude in the band that it rests on. Where that color is unknown,
the other one stands in for it through a relation between the two; where none is known, a typical one.

Source: Gaia DR3 documentation, table 5.9: G - V as a cubic in BP-RP, scatter 0.03 mag, for -0.5 < BP-RP < 5, opened as
quoted in a public astronomy library, which checked it on 4,000 stars with Tycho-2 photometry.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from giantlike.core.arrays import Float, require
from giantlike.core.errors import InputError

COLORS = ("color_bp_rp", "color_bv")  # colors that a :class:`~giantlike.catalogs.StarTable` has
_BP_RP_OF_BV = (0.0168, 1.3774, -0.3363, 0.4844, -0.6262, 0.2528)
"""Fitted to 97,000 stars of the default catalog that have both colors: scatter 0.03 mag, 0.06 at the red end."""
_BV_OF_BP_RP = (-0.0039, 0.7133, -0.0424, 0.2764, -0.1097, -0.0022)  # likewise, the other way round
_BV_RANGE, _BP_RP_RANGE = (
    (-0.3, 1.6),
    (-0.4, 2.2),
)  # mag; colors are clipped to these before the polynomials are applied
_TYPICAL = MappingProxyType({"color_bp_rp": 1.15, "color_bv": 0.95})  # mag, medians of the default catalog


@dataclass(frozen=True, slots=True, kw_only=True)
class Band:
    """A band whose magnitudes are the magnitudes of another one plus a polynomial in a color.

    Parameters
    ----------
    name : str
    base : str; the band that it rests on: ``"Gaia G"``, ``"V"`` or the band of the catalog
    coefficients : tuple of float; of ascending powers of the color: this band minus ``base``
    color : str; ``"color_bp_rp"`` (Gaia BP-RP) or ``"color_bv"`` (Johnson B-V)
    color_range : (float, float); bluer and redder stars are treated as having the bluest and the reddest color here
    typical_color : float, optional; of stars without colors; default the median of the default catalog

    Raises
    ------
    InputError
        No coefficients, an unknown color, or values that are not finite or in the wrong order.
    """

    name: str
    base: str
    coefficients: tuple[float, ...]
    color: str = "color_bp_rp"
    color_range: tuple[float, float] = (-0.5, 5.0)
    typical_color: float | None = None

    def __post_init__(self) -> None:
        require(self.color in COLORS, f"band {self.name}: color must be one of {', '.join(COLORS)}, got {self.color!r}")
        require(len(self.coefficients) > 0, f"band {self.name}: coefficients must not be empty")
        require(bool(np.isfinite(self.coefficients).all()), f"band {self.name}: coefficients must be finite")
        low, high = self.color_range
        require(
            bool(np.isfinite([low, high]).all()) and low < high, f"band {self.name}: color_range must be (low, high)"
        )

    @property
    def text(self) -> str:
        """The relation, for provenance."""
        numbers = ", ".join(f"{value:g}" for value in self.coefficients)
        return f"{self.name} = {self.base} + ({numbers}) in {self.color.removeprefix('color_')}"

    def magnitude(self, base_magnitude: Float, *, color_bp_rp: Float, color_bv: Float) -> Float:
        """Magnitudes (n,) of stars in this band, from those in ``base``; colors (n,), mag, are NaN where unknown."""
        if self.color == "color_bp_rp":
            own, other = color_bp_rp, _polynomial(np.clip(color_bv, *_BV_RANGE), _BP_RP_OF_BV)
        else:
            own, other = color_bv, _polynomial(np.clip(color_bp_rp, *_BP_RP_RANGE), _BV_OF_BP_RP)
        typical = _TYPICAL[self.color] if self.typical_color is None else self.typical_color
        color = np.where(np.isfinite(own), own, np.where(np.isfinite(other), other, typical))
        return np.asarray(base_magnitude + _polynomial(np.clip(color, *self.color_range), self.coefficients))


_G_MINUS_HP = (-0.0223, -0.4303, 0.0992, -0.0747)
"""Fitted to the stars that are in Gaia and Hipparcos: scatter 0.03 mag, 0.1 for B-V > 1.4."""
_V_MINUS_G = (0.02704, -0.01424, 0.2156, -0.01426)  # table 5.9 of [1]_ of this module
BANDS: Mapping[tuple[str, str], Band] = MappingProxyType(
    {
        ("Gaia G", "V"): Band(name="V", base="Gaia G", coefficients=_V_MINUS_G),
        ("V", "Gaia G"): Band(name="Gaia G", base="V", coefficients=tuple(-value for value in _V_MINUS_G)),
        ("Hp", "Gaia G"): Band(
            name="Gaia G", base="Hp", color="color_bv", coefficients=_G_MINUS_HP, color_range=(-0.3, 2.0)
        ),
    }
)
"""Known relations, by the band that they start from and the one that they give."""
_OTHER_NAMES = MappingProxyType({"G": "Gaia G", "Johnson V": "V"})


def band_between(have: str, need: str | Band) -> tuple[Band, ...]:
    """Relations that lead from one band to another. The result is empty where the bands are the same."""
    if isinstance(need, Band):
        return (*band_between(have, need.base), need)
    wanted = _OTHER_NAMES.get(need, need)
    if wanted == have:
        return ()
    through = next((name for start, name in BANDS if start == have and (name, wanted) in BANDS), None)
    if (have, wanted) not in BANDS and through is not None:
        return BANDS[have, through], BANDS[through, wanted]
    if (have, wanted) not in BANDS:
        known = ", ".join(sorted({name for pair in BANDS for name in pair}))
        raise InputError(
            f"no relation is known from band {have!r} to {need!r}: relations exist between {known}; "
            f"give a Band(base={have!r}, ...) of your own"
        )
    return (BANDS[have, wanted],)


def _polynomial(x: Float, coefficients: tuple[float, ...]) -> Float:
    return np.asarray(np.polynomial.polynomial.polyval(x, np.array(coefficients)))
