"""The exported names of giantlike, found by import; shared by the tests of docstrings and of public names."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from importlib import import_module
from types import ModuleType
from typing import Any

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
)
"""Modules whose names are promised to users; all other modules may change without notice."""


def exported_names(module: ModuleType) -> list[str]:
    """``__all__`` of a module, or the public classes, functions and constants that it defines itself."""
    if hasattr(module, "__all__"):
        return sorted(module.__all__)
    own = [name for name, value in vars(module).items() if getattr(value, "__module__", None) == module.__name__]
    return sorted(name for name in own if not name.startswith("_"))


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
