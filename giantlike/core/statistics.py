"""Robust statistics that several packages share."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

MAD_TO_SIGMA = 1.482602218505602
"""Standard deviation over the median absolute deviation of a normal distribution: 1 / (inverse normal CDF at 3/4)."""


def robust_sigma(values: ArrayLike, center: float | None = None) -> float:
    """Standard deviation of values by their median absolute deviation.

    Parameters
    ----------
    values : array_like
        Any shape.
    center : float, optional
        Deviations are from this; default the median of the values.

    Examples
    --------
    >>> round(robust_sigma([1.0, 2.0, 3.0, 4.0, 1000.0]), 4)
    1.4826
    """
    array = np.asarray(values, dtype=np.float64)
    middle = np.median(array) if center is None else center
    return MAD_TO_SIGMA * float(np.median(np.abs(array - middle)))
