"""The run folder: results, provenance and log of a run, while it is going on and after."""

from __future__ import annotations

import contextlib
import difflib
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from giantlike._system.atomic import make_folder, write_text_atomic
from giantlike.campaign.store.database import Database, KnownImage, Unit
from giantlike.campaign.store.log import log_event
from giantlike.campaign.store.odd_epochs import odd_epochs
from giantlike.campaign.store.packing import PackedRecord, make_damage_error, points_of, unpack
from giantlike.campaign.store.records import (
    AttitudeRecord,
    ImageRecord,
    ObservationRecord,
    ObservationsRecord,
    TargetRecord,
)
from giantlike.core.arrays import require
from giantlike.core.errors import DataError, InputError
from giantlike.core.outcomes import Quality, Reason

Record = TypeVar("Record", bound=ImageRecord)
Flagged = TypeVar("Flagged", AttitudeRecord, ObservationRecord)

CAMERA_FILE, CALIBRATION_FILE, RESIDUALS_FILE = "camera.toml", "calibration.json", "calibration_residuals.csv"
"""Files that a calibration writes into the run folder: the camera, the summary, every residual."""
CALIBRATION_PAGE, REPORT_PAGE = "calibration.html", "report.html"
RESULTS_FILE = "results.sqlite"
NETWORK_FILE = "network/result.json"
TRANSFER = "transfer"  # step whose records, attitudes from neighbors in time, replace those of the step ``attitude``
_PROVENANCE = "provenance.json"
_PARTS = "parts"
_TRIED_AGAIN = frozenset({Reason.UNREADABLE_IMAGE, Reason.INTERNAL_ERROR})


