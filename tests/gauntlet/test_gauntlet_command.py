"""``giantlike gauntlet`` end to end, on few and small images."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from giantlike.campaign.store.lock import hold_lock
from giantlike.cli.app import app
from giantlike.gauntlet import KINDS, Verdict

CHEAP = ["--seed", "5", "--kinds", "point,noise,stars_nominal", "--estimators", "unresolved,moment,stars"]


def gauntlet(*arguments: str | Path | int) -> Result:
    return CliRunner().invoke(app, ["gauntlet", *map(str, arguments)])


def without_times(value: Any) -> Any:
    """A report without what a clock says."""
    if isinstance(value, dict):
        return {key: without_times(each) for key, each in value.items() if not key.startswith("cpu_s")}
    return [without_times(each) for each in value] if isinstance(value, list) else value


def test_the_report_counts_every_verdict_once_and_the_folder_holds_page_table_and_summary(tmp_path: Path) -> None:
    result = gauntlet("--images", 5, *CHEAP, "--workers", 1, "--output", tmp_path, "--json")
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["images"] == 5
    for table in ("by_kind", "by_estimator"):
        assert sum(counts["verdicts"] for counts in report[table].values()) == report["verdicts"]
        for verdict in Verdict:
            key = {"needless_refusal": "needless_refusals"}.get(verdict, str(verdict))
            assert sum(counts[str(verdict)] for counts in report[table].values()) == report[key]
    kept = json.loads((tmp_path / "gauntlet.json").read_text(encoding="utf-8"))
    assert len(kept["rows"]) == report["verdicts"]
    assert len((tmp_path / "verdicts.csv").read_text(encoding="utf-8").splitlines()) == report["verdicts"] + 1
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/jpeg") == 5
    assert "http" not in page  # nothing is fetched


@pytest.mark.slow
def test_results_do_not_depend_on_the_number_of_workers() -> None:
    alone, pair = (gauntlet("--images", 4, *CHEAP, "--workers", workers, "--json") for workers in (1, 2))
    assert without_times(json.loads(alone.stdout)) == without_times(json.loads(pair.stdout))


def test_results_do_not_depend_on_a_pause(tmp_path: Path) -> None:
    alone = gauntlet("--images", 4, *CHEAP, "--workers", 1, "--output", tmp_path / "one", "--json")
    parts = tmp_path / "one" / "images.jsonl"
    parts.write_text("".join(parts.read_text(encoding="utf-8").splitlines(keepends=True)[:2]), encoding="utf-8")
    resumed = gauntlet("--images", 4, *CHEAP, "--workers", 1, "--output", tmp_path / "one", "--resume", "--json")
    assert without_times(json.loads(resumed.stdout)) == without_times(json.loads(alone.stdout))
    assert gauntlet("--images", 4, *CHEAP, "--output", tmp_path / "one").exit_code == 2  # it holds one already


def test_a_folder_at_which_another_gauntlet_works_is_refused_with_who_holds_it(tmp_path: Path) -> None:
    with hold_lock(tmp_path):
        refused = gauntlet("--images", 1, "--output", tmp_path)
    assert refused.exit_code == 2
    assert f"process {os.getpid()} of" in refused.output
    assert not (tmp_path / "images.jsonl").exists()


def test_one_image_runs_alone_and_a_wrong_name_is_one_line() -> None:
    report = json.loads(gauntlet("--seed", 5, "--only", 3, "--estimators", "moment,stars", "--json").stdout)
    assert {row["image"] for row in report["rows"]} == {3}
    assert "no 'nominall' in the gauntlet" in gauntlet("--kinds", "nominall").stderr
    assert gauntlet("--list-kinds").stdout.count("\n") == len(KINDS)


def test_a_real_image_without_the_target_comes_after_the_others_and_is_no_silent_wrong(tmp_path: Path) -> None:
    stars = np.random.default_rng(1).poisson(20.0, size=(200, 220)).astype(np.uint16)
    stars[50:53, 60:63] += 4000
    assert cv2.imwrite(str(tmp_path / "stars.png"), stars)
    (tmp_path / "notes.txt").write_text("no image", encoding="utf-8")
    (tmp_path / "broken.png").write_bytes(b"no image either")
    result = gauntlet("--images", 1, *CHEAP, "--workers", 1, "--real", tmp_path, "--json")
    report = json.loads(result.stdout)
    assert report["images"] == 2
    assert report["by_kind"]["real_negative"]["honest"] == 2  # unresolved and moment
    assert gauntlet("--real", tmp_path / "nothing").exit_code == 2
