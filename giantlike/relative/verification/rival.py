"""Competing solutions: another position in the search region, and another apparent size, that fit the image as well."""

from __future__ import annotations

import math

import cv2
import numpy as np

from giantlike.core.arrays import Float
from giantlike.ray_tracing import Template
from giantlike.ray_tracing.cached_trace import Trace
from giantlike.relative.verification.cells import BLOCK, Cells
from giantlike.relative.verification.coarse_fit import OTHER_LAWS
from giantlike.relative.verification.light_side import independent_parts
from giantlike.relative.verification.shifts import ShiftedMatches

_APART, _APART_BLUR = 1.0, 4.0
"""Minimum distance between two positions, radii and standard deviations of the point spread function: nearer, a body
correlates with itself."""
_FAINT = 0.3  # ratio of the light at another position to the light of the fix below which it is another body or a ghost
_LEAST_SIGMAS = 6.0
"""Minimum light at another position, standard deviations of the noise, so that none of about 10^4 positions is
noise."""
_CORE = 4.0 * math.pi
"""Area of a point spread function, squares of its standard deviation: it limits the independent parts of small
bodies."""
_HALVES = ((0.0, 0.5), (0.5, 0.0), (0.5, 0.5))
_SAME = 0.99
"""Squared autocorrelation of a body at half a cell above which positions between cells are skipped. A copy of a point
source between four pixels has 0.8, which made it 10^4 times less likely than the fix."""
_SIZES = (0.5, 0.63, 0.8, 1.25, 1.6)
"""Apparent sizes of another body, relative to the fix: thirds of an octave, up to the size of the region of cells."""


def rival_log_odds(cells: Cells, own: Template, predicted_px: Float, search_px: float, albedo: float) -> float:
    """Logarithm of the odds for the best other position in the search region.

    Returns minus infinity where no other position is far enough away, or none has as much light.
    """
    room = min(math.ceil((search_px + np.abs(predicted_px - cells.center_px).max()) / cells.size), cells.room)
    apart = _APART * cells.radius + _APART_BLUR * cells.blur
    if room <= apart:
        return -math.inf
    light = cells.place(own.brightness, own)
    share, gain = (found.max(axis=0) for found in ShiftedMatches.from_cells(cells, room).correlate(_between(light)))
    noise = math.sqrt(float(np.median(cells.variance)) / max(light.size * float(light.var()), 1e-300))
    steps = np.arange(-room, room + 1)
    columns, rows = steps[None, :], steps[:, None]
    here = np.hypot(rows, columns) < 0.5 * apart
    place_px = [found + cells.size * step for found, step in zip(cells.center_px, (columns, rows), strict=True)]
    searched = np.maximum(*(np.abs(place - mid) for place, mid in zip(place_px, predicted_px, strict=True)))
    away = (np.hypot(rows, columns) >= apart) & (searched <= search_px)
    away &= gain > max(_FAINT * float(gain[here].max()), _LEAST_SIGMAS * noise)
    if not away.any():
        return -math.inf
    seen = float(cells.place(own.coverage, own)[cells.crop(cells.good)].sum())
    parts = min(seen / (BLOCK * cells.radius) ** 2, seen + _CORE * cells.blur**2)
    left, left_there = (max(1.0 - float(share[where].max()), albedo**2) for where in (here, away))
    return 0.5 * parts * math.log(left / left_there)


def find_other_size(cells: Cells, trace: Trace, own: Template, albedo: float) -> tuple[float, float, Float] | None:
    """Apparent size of a body, relative to this one, that matches an image best without markings.

    Returns the logarithm of the odds, the size, and its offset (2,), px; None where this one matches as well. The body
    itself is matched under several laws, as a strong limb darkening resembles a smaller body.
    """
    parts = independent_parts(cells, own)
    if parts == 0.0:
        return None
    light = cells.place(own.brightness, own)
    x, y = own.center_px[0] - cells.inner.x, own.center_px[1] - cells.inner.y
    lit = np.stack([light, *(cells.light(trace.with_reflectance(law)) for law in OTHER_LAWS)])
    resized = np.stack([_resize(light, x, y, size) for size in _SIZES])
    matches = ShiftedMatches.from_cells(cells, math.ceil(cells.radius))
    left = max(float(matches.find_unexplained_share(lit).min()), albedo**2)
    left_by_other = matches.find_unexplained_share(resized)
    which, row, column = np.unravel_index(int(np.argmin(left_by_other)), left_by_other.shape)
    log_odds = 0.5 * parts * math.log(left / max(float(left_by_other.min()), albedo**2))
    offset_px = cells.size * (np.array([column, row], dtype=np.float64) - left_by_other.shape[1] // 2)
    return (log_odds, _SIZES[which], offset_px) if log_odds > 0.0 else None


def _resize(light: Float, x: float, y: float, size: float) -> Float:
    """Light (m, m) of a body resized about its center (x, y)."""
    matrix = np.array([[size, 0.0, (1.0 - size) * x], [0.0, size, (1.0 - size) * y]])
    return np.asarray(cv2.warpAffine(light, matrix, light.shape[::-1], flags=cv2.INTER_LINEAR), dtype=np.float64)


def _between(light: Float) -> Float:
    """Light (k, m, m) of a body and, where it differs, shifted by half a cell along rows, columns and both."""
    from scipy.ndimage import shift

    away = [shift(light, step, order=3) for step in _HALVES]
    alike = min(float(np.corrcoef(light.ravel(), other.ravel())[0, 1]) for other in away) ** 2
    return light[None] if alike > _SAME else np.stack([light, *away])
