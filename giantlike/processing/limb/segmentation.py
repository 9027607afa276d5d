"""Bodies as patches of light: thresholds, connected blobs, and which blob is which body."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, require
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.statistics import robust_sigma
from giantlike.core.values import Value

_CLIP_SIGMAS, _CLIP_ROUNDS = 3.0, 8  # usual clipping of bright pixels; rounds end earlier when nothing is clipped
_NOT_THE_BODY = 1e6  # cost of an assignment that must not be
_RIVAL_COST = 1.0  # additional cost up to which an assignment is ambiguous


@dataclass(frozen=True, slots=True, kw_only=True)
class Background:
    """Level and noise of the sky background."""

    level_dn: float
    sigma_dn: float

    def threshold_dn(self, sigmas: float) -> float:
        """Brightness above which pixels are light."""
        return self.level_dn + sigmas * self.sigma_dn


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Blobs(Value):
    """Connected patches of light, largest first."""

    centroids_px: Float  # (n, 2); of the brightness above background
    middles_px: Float  # (n, 2); of the area
    areas_px: NDArray[np.int64]  # (n,); numbers of pixels
    boxes_px: NDArray[np.int64]  # (n, 4); first column and row, width and height
    flux_dn: Float  # (n,); sum of the brightness above background
    labels: NDArray[np.int32]  # (rows, columns); 1 for the first blob and so on, 0 elsewhere

    def __len__(self) -> int:
        return len(self.areas_px)

    @property
    def touch_frame(self) -> Mask:
        """True for blobs (n,) that reach the edge of the image."""
        rows, columns = self.labels.shape
        low, high = self.boxes_px[:, :2], self.boxes_px[:, :2] + self.boxes_px[:, 2:]
        result: Mask = np.any(low <= 0, axis=1) | np.any(high >= [columns, rows], axis=1)
        return result


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpectedBlob:
    """Expected position, size and brightness of a body."""

    center_px: tuple[float, float]  # of its light
    area_px: float  # illuminated part of its disk
    flux_dn: float = math.nan  # its total flux, where the camera is calibrated; NaN if unknown
    log_flux_sigma: float = 0.3  # standard deviation of the logarithm of ``flux_dn``

    def __post_init__(self) -> None:
        require(math.isfinite(self.area_px) and self.area_px > 0, f"area_px must be > 0, got {self.area_px}")
        require(self.log_flux_sigma > 0, f"log_flux_sigma must be > 0, got {self.log_flux_sigma}")


def otsu_threshold(values: Float, *, bins: int = 1024) -> float:
    """Otsu's threshold, which parts values (n,) into two classes with the largest variance between them.

    Source: Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, "Moment Algorithms".
    """
    require(bins >= 2, f"bins must be >= 2, got {bins}")
    require(values.size > 0 and bool(np.isfinite(values).all()), "values must be finite, and there must be some")
    low, high = float(values.min()), float(values.max())
    require(low < high, f"all values are {low:g}: no threshold parts them")
    counts, edges = np.histogram(values, bins=bins, range=(low, high))
    sums, _ = np.histogram(values, bins=bins, range=(low, high), weights=values - low)
    below = np.cumsum(counts)[:-1].astype(np.float64)
    light = np.cumsum(sums)[:-1]
    above = values.size - below
    between = np.where(
        (below > 0) & (above > 0),
        (light * values.size - sums.sum() * below) ** 2 / np.maximum(below * above, 1.0),
        -1.0,
    )
    best = np.flatnonzero(between >= between.max() * (1.0 - 1e-12))
    gap = best[: int(np.argmax(np.append(np.diff(best), 2) > 1)) + 1]  # bins without values between the classes
    return float(edges[1:-1][gap].mean())


def background_of(values: Float) -> Background:
    """Median level and noise, by absolute deviation, of the sky of pixels (n,) of which less than half are bright."""
    require(values.size > 0, "no pixels to take a background from")
    kept = values
    for _ in range(_CLIP_ROUNDS):
        level = float(np.median(kept))
        sigma = robust_sigma(kept, level)
        inside = np.abs(kept - level) <= _CLIP_SIGMAS * sigma
        if sigma == 0.0 or inside.all():
            break
        kept = kept[inside]
    return Background(level_dn=level, sigma_dn=sigma)


def connected_blobs(pixels_dn: Float, light: Mask, *, level_dn: float = 0.0, min_area_px: int = 1) -> Blobs:
    """Join neighboring light pixels (also across corners) and measure each patch; arrays (rows, columns)."""
    require(pixels_dn.shape == light.shape, f"pixels {pixels_dn.shape} and light {light.shape} differ in shape")
    count, labels, statistics, middles = cv2.connectedComponentsWithStats(light.astype(np.uint8), connectivity=8)
    areas = statistics[:, cv2.CC_STAT_AREA]
    kept = 1 + np.flatnonzero(areas[1:] >= min_area_px)
    kept = kept[np.argsort(-areas[kept], kind="stable")]
    number = np.zeros(count, dtype=np.int32)
    number[kept] = np.arange(1, kept.size + 1)
    labels = number[labels]
    rows, columns = np.nonzero(labels)
    which = labels[rows, columns]
    signal = pixels_dn[rows, columns] - level_dn
    flux, x, y = (np.bincount(which, part, kept.size + 1)[1:] for part in (signal, signal * columns, signal * rows))
    with np.errstate(divide="ignore", invalid="ignore"):
        centroids = np.stack([x / flux, y / flux], axis=-1)
    return Blobs(
        centroids_px=np.where(flux[:, None] > 0, centroids, middles[kept]),
        middles_px=np.asarray(middles[kept], dtype=np.float64),
        areas_px=areas[kept].astype(np.int64),
        boxes_px=statistics[kept, :4].astype(np.int64),
        flux_dn=np.asarray(flux, dtype=np.float64),
        labels=labels,
    )


def identify_blobs(
    blobs: Blobs, expected: Sequence[ExpectedBlob], *, search_px: float, log_area_sigma: float = 0.3
) -> NDArray[np.int64] | Failure:
    """Assign blobs to bodies by position, size and, where known, brightness.

    Each pair costs the squares of its distance over ``search_px`` / 3, of the logarithm of its areas and of its fluxes,
    over their sigmas; the cheapest assignment about the shift of any first pair (an error of pointing costs once) wins.

    Source: Thrasher et al., Development of the Optical Deep-Space Instrument for Navigation, "OpNav Target
    Identification".
    """
    require(len(expected) > 0, "identify_blobs needs at least one expected body")
    require(search_px > 0 and log_area_sigma > 0, "search_px and log_area_sigma must be > 0")
    places = np.array([one.center_px for one in expected], dtype=np.float64)
    looks = _looks(blobs, expected, log_area_sigma)
    found = _assignments(blobs, places, looks, search_px)
    if not found:
        return Failure(
            Reason.NO_SIGNAL,
            f"none of the {len(blobs)} blobs of light has the size of a body and lies within {search_px:g} px of its "
            f"place ({len(expected)} expected): stray light may join it to others",
        )
    order = sorted(found, key=lambda chosen: found[chosen])
    if len(order) > 1 and found[order[1]] - found[order[0]] < _RIVAL_COST:
        return Failure(
            Reason.AMBIGUOUS,
            f"two assignments of {len(blobs)} blobs to {len(expected)} bodies fit as well as the other",
        )
    return np.array(order[0], dtype=np.int64)


def _assignments(blobs: Blobs, places: Float, looks: Float, search_px: float) -> dict[tuple[int, ...], float]:
    """Assignments of blobs to bodies and their costs, about the shift of every first pair."""
    found: dict[tuple[int, ...], float] = {}
    for body in range(len(places)):
        for blob in range(len(blobs)):
            shift = blobs.centroids_px[blob] - places[body]
            if np.linalg.norm(shift) > search_px:
                continue
            chosen, cost = _assign(blobs.centroids_px, places + shift, looks, search_px, len(places))
            if chosen is not None:
                total = cost + float(shift @ shift) / (search_px / 3.0) ** 2
                found[chosen] = min(found.get(chosen, math.inf), total)
    return found


def _looks(blobs: Blobs, expected: Sequence[ExpectedBlob], log_area_sigma: float) -> Float:
    """Cost (bodies, blobs) of the differences in area and flux."""
    areas = np.array([one.area_px for one in expected])
    cost = (np.log(blobs.areas_px[None] / areas[:, None]) / log_area_sigma) ** 2
    flux = np.array([one.flux_dn for one in expected])
    sigma = np.array([one.log_flux_sigma for one in expected])
    with np.errstate(divide="ignore", invalid="ignore"):
        by_flux = (np.log(np.maximum(blobs.flux_dn[None], 1e-12) / flux[:, None]) / sigma[:, None]) ** 2
    result: Float = cost + np.where(np.isfinite(by_flux), by_flux, 0.0)
    return result


def _assign(
    centroids_px: Float, places_px: Float, looks: Float, search_px: float, count: int
) -> tuple[tuple[int, ...] | None, float]:
    """The cheapest assignment of blobs to bodies at given positions, and its cost."""
    from scipy.optimize import linear_sum_assignment

    distance = np.linalg.norm(centroids_px[None] - places_px[:, None], axis=-1)
    cost = looks + (distance / (search_px / 3.0)) ** 2
    cost = np.where((distance <= search_px) & (looks < 25.0), cost, _NOT_THE_BODY)
    rows, columns = linear_sum_assignment(cost)
    total = float(cost[rows, columns].sum())
    if rows.size < count or total >= _NOT_THE_BODY:
        return None, math.inf
    return tuple(int(column) for column in columns), total
