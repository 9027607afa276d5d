"""Names of images as users give them: whole, as a path, or the beginning."""

from __future__ import annotations

import difflib
from collections.abc import Collection
from pathlib import Path

from giantlike.core.errors import InputError

_SHOWN = 4
"""Number of names in a message."""


def find_image(name: str, files: Collection[str], run: Path) -> str:
    """Return the name of an image in the tables, from that name, a path that ends in it, or its beginning.

    Raises InputError: there is none, or there are several; the message names the nearest.
    """
    if name in files:
        return name
    wanted = Path(name).name
    found = [file for file in files if Path(file).name == wanted or (wanted and Path(file).name.startswith(wanted))]
    if len(found) == 1:
        return found[0]
    if found:
        others = f" and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
        raise InputError(f"{run}: {name!r} may be {', '.join(found[:_SHOWN])}{others}: give the whole name")
    near = difflib.get_close_matches(wanted, files, n=_SHOWN, cutoff=0.5) or list(files)[:1]
    others = f", then {', '.join(near[1:])}" if near[1:] else ""
    ending = f"the nearest name is {near[0]}{others}" if near else "there are none"
    raise InputError(f"{run}: there is no image {name!r} in this run; {ending}")
