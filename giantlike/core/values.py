"""The base of values that hold arrays: read-only, and with the invariants that names of fields carry checked.

A field named ``covariance...`` is a covariance matrix (or many), a field named ``direction_FRAME``,
``directions_FRAME`` or ``..._direction_FRAME`` is a unit vector (or many).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from typing import Self, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, Scalar, require

UNIT_TOLERANCE = 1e-9
"""Largest error of the length of a unit vector: rounding of float64 leaves 1e-15, a table with ten digits 1e-10."""
ASYMMETRY_TOLERANCE = 1e-9
"""Largest difference of two mirrored elements, divided by the product of their standard deviations."""
EIGENVALUE_TOLERANCE = 1e-9  # tolerance for negative eigenvalues of a correlation matrix, from rounding
_FEW = 3  # maximum rows of a matrix for which a check element by element is faster


AnyValue = TypeVar("AnyValue", bound="Value")


class Value:
    """Base of frozen dataclasses that hold arrays.

    Every array field becomes a read-only view: assigning to an element raises ``ValueError``, while the array that
    the caller handed in stays writable. A class with its own ``__post_init__`` calls ``Value.__post_init__(self)``
    at its end (a dataclass with slots cannot use ``super()``).

    Raises
    ------
    InputError
        A covariance is not symmetric or not positive semi-definite, or a direction is not a unit vector.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True, slots=True, eq=False)
    ... class Point(Value):
    ...     place_px: Float
    >>> Point(np.zeros(2)).place_px[0] = 1.0
    Traceback (most recent call last):
    ValueError: assignment destination is read-only
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        for name, check in _invariants(type(self)):
            value = getattr(self, name)
            if isinstance(value, np.ndarray):
                if check is not None:
                    check(value, name)
                object.__setattr__(self, name, read_only(value))

    def _keep(self, **checked: object) -> None:
        """Replace fields by checked values, at the end of a ``__post_init__``."""
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        Value.__post_init__(self)


class Estimate(Value):
    """Base of the values that a fit returns in place of a :class:`~giantlike.core.outcomes.Failure`."""

    __slots__ = ()

    def unwrap(self) -> Self:
        """Return the value itself; a :class:`~giantlike.core.outcomes.Failure` raises instead."""
        return self


_Check: TypeAlias = Callable[[Float, str], None]

_INVARIANTS: dict[type, tuple[tuple[str, _Check | None], ...]] = {}


def _invariants(kind: type) -> tuple[tuple[str, _Check | None], ...]:
    """Names of the fields of a class of values, and the checks that their names imply; cached for each class."""
    known = _INVARIANTS.get(kind)
    if known is None:
        names = [field.name for field in fields(kind)]
        known = _INVARIANTS[kind] = tuple((name, _check_of(name)) for name in names)
    return known


def _check_of(name: str) -> _Check | None:
    """Check implied by the name of a field."""
    if name.startswith("covariance"):
        return check_covariance
    return check_directions if "direction_" in name or "directions_" in name else None


def select_rows(value: AnyValue, which: NDArray[np.integer] | Mask | slice) -> AnyValue:
    """Return a copy of a value in which every array is indexed along its first axis. ``which`` (k,), (n,) or slice."""
    # Rows of a checked value need no second check, which costs more than the selection.
    selected = object.__new__(type(value))
    for name, _ in _invariants(type(value)):
        part = getattr(value, name)
        rows = read_only(part[which]) if isinstance(part, np.ndarray) else part
        object.__setattr__(selected, name, rows)
    return selected


