"""Pixels along the lit horizon of an ellipsoid, in cells, each fitted by the profile across its piece of horizon.

A cell has its own brightness: gain, growth along the horizon and inward, and background. What it tells about the
horizon's place, about the width of the blur and about how the law is wrong is kept as information, so that it can be
used cell by cell (the Christian-Robinson algorithm) or added up over all of them (the sigmoid fit).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from giantlike.core.arrays import Float, Mask
from giantlike.core.values import Value, select_rows
from giantlike.relative.horizon.profile import ArcPlaces, HorizonArc, Indices, ProfileTable

_ACROSS_STEP_PX, _ALONG_STEP_PX = 0.6, 0.7
"""Steps in which pixels are gathered, px: less than 1 / sqrt(2), so that none is left out."""
_RIDGE = 1e-12
"""Added to normal matrices of unit diagonal: beyond rounding, below all information."""
_NOTHING = 1e-100
"""Least diagonal of a normal matrix: cells without pixels have none, and its square must not underflow."""
_REFITS = 2
"""Fits with the noise of the brightness fitted before; one or four change ellipsoid_cra by up to 0.06 sigma."""
_CLIPS, _CLIP_SIGMAS = 3, 5.0
"""Most fits without the pixels that lie far from the one before; and noise that is allowed for, in sigmas."""
_MIN_FREEDOM = 5
"""Pixels in a cell beyond the number of its parameters; with fewer, its chi-square says nothing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimbPixels(Value):
    """Pixels near a horizon, by cells of it; arrays (c, p) are padded where ``good`` is False.

    Parameters
    ----------
    columns, rows : (c, p) int64, px
    places : ArcPlaces
        Along the horizon, of all c p pixels.
    outward_px : (c, p) float64, px
        Distance from the horizon.
    along : (c, p) float64
        Place in the cell, over its length, from about -1/2 to 1/2.
    good : (c, p) bool
        A pixel, and usable.
    middles : (c,) int64
        The point of the horizon in the middle of each cell.
    filled : (c,) float64
        Share of the cell's area whose pixels are in the frame and usable.
    """

    columns: Indices
    rows: Indices
    places: ArcPlaces
    outward_px: Float
    along: Float
    good: Mask
    middles: Indices
    filled: Float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CellFits(Value):
    """Information of each cell on the horizon's place and on what all cells share, its brightness left free.

    The parameters are the outward shift of the horizon, px; the variance that the blur has besides, px^2; the
    coefficient of the next power of the cosine of emission, over the gain; and the share of each of the profiles that
    may be mixed in, where it is as bright as the law of the body.

    Parameters
    ----------
    information : (c, 1 + s, 1 + s) float64
    pull : (c, 1 + s) float64
        Information times estimate.
    chi2 : (c,) float64
        Per degree of freedom, all free, by pixel noise.
    gain_dn : (c,) float64, DN
        Brightness over that of the law.
    contrast : (c,) float64
        Brightness inside over the noise of the dark.
    unexplained : (c,) float64
        Root mean square of what is left with all free, over the brightness inside.
    used : (c,) float64
        Share of the usable pixels that were not left out for being too far from the fit.
    """

    information: Float
    pull: Float
    chi2: Float
    gain_dn: Float
    contrast: Float
    unexplained: Float
    used: Float

    @property
    def sigma_px(self) -> Float:
        """Standard deviation (c,) of the shift with blur and law known."""
        result: Float = 1.0 / np.sqrt(self.information[:, 0, 0])
        return result

    @property
    def shared(self) -> Float:
        """Shift (c, s) taken for a unit of each of the shared errors."""
        result: Float = self.information[:, 0, 1:] / self.information[:, 0, :1]
        return result

    @property
    def raw_shift_px(self) -> Float:
        """Shift (c,) with all that is shared as assumed."""
        result: Float = self.pull[:, 0] / self.information[:, 0, 0]
        return result

    def about_shared(self, keep: Mask) -> tuple[Float, Float]:
        """Add up what cells say about the shared errors, every shift left free.

        Parameters
        ----------
        keep : (c,) bool

        Returns
        -------
        information : (s, s) float64
        pull : (s,) float64
            Information times estimate.
        """
        crossed = self.information[keep, 1:, 0]
        gained = self.information[keep, 1:, 1:] - crossed[:, :, None] * self.shared[keep, None, :]
        pull = self.pull[keep, 1:] - crossed * self.raw_shift_px[keep, None]
        return gained.sum(axis=0), pull.sum(axis=0)


