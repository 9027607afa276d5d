"""The command line: exit codes, JSON, one line for a mistake, and runs that are killed."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from typer.testing import CliRunner, Result

from giantlike import __version__
from giantlike.campaign.store.records import AttitudeRecord
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.cli.app import app
from giantlike.core.frames import direction_from_radec, pointing_deg
from giantlike.io import write_fits
from tests.campaign_files import CAMERA, Truth, campaign_table, write_campaign

POINTING_DEG = 0.002  # 0.03 px: a hundred stars of 0.1 px, and a priori free
REFERENCE_DEG = 0.02  # the reference solutions know no distortion
REFERENCE_FOV = 0.002  # relative, likewise
STAR_KEYS = ["file", "status", "reason", "ra_deg", "dec_deg", "roll_deg", "fov_deg", "n_matched", "rms_px"]
HELP_SECONDS = 0.5


def giantlike(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def line_on_stderr(result: Result) -> str:
    """The one line that a user's mistake ends in."""
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    (line,) = result.stderr.splitlines()
    return line


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Truth]]:
    return write_campaign(tmp_path_factory.mktemp("campaign"), visits=1)


def test_help_and_version_answer(tmp_path: Path) -> None:
    assert giantlike("--version").stdout == f"giantlike {__version__}\n"
    text = giantlike("--help").stdout
    for command in ("run", "stars", "report", "demo"):
        assert re.search(rf"^  {command} ", text, re.M)
        assert giantlike(command, "--help").exit_code == 0


def test_help_imports_nothing_heavy() -> None:
    script = "import sys\nfrom giantlike.cli.app import app\n" + (
        "heavy = {'numpy', 'scipy', 'cv2', 'astropy', 'matplotlib', 'trimesh', 'pydantic', 'pyarrow', 'spiceypy'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_campaign_runs_and_prints_its_summary_as_json_and_nothing_else(small: tuple[Path, dict[str, Truth]]) -> None:
    path, _ = small
    result = giantlike("run", path, "--workers", "1", "--json")
    assert result.exit_code == 0, result.stderr
    summary = json.loads(result.stdout)
    assert summary["images"] == 3
    assert summary["failed_images"] == []
    assert summary["attitudes"]["ok"] == 3
    assert {row["estimator"]: row["ok"] for row in summary["observations"]} == {
        "cross_correlation": 1,
        "limb_matching": 1,
    }
    kept = json.loads(giantlike("run", path, "--workers", "1", "--json").stdout)["steps"]
    assert kept["PEBBLE: limb_matching"] == {"redone": 0, "kept": 1}
    again = giantlike("run", path, "--workers", "1", "--resume")
    assert again.exit_code == 0
    assert "limb_matching" in again.stdout
    assert "report.html" in again.stdout
    assert json.loads(giantlike("report", path.parent / "run", "--json").stdout)["report"].endswith("report.html")


def test_failed_images_make_exit_code_one(tmp_path: Path) -> None:
    (tmp_path / "broken.fits").write_text("nothing")
    CAMERA.save(tmp_path / "camera.toml")
    table = campaign_table()
    content = {key: table[key] for key in ("campaign", "camera", "stars")} | {"images": {"files": ["*.fits"]}}
    (tmp_path / "campaign.toml").write_text(tomli_w.dumps(content))
    result = giantlike("run", tmp_path / "campaign.toml", "--workers", "1", "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["failed_images"] == ["broken.fits"]


def test_mistakes_end_in_one_line_that_names_the_file_and_exit_code_two(tmp_path: Path) -> None:
    assert "none.toml" in line_on_stderr(giantlike("run", tmp_path / "none.toml"))
    (tmp_path / "bad.toml").write_text("[campaign]\nname = 'x'\noutput = 'y'\ncolor = 'red'\n")
    assert "unknown key campaign.color" in line_on_stderr(giantlike("run", tmp_path / "bad.toml", "--json"))
    assert str(tmp_path) in line_on_stderr(giantlike("report", tmp_path))
    assert "--camera" in line_on_stderr(giantlike("stars", "a.fits"))
    assert "--fov" in line_on_stderr(giantlike("stars", "a.fits", "--fov", "200"))
    assert "cam.toml" in line_on_stderr(giantlike("stars", "a.fits", "--camera", tmp_path / "cam.toml"))
    assert "no earlier demonstration" in line_on_stderr(giantlike("demo", "--output", tmp_path))
    assert giantlike("run").exit_code == 2
    assert giantlike("fly").exit_code == 2


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--fov", "12", "--max-magnitude", "nan"), "max_magnitude"),
        (("--camera", "camera.toml", "--max-magnitude", "inf"), "max_magnitude"),
        (("--fov", "12", "--fov-error", "21"), "--fov-error"),
        (("--fov", "12", "--fov-error", "nan"), "--fov-error"),
        (("--camera", "camera.toml", "--fov-error", "30"), "--fov-error 30 goes with --fov"),
        (("--camera", "camera.toml", "--fov-error", "5"), "--fov-error 5 goes with --fov"),
        (("--camera", "camera.toml", "--fov", "12"), "either --camera"),
    ],
)
def test_a_wrong_option_of_stars_is_a_mistake_and_not_an_unreadable_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], complaint: str
) -> None:
    monkeypatch.chdir(tmp_path)
    CAMERA.save(tmp_path / "camera.toml")
    write_fits(tmp_path / "flat.fits", np.zeros((CAMERA.rows, CAMERA.columns), np.uint16))
    assert complaint in line_on_stderr(giantlike("stars", "flat.fits", *options))


