"""Tutorials: what is stored is complete, small and of no machine; executed again they say and show the same."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from types import SimpleNamespace

import nbformat
import pytest

ROOT = Path(__file__).resolve().parents[2]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.ipynb"))
LARGEST_BYTES = 600_000
PATH = re.compile(r"(?<![\w.:/])/(?:home|root|tmp|usr|opt|var|work|Users|private)/|[A-Z]:\\\\")
"""Beginnings of absolute paths; pictures are left out, whose base64 may hold anything."""


@pytest.fixture(params=TUTORIALS, ids=lambda path: path.stem)
def tutorial(request: pytest.FixtureRequest) -> Path:
    path = request.param
    assert isinstance(path, Path)
    return path


def code_cells(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def kinds(cell: nbformat.NotebookNode) -> list[str]:
    """Kind of each output of a cell: a stream by its name, data by their types."""
    return [one.name if one.output_type == "stream" else " ".join(sorted(one.get("data", ()))) for one in cell.outputs]


def texts(cell: nbformat.NotebookNode) -> list[str]:
    """What outputs of a cell say in words."""
    said = []
    for output in cell.outputs:
        data = output.get("data", {})
        words = [output.get("text", ""), data.get("text/plain", ""), data.get("text/html", "")]
        said += [re.sub(r'src="data:[^"]*"', "", text) for text in words]
    return said


def is_check(cell: nbformat.NotebookNode) -> bool:
    return "check" in cell.metadata.get("tags", ())


def test_there_are_tutorials_and_the_index_has_them_all() -> None:
    index = (ROOT / "docs" / "tutorials" / "index.md").read_text(encoding="utf-8")
    assert TUTORIALS
    for path in TUTORIALS:
        assert f"({path.name})" in index
        assert f"\n{path.stem}\n" in index


def test_outputs_are_stored_small_and_without_errors(tutorial: Path) -> None:
    cells = code_cells(nbformat.read(tutorial, as_version=4))
    assert tutorial.stat().st_size < LARGEST_BYTES
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error" or output.get("name") == "stderr"]
    assert sum("image/png" in kind or "text/html" in kind for cell in cells for kind in kinds(cell)) >= 1


def test_nothing_stored_is_of_a_machine(tutorial: Path) -> None:
    notebook = nbformat.read(tutorial, as_version=4)
    assert set(notebook.metadata) == {"kernelspec"}
    for cell in notebook.cells:
        assert set(cell.metadata) <= {"tags"}
        for text in [cell.source, *(texts(cell) if cell.cell_type == "code" else [])]:
            assert not PATH.search(text)


def test_figures_that_the_text_states_are_checked(tutorial: Path) -> None:
    checks = [cell for cell in nbformat.read(tutorial, as_version=4).cells if is_check(cell)]
    assert len(checks) >= 3
    assert all("assert " in cell.source for cell in checks)


@pytest.mark.slow
def test_executed_again_it_holds_what_it_says_and_shows_the_same_kinds(
    tutorial: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checks of its cells raise where a figure of the text does not hold."""
    if "GIANTLIKE_DATA" in tutorial.read_text(encoding="utf-8"):
        monkeypatch.setenv("GIANTLIKE_DATA", str(request.getfixturevalue("data_dir")))
    store = SimpleNamespace(**runpy.run_path(str(ROOT / "docs" / "store_notebooks.py")))
    stored, again = nbformat.read(tutorial, as_version=4), store.executed(tutorial)
    assert [kinds(cell) for cell in code_cells(again)] == [kinds(cell) for cell in code_cells(stored)]
