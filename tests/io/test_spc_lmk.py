"""LMK files of stereophotoclinometry: what is written comes back, and other files are refused."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.core.errors import DataError, InputError
from giantlike.io.spc_lmk import Lmk, read_lmk, read_lmks, write_lmk
from giantlike.io.spc_sumfile import write_sumfile
from giantlike.observables import row_of_body, row_of_landmark
from giantlike.observables.exchange import sumfile_of
from tests.observables.test_rows import CAMERA, CONTEXT, SIGHTING, position_fix
from tests.observables.test_rows import LANDMARK as SEEN

LANDMARK = Lmk(
    name="AB0001",
    half_size=49,
    scale_km=0.00035,
    position_body_km=np.array([0.12, -0.2, 0.05]),
    body_from_local=Rotation.from_rotvec([0.3, -1.2, 0.7]),
    sigma_body_km=np.array([1e-5, 2e-5, 3e-5]),
    sigma_km=2e-5,
    rms_km=4e-5,
    pictures_px={"P000000001": np.array([0.0, 12.5]), "P000000002": np.array([1023.25, 4.125])},
    overlaps={"CD0002": np.array([0.001, -0.002, 0.0005])},
    limbs_px={"P000000003": np.array([100.0, 200.0])},
)


def test_what_is_written_comes_back(tmp_path: Path) -> None:
    write_lmk(tmp_path / "AB0001.LMK", LANDMARK)
    found = read_lmk(tmp_path / "AB0001.LMK")
    assert (found.body_from_local * LANDMARK.body_from_local.inv()).magnitude() < 1e-9
    for each in fields(Lmk):
        given, read = getattr(LANDMARK, each.name), getattr(found, each.name)
        if isinstance(given, dict):
            assert list(read) == list(given)
            for name in given:
                assert_allclose(read[name], given[name], rtol=0, atol=1e-8)
        elif each.name != "body_from_local":
            assert_allclose(read, given, rtol=1e-9) if not isinstance(given, str) else None
            assert type(read) is type(given)


def test_axes_are_the_lines_of_unit_vectors_and_pixels_count_from_one(tmp_path: Path) -> None:
    """Text in the words of the page: labels with commas, exponents with D, UZ outward."""
    text = """AB0001 T                                        NAME, HFLAG
      49      0.00035000                        SIZE, SCALE(KM)
      -1      -1      -1      -1                HORIZON
    0.2000000000D-04    0.4000000000D-04   SIGKM, RMSLMK
    0.2500000000D+00    0.0000000000D+00    0.0000000000D+00   VLM
    0.0000000000D+00    0.0000000000D+00   -0.1000000000D+01   UX
    0.0000000000D+00    0.1000000000D+01    0.0000000000D+00   UY
    0.1000000000D+01    0.0000000000D+00    0.0000000000D+00   UZ
    0.1000000000D-04    0.1000000000D-04    0.1000000000D-04   SIGMA_LMK
PICTURES
P000000001       1.000      13.500
MAP OVERLAPS
LIMB FITS
END FILE
"""
    path = tmp_path / "AB0001.LMK"
    path.write_text(text)
    found = read_lmk(path)
    assert_allclose(found.body_from_local.apply([0.0, 0.0, 1.0]), [1.0, 0.0, 0.0], rtol=0, atol=1e-12)
    assert_allclose(found.body_from_local.apply([1.0, 0.0, 0.0]), [0.0, 0.0, -1.0], rtol=0, atol=1e-12)
    assert found.position_body_km.tolist() == [0.25, 0.0, 0.0]
    assert found.pictures_px["P000000001"].tolist() == [0.0, 12.5]
    for old, new, words in (
        ("0.2500000000D+00", "abc", "line 5"),
        ("-0.1000000000D+01   UX", "0.1000000000D+01   UX", "UX, UY, UZ"),
        ("END FILE", "", "cut off"),
        ("      49 ", "       0 ", "half_size"),
        ("P000000001       1.000", "P000000001       nan", "line 11"),
    ):
        path.write_text(text.replace(old, new))
        with pytest.raises(DataError, match=words):
            read_lmk(path)
    path.write_text("no\n")
    with pytest.raises(DataError, match="no LMK file"):
        read_lmk(path)


def test_pixels_must_be_those_of_the_sumfiles(tmp_path: Path) -> None:
    body = row_of_body(CONTEXT, SIGHTING, position_fix(), is_preferred=True)
    mark = replace(row_of_landmark(CONTEXT, SIGHTING, position_fix(), SEEN), feature="AB0001")
    picture = replace(sumfile_of(CAMERA, body, [mark]), name="P000000001")
    write_sumfile(tmp_path / "P000000001.SUM", picture)
    place = picture.landmarks_px["AB0001"]
    write_lmk(tmp_path / "AB0001.LMK", replace(LANDMARK, pictures_px={"P000000001": place}))
    assert list(read_lmks(tmp_path, tmp_path)) == ["AB0001"]
    write_lmk(tmp_path / "AB0001.LMK", replace(LANDMARK, pictures_px={"P000000001": place + 0.1}))
    with pytest.raises(DataError, match=r"AB0001\.LMK.*P000000001\.SUM has it at"):
        read_lmks(tmp_path, tmp_path)
    write_lmk(tmp_path / "AB0001.LMK", replace(LANDMARK, pictures_px={"P000000002": place}))
    with pytest.raises(DataError, match="P000000002, which has no SUMFILE"):
        read_lmks(tmp_path, tmp_path)
    with pytest.raises(DataError, match=r"no file \*\.LMK"):
        read_lmks(tmp_path / "none")


@pytest.mark.parametrize(
    "bad",
    [
        {"name": "toolong"},
        {"name": "A B"},
        {"name": ""},
        {"half_size": 0},
        {"scale_km": 0.0},
        {"scale_km": float("nan")},
        {"position_body_km": np.array([1.0, 2.0])},
        {"sigma_body_km": np.array([np.nan, 0.0, 0.0])},
        {"pictures_px": {"thirteenchars": np.zeros(2)}},
        {"overlaps": {"CD0002": np.zeros(2)}},
    ],
)
def test_wrong_content_is_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        replace(LANDMARK, **bad)