def read_only(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return a view of an array that refuses assignment."""
    view = array.view()
    view.setflags(write=False)  # a third of the time of view.flags.writeable = False
    return view


def check_covariance(covariance: Float, name: str, tolerance: float = EIGENVALUE_TOLERANCE) -> None:
    """Raise :class:`InputError` unless matrices (..., n, n), where finite, are symmetric and positive semi-definite.

    Correlation matrices may have eigenvalues down to ``-tolerance``, and an asymmetry of the larger of ``tolerance``
    and :data:`ASYMMETRY_TOLERANCE`.
    """
    shape = covariance.shape
    require(len(shape) >= 2 and shape[-1] == shape[-2], f"{name} must be square, got shape {shape}")
    if _clearly_covariances(covariance):
        return
    if not np.isfinite(covariance).all():
        covariance = covariance[np.isfinite(covariance).all(axis=(-2, -1))]
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    require(bool((variance >= 0.0).all()), f"{name} must have no negative variance, got {variance.tolist()}")
    sigma = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    correlation = covariance / (sigma[..., :, None] * sigma[..., None, :])
    asymmetry = float(np.max(np.abs(correlation - np.swapaxes(correlation, -1, -2)), initial=0.0))
    symmetric = asymmetry <= max(ASYMMETRY_TOLERANCE, tolerance)
    require(symmetric, f"{name} must be symmetric, mirrored elements differ by {asymmetry:.2g}")
    least = float(np.min(_least_eigenvalues(correlation), initial=0.0))
    require(
        least >= -tolerance,
        f"{name} must be positive semi-definite, its correlation matrix has the eigenvalue {least:.2g}",
    )


def _clearly_covariances(matrices: Float) -> bool:
    """True if matrices (..., n, n) are symmetric, finite and positive definite: in a tenth of the time."""
    if matrices.ndim == 2:
        return len(matrices) <= _FEW and _has_cholesky_factor(matrices.tolist())
    if matrices.shape[-1] != 2:
        return False
    a, b, c, d = matrices.reshape(-1, 4).T
    sound = (b == c) & (a > 0.0) & (b * b < a * d) & (a + d < np.inf)
    return bool(sound.all())


def _has_cholesky_factor(rows: list[list[float]]) -> bool:
    """True if a small matrix is symmetric to :data:`ASYMMETRY_TOLERANCE` and has a Cholesky factor."""
    factor: list[list[float]] = []
    for i, row in enumerate(rows):
        if not row[i] > 0.0:
            return False
        found: list[float] = []
        for j in range(i):
            if not abs(row[j] - rows[j][i]) <= ASYMMETRY_TOLERANCE * math.sqrt(row[i] * rows[j][j]):
                return False
            before = sum([found[k] * factor[j][k] for k in range(j)])
            found.append((row[j] - before) / factor[j][j])
        left = row[i] - sum([one * one for one in found])
        if not 0.0 < left < math.inf:
            return False
        factor.append([*found, math.sqrt(left)])
    return True


def _least_eigenvalues(matrices: Float) -> Float:
    """Smallest eigenvalues (m,) of symmetric matrices (m, n, n); for 2 x 2 in closed form, 9 times faster."""
    if matrices.shape[-1] != 2:
        return np.asarray(np.linalg.eigvalsh(matrices)[..., :1])
    a, b, d = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 1]
    return (a + d) / 2.0 - np.hypot((a - d) / 2.0, b)


def check_directions(directions: Float, name: str) -> None:
    """Raise :class:`InputError` unless vectors (..., k) have length one; vectors with NaN (unknown) are not checked."""
    if not isinstance(directions, np.memmap):  # a catalog of millions of stars is not read for a check
        worst = _worst_length(directions)
        require(
            worst <= UNIT_TOLERANCE,
            f"{name} must be unit vectors to {UNIT_TOLERANCE:g}, a length is off by {worst:.2g}: divide by the norm",
        )


def _worst_length(directions: Float) -> float:
    """Largest difference of the length of vectors (..., k) from one, those with NaN left out."""
    if directions.ndim == 1:  # a single vector, as most are: in a fifth of the time
        apart = abs(math.hypot(*directions.tolist()) - 1.0)
        return 0.0 if math.isnan(apart) else apart
    return float(np.nanmax(np.abs(np.linalg.norm(directions, axis=-1) - 1.0), initial=0.0))
