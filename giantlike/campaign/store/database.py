"""The results of a run in one SQLite file: a row for each image, and for each image, step, target and estimator.

While a run writes, the file is in WAL mode: every record is a separate transaction, and any number of readers see the
last. At the end the log is written back, which leaves a plain file that can be copied and read from read-only media.
"""

from __future__ import annotations

import contextlib
import sqlite3
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias, TypeVar

from giantlike.core.errors import DataError

Unit: TypeAlias = tuple[str, str, str, str]
"""Key of a record: step, image, target and estimator (empty where the step has none)."""

Content = TypeVar("Content", str, bytes)

_SCHEMA_VERSION = 1
_WAIT_S = 60.0  # longest wait for another process that writes, for milliseconds, on a busy disk for seconds
_SCHEMA = """
CREATE TABLE images (file TEXT PRIMARY KEY, place INTEGER, path TEXT, stamp TEXT, sha256 TEXT);
CREATE TABLE records (step TEXT, file TEXT, target TEXT, estimator TEXT, place INTEGER, key TEXT, light TEXT,
                      points BLOB, light_crc INTEGER, points_crc INTEGER,
                      PRIMARY KEY (step, file, target, estimator));
"""
_IS_UNIT = "step = ? AND file = ? AND target = ? AND estimator = ?"
_NEW_IMAGE = "INSERT OR IGNORE INTO images VALUES (?, (SELECT COUNT(*) FROM images), '', '', '')"
_PUT = """
INSERT INTO records VALUES (?, ?, ?, ?, (SELECT COUNT(*) FROM records WHERE step = ? AND file = ?), ?, ?, ?, ?, ?)
ON CONFLICT (step, file, target, estimator) DO UPDATE SET key = excluded.key, light = excluded.light,
points = excluded.points, light_crc = excluded.light_crc, points_crc = excluded.points_crc
"""
_ORDERED = """
SELECT images.place, images.path, light, light_crc FROM records JOIN images USING (file)
WHERE step = ? AND images.place IS NOT NULL AND records.place IS NOT NULL ORDER BY images.place, records.place
"""


@dataclass(frozen=True, slots=True)
class Row:
    """A record as it is stored."""

    light: str  # JSON of the record without its lists of points
    points: bytes | None  # the whole record, packed; None where it has no such lists


@dataclass(frozen=True, slots=True)
class KnownImage:
    """An image file as recorded in the run folder."""

    stamp: str  # size and time of change
    sha256: str  # of its content; empty if it could not be read


