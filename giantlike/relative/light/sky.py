"""Sky background of a body: a plane through its pixels, and the error of the plane at the body."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, require
from giantlike.core.statistics import robust_sigma
from giantlike.core.values import Value
from giantlike.processing.limb.segmentation import background_of

SKY_SAMPLE = 16_000  # pixels that are fitted: a plane is then known to a sixtieth of the noise of a pixel
_CLIP_SIGMAS, _ROUNDS = 3.0, 6
"""Pixels farther from the fit are stars or other bodies; rounds of clipping, of which three or four change it."""
_FIRST_CLIP_SIGMAS = 6.0
"""The same about the constant level that the first fit starts from, whose scatter holds the slope."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SkyPlane(Value):
    """Brightness of the sky as a plane, and its errors.

    bend_dn: (6,); paraboloid (1, x, y, x^2, x y, y^2) through the same pixels minus the plane: curvature of the sky.
    """

    middle_px: Float  # origin of the coordinates of the fit
    scale_px: float  # unit of the coordinates of the fit
    plane_dn: Float  # (3,); level at the origin, and rise per unit along columns and rows
    covariance_dn2: Float  # of ``plane_dn``, by noise
    bend_dn: Float
    sigma_dn: float  # noise of a pixel about the plane

    @classmethod
    def through(cls, pixels_dn: Float, dark: Mask, *, step_px: int = 1, least_sigma_dn: float = 0.0) -> SkyPlane:
        """Fit the dark pixels of an image; stars and other bodies among them are clipped away."""
        places = np.flatnonzero(dark)
        places = places[:: max(places.size // SKY_SAMPLE, 1)]
        require(places.size >= _N_BEND, f"a plane and its bend need {_N_BEND} dark pixels, got {places.size}")
        rows, columns = np.divmod(places, dark.shape[1])
        values = pixels_dn[rows, columns]
        rows, columns = step_px * rows, step_px * columns
        middle = 0.5 * step_px * (np.array(dark.shape[::-1], dtype=np.float64) - 1.0)
        scale = max(float(np.max(middle)), 1.0)
        basis = _bend_basis((columns - middle[0]) / scale, (rows - middle[1]) / scale)
        first = background_of(values)
        kept = np.abs(values - first.level_dn) <= _FIRST_CLIP_SIGMAS * max(first.sigma_dn, least_sigma_dn)
        for _ in range(_ROUNDS):
            plane = _fit_basis(basis[kept, :3], values[kept])
            away = values - basis[:, :3] @ plane
            sigma = max(robust_sigma(away[kept], 0.0), least_sigma_dn)
            before, kept = kept, np.abs(away) <= _CLIP_SIGMAS * sigma
            if np.count_nonzero(kept) < _N_BEND or bool((kept == before).all()):
                kept = before
                break
        bend = _fit_basis(basis[kept], values[kept])
        bend[:3] -= plane
        covariance = sigma**2 * np.linalg.pinv(basis[kept, :3].T @ basis[kept, :3])
        return cls(
            middle_px=middle,
            scale_px=scale,
            plane_dn=plane,
            covariance_dn2=0.5 * (covariance + covariance.T),
            bend_dn=bend,
            sigma_dn=sigma,
        )

    def seen_from(self, corner_px: NDArray[np.int64]) -> SkyPlane:
        """Return the plane in coordinates that start at a pixel."""
        return replace(self, middle_px=self.middle_px - corner_px)

    def basis(self, columns: Float, rows: Float) -> Float:
        """Return the terms of the paraboloid at pixels; the first three are those of the plane.

        ``columns``, ``rows`` (n,); returns (n, 6).
        """
        return _bend_basis((columns - self.middle_px[0]) / self.scale_px, (rows - self.middle_px[1]) / self.scale_px)

    def levels_dn(self, shape: tuple[int, ...]) -> Float:
        """Brightness of the plane on every pixel of an image."""
        x = (np.arange(shape[1]) - self.middle_px[0]) / self.scale_px
        y = (np.arange(shape[0]) - self.middle_px[1]) / self.scale_px
        return np.asarray(self.plane_dn[0] + self.plane_dn[1] * x[None, :] + self.plane_dn[2] * y[:, None])


_N_BEND = 6  # terms of a paraboloid


def _fit_basis(basis: Float, values: Float) -> Float:
    """Least-squares coefficients (k,) of a basis (n, k)."""
    return np.asarray(np.linalg.lstsq(basis.T @ basis, basis.T @ values, rcond=None)[0], dtype=np.float64)


def _bend_basis(x: Float, y: Float) -> Float:
    """Terms (n, 6) of a paraboloid."""
    return np.stack([np.ones_like(x), x, y, x**2, x * y, y**2], axis=1)
