"""Facets of a mesh drawn into the rays of pixels: compiled, facet by facet."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask
from giantlike.core.compiled import compiled

Indices = NDArray[np.int64]
Int32 = NDArray[np.int32]
Float32 = NDArray[np.float32]


@compiled
def drawn(
    places_px: Float,
    nearness: Float,
    corners: Int32,
    number: Int32,
    corner_px: Indices,
    sides: Indices,
    starts: Indices,
    patterns_px: Float,
) -> tuple[Int32, Float]:
    """Find the facet that each ray of some pixels meets first.

    Parameters
    ----------
    places_px : (n, 2) float64, px
        Vertices in the image.
    nearness : (n,) float64, 1/km
        One over their depths.
    corners : (k, 3) int32
        Of the facets, which face the camera.
    number : (h, w) int32
        Of the pixels of a part of the image; -1 for those without rays.
    corner_px : (2,) int64, px
        Column and row of the first pixel of that part.
    sides : (p,) int64
        Rays along the sides of a pixel.
    starts : (p + 1,) int64
        First ray of each pixel, and their number.
    patterns_px : (s, s, s, 2) float64, px
        For each number of rays along a side the places of rays, by row and column, from the middle of the pixel.

    Returns
    -------
    facets : (r,) int32
        Number of the facet of each ray among the k; -1 for none.
    lengths_px : (k,) float64, px
        Longer side of the box around each facet; 0 where it lies outside that part of the image.

    Notes
    -----
    A side that two facets share decides for both of them alike, to the bit: no ray slips between.
    """
    facets, nearest = np.full(starts[-1], -1, np.int32), np.zeros(starts[-1])
    height, width = number.shape
    plane, lengths = np.empty((4, 3)), np.zeros(len(corners))
    for i in range(len(corners)):
        a, b, c = corners[i]
        left = min(places_px[a, 0], places_px[b, 0], places_px[c, 0]) - corner_px[0] + 0.5
        right = max(places_px[a, 0], places_px[b, 0], places_px[c, 0]) - corner_px[0] + 0.5
        top = min(places_px[a, 1], places_px[b, 1], places_px[c, 1]) - corner_px[1] + 0.5
        bottom = max(places_px[a, 1], places_px[b, 1], places_px[c, 1]) - corner_px[1] + 0.5
        if right < 0.0 or bottom < 0.0 or left >= width or top >= height:
            continue
        lengths[i] = max(right - left, bottom - top)
        prepared = False
        for row in range(max(int(top), 0), min(int(bottom), height - 1) + 1):
            for column in range(max(int(left), 0), min(int(right), width - 1) + 1):
                pixel = number[row, column]
                if pixel < 0:
                    continue
                if not prepared:
                    _planes(places_px, nearness, a, b, c, corner_px, plane)
                    prepared = True
                side = sides[pixel]
                first, last = int(max(left - column, 0.0) * side), min(int((right - column) * side), side - 1)
                low, high = int(max(top - row, 0.0) * side), min(int((bottom - row) * side), side - 1)
                for i_row in range(low, high + 1):
                    for i_column in range(first, last + 1):
                        x = column + patterns_px[side - 1, i_row, i_column, 0]
                        y = row + patterns_px[side - 1, i_row, i_column, 1]
                        if (
                            plane[0, 0] + x * plane[0, 1] + y * plane[0, 2] >= 0.0
                            and plane[1, 0] + x * plane[1, 1] + y * plane[1, 2] >= 0.0
                            and plane[2, 0] + x * plane[2, 1] + y * plane[2, 2] >= 0.0
                        ):
                            near = plane[3, 0] + x * plane[3, 1] + y * plane[3, 2]
                            ray = starts[pixel] + i_row * side + i_column
                            if near > nearest[ray]:
                                nearest[ray] = near
                                facets[ray] = i
    return facets, lengths


@compiled
def _planes(places_px: Float, nearness: Float, a: int, b: int, c: int, corner_px: Indices, plane: Float) -> None:
    """Fill in (4, 3) functions linear in the place: of the sides of a facet, positive inside, and its nearness."""
    turn = (places_px[b, 0] - places_px[a, 0]) * (places_px[c, 1] - places_px[a, 1]) - (
        places_px[b, 1] - places_px[a, 1]
    ) * (places_px[c, 0] - places_px[a, 0])
    plane[3] = 0.0
    for k in range(3):
        one, other, third = (b, c, a) if k == 0 else (c, a, b) if k == 1 else (a, b, c)
        share = nearness[third] / abs(turn)
        sign = 1.0 if turn > 0.0 else -1.0
        if one > other:  # a side is the same to the bit for both of its facets
            one, other, sign = other, one, -sign
        x, y = places_px[one, 0] - corner_px[0], places_px[one, 1] - corner_px[1]
        along_x, along_y = places_px[other, 0] - places_px[one, 0], places_px[other, 1] - places_px[one, 1]
        plane[k, 0] = sign * (x * along_y - y * along_x)
        plane[k, 1], plane[k, 2] = -sign * along_y, sign * along_x
        for j in range(3):
            plane[3, j] += share * plane[k, j]


@compiled
def shared(facets: Int32, starts: Indices, small: Mask) -> tuple[Int32, Indices, Indices]:
    """Take rays together that meet the same facet within a pixel, or anywhere on a facet that is small.

    Parameters
    ----------
    facets : (r,) int32
        Of each ray; -1 for none.
    starts : (p + 1,) int64
        First ray of each pixel, and their number.
    small : (k,) bool
        Facets that are.

    Returns
    -------
    group : (r,) int32
        Number of the group of each ray; -1 of those that meet nothing.
    chosen : (g,) int64
        One ray of each group: the middle one in their order.
    pixels : (g,) int64
        Their pixels.
    """
    total = len(facets)
    group, of_facet = np.full(total, -1, np.int32), np.full(len(small), -1, np.int32)
    size, count = np.zeros(total, np.int32), 0
    for pixel in range(len(starts) - 1):
        before = count
        for ray in range(starts[pixel], starts[pixel + 1]):
            facet = facets[ray]
            if facet < 0:
                continue
            found = of_facet[facet]
            if found < 0 or (found < before and not small[facet]):
                found = count
                of_facet[facet] = count
                count += 1
            group[ray] = found
            size[found] += 1
    chosen, pixels = np.empty(count, np.int64), np.empty(count, np.int64)
    size //= 2
    for pixel in range(len(starts) - 1):
        for ray in range(starts[pixel], starts[pixel + 1]):
            one = group[ray]
            if one >= 0:
                if size[one] == 0:
                    chosen[one], pixels[one] = ray, pixel
                size[one] -= 1
    return group, chosen, pixels


@compiled
def met(
    from_camera_km: Float, places_px: Float, nearness: Float, corners: Int32, rays_px: Float
) -> tuple[Float, Float]:
    """Find where rays meet facets.

    Parameters
    ----------
    from_camera_km : (n, 3) float64, km
        Vertices, from the camera.
    places_px, nearness : (n, 2), (n,) float64
        As of :func:`drawn`.
    corners : (g, 3) int32
        Of the facet of each ray.
    rays_px : (g, 2) float64, px

    Returns
    -------
    from_camera_km : (g, 4) float64, km
        The points, and zeros.
    directions : (g, 4) float64
        Unit vectors to these, and zeros.
    """
    points, directions = np.zeros((len(corners), 4)), np.zeros((len(corners), 4))
    for i in range(len(corners)):
        x, y = rays_px[i]
        total = 0.0
        for k in range(3):
            one, other, third = corners[i, (k + 1) % 3], corners[i, (k + 2) % 3], corners[i, k]
            share = (x - places_px[one, 0]) * (places_px[other, 1] - places_px[one, 1])
            share -= (y - places_px[one, 1]) * (places_px[other, 0] - places_px[one, 0])
            share *= nearness[third]
            total += share
            for axis in range(3):
                points[i, axis] += share * from_camera_km[third, axis]
        square = 0.0
        for axis in range(3):
            points[i, axis] /= total
            square += points[i, axis] ** 2
        for axis in range(3):
            directions[i, axis] = points[i, axis] / math.sqrt(square)
    return points, directions
