"""The replay of the paper on Orion: what it compares, and the pieces that it is made of."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.dynamics import fly
from giantlike.missions import ComparisonKind, Replay, ReplaySettings, run_replay, save_replay
from giantlike.missions.orion.gimbal import gimbal_angles, pinhole_error_px
from giantlike.missions.orion.return_leg import analyze_plan, angle_slope, entry_angle_deg
from giantlike.missions.orion.return_plan import ReturnPlan, make_plan, without_close_pass
from tests.numerical import numerical_jacobian
from tests.tolerances import FLOAT64_SUM

NAMED = (
    "eq. 21", "eqs. 28-30", "eq. 31", "eq. 33", "eq. 38", "eq. 25", "eq. 26", "eq. 29", "eq. 34", "eq. 35", "eq. 36",
    "eq. 39", "Fig. 4", "Fig. 10c", "I.A", "I.B", "II.C", "III.A",
)  # fmt: skip
"""Places of the paper that the replay has to compare."""


@pytest.fixture(scope="module", name="settings")
def _settings(tmp_path_factory: pytest.TempPathFactory) -> ReplaySettings:
    return ReplaySettings(output=tmp_path_factory.mktemp("orion"), small=True)


@pytest.fixture(scope="module", name="replay")
def _replay(settings: ReplaySettings) -> Replay:
    return run_replay("orion", settings)


@pytest.fixture(scope="module", name="plan")
def _plan() -> ReturnPlan:
    return without_close_pass(make_plan(7200.0, 3600.0))


@pytest.mark.slow
def test_every_place_of_the_paper_is_compared(replay: Replay) -> None:
    places = {each.reference for each in replay.comparisons}
    assert not [name for name in NAMED if not any(name in place for place in places)]
    figures = [figure.reference for section in replay.sections for figure in section.figures]
    assert figures == sorted(figures, key=figures.index)
    assert {"Fig. 1", "Fig. 2", "Fig. 3", "Fig. 4", "Fig. 5", "Fig. 9", "Fig. 10a", "Fig. 10b", "Fig. 10c"} <= set(
        figures
    )


@pytest.mark.slow
def test_errors_of_the_paper_are_told_as_disagreements(replay: Replay) -> None:
    wrong = {each.what: each for each in replay.comparisons if each.agrees is False}
    assert "focal length in the terrain terms, px" in wrong  # 7291.7 against 7312.5
    assert "a pixel of III.A, arcsec" in wrong  # 43.3 mm and 0.018 mm
    assert all(each.kind is not ComparisonKind.INPUT for each in wrong.values())


@pytest.mark.slow
def test_the_report_is_written(replay: Replay, settings: ReplaySettings) -> None:
    save_replay(replay, settings)
    written = json.loads((Path(settings.output) / "replay.json").read_text(encoding="utf-8"))
    assert len(written["comparisons"]) == len(replay.comparisons)
    assert (Path(settings.output) / "report.html").read_text(encoding="utf-8").count("<svg") >= 12


def test_the_reference_arrives_at_the_entry_interface(plan: ReturnPlan) -> None:
    end = plan.legs[-1].steps[-1].mean
    assert_allclose(np.linalg.norm(end[:3]), 6378.137 + 121.92, atol=0.1)  # km; the file has nine digits
    assert_allclose(entry_angle_deg(end[:6]), -6.0, atol=1e-4)
    slope = angle_slope(end)
    numeric = numerical_jacobian(lambda state: entry_angle_deg(state)[None], end[:6], 1e-3)[0]
    assert_allclose(slope, numeric, rtol=1e-3)


def test_corrections_bring_the_place_at_entry_back(plan: ReturnPlan) -> None:
    last = [leg for leg in plan.legs if leg.guidance is not None][-1]
    guidance, at = last.guidance, last.steps[-1].mean[:6]
    assert guidance is not None
    away = np.array([1.0, -2.0, 0.5, 1e-5, 2e-5, -1e-5])
    burned = at + away + np.concatenate([np.zeros(3), guidance @ away])
    end = plan.legs[-1]
    arrived = fly(plan.model.dynamics, last.et, burned, end.et).state[:3] - end.steps[-1].mean[:3]
    drifted = fly(plan.model.dynamics, last.et, at + away, end.et).state[:3] - end.steps[-1].mean[:3]
    assert np.linalg.norm(arrived) < 0.01 * np.linalg.norm(drifted)  # to first order


def test_a_world_as_the_filter_believes_it_has_the_covariance_of_the_filter(plan: ReturnPlan) -> None:
    at = analyze_plan(plan, as_believed=True)[2]
    sigma = at.state.factors.sigmas()
    difference = at.joint.navigation_error()[1] - at.state.factors.composed()
    assert_allclose(difference / np.outer(sigma, sigma), 0.0, atol=FLOAT64_SUM)


def test_equation_39_is_exact_on_the_axes_of_the_gimbal_alone() -> None:
    azimuth, elevation = gimbal_angles()
    assert len(azimuth) == 99
    errors = pinhole_error_px(azimuth, elevation)
    on_axis = (azimuth == 0.0) | (elevation == 0.0)
    assert errors[on_axis].max() < FLOAT64_SUM
    assert errors[~on_axis].min() > 0.05  # px
