"""A mission file: defaults of the tables of a campaign, patterns of its kernels, and where the numbers come from.

Each is a TOML file in ``giantlike/io/missions``. It holds only values that its sources state: where the frame of
a camera or the order of its axes is not known, SPICE gives no attitude, and the campaign has to.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from types import MappingProxyType
from typing import Any

from giantlike.core.errors import InputError

_FOLDER = files("giantlike.io") / "missions"


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """A priori information on the images of one camera."""

    name: str
    about: str  # images that it describes, and values that it does not give
    sources: tuple[str, ...]  # where the numbers come from
    kernels: tuple[str, ...]  # patterns of the names of SPICE kernels, in loading order
    defaults: Mapping[str, Mapping[str, Any]]  # of tables ``camera``, ``images``, ``spice`` of a campaign file


def mission_names() -> tuple[str, ...]:
    """Names of the missions, sorted.

    >>> "dawn_fc2" in mission_names()
    True
    """
    return tuple(sorted(file.name.removesuffix(".toml") for file in _FOLDER.iterdir() if file.name.endswith(".toml")))


def mission(name: str) -> Mission:
    """Return a mission by its name.

    >>> mission("dawn_fc2").defaults["spice"]["frame"]
    'DAWN_FC2'
    """
    if name not in mission_names():
        raise InputError(f"there is no mission {name!r}; there are {', '.join(mission_names())}")
    table = tomllib.loads((_FOLDER / f"{name}.toml").read_text(encoding="utf-8"))
    head = table.pop("mission")
    return Mission(
        name=name,
        about=head["about"],
        sources=tuple(head["sources"]),
        kernels=tuple(head["kernels"]),
        defaults=MappingProxyType(table),
    )
