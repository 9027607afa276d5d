"""Base of all lens models: the affine step from a unit focal plane to pixels, temperature, binning and windows."""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from giantlike.camera_models.base import CameraModel
from giantlike.core.arrays import Float, as_finite, as_floats, require, require_number
from giantlike.core.documented import documented_by

AFFINE_NAMES = ("fx_px", "fy_px", "cx_px", "cy_px", "skew_px")
TEMPERATURE_NAMES = ("a1_per_c", "a2_per_c2", "a3_per_c3")
_BLOCK = 8192  # points per block: its temporaries (64 kB each) stay in the processor's cache


_LARGEST = 1e30  # largest parameter of a model: far beyond any lens, and its powers in derivatives are finite


@documented_by(CameraModel)
@dataclass(frozen=True, slots=True, kw_only=True)
class AffineModel(ABC):
    """A lens that maps directions to a focal plane at unit distance, and affine pixels behind it.

    A subclass supplies the lens (``_lens``, ``_lens_inverse``, ``_lens_jacobian``, ``_lens_by_parameter``), in
    separate coordinate arrays of one dimension.

    Temperature: the image of the lens is magnified about the principal point by
    ``1 + a1 T + a2 T^2 + a3 T^3``, T in degrees Celsius, which multiplies ``fx_px``, ``fy_px`` and ``skew_px`` and
    leaves the principal point and the distortion as they are. :meth:`project` and :meth:`unproject` hold at T = 0;
    :meth:`at_temperature` is the model at another temperature.

    Parameters
    ----------
    fx_px, fy_px : float, px; focal lengths over pixel pitch, positive
    cx_px, cy_px : float, px; principal point
    skew_px : float, px; shear: x moves by ``skew_px`` per unit of focal-plane y
    a1_per_c, a2_per_c2, a3_per_c3 : float; temperature terms, per degree Celsius and its powers

    Raises
    ------
    InputError
        A focal length is not positive or a value is not finite.

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, eqs. 5-8 (linear in T).
    .. [2] Thrasher et al., Development of the Optical Deep-Space Instrument for Navigation, eqs. 1-3 (shear).
    """

    type_name: ClassVar[str]
    parameter_names: ClassVar[tuple[str, ...]]

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    skew_px: float = 0.0
    a1_per_c: float = 0.0
    a2_per_c2: float = 0.0
    a3_per_c3: float = 0.0

    def __post_init__(self) -> None:
        for name in self.parameter_names:
            value = getattr(self, name)
            require(math.isfinite(value), f"camera model: {name} must be finite, got {value}")
            require(abs(value) <= _LARGEST, f"camera model: {name} must be at most {_LARGEST:g}, got {value}")
        for name in ("fx_px", "fy_px"):
            require(
                getattr(self, name) > 0,
                f"camera model: {name} must be > 0, got {getattr(self, name)}; a mission model with negative focal "
                "lengths is converted on import, see giantlike.io.mission_frame",
            )

    @property
    def parameters(self) -> Float:
        """Parameter values (k,) in the order of ``parameter_names``."""
        return np.array([getattr(self, name) for name in self.parameter_names])

    def with_parameters(self, values: ArrayLike) -> Self:
        names = self.parameter_names
        numbers = as_finite(values, (len(names),), "camera model parameters")
        return dataclasses.replace(self, **dict(zip(names, numbers.tolist(), strict=True)))

    @property
    def lens_coefficients(self) -> tuple[float, ...]:
        """Parameters of the lens alone: all but the affine and the temperature terms."""
        names = self.parameter_names[len(AFFINE_NAMES) : -len(TEMPERATURE_NAMES)]
        return tuple([getattr(self, name) for name in names])

    @classmethod
    def unit_lens(cls, coefficients: tuple[float, ...]) -> Self:
        """Return the model with these :attr:`lens_coefficients`, unit focal lengths and the principal point at zero."""
        names = cls.parameter_names[len(AFFINE_NAMES) : -len(TEMPERATURE_NAMES)]
        return cls(fx_px=1.0, fy_px=1.0, cx_px=0.0, cy_px=0.0, **dict(zip(names, coefficients, strict=True)))

    @property
    def focal_length_px(self) -> float:
        """Focal length along x, px."""
        return self.fx_px

    def project(self, points_camera: ArrayLike) -> Float:
        return blockwise(self._project_block, as_floats(points_camera, (3,), "points_camera"), (2,))

    def unproject(self, points_px: ArrayLike) -> Float:
        return blockwise(self._unproject_block, as_floats(points_px, (2,), "points_px"), (3,))

    def project_jacobian(self, points_camera: ArrayLike) -> Float:
        return blockwise(self._project_jacobian_block, as_floats(points_camera, (3,), "points_camera"), (2, 3))

    def unproject_jacobian(self, points_px: ArrayLike) -> Float:
        return blockwise(self._unproject_jacobian_block, as_floats(points_px, (2,), "points_px"), (3, 2))

    def parameter_jacobian(self, points_camera: ArrayLike, temperature_c: float = 0.0) -> Float:
        points = as_floats(points_camera, (3,), "points_camera")
        scale = self._magnification(temperature_c)
        powers = temperature_c ** np.arange(1, 1 + len(TEMPERATURE_NAMES))

        def block(points: Float) -> Float:
            xyz = np.ascontiguousarray(points.T)
            u, v = self._lens(*xyz)
            zero, one = np.zeros_like(u), np.ones_like(u)
            affine = np.array([[scale * u, zero, one, zero, scale * v], [zero, scale * v, zero, one, zero]])
            lens = self._pixels_of(scale * self._lens_by_parameter(*xyz))
            at_zero = np.array([self.fx_px * u + self.skew_px * v, self.fy_px * v])
            warm = at_zero.T[:, :, None] * powers
            return np.concatenate([affine.transpose(2, 0, 1), lens, warm], axis=-1)

        return blockwise(block, points, (2, len(self.parameter_names)))

    def at_temperature(self, temperature_c: float) -> Self:
        """Return the model at a temperature (Celsius): focal lengths and shear scaled, without temperature terms.

        Raises InputError where the focal length would not be positive: the terms were fitted at other temperatures.
        """
        scale = self._magnification(temperature_c)
        require(
            scale > 0,
            f"the temperature terms scale the focal length by {scale:.3g} at {temperature_c} degrees C: "
            "they are a polynomial in degrees Celsius, valid where it was fitted",
        )
        scaled = {name: scale * getattr(self, name) for name in ("fx_px", "fy_px", "skew_px")}
        return dataclasses.replace(self, **scaled, **dict.fromkeys(TEMPERATURE_NAMES, 0.0))

    def binned(self, factor: float) -> Self:
        """Return the model of an image whose pixels are blocks of ``factor`` by ``factor`` pixels.

        The factor is not a whole number for resampled images, and below 1 for enlarged ones.
        """
        require_number(factor, "a binning factor", above=0.0)
        middle = (factor - 1) / 2  # of the first block
        return dataclasses.replace(
            self,
            fx_px=self.fx_px / factor,
            fy_px=self.fy_px / factor,
            skew_px=self.skew_px / factor,
            cx_px=(self.cx_px - middle) / factor,
            cy_px=(self.cy_px - middle) / factor,
        )

    def windowed(self, x0_px: float, y0_px: float) -> Self:
        """Return the model of a window of the image that begins at the pixel ``x0_px``, ``y0_px``."""
        return dataclasses.replace(self, cx_px=self.cx_px - x0_px, cy_px=self.cy_px - y0_px)

    @abstractmethod
    def _lens(self, x: Float, y: Float, z: Float) -> tuple[Float, Float]:
        """Focal-plane coordinates of points; NaN where the lens images nothing."""

    @abstractmethod
    def _lens_inverse(self, u: Float, v: Float) -> tuple[Float, Float, Float]:
        """Unit vectors of focal-plane coordinates; NaN where nothing is imaged."""

    @abstractmethod
    def _lens_jacobian(self, x: Float, y: Float, z: Float) -> Float:
        """(2, 3, n) derivative of :meth:`_lens`."""

    @abstractmethod
    def _lens_by_parameter(self, x: Float, y: Float, z: Float) -> Float:
        """(2, k, n) derivative of :meth:`_lens` with respect to the parameters of the lens itself."""

    def _magnification(self, temperature_c: float) -> float:
        return 1.0 + temperature_c * (self.a1_per_c + temperature_c * (self.a2_per_c2 + temperature_c * self.a3_per_c3))

    def _project_block(self, points: Float) -> Float:
        u, v = self._lens(*np.ascontiguousarray(points.T))
        pixels = np.empty((u.size, 2))
        pixels[:, 0] = self.fx_px * u + self.skew_px * v + self.cx_px
        pixels[:, 1] = self.fy_px * v + self.cy_px
        return pixels

    def _unproject_block(self, pixels: Float) -> Float:
        v = (pixels[:, 1] - self.cy_px) / self.fy_px
        u = (pixels[:, 0] - self.cx_px - self.skew_px * v) / self.fx_px
        return np.stack(self._lens_inverse(u, v), axis=-1)

    def _project_jacobian_block(self, points: Float) -> Float:
        return self._pixels_of(self._lens_jacobian(*np.ascontiguousarray(points.T)))

    def _unproject_jacobian_block(self, pixels: Float) -> Float:
        return inverse_on_the_sphere(self._project_jacobian_block(self._unproject_block(pixels)))

    def _pixels_of(self, by_something: Float) -> Float:
        """Focal-plane derivatives (2, m, n) as pixel derivatives (n, 2, m)."""
        along_x = self.fx_px * by_something[0] + self.skew_px * by_something[1]
        return np.array([along_x, self.fy_px * by_something[1]]).transpose(2, 0, 1)


