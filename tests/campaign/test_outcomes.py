"""Outcomes that are no failures: estimators that do not suit a body, and targets that are not in the field."""

import csv
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.store.records import Problem
from giantlike.campaign.store.results import RunResult
from giantlike.cli.app import app
from giantlike.core.outcomes import Failure, Outcome, Reason
from tests.campaign_files import RADII_KM, write_campaign

FILE, AXES = "visit0_b_short.fits", ("target_x_km", "target_y_km", "target_z_km")


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """A run of a body of 70 px with an estimator for points, a body behind the camera, and one beside the field."""
    shape = {"radii_km": list(RADII_KM)}
    targets = [
        {"name": "PEBBLE", "shape": shape, "estimators": ["cross_correlation", "unresolved"]},
        {"name": "BEHIND", "shape": shape, "estimators": ["cross_correlation", "limb_matching"]},
        {"name": "BESIDE", "shape": shape, "estimators": ["cross_correlation", "moment"]},
    ]
    path, _ = write_campaign(tmp_path_factory.mktemp("outcomes"), visits=1, targets=targets)
    with (path.parent / "geometry.csv").open(newline="") as stream:
        names, *rows = list(csv.reader(stream))
    row = next(dict(zip(names, row, strict=True)) for row in rows if row[0] == FILE)
    place = np.array([float(row[axis]) for axis in AXES])
    across = np.cross(place, [0.3, -0.5, 0.8])
    beside = Rotation.from_rotvec(np.radians(40.0) * across / np.linalg.norm(across)).apply(place)
    for name, vector in (("BEHIND", -place), ("BESIDE", beside)):
        values = row | {"target": name} | dict(zip(AXES, map(repr, vector.tolist()), strict=True))
        rows.append([values[column] for column in names])
    with (path.parent / "geometry.csv").open("w", newline="") as stream:
        csv.writer(stream).writerows([names, *rows])
    return run_campaign(Campaign.load(path), workers=1)


def test_an_estimator_that_does_not_suit_a_body_is_not_applicable(result: RunResult) -> None:
    found = {(one.target, one.estimator): one for one in result.observations if one.file == FILE}
    unresolved = found["PEBBLE", "unresolved"]
    assert unresolved.outcome is Outcome.NOT_APPLICABLE
    assert (unresolved.status, unresolved.problem and unresolved.problem.reason) == ("failed", Reason.NOT_UNRESOLVED)
    assert found["PEBBLE", "cross_correlation"].outcome is Outcome.OK


def test_a_target_nowhere_near_the_image_is_not_in_the_field(result: RunResult) -> None:
    away = [one for one in result.observations if one.file == FILE and one.target != "PEBBLE"]
    assert len(away) == 4
    assert {one.outcome for one in away} == {Outcome.NOT_IN_FIELD}
    assert all(one.problem is not None and "px outside of the image" in one.problem.detail for one in away)


def test_neither_counts_as_a_failure_in_tables_reports_and_exit_codes(result: RunResult) -> None:
    assert result.failed_images == ()
    rows = {(row["target"], row["estimator"]): row for row in result.summary()["observations"]}
    assert (rows["PEBBLE", "unresolved"]["failed"], rows["PEBBLE", "unresolved"]["not_applicable"]) == (0, 1)
    assert (rows["BESIDE", "moment"]["failed"], rows["BESIDE", "moment"]["not_in_field"]) == (0, 1)
    with (result.folder / "observations.csv").open(newline="") as stream:
        cells = {(row["target"], row["estimator"]): row for row in csv.DictReader(stream)}
    assert cells["PEBBLE", "unresolved"]["status"] == "failed"  # the three values that scripts know
    assert cells["PEBBLE", "unresolved"]["outcome"] == "not_applicable"
    assert cells["BEHIND", "limb_matching"]["outcome"] == "not_in_field"
    assert cells["PEBBLE", "cross_correlation"]["outcome"] == "ok"
    page = (result.folder / "report.html").read_text()
    failures = page[page.index('id="failures"') :]
    assert '<span class="ok">None.</span>' in failures
    assert "not applicable" in failures
    assert "not in the field" in failures
    done = CliRunner().invoke(app, ["run", str(result.folder.parent / "campaign.toml"), "--workers", "1"])
    assert done.exit_code == 0
    assert "0 images failed" in done.stdout
    status = json.loads(CliRunner().invoke(app, ["status", str(result.folder), "--json"]).stdout)
    assert status["steps"]["PEBBLE: unresolved"]["statuses"] == {"not_applicable": 1}
    words = CliRunner().invoke(app, ["explain", str(result.folder), FILE]).stdout
    assert "unresolved: not applicable" in words
    assert "moment: not in the field" in words


def test_a_record_of_an_earlier_version_has_its_outcome_by_the_reason() -> None:
    older = Problem.model_validate({"reason": "not_unresolved", "detail": "40 px"})
    assert older.outcome is Outcome.NOT_APPLICABLE
    assert Problem.model_validate({"reason": "no_limb", "detail": ""}).outcome is Outcome.FAILED
    assert Problem.from_failure(Failure(Reason.WRONG_SHAPE, "", not_applicable=True)).outcome is Outcome.NOT_APPLICABLE
