"""Classification of fixes: facts of a solution, and two tests at one rate of false alarms.

A fix is suspect where a named alternative explains the image better, where another position is not excluded, or where
it contradicts the declared prediction. The remedy for imprecision is a larger sigma.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from giantlike.core.arrays import Float, require
from giantlike.core.outcomes import Quality
from giantlike.core.values import Value

FALSE_ALARM = 1e-3  # rate of false alarms of each test of a fix
SHORT_ARC_SHARE = 0.25
"""Share of the outline below which an arc is short; the documented meaning of ``Quality.SHORT_ARC``.

A quarter of a circle still separates center and radius: the sagitta of such an arc is 29 % of the radius.
"""
LEAST_USED_SHARE = 0.5
"""Minimum fraction of the observations used; the documented meaning of ``Quality.MANY_REJECTED``.

The median absolute deviation, by which outliers are found, breaks down where half of the observations are wrong.
"""
BORDER_SHARE = 0.9  # fraction of a bounded search beyond which a fix lies at its edge: the body may lie outside


class Alternative(StrEnum):
    """Another model of an image."""

    OTHER_SUN = "other_sun"  # the illumination direction is not the Sun's
    SECOND_LIGHT = "second_light"
    """A second image of the body lies next to the first: another exposure, a ghost, a second body."""
    SECOND_EXPOSURE = "second_exposure"  # two exposures, a few pixels apart, instead of a motion
    DARK_BODY = "dark_body"  # the image is darker where the body should be: it is not there
    OTHER_OUTLINE = "other_outline"  # the outline is the outline of another body
    OTHER_SIZE = "other_size"  # A body of another apparent size fits the image, this one only with large markings
    SHIFTED_ROWS = "shifted_rows"  # all rows from one on are shifted
    SHIFTED_COLUMNS = "shifted_columns"  # all columns from one on are shifted
    SMOOTH_LIMB = "smooth_limb"  # the limb is the limb of the smooth body, without its height map


_FLAGS = {
    Alternative.OTHER_SUN: Quality.WRONG_LIGHT,
    Alternative.SECOND_LIGHT: Quality.UNEXPLAINED_LIGHT,
    Alternative.SECOND_EXPOSURE: Quality.UNEXPLAINED_LIGHT,
    Alternative.DARK_BODY: Quality.UNEXPLAINED_LIGHT,
    Alternative.OTHER_OUTLINE: Quality.WRONG_FIGURE,
    Alternative.OTHER_SIZE: Quality.WRONG_FIGURE,
    Alternative.SHIFTED_ROWS: Quality.WRONG_FIGURE,
    Alternative.SHIFTED_COLUMNS: Quality.WRONG_FIGURE,
    Alternative.SMOOTH_LIMB: Quality.WRONG_FIGURE,
}
_WEIGHT = 1.0 / len(Alternative)  # A priori weight of each alternative: all are equal


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Facts(Value):
    """Facts of a solution that no statistics decide; the defaults raise no flag.

    search_range: declared search: largest relative error of the predicted range; infinite for estimators that keep the
        range.
    bounded: True for estimators that cannot leave ``search_px``: a fix at its edge may be the flank of a body outside.
    """

    off_px: Float  # (2,); estimated minus predicted position of the point for which the search was declared
    search_px: float  # declared search: largest error of the prediction, in both coordinates
    range_ratio: float = 1.0  # ratio of predicted to estimated range: 1 + the relative error of the prediction
    search_range: float = math.inf
    bounded: bool = False
    n_used: int = 1  # observations used
    n_offered: int = 1  # observations used or rejected
    outline_share: float = 1.0  # ratio of the length of outline used to the whole outline
    cut_by_frame: bool = False  # the body reaches over the edge of the image
    ambiguous: bool = False  # another source that fits equally well lies in the search region
    overexposed: bool = False  # all of the limb is saturated; only the wings of the point spread function are left

    def __post_init__(self) -> None:
        require(0 <= self.n_used <= self.n_offered, f"needed n_used in [0, {self.n_offered}], got {self.n_used}")
        Value.__post_init__(self)

    @property
    def far_from_prediction(self) -> bool:
        """True if the fix lies beyond the declared search, or at the edge of a bounded one.

        The limits are those of the options. They do not grow with the uncertainty of the fix: a distant fix is not
        confirmed by being uncertain.
        """
        limit_px = self.search_px * (BORDER_SHARE if self.bounded else 1.0)
        return float(np.max(np.abs(self.off_px))) > limit_px or abs(self.range_ratio - 1.0) > self.search_range

    @property
    def flags(self) -> Quality:
        """Flags raised by the facts."""
        return _collect_flags(
            {
                Quality.CUT_BY_FRAME: self.cut_by_frame,
                Quality.SHORT_ARC: self.outline_share < SHORT_ARC_SHARE,
                Quality.MANY_REJECTED: self.n_used < LEAST_USED_SHARE * self.n_offered,
                Quality.FAR_FROM_PREDICTION: self.far_from_prediction,
                Quality.AMBIGUOUS: self.ambiguous,
                Quality.LOW_SCORE: self.overexposed,
            }
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """Evidence against a fix.

    alternatives: logarithms of the odds of other models of the image, each integrated over its parameters.
    other_place: logarithm of the odds that the body is at the best other position in the search region.

    The mean of the odds of the alternatives, weighted a priori, exceeds ``1 / false_alarm`` at most at the rate
    ``false_alarm`` where the fix is correct, by Markov's inequality. The alternative with the largest odds gives the
    flag. Another position must be less likely by the same factor; the test of the prediction has the same rate.
    """

    alternatives: Mapping[Alternative, float] = field(default_factory=dict)
    other_place: float = -math.inf
    prediction_chance: float = 1.0  # p-value of the difference of fix and prediction
    false_alarm: float = FALSE_ALARM  # rate of false alarms of each test

    @property
    def flags(self) -> Quality:
        """Flags raised by the tests."""
        flags, limit = Quality.NONE, -math.log(self.false_alarm)
        if self.alternatives:
            likeliest = max(self.alternatives, key=lambda one: self.alternatives[one])
            total = float(np.logaddexp.reduce([*self.alternatives.values()])) + math.log(_WEIGHT)
            flags |= _collect_flags({_FLAGS[likeliest]: total > limit})
        return flags | _collect_flags(
            {
                Quality.AMBIGUOUS: self.other_place > -limit,
                Quality.FAR_FROM_PREDICTION: self.prediction_chance < self.false_alarm,
            }
        )

    @property
    def numbers(self) -> dict[str, float]:
        """Test statistics by name."""
        odds = {f"{name}_log_odds": odds for name, odds in self.alternatives.items() if odds > -math.inf}
        known = {"other_place_log_odds": self.other_place} if self.other_place > -math.inf else {}
        chance = {"prediction_chance": self.prediction_chance} if self.prediction_chance < 1.0 else {}
        return odds | known | chance


def inflation(squared: float, freedom: int) -> float:
    """Factor by which variances are too small for a difference.

    Returns at least 1.

    The formal variances count as an estimate with ``freedom`` degrees of freedom; the factor is the mean of their
    scale, 1, and the scale of the difference, ``squared / freedom``.
    """
    return max(0.5 * (1.0 + squared / freedom), 1.0)


def explaining_inflation(difference: Float, own: Float, other: Float, false_alarm: float = FALSE_ALARM) -> float:
    """Minimum factor of a covariance at which a difference is not significant.

    ``difference`` (k,); ``own``, ``other`` (k, k); returns at least 1.
    """
    from scipy.linalg import eigh
    from scipy.optimize import brentq
    from scipy.special import chdtri

    scale = np.sqrt(np.maximum(np.diag(own + other), 1e-300))
    whole = (own + other) / np.outer(scale, scale)
    shares, axes = eigh(own / np.outer(scale, scale), whole)
    squares = (axes.T @ (difference / scale)) ** 2
    most = float(chdtri(len(difference), false_alarm))

    def excess(log_factor: float) -> float:
        return float(np.sum(squares / (1.0 + (math.exp(log_factor) - 1.0) * np.maximum(shares, 0.0)))) - most

    longest = math.log(1e12)
    if excess(0.0) <= 0.0:
        return 1.0
    return math.exp(longest if excess(longest) > 0.0 else float(brentq(excess, 0.0, longest)))


def _collect_flags(checks: Mapping[Quality, bool]) -> Quality:
    """The flags whose checks are true."""
    flags = Quality.NONE
    for flag, raised in checks.items():
        if raised:
            flags |= flag
    return flags
