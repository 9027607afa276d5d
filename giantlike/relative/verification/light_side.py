"""Test of the illumination direction: the body at the estimated position, lit from the Sun and from other sides."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, unit
from giantlike.core.blocks import block_sums
from giantlike.core.frames import rotate
from giantlike.ray_tracing import Template
from giantlike.ray_tracing.cached_trace import Trace
from giantlike.relative.verification.cell_loops import least_unexplained
from giantlike.relative.verification.cells import BLOCK, Cells
from giantlike.relative.verification.shifts import ShiftedMatches

_LEAST_SHARE = 0.3  # share of the body that must lie in the frame
_OTHER_SIDES_RAD = (0.5 * math.pi, math.pi, 1.5 * math.pi)  # angles by which the Sun is turned about the line of sight
_CLEAR = 0.2
"""Ratio of the residual variance for the Sun to that for other directions without cast shadows below which shadows
could not make these fit better."""
_EXACT = 1e-9  # share of the variance that rounding leaves of an exact model
_HALVED_RADIUS, _HALVED_BLUR = 8.0, 0.5
"""Minimum radius and maximum standard deviation of the point spread function, cells, to test blocks of 2 x 2 cells with
one ray per cell first; for smaller or more blurred bodies these are too coarse."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LightSide:
    """Match of an image with a body lit from the Sun, and from the best of three other directions.

    unexplained, unexplained_by_other: fraction of the variance of the pixels left by the body lit so, at the best
        shift.
    """

    unexplained: float
    unexplained_by_other: float
    log_odds: float  # log likelihood ratio of the other direction to the Sun


def light_side(cells: Cells, trace: Trace, own: Template, sun_direction_camera: Float) -> LightSide | None:
    """Compare an image with a body that is lit from the side of the Sun, and from the others.

    ``sun_direction_camera``: unit vector from body to Sun; returns None where too little of the body lies in the frame.

    Residuals of a body are errors of its law and of its markings, correlated over a quarter of a radius. With n such
    parts the likelihood is proportional to the unexplained variance to the power of -n / 2. At small phase angles all
    sides match alike, and the odds are even. Self-shadowing under another Sun is traced only where it may matter. Where
    blocks of 2 x 2 cells with one ray per cell are decisive, finer cells are not tested.
    """
    parts = independent_parts(cells, own)
    if parts == 0.0:
        return None
    sight = unit(trace.body.position_camera_km)
    turned = [rotate(Rotation.from_rotvec(angle * sight), sun_direction_camera) for angle in _OTHER_SIDES_RAD]
    if cells.radius >= _HALVED_RADIUS and cells.blur <= _HALVED_BLUR:
        rough = _left_of_halved(cells, trace, turned)
        if rough[0] < _CLEAR * rough[1]:
            return _compare(*rough, parts)
    matches = ShiftedMatches.from_cells(cells, math.ceil(cells.radius))
    left = _least(matches, cells.place(own.brightness, own))
    for one in (_without_shadows(trace), trace):
        left_by_other = _least(matches, np.stack([cells.light(one.with_sun(sun)) for sun in turned]))
        if left < _CLEAR * left_by_other:
            break
    return _compare(left, left_by_other, parts)


def _compare(left: float, left_by_other: float, parts: float) -> LightSide:
    odds = 0.5 * parts * math.log(left / left_by_other)
    return LightSide(unexplained=left, unexplained_by_other=left_by_other, log_odds=odds)


def _left_of_halved(cells: Cells, trace: Trace, turned: list[Float]) -> tuple[float, float]:
    """Residual variance fractions of blocks of 2 x 2 cells, for the Sun and for other Suns without cast shadows."""
    room = min(math.ceil(0.5 * cells.radius), cells.room // 2)
    side = (cells.inner.width // 2 + 2 * room) * 2
    first = cells.room - 2 * room
    within = slice(first, first + side)
    good = cells.good[within, within]
    counts = block_sums(good, 2)
    values = block_sums(np.where(good, cells.values[within, within], 0.0), 2) / np.maximum(counts, 1.0)
    few = trace.one_to_a_pixel()
    plain = _without_shadows(few)
    lit = [few, *(plain.with_sun(sun) for sun in turned)]
    light = np.stack([block_sums(cells.inner.cut(*one.at_middles()), 2) for one in lit])
    left = np.maximum(least_unexplained(values, counts > 0.0, light), _EXACT)
    return float(left[0]), float(left[1:].min())


def independent_parts(cells: Cells, template: Template) -> float:
    """Parts of a body in the frame whose departures from a model are independent; 0 where too little of it shows."""
    coverage = cells.place(template.coverage, template)
    seen = float(coverage[cells.crop(cells.good)].sum())
    enough = seen > _LEAST_SHARE * float(template.coverage.sum())
    return seen / (BLOCK * cells.radius) ** 2 if enough else 0.0


def _without_shadows(trace: Trace) -> Trace:
    """Return a trace without self-shadowing, so that another Sun costs no rays."""
    return replace(trace, view=replace(trace.view, options=replace(trace.view.options, shadows=False)))


def _least(matches: ShiftedMatches, light: Float) -> float:
    """Fraction of the variance of the cells left by the best light of (..., m, m) at its best shift."""
    return max(float(matches.find_unexplained_share(light).min()), _EXACT)
