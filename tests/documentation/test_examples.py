"""Every example of every page runs; how, and how a block is left out: tests/documentation/pages.py."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

from giantlike.campaign.demo import DemoReport
from tests.documentation.pages import ROOT, RUN, blocks_of, pages, run_page
from tests.sizes import slow

DEMO = "demo-output"
LANGUAGES = {"python", "console", "text", "toml", "json", "csv", "bash", "{toctree}", "{math}", "{image}", "{figure}"}
WIDEST = 79
"""Characters of a line of code on a page: wider blocks scroll sideways."""
DIRECTIVES = ("{toctree}", "{math}", "{image}", "{figure}")
WITH_EXAMPLES = [page for page in pages() if any(block.language in RUN for block in blocks_of(page))]
FAST = [page for page in WITH_EXAMPLES if any(each.language in RUN and not each.slow for each in blocks_of(page))]
SLOW = [page for page in WITH_EXAMPLES if any(block.slow for block in blocks_of(page))]


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def needs_demo(page: Path) -> bool:
    return DEMO in page.read_text(encoding="utf-8")


@pytest.fixture
def folder(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to be in, with the examples of the project, and the demonstration where a page names it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    shutil.copytree(ROOT / "examples", tmp_path / "examples", ignore=shutil.ignore_patterns("__pycache__"))
    page: Path = request.getfixturevalue("page")
    if needs_demo(page):
        report: DemoReport = request.getfixturevalue("demo_report")
        images = report.output / "images"
        shutil.copytree(report.output, tmp_path / DEMO, ignore=lambda path, names: names if path == str(images) else ())
        shutil.copytree(images, tmp_path / DEMO / "images", copy_function=os.link, dirs_exist_ok=True)
    return tmp_path


@pytest.mark.parametrize("page", [slow(page) if needs_demo(page) else page for page in FAST], ids=name)
@pytest.mark.usefixtures("folder")
def test_the_examples_of_a_page_run(page: Path) -> None:
    run_page(page, slow=False)
    plt.close("all")


@pytest.mark.slow
@pytest.mark.parametrize("page", SLOW, ids=name)
@pytest.mark.usefixtures("folder")
def test_all_examples_of_a_page_run(page: Path) -> None:
    run_page(page, slow=True)
    plt.close("all")


@pytest.mark.parametrize("page", pages(), ids=name)
def test_every_block_says_its_language_and_every_python_block_compiles(page: Path) -> None:
    blocks = blocks_of(page)
    assert {block.language for block in blocks} <= LANGUAGES, "a block without a language is neither run nor exempted"
    for block in blocks:
        if block.language == "python":
            compile(block.text, f"{page.name}:{block.line}", "exec", dont_inherit=True)
        if block.language == "console":
            assert block.text.startswith("$ "), f"{page.name}:{block.line}: no command"


@pytest.mark.parametrize("page", [each for each in pages() if each.name != "CONTRIBUTING.md"], ids=name)
def test_no_block_scrolls_sideways(page: Path) -> None:
    shown = [block for block in blocks_of(page) if block.language not in DIRECTIVES]
    lines = [(block.line + row, line) for block in shown for row, line in enumerate(block.text.split("\n"))]
    wide = [f"{page.name}:{number}: {line}" for number, line in lines if len(line) > WIDEST]
    assert not wide, f"lines of more than {WIDEST} characters:\n" + "\n".join(wide)
