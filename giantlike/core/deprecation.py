"""Old names that keep working, with a warning, for one minor version after something was renamed."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")


def forward_names(module: str, places: Mapping[str, str], *, until: str) -> Callable[[str], Any]:
    """Return a module-level ``__getattr__`` that answers for names that went elsewhere or were renamed.

    ``places`` maps each new module to the names that went there, separated by spaces; ``Old:New`` for a new name.

    Examples
    --------
    In ``giantlike/calibration/__init__.py``::

        places = {"giantlike.calibration": "CalibrationFix:CalibrationResult"}
        __getattr__ = forward_names(__name__, places, until="0.4")
    """
    home_of: dict[str, tuple[str, str]] = {}
    for home, names in places.items():
        for old, _, new in (each.partition(":") for each in names.split()):
            home_of[old] = home, new or old

    def __getattr__(name: str) -> Any:
        if name not in home_of:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        home, new = home_of[name]
        message = f"{module}.{name} is now {home}.{new}; the old place goes in version {until}"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return getattr(import_module(home), new)

    return __getattr__


def renamed_keyword(
    old: str, new: str, *, until: str
) -> Callable[[Callable[Arguments, Answer]], Callable[Arguments, Answer]]:
    """Decorator for a function one of whose keywords was renamed: the old one works and warns."""

    def decorate(function: Callable[Arguments, Answer]) -> Callable[Arguments, Answer]:
        @functools.wraps(function)
        def wrapper(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Answer:
            if old in kwargs:
                message = f"{function.__name__}({old}=...) is now {new}=...; the old keyword goes in version {until}"
                warnings.warn(message, DeprecationWarning, stacklevel=2)
                kwargs[new] = kwargs.pop(old)
            return function(*args, **kwargs)

        return wrapper

    return decorate
