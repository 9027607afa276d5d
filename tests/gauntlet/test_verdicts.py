"""Verdicts of the gauntlet: the words of its page, number by number."""

from __future__ import annotations

from dataclasses import replace

import pytest

from giantlike.gauntlet.rule import Facts, Verdict, fits, solvable
from giantlike.gauntlet.trial import Answer, is_vague, verdict_of

GOOD = Facts(
    hard=False,
    diameter_px=100.0,
    told_diameter_px=100.0,
    phase_deg=60.0,
    told_phase_deg=60.0,
    snr=50.0,
    whole=True,
    limb_px=150.0,
    told_ellipsoid=True,
    offset_px=5.0,
    range_error=0.001,
)
FIX = Answer(
    status="ok",
    error_px=0.02,
    sigma_px=0.02,
    center_sigmas=1.0,
    range_error=1e-4,
    range_sigma=1e-4,
    range_sigmas=1.0,
)


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({}, "right"),
        ({"center_sigmas": 3.9, "error_px": 2.0}, "right"),
        ({"center_sigmas": 4.1, "error_px": 2.0}, "doubtful"),
        ({"center_sigmas": 5.1, "error_px": 2.0}, "silent_wrong"),
        ({"center_sigmas": 50.0, "error_px": 0.49}, "doubtful"),
        ({"range_sigmas": 5.1, "range_error": -0.006}, "silent_wrong"),
        ({"range_sigmas": 5.1, "range_error": 0.004}, "doubtful"),
        ({"center_sigmas": float("nan")}, "silent_wrong"),
    ],
)
def test_an_ok_fix_is_judged_by_its_error_and_sigma(changes: dict[str, float], verdict: str) -> None:
    assert verdict_of(replace(FIX, **changes), GOOD, demanded=True) == verdict  # type: ignore[arg-type]


def test_an_ok_fix_of_a_body_that_is_not_there_is_silently_wrong() -> None:
    assert verdict_of(FIX, replace(GOOD, absent=True), demanded=False) is Verdict.SILENT_WRONG


def test_a_refusal_is_needless_where_an_answer_was_demanded_and_honest_elsewhere() -> None:
    refused = Answer(status="failed", reason="no_limb")
    assert verdict_of(refused, GOOD, demanded=True) is Verdict.NEEDLESS_REFUSAL
    assert verdict_of(refused, GOOD, demanded=False) is Verdict.HONEST
    suspect = replace(FIX, status="suspect", reason="disagreement", center_sigmas=90.0, error_px=40.0)
    assert verdict_of(suspect, GOOD, demanded=False) is Verdict.HONEST


def test_a_reason_that_cannot_be_true_is_misleading() -> None:
    hard = replace(GOOD, hard=True)
    for reason in ("saturated", "out_of_frame", "not_lit", "wrong_shape", "internal_error"):
        assert not fits(reason, hard)
        assert verdict_of(Answer(status="failed", reason=reason), hard, demanded=False) is Verdict.MISLEADING
    assert fits("saturated", replace(hard, saturated=True))
    assert fits("out_of_frame", replace(hard, whole=False))
    raised = Answer(status="raised", reason="ValueError")
    assert verdict_of(raised, hard, demanded=False) is Verdict.MISLEADING


def test_a_sigma_beyond_three_times_the_nominal_one_is_vague_whatever_is_stated_with_the_image() -> None:
    assert not is_vague(replace(FIX, sigma_px=0.05), FIX)
    assert is_vague(replace(FIX, sigma_px=0.07), FIX)
    assert is_vague(replace(FIX, range_sigma=4e-4), FIX)
    stated = replace(FIX, range_sigma=0.05, prior_range=0.05)
    assert not is_vague(stated, FIX)
    assert not is_vague(replace(FIX, sigma_px=9.0), Answer(status="failed", reason="no_limb"))


@pytest.mark.parametrize(
    ("changes", "demanded"),
    [
        ({}, True),
        ({"hard": True}, False),
        ({"absent": True}, False),
        ({"snr": 10.0}, False),
        ({"phase_deg": 130.0}, False),
        ({"offset_px": 35.0}, False),
        ({"range_error": 0.03}, False),
        ({"diameter_px": 30.0}, False),
        ({"limb_px": 40.0}, False),
        ({"told_ellipsoid": False}, False),
    ],
)
def test_an_answer_is_demanded_of_a_horizon_by_size_light_and_limb(changes: dict[str, float], demanded: bool) -> None:
    assert solvable("ellipsoid_cra", replace(GOOD, **changes)) is demanded  # type: ignore[arg-type]


def test_landmarks_are_never_demanded_and_stars_by_their_number() -> None:
    assert not solvable("surface_features", replace(GOOD, told_ellipsoid=False))
    assert solvable("stars", Facts(hard=False, stars=15))
    assert not solvable("stars", Facts(hard=False, stars=14))
