"""Suspect results that a user accepts: used and shown as accepted everywhere, unchanged, until they change."""

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet
from starlette.testclient import TestClient

from giantlike.campaign.export import ExportFormat, export_run
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.store.edits import add_edits, new_edit, read_edits
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord
from giantlike.campaign.store.results import load_result
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.core.outcomes import Outcome
from giantlike.viewer import Session, explain, layers_of
from giantlike.viewer.dossier import write_dossier
from giantlike.viewer.server import application
from tests.campaign_files import CAMERA
from tests.viewer.conftest import Made, RockRun, make_suspect
from tests.viewer.test_edits import giantlike

LONG, SHORT = "visit0_a_long.fits", "visit0_b_short.fits"
TARGET, LIMB, TEMPLATE = "PEBBLE", "limb_matching", "cross_correlation"
FIX = ("--target", TARGET, "--estimator", LIMB)
BY_ANN = ("--who", "Ann Möller", "--why", "the crescent is its own | limb")


def _accept(run: Path, **changes: Any) -> None:
    edit = {"action": "accept", "what": "fix", "file": SHORT, "target": TARGET, "estimator": LIMB, "who": "Ann",
            "why": "right"}  # fmt: skip
    add_edits(run, [new_edit(RunFolder.open(run), edit | changes)])


def _fix(run: Path, estimator: str = LIMB) -> ObservationRecord:
    return next(one for one in load_result(run).observations if one.estimator == estimator)


def test_an_accepted_fix_is_taken_everywhere_and_keeps_its_numbers_and_flags(campaign: Path, run: Path) -> None:
    make_suspect(run, SHORT, (TARGET, LIMB))
    make_suspect(run, SHORT, (TARGET, TEMPLATE))
    before = _fix(run)
    export_run(run, run / "before.parquet", ExportFormat.OBSERVABLES)
    assert {row["preferred_reason"] for row in _bodies(run / "before.parquet")} == {"all fixes are suspect"}
    with pytest.raises(ValueError, match="no observation to write"):
        export_run(run, run / "before.tdm", ExportFormat.TDM)

    done = giantlike("edit", run, "accept", SHORT, *FIX, *BY_ANN)
    assert done.exit_code == 0, done.stderr
    run_campaign(Campaign.load(campaign), workers=1)
    after = _fix(run)
    assert after.outcome is Outcome.ACCEPTED
    assert after.accepted is not None
    assert after.replace(accepted=None) == before
    row = next(
        row for row in csv.DictReader((run / "observations.csv").read_text().splitlines()) if row["estimator"] == LIMB
    )
    assert (row["status"], row["outcome"], row["accepted_by"]) == ("suspect", "accepted", "Ann Möller")
    assert row["accepted_why"] == BY_ANN[3]
    (used,) = (row for row in _bodies(run / "observables.parquet") if row["preferred"])
    assert (used["estimator"], used["status"], used["accepted_by"]) == (LIMB, "suspect", "Ann Möller")
    assert used["preferred_reason"] == "the only fix that is accepted by a user"
    export_run(run, run / "o.jsonl", ExportFormat.OBSERVABLES)
    rows = [json.loads(line) for line in (run / "o.jsonl").read_text().splitlines()]
    assert [one["accepted_by"] for one in rows if one.get("preferred")] == ["Ann Möller"]
    export_run(run, run / "after.tdm", ExportFormat.TDM)
    tdm = (run / "after.tdm").read_text()
    assert (
        "suspect (interpolated_attitude, far_from_prediction), accepted by Ann M?ller: the crescent is its own" in tdm
    )
    assert max(map(len, tdm.splitlines())) <= 254
    assert "accepted by Ann Möller on" in (run / "report.html").read_text()
    words = giantlike("explain", run, SHORT).stdout
    assert "It was accepted by Ann Möller on" in words
    assert f"Accepted by hand ({TARGET} by {LIMB}): Ann Möller" in words
    dossier = write_dossier(run, run / "dossier", campaign)
    assert "accepted by Ann Möller on" in (dossier / "dossier.html").read_text()
    content = json.loads((dossier / "dossier.json").read_text())
    assert content["verdicts"][f"{TARGET}: {LIMB}"]["accepted"] == 1
    assert {doubt["outcome"] for doubt in content["doubts"]} == {"accepted", "suspect"}

    assert giantlike("edit", run, "restore", SHORT, *FIX, *BY_ANN).exit_code == 0
    assert _fix(run) == before


def _bodies(path: Path) -> list[dict[str, Any]]:
    return [row for row in parquet.read_table(path).to_pylist() if row["kind"] == "body"]


