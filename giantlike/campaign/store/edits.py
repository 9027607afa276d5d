"""The edit list of a run: stars, images and fixes that a user rejected or restored, with who, when and why.

``edits.jsonl`` in the run folder has a line per edit and only grows; the last edit of an item counts. Rejected images
and fixes keep their results in the store, so that they can be restored, and have no result, with the reason
``rejected``, wherever a run is read: tables, report, exports. An image with a rejected star is solved again. Numbers of
stars are strings in the file, because they exceed the integers that JSON readers with double precision keep exactly.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError, field_serializer, model_validator

from giantlike._system.atomic import append_text
from giantlike.campaign.store.image_names import find_image
from giantlike.campaign.store.record_values import Pair
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord, ObservationsRecord, Problem
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.core.arrays import require
from giantlike.core.errors import DataError, InputError
from giantlike.core.outcomes import Reason

EDITS_FILE = "edits.jsonl"
MAX_WORDS = 500
"""Maximum length of a reason and of a name."""


class Edited(StrEnum):
    """Kind of thing that an edit is about."""

    IMAGE = "image"
    STAR = "star"
    FIX = "fix"


class Edit(BaseModel):
    """One edit.

    action: ``reject`` or ``restore``.
    file: name of the image in the tables.
    star: number of the star in the catalog.
    target, estimator: of the fix.
    at_px: (2,) list of float, px; where the star was observed when it was rejected, so that it can still be shown.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    action: Literal["reject", "restore"]
    what: Edited
    file: str
    star: int | None = None
    target: str | None = None
    estimator: str | None = None
    who: str
    when_utc: str
    why: str
    at_px: Pair | None = None

    @field_serializer("star", when_used="json-unless-none")
    def _star_text(self, star: int) -> str:
        return str(star)

    @model_validator(mode="after")
    def _complete(self) -> Edit:
        if (self.what is Edited.STAR) != (self.star is not None):
            raise ValueError("a star, and nothing else, has a number")
        if (self.what is Edited.FIX) != (self.target is not None and self.estimator is not None):
            raise ValueError("a fix, and nothing else, has a target and an estimator")
        return self

    @property
    def thing(self) -> tuple[Edited, str, int | None, str | None, str | None]:
        """The thing that it is about."""
        return self.what, self.file, self.star, self.target, self.estimator

    @property
    def name(self) -> str:
        """The thing in words."""
        if self.what is Edited.IMAGE:
            return "the image"
        return f"star {self.star}" if self.star is not None else f"{self.target} by {self.estimator}"

    @property
    def line(self) -> str:
        """The edit in one line."""
        which = "" if self.what is Edited.IMAGE else f" ({self.name})"
        return _printable(f"{self.when_utc} {self.who}: {self.action} {self.what} {self.file}{which}: {self.why}")

    @property
    def problem(self) -> Problem:
        """The reason for which a rejected thing has no result."""
        return Problem(reason=Reason.REJECTED, detail=f"{self.file}: by {self.who} on {self.when_utc}: {self.why}")


@dataclass(frozen=True, slots=True)
class EditList:
    """Edits of a run in the order in which they were made."""

    edits: tuple[Edit, ...] = ()

    @property
    def standing(self) -> list[Edit]:
        """Rejections that were not taken back."""
        last = {edit.thing: edit for edit in self.edits}
        return [edit for edit in last.values() if edit.action == "reject"]

    def rejected_stars(self) -> dict[str, frozenset[int]]:
        """Numbers of the stars that are not to be used, by image."""
        stars: dict[str, set[int]] = {}
        for edit in self.standing:
            if edit.star is not None:
                stars.setdefault(edit.file, set()).add(edit.star)
        return {file: frozenset(numbers) for file, numbers in stars.items()}

    def rejected_images(self) -> dict[str, Problem]:
        """Images that are not to be used, with the reason."""
        return {edit.file: edit.problem for edit in self.standing if edit.what is Edited.IMAGE}

    def attitudes(self, records: Iterable[AttitudeRecord]) -> list[AttitudeRecord]:
        """Attitudes after the edits."""
        rejected = self.rejected_images()
        return [
            record if record.file not in rejected else _without_attitude(record, rejected[record.file])
            for record in records
        ]

    def bodies(self, images: Iterable[ObservationsRecord]) -> list[ObservationsRecord]:
        """Observations after the edits."""
        rejected, fixes = self.rejected_images(), {}
        for edit in self.standing:
            if edit.what is Edited.FIX:
                fixes[edit.file, edit.target, edit.estimator] = edit.problem
        edited = []
        for image in images:
            observations = [
                record if problem is None else _without_fix(record, problem)
                for record in image.observations
                for problem in [rejected.get(image.file) or fixes.get((image.file, record.target, record.estimator))]
            ]
            edited.append(image.model_copy(update={"observations": observations}))
        return edited


