"""Calibration frames of a campaign: checked, used for every image, told in the provenance, redone if changed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from giantlike._system.reading import file_sha256
from giantlike.campaign.check import check_campaign
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.runner import run_campaign
from giantlike.io.fits import write_fits
from tests.campaign_files import CAMERA, campaign_table, write_campaign

SIZE = (CAMERA.rows, CAMERA.columns)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A campaign with three biases and a mask of bad pixels; the images have the bias that the camera states."""
    path, _ = write_campaign(tmp_path / "campaign", visits=1)
    rng = np.random.default_rng(1)
    for number in range(3):
        _write(path, f"bias_{number}.fits", np.rint(rng.normal(100.0, 5.0, SIZE)).astype(np.uint16))
    bad = np.zeros(SIZE, np.uint8)
    bad[5, 7] = 1
    _write(path, "bad.fits", bad)
    _edit(path, {"bias": ["bias_*.fits"], "bad_pixels": "bad.fits"})
    return path


def _write(path: Path, name: str, pixels: Any) -> None:
    (path.parent / name).unlink(missing_ok=True)
    write_fits(path.parent / name, pixels)


def _edit(path: Path, frames: dict[str, Any]) -> None:
    path.write_text(tomli_w.dumps(campaign_table() | {"calibration_frames": frames}))


def test_a_run_uses_frames_tells_them_and_is_redone_when_one_changes(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("giantlike.campaign.run.runner.write_report", lambda result: None)
    first = run_campaign(Campaign.load(path), workers=1)
    assert all(record.status == "ok" for record in first.attitudes)
    told = json.loads((path.parent / "run" / "provenance.json").read_text())["inputs"]["calibration_frames_sha256"]
    assert told == {
        "bias": {f"bias_{k}.fits": file_sha256(path.parent / f"bias_{k}.fits") for k in range(3)},
        "bad_pixels": {"bad.fits": file_sha256(path.parent / "bad.fits")},
    }
    assert not any(count.redone for count in run_campaign(Campaign.load(path), workers=1).steps.values())
    _write(path, "bias_1.fits", np.full(SIZE, 101, np.uint16))
    again = run_campaign(Campaign.load(path), workers=1).steps
    assert {name: count.redone for name, count in again.items()} == {
        name: count.redone + count.kept for name, count in again.items()
    }


def test_check_names_missing_files_wrong_sizes_and_unknown_exposures(path: Path) -> None:
    assert [str(one) for one in check_campaign(path) if one.fatal] == []
    _edit(path, {"bias": ["bias_*.fits"], "flat": ["flats/*.fits"]})
    assert "calibration_frames.flat: no file matches 'flats/*.fits'" in _only(path)
    _write(path, "small.fits", np.full((20, 20), 100, np.uint16))
    _edit(path, {"bias": ["bias_0.fits", "small.fits"]})
    assert "calibration_frames.bias: frame 1 has the shape (20, 20), the first one (280, 320)" in _only(path)
    _edit(path, {"bias": ["small.fits"]})
    assert "the frames have (20, 20) rows and columns, the camera (280, 320)" in _only(path)
    _edit(path, {"bias": ["bias_*.fits"], "dark": ["bias_0.fits"]})
    assert "calibration_frames: the exposure of the dark frames is not known" in _only(path)
    _edit(path, {})
    assert "give at least one of bias, dark, flat and bad_pixels" in _only(path)


def _only(path: Path) -> str:
    """The one mistake that is fatal, on the line of the section."""
    (found,) = [one for one in check_campaign(path) if one.fatal]
    assert found.line is not None
    return found.text
