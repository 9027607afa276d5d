"""Names that are near to a misspelled one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_LIKENESS = 0.7
"""Share of letters in common from which a name is suggested: a slip in six letters; at the 0.6 of difflib, `stars` is
suggested for `estimators`."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a hint at the name that may be meant.

    Examples
    --------
    >>> nearest("limb_maching", ["limb_matching", "moment"])
    " (did you mean 'limb_matching'?)"
    >>> nearest("x", ["limb_matching"])
    ''
    """
    found = difflib.get_close_matches(name, list(known), n=1, cutoff=_LIKENESS)
    return f" (did you mean {found[0]!r}?)" if found else ""
