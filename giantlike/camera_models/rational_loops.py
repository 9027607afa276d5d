"""Projection through lenses of rational radial, decentering and thin-prism distortion: compiled, point by point.

A lens is an array (17,) of ``fx_px, fy_px, cx_px, cy_px, skew_px, k1, ..., k6, p1, p2, s1, ..., s4``.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np

from giantlike._system.compiled import compiled
from giantlike.camera_models.plane import LAST_STEP, MAX_NEWTON_STEPS, STEP_PER_ERROR
from giantlike.core.arrays import Float

Coordinate = TypeVar("Coordinate", float, Float)


def distort(x: Coordinate, y: Coordinate, lens: Float) -> tuple[Coordinate, Coordinate]:
    """Distorted coordinates of points of the image plane, by the 17 values of a lens.

    Source: Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, eqs. 6 and 7.
    """
    k1, k2, k3, k4, k5, k6, p1, p2 = lens[5], lens[6], lens[7], lens[8], lens[9], lens[10], lens[11], lens[12]
    xx, xy, yy = x * x, x * y, y * y
    r2 = xx + yy
    radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    u = radial * x + (2.0 * p1 * xy + p2 * (3.0 * xx + yy)) + r2 * (lens[13] + r2 * lens[14])
    v = radial * y + (p1 * (xx + 3.0 * yy) + 2.0 * p2 * xy) + r2 * (lens[15] + r2 * lens[16])
    return u, v


def slopes(x: Coordinate, y: Coordinate, lens: Float) -> tuple[Coordinate, Coordinate, Coordinate, Coordinate]:
    """Derivative of :func:`distort`. ``lens`` (17,); returns ``ux``, ``uy``, ``vx``, ``vy`` as ``x``."""
    k1, k2, k3, k4, k5, k6, p1, p2 = lens[5], lens[6], lens[7], lens[8], lens[9], lens[10], lens[11], lens[12]
    r2 = x * x + y * y
    denominator = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / denominator
    growth = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3) - radial * (k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6)))
    growth = growth / denominator  # twice the derivative of ``radial`` by r^2
    cross = growth * x * y + 2.0 * (p1 * x + p2 * y)
    prism_x, prism_y = 2.0 * (lens[13] + 2.0 * r2 * lens[14]), 2.0 * (lens[15] + 2.0 * r2 * lens[16])
    return (
        radial + growth * x * x + 2.0 * p1 * y + 6.0 * p2 * x + prism_x * x,
        cross + prism_x * y,
        cross + prism_y * x,
        radial + growth * y * y + 6.0 * p1 * y + 2.0 * p2 * x + prism_y * y,
    )


_distort, _slopes = compiled(distort), compiled(slopes)


@compiled
def project(points: Float, lens: Float, limit: float) -> Float:
    """Pixels (n, 2) of points (n, 3), camera axes; NaN behind the camera and beyond the limit. ``lens`` (17,)."""
    pixels = np.empty((len(points), 2))
    for i in range(len(points)):
        x, y = _on_plane(points[i, 0], points[i, 1], points[i, 2], limit)
        u, v = _distort(x, y, lens)
        pixels[i, 0] = lens[0] * u + lens[4] * v + lens[2]
        pixels[i, 1] = lens[1] * v + lens[3]
    return pixels


@compiled
def projected_slopes(points: Float, lens: Float, limit: float) -> Float:
    """Derivatives (n, 2, 3) of :func:`project` by the points (n, 3), camera axes. ``lens`` (17,)."""
    result = np.empty((len(points), 2, 3))
    for i in range(len(points)):
        _fill_slopes(points[i, 0], points[i, 1], points[i, 2], lens, limit, result[i])
    return result


@compiled
def unproject(pixels: Float, lens: Float, limit: float, mapped: Float, radii: Float) -> Float:
    """Directions (n, 3) of pixels (n, 2), by Newton's method from the radial profile; NaN where nothing is imaged."""
    directions = np.empty((len(pixels), 3))
    for i in range(len(pixels)):
        v = (pixels[i, 1] - lens[3]) / lens[1]
        u = (pixels[i, 0] - lens[2] - lens[4] * v) / lens[0]
        x, y = _undistort(u, v, lens, limit, mapped, radii)
        z = 1.0 / math.sqrt(1.0 + x * x + y * y)
        directions[i, 0], directions[i, 1], directions[i, 2] = x * z, y * z, z
    return directions


