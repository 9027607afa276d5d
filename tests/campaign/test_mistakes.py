"""Mistakes that users make in a campaign: what ``check`` finds, what ``run`` says, and their exit codes."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.runner import run_campaign
from giantlike.cli.app import app
from tests.campaign.flyby import COLUMNS, ZERO_POINT_E_S, Flyby, Session, make_flyby, write_session
from tests.campaign.mistakes import MISTAKES
from tests.sizes import slow

DONE, SOME_FAILED, BAD_INPUT = 0, 1, 2


@dataclass(frozen=True)
class Row:
    """Exit codes of ``check`` and ``run``, and a phrase of each; an empty one where it has nothing to say.

    images: of the run; three where only several show it.
    """

    check: int
    run: int
    checked: str = ""
    ran: str = ""
    images: int = 1


def before(phrase: str) -> Row:
    """Row of an error that ends a run before its first image."""
    return Row(BAD_INPUT, BAD_INPUT, phrase, phrase)


def warned(phrase: str, run: int = DONE) -> Row:
    """Row of a warning that both give."""
    return Row(DONE, run, phrase, phrase)


ROWS: dict[str, Row] = {
    "baseline": Row(DONE, DONE, images=3),
    "radii_km in m": before(r"1e\+03 times the mean radius in the loaded PCK"),
    "radii in Mm": before("0.001 times the mean radius in the loaded PCK"),
    "attitude header in ECLIPJ2000": Row(
        DONE, SOME_FAILED, ran=r"with the a priori attitude taken as ECLIPJ2000 \d+ stars match"
    ),
    "same, lost_in_space": Row(DONE, DONE, ran="the a priori attitude is wrong by 23.4"),
    "quaternion inverse": Row(DONE, SOME_FAILED, ran=r"with the inverse of the a priori attitude \d+ stars match"),
    "quaternion scalar first": Row(DONE, SOME_FAILED, ran=r"with the scalar first \d+ stars match"),
    "camera rolled 90 deg in header": Row(
        DONE, SOME_FAILED, ran=r"with a roll of -90 deg of the a priori attitude \d+ stars match"
    ),
    "DATE-AVG TDB, TIMESYS UTC": Row(
        DONE, DONE, ran=r"a time offset of -6\d\.\d+ .* common to all 3 images.*dates in TDB labeled UTC", images=3
    ),
    "DATE-AVG TDB, TIMESYS TDB": Row(DONE, DONE, images=3),
    "EXPTIME in ms": Row(
        DONE, SOME_FAILED, ran="with the exposures divided by 1000 they do not: are they in ms", images=3
    ),
    "DATE-OBS is really mid, no comment": Row(
        DONE, DONE, ran=r"a time offset of -1\.0\d* .* half of the exposure", images=3
    ),
    "no a priori attitude at all, no lost_in_space": before(
        "no image has an a priori attitude .*: give one, or set stars.lost_in_space = true"
    ),
    "epoch outside the SPK": before("the kernels cover PROBE from 2010-03-02T00:00:00 to 2010-03-03T00:00:00"),
    "no leapseconds kernel": warned("the leap seconds are those of astropy"),
    "no PCK": before("no orientation of RHEA at .* load the PCK.*IAU_RHEA"),
    'radii "pck", no PCK': before("no radii of RHEA: load a PCK that has them .*BODY605_RADII"),
    "no spacecraft SPK": before("'PROBE': no ephemeris of -990"),
    "kernel file missing": before("gone.bsp: SPICE kernel not found"),
    "unknown spacecraft name": before("spice.spacecraft: 'PROBBE': .*did you mean 'PROBE'"),
    "spacecraft id of another": before("'-82': no ephemeris of -82; the kernels have ephemerides of .*PROBE"),
    "target not in kernels": before("'PHOEBE': no ephemeris of 609; the kernels have ephemerides of .*RHEA"),
    "target misspelled": before("'RHEIA': SPICE does not know this name .*did you mean 'RHEA'"),
    "target name valid but wrong body": warned("DIONE has 1.36 times the mean radius in the loaded PCK .*another body"),
    "SPK in ECLIPJ2000 labelled J2000": Row(
        DONE, DONE, *2 * ("outside of all images, .* inside with the SPK of PROBE taken as ECLIPJ2000",), images=2
    ),
    "SPK in m": before(r"the spacecraft moves at 6\.\d+e\+03 km/s, .* is its SPK or the observer of the header in m"),
    "focal 2x too small": Row(
        DONE, SOME_FAILED, ran=r"\d+ stars fit a field of view of (4\.9|5|5\.0)\d* degrees, 0\.50\d* of the 9\.9"
    ),
    "fov_deg in rad": warned("a field of view of 0.0873 deg on 400 px: is it in rad", SOME_FAILED),
    "k1 wrong sign": Row(DONE, DONE, ran=r"the residuals of the stars are radial.* large_residuals \(1\)"),
    "rows upside down": Row(DONE, SOME_FAILED, ran=r"mirrored: with the rows reversed .* \d+ stars match"),
    "scale uncertainty in percent": before("uncertainty.scale: expected less than or equal to 0.3, got 0.5"),
    "attitude_sigma in arcsec": before("attitude_sigma_deg: expected less than or equal to 30, got 72"),
    "attitude_sigma in rad": warned("1.3 arcsec is less than the error of attitudes in headers: is it in rad"),
    "ephemeris_km in m": warned("400000 km at a range of .* is wider than the field of view: is it in m"),
    "ephemeris 10x too small": Row(DONE, DONE, ran=r"far_from_prediction \(1\)"),
    "negative scale": before("uncertainty.scale: expected greater than or equal to 0, got -0.01"),
    "max_magnitude 3": warned(r"0 stars of the catalog lie in the predicted field", SOME_FAILED),
    "frame of another body": warned("IAU_SATURN is the frame of SATURN, not of RHEA"),
    "frame misspelled": before("SPICE does not know the frame 'IAU_RHEIA' .*did you mean 'IAU_RHEA'"),
}


def giantlike(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def said(result: Result) -> str:
    """Both streams in one line, without the folders of the test."""
    return " ".join((result.stdout + result.stderr).split())


def assert_says(result: Result, phrase: str) -> None:
    """Assert that the output matches a regular expression."""
    assert re.search(phrase, said(result)), said(result)


@pytest.fixture(scope="module")
def flyby(tmp_path_factory: pytest.TempPathFactory) -> Flyby:
    return make_flyby(tmp_path_factory.mktemp("flyby"))


def test_every_mistake_has_a_row() -> None:
    assert list(ROWS) == list(MISTAKES)


SLOW = (
    "quaternion inverse",
    "quaternion scalar first",
    "camera rolled 90 deg in header",
    "DATE-AVG TDB, TIMESYS TDB",
    "frame of another body",
    "focal 2x too small",
    "k1 wrong sign",
    "rows upside down",
)
"""Rows whose run takes more than a second, and whose kind of mistake another row or test has as well."""


@pytest.mark.parametrize("name", [slow(name) if name in SLOW else name for name in ROWS])
def test_a_mistake_is_found_as_early_as_it_can_be(name: str, flyby: Flyby, tmp_path: Path) -> None:
    row = ROWS[name]
    path = write_session(flyby, tmp_path / "session", MISTAKES[name], images=row.images)
    checked = giantlike("check", path)
    assert checked.exit_code == row.check, checked.stdout
    assert_says(checked, row.checked or "0 mistakes, 0 warnings$")
    ran = giantlike("run", path, "--workers", "1")
    assert ran.exit_code == row.run, said(ran)
    assert_says(ran, row.ran or "0 images failed")
    assert (path.parent / "run").exists() == (row.run != BAD_INPUT), "a run that ends with 2 has computed nothing"
    if not row.ran:
        assert "giantlike: " not in ran.stderr


def test_the_error_of_an_unused_attitude_is_named_with_its_axis(flyby: Flyby, tmp_path: Path) -> None:
    path = write_session(flyby, tmp_path / "session", MISTAKES["same, lost_in_space"], images=1)
    (record,) = run_campaign(Campaign.load(path), workers=1).attitudes
    assert (record.status, record.flags) == ("ok", ["wrong_apriori"])
    (note,) = record.notes
    assert re.search(r"wrong by 23\.4\d* deg about the inertial x axis: .* taken as ECLIPJ2000 it is correct", note)


def test_stars_tell_an_exposure_in_ms_of_a_single_image_where_a_zero_point_is_declared(
    flyby: Flyby, tmp_path: Path
) -> None:
    def declared(one: Session) -> None:
        in_ms = MISTAKES["EXPTIME in ms"]
        assert in_ms is not None
        in_ms(one)
        one.table["photometry"] = {"zero_point_e_s": ZERO_POINT_E_S}

    path = write_session(flyby, tmp_path / "session", declared, images=1)
    assert_says(giantlike("run", path, "--workers", "1"), "with the exposures divided by 1000 they have .* in ms")
    path = write_session(flyby, tmp_path / "session", MISTAKES["EXPTIME in ms"], images=1)
    assert "in ms" not in said(giantlike("run", path, "--workers", "1"))


def test_a_refusal_is_a_success_where_nothing_is_expected(flyby: Flyby, tmp_path: Path) -> None:
    def dark(one: Session) -> None:
        one.pixels["rhea0.fits"] = np.random.default_rng(7).normal(100.0, 5.0, (COLUMNS, COLUMNS)).astype(np.uint16)
        one.table["images"]["expect"] = {"rhea0*": "none"}

    path = write_session(flyby, tmp_path / "session", dark, images=2)
    ran = giantlike("run", path, "--workers", "1")
    assert ran.exit_code == DONE, said(ran)
    assert_says(ran, r"attitude │ 1 │ 0 │ 1 │")
    page = path.with_name("run").joinpath("report.html").read_text()
    assert "nothing found, as expected" in page
    assert "Every failure" not in page
    path.write_text(path.read_text().replace("rhea0*", "rhea*"))
    again = giantlike("run", path, "--workers", "1")
    assert again.exit_code == SOME_FAILED, "a body was found where nothing was expected"
    assert_says(again, "1 image failed: rhea1.fits")
    assert (
        "a fix in an image that images.expect says to be empty"
        in path.with_name("run").joinpath("report.html").read_text()
    )
    path.write_text(path.read_text().replace("rhea*", "moon*"))
    assert_says(giantlike("check", path), "images.expect: no image has the name 'moon[*]'")


def test_an_error_of_one_image_fails_that_image_alone(flyby: Flyby, tmp_path: Path) -> None:
    def late(one: Session) -> None:
        one.headers["rhea0.fits"]["DATE-OBS"] = "2010-03-12T12:00:00"

    path = write_session(flyby, tmp_path / "session", late, images=2)
    assert giantlike("check", path).exit_code == BAD_INPUT
    ran = giantlike("run", path, "--workers", "1")
    assert ran.exit_code == SOME_FAILED
    assert_says(ran, "1 image failed: rhea0.fits")


def test_warnings_of_the_checks_are_in_the_report(flyby: Flyby, tmp_path: Path) -> None:
    path = write_session(flyby, tmp_path / "session", MISTAKES["frame of another body"], images=1)
    assert giantlike("run", path, "--workers", "1").exit_code == DONE
    assert "IAU_SATURN is the frame of SATURN, not of RHEA" in (path.parent / "run" / "report.html").read_text()
    assert_says(giantlike("explain", path.parent / "run"), "rhea0.fits: 400 x 400 px")  # the only image is not named


def test_radial_residuals_are_called_radial(flyby: Flyby, tmp_path: Path) -> None:
    path = write_session(flyby, tmp_path / "session", MISTAKES["k1 wrong sign"], images=1)
    (record,) = run_campaign(Campaign.load(path), workers=1).attitudes
    assert (record.status, record.flags) == ("suspect", ["large_residuals"])
    assert "the residuals of the stars are radial" in record.notes[0]
