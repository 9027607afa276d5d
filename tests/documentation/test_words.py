"""Plain words: dialect in docstrings, comments and pages, and functions named by a bare participle or ``of``.

``python -m tests.documentation.test_words`` prints every place; docs/glossary.md gives the words to use instead.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ("giantlike", "ray_tracing", "shapes", "catalogs")
GLOSSARY = "docs/glossary.md"
pytestmark = pytest.mark.slow  # `make test` runs it before all others, as a part of `make check`

DIALECT = {
    r"\bnobody (told|tells|declared|declares)\b": 0,
    r"\btold\b(?! ?:)": 4,
    r"\basks for\b": 0,
    r"\bwould rather\b": 0,
    r"\bin proportion to light\b": 0,
    r"\bsquare to\b": 0,
    r"\bfound out\b": 0,
}
"""Phrases, and how often they may still occur; the numbers only fall."""
PARTICIPLE = re.compile(r"_?[a-z]+ed|of")
PARTICIPLES = 40
"""Functions that still have such names; the number only falls."""


def modules() -> Iterator[Path]:
    """Every module of the package, once."""
    for source in SOURCES:
        for path in sorted((ROOT / source).rglob("*.py")):
            if not any(part.is_symlink() for part in path.relative_to(ROOT).parents if str(part) != "."):
                yield path


@cache
def syntax(path: Path) -> ast.Module:
    """Syntax tree of a module."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def prose(path: Path) -> list[tuple[int, str]]:
    """Line and text of each comment and docstring, without words in backticks."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        fenced = re.sub(r"^```.*?^```", lambda match: "\n" * match[0].count("\n"), text, flags=re.M | re.S)
        found = list(enumerate(fenced.splitlines(), 1))
    else:
        nodes = (node for node in ast.walk(syntax(path)) if isinstance(node, ast.Expr))
        values = (node.value for node in nodes if isinstance(node.value, ast.Constant))
        found = [(value.lineno, value.value) for value in values if isinstance(value.value, str)]
        tokens = tokenize.generate_tokens(io.StringIO(text).readline)
        found += [(token.start[0], token.string) for token in tokens if token.type == tokenize.COMMENT]
    return [(line, re.sub(r"`[^`]*`", "", words)) for line, words in found]


def pages() -> Iterator[Path]:
    """Pages that users read, without this list."""
    yield from (ROOT / name for name in ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md"))
    yield from (path for path in sorted((ROOT / "docs").rglob("*.md")) if path != ROOT / GLOSSARY)


def places(pattern: str) -> list[str]:
    """Places in code and pages where a phrase occurs."""
    phrase = re.compile(pattern.replace(" ", r"\s+"), re.I)
    return [
        f"{path.relative_to(ROOT)}:{line}"
        for path in (*modules(), *pages())
        if "_build" not in path.parts
        for line, words in prose(path)
        for _ in phrase.finditer(words)
    ]


def participles() -> list[str]:
    """Functions that are named by a bare participle, or ``of``."""
    return [
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.name}"
        for path in modules()
        for node in ast.walk(syntax(path))
        if isinstance(node, ast.FunctionDef) and PARTICIPLE.fullmatch(node.name)
    ]


@pytest.mark.parametrize("pattern", DIALECT)
def test_prose_uses_plain_words(pattern: str) -> None:
    found = places(pattern)
    assert len(found) <= DIALECT[pattern], f"{GLOSSARY} says what to write instead of {pattern}:\n" + "\n".join(found)


def test_functions_are_named_by_verbs() -> None:
    found = participles()
    assert len(found) <= PARTICIPLES, "name these functions by a verb:\n" + "\n".join(found)


if __name__ == "__main__":
    for each in DIALECT:
        print(each, *places(each), sep="\n    ")
    print("participles", *participles(), sep="\n    ")
