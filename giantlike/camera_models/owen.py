"""Owen's camera: the model of deep-space optical navigation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from giantlike.camera_models.affine import AFFINE_NAMES, TEMPERATURE_NAMES
from giantlike.camera_models.plane import PlaneModel, Slopes
from giantlike.camera_models.polynomial import smallest_positive_root
from giantlike.core.arrays import Float


@dataclass(frozen=True, slots=True, kw_only=True)
class OwenModel(PlaneModel):
    """Radial, tip/tilt and pinwheel distortion of the image-plane point.

    The point (x, y) becomes ``(1 + e2 r^2 + e4 r^4 + e5 y + e6 x) (x, y) + (e1 r + e3 r^3) (-y, x)``.

    Parameters
    ----------
    fx_px, fy_px, cx_px, cy_px, skew_px, a1_per_c, a2_per_c2, a3_per_c3 : float; see ``AffineModel``
    e1, e3 : float; pinwheel coefficients of r and r^3, for an image plane at unit distance
    e2, e4 : float; radial coefficients of r^2 and r^4
    e5, e6 : float; tip/tilt of the detector, along y and along x

    References
    ----------
    .. [1] GIANT, giant/camera_models/owen_model.py, github.com/nasa/giant: the model as printed by its ``__str__``.
    """

    type_name: ClassVar[str] = "owen"
    parameter_names: ClassVar[tuple[str, ...]] = (
        *AFFINE_NAMES, "e1", "e2", "e3", "e4", "e5", "e6", *TEMPERATURE_NAMES,
    )  # fmt: skip

    e1: float = 0.0
    e2: float = 0.0
    e3: float = 0.0
    e4: float = 0.0
    e5: float = 0.0
    e6: float = 0.0

    def _parts(self, x: Float, y: Float) -> tuple[Float, Float, Float]:
        """Squared radius, stretch along the radius and rotation across it."""
        r2 = x * x + y * y
        stretch = 1.0 + r2 * (self.e2 + r2 * self.e4) + self.e5 * y + self.e6 * x
        return r2, stretch, np.sqrt(r2) * (self.e1 + r2 * self.e3)

    def _distort(self, x: Float, y: Float) -> tuple[Float, Float]:
        _, stretch, turn = self._parts(x, y)
        return stretch * x - turn * y, stretch * y + turn * x

    def _slopes(self, x: Float, y: Float) -> Slopes:
        r2, stretch, turn = self._parts(x, y)
        r = np.sqrt(r2)
        growth = 2 * (self.e2 + 2 * r2 * self.e4)
        turning = self.e1 / np.where(r > 0, r, 1.0) + 3 * self.e3 * r
        stretch_x, stretch_y = growth * x + self.e6, growth * y + self.e5
        turn_x, turn_y = turning * x, turning * y
        return (
            stretch + x * stretch_x - y * turn_x,
            x * stretch_y - y * turn_y - turn,
            y * stretch_x + x * turn_x + turn,
            stretch + y * stretch_y + x * turn_y,
        )

    def _by_coefficient(self, x: Float, y: Float) -> tuple[list[Float], list[Float]]:
        r2 = x * x + y * y
        r = np.sqrt(r2)
        return (
            [-r * y, r2 * x, -r2 * r * y, r2**2 * x, x * y, x * x],
            [r * x, r2 * y, r2 * r * x, r2**2 * y, y * y, x * y],
        )

    def _radial_limit(self) -> float:
        return math.sqrt(smallest_positive_root(3 * self.e2, 5 * self.e4))

    def _is_radial(self) -> bool:
        return not any((self.e1, self.e3, self.e5, self.e6))
