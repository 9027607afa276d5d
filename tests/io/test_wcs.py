"""World coordinates of FITS headers, images stored from the bottom, and the sky of New Horizons."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import tomli_w
from astropy.io import fits
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.image_loading import open_image
from giantlike.catalogs import apparent_directions, load_catalog
from giantlike.catalogs.table import et_of_julian_year
from giantlike.cli.app import app
from giantlike.core.errors import InputError
from giantlike.core.frames import camera_from_inertial_of_pointing, direction_from_radec, rotate
from giantlike.image import Image
from giantlike.io.camera_sip import PosedModel
from giantlike.io.wcs_header import attitude_of_wcs, write_wcs

WCS_PX = 0.01  # polynomials of order 5, and the lens fitted to them again
ATTITUDE = Rotation.from_euler("zyx", [120.0, -40.0, 33.0], degrees=True)
CAMERA = Camera(
    name="cam",
    columns=320,
    rows=240,
    model=BrownModel(fx_px=2000.0, fy_px=2000.0, cx_px=162.0, cy_px=118.0, k1=-0.5),
)


def _header(tmp_path: Path) -> fits.Header:
    posed = PosedModel(model=CAMERA.model, columns=320, rows=240, camera_from_inertial=ATTITUDE)
    write_wcs(tmp_path / "x.wcs.fits", posed)
    return fits.getheader(tmp_path / "x.wcs.fits")


def _mirrored(header: fits.Header, rows: int) -> fits.Header:
    """World coordinates of the same picture stored from the bottom, SIP left out."""
    turned = header.copy()
    for key in [key for key in turned if key[:2] in ("A_", "B_", "AP", "BP")]:
        del turned[key]
    turned["CTYPE1"], turned["CTYPE2"] = "RA---TAN", "DEC--TAN"
    turned["CRPIX2"] = rows + 1 - turned["CRPIX2"]
    for key in ("CD1_2", "CD2_2"):
        turned[key] = -turned[key]
    return turned


def _write(path: Path, header: fits.Header) -> Path:
    pixels = np.random.default_rng(1).integers(90, 110, (240, 320)).astype(np.uint16)
    fits.PrimaryHDU(pixels, header).writeto(path)
    return path


def test_the_attitude_of_written_world_coordinates_is_read_back(tmp_path: Path) -> None:
    told = attitude_of_wcs(dict(_header(tmp_path)), CAMERA.model, columns=320, rows=240)
    assert told.rms_px < WCS_PX
    assert (told.camera_from_inertial * ATTITUDE.inv()).magnitude() * 2000.0 < WCS_PX


def test_rows_stored_from_the_bottom_are_turned_on_reading(tmp_path: Path) -> None:
    path = _write(tmp_path / "a.fits", fits.Header())
    stored, turned = Image.open(path), Image.open(path, bottom_up=True)
    assert np.array_equal(turned.pixels, stored.pixels[::-1])
    assert turned.sha256 == stored.sha256
    assert not turned.pixels.flags.writeable


def test_a_mirrored_sky_gives_the_attitude_only_with_its_rows_turned(tmp_path: Path) -> None:
    header = dict(_mirrored(_header(tmp_path), 240))
    with pytest.raises(InputError, match="mirrored: read the image with bottom_up"):
        attitude_of_wcs(header, CAMERA.model, columns=320, rows=240)
    told = attitude_of_wcs(header, CAMERA.model, columns=320, rows=240, bottom_up=True)
    # Without SIP the distortion of the corners, 0.5 px, is left over, and no shift.
    assert told.rms_px < 1.0
    assert (told.camera_from_inertial * ATTITUDE.inv()).magnitude() * 2000.0 < 0.5
    with pytest.raises(InputError, match="mirrored: read it as stored"):
        attitude_of_wcs(dict(_header(tmp_path)), CAMERA.model, columns=320, rows=240, bottom_up=True)


def _campaign(folder: Path, header: fits.Header, **images: bool) -> Campaign:
    _write(folder / "a.fits", header)
    table = {
        "campaign": {"name": "wcs", "output": "run"},
        "images": {"files": ["a.fits"], **images},
        "camera": CAMERA.to_mapping(),
    }
    (folder / "campaign.toml").write_text(tomli_w.dumps(table))
    return Campaign.load(folder / "campaign.toml")


def test_a_campaign_takes_a_plate_solution_in_the_header_as_a_priori(tmp_path: Path) -> None:
    campaign = _campaign(tmp_path, _header(tmp_path))
    prepared = open_image(campaign, campaign.images[0])
    assert prepared.image.camera_from_inertial is not None
    assert (prepared.image.camera_from_inertial * ATTITUDE.inv()).magnitude() * 2000.0 < WCS_PX
    assert "world coordinates" in prepared.notes[0]


@pytest.mark.parametrize("bottom_up", [False, True])
def test_a_campaign_of_images_stored_from_the_bottom_has_to_say_so(tmp_path: Path, bottom_up: bool) -> None:
    campaign = _campaign(tmp_path, _mirrored(_header(tmp_path), 240), bottom_up=bottom_up)
    prepared = open_image(campaign, campaign.images[0])
    assert (prepared.image.camera_from_inertial is not None) == bottom_up
    assert ("bottom_up" in prepared.notes[0]) != bottom_up


@pytest.fixture(scope="module")
def parallax() -> ModuleType:
    path = Path(__file__).parents[2] / "examples" / "new_horizons_parallax.py"
    spec = importlib.util.spec_from_file_location("new_horizons_parallax", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.real_data
def test_near_stars_are_measured_where_they_were_published_and_shifted_by_their_parallax(
    parallax: ModuleType, data_dir: Path
) -> None:
    seen = parallax.sightings(data_dir / "stars")
    assert [one.star for one in seen] == ["Proxima Cen"] * 3 + ["Wolf 359"] * 3
    for one in seen:
        assert np.abs(one.measured_px - one.published_px).max() < 0.3
        assert np.abs(one.predicted_px - one.published_px).max() < 0.3
        assert one.parallax_sigmas < 3.0
        shift_arcsec = np.linalg.norm(one.predicted_px - one.without_parallax_px) * 4.08
        assert shift_arcsec == pytest.approx({"Proxima Cen": 32.3, "Wolf 359": 16.2}[one.star], abs=0.5)


def test_a_sky_stored_from_the_bottom_is_solved_and_drawn_by_the_command(tmp_path: Path) -> None:
    """Real catalog stars, drawn as they are seen, stored with the last row first."""
    model = BrownModel(fx_px=2900.0, fy_px=2900.0, cx_px=299.5, cy_px=299.5)
    camera = Camera(name="cam", columns=600, rows=600, model=model)
    attitude = camera_from_inertial_of_pointing(60.0, 25.0, 0.0)
    stars = load_catalog("default").cone(rotate(attitude.inv(), [0.0, 0.0, 1.0]), 0.16, max_magnitude=8.0)
    points = camera.model.project(rotate(attitude, apparent_directions(stars, et_of_julian_year(2016.0))))
    inside = camera.contains(points, margin_px=-8)
    y, x = np.mgrid[:600, :600]
    pixels = np.random.default_rng(2).normal(100.0, 4.0, (600, 600))
    for (px, py), magnitude in zip(points[inside], stars.magnitude[inside], strict=True):
        box = np.s_[max(int(py) - 6, 0) : int(py) + 8, max(int(px) - 6, 0) : int(px) + 8]
        spot = np.exp(-0.5 * ((x[box] - px) ** 2 + (y[box] - py) ** 2))
        pixels[box] += 10.0 ** (-0.4 * (magnitude - 8.0)) * 150.0 * spot
    path = tmp_path / "sky.fits"
    fits.PrimaryHDU(np.clip(pixels[::-1], 0, 60000).astype(np.uint16)).writeto(path)
    review = tmp_path / "review"
    arguments = ["stars", str(path), "--fov", "11.8", "--fov-error", "5", "--bottom-up", "--review", str(review)]
    outcome = CliRunner().invoke(app, [*arguments, "--json"])
    solved = json.loads(outcome.stdout)[0]
    assert solved["status"] == "ok"
    assert abs(solved["ra_deg"] - 60.0) < 0.01
    assert abs(solved["dec_deg"] - 25.0) < 0.01
    assert {file.name for file in review.iterdir()} == {"sky.fits.stars.png", "sky.fits.residuals.png"}


UNKNOWN_ABERRATION_ARCSEC = np.degrees(30.0 / 299_792.458 / np.sqrt(3.0)) * 3600.0  # a command line knows no observer


@pytest.mark.real_data
def test_stars_behind_a_fixed_pattern_are_solved_with_the_sequence(data_dir: Path) -> None:
    truth = {  # right ascension and declination, deg, published to three digits; img1 was not solved
        "img0.png": (181.172, 16.834),
        "img2.png": (154.015, 19.160),
        "img3.png": (169.987, 13.750),
        "img4.png": (179.821, 15.737),
    }
    images = sorted((data_dir / "stars" / "openstartracker").glob("*.png"))
    outcome = CliRunner().invoke(app, ["stars", *map(str, images), "--fov", "6.07", "--sequence", "--json"])
    solved = {Path(one["file"]).name: one for one in json.loads(outcome.stdout) if one["status"] == "ok"}
    assert truth.keys() <= solved.keys()
    for name, place in truth.items():
        found = direction_from_radec(solved[name]["ra_deg"], solved[name]["dec_deg"])
        assert np.degrees(np.arccos(min(float(found @ direction_from_radec(*place)), 1.0))) < 0.01
        sigma = max(solved[name][f"sigma_{axis}_arcsec"] for axis in "xy")
        assert UNKNOWN_ABERRATION_ARCSEC < sigma < np.hypot(UNKNOWN_ABERRATION_ARCSEC, 10.0)
