"""The generated pages of the documentation are those that the code gives."""

from __future__ import annotations

from pathlib import Path

import pytest

from giantlike.campaign.documentation import pages

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.mark.parametrize("name", sorted(pages()))
def test_a_generated_page_is_up_to_date(name: str) -> None:
    assert (DOCS / name).read_text(encoding="utf-8") == pages()[name], (
        "renew it with: python -m giantlike.campaign.documentation docs"
    )


@pytest.mark.parametrize("name", sorted(set(pages()) - {"camera_presets.md", "missions.md"}))
def test_every_key_and_column_is_described(name: str) -> None:
    rows = [line.strip("| \n").split(" | ") for line in pages()[name].splitlines() if line.startswith("| `")]
    assert len(rows) > 10
    assert all(len(row[-1].split()) >= 1 and row[-1].endswith(".") and "None" not in row[-1] for row in rows)
