"""Another place in the search region where the body would explain the image about as well."""

from __future__ import annotations

import math

import numpy as np

from giantlike.core.arrays import Float
from giantlike.ray_tracing import Template
from giantlike.relative.verification.cells import BLOCK, Cells
from giantlike.relative.verification.shifts import ShiftedMatches

_APART = 1.0
"""Least distance, radii, between two places: a body matches itself to some degree within a radius."""
_FAINT = 0.3
"""Light over that of the fix below which another place holds another, fainter body or a ghost of this one."""
_EXACT = 1e-9
"""Share of the variance that rounding leaves of an exact model."""


def rival_log_odds(cells: Cells, own: Template, predicted_px: Float, search_px: float) -> float:
    """Logarithm of the odds for the best other place in the search region.

    Parameters
    ----------
    cells : Cells
        With room for the search.
    own : Template
        The body at the place found.
    predicted_px : (2,) float64, px
        Place predicted, in the pixels of the image.
    search_px : float, px
        Largest error of the prediction, in both coordinates.

    Returns
    -------
    float
        Of the likelihood at that place over that at the place found, as for sides of the Sun; minus infinity where no
        other place is far enough away, or none holds as much light.
    """
    room = min(math.ceil((search_px + np.abs(predicted_px - cells.center_px).max()) / cells.size), cells.room)
    if room <= _APART * cells.radius:
        return -math.inf
    share, gain = ShiftedMatches.of(cells, room).explained(cells.place(own.brightness, own))
    steps = np.arange(-room, room + 1)
    columns, rows = steps[None, :], steps[:, None]
    here = np.hypot(rows, columns) < 0.5 * _APART * cells.radius
    place_px = [found + cells.size * step for found, step in zip(cells.center_px, (columns, rows), strict=True)]
    searched = np.maximum(*(np.abs(place - mid) for place, mid in zip(place_px, predicted_px, strict=True)))
    away = (np.hypot(rows, columns) >= _APART * cells.radius) & (searched <= search_px)
    away &= gain > _FAINT * float(gain[here].max())
    if not away.any():
        return -math.inf
    coverage = cells.place(own.coverage, own)
    parts = float(coverage[cells.cropped(cells.good)].sum()) / (BLOCK * cells.radius) ** 2
    left, left_there = (max(1.0 - float(share[where].max()), _EXACT) for where in (here, away))
    return 0.5 * parts * math.log(left / left_there)
