"""numpydoc lint of every exported name: the checks are listed in ``[tool.numpydoc_validation]`` of pyproject.toml.

``python -m tests.test_docstrings`` prints the findings without pytest.
"""

from __future__ import annotations

import enum
import inspect
import re
import sys
import tomllib
from pathlib import Path

from numpydoc.docscrape import get_doc_object
from numpydoc.validate import Validator, validate

from tests.exported import exported_objects, public_methods

ROOT = Path(__file__).resolve().parents[1]
CHECKS = frozenset(
    tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["numpydoc_validation"]["checks"]
)
NUMBERS = re.compile(
    r"\b(?:Float|NDArray|Mask|float|int|complex|ArrayLike|tuple|Any|Mapping|dict|Sequence|list|Iter\w+|Callable)\b"
)
"""Annotations that leave a shape, a unit, a frame or the meaning of keys to the docstring."""
RIDDLES = ("How", "What", "Where", "Whether", "Which", "Who", "Why")


def documented_names() -> list[str]:
    """Every exported class and function, and the public methods and properties that have docstrings of their own."""
    names = []
    for name, value in exported_objects():
        names.append(name)
        if inspect.isclass(value):
            names += [f"{name}.{each}" for each in public_methods(value) if not _inherits_docstring(value, each)]
    return names


def _inherits_docstring(cls: type, method: str) -> bool:
    """True for an override without a docstring of its own, whose base class documents it."""
    function = inspect.getattr_static(cls, method)
    return function.__doc__ is None and bool(inspect.getdoc(getattr(cls, method)))


def findings(name: str) -> list[str]:
    """Codes and texts of the checks that the docstring of a name fails; empty when it is good."""
    result = validate(name)
    found = [f"{code} {text}" for code, text in result["errors"] if code in CHECKS]
    if any(text.startswith("PR01") for text in found) and _bases_document_parameters(name):
        found = [text for text in found if not text.startswith("PR01")]
    not_needed = _sections_not_needed(name)
    found = [text for text in found if not text.startswith(not_needed)]
    summary = str(result["docstring"]).split(maxsplit=1)
    if summary and summary[0] in RIDDLES:
        found.append(f"summary begins with {summary[0]!r}: say what the thing is or does, or 'True if ...'")
    return found


def _sections_not_needed(name: str) -> tuple[str, ...]:
    """Codes of the sections that methods need not have, and those that would only repeat the annotations of a function.

    A method with a section of parameters describes all of them.
    """
    function = Validator._load_obj(name)
    if isinstance(function, property) or not inspect.isroutine(function):
        return ("RT01",) if isinstance(function, property) else ()
    signature, documented = inspect.signature(function), Validator(get_doc_object(function)).doc_parameters
    method = inspect.isclass(Validator._load_obj(name.rpartition(".")[0]))
    returns = () if NUMBERS.search(str(signature.return_annotation)) and not method else ("RT01",)
    plain = method or not any(NUMBERS.search(str(one.annotation)) for one in signature.parameters.values())
    return (*returns, "PR01") if plain and not documented else returns


def _bases_document_parameters(name: str) -> bool:
    """True for enumerations, protocols and classes of which docstring and bases together document every parameter."""
    cls = Validator._load_obj(name)
    if not inspect.isclass(cls):
        return False
    if issubclass(cls, enum.Enum) or getattr(cls, "_is_protocol", False):
        return True
    documented = [Validator(get_doc_object(each)).doc_all_parameters for each in cls.__mro__[:-1] if each.__doc__]
    return set(inspect.signature(cls).parameters) <= set().union(*documented)


def test_exported_names_have_complete_numpydoc_docstrings() -> None:
    wrong = {name: found for name in documented_names() if (found := findings(name))}
    lines = [f"{name}: {text}" for name, found in wrong.items() for text in found]
    assert not wrong, "complete these docstrings:\n" + "\n".join(lines)


if __name__ == "__main__":
    everything = documented_names()
    incomplete = {each: texts for each in everything if (texts := findings(each))}
    for each, texts in incomplete.items():
        print("\n    ".join([each, *texts]))
    print(f"{len(everything) - len(incomplete)} of {len(everything)} exported names are complete", file=sys.stderr)