def new_edit(run: RunFolder, wanted: Mapping[str, Any]) -> Edit:
    """Return a new edit of something that the run holds; a star gets its place in the image.

    ``wanted``: fields of :class:`Edit` but the time; an image may be named by the beginning of its name. Raises
    InputError: it is incomplete, its words are not one short line, or it matches nothing; the nearest candidates are
    named.
    """
    when = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    try:
        edit = Edit.model_validate({**wanted, "when_utc": when, "at_px": None})
    except ValidationError as error:
        found = "; ".join(f"{'.'.join(map(str, one['loc'])) or 'edit'}: {one['msg']}" for one in error.errors())
        raise InputError(f"this is no edit: {_printable(found)[:300]}") from error
    edit = edit.model_copy(update={"why": _one_line(edit.why, "a reason"), "who": _one_line(edit.who, "a name")})
    files = list(dict.fromkeys(file for file, *_ in run.keys(AttitudeRecord)))
    edit = edit.model_copy(update={"file": find_image(edit.file, files, run.path)})
    known = read_edits(run.path)
    if edit.action == "restore":
        standing = [each for each in known.standing if each.file == edit.file]
        if edit.thing not in {each.thing for each in standing}:
            there = ", ".join(each.name for each in standing) or "nothing"
            raise InputError(f"{run.path}: {edit.file}: {edit.name} is not rejected; of this image is: {there}")
        return edit
    if edit.what is Edited.FIX:
        _require_fix(run, edit)
    return _with_place(run, edit, known) if edit.star is not None else edit


def _one_line(text: str, what: str) -> str:
    """The text without blanks around it, if it is one line of printable characters."""
    text = text.strip()
    require(bool(text), f"an edit needs {what}")
    require(len(text) <= MAX_WORDS, f"{what} has at most {MAX_WORDS} characters, got {len(text)}")
    require(text.isprintable(), f"{what} is one line of printable characters, got {_printable(text)[:80]!r}")
    return text


def _printable(text: str) -> str:
    """The text with a space for all that is not printable."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def _require_fix(run: RunFolder, edit: Edit) -> None:
    """Refuse a fix that the run does not hold."""
    there = [(target, name) for file, target, name in run.keys(ObservationRecord) if file == edit.file]
    if (edit.target, edit.estimator) not in there:
        names = ", ".join(f"{target} by {name}" for target, name in there) or "none"
        raise InputError(
            f"{run.path}: {edit.file} has no observation of {edit.target!r} by {edit.estimator!r}; there are: {names}"
        )


def _with_place(run: RunFolder, edit: Edit, known: EditList) -> Edit:
    """Edit with the place of its star; refuses one that is not matched in the image, nor was rejected there."""
    assert edit.star is not None
    record = run.load(AttitudeRecord, edit.file)
    stars = None if record is None else record.stars
    places = {
        each.star: each.at_px
        for each in known.edits
        if each.file == edit.file and each.star is not None and each.at_px is not None
    }
    places |= {} if stars is None else dict(zip(stars.star_ids, stars.observed_px, strict=True))
    if edit.star in places:
        return edit.model_copy(update={"at_px": places[edit.star]})
    star, count = edit.star, 0 if stars is None else len(stars.star_ids)
    near = sorted(places, key=lambda number: abs(number - star))[:3]
    ending = f"; the nearest numbers are {', '.join(map(str, near))}" if near else ""
    raise InputError(f"{run.path}: {edit.file}: star {star} is not one of its {count} matched stars{ending}")


def read_edits(folder: Path) -> EditList:
    """Read the edit list of a run. The result is empty if there is none."""
    path = folder / EDITS_FILE
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return EditList()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(path, f"cannot be read: {error}") from error
    edits = list[Edit]()
    for number, line in enumerate(lines, start=1):
        try:
            edits.append(Edit.model_validate_json(line))
        except ValidationError as error:
            text = " ".join(str(error).split())[:200]
            raise DataError(path, f"line {number} is no edit, mend or delete it: {text}") from error
    return EditList(tuple(edits))


def add_edits(folder: Path, edits: Sequence[Edit]) -> None:
    """Append edits to the list of a run."""
    lines = "".join(json.dumps(edit.model_dump(mode="json", exclude_none=True)) + "\n" for edit in edits)
    append_text(folder / EDITS_FILE, lines)


_NO_FIX = ObservationRecord(index=0, file="", target="", estimator="", status="failed")
_KEPT_OF_A_FIX = (
    *("index", "file", "epoch_utc", "target", "estimator", "attitude", "predicted_px", "predicted_camera_km", "time_s"),
)


def _without_attitude(record: AttitudeRecord, problem: Problem) -> AttitudeRecord:
    none = dict.fromkeys(("attitude", "ra_deg", "dec_deg", "roll_deg", "fov_deg"))
    return record.replace(status="failed", problem=problem, flags=[], **none)


def _without_fix(record: ObservationRecord, problem: Problem) -> ObservationRecord:
    kept = {name: getattr(record, name) for name in _KEPT_OF_A_FIX}
    return _NO_FIX.replace(**kept, problem=problem)
