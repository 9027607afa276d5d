"""The edit list of a run: stars, images and fixes that a user rejected or restored, with who, when and why.

``edits.jsonl`` in the run folder has a line per edit and only grows; the last edit of an item counts. Rejected images
and fixes keep their results in the store, so that they can be restored, and are failures with the reason ``rejected``
wherever a run is read: tables, report, exports. An image with a rejected star is solved again.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord, ObservationsRecord, Problem
from giantlike.core.atomic import append_text
from giantlike.core.errors import DataError
from giantlike.core.outcomes import Reason

EDITS_FILE = "edits.jsonl"


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
