"""Quality flags: one rule for each, whatever the estimator."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from giantlike.core.errors import InputError
from giantlike.core.outcomes import Quality
from giantlike.relative.quality import QualityChecks


def flags(**numbers: Any) -> Quality:
    return QualityChecks(**{"off_px": np.zeros(2), "search_px": 40.0, **numbers}).flags


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
        ({"residuals": 1.01}, Quality.LARGE_RESIDUALS),
        ({"outline_share": 0.24}, Quality.SHORT_ARC),
        ({"weakness": 1.01}, Quality.LOW_SCORE),
        ({"prediction_chance": 9e-4}, Quality.FAR_FROM_PREDICTION),
        ({"prediction_chance": 1.1e-3}, Quality.NONE),
        ({"place_chance": 0.018, "figure_chance": 0.018}, Quality.DISAGREEMENT),
        ({"place_chance": 0.018, "prediction_chance": 0.018}, Quality.DISAGREEMENT),
        ({"place_chance": 1e-4, "figure_chance": 0.019}, Quality.NONE),
        ({"strain_chance": 9e-5}, Quality.WRONG_FIGURE),
        ({"strain_chance": 1.1e-4}, Quality.NONE),
        ({"ambiguous": True}, Quality.AMBIGUOUS),
        ({"cut_by_frame": True}, Quality.CUT_BY_FRAME),
    ],
)
def test_each_flag_has_one_limit(numbers: dict[str, Any], flag: Quality) -> None:
    assert flags(**numbers) == flag


def test_more_used_than_offered_is_refused() -> None:
    with pytest.raises(InputError, match="n_used"):
        flags(n_used=3, n_offered=2)


def test_two_objections_are_as_rare_as_the_limit_says() -> None:
    drawn = np.random.default_rng(5).random((400_000, 3))
    seconds = np.sort(drawn, axis=1)[:, 1]
    for second in (0.018, 0.1, 0.5):
        checks = QualityChecks(off_px=np.zeros(2), search_px=40.0, place_chance=0.0, figure_chance=second)
        share = float((seconds <= second).mean())
        assert abs(checks.objections_chance - share) < 4.0 * np.sqrt(share / len(drawn))
