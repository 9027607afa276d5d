"""Edges to a fraction of a pixel by the partial area effect: the illuminated fraction of each column of pixels."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from giantlike.core.arrays import Float, Mask, require
from giantlike.processing.limb.edges import EdgePoints, Pixels, WindowEdges, measured_edges

_CLEAR_PX, _CLEAR_SIGMAS = 2.2, 2.3
"""Half height of the columns: an edge of slope 1 half a pixel off, the far corner of the outer column, and the blur."""


def partial_area_edges(
    pixels_dn: Float,
    usable: Mask,
    seeds_px: Pixels,
    *,
    variance_dn2: Callable[[Float], Float],
    blur_sigma_px: float = 0.0,
) -> EdgePoints:
    r"""Measure edges as parabolas through three columns of pixels.

    ``pixels_dn`` (rows, columns); ``seeds_px`` (n, 2), pixels (x, y) near the edge, as of ``scan_edges``.

    The method of Trujillo-Pino, rederived with blur. The window is rotated so that the edge runs closer to its rows,
    light below: ``v = a + b u + c u^2``. Each column is so high that its ends see light and dark alone, even through
    the point spread function. Its sum, minus dark and divided by the contrast, is then the height of light in it. Blur
    along the column does not change it; blur along the rows, like the mean over the column's width, changes it by c
    times its variance: the heights of the columns at -1, 0 and 1 are ``a + c q``, ``+- b + c`` more at the sides, with
    ``q = sigma^2 + 1/12``. All but the division by the contrast is linear in the pixels, so that their noise propagates
    by one derivative. Exact for steps; a brightness that changes within the window moves the edge, by half its relative
    slope times the square of the half height.
    """
    require(math.isfinite(blur_sigma_px) and blur_sigma_px >= 0, f"blur_sigma_px must be >= 0, got {blur_sigma_px}")
    half = math.ceil(_CLEAR_PX + _CLEAR_SIGMAS * blur_sigma_px)
    spread_px2 = blur_sigma_px**2 + 1.0 / 12.0

    def measure(windows: Float) -> WindowEdges:
        return _find_edges(windows, half, spread_px2, variance_dn2)

    return measured_edges(pixels_dn, usable, seeds_px, half_px=half, measure=measure)


def _find_edges(windows: Float, half: int, spread_px2: float, variance_dn2: Callable[[Float], Float]) -> WindowEdges:
    """Edges of windows (n, 2 half + 1, 2 half + 1), [row, column]."""
    core = windows[:, half - 1 : half + 2, half - 1 : half + 2]
    down = (core[:, 2] - core[:, 0]).sum(axis=1)
    right = (core[:, :, 2] - core[:, :, 0]).sum(axis=1)
    sideways = np.abs(right) > np.abs(down)
    turned = np.where(sideways[:, None, None], np.swapaxes(windows, 1, 2), windows)  # the edge along its rows
    light_up = np.where(sideways, right, down) > 0
    turned = np.where(light_up[:, None, None], turned[:, ::-1], turned)[:, :, half - 1 : half + 2]  # light first
    rising = np.where(sideways, down, right) > 0  # more light at u = 1, so that b > 0
    turned = np.where(rising[:, None, None], turned, turned[:, :, ::-1])
    a, b, c, contrast, gain_a, gain_b = _parabola(turned, half, spread_px2)
    noise = variance_dn2(turned)
    scale = 1.0 / np.hypot(1.0, b)
    offset, normal = _nearest(a, b, c)
    flip_u, flip_v = np.where(rising, 1.0, -1.0), np.where(light_up, -1.0, 1.0)

    def back(vectors: Float) -> Float:
        vectors = vectors * np.stack([flip_u, flip_v], axis=-1)
        return np.where(sideways[:, None], vectors[:, ::-1], vectors)

    # the point moves with a, and with b where it is not at u = 0
    gain = gain_a + offset[:, 0, None, None] * gain_b
    return WindowEdges(
        offsets_px=back(offset),
        normals_px=back(normal),
        sigma_px=scale * np.sqrt(np.einsum("nij,nij,nij->n", gain, gain, noise)),
        sigma_normal_rad=scale**2 * np.sqrt(np.einsum("nij,nij,nij->n", gain_b, gain_b, noise)),
        contrast_dn=contrast,
    )


def _parabola(columns: Float, half: int, spread_px2: float) -> tuple[Float, Float, Float, Float, Float, Float]:
    """Parabola of columns (n, 2 half + 1, 3), light first and more at the right: a, b, c, contrast, da/dI, db/dI."""
    light, dark = np.zeros(columns.shape[1:]), np.zeros(columns.shape[1:])
    light[0, 1:] = light[1, 2] = 1.0 / 3.0  # the corners that the edge leaves free
    dark[-1, :2] = dark[-2, 0] = 1.0 / 3.0
    sums = np.stack([np.broadcast_to(np.arange(3) == k, columns.shape[1:]) for k in range(3)]).astype(np.float64)
    half_sum = 0.5 * (2 * half + 1) * (light + dark)
    bend = 0.5 * (sums[0] + sums[2]) - sums[1]
    along = 0.5 * (sums[2] - sums[0])
    height = sums[1] - half_sum - spread_px2 * bend
    contrast = np.einsum("nij,ij->n", columns, light - dark)
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b, c = (np.einsum("nij,ij->n", columns, part) / contrast for part in (height, along, bend))
        gains = [
            (part - value[:, None, None] * (light - dark)) / contrast[:, None, None]
            for part, value in ((height, a), (along, b))
        ]
    return a, b, c, contrast, gains[0], gains[1]


def _nearest(a: Float, b: Float, c: Float) -> tuple[Float, Float]:
    """Nearest point (n, 2) of the parabola to the middle and the normal (n, 2) there, towards dark: +v."""
    u = -a * b / (1.0 + b**2)
    slope = b + 2.0 * c * u
    normal = np.stack([-slope, np.ones_like(slope)], axis=-1) / np.hypot(1.0, slope)[:, None]
    return np.stack([u, a + b * u + c * u**2], axis=-1), normal
