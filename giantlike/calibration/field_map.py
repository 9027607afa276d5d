"""Maps over the field of a camera: differences of models and their uncertainty in pixels, modulo a rotation.

Attitudes absorb a rotation of the whole camera: two models that differ by one are equivalent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float
from giantlike.core.frames import rotate, skew
from giantlike.core.values import Value

_ROTATION_STEPS = 5  # of Gauss-Newton on the common rotation, which converges quadratically
_CELLS = 25  # grid points along each axis: resolves the sixth-order terms of distortion


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FieldMap(Value):
    """Shifts at the points of a grid over the detector.

    Parameters
    ----------
    points_px : (n, 2) float64, px
    shifts_px : (n, 2) float64, px
    """

    points_px: Float
    shifts_px: Float

    @property
    def rms_px(self) -> float:
        """Radial rms over the grid, px."""
        return float(np.sqrt(np.mean(np.sum(self.shifts_px**2, axis=1))))

    @property
    def max_px(self) -> float:
        """Largest shift, px."""
        return float(np.sqrt(np.max(np.sum(self.shifts_px**2, axis=1))))


def field_grid(columns: int, rows: int) -> Float:
    """Regular grid of pixels (n, 2) over a detector of a size, edges included."""
    x = np.linspace(-0.5, columns - 0.5, _CELLS)
    y = np.linspace(-0.5, rows - 0.5, _CELLS)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _imaged_grid(model: CameraModel, columns: int, rows: int) -> tuple[Float, Float]:
    """Points (n, 2) of the field grid that a model can unproject, and their unit vectors (n, 3)."""
    pixels = field_grid(columns, rows)
    vectors = model.unproject(pixels)
    seen = np.isfinite(vectors).all(axis=1)
    return pixels[seen], vectors[seen]


def map_difference(
    model: CameraModel, other: CameraModel, *, columns: int, rows: int, temperature_c: float = 0.0
) -> FieldMap:
    """Difference of two camera models over the detector, with the best-fit rotation removed.

    Parameters
    ----------
    model, other : CameraModel
    columns, rows : int; size of the detector
    temperature_c : float, Celsius

    Returns
    -------
    FieldMap
        Pixels to which ``other`` projects the lines of sight of ``model`` at the grid points, minus these points.
        Points that one of the models cannot project are omitted.
    """
    first, second = model.at_temperature(temperature_c), other.at_temperature(temperature_c)
    pixels, vectors = _imaged_grid(first, columns, rows)
    rotation = Rotation.identity()
    for _ in range(_ROTATION_STEPS):
        turned = rotate(rotation, vectors)
        shifts = second.project(turned) - pixels
        good = np.isfinite(shifts).all(axis=1)
        by_rotation = (-second.project_jacobian(turned[good]) @ skew(turned[good])).reshape(-1, 3)
        step = np.linalg.lstsq(by_rotation, -shifts[good].reshape(-1), rcond=None)[0]
        rotation = Rotation.from_rotvec(step) * rotation
    shifts = second.project(rotate(rotation, vectors)) - pixels
    good = np.isfinite(shifts).all(axis=1)
    return FieldMap(points_px=pixels[good], shifts_px=shifts[good])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FieldSensitivity(Value):
    """Derivatives of pixels over the field by the parameters of a model."""

    points_px: Float  # (n, 2)
    by_parameter: Float  # (n, 2, p); by every parameter of the model
    unrotated: Float  # (n, 2, p); the same minus the part that is equivalent to a rotation of the camera

    @classmethod
    def from_model(cls, model: CameraModel, *, columns: int, rows: int, temperature_c: float = 0.0) -> FieldSensitivity:
        """Sensitivity at the grid points of a detector that the model can project."""
        there = model.at_temperature(temperature_c)
        pixels, vectors = _imaged_grid(there, columns, rows)
        by_parameter = model.parameter_jacobian(vectors, temperature_c=temperature_c)
        by_rotation = (-there.project_jacobian(vectors) @ skew(vectors)).reshape(-1, 3)
        basis, _ = np.linalg.qr(by_rotation)
        flat = by_parameter.reshape(len(basis), -1)
        unrotated = (flat - basis @ (basis.T @ flat)).reshape(by_parameter.shape)
        return cls(points_px=pixels, by_parameter=by_parameter, unrotated=unrotated)

    def sigma_px(self, estimated: NDArray[np.intp], covariance: Float) -> Float:
        """Radial standard deviation (n,), px, of the map for a covariance (k, k) of parameters of the given indices."""
        by_estimated = self.unrotated[..., estimated]
        variance = np.einsum("nik,kl,nil->n", by_estimated, covariance, by_estimated)
        result: Float = np.sqrt(np.maximum(variance, 0.0))
        return result
