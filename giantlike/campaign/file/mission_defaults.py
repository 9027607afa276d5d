"""``[mission]`` of a campaign file: the defaults of a mission put under the keys that are there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from giantlike.campaign.file.inputs import CAMERA_CHANGES
from giantlike.campaign.file.toml_file import nearest
from giantlike.core.arrays import require
from giantlike.io.mission_files import mission, mission_names


def with_mission(path: Path, table: Mapping[str, Any]) -> dict[str, Any]:
    """Complete a campaign by the defaults of its mission (``[spice]`` where that or ``mission.kernels`` is given)."""
    completed = dict(table)
    section = table.get("mission")
    if not isinstance(section, Mapping) or not isinstance(section.get("name"), str):
        return completed
    name, folder = section["name"], section.get("kernels")
    require(
        name in mission_names(),
        f"mission.name: there is no mission {name!r}{nearest(name, mission_names())}; there are "
        f"{', '.join(mission_names())}",
    )
    known = mission(name)
    for key, defaults in known.defaults.items():
        given = table.get(key, {})
        if not isinstance(given, Mapping) or (key == "spice" and "spice" not in table and folder is None):
            continue
        if key == "camera" and not given.keys() <= CAMERA_CHANGES:
            continue
        completed[key] = {**defaults, **given}
    spice = completed.get("spice", {})
    if isinstance(folder, str) and isinstance(spice, Mapping) and "kernels" not in spice:
        completed["spice"] = {**spice, "kernels": _kernels(path, folder, known.kernels)}
    return completed


def _kernels(path: Path, folder: str, patterns: tuple[str, ...]) -> list[str]:
    """Kernels of a mission in a folder and the folders below it, in loading order."""
    base = path.parent / folder
    require(base.is_dir(), f"mission.kernels: there is no folder {folder!r} ({base})")
    found = [str(file.absolute()) for pattern in patterns for file in sorted(base.rglob(pattern)) if file.is_file()]
    require(
        bool(found),
        f"mission.kernels: no file in {base} has a name such as {', '.join(patterns)}; name them in spice.kernels",
    )
    return list(dict.fromkeys(found))
