"""Square cut-outs of an image around its sources, with the noise of their pixels: the data of all fits of sources."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf

from giantlike.core.arrays import Float, Mask
from giantlike.core.detector import Detector
from giantlike.core.values import Value, select_rows

MIN_PSF_SIGMA_PX = 0.25
"""Narrowest point spread function fitted, px: of a narrower one more than 91 % of the light falls on one pixel, and a
fit of its width has no gradient."""
PIXEL_VARIANCE_PX2 = 1.0 / 12.0
"""Second moment of a square pixel of unit side, px^2, which integration over pixels adds to a source."""
CHI2_SIGMAS = 4.0
"""Excess of a reduced chi-square over 1, in units of ``sqrt(2 / dof)``, from which on it scales a covariance:
noise alone exceeds them once in 30,000 sources."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patches(Value):
    """Square cut-outs of an image, one around each of n sources."""

    values_dn: Float  # (n, w, w)
    valid: Mask  # (n, w, w); True inside the image where the pixel is not bad
    saturated: Mask  # (n, w, w)
    corner_px: NDArray[np.int64]  # (n, 2); (x, y) of the first pixel of each
    noise_dn: Float  # (n,); standard deviation of the background of a pixel
    gain_e_per_dn: float  # for the shot noise of the source
    relative_noise: float = 0.0  # of the response of a pixel, times the light on it

    @property
    def size_px(self) -> int:
        """Side of a patch, px."""
        return int(self.values_dn.shape[1])

    @property
    def half_px(self) -> int:
        """Half side without the central pixel, px."""
        return self.size_px // 2

    @property
    def centers_px(self) -> NDArray[np.int64]:
        """Central pixels (n, 2), px."""
        return self.corner_px + self.half_px

    @property
    def reach_px(self) -> float:
        """Distance within which the light of a neighbor falls into a patch, px."""
        return neighbor_reach_px(self.half_px)

    def select(self, which: NDArray[np.integer] | slice) -> Patches:
        """Patches of the sources with the given indices (k,)."""
        return select_rows(self, which)

    def offsets_px(self, points_px: Float) -> tuple[Float, Float]:
        """Distances (n, w) of the columns and of the rows of each patch from a point (n, 2), px."""
        steps = np.arange(self.size_px)
        dx = self.corner_px[:, 0, None] + steps - points_px[:, 0, None]
        dy = self.corner_px[:, 1, None] + steps - points_px[:, 1, None]
        return dx, dy

    def variance_dn2(self, light_dn: Float) -> Float:
        """Variance (n, w, w), DN^2, of pixels with the light (n, w, w), DN: background, shot noise and response."""
        light = np.maximum(light_dn, 0.0)
        variance = self.noise_dn[:, None, None] ** 2 + light / self.gain_e_per_dn
        return variance + (self.relative_noise * light) ** 2 if self.relative_noise else variance

    def plane_terms(self) -> Float:
        """Terms (3, w, w) of a background that is a plane: 1, and the distances x, y from the central pixel, px."""
        steps = np.arange(self.size_px, dtype=np.float64) - self.half_px
        flat = np.ones((self.size_px, self.size_px))
        return np.stack([flat, flat * steps, flat * steps[:, None]])

    def level_dn(self, planes: Float, points_px: Float) -> Float:
        """Level (n,), DN, of backgrounds (n, 3), the factors of :meth:`plane_terms`, at points (n, 2), px."""
        away = points_px - self.centers_px
        level: Float = planes[:, 0] + np.sum(planes[:, 1:] * away, axis=1)
        return level

    def subtract_slopes(self, planes: Float, points_px: Float) -> Patches:
        """Patches without the slopes of their backgrounds (n, 3): the level is everywhere that at ``points_px``."""
        plane = np.tensordot(planes, self.plane_terms(), axes=1)
        values = self.values_dn - plane + self.level_dn(planes, points_px)[:, None, None]
        return replace(self, values_dn=np.where(self.valid, values, 0.0))

    def residuals(self, light_dn: Float, planes: Float) -> tuple[Float, Float]:
        """Residuals and inverse variances (n, w * w) of a model; zero where a pixel does not count."""
        model = np.tensordot(planes, self.plane_terms(), axes=1) + light_dn
        used = self.valid & ~(self.saturated & (model >= self.values_dn))
        residual = np.where(used, self.values_dn - model, 0.0)
        weight = used / self.variance_dn2(light_dn)
        return residual.reshape(len(model), -1), weight.reshape(len(model), -1)

    def moments(self, points_px: Float, light_dn: Float) -> Float:
        """Moments (5, n) of light (n, w, w) about points (n, 2) over its sum: x, y in px, and xx, yy, xy in px^2."""
        across, down = (np.stack([np.ones_like(d), d, d**2], axis=1) for d in self.offsets_px(points_px))
        return _moments(down @ light_dn @ across.swapaxes(1, 2))

    def border_level_dn(self) -> Float:
        """Median (n,), DN, of the valid pixels on the rim of each patch, or of all valid ones."""
        rim = np.ones(self.valid.shape[1:], dtype=bool)
        rim[1:-1, 1:-1] = False
        usable, values = self.valid[:, rim], self.values_dn[:, rim]
        if not usable.any(axis=1).all():
            usable = np.where((self.valid & rim).any(axis=(1, 2), keepdims=True), self.valid & rim, self.valid)
            usable, values = usable.reshape(len(usable), -1), self.values_dn.reshape(len(usable), -1)
        values = np.where(usable, values, np.inf)
        middle = np.maximum(usable.sum(axis=1) - 1, 0) // 2
        level: Float = np.take_along_axis(np.sort(values, axis=1), middle[:, None], axis=1)[:, 0]
        return np.where(np.isfinite(level), level, 0.0)


