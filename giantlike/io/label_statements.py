"""Statements ``KEY = VALUE <UNIT>`` of labels in the Object Description Language: PDS3 labels and ISIS cubes.

Every search goes forward from the place of the statement, and none is repeated over the same text: a label takes a time
proportional to its length, whatever it holds.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

_SPACE = re.compile(r"\s*")
_WORD = re.compile(r"[A-Za-z0-9_:^]+")
_KEY = re.compile(r"\^?[A-Za-z][A-Za-z0-9_:]*")
_NEITHER = re.compile(r"[^A-Za-z0-9_:^/]+")
_LINE_END = re.compile(r"[^\S\n]*(?:\n|\Z)")
_BRACKETS = {
    "(": re.compile(r"\((?>[^()]+|\([^()]*+\))*+\)"),  # one more level may be inside
    "{": re.compile(r"\{[^{}]*+\}"),
}
_BARE = re.compile(r"[^\s<]+")
_CLOSING = frozenset({"END_OBJECT", "END_GROUP", "End_Object", "End_Group"})


def statements(text: str) -> Iterator[tuple[str, str, str | None]]:
    """Yield key, value as written (empty for END_OBJECT) and unit, or None, of the statements of a label."""
    position, previous = 0, 0  # of the text to look at, and the end of what was there before
    units_end = comments_end = len(text)  # from here on there is no mark that ends one
    while position < len(text):
        position = _skip(_SPACE, text, position)
        word = _WORD.match(text, position)
        if word is None:
            if text.startswith("/*", position) and position < comments_end:
                end = text.find("*/", position + 2)
                comments_end = position if end < 0 else comments_end
                position = position + 2 if end < 0 else end + 2
            else:
                position = max(position + 1, _skip(_NEITHER, text, position))
            previous = position
            continue
        key = _key_of(word[0])
        begins_line = previous == 0 or "\n" in text[previous : word.start()]
        position = previous = word.end()
        if word[0] in _CLOSING and begins_line and _LINE_END.match(text, position):
            yield word[0], "", None
            continue
        equals = _skip(_SPACE, text, position)
        if not key or not text.startswith("=", equals):
            continue
        start = _skip(_SPACE, text, equals + 1)
        end = _value_end(text, start)
        if end == start:
            position = previous = start
            continue
        value, unit, position = text[start:end], None, end
        opened = _skip(_SPACE, text, end)
        if text.startswith("<", opened) and opened < units_end:
            closed = text.find(">", opened)
            units_end = opened if closed < 0 else units_end
            if closed >= 0:
                unit, position = text[opened + 1 : closed], closed + 1
        previous = position
        yield key, value, unit


def _skip(pattern: re.Pattern[str], text: str, position: int) -> int:
    """Place after what a pattern matches at a place; the same place where it does not."""
    match = pattern.match(text, position)
    return position if match is None else match.end()


def _key_of(word: str) -> str:
    """Longest end of a word that is a key; empty if there is none."""
    start = max(word.rfind("^"), 0)
    key = _KEY.search(word, start)
    return "" if key is None else key[0]


def _value_end(text: str, start: int) -> int:
    """End of the value that begins at a place; the place itself if there is none."""
    first = text[start : start + 1]
    if first and first in "\"'":
        closed = text.find(first, start + 1)
        if closed >= 0:
            return closed + 1
    elif first in _BRACKETS:
        match = _BRACKETS[first].match(text, start)
        if match is not None:
            return match.end()
    return _skip(_BARE, text, start)
