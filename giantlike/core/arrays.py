"""Checks of arguments: arrays get a shape, a dtype and finite values, numbers a range, or a clear error."""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.core.errors import InputError

Scalar = TypeVar("Scalar", bound=np.generic)
Float = NDArray[np.float64]  # A float64 array; its shape, unit and frame are in the docstring of whoever takes it
Mask = NDArray[np.bool_]  # A boolean array; in the mask of an image True is a bad pixel
Indices = NDArray[np.int64]  # an array of indices, or of whole numbers


def as_floats(value: ArrayLike, last: tuple[int, ...], name: str) -> Float:
    """Return ``value`` as float64 with trailing axes ``last`` and any leading axes. Returns (..., *last)."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be numeric, got {type(value).__name__}: {error}") from error
    if last and array.shape[-len(last) :] != last:
        wanted = ", ".join(str(n) for n in last)
        raise InputError(f"{name} must have shape (..., {wanted}), got {array.shape}")
    return array


def as_finite(value: ArrayLike, shape: tuple[int, ...], name: str) -> Float:
    """Return a copy of ``value`` as a float64 array of exactly ``shape`` with finite values."""
    array = np.array(as_floats(value, (), name), ndmin=1)
    if array.shape != shape:
        raise InputError(f"{name} must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise InputError(f"{name} must be finite, got {array.tolist()}")
    return array


def as_image(value: ArrayLike, name: str) -> NDArray[Any]:
    """Return ``value`` as an array of pixels in its own dtype."""
    array = np.asarray(value)
    sound = array.ndim == 2 and array.size > 0 and array.dtype.kind in "iuf"
    require(sound, f"{name} must be a 2-D array of real numbers, got {array.dtype} of shape {array.shape}")
    return array


def as_unit(value: ArrayLike, name: str, *, tolerance: float = 1e-9) -> Float:
    """Return ``value`` as unit vectors. ``value`` (..., 3); returns (..., 3)."""
    array = as_floats(value, (3,), name)
    norms = np.linalg.norm(array, axis=-1)
    worst = float(np.max(np.abs(norms - 1.0), initial=0.0))
    if not worst <= tolerance:
        raise InputError(
            f"{name} must be unit vectors to {tolerance:g}, the worst norm is off by {worst:g}: normalize them"
        )
    return array


def unit(vectors: Float) -> Float:
    """Return vectors (..., 3) scaled to length one."""
    result: Float = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return result


def frozen(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return ``array`` itself, set read-only."""
    array.flags.writeable = False
    return array


def require_number(
    value: float, name: str, *, least: float = -math.inf, above: float = -math.inf, most: float = math.inf
) -> None:
    """Raise unless a number is finite and in its range."""
    if not (math.isfinite(value) and least <= value <= most and value > above):
        signs = ((">=", least), (">", above), ("<=", most))
        needs = [f"{sign} {bound:g}" for sign, bound in signs if math.isfinite(bound)]
        raise InputError(f"{name} must be {' and '.join([*needs, 'finite'])}, got {value}")


def finite_or_none(value: float) -> float | None:
    """Return a number that JSON can hold: None for NaN and infinity."""
    return value if math.isfinite(value) else None


def require(condition: bool, message: str) -> None:
    """Raise :class:`InputError` with ``message`` unless ``condition``."""
    if not condition:
        raise InputError(message)


def symmetric(matrix: Float) -> Float:
    """Symmetric part of matrices (..., n, n): without the rounding of a product of several."""
    return (matrix + np.swapaxes(matrix, -1, -2)) / 2.0
