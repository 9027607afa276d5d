"""Selection of good cells along a horizon, each refitted about its own position where relief moves the limb."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value, select_rows
from giantlike.processing.correlated_fit import robust_solution
from giantlike.processing.limb.measurement import judge_points
from giantlike.processing.limb.view import LimbView
from giantlike.relative.horizon.cells import CellFits, fit_cells
from giantlike.relative.horizon.pixels import limb_pixels
from giantlike.relative.horizon.profile import HorizonArc, Indices, ProfileTable

_ROUNDS = 2  # fits of cells about their own positions, where they deviate from one horizon
_RELIEF_PX, _RELIEF_NOISE = 0.1, 3.0
"""Minimum root mean square of that deviation, px and in units of the noise of a cell.

Profiles that are linear in the shift have an error of half its square divided by their width, 0.005 px.
"""
_MIN_FILLED = 0.6  # minimum fraction of usable pixels in a cell
_MIN_CONTRAST_SIGMAS = 5.0  # minimum ratio of the brightness of good cells to the noise of the sky background
_MAX_UNEXPLAINED, _MAX_UNEXPLAINED_FIRST = 0.12, 0.4
"""Maximum residuals of good cells relative to their brightness; more while the horizon is known to 1-2 px only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CellRules:
    """Parameters of the measurement of cells, and limits of good ones."""

    window_px: float  # reach to both sides of the horizon
    cell_px: float  # length of a cell along it
    min_cells: int  # fewer good cells are no limb
    outlier_mad: float  # cells beyond so many robust sigmas are ignored in the test for relief
    first: bool  # the horizon is known to a pixel or two only


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoCells(Value):
    """Too few good cells."""

    good: Mask  # (n,); which of the cells are
    rejected: Mapping[str, int]  # number of the others by reason


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GoodCells(Value):
    """Good cells."""

    fits: CellFits  # of n cells
    middles: Indices  # (n,); the points of the horizon in their middles
    shift_px: Float  # (n,); from there outward to the limb, with the shared parameters as assumed
    spacing_px: float  # from one cell to the next, good or not
    rejected: Mapping[str, int]  # number of the others by reason
    others: Indices  # (k,); the points of the horizon in the middles of these


def good_cells(
    view: LimbView, arc: HorizonArc, table: ProfileTable, clear: Mask, rules: CellRules
) -> GoodCells | NoCells:
    """Fit the cells along a horizon; where they deviate by more than noise, again about the position of each.

    Profiles are linear in the shift to second order only. On a horizon with relief, the squared shifts of cells fitted
    about the prediction look like more blur and another law, which moves the whole horizon: by 0.3-0.5 px outward with
    relief of 0.6 px.
    """
    displaced_px = np.zeros(len(arc.points_px))
    cells = _fit_cells(view, arc, table, clear, displaced_px, rules)
    for _ in range(0 if rules.first else _ROUNDS):
        if isinstance(cells, NoCells):
            break
        design, sigma_px = arc.design[cells.middles], cells.fits.sigma_px
        step_km, keep = robust_solution(cells.shift_px, design, sigma_px, outlier_mad=rules.outlier_mad)
        off_px = float(np.sqrt(np.mean((cells.shift_px - design @ step_km)[keep] ** 2)))
        if off_px < max(_RELIEF_PX, _RELIEF_NOISE * float(np.median(sigma_px))):
            break
        displaced_px = np.interp(arc.along_px, arc.along_px[cells.middles], cells.shift_px)
        cells = _fit_cells(view, arc, table, clear, displaced_px, rules)
    return cells


def _fit_cells(
    view: LimbView, arc: HorizonArc, table: ProfileTable, clear: Mask, displaced_px: Float, rules: CellRules
) -> GoodCells | NoCells:
    """Fit the cells about a horizon that is displaced (k,), px, from that of the ellipsoid."""
    pixels = limb_pixels(arc, clear, window_px=rules.window_px, cell_px=rules.cell_px, displaced_px=displaced_px)
    if pixels is None:
        return NoCells(good=np.zeros(0, dtype=np.bool_), rejected={})
    fits = fit_cells(
        pixels,
        view.pixels_dn,
        table,
        view.detector,
        largest_left=math.inf if rules.first else 2.0 * _MAX_UNEXPLAINED,
    )
    good, rejected = judge_points(
        complete=(pixels.filled * fits.used > _MIN_FILLED) & np.isfinite(fits.chi2),
        strong=fits.contrast > _MIN_CONTRAST_SIGMAS,
        alike=fits.unexplained < (_MAX_UNEXPLAINED_FIRST if rules.first else _MAX_UNEXPLAINED),
        gain_dn=fits.gain_dn,
    )
    if good.sum() < rules.min_cells:
        return NoCells(good=good, rejected=rejected)
    middles = pixels.middles[good]
    fits = select_rows(fits, good)
    apart_px = np.diff(arc.along_px[pixels.middles])
    return GoodCells(
        fits=fits,
        middles=middles,
        shift_px=displaced_px[middles] + fits.raw_shift_px,
        spacing_px=float(np.median(apart_px)) if good.size > 1 else rules.cell_px,
        rejected=rejected,
        others=pixels.middles[~good],
    )
