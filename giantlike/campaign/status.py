"""State of a run, finished or in progress: results, failures with reasons, and who runs it."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from giantlike.campaign.store.edits import read_edits
from giantlike.campaign.store.lock import holder_of, is_locked
from giantlike.campaign.store.records import Problem
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.core.outcomes import Outcome

_LOG_TAIL_BYTES = 20_000  # end of the log that is read for the last event: some hundred lines


@dataclass(frozen=True, slots=True, kw_only=True)
class StepStatus:
    """Results of a step that the run folder holds."""

    done: int
    expected: int | None  # None where it follows from the images themselves
    statuses: Mapping[str, int]  # number of results by :class:`~giantlike.core.reasons.Outcome`
    reasons: Mapping[str, int]  # of everything without a result
    example: Mapping[str, str]  # detail of the first one, by reason


@dataclass(frozen=True, slots=True, kw_only=True)
class RunStatus:
    """State of a run."""

    folder: str
    state: str  # ``running``, ``finished`` or ``interrupted``
    holder: str | None  # the process at work
    images: int  # of the campaign
    steps: Mapping[str, StepStatus] = field(default_factory=dict)
    edits: int = 0  # decisions in effect
    last_event: str | None = None  # time of the last line of the log


def status_of_run(path: Path) -> RunStatus:
    """Look at a run folder; a run may be at work in it."""
    folder = RunFolder.open(path)
    provenance = folder.provenance()
    files = provenance.get("inputs", {}).get("image_files", [])
    running, edits = is_locked(path), read_edits(path)
    steps = {}
    if folder.has_results():
        steps["attitudes"] = _step(
            [(record.outcome, record.problem) for record in edits.attitudes(folder.attitudes())], len(files)
        )
        by_name: dict[str, list[tuple[Outcome, Problem | None]]] = {}
        for record in (one for image in edits.bodies(folder.bodies()) for one in image.observations):
            by_name.setdefault(f"{record.target}: {record.estimator}", []).append((record.outcome, record.problem))
        steps |= {name: _step(found, None) for name, found in by_name.items()}
    finished = isinstance(provenance.get("run"), dict)
    return RunStatus(
        folder=str(path),
        state="running" if running else "finished" if finished else "interrupted",
        holder=holder_of(path) if running else None,
        images=len(files),
        steps=steps,
        edits=len(edits.standing),
        last_event=_last_event(path / "log.jsonl"),
    )


def _step(found: list[tuple[Outcome, Problem | None]], expected: int | None) -> StepStatus:
    problems = [problem for _, problem in found if problem is not None]
    example: dict[str, str] = {}
    for problem in problems:
        example.setdefault(str(problem.reason), problem.detail)
    return StepStatus(
        done=len(found),
        expected=expected,
        statuses=dict(Counter(str(outcome) for outcome, _ in found)),
        reasons=dict(Counter(str(problem.reason) for problem in problems).most_common()),
        example=example,
    )


def _last_event(path: Path) -> str | None:
    try:
        with path.open("rb") as stream:
            stream.seek(max(0, path.stat().st_size - _LOG_TAIL_BYTES))
            lines = stream.read().decode("utf-8", "replace").splitlines()
        return str(json.loads(lines[-1])["time_utc"]) if lines else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
