"""Commands that look at runs and edit them: ``status`` and ``edit``."""

from __future__ import annotations

import getpass
from collections.abc import Iterator
from dataclasses import asdict
from enum import StrEnum
from typing import Annotated, Any

import typer

from giantlike.campaign.status import RunStatus, status_of_run
from giantlike.campaign.store.edits import Edit, Edited, add_edits, new_edit, read_edits
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.cli.arguments import Json, Run
from giantlike.cli.outcome import ExitCode, show_result
from giantlike.core.arrays import require
from giantlike.core.outcomes import Outcome


class Action(StrEnum):
    """Action on the edit list."""

    LIST = "list"
    REJECT = "reject"
    ACCEPT = "accept"
    DISCUSS = "discuss"
    START = "start"
    MASK = "mask"
    RESTORE = "restore"


def status(folder: Run, json: Json = False) -> ExitCode:
    """Show the state of a run, finished or in progress: results, failures with reasons, and who runs it."""
    found = status_of_run(folder)
    return show_result(asdict(found), _lines(found), json=json)


def _lines(found: RunStatus) -> Iterator[str]:
    holder = "" if found.holder is None else f" ({found.holder})"
    last = "" if found.last_event is None else f", last event {found.last_event}"
    yield f"{found.folder}: {found.state}{holder}, {found.images} images{last}"
    for name, step in found.steps.items():
        expected = "" if step.expected is None else f" of {step.expected}"
        counts = ", ".join(f"{step.statuses[one]} {one.words}" for one in Outcome if one in step.statuses)
        yield f"{name}: {step.done}{expected} done: {counts}"
        for reason, count in step.reasons.items():
            yield f"  {reason} ({count}), such as {step.example[reason]}"
    if found.edits:
        yield f"{found.edits} decisions by hand; giantlike edit {found.folder} list"


def edit(
    folder: Run,
    action: Annotated[Action, typer.Argument(help="list, reject, accept, discuss, start, mask or restore.")],
    file: Annotated[
        str | None, typer.Argument(metavar="IMAGE", help="Name of the image, or its beginning; all but list need it.")
    ] = None,
    star: Annotated[int | None, typer.Option(help="Number of a star of it, in the catalog.", metavar="ID")] = None,
    target: Annotated[str | None, typer.Option(help="Target of a fix of it, or of a start.")] = None,
    estimator: Annotated[str | None, typer.Option(help="Estimator of that fix.")] = None,
    landmark: Annotated[str | None, typer.Option(help="Name of a landmark of that fix.")] = None,
    area: Annotated[
        str | None,
        typer.Option(
            help="Area to mask, for all estimators or for that one: two corners of a rectangle, or those of a polygon.",
            metavar="'X,Y X,Y ...'",
        ),
    ] = None,
    center: Annotated[
        tuple[float, float] | None, typer.Option(help="Where a start has the center of its target, px.", metavar="X Y")
    ] = None,
    sigma: Annotated[float | None, typer.Option(help="Sigma of that center, px.", show_default="3")] = None,
    why: Annotated[str | None, typer.Option(help="Reason, for those who come after; all but list need one.")] = None,
    who: Annotated[str | None, typer.Option(help="Default: the user.")] = None,
    json: Json = False,
) -> ExitCode:
    """Reject an image of a run, a star or a fix of it, accept a suspect fix or attitude, or restore what was decided.

    The edit list is kept with the results, with who, when and why. Every later run, report and export applies it;
    results are kept, so that they can be restored. Without a target, accept is for the attitude, and discuss marks the
    image for others to look at. A start says where estimators look for a target when its image is solved again,
    a mask which pixels they, or one of them, leave out.
    """
    run = RunFolder.open(folder)
    if action is Action.LIST:
        edits = read_edits(folder).edits
        return show_result(list(map(_fields, edits)), [edit.line for edit in edits], json=json)
    require(file is not None and bool((why or "").strip()), f"{action} needs an IMAGE and --why TEXT")
    started = action is Action.START or (action is Action.RESTORE and target is not None and estimator is None)
    require((center is not None) == (action is Action.START), "start, and nothing else, needs --center X Y")
    require(started or (target is None) == (estimator is None), "a fix has a --target and an --estimator")
    require((area is not None) >= (action is Action.MASK), "mask needs --area 'X,Y X,Y'")
    require(star is None or target is None, "give either --star or --target and --estimator")
    whole = {Action.ACCEPT: Edited.ATTITUDE, Action.DISCUSS: Edited.REVIEW}.get(action, Edited.IMAGE)
    kinds = {Edited.MASK: area, Edited.LANDMARK: landmark, Edited.START: started or None, Edited.STAR: star}
    kinds[Edited.FIX] = target
    what = next((kind for kind, given in kinds.items() if given is not None), whole)
    made = new_edit(
        run,
        {"action": str(action), "what": what, "file": file, "star": star, "target": target, "estimator": estimator,
         "landmark": landmark, "area_px": None if area is None else _corners(area),
         "at_px": center, "sigma_px": sigma, "who": who or getpass.getuser(), "why": why},
    )  # fmt: skip
    add_edits(folder, [made])
    lines = [made.line, "run the campaign again to bring tables and report up to date"]
    return show_result(_fields(made), lines, json=json)


def _corners(text: str) -> list[list[float]]:
    """Corners of an area; of two, those of a rectangle."""
    try:
        corners = [[float(number) for number in pair.split(",")] for pair in text.split()]
    except ValueError:
        corners = []
    require(len(corners) > 1 and all(len(pair) == 2 for pair in corners), f"--area is 'X,Y X,Y ...', got {text[:60]!r}")
    if len(corners) > 2:
        return corners
    (left, top), (right, bottom) = corners
    return [[left, top], [right, top], [right, bottom], [left, bottom]]


def _fields(edit: Edit) -> dict[str, Any]:
    return edit.model_dump(mode="json", exclude_none=True)
