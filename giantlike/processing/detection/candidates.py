"""Candidates: local maxima of the filtered image above the threshold, each with the component that it belongs to."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float, Indices, Mask
from giantlike.core.values import Value, select_rows
from giantlike.processing.detection.frame import Frame
from giantlike.processing.detection.matched_filter import FilteredImage, Image32
from giantlike.processing.detection.options import DetectionOptions

_EXTENDED_AREA = 4.0  # area / area of a star of the same peak above the threshold; not yet studied
_EXTENDED_AREA_MARGIN_PX = 12  # added to it, px: small areas fluctuate with the noise
_LEAST_SIDE = 0.05  # of the peak: a neighbor below it, which noise may bring below zero, has no logarithm to rely on
_ROWS = 64  # of the image compared with its threshold at a time


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidates(Value):
    """Peaks of the filtered image, most significant first."""

    peaks_px: NDArray[np.int64]  # (n, 2); brightest pixel (x, y) of each
    points_px: Float  # (n, 2); maximum of the Gaussian through it and its neighbors: to about 0.03 px and noise
    flux_dn: Float  # (n,); flux of a star with that maximum
    noise_dn: Float  # (n,)
    significance: Float  # (n,); peak / noise
    area_px: NDArray[np.int64]  # (n,); area of the component: connected pixels above the threshold
    extended: Mask  # (n,); True where the area is far larger than a star
    plateau: Mask  # (n,); True where a pixel of the peak or a neighbor is saturated
    alone: Mask  # (n,); True for the only peak of its component
    first: Mask  # (n,); True for its strongest peak

    def __len__(self) -> int:
        return len(self.flux_dn)

    def select(self, which: NDArray[np.integer] | Mask | slice) -> Candidates:
        """Candidates of a mask, of indices or of a slice, in that order."""
        return select_rows(self, which)

    def join(self, other: Candidates) -> Candidates:
        """These candidates, then the others."""
        names = [field.name for field in fields(self)]
        return Candidates(**{name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in names})


def find_candidates(frame: Frame, filtered: FilteredImage, options: DetectionOptions) -> Candidates:
    """List the local maxima above the threshold; of a component far larger than a star only the strongest."""
    above = _above(filtered, options.threshold_sigma)
    columns = above.shape[1]
    lit = np.flatnonzero(above)
    component, n_components = label_groups(lit, columns)
    area = np.bincount(component, minlength=n_components)
    highest = peaks_among(filtered.response, lit)
    highest = highest[area[component[highest]] >= options.min_area_px]
    peaks, component = lit[highest], component[highest]
    response = filtered.response.ravel()[peaks].astype(np.float64)
    noise = filtered.noise_dn.ravel()[peaks].astype(np.float64)
    significance = response / (noise * filtered.response_noise)
    order = np.argsort(-significance, kind="stable")
    peaks, component, significance, noise = peaks[order], component[order], significance[order], noise[order]
    first = np.zeros(len(order), dtype=bool)  # the strongest peak of its component
    first[np.unique(component, return_index=True)[1]] = True
    strongest = np.zeros(n_components)
    strongest[component[first]] = significance[first]
    star_area = 4.0 * math.pi * filtered.width_px**2 * np.log(strongest[component] / options.threshold_sigma)
    extended = area[component] > _EXTENDED_AREA * star_area + _EXTENDED_AREA_MARGIN_PX
    pixels = np.stack(np.divmod(peaks, columns)[::-1], axis=1)
    plateau: Mask = np.zeros(len(peaks), dtype=bool)
    if frame.any_saturated:
        plateau = np.asarray(frame.patches(pixels, 1).saturated.any(axis=(1, 2)))
    points, top = _maxima(filtered.response, pixels)
    candidates = Candidates(
        peaks_px=pixels,
        points_px=points,
        flux_dn=top * filtered.flux_per_response,
        noise_dn=noise,
        significance=significance,
        area_px=area[component],
        extended=extended,
        plateau=plateau,
        alone=np.bincount(component, minlength=n_components)[component] == 1,
        first=first,
    )
    return candidates.select(first | ~(extended | plateau))


def _above(filtered: FilteredImage, threshold_sigma: float) -> Mask:
    """Pixels (rows, columns) above the threshold: some rows at a time, whose limits stay in the cache."""
    factor = np.float32(threshold_sigma * filtered.response_noise)
    above = np.empty(filtered.response.shape, dtype=bool)
    for first in range(0, len(above), _ROWS):
        some = slice(first, first + _ROWS)
        np.greater(filtered.response[some], filtered.noise_dn[some] * factor, out=above[some])
    return above


def _maxima(response: Image32, pixels_px: NDArray[np.int64]) -> tuple[Float, Float]:
    """Place (n, 2) and height (n,) of the maxima of Gaussians through pixels (n, 2) and their four neighbors."""
    rows, columns = response.shape
    x, y = pixels_px.T
    middle = response[y, x].astype(np.float64)
    top = np.log(middle)
    places, heights = [], [top]
    for before, after in (
        (response[y, np.maximum(x - 1, 0)], response[y, np.minimum(x + 1, columns - 1)]),
        (response[np.maximum(y - 1, 0), x], response[np.minimum(y + 1, rows - 1), x]),
    ):
        low, high = (np.log(np.clip(side, _LEAST_SIDE * middle, middle)) for side in (before, after))
        bend = 2.0 * top - low - high
        shift = 0.5 * (high - low) / np.where(bend > 0.0, bend, 1.0)
        places.append(shift)
        heights.append((high - low) * shift / 4.0)
    return pixels_px + np.stack(places, axis=1), np.exp(sum(heights))


@compiled
def label_groups(lit: Indices, columns: int) -> tuple[Indices, int]:
    """Number (n,) of the group of pixels that touch, along sides or at corners, and their count."""
    parent = np.arange(len(lit))
    above = 0  # the first pixel that may touch from the row above
    for i in range(len(lit)):
        place = lit[i]
        column = place % columns
        if column > 0 and i > 0 and lit[i - 1] == place - 1:
            _join(parent, i - 1, i)
        first = place - columns - (1 if column > 0 else 0)
        last = place - columns + (1 if column < columns - 1 else 0)
        while lit[above] < first:
            above += 1
        at = above
        while lit[at] <= last:
            _join(parent, at, i)
            at += 1
    group, count = np.empty(len(lit), np.int64), 0
    for i in range(len(lit)):
        root = _root(parent, i)  # the first of its group
        if root == i:
            group[i] = count
            count += 1
        else:
            group[i] = group[root]
    return group, count


@compiled
def peaks_among(response: NDArray[np.float32], lit: Indices) -> Indices:
    """Find pixels (p,) of the lit ones (n,) above their eight neighbors; of equal ones only the first."""
    rows, columns = response.shape
    found, count = np.empty(len(lit), np.int64), 0
    for i in range(len(lit)):
        y, x = lit[i] // columns, lit[i] % columns
        height, highest = response[y, x], True
        for v in range(max(y - 1, 0), min(y + 2, rows)):
            for u in range(max(x - 1, 0), min(x + 2, columns)):
                earlier = v < y or (v == y and u < x)
                if (v != y or u != x) and not (height > response[v, u] if earlier else height >= response[v, u]):
                    highest = False
        if highest:
            found[count] = i
            count += 1
    return found[:count]


@compiled
def _root(parent: Indices, i: int) -> int:
    """First of the pixels that one is joined with; the way there is shortened."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@compiled
def _join(parent: Indices, i: int, j: int) -> None:
    i, j = _root(parent, i), _root(parent, j)
    parent[max(i, j)] = min(i, j)
