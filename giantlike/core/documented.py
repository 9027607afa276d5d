"""Docstrings of methods that a protocol documents."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import TypeVar

Class = TypeVar("Class", bound=type)


def documented_by(*sources: type) -> Callable[[Class], Class]:
    """Return a class decorator that gives methods without a docstring that of the same method of a source."""

    def copy_docstrings(cls: Class) -> Class:
        for name, method in vars(cls).items():
            if inspect.isfunction(method) and method.__doc__ is None:
                method.__doc__ = next((vars(each)[name].__doc__ for each in sources if name in vars(each)), None)
        return cls

    return copy_docstrings
