"""Execute the tutorials and store their outputs in place, each from a fresh kernel in an empty folder.

    python docs/store_notebooks.py [NOTEBOOK...]

One of them reads real images from the folder that GIANTLIKE_DATA names; without it, it is left as it is.
What would differ from machine to machine (times of execution, versions of the interpreter) is left out.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = ROOT / "docs" / "tutorials"
TIMEOUT_S = 600
"""For one cell, s: none takes a tenth of it."""
REAL_DATA = "GIANTLIKE_DATA"
PLAIN = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}


def executed(path: Path) -> NotebookNode:
    """Execute a notebook.

    Parameters
    ----------
    path : Path

    Returns
    -------
    NotebookNode
        With its outputs, and without what belongs to this machine.

    Raises
    ------
    nbclient.exceptions.CellExecutionError
        A cell raised an error.
    """
    notebook = nbformat.read(path, as_version=4)
    os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    os.environ["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(
            notebook,
            timeout=TIMEOUT_S,
            kernel_name="python3",
            coalesce_streams=True,
            resources={"metadata": {"path": folder}},
        ).execute()
        return plain(notebook, folder)


def plain(notebook: NotebookNode, folder: str) -> NotebookNode:
    """Return a notebook without execution times, names of the kernel's machine and the folder that it ran in.

    Parameters
    ----------
    notebook : NotebookNode
    folder : str
        The working folder.

    Returns
    -------
    NotebookNode
    """
    notebook.metadata = NotebookNode(PLAIN)
    for number, cell in enumerate(notebook.cells):
        cell.id = f"cell-{number:02d}"
        cell.metadata.pop("execution", None)
        for output in cell.get("outputs", ()):
            output.get("metadata", {}).pop("needs_background", None)
            if "text" in output:
                output.text = output.text.replace(folder, ".")
            for kind, text in output.get("data", {}).items():
                if kind.startswith("text/"):
                    output.data[kind] = text.replace(folder, ".")
    return notebook


def main(names: list[str]) -> None:
    """Execute and store these notebooks, or all."""
    for path in [Path(name) for name in names] or sorted(TUTORIALS.glob("*.ipynb")):
        if REAL_DATA in path.read_text(encoding="utf-8") and REAL_DATA not in os.environ:
            print(f"{path.name}: left as it is, because {REAL_DATA} names no folder of real images")
            continue
        nbformat.write(executed(path), path)
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
