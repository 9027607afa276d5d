"""Geometry and ephemeris tables, and the atomic writing beneath them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from giantlike._system.atomic import write_bytes_atomic, write_text_atomic
from giantlike.core.errors import DataError
from giantlike.core.frames import rotate, rotation_between
from giantlike.core.observer import ObserverState
from giantlike.core.time import et_from_time, time_from_utc, utc_text
from giantlike.io import read_ephemeris_table, read_geometry, write_geometry
from giantlike.io.geometry_table import COLUMNS, GeometryRow
from tests.tolerances import EPOCH_S, FLOAT64_DIGIT

CONTRACT = (
    "file,epoch_utc,exposure_s,qx,qy,qz,qw,target,target_x_km,target_y_km,target_z_km,"
    "body_qx,body_qy,body_qz,body_qw,sun_x,sun_y,sun_z"
)
ROW = "a.fits,2018-12-01T10:07:11.5,0.25,0,0,0.6,0.8,BENNU,1,2,3,0.5,0.5,0.5,0.5,0,0,-1"


def table(path: Path, *lines: str, header: str = CONTRACT) -> Path:
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


def cells(**changes: str) -> str:
    """The example row with some of its cells changed."""
    return ",".join((dict(zip(CONTRACT.split(","), ROW.split(","), strict=True)) | changes).values())


def refusal(path: Path) -> str:
    """The one line in which a geometry table is refused."""
    with pytest.raises(DataError) as caught:
        read_geometry(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    return text


# ----------------------------------------------------------------------------------------- geometry


def test_the_columns_are_those_of_the_campaign_contract_the_observer_and_the_targets_velocity() -> None:
    assert ",".join(COLUMNS[:18]) == CONTRACT
    assert COLUMNS[18:24] == (*(f"observer_{x}_km" for x in "xyz"), *(f"observer_v{x}_km_s" for x in "xyz"))
    assert COLUMNS[24:] == tuple(f"target_v{x}_km_s" for x in "xyz")


def test_a_full_row_is_read_as_what_it_says(tmp_path: Path) -> None:
    (row,) = read_geometry(table(tmp_path / "g.csv", ROW)).rows
    assert (row.file, row.target, row.exposure_s, row.line) == ("a.fits", "BENNU", 0.25, 2)
    assert row.epoch is not None
    assert utc_text(row.epoch) == "2018-12-01T10:07:11.500000"
    assert row.camera_from_inertial is not None
    assert row.body_from_inertial is not None
    assert_array_equal(row.target_position_inertial_km, [1.0, 2.0, 3.0])
    assert_array_equal(row.sun_direction_inertial, [0.0, 0.0, -1.0])
    # scalar last: 2 acos(0.8) about z takes x to (0.28, 0.96, 0); 120 degrees about (1, 1, 1) takes x to y
    assert_allclose(rotate(row.camera_from_inertial, [1.0, 0.0, 0.0]), [0.28, 0.96, 0.0], rtol=0, atol=FLOAT64_DIGIT)
    assert_allclose(rotate(row.body_from_inertial, [1.0, 0.0, 0.0]), [0.0, 1.0, 0.0], rtol=0, atol=FLOAT64_DIGIT)


def test_every_column_but_file_may_be_absent_or_empty(tmp_path: Path) -> None:
    absent = read_geometry(table(tmp_path / "a.csv", "a.fits", header="file")).rows[0]
    empty = read_geometry(table(tmp_path / "b.csv", "a.fits" + "," * 17)).rows[0]
    for row in (absent, empty):
        names = [name for name in GeometryRow.__slots__ if name not in {"file", "line"}]
        assert [getattr(row, name) for name in names] == [None] * len(names)


def test_spaces_empty_lines_quotes_and_a_byte_order_mark_do_not_matter(tmp_path: Path) -> None:
    (tmp_path / "g.csv").write_bytes(b'\xef\xbb\xbffile , exposure_s\r\n\r\n"a, b.fits", 2 \r\n,\r\n')
    (row,) = read_geometry(tmp_path / "g.csv").rows
    assert (row.file, row.exposure_s, row.line) == ("a, b.fits", 2.0, 3)


@pytest.mark.parametrize(
    ("changes", "column", "value"),
    [
        ({"epoch_utc": "yesterday"}, "epoch_utc", "'yesterday'"),
        ({"exposure_s": "1,5".replace(",", ";")}, "exposure_s", "'1;5'"),
        ({"exposure_s": "-1"}, "exposure_s", "'-1'"),
        ({"exposure_s": "nan"}, "exposure_s", "'nan'"),
        ({"qx": "one"}, "qx", "'one'"),
        ({"qy": ""}, "qy", "''"),
        ({"qw": "0.9"}, "qx", "norm"),
        ({"target_y_km": "inf"}, "target_y_km", "'inf'"),
        ({"target_z_km": ""}, "target_z_km", "''"),
        ({"target_x_km": "0", "target_y_km": "0", "target_z_km": "0"}, "target_x_km", "zero"),
        ({"body_qw": ""}, "body_qw", "''"),
        ({"body_qx": "-1.5"}, "body_qx", "norm"),
        ({"sun_z": "-1.1"}, "sun_x", "1.1"),
        ({"target": ""}, "target", "''"),
        ({"file": ""}, "file", "''"),
    ],
)
def test_a_bad_cell_is_refused_with_file_line_column_and_value(
    tmp_path: Path, changes: dict[str, str], column: str, value: str
) -> None:
    text = refusal(table(tmp_path / "g.csv", cells(file="0.fits"), cells(**changes)))
    assert f"line 3, column {column}:" in text
    assert value in text


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", ["empty"]),
        ("file,qx,quality\n", ["line 1", "'quality'"]),
        ("file,qx,qx\n", ["line 1", "'qx'", "once"]),
        ("qx\n", ["line 1", "'file'", "missing"]),
        ("file,qx\na.fits\n", ["line 2", "2 cells", "got 1"]),
        ("file,qx\na.fits,1,2\n", ["line 2", "2 cells", "got 3"]),
        ('file,qx\n"a.fits,1\n', ["line 2", "CSV"]),
        ("file\n\xff\xfe\n", ["UTF-8"]),
    ],
)
def test_a_table_that_is_none_is_refused(tmp_path: Path, content: str, words: list[str]) -> None:
    (tmp_path / "g.csv").write_bytes(content.encode("latin-1"))
    text = refusal(tmp_path / "g.csv")
    assert all(word in text for word in words), text


def test_a_missing_table_is_refused(tmp_path: Path) -> None:
    assert "no such file" in refusal(tmp_path / "g.csv")


def test_two_rows_for_one_image_and_target_are_refused(tmp_path: Path) -> None:
    text = refusal(table(tmp_path / "g.csv", ROW, cells(target="SUN"), ROW))
    assert all(word in text for word in ("line 4", "line 2", "'BENNU'"))


@pytest.mark.parametrize(
    ("changes", "column"),
    [({"epoch_utc": "2018-12-01T10:07:12"}, "epoch_utc"), ({"exposure_s": "1"}, "exposure_s"), ({"qz": "-0.6"}, "qx")],
)
def test_rows_of_one_image_that_disagree_are_refused(tmp_path: Path, changes: dict[str, str], column: str) -> None:
    text = refusal(table(tmp_path / "g.csv", ROW, cells(target="SUN", **changes)))
    assert f"line 3, column {column}:" in text


def test_an_empty_target_means_the_only_one_where_that_is_known(tmp_path: Path) -> None:
    path = table(tmp_path / "g.csv", cells(target=""), "b.fits" + "," * 17)
    rows = read_geometry(path, default_target="EROS").rows
    assert [row.target for row in rows] == ["EROS", None]


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    generator = np.random.default_rng(2)
    state = ObserverState(position_km=generator.normal(size=3) * 1e8, velocity_km_s=generator.normal(size=3) * 20)
    rows = [GeometryRow(file="only.fits", observer=state), GeometryRow(file="a,b.fits", exposure_s=1e-5, target="X")]
    for k in range(30):
        sun = generator.normal(size=3)
        rows.append(
            GeometryRow(
                file=f"{k}.fits",
                epoch=time_from_utc(f"2018-12-01T10:07:11.{k:06d}"),
                exposure_s=float(generator.random()),
                camera_from_inertial=Rotation.random(rng=generator),
                target="BENNU",
                target_position_inertial_km=generator.normal(size=3) * 1e6,
                body_from_inertial=Rotation.random(rng=generator),
                sun_direction_inertial=sun / np.linalg.norm(sun),
            )
        )
    write_geometry(tmp_path / "g.csv", rows)
    again = read_geometry(tmp_path / "g.csv").rows
    assert [(r.file, r.target, r.exposure_s) for r in again] == [(r.file, r.target, r.exposure_s) for r in rows]
    read = again[0].observer
    assert read is not None
    assert_array_equal([read.position_km, read.velocity_km_s], [state.position_km, state.velocity_km_s])
    assert again[1].observer is None
    for old, new in zip(rows[2:], again[2:], strict=True):
        assert new.epoch is not None
        assert old.epoch is not None
        assert abs((new.epoch - old.epoch).to_value("s")) < EPOCH_S
        assert_array_equal(new.target_position_inertial_km, old.target_position_inertial_km)
        assert new.sun_direction_inertial is not None
        assert old.sun_direction_inertial is not None
        assert_allclose(new.sun_direction_inertial, old.sun_direction_inertial, rtol=0, atol=FLOAT64_DIGIT)
        for name in ("camera_from_inertial", "body_from_inertial"):
            assert np.linalg.norm(rotation_between(getattr(new, name), getattr(old, name))) < FLOAT64_DIGIT


def test_the_observer_of_an_image_is_told_once_and_whole(tmp_path: Path) -> None:
    header = "file,target,observer_x_km,observer_y_km,observer_z_km,observer_vx_km_s,observer_vy_km_s,observer_vz_km_s"
    geometry = read_geometry(table(tmp_path / "g.csv", "a.fits,X,1,2,3,4,5,6", "a.fits,Y,,,,,,", header=header))
    known = geometry.image("a.fits")
    assert known is not None
    assert known.observer is not None
    assert_array_equal(known.observer.velocity_km_s, [4.0, 5.0, 6.0])
    assert "observer_vz_km_s" in refusal(table(tmp_path / "half.csv", "a.fits,X,1,2,3,4,5,", header=header))
    rows = ("a.fits,X,1,2,3,4,5,6", "a.fits,Y,1,2,3,4,5,7")
    assert "line 3, column observer_x_km" in refusal(table(tmp_path / "two.csv", *rows, header=header))


def test_images_are_found_by_base_name_with_all_their_targets(tmp_path: Path) -> None:
    geometry = read_geometry(
        table(tmp_path / "g.csv", ROW, "a.fits,,,,,,,SUN,4,5,6,,,,,,,", "b.fits,,,,,,,,,,,,,,,,,", "z.fits" + "," * 17)
    )
    a, b, c = (tmp_path / "images" / name for name in ("a.fits", "b.fits", "c.fits"))
    found = geometry.match([a, b, c], tmp_path)
    assert list(found) == [a, b]
    assert found[a].exposure_s == 0.25
    assert found[a].camera_from_inertial is not None
    assert set(found[a].targets) == {"BENNU", "SUN"}
    assert_array_equal(found[a].targets["SUN"].target_position_inertial_km, [4.0, 5.0, 6.0])
    assert found[b].epoch is None
    assert not found[b].targets
    image = geometry.image("a.fits")
    assert image is not None
    assert image.exposure_s == 0.25
    assert geometry.image("c.fits") is None


def test_a_base_name_that_two_images_share_needs_their_paths(tmp_path: Path) -> None:
    images = [tmp_path / "day1/a.fits", tmp_path / "day2/a.fits"]
    ambiguous = read_geometry(table(tmp_path / "g.csv", ROW))
    with pytest.raises(DataError, match=r"line 2, column file: 'a.fits' is the base name of 2 images") as caught:
        ambiguous.match(images, tmp_path)
    assert caught.value.path == tmp_path / "g.csv"
    clear = read_geometry(
        table(
            tmp_path / "g.csv", cells(file="day1/a.fits", exposure_s="1"), cells(file="./day2/a.fits", exposure_s="2")
        )
    )
    found = clear.match(images, tmp_path)
    assert [found[image].exposure_s for image in images] == [1.0, 2.0]


def test_a_path_wins_over_a_base_name_and_both_may_be_relative(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    geometry = read_geometry(
        table(tmp_path / "g.csv", cells(file="day1/a.fits", exposure_s="1"), cells(file="a.fits", exposure_s="2"))
    )
    found = geometry.match(["day1/a.fits", "day2/a.fits"], ".")
    assert [image.exposure_s for image in found.values()] == [1.0, 2.0]


# ---------------------------------------------------------------------------------------- ephemeris


def test_an_ephemeris_is_sorted_by_time_whatever_the_order_of_its_rows(tmp_path: Path) -> None:
    path = table(
        tmp_path / "e.csv",
        "2020-01-01T00:01:00,4,5,6,0.4,0.5,0.6,0,0,0,1",
        "2020-01-01T00:00:00Z,1,2,3,0.1,0.2,0.3,0,0,0.6,0.8",
        header="epoch_utc,x_km,y_km,z_km,vx_km_s,vy_km_s,vz_km_s,body_qx,body_qy,body_qz,body_qw",
    )
    samples = read_ephemeris_table(path)
    first = et_from_time(time_from_utc("2020-01-01T00:00:00"))
    assert_allclose(samples.et - first, [0.0, 60.0], rtol=0, atol=EPOCH_S)
    assert_array_equal(samples.position_km, [[1, 2, 3], [4, 5, 6]])
    assert_array_equal(samples.velocity_km_s, [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    assert samples.inertial_from_body is not None
    # the table holds body_from_inertial, as geometry.csv does
    assert_allclose(
        rotate(samples.inertial_from_body[0], [0.28, 0.96, 0.0]), [1.0, 0.0, 0.0], rtol=0, atol=FLOAT64_DIGIT
    )


def test_an_ephemeris_may_have_positions_only_and_seconds_for_epochs(tmp_path: Path) -> None:
    samples = read_ephemeris_table(table(tmp_path / "e.csv", "1,2,3,-5.5", header="x_km,y_km,z_km,et"))
    assert samples.et.tolist() == [-5.5]
    assert samples.position_km.tolist() == [[1.0, 2.0, 3.0]]
    assert samples.velocity_km_s is None
    assert samples.inertial_from_body is None


@pytest.mark.parametrize(
    ("header", "rows", "words"),
    [
        ("x_km,y_km,z_km", ["1,2,3"], ["line 1", "epoch_utc and et"]),
        ("et,epoch_utc,x_km,y_km,z_km", ["1,2020-01-01T00:00:00,1,2,3"], ["line 1", "not both"]),
        ("et,x_km,y_km", ["1,2,3"], ["'z_km'", "missing"]),
        ("et,x_km,y_km,z_km", [], ["no rows"]),
        ("et,x_km,y_km,z_km", ["0,1,2,3", "0,4,5,6"], ["line 3", "column et", "line 2"]),
        ("et,x_km,y_km,z_km", [",1,2,3"], ["line 2", "column et"]),
        ("epoch_utc,x_km,y_km,z_km", [",1,2,3"], ["line 2", "column epoch_utc"]),
        ("et,x_km,y_km,z_km", ["0,1,,3"], ["line 2", "column y_km"]),
        ("et,x_km,y_km,z_km", ["0,,,"], ["line 2", "column x_km"]),
        ("et,x_km,y_km,z_km,vx_km_s", ["0,1,2,3,4"], ["line 2", "column vy_km_s"]),
        ("et,x_km,y_km,z_km,body_qx,body_qy,body_qz,body_qw", ["0,1,2,3,1,1,1,1"], ["line 2", "body_qx", "norm"]),
        ("et,x_km,y_km,z_km,body_qx,body_qy,body_qz,body_qw", ["0,1,2,3,,,,"], ["line 2", "body_qx", "every row"]),
    ],
)
def test_a_bad_ephemeris_is_refused_with_its_line_and_column(
    tmp_path: Path, header: str, rows: list[str], words: list[str]
) -> None:
    path = table(tmp_path / "e.csv", *rows, header=header)
    with pytest.raises(DataError) as caught:
        read_ephemeris_table(path)
    assert all(word in str(caught.value) for word in [str(path), *words]), str(caught.value)


# ------------------------------------------------------------------------------------------- atomic


def test_a_write_replaces_the_file_and_leaves_nothing_else(tmp_path: Path) -> None:
    write_text_atomic(tmp_path / "a.txt", "old\n")
    write_text_atomic(tmp_path / "a.txt", "new é\n")
    write_bytes_atomic(tmp_path / "b.bin", b"\0\1")
    assert (tmp_path / "a.txt").read_bytes() == "new é\n".encode()
    assert (tmp_path / "b.bin").read_bytes() == b"\0\1"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.txt", "b.bin"]


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_text_atomic(tmp_path / "a.txt", "old")

    def full(self: Path, data: bytes) -> int:
        with self.open("wb") as file:
            file.write(data[:1])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(DataError, match=r"a.txt: cannot be written: No space left on device"):
        write_text_atomic(tmp_path / "a.txt", "new")
    monkeypatch.undo()
    assert (tmp_path / "a.txt").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_a_write_into_a_folder_that_is_not_there_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none/a.txt: cannot be written"):
        write_text_atomic(tmp_path / "none/a.txt", "x")
