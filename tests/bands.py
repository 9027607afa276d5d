"""Where statistics of a number of random draws lie, by quantiles of chi-square."""

from __future__ import annotations

from scipy.stats import chi2

from tests.tolerances import RARE


def mean_square_band(count: int, rare: float = RARE) -> tuple[float, float]:
    """Band of the mean square of ``count`` normal numbers of unit variance; it is left on either side with ``rare``."""
    low, high = (float(chi2.ppf(chance, count)) / count for chance in (rare, 1.0 - rare))
    return low, high
