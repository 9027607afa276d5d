"""Lock of a run folder: one run at a time writes to it; a second one gets an error that names the holder."""

from __future__ import annotations

import contextlib
import getpass
import json
import os
import socket
import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path

from giantlike._system.atomic import write_text_atomic
from giantlike.core.errors import DataError, InputError

_LOCK, _HOLDER = ".lock", ".lock.json"
_MIN_WAIT_S = 0.2  # wait for another process that looks whether the folder is in use, which takes a millisecond


@contextlib.contextmanager
def hold_lock(folder: Path) -> Iterator[str | None]:
    """Hold the lock of a run folder inside a ``with`` block, by a transaction on a file that ends with the process.

    Yields None if the last one ended well.
    """
    with contextlib.closing(_taken(folder)) as connection:
        before = holder_of(folder)
        now = {
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "user": _user(),
            "since_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        }
        write_text_atomic(folder / _HOLDER, json.dumps(now) + "\n")
        try:
            yield before
        finally:
            (folder / _HOLDER).unlink(missing_ok=True)
            connection.rollback()


def is_locked(folder: Path) -> bool:
    """Return True if a run holds the lock of a folder."""
    if not (folder / _LOCK).exists():
        return False
    try:
        with contextlib.closing(_taken(folder)) as connection:
            connection.rollback()
    except InputError:
        return True
    return False


def holder_of(folder: Path) -> str | None:
    """Process that holds the lock of a folder, or died holding it, in words; None if the last one ended well."""
    try:
        who = json.loads((folder / _HOLDER).read_text(encoding="utf-8"))
        return f"process {who['pid']} of {who['user']} on {who['host']}, started {who['since_utc']}"
    except (OSError, ValueError, KeyError, TypeError):
        return None


def at_work_text(folder: Path) -> str:
    """Sentence on a run that holds the lock of a folder."""
    return f"{folder}: a run is at work here ({holder_of(folder) or 'another process'}): wait for it or stop it"


def _taken(folder: Path) -> sqlite3.Connection:
    connection = None
    try:
        connection = sqlite3.connect(folder / _LOCK, timeout=_MIN_WAIT_S, isolation_level=None)
        connection.execute("BEGIN EXCLUSIVE")
    except sqlite3.Error as error:
        if connection is not None:
            connection.close()
        if getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_BUSY:
            raise InputError(f"{at_work_text(folder)}, or choose another output") from error
        raise DataError(folder / _LOCK, f"cannot be written: {error}") from error
    return connection


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):  # a process without an entry in the list of users
        return "an unknown user"
