"""What a replay leaves behind: a list of comparisons, and a page in the order of the paper."""

import json
from importlib import import_module
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
from giantlike.missions.replay import Stated

_MISSIONS = "giantlike.missions"


def _comparison(what: str, ours: float, kind: ComparisonKind = ComparisonKind.INDEPENDENT) -> Comparison:
    return Comparison(
        what=what,
        paper=1.0,
        ours=ours,
        kind=kind,
        agrees=abs(ours - 1.0) < 0.1,
        reason="within 10 %",
        reference="Fig. 1",
        fails_with="twice_as_far",
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
        flown="A body & stars.",
        pictures=("Fig. 1",),
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
        page.index(text, page.index('id="s1"'))
        for text in ("Stars &amp; a body.", "bias, km", "<svg", "It rises.", ">orbits<", "0.1 s.")
    ]
    assert places == sorted(places)
    assert page.count('class="failed">no') == 1


def test_the_page_opens_with_what_was_flown_what_agrees_and_what_does_not(replay: Replay, tmp_path: Path) -> None:
    save_replay(replay, ReplaySettings(output=tmp_path))

    page = (tmp_path / "report.html").read_text("utf-8")
    first = page[page.index('id="page"') : page.index('id="s1"')]
    places = [
        first.index(text)
        for text in ("A body &amp; stars.", "agrees, independent", "range error, km", ">disagrees<", "bias, km", "<svg")
    ]
    assert places == sorted(places)
    assert ">orbits<" not in first  # an input, found again


def test_a_comparison_needs_finite_numbers_and_a_reason() -> None:
    with pytest.raises(InputError, match="ours must be finite"):
        _comparison("bias, km", float("nan"))
    with pytest.raises(InputError, match="needs a reason"):
        Comparison(what="x", paper=1.0, ours=1.0, kind=ComparisonKind.DERIVED, agrees=True, reason="")


def test_an_independent_agreement_names_what_it_depends_on() -> None:
    with pytest.raises(InputError, match="an independent agreement names the change"):
        Comparison(what="x", paper=1.0, ours=1.0, kind=ComparisonKind.INDEPENDENT, agrees=True, reason="within 10 %")


def test_a_number_decided_by_the_size_of_a_small_replay_is_not_compared(tmp_path: Path) -> None:
    pairs = Stated("Fig. 2", "pairs", 36.0, 2.0, ComparisonKind.SELF_CHECK).agrees(None, "a small run takes fewer")
    replay = Replay(
        name="made_up",
        title="x",
        sections=(Section(title="y", comparisons=(pairs,)),),
        flown="",
        pictures=(),
        assumptions=(),
    )
    summary = save_replay(replay, ReplaySettings(output=tmp_path))
    assert summary["comparisons"][0]["agrees"] is None
    assert summary["counts"]["self_check"] == {"comparisons": 0, "agree": 0}
    assert ">not compared<" in (tmp_path / "report.html").read_text("utf-8")


def test_too_few_can_refute_and_not_confirm() -> None:
    named = Stated("Fig. 2", "bodies named", 1.0, 1.0, ComparisonKind.SELF_CHECK)
    assert named.agrees(True, "all", enough=False).agrees is None
    assert named.agrees(False, "all", enough=False).agrees is False


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "change"), [(name, change) for name in REPLAYS for change in import_module(f"{_MISSIONS}.{name}").CHANGES]
)
def test_independent_comparisons_disagree_under_the_change_that_they_name(
    name: str, change: str, tmp_path: Path
) -> None:
    replay = run_replay(name, ReplaySettings(output=tmp_path, small=True, change=change))
    depending = [each for each in replay.comparisons if each.fails_with == change]
    assert any(each.agrees is False for each in depending)
    assert not [each.what for each in depending if each.agrees]


def test_an_unknown_change_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="artemis1 has no change 'warp': relief_tripled, "):
        run_replay("artemis1", ReplaySettings(output=tmp_path, change="warp"))


def test_an_unknown_replay_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no replay 'apollo'"):
        run_replay("apollo", ReplaySettings(output=tmp_path))


def test_every_replay_is_a_package_that_says_how_it_is_run() -> None:
    for name in REPLAYS:
        assert callable(import_module(f"giantlike.missions.{name}").replay), name
