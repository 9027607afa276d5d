"""Replay of a published flight system: numbers of the paper and of the package, as values, JSON and a page.

A mission is a package in this folder with a function ``replay(settings) -> Replay`` and ``CHANGES``: assumptions that
can be altered, by name, with what they then are: an independent comparison names the one with which it disagrees.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from giantlike._system.atomic import make_folder, write_text_atomic
from giantlike.campaign.report.templates import render_page
from giantlike.core.arrays import require
from giantlike.core.errors import InputError
from giantlike.core.version import VERSION

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REPLAYS: Mapping[str, str] = MappingProxyType(
    {
        "artemis1": "Artemis I: passes of Orion's optical navigation, calibrations, algorithms, limb of the Earth",
        "odin": "ODIN: modes, target determination, calibration and pose of an instrument for small satellites",
        "osiris_rex": "calibration and four phases at Bennu (Liounis et al., independent optical navigation "
        "of OSIRIS-REx)",
        "orion": "Orion before Exploration Mission 1: filter, linear covariance, error models, gimbal grid",
    }
)
"""Name of the package of a mission in this folder, with the paper it replays."""


class ComparisonKind(StrEnum):
    """Relation of our number to the paper's."""

    INPUT = "input"
    """The number follows from one that was put in, drawn with, or tuned to the paper's: this is not an agreement."""
    DERIVED = "derived"  # follows from numbers of the paper, or from published ones, by known formulas
    SELF_CHECK = "self_check"
    """Ours against ours, or against a truth or a limit of our own: the paper has no number that it could miss."""
    INDEPENDENT = "independent"  # a number or statement of the paper from which nothing in the replay was set


INPUT, DERIVED, SELF_CHECK, INDEPENDENT = ComparisonKind


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """A figure, table or number of the paper, and ours.

    fails_with: the change, one of ``CHANGES`` of the mission, with which an independent comparison disagrees.
    """

    what: str  # the quantity, with its unit
    paper: str | float  # as the paper states it
    ours: str | float
    kind: ComparisonKind
    agrees: bool | None  # from a rule in the code of the replay; None where the size of a small replay decides
    reason: str  # the rule and, where they differ, why
    reference: str = ""  # place in the paper, such as "Fig. 7".
    fails_with: str = ""

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name, value in (("paper", self.paper), ("ours", self.ours)):
            if not isinstance(value, str) and not math.isfinite(value):
                raise InputError(f"comparison {self.what!r}: {name} must be finite, got {value}")
        if not self.reason:
            raise InputError(f"comparison {self.what!r} needs a reason: the rule of agreement, or why the two differ")
        if self.kind is INDEPENDENT and self.agrees and not self.fails_with:
            raise InputError(f"comparison {self.what!r}: an independent agreement names the change with which it fails")


@dataclass(frozen=True, slots=True)
class Stated:
    """A result that the paper states, and ours; with a rule it becomes a :class:`Comparison`."""

    reference: str
    what: str
    paper: str | float
    ours: str | float
    kind: ComparisonKind
    fails_with: str = ""

    def agrees(self, holds: bool | None, reason: str, *, enough: bool = True) -> Comparison:
        """Compare the two: they agree where the rule in ``reason`` is met; None does not compare them.

        ``enough``: False where so few were taken that they can refute the rule and not confirm it.
        """
        paper, ours = (value if isinstance(value, str) else float(value) for value in (self.paper, self.ours))
        return Comparison(
            what=self.what, paper=paper, ours=ours, kind=self.kind,
            agrees=None if holds is None or (holds and not enough) else bool(holds),
            reason=reason, reference=self.reference, fails_with=self.fails_with,
        )  # fmt: skip

    def within(self, tolerance: float, reason: str) -> Comparison:
        """Compare the two: they agree within a tolerance with a stated reason."""
        return self.agrees(
            abs(float(self.ours) - float(self.paper)) <= tolerance, f"agrees within {tolerance:.3g}: {reason}"
        )

    def near(self, within: float, because: str) -> Comparison:
        """Compare the two: they agree within a relative tolerance."""
        paper, ours = float(self.paper), float(self.ours)
        return self.agrees(abs(ours - paper) <= within * abs(paper), f"Agrees within {100.0 * within:g} %. {because}")

    def at_most(self, because: str) -> Comparison:
        """Compare the two: ours must not be larger, such as an error within its model."""
        agrees = abs(float(self.ours)) <= abs(float(self.paper))
        return self.agrees(agrees, f"Agrees where ours is not larger. {because}")


