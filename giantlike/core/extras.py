"""Optional libraries: checked for where they are first needed."""

from __future__ import annotations

from importlib.util import find_spec

from giantlike.core.errors import InputError


def require_extra(module: str, *, extra: str, purpose: str) -> None:
    """Refuse to go on without an optional library."""
    if find_spec(module) is None:
        raise InputError(f"{purpose} needs {module}: pip install 'giantlike[{extra}]'")
