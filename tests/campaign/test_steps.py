"""Steps are what is kept: after any change a run goes on in its folder, redoes what is affected and nothing else."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from typer.testing import CliRunner, Result

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.image_loading import open_image
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.store.edits import Edit, Edited, add_edits
from giantlike.campaign.store.lock import hold_lock, holder_of, is_locked
from giantlike.campaign.store.records import AttitudeRecord
from giantlike.campaign.store.results import RunResult, StepCount, load_result
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.cli.app import app
from giantlike.core.errors import DataError, InputError
from tests.campaign_files import CAMERA, campaign_table, write_campaign
from tests.sizes import slow

LIMB, CORRELATION, MOMENT = "PEBBLE: limb_matching", "PEBBLE: cross_correlation", "PEBBLE: moment"
ALL_KEPT = {"attitudes": 0, "transfer": 0, LIMB: 0, CORRELATION: 0, "geometry": 0}
BODIES = {LIMB: 2, CORRELATION: 2, "geometry": 2}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a small campaign that has run: two visits of a long, a short and a long exposure each."""
    path, _ = write_campaign(tmp_path_factory.mktemp("steps"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("giantlike.campaign.run.runner.write_report", _touch_report)
        run_campaign(Campaign.load(path), workers=1)
    return path


def _touch_report(result: RunResult) -> None:
    """Drawing takes most of the time of a small run."""
    (result.folder / "report.html").write_text("")


@pytest.fixture
def copied(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file of a copy of the campaign, with its run."""
    monkeypatch.setattr("giantlike.campaign.run.runner.write_report", _touch_report)
    shutil.copytree(whole.parent, tmp_path / "copy")
    return tmp_path / "copy" / "campaign.toml"


def redone(path: Path) -> dict[str, int]:
    """Number of results that running a campaign again makes, by step."""
    return {name: count.redone for name, count in run_campaign(Campaign.load(path), workers=1).steps.items()}


def tables(folder: Path) -> dict[str, list[list[str]]]:
    """Rows of both tables, without the last column, the time."""
    found = {}
    for name in ("attitudes", "observations"):
        with (folder / f"{name}.csv").open(newline="") as stream:
            found[name] = [row[:-1] for row in csv.reader(stream)]
    return found


def edit_table(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    table = campaign_table()
    change(table)
    path.write_text(tomli_w.dumps(table))


def edit_geometry(path: Path, column: str, value: str, row: int) -> None:
    geometry = path.parent / "geometry.csv"
    with geometry.open(newline="") as stream:
        names, *rows = list(csv.reader(stream))
    rows[row][names.index(column)] = value
    with geometry.open("w", newline="") as stream:
        csv.writer(stream).writerows([names, *rows])


TABLE_CHANGES: dict[str, tuple[Callable[[dict[str, Any]], object], dict[str, int]]] = {
    "nothing": (lambda table: None, ALL_KEPT),
    "the name": (lambda table: table["campaign"].update(name="another"), ALL_KEPT),
    "an option of one estimator": (
        lambda table: table["targets"][0].update(options={"limb_matching": {"max_iterations": 9}}),
        ALL_KEPT | {LIMB: 2},
    ),
    "one more estimator": (lambda table: table["targets"][0]["estimators"].append("moment"), ALL_KEPT | {MOMENT: 2}),
    "one estimator less": (
        lambda table: table["targets"][0]["estimators"].pop(),
        {"attitudes": 0, "transfer": 0, CORRELATION: 0, "geometry": 0},
    ),
    "the shape of a target": (
        lambda table: table["targets"][0].update(shape={"radii_km": [1.1, 1.0, 0.91]}),
        ALL_KEPT | BODIES,
    ),
    "how certain a target is": (
        lambda table: table["targets"][0].update(uncertainty={"scale": 0.01}),
        ALL_KEPT | BODIES,
    ),
    "the atmosphere of a target": (
        lambda table: table["targets"][0].update(atmosphere={"altitude_km": 0.001, "sigma_km": 0.001}),
        ALL_KEPT | BODIES,
    ),
    "an option of the stars, which moves the attitudes": (
        lambda table: table["stars"].update(max_magnitude=6.5),
        ALL_KEPT | BODIES | {"attitudes": 4, "transfer": 2},
    ),
    "how attitudes are carried": (
        lambda table: table["stars"].update(drift_arcsec_per_sqrt_s=0.2),
        ALL_KEPT | BODIES | {"transfer": 2},
    ),
    "what is a star image, as far as no image is concerned": (
        lambda table: table["stars"].update(long_exposure_s=1.5),
        ALL_KEPT,
    ),
    "fewer pictures in the report": (lambda table: table["report"].update(max_overlays=2), ALL_KEPT),
}


SLOW_CHANGES = ("how certain a target is", "the atmosphere of a target", "how attitudes are carried")


@pytest.mark.parametrize("change", [slow(name) if name in SLOW_CHANGES else name for name in TABLE_CHANGES])
def test_a_change_of_the_campaign_file_redoes_what_it_affects(copied: Path, change: str) -> None:
    edit_table(copied, TABLE_CHANGES[change][0])
    assert redone(copied) == TABLE_CHANGES[change][1]
    assert not any(redone(copied).values())


FILE_CHANGES: dict[str, tuple[Callable[[Path], object], dict[str, int]]] = {
    "the camera": (
        lambda path: dataclasses.replace(CAMERA, detector=dataclasses.replace(CAMERA.detector, read_noise_e=5.5)).save(
            path.parent / "camera.toml"
        ),
        ALL_KEPT | BODIES | {"attitudes": 6, "transfer": 2},
    ),
    "the predicted place of a body": (
        lambda path: edit_geometry(path, "target_z_km", "31.0", row=1),
        ALL_KEPT | {LIMB: 1, CORRELATION: 1, "geometry": 1},
    ),
    "blank lines in the geometry table": (
        lambda path: (path.parent / "geometry.csv").write_text((path.parent / "geometry.csv").read_text() + "\n\n"),
        ALL_KEPT,
    ),
    "an image that was touched": (lambda path: os.utime(path.parent / "images" / "visit0_a_long.fits"), ALL_KEPT),
    "an image that was replaced by another": (
        lambda path: shutil.copy(
            path.parent / "images" / "visit1_b_short.fits", path.parent / "images" / "visit0_b_short.fits"
        ),
        ALL_KEPT | {"attitudes": 1, "transfer": 1, LIMB: 1, CORRELATION: 1, "geometry": 1},
    ),
    "one image more": (
        lambda path: shutil.copy(
            path.parent / "images" / "visit1_c_long.fits", path.parent / "images" / "a_first.fits"
        ),
        ALL_KEPT | {"attitudes": 1},
    ),
    "one image less": (
        lambda path: (path.parent / "images" / "visit0_c_long.fits").unlink(),
        ALL_KEPT | {"transfer": 1, LIMB: 1, CORRELATION: 1, "geometry": 1},
    ),
}


@pytest.mark.parametrize("change", FILE_CHANGES)
def test_a_change_of_a_file_redoes_what_it_affects(copied: Path, change: str) -> None:
    FILE_CHANGES[change][0](copied)
    assert redone(copied) == FILE_CHANGES[change][1]
    assert not any(redone(copied).values())


@pytest.mark.slow
def test_what_is_kept_and_redone_makes_the_tables_of_a_fresh_run(copied: Path, tmp_path: Path) -> None:
    images = copied.parent / "images"
    shutil.copy(images / "visit1_c_long.fits", images / "a_first.fits")
    edit_table(copied, lambda table: table["targets"][0].update(options={"limb_matching": {"max_iterations": 9}}))
    run_campaign(Campaign.load(copied), workers=1)
    folder, fresh = copied.parent / "run", tmp_path / "fresh"
    kept = tables(folder)
    folder.rename(fresh)
    run_campaign(Campaign.load(copied), workers=1)
    assert tables(folder) == kept


def test_an_option_taken_back_is_said_and_its_results_are_made_again(copied: Path) -> None:
    said: list[str] = []
    edit_table(copied, lambda table: table["targets"][0].update(options={"limb_matching": {"max_iterations": 9}}))
    result = run_campaign(Campaign.load(copied), workers=1, announce=said.append)
    assert said[0].endswith("changed: campaign.targets, options.targets.PEBBLE.estimators.limb_matching.max_iterations")
    assert said[1] == "attitudes: 0 to do, 6 kept"
    assert f"{LIMB}: 2 to do, 0 kept" in said[2]
    assert f"{CORRELATION}: 0 to do, 2 kept" in said[2]
    assert result.summary()["steps"][LIMB] == {"redone": 2, "kept": 0}


def test_without_transfer_an_image_is_opened_once_for_stars_and_bodies(
    copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []

    def counted(campaign: Any, entry: Any, frames: Any) -> Any:
        opened.append(entry.key)
        return open_image(campaign, entry, frames)

    def without_stars(table: dict[str, Any]) -> None:
        del table["stars"]
        table["targets"][0]["estimators"] = ["moment", "ellipsoid_cra"]

    monkeypatch.setattr("giantlike.campaign.run.worker.open_image", counted)
    edit_table(copied, without_stars)
    result = run_campaign(Campaign.load(copied), workers=1)
    assert sorted(opened) == sorted(record.file for record in result.attitudes)
    # Short exposures were read with the same camera and a priori attitude before: only the bodies are new.
    assert result.steps["attitudes"] == StepCount(redone=4, kept=2)
    assert result.steps[MOMENT] == StepCount(redone=6, kept=0)

    def with_one_estimator(table: dict[str, Any]) -> None:
        without_stars(table)
        table["targets"][0]["estimators"].pop()

    edit_table(copied, with_one_estimator)
    opened.clear()
    assert not any(redone(copied).values())
    assert opened == []


def test_an_attitude_that_comes_out_the_same_keeps_the_bodies(copied: Path) -> None:
    def of_all(table: dict[str, Any]) -> None:
        del table["stars"]["long_exposure_s"]
        table["targets"][0]["estimators"] = ["moment"]

    edit_table(copied, of_all)
    first = run_campaign(Campaign.load(copied), workers=1)
    assert first.steps[MOMENT].redone == 6

    def with_another_option(table: dict[str, Any]) -> None:
        """With the same solutions: the a priori attitude leads to them."""
        of_all(table)
        table["stars"].update(lost_in_space=True)

    edit_table(copied, with_another_option)
    second = run_campaign(Campaign.load(copied), workers=1)
    solved = sum(record.attitude is not None for record in second.attitudes)
    assert second.steps["attitudes"].redone >= solved
    assert second.steps[MOMENT] == StepCount(redone=0, kept=6)


def test_the_folder_of_another_campaign_or_of_an_old_version_is_refused(copied: Path) -> None:
    for image in (copied.parent / "images").iterdir():
        image.rename(image.with_name(f"other_{image.name}"))
    edit_table(copied, lambda table: table["images"].pop("geometry"))
    with pytest.raises(InputError, match="holds a run of other images"):
        run_campaign(Campaign.load(copied), workers=1)
    run = copied.parent / "run"
    (run / "results.sqlite").unlink()
    (run / "parts").mkdir()
    with pytest.raises(DataError, match=r"made by version 0\.2 or older.* into another folder"):
        load_result(run)
    with pytest.raises(DataError, match=r"made by version 0\.2 or older.* into another folder"):
        run_campaign(Campaign.load(copied), workers=1)


# --- the lock --------------------------------------------------------------------------------------------------------


def test_a_second_run_on_a_live_folder_is_refused_with_who_holds_it(copied: Path) -> None:
    run = copied.parent / "run"
    with hold_lock(run):
        assert is_locked(run)
        with pytest.raises(InputError, match=rf"a run is at work here \(process {os.getpid()} of .*, started 20"):
            run_campaign(Campaign.load(copied), workers=1)
    assert not is_locked(run)
    assert holder_of(run) is None


def test_the_lock_of_a_process_that_died_is_taken_over(copied: Path) -> None:
    run = copied.parent / "run"
    (run / ".lock.json").write_text(
        '{"pid": 999999, "user": "ann", "host": "lab", "since_utc": "2026-01-01T00:00:00Z"}'
    )
    said: list[str] = []
    run_campaign(Campaign.load(copied), workers=1, announce=said.append)
    assert "taken over from process 999999 of ann on lab, started 2026-01-01T00:00:00Z, which died" in said[0]


# --- the edit list ---------------------------------------------------------------------------------------------------


def edit(what: Edited, file: str, *, action: str = "reject", **more: Any) -> Edit:
    return Edit.model_validate(
        {"action": action, "what": what, "file": file, "who": "ann", "when_utc": "2026-11-22", "why": "smear"} | more
    )


def test_a_rejected_image_is_no_donor_and_a_restored_one_costs_nothing(copied: Path) -> None:
    run = copied.parent / "run"
    before = tables(run)
    add_edits(run, [edit(Edited.IMAGE, "visit0_a_long.fits")])
    assert redone(copied) == ALL_KEPT | {"transfer": 1, LIMB: 1, CORRELATION: 1, "geometry": 1}
    (rejected,) = [record for record in load_result(run).attitudes if record.status == "failed"]
    assert rejected.problem is not None
    assert (rejected.file, rejected.attitude, rejected.problem.reason) == ("visit0_a_long.fits", None, "rejected")
    assert rejected.problem.detail == "visit0_a_long.fits: by ann on 2026-11-22: smear"
    assert not load_result(run).failed_images
    carried = next(record for record in load_result(run).attitudes if record.file == "visit0_b_short.fits")
    assert carried.provenance["from"] == "visit0_c_long.fits"
    add_edits(run, [edit(Edited.IMAGE, "visit0_a_long.fits", action="restore")])
    assert redone(copied)["attitudes"] == 0
    assert tables(run) == before


def test_a_rejected_fix_is_rejected_wherever_the_run_is_read_and_nothing_is_redone(copied: Path) -> None:
    run, fix = copied.parent / "run", {"target": "PEBBLE", "estimator": "limb_matching"}
    before = tables(run)
    add_edits(run, [edit(Edited.FIX, "visit1_b_short.fits", **fix)])
    assert redone(copied) == ALL_KEPT
    by_name = {(record.file, record.estimator): record for record in load_result(run).observations}
    record = by_name["visit1_b_short.fits", "limb_matching"]
    assert (record.status, record.center_px) == ("failed", None)
    assert by_name["visit1_b_short.fits", "cross_correlation"].status == "ok"
    assert tables(run) != before
    add_edits(run, [edit(Edited.FIX, "visit1_b_short.fits", action="restore", **fix)])
    assert redone(copied) == ALL_KEPT
    assert tables(run) == before


def test_an_image_is_solved_again_without_a_rejected_star(copied: Path) -> None:
    run, file = copied.parent / "run", "visit0_a_long.fits"
    solved = RunFolder(run).load(AttitudeRecord, file)
    assert solved is not None
    assert solved.stars is not None
    star = solved.stars.star_ids[0]
    add_edits(run, [edit(Edited.STAR, file, star=star)])
    assert redone(copied) == ALL_KEPT | {"attitudes": 1, "transfer": 1, LIMB: 1, CORRELATION: 1, "geometry": 1}
    without = RunFolder(run).load(AttitudeRecord, file)
    assert without is not None
    assert without.stars is not None
    assert star not in without.stars.star_ids
    assert len(without.stars.star_ids) >= len(solved.stars.star_ids) - 2


def test_a_damaged_edit_is_refused_with_its_line(copied: Path) -> None:
    (copied.parent / "run" / "edits.jsonl").write_text('{"action": "reject"}\n')
    with pytest.raises(DataError, match=r"edits\.jsonl: line 1 is no edit, mend or delete it"):
        run_campaign(Campaign.load(copied), workers=1)


# --- status and edit at the shell ------------------------------------------------------------------------------------


def giantlike(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_status_tells_the_state_of_a_run_and_edit_keeps_who_when_and_why(copied: Path) -> None:
    run = copied.parent / "run"
    state = json.loads(giantlike("status", run, "--json").stdout)
    assert (state["state"], state["images"], state["steps"]["attitudes"]["done"]) == ("finished", 6, 6)
    with hold_lock(run):
        assert f"run: running (process {os.getpid()} of " in giantlike("status", run).stdout
    assert "all but list need one" in " ".join(giantlike("edit", "--help").stdout.split())
    for nothing in ((), ("--why", " ")):
        refused = giantlike("edit", run, "reject", "visit0_a_long.fits", *nothing)
        assert refused.exit_code == 2
        assert "reject needs an IMAGE and --why TEXT" in refused.stderr
    done = giantlike("edit", run, "reject", "visit0_a_long.fits", "--why", "smear", "--who", "ann")
    assert "ann: reject image visit0_a_long.fits: smear" in done.stdout
    assert "rejected (1), such as visit0_a_long.fits: by ann on 20" in giantlike("status", run).stdout
    assert (
        "there is no image 'none.fits' in this run"
        in giantlike("edit", run, "reject", "none.fits", "--why", "x").stderr
    )
    fix = ("--target", "PEBBLE", "--estimator", "moment", "--why", "x")
    assert (
        "no observation of 'PEBBLE' by 'moment'" in giantlike("edit", run, "reject", "visit0_b_short.fits", *fix).stderr
    )
    (listed,) = json.loads(giantlike("edit", run, "list", "--json").stdout)
    assert (listed["who"], listed["why"], listed["what"]) == ("ann", "smear", "image")


def test_a_run_tells_reasons_in_full_and_verbosely_each_image(copied: Path) -> None:
    (copied.parent / "images" / "visit0_c_long.fits").write_text("no image")
    shown = giantlike("run", copied, "--workers", "1", "-v")
    assert shown.exit_code == 1
    assert re.search(r"^unreadable_image:\n  .*visit0_c_long.fits: .*format", shown.stdout, re.M)
    assert re.search(r"^visit0_c_long.fits: failed: unreadable_image: ", shown.stderr, re.M)
    assert re.search(r"^visit0_b_short.fits PEBBLE limb_matching: ok$", shown.stderr, re.M)
