"""The run folder while a run is going on: one small file, a part, for each finished image and step.

Parts are written whole or not at all, so a kill at any moment loses the images in flight and nothing else.
The first line of a part is its stamp: the state of the inputs it was made from. A part whose stamp differs from that of
today is made again, so that what a change invalidates is decided by what goes into the stamp.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from giantlike.campaign.store.log import log_event
from giantlike.campaign.store.records import ImageRecord, ObservationsRecord
from giantlike.core.atomic import make_folder, write_text_atomic
from giantlike.core.errors import DataError, InputError
from giantlike.core.outcomes import Reason

Record = TypeVar("Record", bound=ImageRecord)

CAMERA_FILE, CALIBRATION_FILE, RESIDUALS_FILE = "camera.toml", "calibration.json", "calibration_residuals.csv"
"""What a calibration writes into the run folder: the camera, the summary, every residual."""
CALIBRATION_PAGE, REPORT_PAGE = "calibration.html", "report.html"
_PROVENANCE = "provenance.json"
_PARTS = "parts"
_TRIED_AGAIN = frozenset({Reason.UNREADABLE_IMAGE, Reason.INTERNAL_ERROR})


class RunFolder:
    """Folder of one run; see :meth:`start` for making a run and :meth:`open` for reading one.

    Parameters
    ----------
    path : Path
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def start(cls, path: Path, inputs: Mapping[str, Any], environment: Mapping[str, Any], *, resume: bool) -> RunFolder:
        """Create a run folder, or continue with one.

        Parameters
        ----------
        path : Path
            Must not exist or be empty, unless ``resume`` is set.
        inputs : mapping
            Everything that decides the results; a run that is continued must have the same.
        environment : mapping
            Written to ``provenance.json`` as well.
        resume : bool
            Continue a run.

        Returns
        -------
        RunFolder

        Raises
        ------
        InputError
            The folder is not empty and ``resume`` is not set, or the inputs changed.
        DataError
            The folder cannot be made, or it is to be continued and is not a run folder.
        """
        folder = cls(path)
        make_folder(path)
        used = any(not item.name.startswith(".") for item in path.iterdir())
        if used and not resume:
            raise InputError(
                f"{path}: the run folder is not empty; continue that run with --resume, or choose another output"
            )
        if used:
            folder._check_same(inputs)
        else:
            folder.write_provenance({"inputs": inputs, "environment": environment})
        make_folder(path / _PARTS)
        return folder

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """Open the folder of a run that was started before.

        Parameters
        ----------
        path : Path

        Returns
        -------
        RunFolder

        Raises
        ------
        DataError
            There is no run in it.
        """
        folder = cls(path)
        folder.provenance()
        return folder

    def provenance(self) -> dict[str, Any]:
        """Read ``provenance.json``.

        Returns
        -------
        dict
            Versions, options and hashes that the run was made from, as JSON.

        Raises
        ------
        DataError
            The file is missing or damaged: this is not a run folder.
        """
        try:
            content = json.loads((self.path / _PROVENANCE).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            if not self.path.exists():
                raise DataError(self.path, "there is no such run folder") from error
            raise DataError(self.path, f"is not a run folder: {_PROVENANCE} is missing or damaged") from error
        if not isinstance(content, dict):
            raise DataError(self.path, f"is not a run folder: {_PROVENANCE} is damaged")
        return content

    def write_provenance(self, content: Mapping[str, Any]) -> None:
        """Write ``provenance.json``.

        Parameters
        ----------
        content : mapping
        """
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

    def save(self, record: ImageRecord, stamp: str) -> None:
        """Write the record of a finished image.

        Parameters
        ----------
        record : ImageRecord
        stamp : str
            State of the inputs it was made from; one line of ASCII, see :func:`stamp_of`.
        """
        write_text_atomic(self._part(type(record), record.index), f"{stamp}\n{record.model_dump_json()}")

    def load(self, kind: type[Record], index: int, file: str, *, stamp: str | None = None) -> Record | None:
        """Record of an image.

        Parameters
        ----------
        kind : type
            Of the record.
        index : int
        file : str
            Name of the image.
        stamp : str, optional
            If given, only a record made from these inputs is returned, and none that says that the image could not be
            read or of an internal error: that may have been put right.

        Returns
        -------
        record or None
            None if it is not finished, damaged, of another file or not valid any more.
        """
        try:
            made_from, record = _read(kind, self._part(kind, index))
        except (OSError, ValidationError):
            return None
        if record.file != file:
            return None
        if stamp is not None and (made_from != stamp or _TRIED_AGAIN & {each.reason for each in record.problems}):
            return None
        return record

    def drop_observations(self, index: int) -> None:
        """Delete the observations of an image, if there are any: it turned out to be one without.

        Parameters
        ----------
        index : int
        """
        self._part(ObservationsRecord, index).unlink(missing_ok=True)

    def load_all(self, kind: type[Record]) -> list[Record]:
        """All records of a kind, in input order, without their lists of points.

        Parameters
        ----------
        kind : type
            Of the records.

        Returns
        -------
        list

        Raises
        ------
        DataError
            One of them is damaged.
        """
        parts = self.path / _PARTS
        try:
            return [_read(kind, path)[1].light() for path in sorted(parts.glob(f"*.{kind.part}.json"))]
        except (OSError, ValidationError) as error:
            raise DataError(parts, f"holds a damaged part: {' '.join(str(error).split())[:200]}") from error

    def log(self, event: str, **values: Any) -> None:
        """Log an event of this run, see :func:`~giantlike.campaign.store.log.log_event`.

        Parameters
        ----------
        event : str
        **values
        """
        log_event(self.path, event, **values)

    def _part(self, kind: type[ImageRecord], index: int) -> Path:
        return self.path / _PARTS / f"{index:06d}.{kind.part}.json"


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Names of the inputs that differ, dotted down to what changed within tables.

    Parameters
    ----------
    before, now : mapping

    Returns
    -------
    list of str

    Examples
    --------
    >>> changes({"a": {"b": 1, "c": 2}, "d": 3}, {"a": {"b": 1, "c": 5}})
    ['a.c', 'd']
    """
    names: list[str] = []
    for key in dict.fromkeys([*before, *now]):
        old, new = before.get(key), now.get(key)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            names += [f"{key}.{name}" for name in changes(old, new)]
        elif old != new:
            names.append(key)
    return names


def stamp_of(path: Path) -> str:
    """Size and time of change of an image file; empty if there is no file.

    Parameters
    ----------
    path : Path

    Returns
    -------
    str
        Another one means that the file was written again.
    """
    try:
        status = path.stat()
    except OSError:
        return ""
    return f"{status.st_size} {status.st_mtime_ns}"


def _read(kind: type[Record], path: Path) -> tuple[str, Record]:
    """Stamp (first line of a part) and record (the rest)."""
    stamp, _, record = path.read_bytes().partition(b"\n")
    return stamp.decode("ascii", "replace"), kind.model_validate_json(record)
