"""Text files written by grammars: keys that are right with values that are not, rows of any length, deep structures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from giantlike.camera import Camera
from giantlike.core.errors import OpNavError
from giantlike.io import read_ephemeris_table, read_geometry
from giantlike.io.camera_import import read_foreign_camera
from giantlike.io.image_files import read_image_file
from giantlike.shapes import load_shape
from giantlike.stars.rates import read_rates

EXAMPLES = 40
_CHECKS = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
_NUMBER_TEXT = st.one_of(
    st.integers(-(2**70), 2**70).map(str),
    st.floats(width=64).map(repr),
    st.sampled_from(
        ["", "-", "+", "1e", "1d5", "1_0", "0x10", "１", "1,5", "1e999", "NaN", "inf", "''", "\x00", "9" * 400]
    ),
)
_WORD = st.text(st.characters(codec="utf-8", exclude_characters="\r\n"), max_size=12)
_END = st.sampled_from(["\n", "\r\n", "\r", "\n\n", ""])


def _quietly(read: Any, path: Path) -> None:
    """Read a file, which may be refused in one line."""
    text = path.name
    try:
        read(path)
    except OpNavError as error:
        text = str(error)
    assert "\n" not in text
    assert path.name in text


_TOML = st.recursive(
    st.one_of(st.integers(-(2**63), 2**63 - 1), st.floats(), st.booleans(), _WORD),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(_WORD, inner, max_size=3),
    max_leaves=6,
)
_CAMERA_KEYS = {
    "": ["name", "columns", "rows", "model", "psf", "detector", "frame", "uncertainty", "format"],
    "model": ["type", "fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "temperature", "alpha"],
    "psf": ["type", "sigma_px", "sigma_x_px", "sigma_y_px", "angle_deg"],
    "detector": ["gain_e_per_dn", "read_noise_e", "saturation_dn", "bias_dn", "bits"],
}


@pytest.mark.parametrize("table", list(_CAMERA_KEYS))
@_CHECKS
@given(data=st.data())
def test_camera_files_with_any_value_under_a_known_key(tmp_path: Path, table: str, data: st.DataObject) -> None:
    content: dict[str, Any] = {
        "name": "c", "columns": 8, "rows": 8, "psf": {"type": "gaussian", "sigma_px": 0.8},
        "model": {"type": "pinhole", "fx_px": 10.0, "fy_px": 10.0, "cx_px": 4.0, "cy_px": 4.0},
        "detector": {"gain_e_per_dn": 1.0},
    }  # fmt: skip
    changed = data.draw(st.dictionaries(st.sampled_from(_CAMERA_KEYS[table]), _TOML, min_size=1, max_size=3))
    (content[table] if table else content).update(changed)
    path = tmp_path / "camera.toml"
    path.write_text(tomli_w.dumps(content), encoding="utf-8")
    _quietly(Camera.load, path)


_TABLES = {
    "orbit": (read_ephemeris_table, "epoch_utc,x_km,y_km,z_km,vx_km_s,vy_km_s,vz_km_s"),
    "gyro": (read_rates, "epoch_utc,rate_x_rad_s,rate_y_rad_s,rate_z_rad_s"),
    "geometry": (read_geometry, "file,epoch_utc,exposure_s,qx,qy,qz,qw,target,target_x_km,target_y_km,target_z_km"),
}


@pytest.mark.parametrize("kind", list(_TABLES))
@_CHECKS
@given(data=st.data())
def test_tables_with_any_cells_ends_and_encodings(tmp_path: Path, kind: str, data: st.DataObject) -> None:
    read, header = _TABLES[kind]
    n_columns = header.count(",") + 1
    cell = st.one_of(_NUMBER_TEXT, _WORD, st.just("2020-01-01T00:00:00"), st.just('"'), st.just('a"b,c'))
    rows = data.draw(st.lists(st.lists(cell, min_size=n_columns - 1, max_size=n_columns + 1), max_size=4))
    end = data.draw(_END)
    text = data.draw(st.sampled_from(["", "\ufeff", "#"])) + end.join([header, *(",".join(row) for row in rows)]) + end
    path = tmp_path / f"{kind}.csv"
    path.write_bytes(text.encode(data.draw(st.sampled_from(["utf-8", "utf-16", "utf-32"])), errors="replace"))
    _quietly(read, path)


@_CHECKS
@given(data=st.data())
def test_shapes_in_text_with_any_words_and_indices(tmp_path: Path, data: st.DataObject) -> None:
    words = st.lists(_NUMBER_TEXT | st.sampled_from(["1", "2", "3", "4", "-1", "1/2/3", "1//3", "0.5"]), max_size=5)
    kinds = st.sampled_from(
        ["v", "f", "vt", "#", "o", "", "facet normal", "vertex", "outer loop", "endloop", "solid x"]
    )
    lines = data.draw(st.lists(st.tuples(kinds, words), max_size=12))
    text = data.draw(_END).join(" ".join([kind, *parts]) for kind, parts in lines)
    path = tmp_path / data.draw(st.sampled_from(["s.obj", "s.stl", "s.tab", "s.icq"]))
    path.write_text(data.draw(st.sampled_from(["", "4 4\n", "1\n"])) + text, encoding="utf-8", errors="replace")
    _quietly(load_shape, path)


_PDS3 = "RECORD_BYTES ^IMAGE LINES LINE_SAMPLES SAMPLE_BITS SAMPLE_TYPE OBJECT END_OBJECT RECORD_TYPE BANDS"
_VICAR = "FORMAT NL NS NB RECSIZE NLB NBB ORG INTFMT REALFMT TYPE"
_LABELS = {
    "a.img": ("PDS_VERSION_ID = PDS3\r\n", _PDS3.split(), "\r\n"),
    "a.vic": ("LBLSIZE=400 ", _VICAR.split(), "  "),
}


@pytest.mark.parametrize("name", list(_LABELS))
@_CHECKS
@given(data=st.data())
def test_labels_of_images_with_any_values(tmp_path: Path, name: str, data: st.DataObject) -> None:
    begin, keys, end = _LABELS[name]
    value = st.one_of(
        _NUMBER_TEXT, _WORD, st.sampled_from(["IMAGE", "'BYTE'", "8", "24", "(1, 2)", '"x', "<BYTES>", "BSQ"])
    )
    items = data.draw(st.lists(st.tuples(st.sampled_from(keys), value), max_size=14))
    text = begin + end.join(f"{key}={item}" for key, item in items) + end + "END" + end
    path = tmp_path / name
    path.write_bytes(text.encode("utf-8", errors="replace").ljust(400) + bytes(data.draw(st.integers(0, 2000))))
    _quietly(read_image_file, path)


_MAPS = st.recursive(
    _NUMBER_TEXT | _WORD | st.sampled_from(["!!opencv-matrix", "[ 1., 2. ]", "&a *a", "|\n  x", "{", "- 1", "? x"]),
    lambda inner: st.dictionaries(st.sampled_from(["rows", "cols", "dt", "data", "x"]), inner, max_size=4).map(
        lambda table: "".join(f"\n   {key}: {value}" for key, value in table.items())
    ),
    max_leaves=6,
)


@_CHECKS
@given(
    keys=st.lists(st.sampled_from(["camera_matrix", "distortion_coefficients", "image_width", "image_height", "x"])),
    values=st.lists(_MAPS, min_size=5, max_size=5),
    head=st.sampled_from(["%YAML:1.0\n---\n", "%YAML 1.2\n---\n", "", "<opencv_storage>"]),
)
def test_camera_files_in_yaml_with_any_structure(tmp_path: Path, keys: list[str], values: list[str], head: str) -> None:
    path = tmp_path / "camera.yml"
    text = head + "\n".join(f"{key}: {value}" for key, value in zip(keys, values, strict=False)) + "\n"
    path.write_text(text, encoding="utf-8", errors="replace")
    _quietly(lambda file: read_foreign_camera(file, instrument_id=None), path)


_CARDS = ["NAXIS", "NAXIS1", "NAXIS2", "BITPIX", "BZERO", "BSCALE", "EXTEND", "BLANK", "XTENSION", "SIMPLE", "GCOUNT"]


@_CHECKS
@given(
    cards=st.lists(
        st.tuples(
            st.sampled_from(_CARDS),
            _NUMBER_TEXT | st.sampled_from(["T", "F", "2147483647", "99999999", "'IMAGE   '", "-64", "16"]),
        ),
        max_size=8,
    )
)
def test_fits_headers_with_any_cards(tmp_path: Path, cards: list[tuple[str, str]]) -> None:
    lines = [("SIMPLE", "T"), ("BITPIX", "8"), ("NAXIS", "2"), ("NAXIS1", "8"), ("NAXIS2", "8"), *cards]
    kept = dict(lines)  # the last value of a key at the place of the first
    text = "".join(f"{key:<8}= {value:>20}".ljust(80)[:80] for key, value in kept.items()) + "END".ljust(80)
    path = tmp_path / "a.fits"
    path.write_bytes(text.encode("ascii", errors="replace").ljust(2880) + bytes(2880))
    _quietly(read_image_file, path)
