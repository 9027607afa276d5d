"""The folder of a gauntlet: a line by image as they are done, ``gauntlet.json``, the table of verdicts and the page."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from giantlike._system.atomic import append_text, write_text_atomic
from giantlike._system.reading import check, reads
from giantlike.core.errors import DataError
from giantlike.core.version import VERSION
from giantlike.gauntlet.page import page_of
from giantlike.gauntlet.run import Gauntlet, ImageResult, summary_of
from giantlike.gauntlet.trial import TrialRow
from giantlike.io.tables import columns_of, write_rows

SUMMARY, TABLE, PAGE, _PARTS = "gauntlet.json", "verdicts", "report.html", "images.jsonl"  # names of the files


class _Line(BaseModel):
    """A line of ``images.jsonl``."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    stamp: dict[str, Any]
    index: int
    kind: str
    cpu_s: float
    thumbnail: str
    rows: list[TrialRow]


def has_results(folder: Path) -> bool:
    """Tell whether a folder holds a gauntlet, finished or not."""
    return (folder / _PARTS).exists() or (folder / SUMMARY).exists()


def _stamp(wanted: Gauntlet) -> dict[str, Any]:
    """Key of the inputs on which the results of one image depend."""
    return {"seed": wanted.seed, "estimators": list(wanted.estimators), "version": VERSION}


def save_results(folder: Path, wanted: Gauntlet, results: Sequence[ImageResult], *, append: bool) -> None:
    """Write results into the folder."""
    path = folder / _PARTS
    if append:
        append_text(path, "".join(_line(wanted, result) for result in results))
        return
    rows = [row for result in results for row in result.rows]
    report = summary_of(wanted, results)
    everything = report | {"rows": [asdict(row) for row in rows]}
    write_text_atomic(path, "".join(_line(wanted, result) for result in results))
    write_rows(folder / TABLE, TrialRow, rows)
    write_text_atomic(folder / SUMMARY, json.dumps(everything, indent=1, allow_nan=False) + "\n")
    write_text_atomic(folder / PAGE, page_of(report, results))


def _line(wanted: Gauntlet, result: ImageResult) -> str:
    values = {
        "stamp": _stamp(wanted),
        "index": result.index,
        "kind": result.kind,
        "cpu_s": result.cpu_s,
        "thumbnail": base64.b64encode(result.thumbnail).decode("ascii"),
        "rows": [asdict(row) for row in result.rows],
    }
    return json.dumps(values, allow_nan=False) + "\n"


@reads("results of a gauntlet")
def load_results(folder: Path, wanted: Gauntlet) -> list[ImageResult]:
    """Read the images that a killed run had finished; those of another seed, choice or version are left out."""
    path = folder / _PARTS
    if not path.exists():
        return []
    numbers = set(wanted.numbers())
    results: dict[int, ImageResult] = {}
    *lines, last = path.read_bytes().split(b"\n")
    if last:
        lines.append(last)
    for number, line in enumerate(lines, start=1):
        try:
            kept = _Line.model_validate_json(line)
            thumbnail = base64.b64decode(kept.thumbnail, validate=True)
            check(all(_is_whole(row) for row in kept.rows), "a row lacks a value")
        except ValueError as error:
            if line is last:
                continue  # of a run that was killed while it wrote
            raise DataError(path, f"line {number} is damaged: delete it, and its image is made again") from error
        if kept.stamp == _stamp(wanted) and kept.index in numbers:
            results[kept.index] = ImageResult(
                index=kept.index, kind=kept.kind, rows=tuple(kept.rows), cpu_s=kept.cpu_s, thumbnail=thumbnail
            )
    return list(results.values())


def _is_whole(row: TrialRow) -> bool:
    """True if a row has every value that a table needs."""
    return all(getattr(row, column.name) is not None for column in columns_of(TrialRow) if column.required)
