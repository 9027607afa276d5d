"""Images that hold what nobody expects, through every lens: estimators answer or fail, and never break down."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from giantlike.core.outcomes import Failure, Reason
from giantlike.relative import ESTIMATORS
from giantlike.relative.limb.limb_matching import LimbMatching
from tests.relative.random_images import LENSES, broken_down, random_image
from tests.sizes import slow

FAST = ("moment", "limb_matching")


@pytest.mark.parametrize("seed", range(len(LENSES)))
def test_no_estimator_breaks_down_on_a_random_image_of_any_lens(seed: int) -> None:
    assert broken_down(seed, FAST) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(len(LENSES), 5 * len(LENSES)))
def test_no_estimator_at_all_breaks_down_on_many_random_images(seed: int) -> None:
    assert broken_down(seed) == []


ERRORS = (
    np.linalg.LinAlgError("Singular matrix"),
    ZeroDivisionError("division by zero"),
    ValueError("covariance must be symmetric, mirrored elements differ by 1.5e-09"),
    IndexError("index 0 is out of bounds"),
)


@pytest.mark.parametrize("error", ERRORS)
def test_a_computation_that_breaks_down_is_a_failure_with_its_place_and_reason(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise error

    case = random_image(0)
    monkeypatch.setattr(LimbMatching, "_solve", broken)
    outcome = LimbMatching().estimate(case.image, case.camera, case.scene)
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.INTERNAL_ERROR
    assert type(error).__name__ in outcome.detail
    assert str(error) in outcome.detail


@pytest.mark.parametrize("error", [ERRORS[0], *map(slow, ERRORS[1:])])
def test_auto_goes_on_with_its_other_estimators_where_one_breaks_down(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise error

    case = random_image(42)  # only limb_matching finds this body
    monkeypatch.setattr(LimbMatching, "_solve", broken)
    auto = ESTIMATORS["auto"]().estimate(case.image, case.camera, case.scene)
    assert isinstance(auto, Failure)
    assert auto.reason is Reason.NO_LIMB
    assert "limb_matching: internal_error; cross_correlation: " in auto.detail


def test_an_error_of_the_program_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise AttributeError("no such attribute")

    case = random_image(0)
    monkeypatch.setattr(LimbMatching, "_solve", broken)
    with pytest.raises(AttributeError):
        LimbMatching().estimate(case.image, case.camera, replace(case.scene))
