"""Drawings of the concepts: committed as their script makes them, small, and shown on a page."""

from __future__ import annotations

import runpy
from pathlib import Path
from xml.etree import ElementTree

import pytest

DOCS = Path(__file__).parents[2] / "docs"
LARGEST = 60_000  # bytes: a page with nine of them still loads at once
SCRIPT = runpy.run_path(str(DOCS / "draw_concepts.py"))


@pytest.mark.parametrize("name", sorted(SCRIPT["DRAWINGS"]))
def test_a_drawing_is_that_of_its_script_and_shown_on_a_page(name: str) -> None:
    committed = (DOCS / "images" / "concepts" / f"{name}.svg").read_text(encoding="utf-8")
    assert committed == SCRIPT["DRAWINGS"][name]().svg()
    assert len(committed) < LARGEST
    assert ElementTree.fromstring(committed).find("{http://www.w3.org/2000/svg}title") is not None
    pages = [DOCS.parent / "ARCHITECTURE.md", *(DOCS / "concepts").glob("*.md")]
    assert any(f"images/concepts/{name}.svg" in page.read_text(encoding="utf-8") for page in pages)