def _moments(sums: Float) -> Float:
    """Moments (5, n) of sums (n, 3, 3) of light times powers 0, 1, 2 of its rows and of its columns."""
    moments = np.stack([sums[:, 0, 1], sums[:, 1, 0], sums[:, 0, 2], sums[:, 2, 0], sums[:, 1, 1]])
    return moments / np.maximum(sums[:, 0, 0], 1e-300)


def neighbor_reach_px(half_px: int) -> float:
    """Distance within which the light of a neighbor falls into patches of this half size, px."""
    return 1.5 * half_px + 1.0


def cut_patches(
    pixels: NDArray[np.generic],
    bad: Mask | None,
    points_px: NDArray[np.integer],
    half_px: int,
    *,
    detector: Detector,
    noise_dn: ArrayLike = 1.0,
) -> Patches:
    """Cut squares of ``2 half_px + 1`` pixels about central pixels (n, 2), partly beyond the edge, out of an image."""
    corner = np.asarray(points_px - half_px, dtype=np.int64)
    values, valid = _squares(pixels, bad, corner, 2 * half_px + 1)
    return Patches(
        values_dn=values,
        valid=valid,
        saturated=valid & (values >= detector.saturation_dn),
        corner_px=corner,
        noise_dn=np.broadcast_to(np.asarray(noise_dn, dtype=np.float64), len(points_px)),
        gain_e_per_dn=detector.gain_e_per_dn,
        relative_noise=detector.relative_noise,
    )


def _squares(
    pixels: NDArray[np.generic], bad: Mask | None, corner_px: NDArray[np.int64], size_px: int
) -> tuple[Float, Mask]:
    """Pixels (n, w, w) of squares from these corners (x, y), (n, 2), and those that are good and in the image."""
    values = np.empty((len(corner_px), size_px, size_px))
    valid = np.ones(values.shape, dtype=bool)
    height, breadth = pixels.shape
    whole = ((corner_px >= 0) & (corner_px <= np.array([breadth, height]) - size_px)).all(axis=1)
    if whole.any():
        x, y = corner_px[whole].T
        values[whole] = sliding_window_view(pixels, (size_px, size_px))[y, x]
        if bad is not None:
            valid[whole] = ~sliding_window_view(bad, (size_px, size_px))[y, x]
    cut = np.flatnonzero(~whole)
    if cut.size:
        columns, rows = (corner_px[cut, k, None] + np.arange(size_px) for k in (0, 1))
        inside = ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < breadth))[:, None, :]
        index = (np.clip(rows, 0, height - 1)[:, :, None], np.clip(columns, 0, breadth - 1)[:, None, :])
        values[cut], valid[cut] = pixels[index], inside if bad is None else inside & ~bad[index]
    if not valid.all():
        values[~valid] = 0.0
    return values, valid


def pixel_shares(first: NDArray[np.integer], size: int, center: Float, width: Float) -> tuple[Float, Float, Float]:
    """Fraction (n, size) of a unit Gaussian in each pixel along an axis, and its derivatives by center and ln width."""
    scale = 1.0 / (math.sqrt(2.0) * width)
    u = (first - center + np.arange(size + 1)[:, None] - 0.5) * scale  # one operation on all sources, pixel by pixel
    bell = np.exp(-u * u)
    bell *= 1.0 / math.sqrt(math.pi)
    below = erf(u)
    u *= bell
    return (0.5 * (below[1:] - below[:-1])).T, ((bell[:-1] - bell[1:]) * scale).T, (u[:-1] - u[1:]).T


def draw_stars(shape: tuple[int, ...], points_px: Float, flux_dn: Float, width_px: Float) -> NDArray[np.float32]:
    """Light (rows, columns), DN, of Gaussians (n,) integrated over the pixels, to six of their widths and a pixel."""
    half = math.ceil(6.0 * float(width_px.max(initial=0.0))) + 1
    light = np.zeros((shape[0] + 2 * half, shape[1] + 2 * half), dtype=np.float32)
    first = np.clip(np.rint(points_px).astype(np.int64), 0, np.array(shape[1::-1]) - 1) - half
    across, down = (pixel_shares(first[:, k], 2 * half + 1, points_px[:, k], width_px)[0] for k in (0, 1))
    for (x, y), row, column, flux in zip(first + half, across, down, flux_dn, strict=True):
        light[y : y + 2 * half + 1, x : x + 2 * half + 1] += flux * np.outer(column, row)
    return light[half : half + shape[0], half : half + shape[1]]


def normal_equations(jacobian: Float, residual: Float, weight: Float) -> tuple[Float, Float]:
    """Form the normal equations (n, p, p), (n, p) of n fits of p parameters to pixels: ``jacobian`` (n, p, pixels)."""
    weighted = jacobian * weight[:, None, :]
    return weighted @ jacobian.swapaxes(1, 2), (weighted @ residual[:, :, None])[:, :, 0]


def chi2_inflation(chi2: Float, freedom: NDArray[np.integer]) -> Float:
    """Variance inflation (n,) of a covariance: the reduced chi-square where it exceeds its noise limit, else 1."""
    reduced = chi2 / freedom
    return np.where(reduced > 1.0 + CHI2_SIGMAS * np.sqrt(2.0 / freedom), reduced, 1.0)
