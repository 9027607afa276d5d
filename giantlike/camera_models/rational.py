"""Lenses whose distortion is radial, decentering and of thin prisms: OpenCV's, and Brown's as a part."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.polynomial import Polynomial

from giantlike.camera_models.affine import AFFINE_NAMES, TEMPERATURE_NAMES
from giantlike.camera_models.plane import PlaneModel, Slopes, radial_table
from giantlike.camera_models.polynomial import smallest_positive_root
from giantlike.core.arrays import Float


@dataclass(frozen=True, slots=True, kw_only=True)
class RationalModel(PlaneModel):
    """A plane lens of OpenCV's twelve coefficients, projected in compiled loops (``rational_loops``).

    Numba kernels are imported at first use: they take a third of a second to load.
    """

    @property
    @abstractmethod
    def _twelve(self) -> tuple[float, ...]:
        """Coefficients ``k1`` to ``k6``, ``p1``, ``p2``, ``s1`` to ``s4``."""

    @property
    def _numbers(self) -> Float:
        """Lens (17,) as the loops take it."""
        return np.array((self.fx_px, self.fy_px, self.cx_px, self.cy_px, self.skew_px, *self._twelve))

    def _distort(self, x: Float, y: Float) -> tuple[Float, Float]:
        from giantlike.camera_models import rational_loops

        return rational_loops.distort(x, y, self._numbers)

    def _slopes(self, x: Float, y: Float) -> Slopes:
        from giantlike.camera_models import rational_loops

        return rational_loops.slopes(x, y, self._numbers)

    def _project_block(self, points: Float) -> Float:
        from giantlike.camera_models.rational_loops import project

        return project(_own(points), self._numbers, self.max_radius)

    def _project_jacobian_block(self, points: Float) -> Float:
        from giantlike.camera_models.rational_loops import projected_slopes

        return projected_slopes(_own(points), self._numbers, self.max_radius)

    def _unproject_block(self, pixels: Float) -> Float:
        from giantlike.camera_models.rational_loops import unproject

        return unproject(_own(pixels), self._numbers, self.max_radius, *self._radial_table)

    def _unproject_jacobian_block(self, pixels: Float) -> Float:
        from giantlike.camera_models.rational_loops import unprojected_slopes

        return unprojected_slopes(_own(pixels), self._numbers, self.max_radius, *self._radial_table)

    @property
    def _radial_table(self) -> tuple[Float, Float]:
        return radial_table(type(self), self.lens_coefficients)


def _own(values: Float) -> Float:
    """Copy that is contiguous and may be written to: loops are compiled anew for any other kind of array."""
    return np.array(values, order="C")


@dataclass(frozen=True, slots=True, kw_only=True)
class BrownModel(RationalModel):
    """Pinhole with radial (k1-k3) and decentering (p1, p2) distortion of the image-plane point.

    Parameters
    ----------
    fx_px, fy_px, cx_px, cy_px, skew_px, a1_per_c, a2_per_c2, a3_per_c3 : float; see ``AffineModel``
    k1, k2, k3 : float; radial coefficients of r^2, r^4, r^6, image-plane units
    p1, p2 : float; decentering coefficients

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, eqs. 5-8.
    """

    type_name: ClassVar[str] = "brown"
    parameter_names: ClassVar[tuple[str, ...]] = (*AFFINE_NAMES, "k1", "k2", "k3", "p1", "p2", *TEMPERATURE_NAMES)

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @property
    def _twelve(self) -> tuple[float, ...]:
        return (self.k1, self.k2, self.k3, 0.0, 0.0, 0.0, self.p1, self.p2, 0.0, 0.0, 0.0, 0.0)

    def _by_coefficient(self, x: Float, y: Float) -> tuple[list[Float], list[Float]]:
        r2 = x * x + y * y
        return (
            [r2 * x, r2**2 * x, r2**3 * x, 2 * x * y, r2 + 2 * x * x],
            [r2 * y, r2**2 * y, r2**3 * y, r2 + 2 * y * y, 2 * x * y],
        )

    def _radial_limit(self) -> float:
        return math.sqrt(smallest_positive_root(3 * self.k1, 5 * self.k2, 7 * self.k3))

    def _is_radial(self) -> bool:
        return self.p1 == 0.0 == self.p2


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenCVModel(RationalModel):
    """OpenCV's distortion with up to twelve coefficients (no tilted sensor).

    Parameters
    ----------
    fx_px, fy_px, cx_px, cy_px, skew_px, a1_per_c, a2_per_c2, a3_per_c3 : float; see ``AffineModel``
    k1, k2, k3, k4, k5, k6 : float; of r^2, r^4, r^6 in the numerator of the radial factor, then its denominator
    p1, p2 : float; decentering coefficients
    s1, s2, s3, s4 : float; thin prism: x moves by ``s1 r^2 + s2 r^4``, y by ``s3 r^2 + s4 r^4``

    References
    ----------
    .. [1] GIANT, theory section of giant/camera_models/opencv_model.py, github.com/nasa/giant; the numbers agree with
       cv2.projectPoints.
    """

    type_name: ClassVar[str] = "opencv"
    parameter_names: ClassVar[tuple[str, ...]] = (
        *AFFINE_NAMES, "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4", *TEMPERATURE_NAMES,
    )  # fmt: skip

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    s1: float = 0.0
    s2: float = 0.0
    s3: float = 0.0
    s4: float = 0.0

    @property
    def _twelve(self) -> tuple[float, ...]:
        return self.lens_coefficients

    def _parts(self, r2: Float) -> tuple[Float, Float]:
        """Numerator and denominator of the radial factor."""
        numerator = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        return numerator, 1.0 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))

    def _by_coefficient(self, x: Float, y: Float) -> tuple[list[Float], list[Float]]:
        r2 = x * x + y * y
        numerator, denominator = self._parts(r2)
        powers = [r2 / denominator, r2**2 / denominator, r2**3 / denominator]
        powers += [-power * numerator / denominator for power in powers]
        zero = np.zeros_like(x)
        return (
            [p * x for p in powers] + [2 * x * y, r2 + 2 * x * x, r2, r2**2, zero, zero],
            [p * y for p in powers] + [r2 + 2 * y * y, 2 * x * y, zero, zero, r2, r2**2],
        )

    def _radial_limit(self) -> float:
        numerator = Polynomial([1.0, self.k1, self.k2, self.k3])  # in t = r^2
        denominator = Polynomial([1.0, self.k4, self.k5, self.k6])
        t = Polynomial([0.0, 1.0])
        slope = (numerator + 2 * t * numerator.deriv()) * denominator - 2 * t * numerator * denominator.deriv()
        return math.sqrt(min(smallest_positive_root(*part.coef[1:]) for part in (slope, denominator)))

    def _is_radial(self) -> bool:
        return not any((self.p1, self.p2, self.s1, self.s2, self.s3, self.s4))
