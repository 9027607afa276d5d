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
    """A map between directions in camera axes and pixels, as an immutable value.

    Leading axes are free everywhere; coordinates are last. Points that a model cannot image (behind
    the camera, beyond the radius where its polynomial folds over) give NaN, never a wrong pixel.
    """

    type_name: ClassVar[str]
    """Name in camera files."""

    def __hash__(self) -> int:
        """Hash of the value: key of caches of values that depend on the model alone."""
        ...

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the entries of :attr:`parameters`, as in camera files."""
        ...

    @property
    def parameters(self) -> Float:
        """Parameter values (k,), in the order and units of :attr:`parameter_names`."""
        ...

    def with_parameters(self, values: ArrayLike) -> Self:
        """Return the same model with other values (k,), in the order and units of :attr:`parameter_names`."""
        ...

    @property
    def focal_length_px(self) -> float:
        """Focal length along x, px: the scale at the center of projection."""
        ...

    def project(self, points_camera: ArrayLike) -> Float:
        """Project points to pixels.

        Parameters
        ----------
        points_camera : (..., 3) array_like, camera axes; points or directions, in any unit of length

        Returns
        -------
        (..., 2) float64, px
            NaN where the lens images nothing.
        """
        ...

    def unproject(self, points_px: ArrayLike) -> Float:
        """Return the directions of pixels.

        Parameters
        ----------
        points_px : (..., 2) array_like, px; pixels

        Returns
        -------
        (..., 3) float64, unitless, camera axes
            Unit vectors; NaN where no direction maps to the pixel.
        """
        ...

    def project_jacobian(self, points_camera: ArrayLike) -> Float:
        """Derivative (..., 2, 3) of :meth:`project` by the points (..., 3), px per unit of the points."""
        ...

    def unproject_jacobian(self, points_px: ArrayLike) -> Float:
        """Derivative (..., 3, 2) of :meth:`unproject` by the pixels (..., 2), 1/px."""
        ...

    def parameter_jacobian(self, points_camera: ArrayLike, temperature_c: float = 0.0) -> Float:
        """Derivative (..., 2, k) of the pixels of points (..., 3) at a temperature (Celsius) by :attr:`parameters`.

        Columns are in the order of :attr:`parameter_names`, px per unit of each; temperature terms are zero at 0
        degrees.
        """
        ...

    def at_temperature(self, temperature_c: float) -> Self:
        """Return the model at a temperature of the optics (Celsius), with its temperature terms applied and cleared."""
        ...


def ifov_rad(model: CameraModel, points_px: ArrayLike) -> Float:
    """Return the geometric-mean angle that one pixel subtends.

    Parameters
    ----------
    model : CameraModel; any camera model
    points_px : (..., 2) array_like, px; pixels

    Returns
    -------
    (...,) float64, rad
    """
    # The derivative by the pixel is the pseudo-inverse of this one: its Gram matrix has the inverse determinant.
    jacobian = model.project_jacobian(model.unproject(points_px))
    gram = jacobian @ np.swapaxes(jacobian, -1, -2)
    with np.errstate(invalid="ignore", divide="ignore"):
        area = gram[..., 0, 0] * gram[..., 1, 1] - gram[..., 0, 1] ** 2
        result: Float = np.abs(area) ** -0.25
    return result
