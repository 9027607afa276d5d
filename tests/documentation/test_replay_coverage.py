"""The page of what replays cover names tests, commands and places of reports that exist, and counts its rows."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import pytest
import typer

from giantlike.cli.app import app
from giantlike.missions import REPLAYS

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "replay_coverage.md").read_text(encoding="utf-8")
TESTS = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
PARTS = re.split(r"^## ", PAGE, flags=re.MULTILINE)[1:]
COMMANDS = typer.main.get_command(app).list_commands(typer.Context(typer.main.get_command(app)))  # type: ignore[attr-defined]
STATES = ("run", "reduced", "library", "missing")


def rows(part: str) -> list[list[str]]:
    lines = [line for line in part.splitlines() if re.match(r"\| \d", line)]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.partition("\n")[0])
def test_elements_name_a_place_of_the_report_and_a_test_that_exist_or_a_reason(part: str) -> None:
    (name,) = re.findall(r"^`giantlike replay (\w+)`", part, flags=re.MULTILINE)
    assert name in REPLAYS
    package = ROOT / "giantlike" / "missions" / name
    shown = (ROOT / "benchmarks" / "results" / f"replay_{name}.csv").read_text(encoding="utf-8")
    shown += "".join(path.read_text(encoding="utf-8") for path in sorted(package.iterdir()) if path.is_file())
    for number, (told, element, state, place, words) in enumerate(rows(part), 1):
        assert told == str(number)
        assert state in STATES, element
        assert words, element
        assert re.search(re.escape(place) + r"(?!\d)", shown), f"{element}: {place}"
        tests = re.findall(r"`(test_\w+)`", words)
        assert tests or state != "run", element
        assert place or state != "run", element
        assert not [each for each in tests if f"def {each}(" not in TESTS], element
        assert not [each for each in re.findall(r"`giantlike (\w+)", words) if each not in COMMANDS], element


def test_the_page_counts_its_rows() -> None:
    summary = {
        cells[0]: [int(cell) for cell in cells[1:]]
        for cells in re.findall(r"^\| ([\w -]+) \| (\d+) \| (\d+) \| (\d+) \| (\d+) \| (\d+) \|$", PAGE, re.MULTILINE)
    }
    assert len(summary) == len(PARTS)
    for part in PARTS:
        count = Counter(state for _, _, state, _, _ in rows(part))
        assert summary[part.partition("\n")[0]] == [count.total(), *(count[state] for state in STATES)]
