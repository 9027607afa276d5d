"""Rays near a horizon against its cone, compiled: distances, and how the horizon moves and bends there."""

from __future__ import annotations

import math

import numpy as np

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float


@compiled
def distances(
    directions: Float, by_pixel: Float, pull: Float, conic: Float, shape: Float, steps: int
) -> tuple[Float, Float, Float]:
    """Find the nearest points of a horizon by Newton steps.

    ``directions`` (n, 3), camera axes; ``by_pixel`` (n, 3, 2) 1/px; ``pull`` (3,) 1/km; ``conic`` (3, 3) 1/km^2, of its
    cone: see :meth:`~giantlike.relative.horizon.geometry.Figure.cone`; ``shape`` (3, 3) 1/km^2; returns ``outward_px``
    (n,), distances of the pixels from the horizon, positive outside; ``by_position`` (n, 3) px/km, motion of the
    horizon outward with the position; ``normals_px`` (n, 2), outward.
    """
    count = len(directions)
    outward, by_position, normals = np.empty(count), np.empty((count, 3)), np.empty((count, 2))
    ray, half, shaped = np.empty(3), np.empty(3), np.empty(3)
    for k in range(count):
        x = y = by_x = by_y = 0.0
        for _ in range(steps):
            for i in range(3):
                ray[i] = directions[k, i] + by_pixel[k, i, 0] * x + by_pixel[k, i, 1] * y
            value = by_x = by_y = 0.0
            for i in range(3):
                half[i] = ray[0] * conic[0, i] + ray[1] * conic[1, i] + ray[2] * conic[2, i]
                value += half[i] * ray[i]
                by_x += 2.0 * half[i] * by_pixel[k, i, 0]
                by_y += 2.0 * half[i] * by_pixel[k, i, 1]
            step = value / (by_x * by_x + by_y * by_y)
            x -= step * by_x
            y -= step * by_y
        slope = math.sqrt(by_x * by_x + by_y * by_y)
        normals[k, 0], normals[k, 1] = -by_x / slope, -by_y / slope  # the form is positive inside
        outward[k] = -x * normals[k, 0] - y * normals[k, 1]
        along = across = 0.0
        for i in range(3):
            shaped[i] = ray[0] * shape[0, i] + ray[1] * shape[1, i] + ray[2] * shape[2, i]
            along += ray[i] * pull[i]
            across += shaped[i] * ray[i]
        for i in range(3):
            by_position[k, i] = 2.0 * (along * shaped[i] - across * pull[i]) / slope
    return outward, by_position, normals


@compiled
def curvatures(directions: Float, by_pixel: Float, normals_px: Float, conic: Float) -> Float:
    """Curvature of a horizon in the image. ``normals_px`` (n, 2); returns (n,) 1/px."""
    result = np.empty(len(directions))
    for k in range(len(directions)):
        slope = bend = 0.0
        for i in range(3):
            along = by_pixel[k, i, 1] * normals_px[k, 0] - by_pixel[k, i, 0] * normals_px[k, 1]
            for j in range(3):
                across = by_pixel[k, j, 0] * normals_px[k, 0] + by_pixel[k, j, 1] * normals_px[k, 1]
                there = by_pixel[k, j, 1] * normals_px[k, 0] - by_pixel[k, j, 0] * normals_px[k, 1]
                slope += directions[k, i] * conic[i, j] * across
                bend += along * conic[i, j] * there
        result[k] = bend / slope
    return result
