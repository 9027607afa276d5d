"""Pages for readers: their links lead somewhere, the index has them all, and the README stays short."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
WRITTEN = [path for path in [*DOCS.rglob("*.md"), *DOCS.rglob("*.ipynb")] if "_build" not in path.parts]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "benchmarks").glob("*.md"), *WRITTEN])


def links(page: Path) -> list[str]:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return [link.partition("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in link]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    broken = [link for link in links(page) if link and not (page.parent / link).exists()]
    assert not broken


def listed(page: Path) -> set[Path]:
    """Pages that the trees of a page name, by name or by pattern."""
    trees = re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    names = [line for tree in trees for line in tree.split() if not line.startswith(":")]
    found = {each.resolve() for name in names for each in page.parent.glob(f"{name}.*")}
    return {each for each in found if each in PAGES}


def test_a_reader_who_starts_at_the_index_finds_every_page() -> None:
    reached, ahead = set[Path](), {DOCS / "index.md"}
    while ahead:
        page = ahead.pop()
        reached.add(page)
        linked = {(page.parent / link).resolve() for link in links(page) if link}
        ahead |= ((linked & set(PAGES)) | listed(page)) - reached
    assert not {str(page.relative_to(ROOT)) for page in set(PAGES) - reached}


def test_the_readme_stays_short_and_its_pictures_small() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150
    for picture in ("real.png", "demo.png"):
        assert (ROOT / "docs" / "images" / picture).stat().st_size < 200_000
