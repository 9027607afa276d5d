"""Docstrings below the members of an enumeration, which Python itself throws away."""

from __future__ import annotations

import ast
import inspect
import textwrap
from enum import Enum
from functools import cache


@cache
def attribute_docs(enumeration: type[Enum]) -> dict[str, str]:
    """Return the docstrings of the members of an enumeration.

    >>> from giantlike.core.reasons import Reason
    >>> attribute_docs(Reason)["REJECTED"]
    'A person rejected it. `giantlike edit RUN restore` takes that back.'
    """
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(enumeration))).body
    assert isinstance(definition, ast.ClassDef)
    docs: dict[str, str] = {}
    for before, after in zip(definition.body, definition.body[1:], strict=False):
        told = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        if told and isinstance(before, ast.Assign) and isinstance(before.targets[0], ast.Name):
            assert isinstance(after, ast.Expr)
            assert isinstance(after.value, ast.Constant)
            docs[before.targets[0].id] = " ".join(str(after.value.value).split())
    return docs
