"""The run folder while a run is going on: one small file per finished image, and a log.

Parts are written whole or not at all, so a kill at any moment loses the images in flight and nothing else.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from pydantic import ValidationError

from giantlike.campaign.store.provenance import changes
from giantlike.campaign.store.records import AttitudeRecord, CalibrationRecord, ObservationsRecord
from giantlike.core.atomic import write_text_atomic
from giantlike.core.errors import DataError, InputError
from giantlike.core.outcomes import Reason

Record = TypeVar("Record", AttitudeRecord, ObservationsRecord, CalibrationRecord)
LightRecord = TypeVar("LightRecord", AttitudeRecord, ObservationsRecord)
AnyRecord: TypeAlias = AttitudeRecord | ObservationsRecord | CalibrationRecord

_PROVENANCE = "provenance.json"
_PARTS = "parts"
_LOG = "log.jsonl"
_TRIED_AGAIN = frozenset({Reason.UNREADABLE_IMAGE, Reason.INTERNAL_ERROR})


class RunFolder:
    """A run folder; see :meth:`start` for a run and :meth:`open` for reading one.

    Parameters
    ----------
    path : Path
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def start(cls, path: Path, inputs: Mapping[str, Any], environment: Mapping[str, Any], *, resume: bool) -> RunFolder:
        """Create a run folder, or go on with one.

        Parameters
        ----------
        path : Path
            Must not exist or be empty, unless ``resume``.
        inputs : mapping
            What decides the results; a run that is continued must have the same.
        environment : mapping
            Noted as well.
        resume : bool

        Raises
        ------
        InputError
            The folder holds something and ``resume`` is not set, it is no run folder, or the inputs changed.
        DataError
            The folder cannot be made.
        """
        folder = cls(path)
        try:
            path.mkdir(parents=True, exist_ok=True)
            used = any(not item.name.startswith(".") for item in path.iterdir())
        except OSError as error:
            raise DataError(path, f"cannot make the run folder: {error.strerror or error}") from error
        if used and not resume:
            raise InputError(
                f"{path}: the run folder is not empty; continue that run with --resume, or choose another output"
            )
        if used:
            folder._check_same(inputs)
        else:
            folder.write_provenance({"inputs": inputs, "environment": environment})
        try:
            (path / _PARTS).mkdir(exist_ok=True)
        except OSError as error:
            raise DataError(path / _PARTS, f"cannot be made: {error.strerror or error}") from error
        return folder

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """Open the folder of a run that was started before.

        Raises
        ------
        DataError
            There is no run in it.
        """
        folder = cls(path)
        folder.provenance()
        return folder

    def provenance(self) -> dict[str, Any]:
        """Return what the run was made from.

        Raises
        ------
        DataError
            ``provenance.json`` is missing or damaged: this is no run folder.
        """
        try:
            content = json.loads((self.path / _PROVENANCE).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            if not self.path.exists():
                raise DataError(self.path, "there is no such run folder") from error
            raise DataError(self.path, f"is no run folder: {_PROVENANCE} is missing or damaged") from error
        if not isinstance(content, dict):
            raise DataError(self.path, f"is no run folder: {_PROVENANCE} is damaged")
        return content

    def write_provenance(self, content: Mapping[str, Any]) -> None:
        """Write ``provenance.json``."""
        write_text_atomic(self.path / _PROVENANCE, json.dumps(content, indent=1, default=str) + "\n")

    def _check_same(self, inputs: Mapping[str, Any]) -> None:
        before = self.provenance().get("inputs", {})
        now = json.loads(json.dumps(inputs, default=str))
        changed = changes(before, now)
        if changed:
            names = ", ".join(changed[:5]) + (f" and {len(changed) - 5} more" if len(changed) > 5 else "")
            raise InputError(
                f"{self.path}: this run cannot be continued, because {names} changed since it was started; "
                "undo that, or choose another output"
            )

    def save(self, record: AnyRecord, stamp: str) -> None:
        """Keep the record of a finished image, and which state of the image file (:func:`stamp_of`) it is of."""
        write_text_atomic(self._part(type(record), record.index), f"{stamp}\n{record.model_dump_json()}")

    def load(self, kind: type[Record], index: int, file: str) -> Record | None:
        """Record of an image, None when it is not finished (or its part is damaged)."""
        try:
            record = _read(kind, self._part(kind, index))[1]
        except (OSError, ValidationError):
            return None
        return record if record.file == file else None

    def load_valid(self, kind: type[Record], index: int, file: str, stamp: str) -> Record | None:
        """Record of an image that need not be made again.

        None as well where the image file has another stamp than when the record was made, and where the record
        says that the image could not be read or that something went wrong inside: that may have been put right.
        """
        record = self.load(kind, index, file)
        if record is None or _read(kind, self._part(kind, index))[0] != stamp:
            return None
        if isinstance(record, ObservationsRecord):
            problems = [one.problem for one in record.observations]
        else:
            problems = [record.problem]
        return None if any(problem is not None and problem.reason in _TRIED_AGAIN for problem in problems) else record

    def drop_observations(self, index: int) -> None:
        """Forget the observations of an image, if there are any: it turned out to be one without."""
        self._part(ObservationsRecord, index).unlink(missing_ok=True)

    def load_all(self, kind: type[LightRecord]) -> list[LightRecord]:
        """All records of a kind, in input order, without their lists of points."""
        suffix = _SUFFIXES[kind]
        paths = sorted((self.path / _PARTS).glob(f"*.{suffix}.json"))
        try:
            return [_read(kind, path)[1].light() for path in paths]
        except (OSError, ValidationError) as error:
            raise DataError(
                self.path / _PARTS, f"holds a damaged part: {' '.join(str(error).split())[:200]}"
            ) from error

    def log(self, event: str, **values: Any) -> None:
        """Add a line to ``log.jsonl``.

        Raises
        ------
        DataError
            The file cannot be written.
        """
        line = {"time_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), "event": event} | values
        try:
            with (self.path / _LOG).open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(line, default=str) + "\n")
        except OSError as error:
            raise DataError(self.path / _LOG, f"cannot be written: {error.strerror or error}") from error

    def _part(self, kind: type[AnyRecord], index: int) -> Path:
        return self.path / _PARTS / f"{index:06d}.{_SUFFIXES[kind]}.json"


_SUFFIXES: Mapping[type[AnyRecord], str] = {
    CalibrationRecord: "calibration",
    AttitudeRecord: "attitude",
    ObservationsRecord: "observations",
}


def _read(kind: type[Record], path: Path) -> tuple[str, Record]:
    """Stamp of the image (first line of a part) and record (the rest)."""
    stamp, _, record = path.read_bytes().partition(b"\n")
    return stamp.decode("ascii", "replace"), kind.model_validate_json(record)


def stamp_of(path: Path) -> str:
    """Size and time of change of an image file: another stamp means that it was written again; empty without file."""
    try:
        status = path.stat()
    except OSError:
        return ""
    return f"{status.st_size} {status.st_mtime_ns}"
