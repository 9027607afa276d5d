"""Smallest positive root of a polynomial, which bounds the region in which a lens can be inverted."""

from __future__ import annotations

import numpy as np

_FARTHEST = 1e12  # larger roots count as none: squared image-plane radii beyond it are 90 degrees from the axis


def smallest_positive_root(*coefficients: float) -> float:
    """Smallest positive root of ``1 + c1 t + c2 t^2 + ...``; infinite where there is none.

    The reciprocal of the largest root of the reversed polynomial, for which tiny and zero coefficients are harmless.

    >>> smallest_positive_root(-1.0, -2.0)
    0.5
    """
    reciprocals = np.roots([1.0, *coefficients])
    real = reciprocals.real[np.abs(reciprocals.imag) <= 1e-9 * np.abs(reciprocals)]
    largest = float(real.max(initial=0.0))
    return 1.0 / largest if largest > 1.0 / _FARTHEST else float("inf")
