"""Pages that are made when the site is built, in `docs/api/`: one per public package, one of all commands."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import typer
from sphinx.pycode import ModuleAnalyzer

from giantlike.cli.app import app
from tests.exported import PACKAGES, exported_names

OTHERS = (
    "giantlike.atmosphere",
    "giantlike.campaign",
    "giantlike.catalogs.readers",
    "giantlike.presets",
    "giantlike.processing",
    "giantlike.ray_tracing.reflectance",
    "giantlike.rings",
    "giantlike.simulation",
    "giantlike.terrain",
    "giantlike.viewer",
)
"""Packages that users meet beside those whose names are promised."""

_INDEX = """\
API
===

Every name, with shapes, units and frames. Names of the first list stay: one that leaves warns for one minor version
before. Those of the second may change; the :doc:`change log </CHANGELOG>` tells.

"""


_COMMANDS = """\
# Commands

Every command with its arguments and options, as `--help` shows them; examples:
[at the shell](../command_line.md).

"""


def write_api_pages(folder: Path) -> None:
    """Write the page of every public package, their index, and the page of commands.

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
    pages["commands.md"] = _COMMANDS + "\n".join(_commands())
    for stale in {path.name for path in folder.iterdir()} - set(pages):
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


def _commands() -> Iterator[str]:
    """Lines of every command, those of groups after one another."""
    root: Any = typer.main.get_command(app)
    context = root.context_class(root, info_name="giantlike")
    for name in root.list_commands(context):
        command = root.get_command(context, name)
        if hasattr(command, "list_commands"):
            for inner in command.list_commands(context):
                yield from _command(f"{name} {inner}", command.get_command(context, inner), context)
        else:
            yield from _command(name, command, context)


def _command(name: str, command: Any, above: Any) -> Iterator[str]:
    """Lines of one command: its help, and a table of its arguments and options."""
    text = "\n\n".join(" ".join(part.split()) for part in inspect.cleandoc(command.help).split("\n\n"))
    yield f"## `giantlike {name}`\n\n{text}\n\n| argument or option | meaning |\n| --- | --- |"
    context = command.context_class(command, info_name=name, parent=above)
    for one in command.params:
        spelled, meaning = (" ".join(text.split()) for text in one.get_help_record(context))
        yield "| `{}` | {} |".format(spelled.replace("|", "\\|"), meaning.replace("|", "\\|"))
    yield ""


def _members(cls: type) -> str:
    """Options that show the members of a class, those that it inherits from classes of giantlike included."""
    foreign = [base.__name__ for base in cls.__mro__ if not base.__module__.startswith("giantlike")]
    return f"   :members:\n   :inherited-members: {', '.join(foreign)}\n"


def _page(package: str, homes: dict[int, str]) -> str:
    """Text of the page of a package: a table of its names, then those in full that no page before has."""
    module = import_module(package)
    rows, full = [], []
    constants = ModuleAnalyzer.for_module(package).find_attr_docs()
    for name in exported_names(module):
        value = getattr(module, name)
        if name.startswith("__"):
            continue
        is_class = inspect.isclass(value)
        if is_class or inspect.isroutine(value):
            home = homes.setdefault(id(value), f"{package}.{name}")
            kind, summary = ("class" if is_class else "function"), _summary(value)
        else:  # constants and aliases of types: their documentation stands in the source
            home, kind = f"{package}.{name}", "data"
            summary = "".join(constants.get(("", name), ())[:1])
        rows.append((f":py:obj:`{name} <{home}>`", summary))
        if home == f"{package}.{name}":
            full.append(f".. auto{kind}:: {home}\n" + (_members(value) if is_class else ""))
    title = f"{package}\n{'=' * len(package)}\n\n.. automodule:: {package}\n\n"
    return title + _table(rows) + "\n" + "\n".join(full)