@dataclass(frozen=True, slots=True)
class ReplayFigure:
    """A figure of the paper, reproduced."""

    reference: str  # place in the paper, such as "Fig. 7".
    title: str
    caption: str
    figure: Figure  # of matplotlib, made without pyplot


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """Part of a replay, such as a phase of the mission."""

    title: str
    text: str = ""  # description, in a few sentences
    figures: tuple[ReplayFigure, ...] = ()
    comparisons: tuple[Comparison, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Replay:
    """A finished replay.

    assumptions: assumptions where the paper gives no values; a value tuned to meet a table is named as tuned.
    """

    name: str  # one of ``REPLAYS``
    title: str
    sections: tuple[Section, ...]  # in the order of the paper
    flown: str  # what was simulated and processed, in two or three sentences, for the first page
    pictures: tuple[str, ...]  # references of figures for the first page, such as "Fig. 7".
    assumptions: tuple[str, ...]

    @property
    def comparisons(self) -> tuple[Comparison, ...]:
        """Comparisons of all sections."""
        return tuple(each for section in self.sections for each in section.comparisons)

    @property
    def shown_first(self) -> tuple[ReplayFigure, ...]:
        """Figures of the first page, one to a reference."""
        figures = {figure.reference: figure for section in self.sections for figure in section.figures}
        return tuple(figures[name] for name in self.pictures if name in figures)


def _no_progress(stage: str, done: int, total: int) -> None:
    """Discard a progress message."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplaySettings:
    """Options of a replay.

    data: folder with kernels and shapes of the mission; without it, the paper's numbers are simulated.
    """

    output: Path  # folder for intermediate products, such as images and runs
    small: bool = False  # fewer images and draws: shows that it works, in seconds
    workers: int = 1  # number of processes
    seed: int = 1  # of all random numbers
    data: Path | None = None
    change: str = ""  # one of ``CHANGES`` of the mission: an assumption to alter, to see which comparisons depend on it
    progress: Callable[[str, int, int], None] = _no_progress  # takes the name of a step, the number done, and of all


def run_replay(name: str, settings: ReplaySettings) -> Replay:
    """Replay the results of a paper."""
    require(name in REPLAYS, f"there is no replay {name!r}; there are {', '.join(REPLAYS)}")
    mission, change = import_module(f"giantlike.missions.{name}"), settings.change
    require(not change or change in mission.CHANGES, f"{name} has no change {change!r}: {', '.join(mission.CHANGES)}")
    replayed: Replay = mission.replay(settings)
    lines = (f"CHANGED: {mission.CHANGES[change]}",) if change else ()
    return replace(replayed, assumptions=lines + replayed.assumptions)


def summary_of(replay: Replay, settings: ReplaySettings) -> dict[str, Any]:
    """Return the content of ``replay.json``."""
    comparisons = replay.comparisons
    return {
        "replay": replay.name,
        "title": replay.title,
        "version": VERSION,
        "small": settings.small,
        "seed": settings.seed,
        "change": settings.change,
        "counts": {
            str(kind): {
                "comparisons": sum(each.kind is kind and each.agrees is not None for each in comparisons),
                "agree": sum(each.kind is kind and each.agrees is True for each in comparisons),
            }
            for kind in ComparisonKind
        },
        "comparisons": [asdict(each) for each in comparisons],
        "assumptions": list(replay.assumptions),
    }


def save_replay(replay: Replay, settings: ReplaySettings) -> dict[str, Any]:
    """Write ``replay.json`` and ``report.html`` to the folder of the settings. The result is as :func:`summary_of`."""
    summary = summary_of(replay, settings)
    make_folder(settings.output)
    write_text_atomic(settings.output / "replay.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")
    write_text_atomic(settings.output / "report.html", _page_of(replay, summary))
    return summary


def _page_of(replay: Replay, summary: Mapping[str, Any]) -> str:
    """The page: sections in the order of the paper, then the assumptions."""
    from giantlike.plotting.style import svg_text

    return render_page(
        "replay.html.j2",
        "giantlike.missions",
        version=VERSION,
        replay=replay,
        summary=summary,
        shown=lambda value: value if isinstance(value, str) else f"{value:.4g}",
        svg=lambda figure, place: svg_text(figure.figure, f"{replay.name}-{place}"),
    )