def limb_pixels(
    arc: HorizonArc, usable: Mask, *, window_px: float, cell_px: float, displaced_px: Float
) -> LimbPixels | None:
    """Gather the pixels near a horizon in cells.

    Parameters
    ----------
    arc : HorizonArc
        Part of the horizon that counts.
    usable : (rows, columns) bool
    window_px : float, px
        Reach to both sides of the horizon.
    cell_px : float, px
        Length of a cell along the horizon.
    displaced_px : (k,) float64, px
        How far outside the horizon of the ellipsoid the one in the image lies at each of its points: distances are from
        there.

    Returns
    -------
    LimbPixels or None
        None where there is no usable pixel.
    """
    across = np.arange(-window_px, window_px + _ACROSS_STEP_PX, _ACROSS_STEP_PX)
    pieces = max(round(arc.spacing_px / _ALONG_STEP_PX), 1)
    along = ((np.arange(pieces) + 0.5) / pieces - 0.5) * arc.spacing_px
    heights, tangents = (displaced_px[:, None] + across)[..., None], arc.tangents_px
    columns, rows = (
        np.rint(
            arc.points_px[:, axis, None, None]
            + heights * arc.normals_px[:, axis, None, None]
            + along * tangents[:, axis, None, None]
        ).astype(np.int64)
        for axis in range(2)
    )
    inside = np.flatnonzero((columns >= 0) & (columns < usable.shape[1]) & (rows >= 0) & (rows < usable.shape[0]))
    columns, rows = columns.ravel()[inside], rows.ravel()[inside]
    first = _firsts(columns, rows)
    pixels, nodes = np.stack([columns[first], rows[first]], axis=-1), inside[first] // (across.size * pieces)
    outward, feet_px = arc.seen_from(pixels, nodes)
    apart = outward - displaced_px[nodes]
    near = (np.abs(apart) <= window_px) & usable[pixels[:, 1], pixels[:, 0]]
    if not near.any():
        return None
    pixels, nodes, outward = pixels[near], nodes[near], outward[near]
    feet = ArcPlaces.of(arc, feet_px[near], nodes)
    return _in_cells(arc, pixels, feet, apart[near], window_px, cell_px)


def fit_cells(
    pixels: LimbPixels,
    data_dn: Float,
    table: ProfileTable,
    variance_dn2: Callable[[Float], Float],
    *,
    largest_left: float = math.inf,
) -> CellFits:
    """Fit the profiles of a table to the pixels of each cell.

    Parameters
    ----------
    pixels : LimbPixels
    data_dn : (rows, columns) float64, DN
    table : ProfileTable
        Its last power and the profiles after it are shared errors; the powers before are free in each cell.
    variance_dn2 : callable
        Noise variance of pixels of a brightness, DN^2.
    largest_left : float
        Pixels that are farther from the fit, with all free, than this share of the brightness inside and than noise,
        are left out: dead columns, cosmic rays.

    Returns
    -------
    CellFits

    Notes
    -----
    Least squares weighted by the noise of the fitted brightness, linear in everything but the shift, for which the
    profile is linearized; blur enters through half the second derivative of the profile.
    """
    good = pixels.good
    profiles = tuple(
        part.reshape(*good.shape, -1) for part in table.at(pixels.places.along_px, pixels.outward_px.ravel())
    )
    data = np.where(good, data_dn[pixels.rows, pixels.columns], 0.0)
    problem = _CellProblem(along=pixels.along, data=data, profiles=profiles, free=table.powers - 1, noise=variance_dn2)
    kept = good
    for _ in range(_CLIPS):
        fits, far = problem.fit(kept, largest_left)
        if not far.any():
            break
        kept = kept & ~far
    return replace(fits, used=kept.sum(axis=1) / good.sum(axis=1))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _CellProblem:
    """Pixels (c, p) of cells and the profiles (c, p, q) that are fitted to them, with two derivatives."""

    along: Float
    data: Float
    profiles: tuple[Float, ...]
    free: int
    noise: Callable[[Float], Float]

    def brightness(self, good: Mask) -> tuple[Float, Float, Float, Float]:
        """Columns (c, p, n) free in each cell, weights (c, p), solution (c, n) and its covariance (c, n, n)."""
        value = self.profiles[0]
        columns = np.concatenate(
            [value[..., : self.free], self.along[..., None] * value[..., :1], np.ones((*good.shape, 1))], axis=-1
        )
        weights = good / self.noise(np.maximum(self.data, 0.0))
        for _ in range(_REFITS):
            solution, _ = _solved(columns, weights, self.data)
            fitted = (columns @ solution[..., None])[..., 0]
            weights = good / self.noise(np.maximum(fitted, 0.0))
        return columns, weights, *_solved(columns, weights, self.data)

    def fit(self, good: Mask, largest_left: float) -> tuple[CellFits, Mask]:
        """Fit the good pixels; return also those that lie too far from the fit."""
        value, slope, curve = self.profiles
        columns, weights, solution, solver = self.brightness(good)
        powers = solution[:, : self.free, None]
        inside = np.where(good, (value[..., : self.free] @ powers)[..., 0], 0.0).max(axis=1)
        largest = np.where(good[..., None], value, 0.0).max(axis=1)
        gains = inside[:, None] / np.maximum(largest, _RIDGE)
        gains[:, self.free] = gains[:, 0]
        extra = np.concatenate(
            [
                -slope[..., : self.free] @ powers,
                0.5 * curve[..., : self.free] @ powers,
                value[..., self.free :] * gains[:, None, self.free :],
            ],
            axis=-1,
        )
        weighted = extra * weights[..., None]
        crossed = np.swapaxes(columns, 1, 2) @ weighted  # (c, n, 1 + s)
        information = np.swapaxes(extra, 1, 2) @ weighted - np.swapaxes(crossed, 1, 2) @ (solver @ crossed)
        left = self.data - (columns @ solution[..., None])[..., 0]
        pull = (np.swapaxes(weighted, 1, 2) @ left[..., None])[..., 0]
        freedom = good.sum(axis=1) - columns.shape[2] - extra.shape[2]
        information = _floored(information, freedom)
        estimate = np.linalg.solve(information, pull[..., None])
        left = left - ((extra - columns @ (solver @ crossed)) @ estimate)[..., 0]
        remains = (weights * left**2).sum(axis=1)
        rms = np.sqrt(remains / np.maximum(weights.sum(axis=1), _RIDGE))
        noise = np.sqrt(self.noise(np.maximum(self.data - left, 0.0)))
        step = np.maximum(inside, np.finfo(np.float64).tiny)  # not 0, for the largest may be infinite
        far = good & (np.abs(left) > _CLIP_SIGMAS * noise + largest_left * step[:, None])
        fits = CellFits(
            information=information,
            pull=pull,
            chi2=np.where(freedom < _MIN_FREEDOM, np.inf, remains / np.maximum(freedom, 1)),
            gain_dn=gains[:, 0],
            contrast=inside * np.sqrt(weights.max(axis=1)),
            unexplained=np.where(inside > 0.0, rms / np.where(inside > 0.0, inside, 1.0), np.inf),
            used=np.ones(len(good)),
        )
        return fits, far


