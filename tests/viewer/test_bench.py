"""Looking into a run at the shell: layers, words, pictures, backplanes."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from matplotlib.text import Annotation
from typer.testing import CliRunner, Result

import giantlike as gl
from giantlike.cli.app import app
from giantlike.core.attribute_docs import attribute_docs
from giantlike.core.errors import InputError
from giantlike.core.findings import Findings
from giantlike.core.frames import direction_from_radec, rotate
from giantlike.core.outcomes import Quality, Reason
from giantlike.viewer import Session, explain, layers_of
from giantlike.viewer.comparison import limb_residuals, match_of
from giantlike.viewer.explain import _digits
from giantlike.viewer.layers import LAYERS
from giantlike.viewer.pictures import picture_of
from giantlike.viewer.planes import backplanes_of, with_terminators
from giantlike.viewer.session import chosen_fix
from tests.campaign_files import APRIORI_OFFSET_KM, CAMERA, RADII_KM, Truth
from tests.viewer.conftest import RockRun

SHORT, LONG = "visit0_b_short.fits", "visit0_a_long.fits"
WCS_PX = 0.01  # of the polynomials that stand for a pinhole camera
CENTER_PX = 0.2  # of fixes in these images


def giantlike(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_layers_have_what_the_run_found(run: Path, made: tuple[Path, dict[str, Truth]]) -> None:
    session = Session(run)
    stars = {layer.name: layer for layer in layers_of(session.seen(LONG))}
    body = {layer.name: layer for layer in layers_of(session.seen(SHORT))}

    matched, predicted = stars["matches"].layer.points, stars["catalog"].layer.points
    assert len(matched) == len(stars["matches"].star_ids) == len(stars["matches"].labels) >= 10
    assert np.abs(matched - predicted).max() < 1.0
    assert len(stars["detections"].layer.points) >= len(matched)
    truth_px = CAMERA.model.project(made[1][SHORT].position_camera_km)
    assert np.linalg.norm(body["centers"].layer.points - truth_px, axis=1).max() < CENTER_PX
    assert {"predicted", "fitted"} <= body.keys()
    assert [layer.name for layer in layers_of(session.seen(LONG), ["rejected", "matches"])][-1:] == ["matches"]


def test_an_image_is_explained_in_words(run: Path, made: tuple[Path, dict[str, Truth]]) -> None:
    session = Session(run)

    star_words, body_words = explain(session.seen(LONG)), explain(session.seen(SHORT))

    assert re.search(r"Attitude: ok, from its own stars\.", star_words)
    assert re.search(r"\d+ detections, \d+ matched with catalog stars", star_words)
    assert "from the star images before and after it" in body_words
    assert re.search(r"Center at \([\d.]+, [\d.]+\) px, sigma", body_words)
    assert "Variance by cause: " in body_words
    size = re.search(r"([\d.]+) px across \(the sphere of its volume\)", body_words)
    assert size is not None
    range_km = float(np.linalg.norm(made[1][SHORT].position_camera_km + APRIORI_OFFSET_KM))
    diameter_px = 2.0 * np.arcsin(np.cbrt(np.prod(RADII_KM)) / range_km) * CAMERA.model.focal_length_px
    assert float(size[1]) == pytest.approx(diameter_px, abs=0.2)  # the scale a few degrees off the axis
    assert "Odds of other models of the image: " in body_words
    assert "Smallest sigma of the fixes to trust" in body_words


@pytest.mark.parametrize(
    ("value", "digits", "text"), [(7.4732812, 6, "7.47328"), (73094089.4, 8, "73094089"), (74123.0, 2, "74000")]
)
def test_numbers_are_told_with_the_digits_that_count_and_no_exponent(value: float, digits: int, text: str) -> None:
    assert _digits(value, digits) == text
    assert _digits(-value, digits, "+") == f"-{text}"


def test_a_fix_and_a_failure_outside_of_a_run_are_explained_too() -> None:
    fix = gl.CenterFix(
        estimator="moment",
        target="ROCK",
        center_px=np.array([10.0, 20.0]),
        covariance_px2=np.diag([0.04, 0.01]),
        predicted_px=np.array([11.0, 20.0]),
        residuals=np.zeros(0),
        n_used=90,
        n_rejected=3,
        score=1.0,
        flags=gl.Quality.WRONG_FIGURE | gl.Quality.SATURATED,
        parts={gl.Cause.NOISE: np.diag([0.01, 0.01]), gl.Cause.PSF: np.diag([0.03, 0.0])},
    )
    words = explain(fix)
    assert "ROCK by moment: suspect" in words
    assert "Observations used: 90, 3 rejected." in words
    assert "Variance by cause: psf 60%, noise 40%." in words
    assert "Suspect because: wrong_figure. " in words
    assert "Note: saturated. " in words
    assert explain(gl.Failure(gl.Reason.NO_LIMB, "too small.")).startswith("no_limb: too small. There is no limb")


def test_the_odds_of_other_models_and_the_larger_sigma_are_explained() -> None:
    checks = {
        "other_sun_log_odds": -20.0 * math.log(10.0),
        "second_light_log_odds": 4.0 * math.log(10.0),
        "other_place_log_odds": -5.0 * math.log(10.0),
        "prediction_chance": 0.25,
        "tension": 2.5,
    }
    fix = gl.CenterFix(
        estimator="moment",
        target="ROCK",
        center_px=np.array([10.0, 20.0]),
        covariance_px2=0.04 * np.eye(2),
        predicted_px=np.array([11.0, 20.0]),
        residuals=np.zeros(0),
        n_used=90,
        n_rejected=3,
        score=1.0,
        parts={gl.Cause.NOISE: 0.04 * np.eye(2)},
        findings=Findings(checks=checks),
    )
    words = explain(fix)
    assert "second_light 10^4.0, other_sun 10^-20.0 (suspect where their sum exceeds 10^4.0)." in words
    assert "Odds of another place in the search region: 10^-5.0 (suspect above 10^-3.0)." in words
    assert "Probability that a right prediction is off by as much: 0.25 (suspect below 0.001)." in words
    assert "multiplied by 2.5 (tension)" in words
    assert "tension" not in explain(replace(fix, findings=Findings()))


def test_every_reason_and_flag_has_a_meaning_and_a_remedy() -> None:
    reasons, flags = attribute_docs(Reason), attribute_docs(Quality)
    single = {str(flag.name) for flag in Quality if flag.value.bit_count() == 1}
    assert reasons.keys() == {reason.name for reason in Reason}
    assert flags.keys() == single
    for text in (*reasons.values(), *flags.values()):
        assert len(re.findall(r"[.;](?: |$)", text)) >= 2, text


def test_names_of_images_may_be_short_but_must_be_clear(run: Path) -> None:
    session = Session(run)
    assert session.find("visit0_b_short") == SHORT
    assert session.find(f"some/folder/{LONG}") == LONG
    with pytest.raises(InputError, match="give the whole name"):
        session.find("visit0")
    with pytest.raises(InputError, match="the nearest name is visit0_b_short"):
        session.find("visit0_b_shart.fits")


def test_backplanes_lie_where_the_body_is_and_carry_world_coordinates(
    run: Path, made: tuple[Path, dict[str, Truth]], tmp_path: Path
) -> None:
    result = giantlike("backplanes", SHORT, "--run", run, "--output", tmp_path / "b.fits")
    assert result.exit_code == 0, result.stderr
    with fits.open(tmp_path / "b.fits") as file:
        header, cube = file[0].header, file[0].data
        names = [header[f"PLANE{number + 1}"] for number in range(len(cube))]
        sky = WCS(header, naxis=2)
    planes = dict(zip(names, cube, strict=True))
    truth = made[1][SHORT]
    rows, columns = np.nonzero(planes["body"] == 0)
    center = CAMERA.model.project(truth.position_camera_km)
    assert np.hypot(columns.mean() - center[0], rows.mean() - center[1]) < 0.5
    assert abs(np.nanmin(planes["range"]) - np.linalg.norm(truth.position_camera_km)) < 1.2 * RADII_KM[0]
    assert np.isnan(planes["phase"][planes["body"] < 0]).all()
    points = np.array([[10.0, 20.0], [300.0, 250.0]])
    radec = sky.all_pix2world(points, 0)
    seen = rotate(truth.camera_from_inertial, np.array([direction_from_radec(*each) for each in radec]))
    off = CAMERA.model.project(seen) - points
    apart = np.ptp(off, axis=0)
    assert np.abs(apart).max() < WCS_PX, "the field is warped against the camera"


def test_the_template_at_a_fix_explains_the_image(run: Path) -> None:
    session = Session(run)
    seen = session.seen(SHORT)
    target = seen.observations[0].target
    match = match_of(session, SHORT, target)

    body = match.model_dn > match.model_dn.min() + 0.2 * np.ptp(match.model_dn)
    noise = np.sqrt(match.model_dn[body & match.region] + 25.0)
    assert 0.8 < np.std(match.difference_dn[body & match.region] / noise) < 1.5
    surface = match.correlation(half_px=5)
    assert int(np.nanargmax(surface)) == 5 * surface.shape[1] + 5


def test_limb_points_lie_on_the_outline_at_their_fix(run: Path) -> None:
    session = Session(run)
    seen = session.seen(SHORT)
    fixes = [one for one in seen.observations if len(seen.points[one.subject].get("limb_px", ()))]
    assert fixes, "the campaign has an estimator of limbs"
    for fix in fixes:
        found = limb_residuals(session, SHORT, fix)
        assert np.abs(np.median(found.distance_px)) < 0.1
        assert np.std(found.distance_px) < 0.5


def test_the_fix_to_look_at_is_the_best_one_or_the_one_asked_for(run: Path) -> None:
    seen = Session(run).seen(SHORT)
    names = [one.estimator for one in seen.observations]
    target = seen.observations[0].target
    best = chosen_fix(seen, target)
    assert best is not None
    assert best.status == "ok"
    asked = chosen_fix(seen, target, names[-1])
    assert asked is None or asked.estimator == names[-1]
    with pytest.raises(InputError, match="there are"):
        chosen_fix(seen, target, "astrology")


def test_show_draws_the_layers_asked_for(run: Path, tmp_path: Path) -> None:
    for layers in ("matches", "detections"):
        output = tmp_path / f"{layers}.png"
        result = giantlike("show", LONG, "--run", run, "--output", output, "--layers", layers)
        assert result.exit_code == 0, result.stderr
    green, orange = (cv2.imread(str(tmp_path / f"{name}.png")) for name in ("matches", "detections"))
    assert green is not None
    assert orange is not None
    colored = [int((np.ptp(picture.astype(int), axis=2) > 60).sum()) for picture in (green, orange)]
    assert min(colored) > 100
    assert np.any(green != orange)
    wrong = giantlike("show", LONG, "--run", run, "--output", tmp_path / "x.png", "--layers", "constellations")
    assert wrong.exit_code == 2
    assert ", ".join(LAYERS) in wrong.stderr


def test_pictures_have_names_beside_landmarks_in_view(rock: RockRun) -> None:
    session = Session(rock.run)
    (layer,) = layers_of(session.seen(rock.file), ["landmarks"])
    first = layer.layer.points[0]
    for box in (None, (*first - 3.0, *first + 3.0)):
        texts = picture_of(session, rock.file, [layer], box=box).axes[0].texts
        names = list(layer.names) if box is None else [layer.names[0]]
        assert [text.get_text() for text in texts] == names
        places = [text.xy for text in texts if isinstance(text, Annotation)]
        np.testing.assert_array_equal(places, layer.layer.points[: len(names)])


def test_explain_has_json(run: Path) -> None:
    result = giantlike("explain", "visit0_b_short", "--run", run, "--json")
    assert result.exit_code == 0, result.stderr
    content = json.loads(result.stdout)
    assert content["file"] == SHORT
    assert content["verdict"] in {"ok", "suspect"}
    seen = Session(run).seen(SHORT)
    assert content["image"]["epoch_utc"] == seen.record.epoch_utc
    assert [target["target"] for target in content["targets"]] == [one.target for one in seen.targets]
    found = [one for one in content["fixes"] if one["status"] != "failed"]
    assert found
    assert all(len(one["center_px"]) == 2 and "checks" in one for one in found)


def test_a_campaign_file_that_moved_is_asked_for(campaign: Path, run: Path, tmp_path: Path) -> None:
    moved = tmp_path / "copy" / "other.toml"
    campaign.rename(moved)
    lost = giantlike("backplanes", SHORT, "--run", run, "--output", tmp_path / "b.fits")
    assert lost.exit_code == 2
    assert "--campaign FILE" in lost.stderr
    found = giantlike("backplanes", SHORT, "--run", run, "--output", tmp_path / "b.fits", "--campaign", moved)
    assert found.exit_code == 0, found.stderr


def test_the_terminator_is_where_the_sun_stands_at_the_horizon(run: Path) -> None:
    session = Session(run)
    planes = backplanes_of(session, SHORT)
    seen = with_terminators(session, session.seen(SHORT), planes)
    ((target, lines),) = seen.terminators.items()
    known = session.geometry(SHORT)[target]
    points = np.concatenate(lines)
    assert np.ptp(points, axis=0).max() > 0.5 * np.ptp(np.argwhere(planes.body == 0), axis=0).max()
    columns, rows = np.rint(points).astype(int).T
    near = np.degrees(planes.incidence_rad[rows, columns])
    assert np.nanmax(np.abs(near - 90.0)) < 8.0  # half a pixel, on a body of some 70
    center = CAMERA.model.project(session.position_camera_km(known, chosen_fix(session.seen(SHORT), target)))
    sunward = known.sun_direction_camera[:2] / np.linalg.norm(known.sun_direction_camera[:2])
    step = np.rint(points + 4.0 * sunward).astype(int)
    lit = planes.incidence_rad[step[:, 1], step[:, 0]]
    assert np.nanmedian(lit) < np.radians(90.0)
    assert np.abs(points - center).max() < 100.0
    (layer, *_) = layers_of(seen, ["terminator"])
    assert layer.title == f"{target}: terminator"


def test_limb_points_that_were_not_used_are_a_layer_of_their_own(run: Path) -> None:
    seen = Session(run).seen(SHORT)
    fixes = {one.estimator: one for one in seen.observations}
    used = {layer.title: len(layer.layer.points) for layer in layers_of(seen, ["limb"])}
    assert set(used) == {"PEBBLE: limb points used by limb_matching"}
    assert list(used.values()) == [fixes["limb_matching"].n_used]
    rejected = sum(len(layer.layer.points) for layer in layers_of(seen, ["limb-rejected"]))
    assert rejected == fixes["limb_matching"].n_rejected
