"""The replay of ODIN runs small, compares what it promises, and its truth does not come from its estimators."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from giantlike.missions.odin.compared import of_interlock
from giantlike.missions.odin.narrow import InterlockStudy, true_interlock
from giantlike.missions.odin.optics import choices, coverage, is_dominated, range_sigma
from giantlike.missions.odin.paper import paper
from giantlike.missions.replay import ComparisonKind, ReplaySettings, run_replay, save_replay

NAMED = ("Table 3", "Fig. 5", "Fig. 6", "Fig. 9", "Fig. 16", "Fig. 18", "Fig. 20", "eqs. 21-23", "Flight Software")


@pytest.fixture(scope="module")
def summary(tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    folder: Path = tmp_path_factory.mktemp("odin")
    settings = ReplaySettings(output=folder, small=True)
    save_replay(run_replay("odin", settings), settings)
    assert (folder / "report.html").stat().st_size > 100_000
    assert "Fig. 13: Stars identified" in (folder / "report.html").read_text(encoding="utf-8")
    read: dict[str, object] = json.loads((folder / "replay.json").read_text())
    return read


@pytest.mark.slow
def test_every_figure_that_the_replay_names_is_compared(summary: dict[str, object]) -> None:
    comparisons = summary["comparisons"]
    assert isinstance(comparisons, list)
    references = " ".join(each["reference"] for each in comparisons)
    assert all(name in references for name in NAMED)
    assert [each["what"] for each in comparisons if each["agrees"] is None] == [
        "Earth: named rightly, wrongly, not named",
        "Moon: named rightly, wrongly, not named",
        "images whose stars are identified with the camera's size alone",
        "scatter of the angle in 2 pairs, arcsec",
        "pairs solved",
        "pairs processed",
    ]


@pytest.mark.slow
def test_the_modes_end_in_a_pose_and_refraction_is_taken_out(summary: dict[str, object]) -> None:
    comparisons = summary["comparisons"]
    assert isinstance(comparisons, list)
    found = {each["what"]: each for each in comparisons}
    for start in ("modes run from idle", "error of that position", "expected to measured Moon with refraction taken"):
        (each,) = (value for what, value in found.items() if what.startswith(start))
        assert each["agrees"], each


def test_agreement_is_decided_by_the_numbers() -> None:
    """The same study with another scatter gets another verdict."""
    rng = np.random.default_rng(1)

    def study(sigma_arcsec: float) -> InterlockStudy:
        turns = [np.radians([0.0, value / 3600.0, 0.0]) for value in rng.normal(0.0, sigma_arcsec, 36)]
        rotation = type(true_interlock()).from_rotvec(turns) * true_interlock()
        return InterlockStudy(seen=rotation, corrected=rotation, orientation=np.zeros(36), failed=0)

    for sigma, agrees in ((7.0, True), (0.5, False)):
        verdict = [each.agrees for each in of_interlock(study(sigma), np.full(10, 50.0)) if "taken out" in each.what]
        assert verdict == [agrees]
        by_air = [each for each in of_interlock(study(sigma), np.full(10, 50.0)) if "refraction alone" in each.what]
        assert not by_air[0].agrees
        assert by_air[0].kind is ComparisonKind.INDEPENDENT


def test_optics_follow_from_geometry() -> None:
    assert abs(coverage(50_000, np.random.default_rng(2)) - (1.0 - np.cos(np.radians(82.5)))) < 0.01
    # The range error falls with the three-halves power of the size, as one limb point a pixel makes it.
    slope = np.log(range_sigma(2000.0, 1737.4, 4e5) / range_sigma(8000.0, 1737.4, 4e5)) / np.log(4.0)
    assert abs(slope - 1.5) < 0.05
    every = choices()
    worse = next(each for each in every if each.sensor == "IMX273")
    assert not all(is_dominated(each, every) for each in every)
    assert worse.megapixels < 2.0
    assert paper()["calibration"]["images"] == 15
