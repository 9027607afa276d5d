"""A run folder that somebody damaged is refused in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from giantlike.campaign.store.results import load_result
from giantlike.core.errors import DataError
from tests.campaign.test_export import _record, _run


def _provenance(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "provenance.json"
    content = json.loads(path.read_text())
    change(content["run"])
    path.write_text(json.dumps(content))


def _part(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = next((folder / "parts").glob("*.attitude.json"))
    stamp, _, text = path.read_text().partition("\n")
    content = json.loads(text)
    change(content)
    path.write_text(f"{stamp}\n{json.dumps(content)}")


DAMAGES: dict[str, Callable[[Path], object]] = {
    "zero quaternion": lambda folder: _part(folder, lambda part: part["attitude"].update(quaternion_xyzw=[0, 0, 0, 0])),
    "short quaternion": lambda folder: _part(folder, lambda part: part["attitude"].update(quaternion_xyzw=[0, 0, 1])),
    "covariance": lambda folder: _part(folder, lambda part: part["attitude"].update(covariance_rad2=[[1.0]])),
    "flag": lambda folder: _part(folder, lambda part: part["attitude"].update(flags=["splendid"])),
    "unknown key": lambda folder: _part(folder, lambda part: part.update(more={"a": [[[1]]]})),
    "missing key": lambda folder: _provenance(folder, lambda run: run.pop("name")),
    "wrong type": lambda folder: _provenance(folder, lambda run: run.update(warnings={"a": {"b": 1}})),
    "nested": lambda folder: (folder / "provenance.json").write_text("[" * 100_000),
    "no text": lambda folder: (folder / "provenance.json").write_bytes(b"\xff\xfe\x00"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_run_is_refused_in_one_line(tmp_path: Path, damage: str) -> None:
    folder = _run(tmp_path / "run", [_record(0), _record(1)])
    assert len(load_result(folder).attitudes) == 2
    DAMAGES[damage](folder)
    with pytest.raises(DataError, match="damaged") as caught:
        load_result(folder)
    assert "\n" not in str(caught.value)


def test_parts_with_damaged_bytes_are_read_or_refused(tmp_path: Path) -> None:
    folder = _run(tmp_path / "run", [_record(0)])
    path = next((folder / "parts").glob("*.attitude.json"))
    content, random, refused = path.read_bytes(), np.random.default_rng(3), 0
    for _ in range(200):
        damaged = bytearray(content)
        for place in random.integers(len(content), size=int(random.integers(1, 6))):
            damaged[place] = random.integers(256)
        path.write_bytes(damaged)
        try:
            load_result(folder)
        except DataError as error:
            refused += "\n" not in str(error)
    assert refused > 100