def test_stars_are_solved_with_a_camera_file_lost_in_space(small: tuple[Path, dict[str, Truth]]) -> None:
    path, truth = small
    image = path.parent / "images" / "visit0_a_long.fits"
    result = giantlike("stars", image, "--camera", path.parent / "camera.toml", "--max-magnitude", "7", "--json")
    assert result.exit_code == 0, result.output
    (answer,) = json.loads(result.stdout)
    assert list(answer)[:9] == STAR_KEYS
    assert (answer["file"], answer["status"], answer["reason"]) == (str(image), "ok", None)
    assert answer["fov_deg"] == CAMERA.fov_deg
    center = CAMERA.model.unproject(CAMERA.center_px)
    expected = pointing_deg(truth[image.name].camera_from_inertial, center)
    separation = separation_deg(answer, expected[0], expected[1])
    assert separation < POINTING_DEG
    assert abs(answer["roll_deg"] - expected[2]) < 10 * POINTING_DEG


def test_images_without_stars_fail_with_a_reason_and_never_an_attitude(tmp_path: Path) -> None:
    noise = np.random.default_rng(3).poisson(400.0, (200, 240)).astype(np.uint16)
    write_fits(tmp_path / "noise.fits", noise)
    (tmp_path / "text.fits").write_text("no image")
    result = giantlike("stars", tmp_path / "noise.fits", tmp_path / "text.fits", "--fov", "12", "--json")
    assert result.exit_code == 1
    answers = json.loads(result.stdout)
    assert [answer["status"] for answer in answers] == ["failed", "failed"]
    assert answers[1]["reason"] == "unreadable_image"
    for answer in answers:
        assert answer["reason"]
        assert answer["detail"]
        assert [answer[key] for key in STAR_KEYS[3:]] == [None] * 6
    people = giantlike("stars", tmp_path / "text.fits", "--fov", "12").stdout
    assert "unreadable_image" in people


@pytest.mark.real_data
def test_night_sky_images_are_solved_from_a_rough_field_of_view(data_dir: Path) -> None:
    import csv

    with (data_dir / "stars" / "reference.csv").open(newline="") as stream:
        reference = {row["file"]: row for row in csv.DictReader(stream)}
    images = sorted((data_dir / "stars" / "tetra3").glob("*.tiff"))
    result = giantlike("stars", *images, "--fov", "11.4", "--lost-in-space", "--json")
    assert result.exit_code == 0, result.output
    for answer in json.loads(result.stdout):
        expected = reference[f"tetra3/{Path(answer['file']).name}"]
        assert separation_deg(answer, float(expected["ra_deg"]), float(expected["dec_deg"])) < REFERENCE_DEG
        assert abs(answer["fov_deg"] / float(expected["fov_x_deg"]) - 1) < REFERENCE_FOV
        assert answer["n_matched"] >= 40


def separation_deg(answer: dict[str, Any], ra_deg: float, dec_deg: float) -> float:
    found = direction_from_radec(answer["ra_deg"], answer["dec_deg"])
    expected = direction_from_radec(ra_deg, dec_deg)
    return float(np.degrees(np.linalg.norm(np.cross(found, expected))))


# --- killed runs -----------------------------------------------------------------------------------------------------


def start(path: Path, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "giantlike", "run", str(path), *arguments]
    before = signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # a background job ignores it, and so would the run
    try:
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    finally:
        signal.signal(signal.SIGINT, before)


def images_done(run: Path) -> int:
    """Number of images whose attitude the run folder holds, read while the run writes."""
    return len(RunFolder(run).keys(AttitudeRecord))


def wait_for_images(run: Path, count: int, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 60
    while images_done(run) < count:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


def children_of(pid: int) -> list[int]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found.append(int(stat.parent.name))
    return found


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def tables(run: Path) -> list[str]:
    return [
        re.sub(r",[^,\n]*$", "", (run / f"{name}.csv").read_text(), flags=re.M)
        for name in ("attitudes", "observations")
    ]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes through /proc")
def test_a_run_killed_without_warning_leaves_no_process_behind_and_can_be_continued(tmp_path: Path) -> None:
    path, _ = write_campaign(tmp_path / "killed", visits=4)
    run = path.parent / "run"
    process = start(path, "--workers", "2")
    wait_for_images(run, 2, process)
    children = children_of(process.pid)
    assert children
    process.kill()
    process.communicate()
    deadline = time.monotonic() + 20
    while any(is_alive(child) for child in children):
        assert time.monotonic() < deadline, "worker processes live on after the run was killed"
        time.sleep(0.05)
    assert not (run / "attitudes.csv").exists()
    done = images_done(run)
    assert giantlike("run", path, "--workers", "1", "--resume").exit_code == 0
    log = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    starts = [number for number, line in enumerate(log) if line["event"] == "run_started"]
    assert sum(line["event"] == "image" for line in log[starts[1] :]) == 12 - done
    killed = tables(run)
    table = campaign_table()
    table["campaign"]["output"] = "whole"
    path.write_text(tomli_w.dumps(table))
    assert giantlike("run", path, "--workers", "1").exit_code == 0
    assert tables(path.parent / "whole") == killed


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_an_interrupted_run_ends_with_one_line_and_exit_code_130(tmp_path: Path) -> None:
    path, _ = write_campaign(tmp_path / "interrupted", visits=2)
    process = start(path, "--workers", "1")
    wait_for_images(path.parent / "run", 1, process)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert stdout == ""
    assert stderr == "giantlike: interrupted; what is finished is kept\n"
