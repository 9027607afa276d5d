"""Events of a run: to its log.jsonl always, to other handlers at the level that the program chose."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest

from giantlike.campaign.store.log import LOGGER, RunLogHandler, log_event
from giantlike.core.errors import DataError


def events(folder: Path) -> list[str]:
    return [json.loads(line)["event"] for line in (folder / "log.jsonl").read_text().splitlines()]


def test_events_are_lines_of_json_with_time_event_and_values(tmp_path: Path) -> None:
    with RunLogHandler(tmp_path):
        log_event(tmp_path, "image", file="a.fits", time_s=0.5)
    (line,) = [json.loads(text) for text in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert list(line) == ["time_utc", "event", "file", "time_s"]
    assert (line["event"], line["file"], line["time_s"]) == ("image", "a.fits", 0.5)


def test_other_handlers_get_events_only_from_the_level_of_the_program(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    before = LOGGER.level
    with RunLogHandler(tmp_path):
        log_event(tmp_path, "image", file="a.fits")
        log_event(tmp_path, "warning", level=logging.WARNING, detail="odd")
    assert [record.getMessage() for record in caplog.records] == ["warning: detail=odd"]
    with caplog.at_level(logging.INFO, logger=LOGGER.name), RunLogHandler(tmp_path):
        log_event(tmp_path, "image", file="b.fits")
    assert caplog.records[-1].getMessage() == "image: file=b.fits"
    assert events(tmp_path) == ["image", "warning", "image"]
    assert (LOGGER.level, LOGGER.handlers) == (before, [])


def test_two_runs_in_one_process_keep_their_logs_apart(tmp_path: Path) -> None:
    one, other = tmp_path / "one", tmp_path / "other"
    one.mkdir()
    other.mkdir()
    with RunLogHandler(one), RunLogHandler(other):
        log_event(one, "first")
        log_event(other, "second", level=logging.ERROR)
    assert (events(one), events(other)) == (["first"], ["second"])


def test_a_log_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "log.jsonl").mkdir()
    with RunLogHandler(tmp_path), pytest.raises(DataError, match="cannot be written"):
        log_event(tmp_path, "image")
