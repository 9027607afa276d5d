"""The edit list of a run: stars, images and fixes that a user rejected, accepted or restored, with who, when and why.

``edits.jsonl`` in the run folder has a line per edit and only grows; the last edit of an item counts. Rejected images
and fixes keep their results in the store, and have none wherever a run is read. An image with a rejected star is solved
again. The acceptance of a suspect result is kept with it, and lapses when the result moves or another check objects.
Numbers of stars are strings in the file, since they exceed what JSON readers with double precision keep.
"""

from __future__ import annotations

import difflib
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_serializer, model_validator
from scipy.spatial.transform import Rotation

from giantlike._system.atomic import append_text
from giantlike.campaign.store.record_values import FlagName, Pair, UnitQuaternion
from giantlike.campaign.store.records import Acceptance, AttitudeRecord, ObservationRecord, ObservationsRecord, Problem
from giantlike.campaign.store.run_folder import RunFolder, find_image
from giantlike.core.arrays import Mask, require
from giantlike.core.errors import DataError, InputError
from giantlike.core.outcomes import Outcome, Quality, Reason

EDITS_FILE = "edits.jsonl"
MAX_WORDS = 500  # maximum length of a reason and of a name


class Edited(StrEnum):
    """Kind of thing that an edit is about."""

    IMAGE = "image"
    ATTITUDE = "attitude"
    STAR = "star"
    FIX = "fix"
    REVIEW = "review"
    START = "start"
    MASK = "mask"
    LANDMARK = "landmark"


_WHOLE = (Edited.IMAGE, Edited.ATTITUDE, Edited.REVIEW)  # things of which an image has one
_DECIDED: Mapping[str, tuple[Edited, ...]] = MappingProxyType({
    "reject": (Edited.IMAGE, Edited.STAR, Edited.FIX, Edited.LANDMARK),
    "accept": (Edited.ATTITUDE, Edited.FIX),
    "discuss": (Edited.REVIEW,),
    "start": (Edited.START,),
    "mask": (Edited.MASK,),
})  # fmt: skip
"""Things that each action is for."""
_DECISIONS = MappingProxyType({
    "reject": "Rejected by hand", "accept": "Accepted by hand", "discuss": "To discuss", "start": "Started by hand",
    "mask": "Masked by hand",
})  # fmt: skip
_PARTS = ("star", "target", "estimator", "landmark", "area_px")
_GIVEN: Mapping[Edited, tuple[frozenset[str], ...]] = MappingProxyType({
    Edited.STAR: (frozenset({"star"}),),
    Edited.FIX: (frozenset({"target", "estimator"}),),
    Edited.START: (frozenset({"target"}),),
    Edited.LANDMARK: (frozenset({"target", "estimator", "landmark"}),),
    Edited.MASK: (frozenset({"area_px"}), frozenset({"area_px", "target", "estimator"})),
})  # fmt: skip
"""Fields by which a thing is named; of others, none."""
START_SIGMA_PX = 3.0  # standard deviation of a center that was dragged by hand, px
_SHIFT, _FAR_PX = 4, 1e6  # binary digits of fractions of corners, px; where areas end that reach farther out
_ROUNDING_RAD = 1e-12
Area: TypeAlias = tuple[tuple[float, float], ...]  # corners of a polygon, px
Thing: TypeAlias = tuple[Edited, str, int | None, str | None, str | None, str | None, Area]
Decided = TypeVar("Decided", AttitudeRecord, ObservationRecord)


