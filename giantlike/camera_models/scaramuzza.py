"""Scaramuzza's parametric omnidirectional camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from giantlike.camera_models.affine import AFFINE_NAMES, TEMPERATURE_NAMES
from giantlike.camera_models.axial import AxialModel, solve_increasing
from giantlike.camera_models.polynomial import smallest_positive_root
from giantlike.core.arrays import Float

_WIDEST_RADIUS = 1000.0  # focal lengths, end of the table of a lens whose angle grows without limit
_TABLE = 4096  # nodes of the table of radii by angle from which Newton's method starts


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaramuzzaModel(AxialModel):
    """Scaramuzza's omnidirectional camera: a polynomial from the pixel to the direction.

    The focal-plane point (u, v) at radius m is the image of the direction ``(u, v, 1 + b2 m^2 + b3 m^3 + b4 m^4)``.
    With the plane at unit distance the published a0 is the focal length: :meth:`from_polynomial`.

    Parameters
    ----------
    fx_px, fy_px, cx_px, cy_px, skew_px, a1_per_c, a2_per_c2, a3_per_c3 : float; see ``AffineModel``
    b2, b3, b4 : float; ``a2 a0``, ``a3 a0^2``, ``a4 a0^3`` in terms of the published polynomial

    References
    ----------
    .. [1] Thrasher et al., Development of the Optical Deep-Space Instrument for Navigation, eqs. 5-6 and Table 2.
    """

    type_name: ClassVar[str] = "scaramuzza"
    parameter_names: ClassVar[tuple[str, ...]] = (*AFFINE_NAMES, "b2", "b3", "b4", *TEMPERATURE_NAMES)

    b2: float = 0.0
    b3: float = 0.0
    b4: float = 0.0

    @classmethod
    def from_polynomial(
        cls,
        *,
        a0_px: float,
        a2: float = 0.0,
        a3: float = 0.0,
        a4: float = 0.0,
        cx_px: float,
        cy_px: float,
        stretch: float = 1.0,
    ) -> ScaramuzzaModel:
        """Return the model of a published polynomial in pixels, ``a0 + a2 rho^2 + a3 rho^3 + a4 rho^4``.

        ``a0_px`` is positive (a toolbox whose z axis points into the camera has all signs reversed); ``cx_px``,
        ``cy_px``, px: center of the image circle; ``stretch``: width over height of the image circle.
        """
        return cls(
            fx_px=a0_px * stretch,
            fy_px=a0_px,
            cx_px=cx_px,
            cy_px=cy_px,
            b2=a2 * a0_px,
            b3=a3 * a0_px**2,
            b4=a4 * a0_px**3,
        )

    @property
    def max_angle_rad(self) -> float:
        """Largest angle from the axis that is imaged, rad: where the angle stops growing with the radius."""
        return _limits(self.lens_coefficients)[1]

    def _depth(self, radius: Float) -> Float:
        return 1.0 + radius**2 * (self.b2 + radius * (self.b3 + radius * self.b4))

    def _depth_slope(self, radius: Float) -> Float:
        return radius * (2 * self.b2 + radius * (3 * self.b3 + radius * 4 * self.b4))

    def _angle(self, radius: Float) -> Float:
        return np.where(radius <= _limits(self.lens_coefficients)[0], np.arctan2(radius, self._depth(radius)), np.nan)

    def _radius(self, angle: Float) -> Float:
        widest, widest_angle, radii = _limits(self.lens_coefficients)
        place = np.where(angle <= widest_angle, angle, 0.0) * ((len(radii) - 1) / widest_angle)
        before = np.minimum(place.astype(np.int64), len(radii) - 2)
        start = radii[before] + (place - before) * (radii[before + 1] - radii[before])

        def residual_and_slope(radius: Float, target: Float) -> tuple[Float, Float]:
            cosine, sine = np.cos(target), np.sin(target)
            return radius * cosine - self._depth(radius) * sine, cosine - self._depth_slope(radius) * sine

        return solve_increasing(residual_and_slope, np.where(angle <= widest_angle, angle, np.nan), start, widest)

    def _radius_slope(self, angle: Float, radius: Float) -> Float:
        depth = self._depth(radius)
        return (radius**2 + depth**2) / (depth - radius * self._depth_slope(radius))

    def _radius_by_coefficient(self, angle: Float, radius: Float) -> list[Float]:
        sensitivity = radius / (self._depth(radius) - radius * self._depth_slope(radius))
        return [sensitivity * radius**power for power in (2, 3, 4)]


@lru_cache(maxsize=256)
def _limits(coefficients: tuple[float, ...]) -> tuple[float, float, Float]:
    """Largest radius, its angle, and the radii of angles evenly spaced up to it."""
    model = ScaramuzzaModel.unit_lens(coefficients)
    widest = min(smallest_positive_root(0.0, -model.b2, -2 * model.b3, -3 * model.b4), _WIDEST_RADIUS)
    radii = np.tan(np.linspace(0.0, np.arctan(widest), 16 * _TABLE))
    radii[-1] = widest
    angles = np.arctan2(radii, model._depth(radii))
    return widest, float(angles[-1]), np.interp(np.linspace(0.0, angles[-1], _TABLE), angles, radii)
