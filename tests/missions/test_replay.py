"""What a replay leaves behind: a list of comparisons, and a page in the order of the paper."""

import json
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from giantlike.core.errors import InputError
from giantlike.missions import (
    REPLAYS,
    Comparison,
    ComparisonKind,
    Replay,
    ReplayFigure,
    ReplaySettings,
    Section,
    run_replay,
    save_replay,
)


def _comparison(what: str, ours: float, kind: ComparisonKind = ComparisonKind.INDEPENDENT) -> Comparison:
    return Comparison(
        what=what,
        paper=1.0,
        ours=ours,
        kind=kind,
        agrees=abs(ours - 1.0) < 0.1,
        reason="within 10 %",
        reference="Fig. 1",
    )


@pytest.fixture(name="replay")
def _replay() -> Replay:
    figure = Figure()
    figure.subplots().plot([0.0, 1.0])
    return Replay(
        name="made_up",
        title="A made-up mission",
        sections=(
            Section(
                title="Approach",
                text="Stars & a body.",
                figures=(ReplayFigure(reference="Fig. 1", title="A line", caption="It rises.", figure=figure),),
                comparisons=(_comparison("range error, km", 1.05), _comparison("bias, km", 3.0)),
            ),
            Section(title="Orbit", comparisons=(_comparison("orbits", 1.0, ComparisonKind.INPUT),)),
        ),
        assumptions=("The exposure is not stated: 0.1 s.",),
    )


def test_the_json_has_each_comparison_and_counts_them_by_kind(replay: Replay, tmp_path: Path) -> None:
    summary = save_replay(replay, ReplaySettings(output=tmp_path / "out"))

    assert json.loads((tmp_path / "out" / "replay.json").read_text("utf-8")) == summary
    assert [each["what"] for each in summary["comparisons"]] == ["range error, km", "bias, km", "orbits"]
    assert summary["counts"]["independent"] == {"comparisons": 2, "agree": 1}
    assert summary["counts"]["input"] == {"comparisons": 1, "agree": 1}


def test_the_page_has_figures_and_differences_in_the_papers_order(replay: Replay, tmp_path: Path) -> None:
    save_replay(replay, ReplaySettings(output=tmp_path))

    page = (tmp_path / "report.html").read_text("utf-8")
    places = [
        page.index(text) for text in ("Stars &amp; a body.", "bias, km", "<svg", "It rises.", ">orbits<", "0.1 s.")
    ]
    assert places == sorted(places)
    assert page.count('class="failed">no') == 1


def test_a_comparison_needs_finite_numbers_and_a_reason() -> None:
    with pytest.raises(InputError, match="ours must be finite"):
        _comparison("bias, km", float("nan"))
    with pytest.raises(InputError, match="needs a reason"):
        Comparison(what="x", paper=1.0, ours=1.0, kind=ComparisonKind.DERIVED, agrees=True, reason="")


def test_an_unknown_replay_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no replay 'apollo'"):
        run_replay("apollo", ReplaySettings(output=tmp_path))


def test_every_replay_is_a_package_that_says_how_it_is_run() -> None:
    from importlib import import_module

    for name in REPLAYS:
        assert callable(import_module(f"giantlike.missions.{name}").replay), name