class Edit(BaseModel):
    """One edit.

    action: ``reject``, ``accept``, ``discuss``, ``start``, ``mask`` or ``restore``.
    target, estimator: of the fix; the target alone of a start; of a mask, the estimator that it is for, if not for all.
    at_px: (2,) list of float, px; where the star was observed when it was rejected, so that it can still be shown;
        center of a fix that was accepted; where estimators are to start.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    action: Literal["reject", "accept", "discuss", "start", "mask", "restore"]
    what: Edited
    file: str  # name of the image in the tables
    star: int | None = None  # number of the star in the catalog
    target: str | None = None
    estimator: str | None = None
    landmark: str | None = None  # name of a landmark of a fix
    area_px: list[Pair] | None = None  # (n, 2) list of float, px; corners of a mask
    who: str
    when_utc: str
    why: str
    at_px: Pair | None = None
    sigma_px: Annotated[float, Field(gt=0, le=1000)] | None = None  # of such a start
    quaternion_xyzw: UnitQuaternion | None = None  # (4,); attitude that was accepted
    flags: list[FlagName] = Field(default_factory=list)  # names of the flags for which an accepted result is suspect

    @field_serializer("star", when_used="json-unless-none")
    def _star_text(self, star: int) -> str:
        return str(star)

    @model_validator(mode="after")
    def _complete(self) -> Edit:
        given = frozenset(name for name in _PARTS if getattr(self, name) is not None)
        if given not in _GIVEN.get(self.what, (frozenset(),)):
            needed = " or ".join(_words(each) for each in _GIVEN.get(self.what, (frozenset(),)))
            raise ValueError(f"the kind {self.what} goes with {needed}, got {_words(given)}")
        if self.area_px is not None and not (3 <= len(self.area_px) <= 500 and np.isfinite(self.area_px).all()):
            raise ValueError("an area has 3 to 500 corners, px")
        if self.action == "start" and (self.at_px is None or not np.isfinite(self.at_px).all()):
            raise ValueError("a start needs a center, px")
        if self.action != "restore" and self.what not in _DECIDED[self.action]:
            raise ValueError(f"{self.action} is for {' and '.join(_DECIDED[self.action])}, not for {self.what}")
        return self

    @property
    def thing(self) -> Thing:
        """The thing that it is about."""
        return self.what, self.file, self.star, self.target, self.estimator, self.landmark, self.area

    @property
    def area(self) -> Area:
        """Corners of the area; empty where there is none."""
        return tuple((x, y) for x, y in self.area_px or ())

    @property
    def name(self) -> str:
        """The thing in words."""
        if self.what in _WHOLE:
            return f"the {self.what}"
        if self.what is Edited.START:
            place = "" if self.at_px is None else f" at ({self.at_px[0]:.2f}, {self.at_px[1]:.2f}) px"
            return f"the start of {self.target}{place}"
        if self.what is Edited.MASK:
            (left, top), (right, bottom) = np.min(self.area, axis=0), np.max(self.area, axis=0)
            alone = "" if self.target is None else f", for {self.target} by {self.estimator}"
            return f"the area from ({left:.4g}, {top:.4g}) to ({right:.4g}, {bottom:.4g}) px{alone}"
        if self.what is Edited.LANDMARK:
            return f"landmark {self.landmark} of {self.target} by {self.estimator}"
        return f"star {self.star}" if self.star is not None else f"{self.target} by {self.estimator}"

    @property
    def line(self) -> str:
        """The edit in one line."""
        which = "" if self.what in _WHOLE else f" ({self.name})"
        what = "" if self.what == self.action else f" {self.what}"
        return _printable(f"{self.when_utc} {self.who}: {self.action}{what} {self.file}{which}: {self.why}")

    @property
    def decision(self) -> str:
        """The action in words: ``Rejected by hand``."""
        return _DECISIONS[self.action]

    def accepts(self, record: AttitudeRecord | ObservationRecord) -> bool:
        """True if a result is the one that was accepted: within its sigma, with no other flag that makes it suspect."""
        if self.action != "accept" or record.status != "suspect" or not suspect_flags(record) <= set(self.flags):
            return False
        if isinstance(record, ObservationRecord):
            if record.center_px is None or record.covariance_px2 is None or self.at_px is None:
                return False
            moved, sigma = np.subtract(record.center_px, self.at_px), np.sqrt(np.diag(np.array(record.covariance_px2)))
        else:
            if record.attitude is None or self.quaternion_xyzw is None:
                return False
            moved = (record.attitude.rotation * Rotation.from_quat(self.quaternion_xyzw).inv()).as_rotvec()
            sigma = np.nan_to_num(record.attitude.sigma_rad) + _ROUNDING_RAD
        return bool((np.abs(moved) <= sigma).all())

    @property
    def problem(self) -> Problem:
        """The reason for which a rejected thing has no result."""
        return Problem(reason=Reason.REJECTED, detail=f"{self.file}: by {self.who} on {self.when_utc}: {self.why}")


@dataclass(frozen=True, slots=True)
class Start:
    """Position of a target from which its estimators start, in place of the predicted one."""

    center_px: tuple[float, float]
    sigma_px: float
    who: str = field(compare=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class Measuring:
    """Decisions that change how an image is measured."""

    rejected_stars: frozenset[int] = frozenset()  # numbers of stars that are not to be used
    starts: Mapping[str, Start] = field(default_factory=dict)  # by target
    # masks by target and estimator; by two empty names those of the image
    areas: Mapping[tuple[str, str], tuple[Area, ...]] = field(default_factory=dict)
    # names of those that are not to be used, by target and estimator
    landmarks: Mapping[tuple[str, str], frozenset[str]] = field(default_factory=dict)

    @property
    def of_stars(self) -> list[object]:
        """Everything that the stars of the image depend on; empty where nobody decided."""
        return [*sorted(self.rejected_stars), *self.areas.get(("", ""), ())]

    def of_fix(self, target: str, estimator: str) -> list[object]:
        """Return what a fix depends on; empty where nobody decided."""
        start, of = self.starts.get(target), (target, estimator)
        started = [] if start is None else [start.center_px, start.sigma_px]
        return [*started, *self.areas.get(("", ""), ()), *self.areas.get(of, ()), *sorted(self.landmarks.get(of, ()))]

    def provenance(self, target: str, estimator: str) -> dict[str, str]:
        """Return what users decided on a fix, in words, for its provenance."""
        start, of, words = self.starts.get(target), (target, estimator), dict[str, str]()
        if start is not None:
            x, y = start.center_px
            words["start"] = f"center ({x:.2f}, {y:.2f}) px, sigma {start.sigma_px:g} px, by {start.who}"
        if (count := len(self.areas.get(("", ""), ())) + len(self.areas.get(of, ()))) > 0:
            words["masked"] = f"{count} area{'s' * (count > 1)} drawn by hand"
        if of in self.landmarks:
            words["landmarks_rejected"] = ", ".join(sorted(self.landmarks[of]))
        return words


@dataclass(frozen=True, slots=True)
class EditList:
    """Edits of a run in the order in which they were made."""

    edits: tuple[Edit, ...] = ()

    @property
    def standing(self) -> list[Edit]:
        """Decisions that were not taken back, the latest last."""
        last = dict[Thing, Edit]()
        for edit in self.edits:
            last.pop(edit.thing, None)
            last[edit.thing] = edit
        return [edit for edit in last.values() if edit.action != "restore"]

    def measuring(self) -> dict[str, Measuring]:
        """Decisions that change how images are measured, by image."""
        found: dict[str, Measuring] = {}
        for edit in self.standing:
            known = found.get(edit.file, Measuring())
            if edit.star is not None:
                known = replace(known, rejected_stars=known.rejected_stars | {edit.star})
            elif edit.what is Edited.START and edit.target is not None and edit.at_px is not None:
                x, y = edit.at_px
                start = Start((x, y), edit.sigma_px or START_SIGMA_PX, edit.who)
                known = replace(known, starts={**known.starts, edit.target: start})
            elif edit.what is Edited.MASK:
                of = (edit.target or "", edit.estimator or "")
                known = replace(known, areas={**known.areas, of: (*known.areas.get(of, ()), edit.area)})
            elif edit.what is Edited.LANDMARK and edit.target and edit.estimator and edit.landmark:
                of, names = (edit.target, edit.estimator), frozenset({edit.landmark})
                known = replace(known, landmarks={**known.landmarks, of: known.landmarks.get(of, frozenset()) | names})
            found[edit.file] = known
        return found

    def rejected_images(self) -> dict[str, Problem]:
        """Images that are not to be used, with the reason."""
        return {edit.file: edit.problem for edit in self.standing if edit.what is Edited.IMAGE}

    def attitudes(self, records: Iterable[AttitudeRecord]) -> list[AttitudeRecord]:
        """Attitudes after the edits."""
        rejected = self.rejected_images()
        accepted = {edit.file: edit for edit in self.standing if edit.what is Edited.ATTITUDE}
        return [
            _apply_acceptance(record, accepted.get(record.file))
            if record.file not in rejected
            else _without_attitude(record, rejected[record.file])
            for record in records
        ]

    def bodies(self, images: Iterable[ObservationsRecord]) -> list[ObservationsRecord]:
        """Observations after the edits."""
        rejected = self.rejected_images()
        fixes = {(one.file, one.target, one.estimator): one for one in self.standing if one.what is Edited.FIX}
        edited = []
        for image in images:
            observations = []
            for record in image.observations:
                edit = fixes.get((image.file, record.target, record.estimator))
                problem = rejected.get(image.file)
                if problem is None and edit is not None and edit.action == "reject":
                    problem = edit.problem
                observations.append(
                    _without_fix(record, problem) if problem is not None else _apply_acceptance(record, edit)
                )
            edited.append(image.model_copy(update={"observations": observations}))
        return edited


def new_edit(run: RunFolder, wanted: Mapping[str, Any]) -> Edit:
    """Return a new edit of something that the run holds; a star gets its place in the image.

    ``wanted``: fields of :class:`Edit` but the time. InputError where incomplete or of nothing, with the nearest names.
    """
    when = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    try:
        edit = Edit.model_validate({**wanted, "quaternion_xyzw": None, "when_utc": when, "flags": []})
    except ValidationError as error:
        found = "; ".join(f"{'.'.join(map(str, one['loc'])) or 'edit'}: {one['msg']}" for one in error.errors())
        raise InputError(f"this is no edit: {_printable(found)[:300]}") from error
    edit = edit.model_copy(update={"why": _one_line(edit.why, "a reason"), "who": _one_line(edit.who, "a name")})
    files = list(dict.fromkeys(file for file, *_ in run.keys(AttitudeRecord)))
    edit = edit.model_copy(update={"file": find_image(edit.file, files, run.path)})
    known = read_edits(run.path)
    if edit.action == "restore":
        return _restore(run, edit, [each for each in known.standing if each.file == edit.file])
    if edit.target is not None:
        _require_fix(run, edit)
    if edit.landmark is not None:
        _require_landmark(run, edit)
    if edit.what is Edited.MASK:
        _require_pixels(run, edit)
    if edit.action == "start":
        return _start(run, edit)
    edit = edit.model_copy(update={"at_px": None})
    if edit.action == "accept":
        return _accept(run, edit, known)
    return _with_place(run, edit, known) if edit.star is not None else edit


def _restore(run: RunFolder, edit: Edit, standing: Sequence[Edit]) -> Edit:
    """Edit that takes a decision back; of an image without further words, the last one on the image as a whole."""
    if edit.what is Edited.IMAGE:
        whole = next((each.what for each in reversed(standing) if each.what in _WHOLE), edit.what)
        edit = edit.model_copy(update={"what": whole})
    if edit.thing not in {each.thing for each in standing}:
        there = ", ".join(each.name for each in standing) or "nothing"
        raise InputError(f"{run.path}: {edit.file}: there is no decision on {edit.name}; decided on: {there}")
    return edit


def _accept(run: RunFolder, edit: Edit, known: EditList) -> Edit:
    """Edit with the result that it accepts; refuses one that is not suspect."""
    of = (edit.file, edit.target or "", edit.estimator or "")
    bodies = (one for image in known.bodies(run.bodies()) for one in image.observations)
    records: list[AttitudeRecord | ObservationRecord] = [*known.attitudes(run.attitudes()), *bodies]
    record = next((one for one in records if (one.file, *one.subject) == of), None)
    name = f"{run.path}: {edit.file}: {edit.name}"
    if record is None or record.accepted is not None:
        raise InputError(f"{name} is {'not in the run any more' if record is None else record.accepted}")
    if record.outcome is not Outcome.SUSPECT:
        reason = "" if record.problem is None else f" ({record.problem.reason})"
        raise InputError(f"{name} is {record.outcome.words}{reason}: only suspect results can be accepted")
    changes: dict[str, object] = {"flags": sorted(suspect_flags(record))}
    if isinstance(record, ObservationRecord):
        changes["at_px"] = record.center_px
    elif record.attitude is not None:
        changes["quaternion_xyzw"] = record.attitude.quaternion_xyzw
    return edit.model_copy(update=changes)


def _start(run: RunFolder, edit: Edit) -> Edit:
    """Edit with its sigma; refuses a center that is farther outside of the image than it is large."""
    record = run.load(AttitudeRecord, edit.file, light=True)
    assert edit.at_px is not None
    size = (0, 0) if record is None else (record.columns, record.rows)
    if not all(-n <= at <= 2 * n for at, n in zip(edit.at_px, size, strict=True)):
        at = ", ".join(f"{each:g}" for each in edit.at_px)
        raise InputError(
            f"{run.path}: {edit.file}: a start at ({at}) px is far outside of its {size[0]} x {size[1]} px"
        )
    return edit.model_copy(update={"sigma_px": edit.sigma_px or START_SIGMA_PX})


def suspect_flags(record: AttitudeRecord | ObservationRecord) -> set[str]:
    """Names of the flags that make a result suspect."""
    return {flag for flag in record.flags if Quality[flag.upper()].suspect}


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
    if edit.estimator is None and edit.target in {target for target, _ in there}:
        return
    if (edit.target, edit.estimator) not in there:
        names = ", ".join(f"{target} by {name}" for target, name in there) or "none"
        raise InputError(
            f"{run.path}: {edit.file} has no observation of {edit.target!r} by {edit.estimator!r}; there are: {names}"
        )


def _require_landmark(run: RunFolder, edit: Edit) -> None:
    """Refuse a landmark that a fix does not use."""
    record = run.load(ObservationRecord, edit.file, (edit.target or "", edit.estimator or ""))
    names = [] if record is None or record.landmarks is None else record.landmarks.names
    if edit.landmark not in names:
        near = difflib.get_close_matches(edit.landmark or "", names)
        ending = f"; the nearest names are {', '.join(near)}" if near else ""
        raise InputError(f"{run.path}: {edit.file}: {edit.name} is not one of its {len(names)}{ending}")


def _require_pixels(run: RunFolder, edit: Edit) -> None:
    """Refuse an area that has no pixel of the image in it, or all of them."""
    record = run.load(AttitudeRecord, edit.file, light=True)
    shape = (0, 0) if record is None else (record.rows, record.columns)
    if not 0 < (count := int(mask_of([edit.area], shape).sum())) < shape[0] * shape[1]:
        none = "none" if count == 0 else "all"
        raise InputError(f"{run.path}: {edit.file}: {edit.name} has {none} of its {shape[1]} x {shape[0]} pixels in it")


def mask_of(areas: Iterable[Area], shape: tuple[int, int]) -> Mask:
    """Mask (rows, columns) of the pixels in polygons, whose corners are not farther out than a million px."""
    import cv2

    drawn = np.zeros(shape, dtype=np.uint8)
    for area in areas if drawn.size else ():
        corners = np.rint(np.clip(area, -_FAR_PX, _FAR_PX) * 2**_SHIFT).astype(np.int32)
        cv2.fillPoly(drawn, [corners], (1,), shift=_SHIFT)
    return drawn.astype(bool)


def _words(names: Iterable[str]) -> str:
    """Names of fields as words."""
    return " and ".join(f"{name.removesuffix('_px')}" for name in _PARTS if name in names) or "nothing else"


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


def _apply_acceptance(record: Decided, edit: Edit | None) -> Decided:
    """The result with its acceptance, where it is still the accepted one."""
    if edit is None or not edit.accepts(record):
        return record
    return record.model_copy(update={"accepted": Acceptance(who=edit.who, when_utc=edit.when_utc, why=edit.why)})


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
