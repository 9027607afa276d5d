"""The folder of a gauntlet: a line by image as they are done, ``gauntlet.json``, the table of verdicts and the page."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from giantlike._system.atomic import append_text, write_text_atomic
from giantlike._system.reading import check, reads
from giantlike.campaign.report.templates import render_page
from giantlike.core.errors import DataError
from giantlike.core.version import VERSION
from giantlike.gauntlet.kinds import KINDS
from giantlike.gauntlet.rule import Verdict
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
        append_text(path, "".join(_verdict_line(wanted, result) for result in results))
        return
    rows = [row for result in results for row in result.rows]
    report = summary_of(wanted, results)
    everything = report | {"rows": [asdict(row) for row in rows]}
    write_text_atomic(path, "".join(_verdict_line(wanted, result) for result in results))
    write_rows(folder / TABLE, TrialRow, rows)
    write_text_atomic(folder / SUMMARY, json.dumps(everything, indent=1, allow_nan=False) + "\n")
    write_text_atomic(folder / PAGE, page_of(report, results))


def _verdict_line(wanted: Gauntlet, result: ImageResult) -> str:
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


_WORST_FIRST = (
    Verdict.SILENT_WRONG,
    Verdict.NEEDLESS_REFUSAL,
    Verdict.MISLEADING,
    Verdict.DOUBTFUL,
    Verdict.VAGUE,
    Verdict.HONEST,
    Verdict.RIGHT,
)
_LISTED = (Verdict.SILENT_WRONG, Verdict.NEEDLESS_REFUSAL, Verdict.MISLEADING)
"""Verdicts whose rows are listed one by one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WallCard:
    """An image on the wall."""

    index: int
    kind: str
    summary: str
    picture: str  # JPEG as base64
    worst: str  # the worst verdict; empty where no estimator ran
    dots: tuple[tuple[str, str], ...]  # verdict of each estimator, and a line about it


def page_of(report: Mapping[str, Any], results: Sequence[ImageResult]) -> str:
    """Return the page of a gauntlet. ``report`` as :func:`~giantlike.gauntlet.run.summary_of` returns it."""
    rows = [row for result in results for row in result.rows]
    return render_page(
        "gauntlet.html.j2",
        "giantlike.gauntlet",
        version=VERSION,
        report=report,
        verdicts=[str(verdict) for verdict in _WORST_FIRST],
        meanings={str(verdict): verdict.name.replace("_", " ").lower() for verdict in Verdict},
        summaries={name: _summary(name) for name in report["by_kind"]},
        listed=sorted(
            (row for row in rows if Verdict(row.verdict) in _LISTED),
            key=lambda row: (_LISTED.index(Verdict(row.verdict)), row.estimator, row.kind, row.image),
        ),
        cards=[_card(result) for result in results],
    )


def _summary(kind: str) -> str:
    """Disturbance of a kind, in a line."""
    return KINDS[kind].summary if kind in KINDS else "a real image that does not show the target"


def _card(result: ImageResult) -> WallCard:
    verdicts = [Verdict(row.verdict) for row in result.rows]
    return WallCard(
        index=result.index,
        kind=result.kind,
        summary=_summary(result.kind),
        picture=base64.b64encode(result.thumbnail).decode("ascii"),
        worst=str(min(verdicts, key=_WORST_FIRST.index)) if verdicts else "",
        dots=tuple((row.verdict, _line(row)) for row in result.rows),
    )


def _line(row: TrialRow) -> str:
    """Outcome of an estimator, in a line."""
    text = f"{row.estimator}: {row.verdict.replace('_', ' ')}, {row.status}"
    if row.reason:
        text += f" ({row.reason})"
    if row.error_px is not None and row.sigma_px is not None and row.sigmas is not None:
        text += f"; {row.error_px:.3g} px off, sigma {row.sigma_px:.2g} px, {row.sigmas:.1f} sigma"
    return text
