"""Result of a pass: parameters with covariance by cause, tests of each term, and undetermined combinations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats

from giantlike.calibration.observability import WeakCombination
from giantlike.core.arrays import Float, require
from giantlike.core.errors import InputError
from giantlike.core.values import Value


@dataclass(frozen=True, slots=True, kw_only=True)
class TermTest:
    """Test of the hypothesis that the parameters of a term have their a priori values."""

    term: str
    # squared departure in units of its covariance under the hypothesis, correlations and considered errors included;
    # divided by ``count`` where the noise was scaled by the residuals
    statistic: float
    count: int  # number of parameters
    # degrees of freedom of the noise: the statistic is F with ``(count, freedom)``, or chi-square of ``count`` where
    # None
    freedom: int | None
    p_value: float  # probability of a statistic at least as large under the hypothesis

    def significant(self, level: float = 0.05) -> bool:
        """True if the hypothesis is rejected at a level."""
        return self.p_value < level


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimetagJitter(Value):
    """Errors of the timetags in addition to their bias."""

    sigma_s: float  # standard deviation of the errors
    # standard deviation of the natural logarithm of ``sigma_s``; 0 where it was given, not estimated
    sigma_of_log: float
    p_value: float  # of the hypothesis of no jitter; 1 where it was given
    errors_s: Float  # errors_s, sigmas_s: (n,); error of each tag as the image shows it, and its standard deviation
    sigmas_s: Float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PassFix(Value):
    """Parameters that the images of a pass share, as they show them.

    Parameters
    ----------
    names, units, terms : tuple of str; of the k parameters that were estimated
    values : (k,) float64
    covariance : (k, k) float64
    parts : mapping of str to (k, k) float64; ``noise`` (scaled by residuals), ``a priori``, ``considered TERM``
    apriori, apriori_sigmas : (k,) float64; values and standard deviations before; infinite where nothing was known
    learned : (k,) float64; fraction of the a priori variance that the pass removed; 1 where nothing was known
    tests : tuple of TermTest
    weak : tuple of WeakCombination
    jitter : TimetagJitter or None
    positions_camera_km : (n, 3) float64, km, camera axes; of the body, without altitude and offsets of limbs
    residuals : tuple of (m,) float64, sigmas; measured minus predicted, jitter left in; NaN where excluded
    chi2 : float; squared residuals in units of their covariance
    freedom : int
    noise_scale : float; factor on the standard deviations of the noise, at least 1
    n_used, n_rejected, iterations : int
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    terms: tuple[str, ...]
    values: Float
    covariance: Float
    parts: Mapping[str, Float]
    apriori: Float
    apriori_sigmas: Float
    learned: Float
    tests: tuple[TermTest, ...]
    weak: tuple[WeakCombination, ...]
    jitter: TimetagJitter | None
    positions_camera_km: Float
    residuals: tuple[Float, ...]
    chi2: float
    freedom: int
    noise_scale: float
    n_used: int
    n_rejected: int
    iterations: int

    @property
    def sigmas(self) -> Float:
        """Standard deviations (k,) of the values."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def correlation(self) -> Float:
        """Correlations (k, k) of the values."""
        return self.covariance / np.outer(self.sigmas, self.sigmas)

    def value(self, name: str) -> float:
        """Value of a parameter, one of ``names``; InputError for others."""
        return float(self.values[self._index(name)])

    def sigma(self, name: str) -> float:
        """Standard deviation of a parameter, one of ``names``; InputError for others."""
        return float(self.sigmas[self._index(name)])

    def test(self, term: str) -> TermTest:
        """Test of a term, one of ``terms``; InputError for one that was not estimated."""
        for each in self.tests:
            if each.term == term:
                return each
        raise InputError(f"no term {term!r} was estimated; there are {', '.join(each.term for each in self.tests)}")

    def _index(self, name: str) -> int:
        require(name in self.names, f"no parameter {name!r} was estimated; there are {', '.join(self.names)}")
        return self.names.index(name)


def term_test(term: str, departure: Float, covariance: Float, freedom: int | None) -> TermTest:
    """Test a departure (k,) against its covariance (k, k) under the hypothesis that there is none."""
    scale = np.sqrt(np.diagonal(covariance))
    used = scale > 0.0
    scaled = departure[used] / scale[used]
    correlation = covariance[np.ix_(used, used)] / np.outer(scale[used], scale[used])
    squared, count = float(scaled @ np.linalg.pinv(correlation, hermitian=True) @ scaled), int(used.sum())
    if freedom is None or count == 0:
        return TermTest(
            term=term,
            statistic=squared,
            count=count,
            freedom=None,
            p_value=float(stats.chi2.sf(squared, count)) if count else 1.0,
        )
    return TermTest(
        term=term,
        statistic=squared / count,
        count=count,
        freedom=freedom,
        p_value=float(stats.f.sf(squared / count, count, freedom)),
    )
