"""The exported names of giantlike, found by import; shared by the tests of docstrings and of public names.

At a release ``python -m tests.exported > tests/public_names_<version>.json`` writes down what the next one must keep.
"""

from __future__ import annotations

import enum
import inspect
import json
import re
from collections.abc import Callable, Iterator
from importlib import import_module
from types import ModuleType
from typing import Any, TypeVar

PACKAGES = (
    "giantlike",
    "giantlike.relative",
    "giantlike.stars",
    "giantlike.shapes",
    "giantlike.catalogs",
    "giantlike.ray_tracing",
    "giantlike.camera_models",
    "giantlike.calibration",
    "giantlike.io",
    "giantlike.scene",
    "giantlike.image",
    "giantlike.camera",
    "giantlike.ephemeris",
    "giantlike.core.outcomes",
    "giantlike.core.detector",
    "giantlike.stars.rates",
    "giantlike.triangulation",
    "giantlike.network",
    "giantlike.passes",
    "giantlike.photometry",
    "giantlike.search",
    "giantlike.planning",
    "giantlike.cislunar",
    "giantlike.autonomy",
    "giantlike.dynamics",
)
"""Modules whose names are promised to users; all other modules may change without notice."""


def exported_names(module: ModuleType) -> list[str]:
    """``__all__`` of a module, or the public classes, functions and constants that it defines itself."""
    if hasattr(module, "__all__"):
        return sorted(module.__all__)
    source = inspect.getsource(module)
    own = re.findall(r"^(?:def |class )?([A-Za-z]\w*)(?:\(| *:| *=)", source, re.MULTILINE)
    return sorted(name for name in own if not isinstance(getattr(module, name, None), TypeVar | None))


def exported_objects() -> Iterator[tuple[str, Any]]:
    """Dotted name and value of every exported class and function, each once, under the first package that has it."""
    seen: set[int] = set()
    for package in PACKAGES:
        module = import_module(package)
        for name in exported_names(module):
            value = getattr(module, name)
            if (inspect.isclass(value) or inspect.isfunction(value)) and id(value) not in seen:
                seen.add(id(value))
                yield f"{package}.{name}", value


def public_methods(cls: type) -> list[str]:
    """Names of the public methods and properties of a class that giantlike itself defines, inherited ones included."""
    return [
        name
        for name in sorted(dir(cls))
        if not name.startswith("_") and _is_method(value := inspect.getattr_static(cls, name)) and _is_ours(value)
    ]


def _is_method(value: object) -> bool:
    return inspect.isfunction(value) or isinstance(value, property | classmethod | staticmethod)


def _is_ours(value: Any) -> bool:
    function = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
    return str(getattr(function, "__module__", "")).startswith("giantlike")


def constructor_keywords(cls: type) -> list[str]:
    """Names that a class takes as keywords: its members for an enumeration, none where it takes any arguments."""
    if issubclass(cls, enum.Enum):
        return list(cls.__members__)
    try:
        return parameter_names(cls)
    except ValueError:  # built-in constructors, those of exceptions, have no signature
        return []


def parameter_names(call: Callable[..., Any]) -> list[str]:
    """Names of the parameters of a function or constructor, without ``*args`` and ``**kwargs``."""
    parameters = inspect.signature(call).parameters.values()
    return [each.name for each in parameters if each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)]


def snapshot() -> dict[str, dict[str, Any]]:
    """Exported names by package: keywords of classes, parameters of functions, null for constants."""
    result: dict[str, dict[str, Any]] = {}
    for package in PACKAGES:
        module = import_module(package)
        names: dict[str, Any] = result.setdefault(package, {})
        for name in exported_names(module):
            value = getattr(module, name)
            if inspect.isclass(value):
                names[name] = {"class": constructor_keywords(value)}
            else:
                names[name] = {"function": parameter_names(value)} if callable(value) else None
    return result


if __name__ == "__main__":
    lines = [
        f'"{package}": {{\n'
        + ",\n".join(f' "{name}": {json.dumps(promise)}' for name, promise in names.items())
        + "\n}"
        for package, names in snapshot().items()
    ]
    print("{\n" + ",\n".join(lines) + "\n}")
