"""``giantlike detect``: what it prints for machines and for people, and how it ends."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from giantlike.camera import Camera
from giantlike.cli.app import app
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.io import write_fits
from tests.processing.test_detection import (
    GAIN,
    NOISE_DN,
    READ_NOISE_E,
    exposed,
    flux_of_snr,
    paired,
    spread_points,
    star_image,
)

KEYS = ["x_px", "y_px", "sigma_x_px", "sigma_y_px", "flux_dn", "snr", "flags", "is_star"]
SHAPE = (200, 240)
ERROR_SIGMAS = 5.0


def giantlike(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def stars_in(folder: Path, name: str = "stars.fits", *, seed: int = 5, snr: float = 50.0) -> tuple[Path, Any]:
    """A written image of stars, and where they are."""
    points = spread_points(SHAPE, 40, seed)
    light = star_image(points, np.full(len(points), flux_of_snr(snr, 0.8)), 0.8, SHAPE)
    write_fits(folder / name, exposed(light, seed))
    return folder / name, points


def camera_file(folder: Path, columns: int = SHAPE[1], rows: int = SHAPE[0]) -> Path:
    camera = replace(
        Camera.from_fov(4.0, columns, rows),
        psf=GaussianPsf(sigma_px=0.8),
        detector=Detector(gain_e_per_dn=GAIN, read_noise_e=READ_NOISE_E),
    )
    camera.save(folder / "camera.toml")
    return folder / "camera.toml"


def test_json_lists_every_detection_with_position_error_flux_and_flags(tmp_path: Path) -> None:
    path, points = stars_in(tmp_path)
    result = giantlike("detect", path, "--camera", camera_file(tmp_path), "--json")
    assert result.exit_code == 0, result.stderr
    (image,) = json.loads(result.stdout)
    assert image["file"] == str(path)
    assert image["status"] == "ok"
    assert image["reason"] is None
    assert image["psf_sigma_px"] == 0.8
    stars = [row for row in image["detections"] if row["is_star"]]
    assert all(list(row) == KEYS for row in image["detections"])
    found = np.array([[row["x_px"], row["y_px"]] for row in stars])
    sigma = np.array([[row["sigma_x_px"], row["sigma_y_px"]] for row in stars])
    distance, index = paired(found, points)
    assert distance.max() < 1.0
    assert (np.abs(found[index] - points) < ERROR_SIGMAS * sigma[index]).all()
    flux = [row["flux_dn"] for row in image["detections"]]
    assert flux == sorted(flux, reverse=True)


def test_an_unreadable_image_fails_and_the_others_go_on(tmp_path: Path) -> None:
    path, points = stars_in(tmp_path)
    broken = tmp_path / "broken.fits"
    broken.write_bytes(path.read_bytes()[:4000])
    result = giantlike("detect", broken, path, tmp_path / "missing.png", "--json")
    assert result.exit_code == 1
    first, second, third = json.loads(result.stdout)
    assert (first["status"], first["reason"], first["detections"]) == ("failed", "unreadable_image", [])
    assert third["status"] == "failed"
    assert "missing.png" in third["detail"]
    assert second["status"] == "ok"
    assert len(second["detections"]) >= len(points)


def test_the_table_shows_the_brightest_and_names_failures(tmp_path: Path) -> None:
    path, _ = stars_in(tmp_path)
    write_fits(tmp_path / "flat.fits", np.full(SHAPE, 7, dtype=np.uint16))
    result = giantlike("detect", path, tmp_path / "flat.fits")
    assert result.exit_code == 1
    assert "look like stars" in result.stdout
    assert "sigma_x" in result.stdout
    assert "no_signal" in result.stdout


def test_faint_detections_can_be_left_out_and_the_width_of_the_psf_be_given(tmp_path: Path) -> None:
    path, points = stars_in(tmp_path)
    result = giantlike("detect", path, "--psf-sigma", "0.8", "--min-snr", "1000", "--json")
    assert result.exit_code == 0
    (image,) = json.loads(result.stdout)
    assert image["detections"] == []
    (image,) = json.loads(giantlike("detect", path, "--json").stdout)
    assert len(image["detections"]) >= len(points)
    assert image["psf_sigma_px"] == pytest.approx(0.8, abs=0.05)  # 20 stars of SNR 50, each good to 3 %


def test_an_image_of_another_size_than_the_camera_fails_with_both_named(tmp_path: Path) -> None:
    path, _ = stars_in(tmp_path)
    result = giantlike("detect", path, "--camera", camera_file(tmp_path, columns=100), "--json")
    assert result.exit_code == 1
    assert "240 x 200" in json.loads(result.stdout)[0]["detail"]


def test_the_noise_may_come_from_covered_pixels_or_the_detector(tmp_path: Path) -> None:
    path, _ = stars_in(tmp_path)
    camera = camera_file(tmp_path)
    noise = {}
    for options in (["--noise", "local"], ["--noise", "image"], ["--noise", "detector"]):
        (image,) = json.loads(giantlike("detect", path, "--camera", camera, *options, "--json").stdout)
        noise[options[1]] = image["noise_dn"]
    assert noise["image"] == pytest.approx(noise["local"], rel=0.1)  # 5,000 samples of it, and stars among them
    assert noise["detector"] == pytest.approx(NOISE_DN, rel=0.03)  # bias 0: the level is known to 0.1 DN
    region = ["--noise", "covered", "--covered", "0", "0", "30", "30"]
    result = giantlike("detect", path, "--camera", camera, *region, "--json")
    assert json.loads(result.stdout)[0]["noise_dn"] == pytest.approx(NOISE_DN, rel=0.15)  # 900 pixels: 2.4 %, 5 sigma


def test_the_point_spread_function_is_estimated_on_request(tmp_path: Path) -> None:
    path, points = stars_in(tmp_path, snr=100.0)
    camera = camera_file(tmp_path)
    result = giantlike("detect", path, "--camera", camera, "--psf", "gaussian", "--json")
    psf = json.loads(result.stdout)[0]["psf"]
    assert abs(psf["sigma_px"] - 0.8) < ERROR_SIGMAS * psf["sigma_error_px"]
    assert psf["n_used"] <= len(points)
    assert "[psf] sigma_px = 0." in giantlike("detect", path, "--camera", camera, "--psf", "moffat").stdout
    (image,) = json.loads(giantlike("detect", path, "--psf", "moffat", "--psf-degree", "3", "--json").stdout)
    assert image["status"] == "ok"
    assert image["psf"]["reason"] == "too_few_detections"


def moving_sequence(folder: Path, count: int) -> tuple[list[Path], list[Any]]:
    """Images of stars that move, on a pattern that does not, with hot pixels."""
    rng = np.random.default_rng(7)
    pattern = rng.normal(0.0, 60.0, SHAPE)
    pattern[30, 40] += 4000.0
    start = spread_points(SHAPE, 40, 5)
    paths, places = [], []
    for k in range(count):
        points = start + np.array([7.0, -5.0]) * k
        light = star_image(points, np.full(len(points), flux_of_snr(150.0, 0.8)), 0.8, SHAPE)
        image = exposed(light + 1000.0, 50 + k) + pattern
        image[20 + 11 * k, 150] += 3000.0  # a particle
        paths.append(folder / f"{k}.fits")
        write_fits(paths[-1], image.astype(np.float32))
        inside = (points > 5).all(axis=1) & (points < np.array(SHAPE[::-1]) - 5).all(axis=1)
        places.append(points[inside])
    return paths, places


def test_a_fixed_pattern_is_removed_by_the_sequence(tmp_path: Path) -> None:
    paths, places = moving_sequence(tmp_path, 5)
    alone = json.loads(giantlike("detect", paths[2], "--psf-sigma", "0.8", "--json").stdout)[0]
    result = giantlike("detect", *paths, "--psf-sigma", "0.8", "--sequence", "--json")
    assert result.exit_code == 0, result.stderr
    for image, points in zip(json.loads(result.stdout), places, strict=True):
        assert image["noise_dn"] < 0.7 * alone["noise_dn"]
        stars = np.array([[row["x_px"], row["y_px"]] for row in image["detections"] if row["is_star"]])
        assert (paired(stars, points)[0] < 1.0).all()
        hit = [row for row in image["detections"] if abs(row["x_px"] - 150) < 1 and "cosmic_ray" in row["flags"]]
        assert hit


def test_images_of_one_pointing_keep_their_stars(tmp_path: Path) -> None:
    paths = [stars_in(tmp_path, f"{k}.fits")[0] for k in range(3)]
    result = giantlike("detect", *paths, "--psf-sigma", "0.8", "--sequence", "--json")
    assert result.exit_code == 0
    assert "no fixed pattern is removed" in result.stderr
    for image in json.loads(result.stdout):
        assert sum(row["is_star"] for row in image["detections"]) >= len(stars_in(tmp_path)[1])


def test_one_image_is_no_sequence(tmp_path: Path) -> None:
    result = giantlike("detect", stars_in(tmp_path)[0], "--sequence")
    assert result.exit_code == 2
    assert "at least two" in result.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ["--noise", "covered"],
        ["--psf-sigma", "-1"],
        ["--min-snr", "-3"],
        ["--threshold", "0"],
        ["--camera", "no_such.toml"],
    ],
)
def test_a_users_mistake_is_one_line(tmp_path: Path, arguments: list[str]) -> None:
    path, _ = stars_in(tmp_path)
    result = giantlike("detect", path, *arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert len(result.stderr.splitlines()) == 1


def test_calibration_frames_of_a_file_are_applied_before_the_search(tmp_path: Path) -> None:
    points = spread_points(SHAPE, 40, 3)
    light = star_image(points, np.full(len(points), flux_of_snr(30.0, 0.8)), 0.8, SHAPE)
    hot = np.zeros(SHAPE)
    hot[tuple(np.random.default_rng(1).integers(0, 200, (2, 300)))] = 30.0 * NOISE_DN
    write_fits(tmp_path / "stars.fits", exposed(light, 3) + hot, header={"EXPTIME": 1.0})
    for number in range(5):
        write_fits(
            tmp_path / f"dark{number}.fits", exposed(np.zeros(SHAPE), 50 + number) + hot, header={"EXPTIME": 1.0}
        )
    frames = tmp_path / "frames.toml"
    frames.write_text('[campaign]\nname = "other tables do not matter"\n[calibration_frames]\ndark = ["dark*.fits"]\n')

    def stars(*options: str | Path) -> list[dict[str, Any]]:
        result = giantlike("detect", tmp_path / "stars.fits", "--camera", camera_file(tmp_path), "--json", *options)
        assert result.exit_code == 0, result.stderr
        rows: list[dict[str, Any]] = json.loads(result.stdout)[0]["detections"]
        return rows

    def false(rows: list[dict[str, Any]]) -> int:
        found = np.array([[row["x_px"], row["y_px"]] for row in rows])
        return int((np.hypot(*(found[:, None] - points).T).min(axis=0) > 1.0).sum())

    assert false(stars()) > 100
    assert false(stars("--frames", frames)) == 0
    assert len(stars("--frames", frames)) == len(points)


def test_frames_and_a_sequence_are_not_taken_together(tmp_path: Path) -> None:
    path, _ = stars_in(tmp_path)
    result = giantlike("detect", path, path, "--sequence", "--frames", tmp_path / "frames.toml")
    assert result.exit_code == 2
    assert "give it or --sequence" in result.stderr


def test_a_file_without_frames_is_refused(tmp_path: Path) -> None:
    path, _ = stars_in(tmp_path)
    (tmp_path / "frames.toml").write_text("[camera]\n")
    result = giantlike("detect", path, "--frames", tmp_path / "frames.toml")
    assert result.exit_code == 2
    assert "frames.toml" in result.stderr
    assert "calibration_frames" in result.stderr
