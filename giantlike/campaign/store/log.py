"""Events of a run as lines of ``log.jsonl``: a handler of the logger ``giantlike.campaign``."""

from __future__ import annotations

import json
import logging
import time
from pathlib import Path
from typing import Any

from giantlike._system.atomic import append_text

LOGGER = logging.getLogger("giantlike.campaign")


def log_event(folder: Path, event: str, *, level: int = logging.INFO, **values: Any) -> None:
    """Log an event of a run. ``level`` as of :mod:`logging`."""
    text = ", ".join(f"{key}={value}" for key, value in values.items())
    extra = {"run_folder": folder, "line": {"event": event} | values}
    LOGGER.log(level, "%s: %s", event, text, extra=extra)


class RunLogHandler(logging.Handler):
    """Writes the events of one run, of any level, to its ``log.jsonl`` in a ``with`` block."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self._before = (logging.NOTSET, logging.NOTSET)

    def __enter__(self) -> None:
        self._before = (LOGGER.level, LOGGER.getEffectiveLevel())
        LOGGER.addHandler(self)
        LOGGER.addFilter(self._pass_on)
        LOGGER.setLevel(min(logging.INFO, LOGGER.getEffectiveLevel()))

    def __exit__(self, *_: object) -> None:
        LOGGER.removeHandler(self)
        LOGGER.removeFilter(self._pass_on)
        LOGGER.setLevel(self._before[0])

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line, if the record is an event of this run."""
        if getattr(record, "run_folder", None) != self._folder:
            return
        line = {"time_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())} | vars(record)["line"]
        append_text(self._folder / "log.jsonl", json.dumps(line, default=str) + "\n")

    def _pass_on(self, record: logging.LogRecord) -> bool:
        """Filter of the logger: return False for a record below the level of before, once it is written."""
        if record.levelno >= self._before[1]:
            return True
        folder = getattr(record, "run_folder", None)
        if folder == self._folder:
            self.handle(record)
        return folder not in (None, self._folder)  # another run in this process has its own filter
