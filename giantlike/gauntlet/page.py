"""``report.html`` of a gauntlet: a wall of images with verdicts, in one file that needs nothing else."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from giantlike.campaign.report.templates import render_page
from giantlike.core.version import VERSION
from giantlike.gauntlet.kinds import KINDS
from giantlike.gauntlet.rule import Verdict
from giantlike.gauntlet.run import ImageResult
from giantlike.gauntlet.trial import TrialRow

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
