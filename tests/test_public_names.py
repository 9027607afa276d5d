"""What 0.1.0 exported can still be imported and called: names that leave warn for one minor version first."""

from __future__ import annotations

import inspect
import json
import warnings
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from giantlike.core.deprecation import renamed_keyword
from tests.exported import constructor_keywords, parameter_names

PROMISED: dict[str, dict[str, Any]] = json.loads(
    Path(__file__).with_name("public_names_0_1_0.json").read_text(encoding="utf-8")
)

MOVED = (
    "giantlike.bench",
    "giantlike.calibration",
    "giantlike.catalogs",
    "giantlike.io",
    "giantlike.navigation",
    "giantlike.plotting",
    "giantlike.ray_tracing",
    "giantlike.shapes",
    "giantlike.simulation",
    "giantlike.stars",
)
"""Modules with names that were moved elsewhere."""

RENAMED_PARAMETERS = {"render": {"recentre"}}
"""Parameters of functions that have another name since, by CHANGELOG.md."""


def current(package: str, name: str) -> Any:
    """The object that a promised name gives today, by its new name where it was renamed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        return getattr(import_module(package), name, None)


@pytest.mark.parametrize("package", PROMISED)
def test_every_name_that_0_1_0_exported_is_still_there(package: str) -> None:
    missing = [name for name in PROMISED[package] if current(package, name) is None]
    assert not missing, f"{package} lost names: keep them importable by giantlike.core.deprecation"


@pytest.mark.parametrize("package", PROMISED)
def test_constructors_take_every_keyword_that_they_took_in_0_1_0(package: str) -> None:
    promised = {
        name: set(promise["class"]) for name, promise in PROMISED[package].items() if promise and "class" in promise
    }
    lost = {
        name: lack
        for name, had in promised.items()
        if (lack := had - set(constructor_keywords(current(package, name))))
    }
    assert not lost, f"constructors of {package} lost keywords"


@pytest.mark.parametrize("package", PROMISED)
def test_functions_take_every_parameter_that_they_took_in_0_1_0(package: str) -> None:
    promised = {
        name: promise["function"] for name, promise in PROMISED[package].items() if promise and "function" in promise
    }
    lost = {
        name: lack
        for name, had in promised.items()
        if (lack := set(had) - set(parameter_names(current(package, name))) - RENAMED_PARAMETERS.get(name, set()))
    }
    assert not lost, f"functions of {package} lost parameters"


@pytest.mark.parametrize("module", MOVED)
def test_names_that_went_elsewhere_work_at_their_old_place_and_warn(module: str) -> None:
    old = import_module(module)
    places = inspect.getclosurevars(old.__getattr__).nonlocals["home_of"]
    assert places
    for name, (home, new) in places.items():
        with pytest.warns(DeprecationWarning, match=f"{name} is now {home}.{new};"):
            value = getattr(old, name)
        assert value is getattr(import_module(home), new)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = old.nothing


def test_a_renamed_keyword_works_and_warns() -> None:
    @renamed_keyword("recentre", "recenter", until="0.3")
    def render(**keywords: bool) -> dict[str, bool]:
        return keywords

    with pytest.warns(DeprecationWarning, match="is now recenter"):
        assert render(recentre=True) == {"recenter": True}
    assert render(recenter=True) == {"recenter": True}
