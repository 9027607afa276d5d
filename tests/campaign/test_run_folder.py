"""A run folder that somebody damaged is refused in one line."""

from __future__ import annotations

import contextlib
import json
import sqlite3
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from giantlike.campaign.store.results import load_result
from giantlike.campaign.store.run_folder import RESULTS_FILE
from giantlike.core.errors import DataError
from tests.campaign.test_export import _record, _run


def _provenance(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "provenance.json"
    content = json.loads(path.read_text())
    change(content["run"])
    path.write_text(json.dumps(content))


def _light(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a record in a way that its check sum does not tell."""
    with contextlib.closing(sqlite3.connect(folder / RESULTS_FILE)) as connection, connection:
        (text,) = connection.execute("SELECT light FROM records LIMIT 1").fetchone()
        content = json.loads(text)
        change(content)
        light = json.dumps(content)
        connection.execute("UPDATE records SET light = ?, light_crc = ?", (light, zlib.crc32(light.encode())))


DAMAGES: dict[str, Callable[[Path], object]] = {
    "zero quaternion": lambda folder: _light(
        folder, lambda part: part["attitude"].update(quaternion_xyzw=[0, 0, 0, 0])
    ),
    "short quaternion": lambda folder: _light(folder, lambda part: part["attitude"].update(quaternion_xyzw=[0, 0, 1])),
    "covariance": lambda folder: _light(folder, lambda part: part["attitude"].update(covariance_rad2=[[1.0]])),
    "flag": lambda folder: _light(folder, lambda part: part["attitude"].update(flags=["splendid"])),
    "unknown key": lambda folder: _light(folder, lambda part: part.update(more={"a": [[[1]]]})),
    "missing key": lambda folder: _provenance(folder, lambda run: run.pop("name")),
    "wrong type": lambda folder: _provenance(folder, lambda run: run.update(warnings={"a": {"b": 1}})),
    "nested": lambda folder: (folder / "provenance.json").write_text("[" * 100_000),
    "no database": lambda folder: (folder / RESULTS_FILE).write_bytes(b"not a database" * 100),
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


def test_results_with_damaged_bytes_are_read_right_or_refused(tmp_path: Path) -> None:
    folder = _run(tmp_path / "run", [_record(0), _record(1)])
    before, path = load_result(folder), folder / RESULTS_FILE
    content, random, refused = path.read_bytes(), np.random.default_rng(3), 0
    for _ in range(200):
        damaged = bytearray(content)
        for place in random.integers(len(content), size=int(random.integers(1, 6))):
            damaged[place] = random.integers(256)
        path.write_bytes(damaged)
        try:
            attitudes = load_result(folder).attitudes
        except DataError as error:
            refused += "\n" not in str(error)
            continue
        whole = [record.attitude for record in before.attitudes]
        assert all(record.attitude in whole for record in attitudes)
    assert refused > 20  # most of the file is free pages
