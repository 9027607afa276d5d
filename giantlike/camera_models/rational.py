"""Base of lenses whose distortion is radial, decentering and of thin prisms: OpenCV's, and Brown's as a part."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np

from giantlike.camera_models.plane import PlaneModel, Slopes, radial_table
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
