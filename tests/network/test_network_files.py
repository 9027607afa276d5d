"""Files of networks: SPC there and back, rotation as SPICE reads it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import spiceypy
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from giantlike.cli.app import app
from giantlike.core.errors import DataError, InputError
from giantlike.io.spice import load_kernels, rotation_coefficients
from giantlike.network import NetworkFix, adjust, pck_of, read_spc, write_network, write_spc
from tests.network.networks import World, world
from tests.network.test_rotation import adjusted, scene
from tests.tolerances import FLOAT64, FLOAT64_SUM

PIXEL_PX = 6e-4  # three digits in the file


def made() -> tuple[World, NetworkFix]:
    truth = world(7)
    photos = [
        replace(photo, name=f"IMG {k}", et=8e8 + 100.0 * k, columns=1000, rows=1000,
                sun_direction=np.array([0.6, 0.0, 0.8]))
        for k, photo in enumerate(truth.photos)
    ]  # fmt: skip
    names = tuple(f"P{k:03d}" for k in range(len(truth.tracks.names)))
    return truth, adjust(photos, replace(truth.tracks, names=names)).unwrap()


def test_a_network_is_written_as_spc_files_and_read_back(tmp_path: Path) -> None:
    _, fix = made()
    write_spc(tmp_path, fix)
    photos, tracks = read_spc(tmp_path / "SUMFILES", tmp_path / "LMKFILES")
    assert [photo.name for photo in photos] == [f"IMG_{k}" for k in range(len(fix.photos))]
    for photo, known in zip(photos, fix.photos, strict=True):
        turn = (photo.camera_from_inertial * known.camera_from_inertial.inv()).magnitude()
        assert turn < FLOAT64_SUM
        assert_allclose(photo.position_km, known.position_km, rtol=0, atol=FLOAT64_SUM)
        assert_allclose(photo.et, known.et, rtol=0, atol=1e-3)
        assert photo.covariance_pose is not None
        assert known.covariance_pose is not None
        assert_allclose(np.diag(photo.covariance_pose), np.diag(known.covariance_pose), rtol=1e-8)
    order = [fix.tracks.names.index(name) for name in tracks.names]
    assert_allclose(np.asarray(tracks.points_km), fix.points_km[order], rtol=0, atol=FLOAT64_SUM)
    measured = {
        (fix.tracks.names[i], k): pixel
        for i, k, pixel in zip(fix.tracks.point, fix.tracks.photo, fix.tracks.points_px, strict=True)
    }
    assert len(tracks.point) == int(fix.used.sum())
    for i, k, pixel in zip(tracks.point, tracks.photo, tracks.points_px, strict=True):
        assert_allclose(pixel, measured[tracks.names[i], k], rtol=0, atol=PIXEL_PX)
    again = adjust(photos, tracks).unwrap()
    sigma = np.sqrt(np.diagonal(fix.covariance_points_km2[order], axis1=1, axis2=2))
    assert np.abs(again.points_km - fix.points_km[order]).max() < 0.2 * sigma.max()  # the files have sigmas alone


def test_the_command_adjusts_sumfiles(tmp_path: Path) -> None:
    _, fix = made()
    write_network(tmp_path, fix)
    command = ["network", "adjust", str(tmp_path / "SUMFILES"), "-o", str(tmp_path / "out")]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert f"{len(fix.photos)} images" in done.stdout
    assert (tmp_path / "out" / "LMKFILES" / "P000.LMK").is_file()
    (tmp_path / "SUMFILES" / "IMG_0.SUM").unlink()
    refused = CliRunner().invoke(app, command)
    assert refused.exit_code == 2
    assert "names the image IMG_0, which has no SUMFILE" in refused.stderr
    with pytest.raises(DataError, match=r"no file \*.SUM"):
        read_spc(tmp_path / "LMKFILES")


def test_names_that_spc_cannot_have_are_said_and_the_rest_is_written(tmp_path: Path) -> None:
    _, fix = made()
    long = replace(fix, tracks=replace(fix.tracks, names=tuple(f"POINT{k:03d}" for k in range(len(fix.points_km)))))
    with pytest.raises(InputError, match="at most 6 characters"):
        write_spc(tmp_path, long)
    write_network(tmp_path / "rest", long)
    assert "at most 6 characters" in (tmp_path / "rest" / "result.json").read_text()


def test_spice_reads_the_adjusted_rotation_and_the_covariance_is_in_the_comments(tmp_path: Path) -> None:
    declared, photos, tracks, *_ = scene(3)
    fix = adjusted(declared, photos, tracks)
    assert fix.body is not None
    assert fix.body.covariance_j2000 is not None
    text = pck_of(fix, 2101955)
    path = tmp_path / "rotation.tpc"
    path.write_text(text)
    with load_kernels([path], "."):
        for et in (fix.mean_et, 0.0):
            matrix = spiceypy.tipbod("J2000", 2101955, et)
            assert_allclose(matrix, fix.body.inertial_from_body(et).inv().as_matrix(), rtol=0, atol=FLOAT64_SUM)
        found = rotation_coefficients("2101955")
        assert found is not None
        assert_allclose(found[2], fix.body.pm_deg, rtol=0, atol=FLOAT64)
        assert rotation_coefficients("2000433") is None
    rows = [line.split() for line in text.splitlines() if line.count("e") >= 4 and line[:1] in "-0123456789"]
    assert_allclose(np.array(rows, dtype=float), fix.body.covariance_j2000, rtol=1e-14, atol=0)
    with pytest.raises(InputError, match="needs a network with a rotation"):
        pck_of(made()[1], 1)
