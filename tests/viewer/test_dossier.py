"""The dossier of a run: complete, honest about what changed since, and enough to make the run again."""

import hashlib
import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.store.edits import Edit, Edited, add_edits
from giantlike.campaign.store.results import load_result
from giantlike.cli.app import app
from giantlike.core.errors import DataError, InputError
from giantlike.viewer.dossier import check_dossier, read_dossier, reproduce, write_dossier

SHORT = "visit0_b_short.fits"


def giantlike(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def reject_limb(run: Path, why: str) -> None:
    edit = Edit(
        action="reject", what=Edited.FIX, file=SHORT, target="PEBBLE", estimator="limb_matching",
        who="ada", when_utc="2026-01-02T03:04:05Z", why=why,
    )  # fmt: skip
    add_edits(run, [edit])


def test_a_dossier_names_every_file_of_the_campaign_with_its_hash(campaign: Path, run: Path) -> None:
    dossier = write_dossier(run)
    content = read_dossier(dossier)
    loaded = Campaign.load(campaign)
    hashes = {(dossier / row["path"]).resolve(): row["sha256"] for row in content["inputs"]}
    wanted = {campaign, loaded.geometry_file, *(entry.path for entry in loaded.images)}
    assert {path.resolve() for path in wanted if path is not None} <= set(hashes)
    for path, digest in hashes.items():
        assert hashlib.sha256(path.read_bytes()).hexdigest() == digest
    assert not any(row["path"].startswith("/") for row in content["inputs"])
    assert {"numpy", "scipy"} <= set(content["versions"]["packages"])
    assert set(content["options"]["targets"]["PEBBLE"]["estimators"]) == {"cross_correlation", "limb_matching"}
    written = {path.relative_to(dossier).as_posix() for path in dossier.rglob("*") if path.is_file()}
    assert written == set(content["files"]) | {"dossier.json"}
    assert {"run/observations.csv", "run/report.html", "exports/attitudes.csv", "explanations.txt"} <= written
    assert "figures/image0001_residuals1.svg" in written
    words = (dossier / "explanations.txt").read_text()
    assert all(record.file in words for record in load_result(run).attitudes)


def test_the_check_names_what_changed_and_what_is_gone_and_nothing_else(campaign: Path, run: Path) -> None:
    dossier = write_dossier(run)
    whole = check_dossier(dossier)
    assert whole.holds
    assert whole.versions == ()
    loaded = Campaign.load(campaign)
    assert loaded.geometry_file is not None
    loaded.geometry_file.write_text(loaded.geometry_file.read_text() + "\n")
    loaded.images[0].path.unlink()
    (dossier / "run" / "observations.csv").write_text("forged")
    found = check_dossier(dossier)
    assert [name.split()[0] for name in found.missing] == ["image"]
    assert loaded.images[0].path.name in found.missing[0]
    assert [name.rpartition("/")[2] for name in found.changed] == [
        loaded.geometry_file.name, "observations.csv in the dossier"
    ]  # fmt: skip
    assert found.same == whole.same - 3
    answer = giantlike("dossier", dossier, "--check")
    assert answer.exit_code == 1
    assert "geometry table" in answer.stdout


def test_decisions_are_in_it_with_who_when_and_why_once_the_run_is_up_to_date(campaign: Path, run: Path) -> None:
    reject_limb(run, why="it's <dark> there")
    with pytest.raises(InputError, match="the edit list; bring it up to date first: giantlike run"):
        write_dossier(run)
    run_campaign(Campaign.load(campaign), workers=1)
    answer = giantlike("dossier", run, "--output", run.parent / "handed_in", "--json")
    assert answer.exit_code == 0, answer.stderr
    dossier = Path(json.loads(answer.stdout)["dossier"])
    (edit,) = read_dossier(dossier)["edits"]
    assert (edit["who"], edit["when_utc"], edit["why"]) == ("ada", "2026-01-02T03:04:05Z", "it's <dark> there")
    page = (dossier / "dossier.html").read_text()
    assert "&lt;dark&gt;" in page
    assert "giantlike dossier handed_in --reproduce NEW_RUN" in page
    doubts = [row for row in read_dossier(dossier)["doubts"] if row["file"] == SHORT]
    assert [row["reason"].split(":")[0] for row in doubts] == ["rejected"]


def test_no_dossier_is_made_of_a_run_whose_inputs_changed_nor_over_other_files(campaign: Path, run: Path) -> None:
    (run.parent / "mine").mkdir()
    (run.parent / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(InputError, match="holds something else than a dossier"):
        write_dossier(run, run.parent / "mine")
    with pytest.raises(DataError, match="this is no dossier"):
        check_dossier(run)
    image = Campaign.load(campaign).images[1].path
    data = bytearray(image.read_bytes())
    data[-3000] ^= 1
    image.write_bytes(bytes(data))
    with pytest.raises(InputError, match=image.name):
        write_dossier(run)


def test_the_command_of_a_dossier_makes_the_same_tables_and_says_when_it_does_not(campaign: Path, run: Path) -> None:
    reject_limb(run, why="a trial")
    run_campaign(Campaign.load(campaign), workers=1)
    dossier = write_dossier(run, run.parent / "dossier")
    again = giantlike("dossier", dossier, "--reproduce", run.parent / "again", "--workers", "1")
    assert again.exit_code == 0, again.stdout + again.stderr
    assert "the tables are the same" in again.stdout
    rejected = [one for one in load_result(run.parent / "again").observations if one.estimator == "limb_matching"]
    assert rejected[0].problem is not None
    table = dossier / "run" / "observations.csv"
    table.write_text(table.read_text().replace(",ok,", ",suspect,"))
    assert reproduce(dossier, run.parent / "again", workers=1) == [
        f"observations.csv: {SHORT} PEBBLE cross_correlation"
    ]
