"""Numerical derivatives: the one reference that every analytic Jacobian is checked against."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from giantlike.core.arrays import Float


def numerical_jacobian(function: Callable[[Float], Float], at: Float, step: float) -> Float:
    """Central differences: (..., m, k) for a function from (..., k) to (..., m)."""
    columns = []
    for k in range(at.shape[-1]):
        offset = np.zeros(at.shape[-1])
        offset[k] = step
        columns.append((function(at + offset) - function(at - offset)) / (2 * step))
    return np.stack(columns, axis=-1)