def test_an_accepted_attitude_is_exported(run: Path) -> None:
    make_suspect(run, LONG, flag="large_residuals")
    taken = [export_run(run, run / f"{name}.aem", ExportFormat.AEM).n_attitudes for name in "a"]
    assert giantlike("edit", run, "accept", LONG, *BY_ANN).exit_code == 0
    taken.append(export_run(run, run / "b.aem", ExportFormat.AEM).n_attitudes)
    assert taken == [2, 3]
    assert f"COMMENT {LONG}: suspect, accepted by Ann M?ller on" in (run / "b.aem").read_text()
    assert giantlike("edit", run, "restore", LONG, "--why", "no").exit_code == 0
    assert read_edits(run).standing == []


REFUSED: dict[str, tuple[tuple[str, ...], str]] = {
    "what is ok": ((SHORT, *FIX), f"{TARGET} by {LIMB} is ok: only suspect"),
    "an attitude that is ok": ((LONG,), "the attitude is ok: only suspect"),
    "a star": ((LONG, "--star", "5"), "accept is for attitude and fix, not for star"),
    "a fix that is not there": ((SHORT, "--target", TARGET, "--estimator", "moment"), f"{TARGET} by {LIMB}"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_only_a_suspect_result_can_be_accepted(run: Path, case: str) -> None:
    arguments, words = REFUSED[case]
    done = giantlike("edit", run, "accept", *arguments, *BY_ANN)
    assert done.exit_code == 2
    assert words in done.stderr
    assert read_edits(run).edits == ()


def test_what_failed_was_rejected_or_is_accepted_already_cannot_be_accepted(run: Path) -> None:
    make_suspect(run, SHORT, (TARGET, LIMB))
    _accept(run)
    with pytest.raises(ValueError, match="is accepted by Ann on"):
        _accept(run)
    _accept(run, action="reject")
    with pytest.raises(ValueError, match="is rejected"):
        _accept(run)
    assert _fix(run).outcome is Outcome.REJECTED
    folder = RunFolder.open(run)
    record = folder.load(ObservationRecord, SHORT, (TARGET, TEMPLATE))
    assert record is not None
    with folder.writing():
        failed = {"status": "failed", "problem": {"reason": "no_signal", "detail": "dark"}, "center_px": None}
        folder.save(record.replace(**failed), "key")
    with pytest.raises(ValueError, match=r"is failed \(no_signal\)"):
        _accept(run, estimator=TEMPLATE)


@pytest.mark.parametrize(
    ("moved_sigmas", "flag", "holds"), [(0.5, "", True), (2.0, "", False), (0.0, "ambiguous", False)]
)
def test_an_acceptance_lapses_when_the_fix_moves_or_another_check_objects(
    run: Path, moved_sigmas: float, flag: str, holds: bool
) -> None:
    make_suspect(run, SHORT, (TARGET, LIMB))
    _accept(run)
    folder = RunFolder.open(run)
    record = folder.load(ObservationRecord, SHORT, (TARGET, LIMB))
    assert record is not None
    assert record.center_px is not None
    assert record.covariance_px2 is not None
    x, y = record.center_px
    moved = [x + moved_sigmas * record.covariance_px2[0][0] ** 0.5, y]
    with folder.writing():
        folder.save(record.replace(center_px=moved, flags=[*record.flags, *filter(None, [flag])]), "key")
    assert _fix(run).outcome is (Outcome.ACCEPTED if holds else Outcome.SUSPECT)
    assert ("another one since" in explain(Session(run).seen(SHORT))) is not holds


def test_images_have_a_state_of_review(run: Path) -> None:
    client = TestClient(application(Session(run), "secret"), base_url="http://127.0.0.1:8000")
    client.get("/?token=secret")

    def decide(action: str, **thing: Any) -> str:
        wanted = {"action": action, "file": SHORT, "why": "x", "who": "Ann"} | thing
        answer = client.post("/api/edit", json=wanted, headers={"X-Token": "secret"})
        assert answer.status_code == 200, answer.text
        (image,) = (image for image in client.get("/api/run").json()["images"] if image["file"] == SHORT)
        return f"{image['verdict']}, {image['review']}"

    fix = {"what": "fix", "target": TARGET}
    make_suspect(run, SHORT, (TARGET, LIMB))
    make_suspect(run, SHORT, (TARGET, TEMPLATE))
    assert decide("discuss", what="review") == "suspect, to discuss"
    assert decide("restore", what="review") == "suspect, unseen"
    assert decide("accept", estimator=LIMB, **fix) == "accepted, accepted"
    assert decide("reject", estimator=TEMPLATE, **fix) == "accepted, rejected"
    assert decide("restore", estimator=TEMPLATE, **fix) == "accepted, accepted"
    assert decide("reject", what="image") == "rejected, rejected"
    assert decide("restore", what="image") == "accepted, accepted"
    area = [[10.0, 10.0], [20.0, 10.0], [20.0, 20.0]]
    assert decide("mask", what="mask", area_px=area) == "accepted, accepted"  # no verdict on a result
    assert decide("restore", estimator=LIMB, **fix) == "suspect, unseen"


def predict_elsewhere(campaign: Path, offset_km: float = 8.0) -> None:
    """Move the predicted direction of the body in the short image, at the same range."""
    path = campaign.parent / "geometry.csv"
    head, *lines = path.read_text().splitlines()
    names = head.split(",")
    for number, line in enumerate(lines):
        row = dict(zip(names, line.split(","), strict=True))
        if row["file"] == SHORT:
            position = np.array([float(row[f"target_{axis}_km"]) for axis in "xyz"])
            moved = position + np.array([0.0, offset_km, 0.0])
            moved *= np.linalg.norm(position) / np.linalg.norm(moved)
            row |= {f"target_{axis}_km": repr(float(x)) for axis, x in zip("xyz", moved, strict=True)}
            lines[number] = ",".join(row.values())
    path.write_text("\n".join([head, *lines]) + "\n")


def test_an_image_whose_prediction_is_too_far_off_is_solved_from_a_start(made: Made, campaign: Path, run: Path) -> None:
    predict_elsewhere(campaign)
    failed = run_campaign(Campaign.load(campaign), workers=1).observations
    assert {str(one.problem.reason) for one in failed if one.problem is not None} == {"low_correlation", "no_limb"}
    truth = CAMERA.model.project(made[1][SHORT].position_camera_km)
    center = [str(round(each)) for each in truth + 4.0]  # as well as a hand drags
    done = giantlike("edit", run, "start", SHORT, "--target", TARGET, "--center", *center, *BY_ANN)
    assert done.exit_code == 0, done.stderr
    assert f"start {SHORT} (the start of {TARGET} at ({center[0]}.00, {center[1]}.00) px)" in done.stdout

    again = run_campaign(Campaign.load(campaign), workers=1)
    assert sum(count.redone for count in again.steps.values()) == 2  # not the attitudes, nor the outline
    for fix, before in zip(again.observations, failed, strict=True):
        assert fix.outcome is Outcome.OK
        assert fix.center_px is not None
        assert fix.covariance_px2 is not None
        assert np.all(np.abs(fix.center_px - truth) < 5.0 * np.sqrt(np.diag(np.array(fix.covariance_px2))))
        assert fix.predicted_px == before.predicted_px  # observed minus computed is by the a priori geometry
        assert fix.provenance["start"].endswith("sigma 3 px, by Ann Möller")
    assert f"Started by hand: center ({center[0]}.00" in giantlike("explain", run, SHORT).stdout
    assert "start" in {layer.name for layer in layers_of(Session(run).seen(SHORT))}
    dossier = write_dossier(run, run / "dossier", campaign)
    assert f"at ({center[0]}.00, {center[1]}.00) px" in (dossier / "dossier.html").read_text()
    assert sum(count.redone for count in run_campaign(Campaign.load(campaign), workers=1).steps.values()) == 0

    assert giantlike("edit", run, "restore", SHORT, "--target", TARGET, "--why", "no").exit_code == 0
    last = run_campaign(Campaign.load(campaign), workers=1).observations
    assert [one.problem for one in last] == [one.problem for one in failed]


STARTS: dict[str, tuple[tuple[str, ...], str]] = {
    "no center": (("--target", TARGET), "start, and nothing else, needs --center X Y"),
    "no target": (("--center", "5", "5"), "the kind start goes with target, got nothing else"),
    "another target": (("--target", "MOON", "--center", "5", "5"), f"there are: {TARGET} by"),
    "an estimator": ((*FIX, "--center", "5", "5"), "the kind start goes with target, got target and estimator"),
    "nan": (("--target", TARGET, "--center", "nan", "5"), "a start needs a center"),
    "far outside": (("--target", TARGET, "--center", "5", "9000"), "far outside of its 320 x 280 px"),
    "a negative sigma": (("--target", TARGET, "--center", "5", "5", "--sigma", "-1"), "sigma_px"),
}


@pytest.mark.parametrize("case", STARTS)
def test_a_start_that_makes_no_sense_is_refused(run: Path, case: str) -> None:
    arguments, words = STARTS[case]
    done = giantlike("edit", run, "start", SHORT, *arguments, *BY_ANN)
    assert done.exit_code == 2
    assert words in done.stderr
    assert read_edits(run).edits == ()


def test_ten_limb_points_and_an_area_are_left_out_when_the_image_is_solved_again(campaign: Path, run: Path) -> None:
    session = Session(run)
    before, seen = _fix(run), session.seen(SHORT)
    points = np.array(seen.points[TARGET, LIMB]["limb_px"])[5:15]
    client = TestClient(application(session, "secret"), base_url="http://127.0.0.1:8000")
    client.get("/?token=secret")
    table = client.get("/api/points").json()
    assert {row["kind"] for row in table["points"]} == {"star", "limb"}
    assert table["count"] == len(table["points"]) > len(points)
    sigmas = [row["sigmas"] for row in table["points"]]
    assert sigmas == sorted(sigmas, reverse=True)
    limb = [row for row in table["points"] if row["kind"] == "limb"]
    assert np.sqrt(np.mean([row["sigmas"] ** 2 for row in limb])) == pytest.approx(1.0, abs=1e-3)

    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    things = [{"target": TARGET, "estimator": LIMB, "area_px": (point + corners).tolist()} for point in points]
    wanted = {"action": "mask", "what": "mask", "file": SHORT, "why": "a ridge", "who": "Ann", "things": things}
    answer = client.post("/api/edit", json=wanted, headers={"X-Token": "secret"})
    assert answer.status_code == 200, answer.text
    assert sum(row["rejected"] for row in client.get("/api/points").json()["points"]) >= len(points)
    (left, top), (right, bottom) = np.rint(points.min(axis=0) - 40), np.rint(points.max(axis=0) - 20)
    area = f"{left:g},{top:g} {right:g},{bottom:g}"
    assert giantlike("edit", run, "mask", LONG, "--area", "0,0 40,279", *BY_ANN).exit_code == 0

    again = run_campaign(Campaign.load(campaign), workers=1)
    after, used = _fix(run), np.array(Session(run).seen(SHORT).points[TARGET, LIMB]["limb_px"])
    assert np.linalg.norm(used[:, None] - points, axis=2).min() > 0.5
    assert before.n_used is not None
    assert after.n_used is not None
    assert before.n_used - 15 <= after.n_used <= before.n_used - 10
    assert after.provenance["masked"] == "10 areas drawn by hand"
    assert again.steps[f"{TARGET}: {LIMB}"].redone == 1
    stars = RunFolder.open(run).load(AttitudeRecord, LONG)
    assert stars is not None
    assert stars.stars is not None
    assert np.array(stars.stars.observed_px)[:, 0].min() > 40.0
    assert _fix(run, TEMPLATE).provenance.get("masked") is None
    assert giantlike("edit", run, "mask", SHORT, "--area", area, *BY_ANN).exit_code == 0
    run_campaign(Campaign.load(campaign), workers=1)
    assert _fix(run, TEMPLATE).provenance["masked"] == "1 area drawn by hand"
    assert "mask" in {layer.name for layer in layers_of(Session(run).seen(SHORT))}
    assert giantlike("edit", run, "restore", SHORT, "--area", area, "--why", "no").exit_code == 0
    assert len(read_edits(run).standing) == 11


AREAS: dict[str, tuple[tuple[str, ...], str]] = {
    "no area": ((), "mask needs --area"),
    "no numbers": (("--area", "left right"), "--area is 'X,Y X,Y ...', got 'left right'"),
    "one corner": (("--area", "5,5"), "--area is"),
    "not a number": (("--area", "nan,5 7,8"), "an area has 3 to 500 corners"),
    "outside": (("--area", "400,5 500,8"), "has none of its 320 x 280 pixels"),
    "everything": (("--area", "-5,-5 1e9,1e9"), "has all of its 320 x 280 pixels"),
    "a target alone": (("--area", "5,5 7,8", "--target", TARGET), "a fix has a --target and an --estimator"),
}


@pytest.mark.parametrize("case", AREAS)
def test_an_area_that_makes_no_sense_is_refused(run: Path, case: str) -> None:
    arguments, words = AREAS[case]
    done = giantlike("edit", run, "mask", SHORT, *arguments, *BY_ANN)
    assert done.exit_code == 2
    assert words in done.stderr
    assert read_edits(run).edits == ()


def test_a_rejected_landmark_is_not_used_again(rock: RockRun, tmp_path: Path) -> None:
    folder = shutil.copytree(rock.run.parent, tmp_path / "copy")
    run = folder / "run"
    of = ("--target", "BODY", "--estimator", "surface_features")
    names = Session(run).seen(rock.file).points["BODY", "surface_features"]["landmarks"]["names"]
    refused = giantlike("edit", run, "reject", rock.file, *of, "--landmark", names[0][:-1], *BY_ANN)
    assert refused.exit_code == 2
    assert names[0] in refused.stderr
    assert giantlike("edit", run, "reject", rock.file, *of, "--landmark", names[0], *BY_ANN).exit_code == 0
    run_campaign(Campaign.load(folder / "campaign.toml"), workers=1)
    marks = Session(run).seen(rock.file).points["BODY", "surface_features"]["landmarks"]
    assert names[0] not in [*marks["names"], *marks["rejected_names"]]
    assert f"Landmarks rejected by hand: {names[0]}" in giantlike("explain", run, rock.file).stdout