@compiled
def unprojected_slopes(pixels: Float, lens: Float, limit: float, mapped: Float, radii: Float) -> Float:
    """Derivatives (n, 3, 2) of :func:`unproject` by the pixels (n, 2), 1/px."""
    result, by_point = np.empty((len(pixels), 3, 2)), np.empty((2, 3))
    directions = unproject(pixels, lens, limit, mapped, radii)
    for i in range(len(pixels)):
        _fill_slopes(directions[i, 0], directions[i, 1], directions[i, 2], lens, limit, by_point)
        a = b = d = 0.0  # the pseudo-inverse: the length of a vector does not change its pixel
        for axis in range(3):
            a += by_point[0, axis] * by_point[0, axis]
            b += by_point[0, axis] * by_point[1, axis]
            d += by_point[1, axis] * by_point[1, axis]
        scale = 1.0 / (a * d - b * b)
        for axis in range(3):
            result[i, axis, 0] = scale * (d * by_point[0, axis] - b * by_point[1, axis])
            result[i, axis, 1] = scale * (a * by_point[1, axis] - b * by_point[0, axis])
    return result


@compiled
def _on_plane(x: float, y: float, z: float, limit: float) -> tuple[float, float]:
    """Gnomonic coordinates; NaN behind the camera and beyond the limit."""
    inverse = 1.0 / z
    x, y = x * inverse, y * inverse
    if z > 0.0 and x * x + y * y <= limit * limit:
        return x, y
    return math.nan, math.nan


@compiled
def _fill_slopes(x: float, y: float, z: float, lens: Float, limit: float, result: Float) -> None:
    """Derivative (2, 3) of a pixel by its point."""
    px, py = _on_plane(x, y, z, limit)
    ux, uy, vx, vy = _slopes(px, py, lens)
    ux, uy = lens[0] * ux + lens[4] * vx, lens[0] * uy + lens[4] * vy
    vx, vy = lens[1] * vx, lens[1] * vy
    result[0, 0], result[0, 1], result[0, 2] = ux / z, uy / z, -(ux * px + uy * py) / z
    result[1, 0], result[1, 1], result[1, 2] = vx / z, vy / z, -(vx * px + vy * py) / z


@compiled
def _undistort(u: float, v: float, lens: Float, limit: float, mapped: Float, radii: Float) -> tuple[float, float]:
    """Point that is imaged at another; NaN if none within the limit is. See PlaneModel."""
    start = _start(math.hypot(u, v), mapped, radii)
    x, y = u * start, v * start
    for _ in range(MAX_NEWTON_STEPS):
        at_u, at_v = _distort(x, y, lens)
        ux, uy, vx, vy = _slopes(x, y, lens)
        inverse = 1.0 / (ux * vy - uy * vx)
        du, dv = at_u - u, at_v - v
        near_x, near_y = x - (vy * du - uy * dv) * inverse, y - (ux * dv - vx * du) * inverse
        step, error = abs(near_x - x) + abs(near_y - y), abs(du) + abs(dv)
        radius = math.hypot(near_x, near_y)
        outside = radius > limit
        if outside:
            back = 0.5 * (min(math.hypot(x, y), limit) + limit) / radius
            near_x, near_y = near_x * back, near_y * back
        x, y = near_x, near_y
        if not (max(step, STEP_PER_ERROR * error) > LAST_STEP * (1.0 + radius) or outside):
            return x, y
    return math.nan, math.nan


@compiled
def _start(distance: float, mapped: Float, radii: Float) -> float:
    """Factor on a distorted point that removes the mean of the distortion over azimuth."""
    if not distance > 0.0:
        return float(radii[0] + distance)  # not a number where the distance is none
    last = len(mapped) - 1
    if distance >= mapped[last]:
        return float(radii[last] / distance)
    i = max(int(np.searchsorted(mapped, distance, side="right")), 1)
    share = (distance - mapped[i - 1]) / (mapped[i] - mapped[i - 1])
    return float((radii[i - 1] + share * (radii[i] - radii[i - 1])) / distance)
