"""The judge: a limit for each fact of a solution, and two tests at one rate of false alarms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from giantlike.core.errors import InputError
from giantlike.core.outcomes import Quality
from giantlike.relative.judge import FALSE_ALARM, Alternative, Facts, Judgement

LIMIT = -math.log(FALSE_ALARM)
ALONE = LIMIT + math.log(len(Alternative))
"""Log odds that one alternative needs where all others have none: each has a fifth of the weight."""


@pytest.mark.parametrize(
    ("numbers", "flag"),
    [
        ({"off_px": np.array([0.0, -40.1])}, Quality.FAR_FROM_PREDICTION),
        ({"off_px": np.array([39.9, -39.9])}, Quality.NONE),
        ({"off_px": np.array([36.1, 0.0]), "bounded": True}, Quality.FAR_FROM_PREDICTION),
        ({"off_px": np.array([35.9, 0.0]), "bounded": True}, Quality.NONE),
        ({"range_ratio": 1.031, "search_range": 0.03}, Quality.FAR_FROM_PREDICTION),
        ({"range_ratio": 0.969, "search_range": 0.03}, Quality.FAR_FROM_PREDICTION),
        ({"range_ratio": 0.971, "search_range": 0.03}, Quality.NONE),
        ({"range_ratio": 2.0}, Quality.NONE),
        ({"n_used": 49, "n_offered": 100}, Quality.MANY_REJECTED),
        ({"n_used": 50, "n_offered": 100}, Quality.NONE),
        ({"outline_share": 0.24}, Quality.SHORT_ARC),
        ({"outline_share": 0.26}, Quality.NONE),
        ({"ambiguous": True}, Quality.AMBIGUOUS),
        ({"cut_by_frame": True}, Quality.CUT_BY_FRAME),
    ],
)
def test_each_fact_has_one_limit(numbers: dict[str, Any], flag: Quality) -> None:
    assert Facts(**{"off_px": np.zeros(2), "search_px": 40.0, **numbers}).flags == flag


def test_more_used_than_offered_is_refused() -> None:
    with pytest.raises(InputError, match="n_used"):
        Facts(off_px=np.zeros(2), search_px=40.0, n_used=3, n_offered=2)


@pytest.mark.parametrize(
    ("numbers", "flag"),
    [
        ({}, Quality.NONE),
        ({"other_place": -LIMIT + 0.1}, Quality.AMBIGUOUS),
        ({"other_place": -LIMIT - 0.1}, Quality.NONE),
        ({"prediction_chance": 9e-4}, Quality.FAR_FROM_PREDICTION),
        ({"prediction_chance": 1.1e-3}, Quality.NONE),
        ({"prediction_chance": 0.009, "false_alarm": 0.01}, Quality.FAR_FROM_PREDICTION),
        ({"alternatives": {Alternative.OTHER_SUN: ALONE + 0.1}}, Quality.WRONG_LIGHT),
        ({"alternatives": {Alternative.SECOND_LIGHT: ALONE + 0.1}}, Quality.UNEXPLAINED_LIGHT),
        ({"alternatives": {Alternative.SHIFTED_ROWS: ALONE + 0.1}}, Quality.WRONG_FIGURE),
        ({"alternatives": {Alternative.SHIFTED_COLUMNS: ALONE + 0.1}}, Quality.WRONG_FIGURE),
        ({"alternatives": {Alternative.SMOOTH_LIMB: ALONE + 0.1}}, Quality.WRONG_FIGURE),
        ({"alternatives": dict.fromkeys(Alternative, -math.inf)}, Quality.NONE),
        ({"alternatives": dict.fromkeys(Alternative, LIMIT - 0.1)}, Quality.NONE),
    ],
)
def test_each_test_has_one_limit(numbers: dict[str, Any], flag: Quality) -> None:
    assert Judgement(**numbers).flags == flag


@pytest.mark.parametrize("one", list(Alternative))
def test_an_alternative_alone_needs_the_odds_that_its_weight_leaves(one: Alternative) -> None:
    assert Judgement(alternatives={one: ALONE - 0.1}).flags == Quality.NONE


def test_the_mean_of_odds_decides_and_the_likeliest_alternative_names_the_flag() -> None:
    both = {Alternative.OTHER_SUN: ALONE - 0.6, Alternative.SHIFTED_ROWS: ALONE - 0.5}
    assert Judgement(alternatives=both).flags == Quality.WRONG_FIGURE
    for one, log_odds in both.items():
        assert Judgement(alternatives={one: log_odds}).flags == Quality.NONE


def test_numbers_name_what_was_tested_and_nothing_else() -> None:
    judgement = Judgement(alternatives={Alternative.SECOND_LIGHT: 3.0}, other_place=-20.0, prediction_chance=0.5)
    assert judgement.numbers == {
        "second_light_log_odds": 3.0,
        "other_place_log_odds": -20.0,
        "prediction_chance": 0.5,
    }
    assert Judgement().numbers == {}


@pytest.mark.monte_carlo(few=4000, full=20_000)
@pytest.mark.parametrize("false_alarm", [1e-3, 1e-2, 0.1])
def test_right_models_raise_false_alarms_at_most_at_the_rate(false_alarm: float, draws: int) -> None:
    """Markov's inequality: data are noise, alternatives add signals whose amplitudes are a priori normal."""
    rng, count, sigma = np.random.default_rng(3), 20_000, np.geomspace(0.5, 8.0, len(Alternative))
    scores = rng.normal(size=(count, len(Alternative)))  # of unit signals in unit noise
    log_odds = 0.5 * scores**2 * sigma**2 / (1.0 + sigma**2) - 0.5 * np.log1p(sigma**2)
    assert float(np.exp(log_odds[:, 0]).mean()) == pytest.approx(1.0, rel=0.02)  # odds, whose mean is 1
    alarms = sum(
        Judgement(alternatives=dict(zip(Alternative, row, strict=True)), false_alarm=false_alarm).flags != Quality.NONE
        for row in log_odds[:draws]
    )
    assert alarms <= false_alarm * draws + 4.0 * math.sqrt(false_alarm * draws)
    found = scores + rng.normal(size=scores.shape) * 30.0  # signals of thirty sigma are found
    of_signals = 0.5 * found[:200] ** 2 * sigma**2 / (1.0 + sigma**2) - 0.5 * np.log1p(sigma**2)
    seen = [Judgement(alternatives=dict(zip(Alternative, row, strict=True))).flags for row in of_signals]
    assert sum(flags != Quality.NONE for flags in seen) > 190