class Database:
    """The file; opened for each access, or kept open inside ``with database.open_for_writing():``."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._open: sqlite3.Connection | None = None

    def exists(self) -> bool:
        """Return True if there is such a file; while it is being made, its size is 0."""
        try:
            return self.path.stat().st_size > 0
        except OSError:
            return False

    @contextlib.contextmanager
    def open_for_writing(self) -> Iterator[None]:
        """Context manager that keeps the file open, in WAL mode."""
        with self._border(), contextlib.closing(self._connect(write=True)) as connection:
            # a file system without shared memory (some network ones) keeps another journal: as safe, and slower.
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = NORMAL")
            self._open = connection
            try:
                yield
            finally:
                self._open = None
                with contextlib.suppress(sqlite3.OperationalError):  # a reader is at it: the next run tidies up
                    connection.execute("PRAGMA journal_mode = DELETE")

    @contextlib.contextmanager
    def open_for_reading(self) -> Iterator[None]:
        """Context manager that keeps the file open for reading; it does nothing where it is open."""
        if self._open is not None:
            yield
            return
        with self._border(), contextlib.closing(self._connect(write=False)) as connection:
            self._open = connection
            try:
                yield
            finally:
                self._open = None

    def put(self, unit: Unit, key: str, row: Row) -> None:
        """Write a record."""
        step, file = unit[:2]
        with self._open_connection(write=True) as connection:
            connection.execute(_NEW_IMAGE, (file,))
            connection.execute(_PUT, (*unit, step, file, key, row.light, row.points, _crc(row.light), _crc(row.points)))

    def get(self, unit: Unit) -> Row | None:
        """Return a record; None if there is none."""
        with self._open_connection() as connection:
            found = connection.execute(
                f"SELECT light, light_crc, points, points_crc FROM records WHERE {_IS_UNIT}", unit
            ).fetchone()
        if found is None:
            return None
        light, light_crc, points, points_crc = found
        return Row(self._check_crc(light, light_crc), None if points is None else self._check_crc(points, points_crc))

    def keys(self, step: str) -> dict[tuple[str, str, str], str]:
        """Hashes of the records of a step, damaged ones left out."""
        with self._open_connection() as connection:
            rows = connection.execute(
                "SELECT file, target, estimator, key, light, light_crc, points, points_crc FROM records WHERE step = ?",
                (step,),
            )
            return {
                (file, target, estimator): key
                for file, target, estimator, key, light, light_crc, points, points_crc in rows
                if _crc(light) == light_crc and _crc(points) == points_crc
            }

    def rows(self, step: str) -> Iterator[tuple[int, str, str]]:
        """Yield place, path and record without points of a step, those that are part of the run, in input order."""
        with self._open_connection() as connection:
            for place, path, light, crc in connection.execute(_ORDERED, (step,)):
                yield place, path, self._check_crc(light, crc)

    def delete(self, units: Iterable[Unit]) -> None:
        """Delete records."""
        with self._open_connection(write=True) as connection:
            connection.executemany(f"DELETE FROM records WHERE {_IS_UNIT}", units)

    def images(self) -> dict[str, KnownImage]:
        """Every image in the file, part of the run or not, by name."""
        with self._open_connection() as connection:
            rows = connection.execute("SELECT file, stamp, sha256 FROM images")
            return {file: KnownImage(stamp or "", sha256 or "") for file, stamp, sha256 in rows}

    def set_images(self, images: Sequence[tuple[str, str]]) -> None:
        """Say which images are part of the run, and in which order."""
        with self._open_connection(write=True) as connection:
            connection.execute("UPDATE images SET place = NULL")
            connection.executemany(
                "INSERT INTO images (file, place, path) VALUES (?, ?, ?) "
                "ON CONFLICT (file) DO UPDATE SET place = excluded.place, path = excluded.path",
                [(file, place, path) for place, (file, path) in enumerate(images)],
            )

    def set_image_state(self, file: str, known: KnownImage) -> None:
        """Store the hash of an image file when it was read."""
        with self._open_connection(write=True) as connection:
            connection.execute(
                "UPDATE images SET stamp = ?, sha256 = ? WHERE file = ?", (known.stamp, known.sha256, file)
            )

    def set_places(self, step: str, places: dict[tuple[str, str, str], int]) -> None:
        """Store which records of a step are part of the run, and the order of the records of one image."""
        with self._open_connection(write=True) as connection:
            connection.execute("UPDATE records SET place = NULL WHERE step = ?", (step,))
            connection.executemany(
                f"UPDATE records SET place = ? WHERE {_IS_UNIT}",
                [(place, step, *unit) for unit, place in places.items()],
            )

    def adopt(self, other: Database, path_here: Callable[[str], str]) -> None:
        """Append the images that are part of another run, with their records."""
        with other._open_connection() as source, self._open_connection(write=True) as connection:
            here = {file for (file,) in connection.execute("SELECT file FROM images")}
            images = source.execute(
                "SELECT file, place, path, stamp, sha256 FROM images WHERE place IS NOT NULL ORDER BY place"
            )
            for file, _, path, stamp, sha256 in images.fetchall():
                if file in here:
                    continue
                place = "(SELECT COUNT(*) FROM images)"
                row = (file, path_here(path or file), stamp, sha256)
                connection.execute(f"INSERT INTO images VALUES (?, {place}, ?, ?, ?)", row)
                records = source.execute("SELECT * FROM records WHERE file = ?", (file,))
                connection.executemany("INSERT INTO records VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", records)

    def _check_crc(self, content: Content, crc: int) -> Content:
        if _crc(content) != crc:
            raise DataError(self.path, "holds a damaged record: run the campaign again, which makes it anew")
        return content

    @contextlib.contextmanager
    def _open_connection(self, *, write: bool = False) -> Iterator[sqlite3.Connection]:
        """The open connection, or one for this access; writes form one transaction."""
        with self._border(), contextlib.ExitStack() as ending:
            connection = self._open
            if connection is None:
                connection = ending.enter_context(contextlib.closing(self._connect(write=write)))
            if write:
                ending.enter_context(connection)
            yield connection

    def _connect(self, *, write: bool) -> sqlite3.Connection:
        new = not self.exists()
        if new and not write:
            raise DataError(self.path, "is missing: this is not the folder of a run")
        connection = sqlite3.connect(self.path, timeout=_WAIT_S)
        try:
            if new:
                connection.executescript(f"BEGIN; {_SCHEMA} PRAGMA user_version = {_SCHEMA_VERSION}; COMMIT;")
            (version,) = connection.execute("PRAGMA user_version").fetchone()
            if version != _SCHEMA_VERSION:
                raise DataError(
                    self.path,
                    f"has form {version}, and this version reads form {_SCHEMA_VERSION}: read it with the version that "
                    "wrote it (see provenance.json), or run the campaign into another folder",
                )
        except BaseException:
            connection.close()
            raise
        return connection

    @contextlib.contextmanager
    def _border(self) -> Iterator[None]:
        """Errors of SQLite become a :class:`DataError`."""
        try:
            yield
        except sqlite3.OperationalError as error:
            raise DataError(self.path, f"cannot be read or written: {_one_line(error)}") from error
        except (sqlite3.Error, UnicodeDecodeError) as error:
            raise DataError(
                self.path, f"is damaged ({_one_line(error)}): delete it, and giantlike run makes all results again"
            ) from error


def _one_line(error: Exception) -> str:
    """Text of an error in one line: SQLite quotes whole definitions of tables."""
    return " ".join(str(error).split())


def _crc(content: object) -> int | None:
    """Checksum of text or bytes; None for other types."""
    if isinstance(content, str):
        content = content.encode()
    return zlib.crc32(content) if isinstance(content, bytes) else None