def blockwise(function: Callable[[Float], Float], values: Float, last: tuple[int, ...]) -> Float:
    """Apply a function from (n, m) to (n, *last) to values (..., m), a block of points at a time."""
    flat = values.reshape(-1, values.shape[-1])
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        if len(flat) <= _BLOCK:
            return function(flat).reshape(values.shape[:-1] + last)
        result = np.empty((len(flat), *last))
        for start in range(0, len(flat), _BLOCK):
            result[start : start + _BLOCK] = function(flat[start : start + _BLOCK])
    return result.reshape(values.shape[:-1] + last)


def inverse_on_the_sphere(project_jacobian: Float) -> Float:
    """Derivative (..., 3, 2) of a unit vector by its pixel, the pseudo-inverse of the opposite one (..., 2, 3)."""
    xs, ys = (np.moveaxis(project_jacobian[..., row, :], -1, 0) for row in range(2))  # by component: small products
    a, b, d = (np.sum(one * other, axis=0) for one, other in ((xs, xs), (xs, ys), (ys, ys)))  # are slow
    result = np.empty((*project_jacobian.shape[:-2], 3, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = 1.0 / (a * d - b * b)
        for axis, (x, y) in enumerate(zip(xs, ys, strict=True)):
            result[..., axis, 0] = scale * (d * x - b * y)
            result[..., axis, 1] = scale * (a * y - b * x)
    return result
