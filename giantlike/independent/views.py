"""A pinhole camera with a little distortion, in pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from giantlike.independent.laws import Float


@dataclass(frozen=True)
class PinholeView:
    """Camera that maps ``(X / Z, Y / Z)`` to pixels, with radial and tangential distortion after Brown (1966).

    k1, k2, k3: radial terms: ``(1 + k1 r^2 + k2 r^4 + k3 r^6)``, r in units of the focal length.
    p1, p2: tangential terms: ``x + 2 p1 x y + p2 (r^2 + 2 x^2)``, ``y + p1 (r^2 + 2 y^2) + 2 p2 x y``.
    """

    focal_px: float  # focal length
    center_px: tuple[float, float]  # pixel of the boresight: (column, row), (0, 0) the center of the first pixel
    columns: int  # columns, rows: size of the detector
    rows: int
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    aspect: float = 1.0  # focal length along rows by that along columns
    skew_px: float = 0.0  # shift along columns for each unit of ``Y / Z``

    def _distort(self, plane: Float) -> Float:
        x, y = plane[..., 0], plane[..., 1]
        squared = x * x + y * y
        radial = 1.0 + squared * (self.k1 + squared * (self.k2 + squared * self.k3))
        return np.stack(
            [
                x * radial + 2.0 * self.p1 * x * y + self.p2 * (squared + 2.0 * x * x),
                y * radial + self.p1 * (squared + 2.0 * y * y) + 2.0 * self.p2 * x * y,
            ],
            axis=-1,
        )

    def project(self, vectors_camera: ArrayLike) -> Float:
        """Return the pixels (..., 2) of vectors (..., 3) in camera axes; NaN behind the camera."""
        vectors = np.asarray(vectors_camera, dtype=float)
        depth = np.where(vectors[..., 2] > 0.0, vectors[..., 2], np.nan)
        plane = self._distort(vectors[..., :2] / depth[..., None])
        sheared = self.focal_px * plane * (1.0, self.aspect) + plane[..., 1:] * (self.skew_px, 0.0)
        return np.asarray(sheared + self.center_px, dtype=float)

    def directions(self, pixels: ArrayLike) -> Float:
        """Return the vectors (..., 3) in camera axes, third component 1, that fall on pixels (..., 2)."""
        target = (np.asarray(pixels, dtype=float) - self.center_px) / (self.focal_px * np.array([1.0, self.aspect]))
        target = target - target[..., 1:] * (self.skew_px / self.focal_px, 0.0)
        plane = target
        if self.k1 or self.k2 or self.k3 or self.p1 or self.p2:
            for _ in range(30):  # fixed point; contracts by the size of the distortion each time
                error = target - self._distort(plane)
                plane = plane + error
                if np.abs(error).max(initial=0.0) < 1e-13:
                    break
        return np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1)
