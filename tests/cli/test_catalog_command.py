"""``giantlike catalog build``, ``query`` and ``info``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from giantlike.cli.app import app
from tests.tolerances import FIVE_DIGITS, FLOAT32, FLOAT64_ROOT, FLOAT64_SUM

TABLE = "HD,RA,DE,Vmag,pm\n11,10.0,20.0,4.5,3600\n12,10.2,20.0,6.5,0\n13,190.0,-20.0,5.5,0\n"
COLUMNS = ["ids=HD", "ra_deg=RA", "dec_deg=DE", "magnitude=Vmag", "pm_dec_mas_yr=pm"]


def _run(*arguments: object, code: int = 0) -> str:
    result = CliRunner().invoke(app, ["catalog", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return result.output


def _build(folder: Path, *more: object, code: int = 0) -> str:
    source = folder / "stars.csv"
    source.write_text(TABLE)
    options = [part for column in COLUMNS for part in ("--column", column)]
    return _run("build", source, folder / "made.stars", "--format", "table", "--band", "V", *options, *more, code=code)


def test_a_catalog_is_built_and_asked(tmp_path: Path) -> None:
    assert "3 stars, magnitudes in V" in _build(tmp_path)
    made = tmp_path / "made.stars"
    rows: list[dict[str, Any]] = json.loads(_run("query", made, "--ra", 10, "--dec", 20, "--radius", 1, "--json"))
    assert [row["id"] for row in rows] == ["11", "12"]
    assert rows[0]["magnitude"] == 4.5
    assert rows[0]["color_bv"] is None
    assert rows[1]["distance_deg"] == pytest.approx(0.18794, abs=FIVE_DIGITS)
    bright = json.loads(_run("query", made, "--ra", 10, "--dec", 20, "--radius", 1, "--max-magnitude", 5, "--json"))
    assert [row["id"] for row in bright] == ["11"]


def test_stars_are_moved_to_the_epoch_asked_for(tmp_path: Path) -> None:
    _build(tmp_path)
    made = tmp_path / "made.stars"
    asked = ("query", made, "--ra", 10, "--dec", 20, "--radius", 0.05, "--json")
    assert json.loads(_run(*asked))[0]["dec_deg"] == pytest.approx(20.0, abs=FLOAT64_SUM)
    later = json.loads(_run(*asked, "--epoch", 2040))
    assert later[0]["dec_deg"] == pytest.approx(20.04, abs=FLOAT64_ROOT)  # 3.6 arcsec a year for 40 years
    assert later[0]["epoch_jyear"] == 2040.0
    assert json.loads(_run(*asked, "--epoch", 2060)) == []


def test_a_users_stars_take_the_place_of_those_of_the_first_catalog(tmp_path: Path) -> None:
    _build(tmp_path)
    mine = tmp_path / "mine.csv"
    mine.write_text("ids,ra_deg,dec_deg,magnitude,epoch_jyear\n77,10.0,20.025,4.4,2025.0\n13,50.0,50.0,8.0,2025.0\n")
    both = tmp_path / "both.stars"
    told = json.loads(_run("join", tmp_path / "made.stars", mine, both, "--json"))
    assert (told["stars"], told["replaced"], told["band"]) == (4, 1, "V")
    near = json.loads(_run("query", both, "--ra", 10, "--dec", 20, "--radius", 1, "--json"))
    assert [(row["id"], row["magnitude"]) for row in near] == [("77", pytest.approx(4.4, abs=FLOAT32)), ("12", 6.5)]
    other = json.loads(_run("query", both, "--ra", 50, "--dec", 50, "--radius", 1, "--json"))
    assert [row["id"] for row in other] == ["-1"]  # 13 is another star already
    assert json.loads(_run("info", both, "--json"))["sources"][1]["name"] == "mine.csv"
    assert "SOURCE" not in _run("join", mine, code=2)


@pytest.mark.real_data
def test_the_two_stars_of_the_lorri_images_are_joined_as_a_users_table(tmp_path: Path, data_dir: Path) -> None:
    """The published table has no magnitudes and no identifiers; Proxima is in the default catalog too."""
    made, both = tmp_path / "lorri.stars", tmp_path / "both.stars"
    source = data_dir / "stars" / "lorri_stars.csv"
    _run("build", source, made, "--format", "table", "--column", "magnitude=11", "--band", "Gaia G")
    told = json.loads(_run("join", "default", made, both, "--json"))
    assert told["replaced"] == 1
    wolf = json.loads(_run("query", both, "--ra", 164.1, "--dec", 7.0, "--radius", 0.01, "--epoch", 2016, "--json"))
    assert [row["id"] for row in wolf] == ["2"]
    proxima = json.loads(_run("query", both, "--ra", 217.392, "--dec", -62.676, "--radius", 0.002, "--json"))
    assert [row["id"] for row in proxima] == ["1"]
    assert proxima[0]["parallax_mas"] == pytest.approx(768.0665, abs=FIVE_DIGITS)


def test_people_get_a_list_with_a_heading(tmp_path: Path) -> None:
    _build(tmp_path)
    text = _run("query", tmp_path / "made.stars", "--ra", 10, "--dec", 20, "--radius", 1, "--limit", 1)
    assert text.splitlines()[0] == "2 stars in made, magnitudes in V"
    assert len(text.splitlines()) == 3


def test_info_names_the_sources_and_checks_the_hash(tmp_path: Path) -> None:
    _build(tmp_path, "--name", "mine")
    made = tmp_path / "made.stars"
    told = json.loads(_run("info", made, "--check", "--json"))
    assert (told["name"], told["stars"], told["band"], told["checked"]) == ("mine", 3, "V", True)
    assert told["magnitudes"] == [4.5, 5.5, 6.5]
    assert told["sources"][0]["name"] == "stars.csv"
    assert "sha256:" in _run("info", made)
    content = bytearray(made.read_bytes())
    content[-100] ^= 1
    made.write_bytes(content)
    assert "damaged" in _run("info", made, "--check", code=2)


def test_mistakes_end_in_one_line_and_exit_code_2(tmp_path: Path) -> None:
    _build(tmp_path)
    made, source = tmp_path / "made.stars", tmp_path / "stars.csv"
    assert "--overwrite" in _build(tmp_path, code=2)
    _build(tmp_path, "--overwrite")
    for arguments, message in (
        (("build", source, "--format", "table"), "SOURCE... OUTPUT"),
        (("build", source, tmp_path / "made.db", "--format", "table"), "must end in .stars"),
        (("build", source, tmp_path / "b.stars", "--format", "gaia", "--column", "ra_deg=RA"), "--format table"),
        (("build", source, tmp_path / "b.stars", "--format", "gaia"), "has no column 'source_id'"),
        (("query", made, "--ra", 1, "--dec", 91, "--radius", 1), "--dec"),
        (("query", made, "--ra", 1, "--dec", 1, "--radius", 0), "--radius"),
        (("query", made, "--ra", 1, "--dec", 1, "--radius", 1, "--band", "K"), "no relation is known"),
        (("query", tmp_path / "none.stars", "--ra", 1, "--dec", 1, "--radius", 1), "there is no such catalog"),
        (("info", source, "--check"), "unknown column"),
    ):
        output = _run(*arguments, code=2)
        assert message in output
        assert output.count("\n") == 1
    assert not (tmp_path / "b.stars").exists()
