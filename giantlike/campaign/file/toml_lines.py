"""Line numbers of the keys of a TOML file, for messages."""

from __future__ import annotations

import re
from collections.abc import Mapping

_HEADER = re.compile(r"\s*(\[\[?)([^\[\]]++)\]\]?\s*(#.*)?$")
_KEY = re.compile(r"""\s*([A-Za-z0-9_\-."']+)\s*=""")


def lines_of_keys(text: str) -> dict[str, int]:
    r"""Lines of the tables and keys of a TOML file.

    Examples
    --------
    >>> lines_of_keys("[a]\nb = 1\n[[c]]\nd.e = 2\n[[c]]\n")
    {'a': 1, 'a.b': 2, 'c[0]': 3, 'c[0].d.e': 4, 'c[1]': 5}
    """
    lines: dict[str, int] = {}
    counts: dict[str, int] = {}
    table = ""
    depth = 0
    for number, line in enumerate(text.splitlines(), start=1):
        header = _HEADER.match(line) if depth == 0 else None
        if header is not None:
            table = _full_name(header.group(2).strip(), counts)
            if header.group(1) == "[[":
                counts[table] = counts.get(table, -1) + 1
                table = f"{table}[{counts[table]}]"
            lines.setdefault(table, number)
            continue
        key = _KEY.match(line) if depth == 0 else None
        if key is not None:
            lines.setdefault(f"{table}.{key.group(1)}".strip("."), number)
        bare = re.sub(r"\"[^\"]*\"|'[^']*'|#.*", "", line)
        depth = max(0, depth + bare.count("[") + bare.count("{") - bare.count("]") - bare.count("}"))
    return lines


def line_of(key: str, lines: Mapping[str, int]) -> int | None:
    """Line of a key or, where it has none, of the nearest key or table around it."""
    while key:
        if key in lines:
            return lines[key]
        key = re.sub(r"(\[\d+\]|\.?[^.\[\]]+|.)$", "", key)
    return None


def _full_name(name: str, counts: Mapping[str, int]) -> str:
    """Name of a table with the positions of the arrays that it is in."""
    full = ""
    parts = [part.strip().strip("\"'") for part in name.split(".")]
    for place, part in enumerate(parts):
        full = f"{full}.{part}".strip(".")
        if full in counts and place < len(parts) - 1:
            full = f"{full}[{counts[full]}]"
    return full
