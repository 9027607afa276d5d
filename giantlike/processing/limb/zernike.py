"""Edges to a fraction of a pixel by Zernike moments of small windows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, require
from giantlike.core.values import Value
from giantlike.processing.limb.edges import EdgePoints, Pixels, WindowEdges, measured_edges

SIZES = (5, 7)  # sides of the windows that have kernels, px
_SUBPIXELS = 101  # along a pixel, for the integrals of the kernels
_NODES, _REACH_SIGMAS = 41, 5.0  # nodes and range, sigmas, of the sum over the blur: a Gaussian is integrated to 1e-6
_TABLE = np.linspace(-0.65, 0.65, 261)  # distance of the edge / radius of the window
_PIXEL_AND_HOLD_PX2 = 2.0 / 12.0  # variance of the pixel, and of holding its value over its area
_TRIALS = 32  # directions of edges in a right angle for the error of sampling


def zernike_edges(
    pixels_dn: Float,
    usable: Mask,
    seeds_px: Pixels,
    *,
    variance_dn2: Callable[[Float], Float],
    blur_sigma_px: float = 0.0,
    size: int = 7,
    curvature_px: float = 0.0,
) -> EdgePoints:
    r"""Measure edges by Zernike moments of windows of 5 x 5 or 7 x 7 pixels.

    ``pixels_dn`` (rows, columns); ``seeds_px`` (n, 2), pixels (x, y) near the edge, as of ``scan_edges``; ``size`` in
    px; ``curvature_px`` in 1/px, of the edge: 1 over the radius of a bright disk, negative for a dark one.

    With ``A11`` and ``A20`` the integrals of the image times ``x + iy`` and ``2 rho^2 - 1`` over the circle in the
    window (radius ``size / 2`` px: 2.5 and 3.5), a step of height k at distance l has ``|A11| = 2/3 k (1 - l^2)^(3/2)``
    and ``A20 = l |A11|``; the argument of ``A11`` points to the light. The kernels are these polynomials integrated
    over each pixel. Blur (the point spread function, the pixel, and holding its value over its area: 1/12 px^2 each)
    averages both over l, and curvature removes a segment; their ratio is tabulated with both and inverted. The sampling
    error, which depends on where an edge crosses the pixels, is measured on straight edges and added to ``sigma_px``.
    """
    require(size in SIZES, f"size must be 5 or 7, got {size}")
    table = _table(size, round(float(blur_sigma_px), 6))

    def measure(windows: Float) -> WindowEdges:
        return _find_edges(windows, table, curvature_px * table.radius_px, variance_dn2)

    return measured_edges(pixels_dn, usable, seeds_px, half_px=size // 2, measure=measure)


def zernike_kernels(size: int) -> tuple[NDArray[np.complex128], Float]:
    """Kernels (size, size) of the moments A11 and A20: ``x + iy`` and ``2 rho^2 - 1`` integrated over each pixel.

    Unit of length is the radius of the circle, ``size / 2`` px; both sum up to zero.

    >>> first, second = zernike_kernels(5)
    >>> bool(abs(first.sum()) < 1e-12), bool(abs(second.sum()) < 1e-3)
    (True, True)
    """
    places = (np.arange(size * _SUBPIXELS) + 0.5) / (0.5 * size * _SUBPIXELS) - 1.0
    x, y = np.meshgrid(places, places)
    rho2 = x**2 + y**2
    inside = rho2 <= 1.0
    area = (2.0 / (size * _SUBPIXELS)) ** 2

    def integrate(values: Float) -> Float:
        cells = np.where(inside, values, 0.0).reshape(size, _SUBPIXELS, size, _SUBPIXELS)
        result: Float = area * cells.sum(axis=(1, 3))
        return result

    return integrate(x) + 1j * integrate(y), integrate(2.0 * rho2 - 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Table(Value):
    """Kernels, and the inverted ratio of the moments: all that depends on size and blur alone."""

    first: NDArray[np.complex128]
    second: Float
    ratio: Float  # A20 over |A11| at the distances of ``_TABLE``
    per_curvature: Float  # its change with the curvature (in radii of the window)
    height: Float  # |A11| of a step of height one
    radius_px: float
    sampling_px: float

    def distance(self, ratio: Float, curvature: float) -> tuple[Float, Float]:
        """Distance of the edge and its derivative with the ratio; NaN outside the table."""
        expected = self.ratio + curvature * self.per_curvature
        slope = np.gradient(_TABLE, expected)
        found = np.interp(ratio, expected, _TABLE, left=np.nan, right=np.nan)
        return found, np.interp(ratio, expected, slope)


@lru_cache(maxsize=32)
def _table(size: int, blur_sigma_px: float) -> _Table:
    first, second = zernike_kernels(size)
    radius = 0.5 * size
    width = math.sqrt(blur_sigma_px**2 + _PIXEL_AND_HOLD_PX2) / radius
    nodes = np.linspace(-_REACH_SIGMAS, _REACH_SIGMAS, _NODES) * width
    weights = np.exp(-0.5 * (nodes / width) ** 2)
    weights /= weights.sum()
    place = _TABLE[:, None] + nodes
    chord2 = np.maximum(1.0 - place**2, 0.0)
    chord = np.sqrt(chord2)
    step_11 = (2.0 / 3.0) * chord**3
    step_20 = place * step_11
    # light minus a segment of height c (y^2 + width^2) / 2, along the chord -chord < y < chord
    bent_11 = -0.5 * place * ((2.0 / 3.0) * chord**3 + 2.0 * width**2 * chord)
    inner = 2.0 * place**2 - 1.0
    bent_20 = -0.5 * (
        inner * ((2.0 / 3.0) * chord**3 + 2.0 * width**2 * chord) + 0.8 * chord**5 + (4.0 / 3.0) * width**2 * chord**3
    )
    a11, a20, b11, b20 = (part @ weights for part in (step_11, step_20, bent_11, bent_20))
    ratio = a20 / a11
    bare = _Table(
        first=first,
        second=second,
        ratio=ratio,
        per_curvature=(b20 - ratio * b11) / a11,
        height=a11,
        radius_px=radius,
        sampling_px=0.0,
    )
    return replace(bare, sampling_px=_sampling_px(bare, blur_sigma_px))


def _sampling_px(table: _Table, blur_sigma_px: float) -> float:
    """Root mean square error, px, on straight edges without noise, over directions and positions in the pixel."""
    size = len(table.second)
    angles = (np.arange(_TRIALS) + 0.5) * (0.5 * np.pi / _TRIALS)
    places = np.linspace(-0.5, 0.5, 11)[:-1]
    fine = (np.arange(size * 15) + 0.5) / 15 - 0.5 * size
    x, y = np.meshgrid(fine, fine)
    turn, off = (part.ravel() for part in np.meshgrid(angles, places))
    depth = np.cos(turn)[:, None, None] * x + np.sin(turn)[:, None, None] * y - off[:, None, None]
    if blur_sigma_px > 0:
        from scipy.special import ndtr

        light = ndtr(depth / blur_sigma_px)
    else:
        light = (depth > 0).astype(np.float64)
    windows = light.reshape(-1, size, 15, size, 15).mean(axis=(2, 4))
    found = _find_edges(windows, table, 0.0, np.zeros_like)
    error = np.einsum("ij,ij->i", found.offsets_px, np.stack([np.cos(turn), np.sin(turn)], axis=-1)) - off
    return float(np.sqrt(np.mean(error**2)))


def _find_edges(windows: Float, table: _Table, curvature: float, variance_dn2: Callable[[Float], Float]) -> WindowEdges:
    """Edges of windows (n, size, size)."""
    a11 = np.einsum("nij,ij->n", windows, table.first)
    a20 = np.einsum("nij,ij->n", windows, table.second)
    size = np.abs(a11)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = a20 / size
        distance, slope = table.distance(ratio, curvature)
        to_light = a11 / size
        height = size / np.interp(distance, _TABLE, table.height)
        # d|A11| = Re(conj(to_light) K11) dI, and the part across it rotates the normal
        turned = np.conj(to_light)[:, None, None] * table.first
        gain = (slope / size)[:, None, None] * (table.second - ratio[:, None, None] * turned.real)
        turn = turned.imag / size[:, None, None]
    noise = variance_dn2(windows)
    direction = np.stack([to_light.real, to_light.imag], axis=-1)
    across = table.radius_px * np.sqrt(np.einsum("nij,nij,nij->n", gain, gain, noise))
    return WindowEdges(
        offsets_px=table.radius_px * distance[:, None] * direction,
        normals_px=-direction,
        sigma_px=np.hypot(across, table.sampling_px),
        sigma_normal_rad=np.sqrt(np.einsum("nij,nij,nij->n", turn, turn, noise)),
        contrast_dn=height,
    )
