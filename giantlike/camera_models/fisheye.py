"""Fisheye cameras: equidistant and equisolid, each with a polynomial."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from giantlike.camera_models.affine import AFFINE_NAMES, TEMPERATURE_NAMES
from giantlike.camera_models.axial import AxialModel, solve_increasing
from giantlike.camera_models.polynomial import smallest_positive_root
from giantlike.core.arrays import Float


@dataclass(frozen=True, slots=True, kw_only=True)
class FisheyeModel(AxialModel):
    """Base of fisheye lenses: an ideal radius e times ``1 + k1 e^2 + k2 e^4 + k3 e^6 + k4 e^8``.

    Parameters
    ----------
    fx_px, fy_px, cx_px, cy_px, skew_px, a1_per_c, a2_per_c2, a3_per_c3 : float; see ``AffineModel``
    k1, k2, k3, k4 : float; coefficients of the powers 2, 4, 6, 8 of the ideal radius
    """

    parameter_names: ClassVar[tuple[str, ...]] = (*AFFINE_NAMES, "k1", "k2", "k3", "k4", *TEMPERATURE_NAMES)

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    @property
    def max_angle_rad(self) -> float:
        """Largest angle from the axis that is imaged, rad: where the radius stops growing, at most pi."""
        return float(self._angle_of_ideal(np.array(_limits(type(self), self.lens_coefficients)[0])))

    @abstractmethod
    def _ideal(self, angle: Float) -> Float:
        """Radius of the ideal lens."""

    @abstractmethod
    def _ideal_slope(self, angle: Float) -> Float:
        """Derivative of :meth:`_ideal`."""

    @abstractmethod
    def _angle_of_ideal(self, ideal: Float) -> Float:
        """Inverse of :meth:`_ideal`."""

    def _correct(self, ideal: Float) -> Float:
        e2 = ideal * ideal
        return ideal * (1.0 + e2 * (self.k1 + e2 * (self.k2 + e2 * (self.k3 + e2 * self.k4))))

    def _growth(self, ideal: Float) -> Float:
        """Derivative of :meth:`_correct`."""
        e2 = ideal * ideal
        return 1.0 + e2 * (3 * self.k1 + e2 * (5 * self.k2 + e2 * (7 * self.k3 + e2 * 9 * self.k4)))

    def _radius(self, angle: Float) -> Float:
        ideal = self._ideal(angle)
        return np.where(ideal <= _limits(type(self), self.lens_coefficients)[0], self._correct(ideal), np.nan)

    def _radius_slope(self, angle: Float, radius: Float) -> Float:
        return self._growth(self._ideal(angle)) * self._ideal_slope(angle)

    def _radius_by_coefficient(self, angle: Float, radius: Float) -> list[Float]:
        ideal = np.where(np.isfinite(radius), self._ideal(angle), np.nan)
        return [ideal**power for power in (3, 5, 7, 9)]

    def _angle(self, radius: Float) -> Float:
        widest, radii, ideals = _limits(type(self), self.lens_coefficients)
        start = np.where(radius <= radii[-1], np.interp(radius, radii, ideals), np.nan)

        def residual_and_slope(ideal: Float, target: Float) -> tuple[Float, Float]:
            return self._correct(ideal) - target, self._growth(ideal)

        return self._angle_of_ideal(solve_increasing(residual_and_slope, radius, start, widest))


@dataclass(frozen=True, slots=True, kw_only=True)
class EquidistantModel(FisheyeModel):
    """Equidistant fisheye, whose ideal radius is the angle itself: OpenCV's fisheye model, beyond 90 degrees too.

    Parameters
    ----------
    fx_px, fy_px, cx_px, cy_px, skew_px, a1_per_c, a2_per_c2, a3_per_c3 : float; see ``AffineModel``
    k1, k2, k3, k4 : float; coefficients of the angle's powers 2, 4, 6, 8, relative to the angle

    References
    ----------
    .. [1] GIANT, theory section of giant/camera_models/fisheye_model.py, github.com/nasa/giant; the numbers agree
       with cv2.fisheye.projectPoints.
    """

    type_name: ClassVar[str] = "equidistant"

    def _ideal(self, angle: Float) -> Float:
        return angle

    def _ideal_slope(self, angle: Float) -> Float:
        return np.ones_like(angle)

    def _angle_of_ideal(self, ideal: Float) -> Float:
        return ideal


@dataclass(frozen=True, slots=True, kw_only=True)
class EquisolidModel(FisheyeModel):
    """Equisolid fisheye, whose ideal radius is twice the sine of half the angle: equal solid angles have equal areas.

    Parameters
    ----------
    fx_px, fy_px, cx_px, cy_px, skew_px, a1_per_c, a2_per_c2, a3_per_c3 : float; see ``AffineModel``
    k1, k2, k3, k4 : float; coefficients of the ideal radius's powers 2, 4, 6, 8, relative to it
    """

    type_name: ClassVar[str] = "equisolid"

    def _ideal(self, angle: Float) -> Float:
        return 2.0 * np.sin(0.5 * angle)

    def _ideal_slope(self, angle: Float) -> Float:
        return np.cos(0.5 * angle)

    def _angle_of_ideal(self, ideal: Float) -> Float:
        return 2.0 * np.arcsin(0.5 * ideal)


@lru_cache(maxsize=256)
def _limits(kind: type[FisheyeModel], coefficients: tuple[float, ...]) -> tuple[float, Float, Float]:
    """Largest ideal radius, and a table of radii and their ideal radii up to it."""
    model = kind.unit_lens(coefficients)
    widest = float(model._ideal(np.array(np.pi)))
    fold = math.sqrt(smallest_positive_root(3 * model.k1, 5 * model.k2, 7 * model.k3, 9 * model.k4))
    ideals = np.linspace(0.0, min(fold, widest), 512)
    return float(ideals[-1]), model._correct(ideals), ideals
