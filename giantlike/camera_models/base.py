"""The interface of every camera model.

Camera axes: +x along increasing columns, +y along increasing rows, +z boresight. Pixels are
(x, y) = (column, row) with (0, 0) at the center of the first stored pixel.
"""

from __future__ import annotations

from typing import ClassVar, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float


@runtime_checkable
class CameraModel(Protocol):
    """A map between directions in camera axes and pixels; an immutable value.

    Leading axes are free everywhere; coordinates are last. Points that a model cannot image (behind
    the camera, beyond the radius where its polynomial folds over) give NaN, never a wrong pixel.
    """

    type_name: ClassVar[str]
    """Name in camera files."""

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the entries of :attr:`parameters`, as in camera files."""
        ...

    @property
    def parameters(self) -> Float:
        """Parameter values (k,), in the order and units of :attr:`parameter_names`."""
        ...

    def with_parameters(self, values: ArrayLike) -> Self:
        """Return the same model with other parameter values (k,)."""
        ...

    @property
    def focal_length_px(self) -> float:
        """Focal length along x, px: the scale at the center of projection."""
        ...

    def project(self, points_camera: ArrayLike) -> Float:
        """Pixels (..., 2) of points or directions (..., 3) in camera axes, any length unit."""
        ...

    def unproject(self, points_px: ArrayLike) -> Float:
        """Unit vectors (..., 3) in camera axes of pixels (..., 2)."""
        ...

    def project_jacobian(self, points_camera: ArrayLike) -> Float:
        """Derivative (..., 2, 3) of :meth:`project` with respect to the point, px per its unit."""
        ...

    def unproject_jacobian(self, points_px: ArrayLike) -> Float:
        """Derivative (..., 3, 2) of :meth:`unproject` with respect to the pixel, 1/px."""
        ...

    def parameter_jacobian(self, points_camera: ArrayLike, temperature_c: float = 0.0) -> Float:
        """Derivative (..., 2, k) of the pixels at a temperature with respect to :attr:`parameters`."""
        ...

    def at_temperature(self, temperature_c: float) -> Self:
        """Return the model at a temperature in degrees Celsius, its temperature terms applied and cleared."""
        ...


def ifov_rad(model: CameraModel, points_px: ArrayLike) -> Float:
    """Geometric-mean angle (...,) in radians that one pixel subtends at pixels (..., 2)."""
    jacobian = model.unproject_jacobian(points_px)
    gram = np.swapaxes(jacobian, -1, -2) @ jacobian
    result: Float = np.linalg.det(gram) ** 0.25
    return result
