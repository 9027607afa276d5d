"""Pages of the reference say what the code does."""

from __future__ import annotations

import ast
import inspect
import re
from pathlib import Path
from types import ModuleType

import pytest

from giantlike.campaign.documentation import pages
from giantlike.cli.outcome import ExitCode
from giantlike.core.attribute_docs import attribute_docs
from giantlike.io import fits_keywords, label_geometry, label_times

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.mark.parametrize("name", sorted(pages()))
def test_a_generated_page_is_up_to_date(name: str) -> None:
    assert (DOCS / name).read_text(encoding="utf-8") == pages()[name], (
        "renew it with: python -m giantlike.campaign.documentation docs"
    )


@pytest.mark.parametrize("name", sorted(set(pages()) - {"camera_presets.md", "missions.md", "header_keywords.md"}))
def test_every_key_and_column_is_described(name: str) -> None:
    rows = [line.strip("| \n").split(" | ") for line in pages()[name].splitlines() if line.startswith("| `")]
    assert len(rows) > 10
    assert all(len(row[-1].split()) >= 1 and row[-1].endswith(".") and "None" not in row[-1] for row in rows)


@pytest.mark.parametrize("name", sorted(pages()))
def test_a_page_has_no_markup_of_docstrings(name: str) -> None:
    """What people read on pages, in reports and at the shell is not that of Sphinx."""
    assert not re.findall(r":(?:attr|class|func|meth|mod|data):`[^`]*`", pages()[name])


def test_the_exit_codes_of_the_page_are_those_of_the_commands() -> None:
    rows = re.findall(r"^\| (\d+) \| (.*) \|$", (DOCS / "command_line.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert rows == [(str(ExitCode[name].value), meaning) for name, meaning in attribute_docs(ExitCode).items()]
    assert {int(code) for code, _ in rows} == set(ExitCode)


@pytest.mark.parametrize("module", [fits_keywords, label_times, label_geometry], ids=lambda module: module.__name__)
def test_every_keyword_that_a_reader_looks_for_is_on_the_page(module: ModuleType) -> None:
    """Keys of subscripts, of ``get`` and of ``number``, and tuples of keywords."""
    page = (DOCS / "header_keywords.md").read_text(encoding="utf-8")
    looked_for = set[str]()
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        keys: list[ast.expr] = []
        if isinstance(node, ast.Subscript):
            keys = [node.slice]
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in {
            "get",
            "number",
        }:
            keys = node.args[:1]
        elif isinstance(node, ast.Tuple):
            keys = node.elts
        texts = [each.value for each in keys if isinstance(each, ast.Constant) and isinstance(each.value, str)]
        looked_for |= {text for text in texts if re.fullmatch(r"[A-Z][A-Z0-9_-]{2,}", text)}
    assert len(looked_for) > 5
    missing = {key for key in looked_for if not re.search(rf"`{key}\b|_{key}\b|\b{key}_", page)}
    assert not missing
