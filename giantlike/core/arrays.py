"""Checks at the border: arrays that come in get a shape, a dtype and finite values, or a clear error."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.core.errors import InputError

Scalar = TypeVar("Scalar", bound=np.generic)
Float = NDArray[np.float64]
"""A float64 array; its shape, unit and frame are in the docstring of whoever takes it."""
Mask = NDArray[np.bool_]
"""A boolean array; in the mask of an image True is a bad pixel."""


def as_floats(value: ArrayLike, last: tuple[int, ...], name: str) -> Float:
    """Return ``value`` as float64 with trailing axes ``last``, any leading axes.

    Parameters
    ----------
    value : array_like
    last : tuple of int
        The required trailing shape: ``(3,)`` for points, ``(3, 3)`` for matrices, ``()`` for anything.
    name : str
        How the error calls it.

    Raises
    ------
    InputError
        The shape differs or the value is not numeric.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be numeric, got {type(value).__name__}: {error}") from error
    if last and array.shape[-len(last) :] != last:
        wanted = ", ".join(str(n) for n in last)
        raise InputError(f"{name} must have shape (..., {wanted}), got {array.shape}")
    return array


def as_finite(value: ArrayLike, shape: tuple[int, ...], name: str) -> Float:
    """Return ``value`` as a float64 array of exactly ``shape`` with finite values (a copy).

    Raises
    ------
    InputError
        The shape differs, or a value is NaN or infinite.
    """
    array = np.array(value, dtype=np.float64) if not np.isscalar(value) else np.array([value], dtype=np.float64)
    if array.shape != shape:
        raise InputError(f"{name} must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise InputError(f"{name} must be finite, got {array.tolist()}")
    return array


def as_unit(value: ArrayLike, name: str, *, tolerance: float = 1e-9) -> Float:
    """Return unit vectors (..., 3); anything that is not unit to ``tolerance`` is refused."""
    array = as_floats(value, (3,), name)
    norms = np.linalg.norm(array, axis=-1)
    worst = float(np.max(np.abs(norms - 1.0), initial=0.0))
    if not worst <= tolerance:
        raise InputError(f"{name} must be unit vectors to {tolerance:g}, the worst norm is off by {worst:g}: normalize")
    return array


def unit(vectors: Float) -> Float:
    """Scale vectors (..., 3) to length one."""
    result: Float = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return result


def frozen(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return ``array`` set read-only, so that a value that holds it stays a value.

    Meant for large arrays (pixels, vertices): scipy's ``Rotation.apply`` refuses read-only vectors.
    """
    array.flags.writeable = False
    return array


def require_number(
    value: float, name: str, *, least: float = -math.inf, above: float = -math.inf, most: float = math.inf
) -> None:
    """Raise unless a number is finite and in its range.

    Parameters
    ----------
    value : float
        The number.
    name : str
        Name of the number in the message.
    least, most : float
        Bounds that the number may reach.
    above : float
        Lower bound that the number must exceed.

    Raises
    ------
    InputError
        The number is NaN, infinite or out of range.
    """
    if not (math.isfinite(value) and least <= value <= most and value > above):
        signs = ((">=", least), (">", above), ("<=", most))
        needs = [f"{sign} {bound:g}" for sign, bound in signs if math.isfinite(bound)]
        raise InputError(f"{name} must be {' and '.join([*needs, 'finite'])}, got {value}")


def require(condition: bool, message: str) -> None:
    """Raise :class:`InputError` with ``message`` unless ``condition``."""
    if not condition:
        raise InputError(message)
