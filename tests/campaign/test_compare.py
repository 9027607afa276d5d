"""Runs beside each other and beside files of other teams: differences, combined sigmas, and errors that both share."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import spiceypy
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner, Result

from giantlike.campaign.compare.differences import ResultComparison
from giantlike.campaign.compare.external import ExternalOptions, compare_external
from giantlike.campaign.compare.runs import compare_runs
from giantlike.campaign.export import ExportFormat, ExportOptions, export_run
from giantlike.campaign.merge import merge_runs
from giantlike.campaign.store.database import KnownImage
from giantlike.campaign.store.edits import Edit, Edited, add_edits
from giantlike.campaign.store.records import Attitude, AttitudeRecord, ObservationRecord
from giantlike.campaign.store.results import load_result
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.campaign.watch import watch_campaign
from giantlike.cli.app import app
from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.errors import InputError
from giantlike.core.frames import radec_from_direction, rotate
from giantlike.core.time import time_from_et, utc_text
from giantlike.core.units import ARCSEC_PER_RAD
from tests.campaign.test_export import CAMERA, START_ET, _attitude

N = 6
SIGMA_ARCSEC, NOISE_PX, SCALE_PX, RANGE_KM = 1.0, 0.1, 0.3, 500.0
ARCSEC = 1e-6  # arcsec: rounding of quaternions in float64 is 1e-10 rad at most
PIXEL = 1e-6  # px, likewise, at a scale of 3,000 px per rad, and 1e-10 of the range by the time of light


def run_with(
    folder: Path, *, turn_arcsec: float = 0.0, offset_px: float = 0.0, sha256: str = "", **inputs: Any
) -> Path:
    """A finished run of synthetic attitudes and fixes, as far from the truth as said."""
    given = {"camera": CAMERA.to_mapping(), "shapes_sha256": {"ROCK": "a"}, "catalog": "c",
             "options": {"targets": {"ROCK": {"reflectance": "McEwen()"}}}, "image_files": []}  # fmt: skip
    run = RunFolder.start(folder, given | inputs, {})
    for k in range(N):
        et = START_ET + 600.0 * k
        turned = Rotation.from_rotvec([turn_arcsec / ARCSEC_PER_RAD, 0.0, 0.0]) * _attitude(et)
        covariance = (np.eye(3) * (SIGMA_ARCSEC / ARCSEC_PER_RAD) ** 2).tolist()
        attitude = Attitude(
            source="stars", quaternion_xyzw=turned.as_quat().tolist(), covariance_rad2=covariance,
            parts={Cause.NOISE: covariance},
        )  # fmt: skip
        file = f"image_{k}.fits"
        run.save(
            AttitudeRecord(index=k, file=file, path=file, sha256=sha256 or f"{folder.name}{k}", columns=640, rows=480,
                           et=et, epoch_utc=utc_text(time_from_et(et)), status="ok", attitude=attitude),
            "key",
        )  # fmt: skip
        run.set_image_state(file, KnownImage("", sha256 or f"{folder.name}{k}"))
        center = place(k) + np.array([offset_px, 0.0])
        parts = {
            Cause.NOISE: np.diag([NOISE_PX**2, NOISE_PX**2, 1.0]).tolist(),
            Cause.SHAPE_SCALE: np.diag([SCALE_PX**2, SCALE_PX**2, 4.0]).tolist(),
        }
        total = np.sum([np.array(part) for part in parts.values()], axis=0)
        run.save(
            ObservationRecord(index=k, file=file, target="ROCK", estimator="limb_matching", status="ok", parts=parts,
                              attitude=attitude, center_px=center.tolist(), covariance_px2=total[:2, :2].tolist(),
                              covariance_with_attitude_px2=total[:2, :2].tolist(), predicted_px=center.tolist(),
                              range_km=RANGE_KM, sigma_range_km=float(np.sqrt(total[2, 2]))),
            "key",
        )  # fmt: skip
    content = run.provenance()
    run.write_provenance(
        content | {"run": {"name": "test", "hdu": None, "max_overlays": 0, "warnings": [], "time_s": 1.0}}
    )
    return folder


def position_inertial(k: int) -> Float:
    """Place of the body at image k, km: it moves through the field."""
    return rotate(_attitude(START_ET + 600.0 * k).inv(), [5.0 * k - 10.0, 4.0, RANGE_KM])


def place(k: int) -> Float:
    """Pixel of the body in image k."""
    return CAMERA.model.project(rotate(_attitude(START_ET + 600.0 * k), position_inertial(k)))


def rows(comparison: ResultComparison) -> dict[tuple[str, str], dict[str, Any]]:
    return {(row["what"], row["axis"]): row for row in comparison.summary()["differences"]}


def giantlike(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


# --- two runs --------------------------------------------------------------------------------------------------------


def test_runs_of_other_images_of_the_same_scene_share_the_shape_and_not_the_noise(tmp_path: Path) -> None:
    one = run_with(tmp_path / "one", turn_arcsec=2.0, offset_px=0.4)
    found = compare_runs(one, run_with(tmp_path / "two"))
    attitude, center = rows(found)["attitude", "x"], rows(found)["ROCK: limb_matching", "x"]
    assert attitude["mean"] == pytest.approx(2.0, abs=ARCSEC)
    assert attitude["median_sigma"] == pytest.approx(np.sqrt(2.0) * SIGMA_ARCSEC, rel=1e-9)
    assert attitude["rms_over_sigma"] == pytest.approx(np.sqrt(2.0), rel=1e-6)
    assert (center["n"], center["mean"]) == (N, pytest.approx(0.4, abs=PIXEL))
    assert center["median_sigma"] == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=1e-9)
    assert "ROCK: shape, its scale, pole and spin (the same file)" in found.shared
    assert not any("same image files" in text for text in found.shared)


def test_runs_of_the_same_images_with_another_shape_share_the_noise_and_not_the_shape(tmp_path: Path) -> None:
    one = run_with(tmp_path / "one", offset_px=0.4, sha256="same")
    found = compare_runs(one, run_with(tmp_path / "two", sha256="same", shapes_sha256={"ROCK": "b"}))
    center = rows(found)["ROCK: limb_matching", "x"]
    assert center["median_sigma"] == pytest.approx(np.sqrt(2.0) * SCALE_PX, rel=1e-9)
    assert (
        "noise, background and markings of bodies (the same image files; in part, where options differ)" in found.shared
    )
    assert not any("shape" in text for text in found.shared)
    # The attitudes have nothing but noise, which both share: no sigma is left, and no ratio.
    assert rows(found)["attitude", "x"]["rms_over_sigma"] is None


def test_runs_without_a_common_image_are_refused(tmp_path: Path) -> None:
    one, two = run_with(tmp_path / "one"), tmp_path / "two"
    run = RunFolder.start(two, {}, {})
    run.save(AttitudeRecord(index=0, file="other.fits", path="x", status="failed"), "key")
    run.write_provenance(run.provenance() | RunFolder(one).provenance())
    with pytest.raises(InputError, match="no image of one is in the other"):
        compare_runs(one, two)


# --- files of another team -------------------------------------------------------------------------------------------


def test_attitudes_of_a_table_and_of_a_c_kernel_differ_by_what_they_were_turned(tmp_path: Path) -> None:
    run, truth = run_with(tmp_path / "run", turn_arcsec=3.0), run_with(tmp_path / "truth")
    export_run(truth, tmp_path / "theirs.csv", ExportFormat.CSV)
    found = rows(compare_external(run, tmp_path / "theirs.csv"))
    assert found["attitude", "x"]["mean"] == pytest.approx(3.0, abs=ARCSEC)
    assert found["attitude", "x"]["median_sigma"] == pytest.approx(np.sqrt(2.0), rel=1e-9)
    header, *lines = (tmp_path / "theirs.csv").read_text().splitlines()
    untimed = [",".join([cells[0], "", "", *cells[3:]]) for line in lines if (cells := line.split(","))]
    (tmp_path / "untimed.csv").write_text("\n".join([header, *untimed]) + "\n")
    by_name = rows(compare_external(run, tmp_path / "untimed.csv"))
    assert by_name["attitude", "x"]["n"] == N
    assert by_name["attitude", "x"]["mean"] == pytest.approx(3.0, abs=ARCSEC)
    options = ExportOptions(instrument_id=-999001, frame_name="GL_TEST_CAM", max_gap_s=1e4)
    files = export_run(truth, tmp_path / "theirs.bc", ExportFormat.CK, options).files
    others = tuple(str(file) for file in files if file.suffix != ".bc")
    compared = compare_external(run, tmp_path / "theirs.bc", ExternalOptions(kernels=others, frame="GL_TEST_CAM"))
    assert (rows(compared)["attitude", "x"]["n"], spiceypy.ktotal("ALL")) == (N, 0)
    assert rows(compared)["attitude", "x"]["mean"] == pytest.approx(3.0, abs=1e-3)  # clock ticks of 1e-5 s
    assert any("state no covariance" in note or "states no covariance" in note for note in compared.notes)


def test_observables_of_a_table_are_matched_by_image_or_by_time(tmp_path: Path) -> None:
    run = run_with(tmp_path / "run", offset_px=0.5)
    with (tmp_path / "by_name.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["file", "target", "x_px", "y_px", "sigma_x_px", "sigma_y_px", "range_km"])
        for k in range(N - 1):
            writer.writerow([f"image_{k}.fits", "ROCK", *place(k), 0.2, 0.2, RANGE_KM + 2.0])
        writer.writerow(["another.fits", "ROCK", 1.0, 2.0, 0.2, 0.2, ""])
    found = compare_external(run, tmp_path / "by_name.csv")
    center, distance = rows(found)["ROCK: limb_matching", "x"], rows(found)["ROCK: limb_matching", "range"]
    assert (center["n"], center["mean"]) == (N - 1, pytest.approx(0.5, abs=PIXEL))
    assert center["median_sigma"] == pytest.approx(np.sqrt(NOISE_PX**2 + SCALE_PX**2 + 0.2**2), rel=1e-9)
    assert distance["mean"] == pytest.approx(-2.0, abs=1e-9)
    assert found.only_second == 1
    with (tmp_path / "by_time.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["epoch_utc", "ra_deg", "dec_deg", "sigma_arcsec"])
        for k in range(N):
            ra, dec = radec_from_direction(position_inertial(k) / np.linalg.norm(position_inertial(k)))
            writer.writerow([utc_text(time_from_et(START_ET + 600.0 * k)), ra, dec, 10.0])
    center = rows(compare_external(run, tmp_path / "by_time.csv"))["ROCK: limb_matching", "x"]
    assert (center["n"], center["mean"]) == (N, pytest.approx(0.5, abs=PIXEL))


def test_angles_of_a_tdm_and_a_reconstructed_trajectory_give_the_same_offset(tmp_path: Path) -> None:
    run = run_with(tmp_path / "run", offset_px=0.5)
    lines = ["CCSDS_TDM_VERS = 2.0", "META_START", "TIME_SYSTEM = UTC", "PARTICIPANT_1 = CAM", "PARTICIPANT_2 = ROCK",
             "ANGLE_TYPE = RADEC", "REFERENCE_FRAME = ICRF", "META_STOP", "DATA_START"]  # fmt: skip
    for k in range(N):
        ra, dec = radec_from_direction(position_inertial(k) / np.linalg.norm(position_inertial(k)))
        epoch = utc_text(time_from_et(START_ET + 600.0 * k))
        lines += [f"ANGLE_1 = {epoch} {ra:.12f}", f"ANGLE_2 = {epoch} {dec:.12f}"]
    (tmp_path / "theirs.tdm").write_text("\n".join([*lines, "DATA_STOP"]) + "\n")
    center = rows(compare_external(run, tmp_path / "theirs.tdm"))["ROCK: limb_matching", "x"]
    assert (center["n"], center["mean"]) == (N, pytest.approx(0.5, abs=PIXEL))
    lines.insert(2, "COMMENT angles: stellar aberration is removed, light time is not")
    (tmp_path / "astrometric.tdm").write_text("\n".join([*lines, "DATA_STOP"]) + "\n")
    with pytest.raises(InputError, match="--angles apparent"):  # not off by up to 20 arcsec
        compare_external(run, tmp_path / "astrometric.tdm")
    _write_trajectory(tmp_path / "theirs.bsp")
    options = ExternalOptions(spacecraft="-999", body="2000999")
    compared = compare_external(run, tmp_path / "theirs.bsp", options)
    center, distance = (rows(compared)["ROCK: limb_matching", axis] for axis in ("x", "range"))
    # The spacecraft is at rest: no aberration; the body's motion during the light time of 2 ms is 0.02 m of 500 km.
    assert (center["n"], center["mean"]) == (N, pytest.approx(0.5, abs=1e-3))
    assert distance["largest"] < 0.3  # km: the range of the body varies by its way through the field


def _write_trajectory(path: Path) -> None:
    """A body that is where the images show it, as seen from a spacecraft at rest at the barycenter."""
    times = START_ET + 600.0 * np.arange(-1.0, N + 1.0)
    places = np.array([position_inertial(k) for k in range(-1, N + 1)])
    velocities = np.gradient(places, 600.0, axis=0)
    handle = spiceypy.spkopn(str(path), "test", 0)
    states = np.hstack([places, velocities])
    spiceypy.spkw09(
        handle, 2000999, 0, "J2000", times[0], times[-1], "body", 1, len(times), states.tolist(), times.tolist()
    )
    still = np.zeros_like(states)
    spiceypy.spkw09(
        handle, -999, 0, "J2000", times[0], times[-1], "craft", 1, len(times), still.tolist(), times.tolist()
    )
    spiceypy.spkcls(handle)


def test_compare_at_the_shell_prints_a_table_and_names_what_is_shared(tmp_path: Path) -> None:
    one, two = run_with(tmp_path / "one", offset_px=0.4), run_with(tmp_path / "two")
    shown = giantlike("compare", one, two, "--output", tmp_path / "all.csv")
    assert shown.exit_code == 0, shown.stderr
    assert "both share: ROCK: shape, its scale, pole and spin (the same file)" in shown.stdout
    assert len((tmp_path / "all.csv").read_text().splitlines()) == 1 + N * (3 + 2 + 1)
    assert json.loads(giantlike("compare", one, two, "--json").stdout)["differences"][0]["n"] == N
    assert "give another run folder, or a" in giantlike("compare", one, tmp_path / "x.docx").stderr


# --- merge and watch -------------------------------------------------------------------------------------------------


def test_parts_of_a_campaign_become_one_run_with_their_edits(tmp_path: Path) -> None:
    one, two = run_with(tmp_path / "one", sha256="same"), run_with(tmp_path / "two", sha256="same")
    whole = load_result(one)
    parts = {one: range(N // 2), two: range(N // 2, N)}
    for run, part in parts.items():
        RunFolder(run).set_images([(f"image_{k}.fits", f"image_{k}.fits") for k in part])
    last = f"image_{N - 1}.fits"
    add_edits(two, [Edit(action="reject", what=Edited.IMAGE, file=last, who="ann", when_utc="2026", why="smear")])
    merged = merge_runs([two, one], tmp_path / "merged")
    assert [record.file for record in merged.attitudes] == [f"image_{k}.fits" for k in (3, 4, 5, 0, 1, 2)]
    assert {r.file for r in merged.attitudes if r.status == "failed"} == {last}
    fixes = {record.file: record.center_px for record in merged.observations if record.center_px}
    assert fixes == {r.file: r.center_px for r in whole.observations if r.file != last}
    assert (tmp_path / "merged" / "observations.csv").exists()
    assert merged.attitudes[0].path == "../two/image_3.fits"
    with pytest.raises(InputError, match="not empty"):
        merge_runs([one, two], tmp_path / "merged")


def test_runs_that_do_not_belong_together_are_not_merged(tmp_path: Path) -> None:
    one, other = run_with(tmp_path / "one"), run_with(tmp_path / "two", catalog="another")
    with pytest.raises(InputError, match="differ in catalog"):
        merge_runs([one, other], tmp_path / "merged")
    with pytest.raises(InputError, match=r"'image_0\.fits' is another image in each"):
        merge_runs([one, run_with(tmp_path / "three")], tmp_path / "merged")


class Ended(Exception):
    """Ends the watch of a test."""


def test_watching_runs_again_when_an_image_arrives_and_waits_for_the_first(tmp_path: Path) -> None:
    CAMERA.save(tmp_path / "camera.toml")
    path, ran, told, looks = tmp_path / "campaign.toml", list[int](), list[str](), 0
    path.write_text(
        '[campaign]\nname = "a"\noutput = "run"\n[images]\nfiles = ["*.fits"]\n[camera]\nfile = "camera.toml"\n'
    )
    run = run_with(tmp_path / "done")

    def wait(_: float) -> None:
        nonlocal looks
        looks += 1
        if looks in (2, 4):
            (tmp_path / f"{looks}.fits").write_text("an image")
        if looks == 6:
            raise Ended

    def do(campaign: Any) -> Any:
        ran.append(len(campaign.images))
        return load_result(run)

    with pytest.raises(Ended):
        watch_campaign(path, do, every_s=1.0, announce=told.append, wait=wait)
    assert ran == [1, 2]
    assert told[0].startswith("waiting: ")
    assert "no file matches" in told[0]
    assert len(told) == 3
