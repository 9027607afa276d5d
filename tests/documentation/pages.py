"""Runs the examples of a page as a reader does: blocks in order, in one folder, Python in one namespace.

A ``python`` block is executed. Of a ``console`` block each line that begins with ``$`` is carried out: a plain
``giantlike`` command in this process, anything else by bash. The lines below it must occur in what the command
writes, in this order; numbers and spaces may differ, and ``...`` stands for anything. ``# exits with 1`` behind a
command tells its exit code where it is not 0. A ``text`` block right below one of these, without words in between, is
what that block writes, and is compared in the same way. Blocks of other languages are not run. A comment on the line
before a block says what is done with it: ``<!-- slow -->``, it runs with ``make test-all`` only (as do blocks that
need it); ``<!-- not run: REASON -->``, never, but a ``python`` block must still compile.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from giantlike.cli.app import app

ROOT = Path(__file__).resolve().parents[2]
RUN = ("python", "console")
"""Languages of the blocks that are run."""
_NUMBER = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")
_SHELL = re.compile(r"[|<>&;$`*?(){}~]")
_EXIT = re.compile(r"# exits with (\d+)")


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """A fenced block: its language, text, number of its first line in the page, comment before it, and output below."""

    language: str
    text: str
    line: int
    comment: str
    output: tuple[str, ...] = ()

    @property
    def slow(self) -> bool:
        return self.comment == "<!-- slow -->"

    @property
    def exempt(self) -> bool:
        return re.fullmatch(r"<!-- not run: \S.* -->", self.comment) is not None


def pages() -> list[Path]:
    """Every page whose examples readers run."""
    written = [path for path in (ROOT / "docs").rglob("*.md") if "_build" not in path.parts]
    return sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *written])


def blocks_of(page: Path) -> list[Block]:
    """Fenced blocks of a page, in order."""
    lines = page.read_text(encoding="utf-8").splitlines()
    blocks: list[Block] = []
    start: int | None = None
    for number, line in enumerate(lines):
        if not line.lstrip().startswith("```"):
            continue
        if start is None:
            start = number
            continue
        indent = len(lines[start]) - len(lines[start].lstrip())
        language = lines[start].strip().strip("`")
        comment = lines[start - 1].strip() if start else ""
        text = "\n".join(each[indent:] for each in lines[start + 1 : number])
        if language == "text" and blocks and _between(lines, blocks[-1], start) == "":
            blocks[-1] = replace(blocks[-1], output=tuple(text.splitlines()))
        blocks.append(Block(language=language, text=text, line=start + 2, comment=comment))
        start = None
    assert start is None, f"{page.name}: the block of line {(start or 0) + 1} has no end"
    return blocks


def _between(lines: list[str], block: Block, start: int) -> str:
    """What stands between the end of a block and the line on which another starts."""
    return "".join(lines[block.line + len(block.text.split("\n")) : start]).strip()


def run_page(page: Path, *, slow: bool) -> dict[str, Any]:
    """Run the blocks of a page in the current folder, those marked slow on demand; returns the Python namespace."""
    names: dict[str, Any] = {"__name__": page.stem}
    for block in blocks_of(page):
        if block.exempt or (block.slow and not slow):
            continue
        place, written = f"{page.name}:{block.line}", ""
        if block.language == "python":
            code = compile("\n" * (block.line - 1) + block.text, str(page), "exec", dont_inherit=True)
            with redirect_stdout(StringIO()) as printed:
                exec(code, names)
            written = printed.getvalue()
        elif block.language == "console":
            written = "".join(_run_command(place, command, shown) for command, shown in _commands(block))
        missing = _first_missing(block.output, written) if block.language in RUN else None
        assert missing is None, f"{place}: the block does not write the line\n{missing}\nbut\n{written}"
    return names


def _commands(block: Block) -> list[tuple[str, list[str]]]:
    """Commands of a console block, each with the lines shown below it."""
    commands: list[tuple[str, list[str]]] = []
    for line in block.text.replace("\\\n", " ").splitlines():
        if line.startswith("$ "):
            commands.append((line[2:], []))
        elif line.strip():
            commands[-1][1].append(line)
    return commands


def _run_command(place: str, command: str, shown: list[str]) -> str:
    """Carry out a command, compare, and return what it writes."""
    told = _EXIT.search(command)
    expected = int(told[1]) if told else 0
    plain = command.partition(" # ")[0].strip()
    if plain.startswith("giantlike ") and not _SHELL.search(plain):
        result = CliRunner().invoke(app, shlex.split(plain)[1:])
        code, output = result.exit_code, result.output
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
    else:
        path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
        environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT)}
        bash = shutil.which("bash") or "bash"
        done = subprocess.run(
            [bash, "-c", plain],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        code, output = done.returncode, done.stdout
    assert code == expected, f"{place}: `{plain}` exits with {code}:\n{output}"
    missing = _first_missing(shown, output)
    assert missing is None, f"{place}: `{plain}` does not write the line\n{missing}\nbut\n{output}"
    return output if output.endswith("\n") else f"{output}\n"


def _first_missing(shown: Sequence[str], output: str) -> str | None:
    """The first shown line that does not occur in the output after those before it; None if all do."""
    written = iter([_without_numbers(line) for line in output.splitlines()])
    for line in shown:
        if line.strip() == "...":
            continue
        pattern = re.escape(_without_numbers(line)).replace(r"\.\.\.", ".*")
        if not any(re.fullmatch(pattern, each) for each in written):
            return line
    return None


def _without_numbers(line: str) -> str:
    return " ".join(_NUMBER.sub("0", line).split())
