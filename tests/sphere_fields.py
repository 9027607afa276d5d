"""Random functions on the sphere for bodies of some tens of pixels: tables of 0.7 degrees, made once."""

from __future__ import annotations

from functools import cache

from giantlike.independent import SphereField
from giantlike.independent import bumps as tabulated_bumps

CELLS = 256
"""Cells along the side of a table, a third of the usual number: 0.5 px on a disk of 100 px, at a ninth of the cost."""


@cache
def bumps(
    seed: int, *, rms: float, count: int = 60, widths_deg: tuple[float, float] = (5.0, 30.0), cells: int = CELLS
) -> SphereField:
    """Round bumps and hollows that neither scale nor move a sphere."""
    return tabulated_bumps(seed, rms=rms, count=count, widths_deg=widths_deg, cells=cells)
