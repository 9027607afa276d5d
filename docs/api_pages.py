"""Pages of the API reference, one per public package, made when the site is built: `docs/api/`."""

from __future__ import annotations

import inspect
from importlib import import_module
from pathlib import Path
from typing import Any

from tests.exported import PACKAGES, exported_names

OTHERS = (
    "giantlike.atmosphere",
    "giantlike.bench",
    "giantlike.campaign",
    "giantlike.catalogs.readers",
    "giantlike.gauntlet",
    "giantlike.io.height_maps",
    "giantlike.missions",
    "giantlike.observables",
    "giantlike.plotting",
    "giantlike.presets",
    "giantlike.processing",
    "giantlike.ray_tracing.reflectance",
    "giantlike.simulation",
    "giantlike.terrain",
)
"""Packages that users meet beside those whose names are promised."""

_INDEX = """\
API
===

Every name, with shapes, units and frames. Names of the first list stay: one that leaves warns for one minor version
before. Those of the second may change; the :doc:`change log </CHANGELOG>` tells.

"""


def write_api_pages(folder: Path) -> None:
    """Write the page of every public package and their index.

    A name that several packages export is described once, in the deepest package; the others link there.

    Parameters
    ----------
    folder : Path
        Made if missing; files whose text is the same are left alone, so that Sphinx does not read them again.
    """
    folder.mkdir(exist_ok=True)
    homes: dict[int, str] = {}
    pages = {}
    for package in sorted((*PACKAGES, *OTHERS), key=lambda name: -name.count(".")):
        pages[f"{package}.rst"] = _page(package, homes)
    pages["index.rst"] = _INDEX + _tree("Promised", PACKAGES) + _tree("Others", OTHERS)
    for stale in {path.name for path in folder.glob("*.rst")} - set(pages):
        (folder / stale).unlink()
    for file, text in pages.items():
        path = folder / file
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def _summary(value: Any) -> str:
    return (inspect.getdoc(value) or "").split("\n")[0]


def _table(rows: list[tuple[str, str]]) -> str:
    lines = [".. list-table::\n   :widths: 35 65\n"]
    lines += [f"   * - {first}\n     - {second}" for first, second in rows]
    return "\n".join(lines) + "\n"


def _tree(caption: str, names: tuple[str, ...]) -> str:
    """Table of a list of packages with their summaries, and the hidden tree that Sphinx needs."""
    rows = [(f":doc:`{name} <{name}>`", _summary(import_module(name))) for name in sorted(names)]
    tree = "\n".join([".. toctree::\n   :hidden:\n", *(f"   {name}" for name in sorted(names))])
    return f"{caption}\n{'-' * len(caption)}\n\n{_table(rows)}\n{tree}\n\n"


def _page(package: str, homes: dict[int, str]) -> str:
    """Text of the page of a package: a table of its names, then those in full that no page before has."""
    module = import_module(package)
    rows, full = [], []
    for name in exported_names(module):
        value = getattr(module, name)
        if name.startswith("__"):
            continue
        is_class = inspect.isclass(value)
        if is_class or inspect.isroutine(value):
            home = homes.setdefault(id(value), f"{package}.{name}")
            kind, summary = ("class" if is_class else "function"), _summary(value)
        else:  # constants and aliases of types: their documentation stands in the source
            home, kind, summary = f"{package}.{name}", "data", ""
        rows.append((f":py:obj:`{name} <{home}>`", summary))
        if home == f"{package}.{name}":
            full.append(f".. auto{kind}:: {home}\n" + ("   :members:\n" if is_class else ""))
    title = f"{package}\n{'=' * len(package)}\n\n.. automodule:: {package}\n\n"
    return title + _table(rows) + "\n" + "\n".join(full)