def _floored(information: Float, freedom: Indices) -> Float:
    """Information (c, n, n) that can be inverted: hardly any for cells of which rounding alone is left."""
    one = np.eye(information.shape[1])
    information = np.where((freedom < _MIN_FREEDOM)[:, None, None], _RIDGE * one, information)
    least = _RIDGE * np.maximum(np.trace(information, axis1=1, axis2=2), 1e-30)
    result: Float = information + least[:, None, None] * one
    return result


def _solved(columns: Float, weights: Float, data: Float) -> tuple[Float, Float]:
    """Weighted least squares of every cell: solution (c, n) and the inverse (c, n, n) of its normal matrix."""
    weighted = np.swapaxes(columns * weights[..., None], 1, 2)
    normal = weighted @ columns
    scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), _NOTHING))
    scaled = normal / (scale[:, :, None] * scale[:, None, :]) + _RIDGE * np.eye(normal.shape[1])
    inverse = np.linalg.inv(scaled) / (scale[:, :, None] * scale[:, None, :])
    return (inverse @ (weighted @ data[..., None]))[..., 0], inverse


def _in_cells(
    arc: HorizonArc, pixels: Indices, places: ArcPlaces, outward: Float, window_px: float, cell_px: float
) -> LimbPixels:
    """Sort pixels (n, 2) into cells and pad them."""
    number = (arc.along_px / cell_px).astype(np.int64)
    cell = number[places.nodes]
    order = np.argsort(cell, kind="stable")
    pixels, places, outward, cell = pixels[order], select_rows(places, order), outward[order], cell[order]
    present, start, count = np.unique(cell, return_index=True, return_counts=True)
    index = start[:, None] + np.minimum(np.arange(count.max()), count[:, None] - 1)
    good = np.arange(count.max()) < count[:, None]
    first = np.searchsorted(number, present, side="left")
    last = np.searchsorted(number, present, side="right") - 1
    middles = (first + last) // 2
    offset = pixels[index] - arc.points_px[middles][:, None]
    along = np.einsum("cpi,ci->cp", offset, arc.tangents_px[middles]) / cell_px
    return LimbPixels(
        columns=pixels[index, 0],
        rows=pixels[index, 1],
        places=select_rows(places, index.ravel()),
        outward_px=outward[index],
        along=along,
        good=good,
        middles=middles,
        filled=count / (2.0 * window_px * cell_px),
    )


def _firsts(columns: Indices, rows: Indices) -> Indices:
    """One occurrence of each of n pixels."""
    if len(columns) == 0:
        return np.zeros(0, dtype=np.int64)
    left, top = columns.min(), rows.min()
    keys = (rows - top) * (columns.max() - left + 1) + (columns - left)
    where = np.zeros(int(keys.max()) + 1, dtype=np.int64)
    where[keys] = np.arange(keys.size)
    return np.flatnonzero(where[keys] == np.arange(keys.size))