class RunFolder:
    """Folder of one run; see :meth:`start` for making a run and :meth:`open` for reading one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._results = Database(path / RESULTS_FILE)

    @classmethod
    def start(cls, path: Path, inputs: Mapping[str, Any], environment: Mapping[str, Any]) -> RunFolder:
        """Create a run folder, or go on with one."""
        folder = cls(path)
        folder.check_usable()
        make_folder(path)
        folder.write_provenance({"inputs": inputs, "environment": environment})
        return folder

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """Open the folder of a run that was started before."""
        folder = cls(path)
        folder.provenance()
        folder._check_version()
        return folder

    def check_usable(self) -> None:
        """Raise unless a run can be made here: nothing is there yet, or a run."""
        if not self.path.exists():
            return
        require(self.path.is_dir(), f"{self.path}: is a file, and a run needs a folder: choose another output")
        self._check_version()
        others = [item.name for item in self.path.iterdir() if not item.name.startswith(".")]
        if others and not (self.path / _PROVENANCE).is_file():
            raise InputError(
                f"{self.path}: is not empty and is not a run folder (it holds {sorted(others)[0]!r}); "
                "choose another output"
            )

    def _check_version(self) -> None:
        if (self.path / _PARTS).is_dir() and not self._results.exists():
            raise DataError(
                self.path,
                "was made by version 0.2 or older, which kept a file for each image; its tables are still good: for "
                "report and export read it with that version, or run the campaign again into another folder",
            )

    def provenance(self) -> dict[str, Any]:
        """Read ``provenance.json``."""
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
        """Write ``provenance.json``."""
        write_text_atomic(self.path / _PROVENANCE, json.dumps(content, indent=1, default=str) + "\n")

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """Context manager that keeps the results open, which makes many writes fast."""
        with self._results.open_for_writing():
            yield

    def save(self, record: ImageRecord | PackedRecord[Any], key: str, *, step: str | None = None) -> None:
        """Keep a record."""
        packed = PackedRecord.from_record(record) if isinstance(record, ImageRecord) else record
        light = packed.light
        if _TRIED_AGAIN & {problem.reason for problem in light.problems}:
            key = ""
        self._results.put(_unit(type(light), light.file, light.subject, step), key, packed.row)

    def load(
        self,
        kind: type[Record],
        file: str,
        of: tuple[str, str] = ("", ""),
        *,
        step: str | None = None,
        light: bool = False,
    ) -> Record | None:
        """Return a record; None if there is none."""
        row = self._results.get(_unit(kind, file, of, step))
        if row is None:
            return None
        try:
            if row.points is None or light:
                return kind.model_validate_json(row.light)
            return kind.model_validate(unpack(row.points))
        except ValueError as error:
            raise make_damage_error(self._results.path, error) from error

    def keys(self, kind: type[ImageRecord], *, step: str | None = None) -> dict[tuple[str, str, str], str]:
        """Hashes of the records of a kind; empty where unreadable images or internal errors are to be tried again."""
        return self._results.keys(step or kind.part) if self._results.exists() else {}

    def load_all(self, kind: type[Record], *, step: str | None = None) -> Iterator[Record]:
        """Yield the records of a kind that are part of the run, in input order, without their lists of points."""
        for place, path, light in self._results.rows(step or kind.part):
            try:
                record = kind.model_validate_json(light)
            except ValidationError as error:
                raise make_damage_error(self._results.path, error) from error
            today: dict[str, Any] = {"index": place}
            if path and isinstance(record, AttitudeRecord):
                today["path"] = path
            yield record.model_copy(update=today)

    def points(self, record: ImageRecord) -> dict[str, Any]:
        """Lists of points that a record was kept with, long ones as arrays. The result is empty for a failure."""
        return points_of(record, self.packed_points(record), self._results.path)

    def packed_points(self, record: ImageRecord) -> bytes | None:
        """Lists of points that a record was kept with, for :func:`points_of`; None if there are none."""
        row = None if record.problems else self._results.get(_unit(type(record), record.file, record.subject, None))
        return None if row is None else row.points

    @contextlib.contextmanager
    def reading(self) -> Iterator[None]:
        """Context manager that keeps the results open, which makes many reads fast."""
        with self._results.open_for_reading():
            yield

    def attitudes(self) -> list[AttitudeRecord]:
        """Attitudes of all images, from stars, a priori or transferred, in input order, without lists of stars."""
        transferred = {record.file: record for record in self.load_all(AttitudeRecord, step=TRANSFER)}
        records = [transferred.get(record.file, record) for record in self.load_all(AttitudeRecord)]
        odd = odd_epochs({record.file: record.et for record in records})
        return [_mark_suspect(record) if record.file in odd else record for record in records]

    def bodies(self) -> list[ObservationsRecord]:
        """Observations of all images that show a body, in input order, without limb points and outlines."""
        images: dict[str, ObservationsRecord] = {}
        odd = odd_epochs({record.file: record.et for record in self.load_all(AttitudeRecord)})
        for record in self.load_all(ObservationRecord):
            image = images.setdefault(record.file, ObservationsRecord(index=record.index, file=record.file))
            image.observations.append(_mark_suspect(record) if record.file in odd else record)
        for target in self.load_all(TargetRecord):
            if target.file not in images:
                continue
            if target.sighting is not None:
                images[target.file].sightings.append(target.sighting)
            if target.note is not None:
                images[target.file].notes.append(target.note)
        return list(images.values())

    def drop(self, kind: type[ImageRecord], files: Iterable[str], *, step: str | None = None) -> None:
        """Delete the records of images."""
        self._results.delete(_unit(kind, file, ("", ""), step) for file in files)

    def has_results(self) -> bool:
        """Return True if a run has begun to write here."""
        return self._results.exists()

    def images(self) -> dict[str, KnownImage]:
        """Every image in the folder, by name."""
        return self._results.images() if self._results.exists() else {}

    def set_images(self, images: Sequence[tuple[str, str]]) -> None:
        """Say which images are part of the run, in input order: names, and paths relative to the folder."""
        self._results.set_images(images)

    def set_image_state(self, file: str, known: KnownImage) -> None:
        """Store the hash of an image file when it was read."""
        self._results.set_image_state(file, known)

    def set_places(self, kind: type[ImageRecord], places: dict[tuple[str, str, str], int]) -> None:
        """Store which records of a kind are part of the run, and the order of the records of one image."""
        self._results.set_places(kind.part, places)

    def adopt(self, other: RunFolder, path_here: Callable[[str], str]) -> None:
        """Add the images of another run, with their records, except images that are here already."""
        self._results.adopt(other._results, path_here)

    def log(self, event: str, **values: Any) -> None:
        """Log an event of this run, see :func:`~giantlike.campaign.store.log.log_event`."""
        log_event(self.path, event, **values)


def _mark_suspect(record: Flagged) -> Flagged:
    """Record of an image with an odd epoch: what it holds is suspect."""
    if record.status == "failed":
        return record
    (flag,) = Quality.ODD_EPOCH.names()
    flags = record.flags if flag in record.flags else [*record.flags, flag]
    return record.model_copy(update={"status": "suspect", "flags": flags})


def stamp_of(path: Path) -> str:
    """Size and time of change of an image file; empty if there is no file."""
    try:
        status = path.stat()
    except OSError:
        return ""
    return f"{status.st_size} {status.st_mtime_ns}"


def _unit(kind: type[ImageRecord], file: str, of: tuple[str, str], step: str | None) -> Unit:
    return (step or kind.part, file, *of)


_SHOWN = 4  # number of names in a message


def find_image(name: str, files: Collection[str], run: Path) -> str:
    """Name of an image in the tables, by name, the end of its path or the beginning; InputError names the nearest."""
    if name in files:
        return name
    wanted = Path(name).name
    found = [file for file in files if Path(file).name == wanted or (wanted and Path(file).name.startswith(wanted))]
    if len(found) == 1:
        return found[0]
    if found:
        others = f" and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
        raise InputError(f"{run}: {name!r} may be {', '.join(found[:_SHOWN])}{others}: give the whole name")
    near = difflib.get_close_matches(wanted, files, n=_SHOWN, cutoff=0.5) or list(files)[:1]
    others = f", then {', '.join(near[1:])}" if near[1:] else ""
    ending = f"the nearest name is {near[0]}{others}" if near else "there are none"
    raise InputError(f"{run}: there is no image {name!r} in this run; {ending}")
