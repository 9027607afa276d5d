"""Optional libraries: checked for where they are first needed."""

from __future__ import annotations

from importlib.util import find_spec

from giantlike.core.errors import InputError


def require_extra(module: str, *, extra: str, purpose: str) -> None:
    """Refuse to go on without an optional library.

    Parameters
    ----------
    module : str
        Name that it is imported by.
    extra : str
        Extra of this package that installs it.
    purpose : str
        What needs it: subject of the message.

    Raises
    ------
    InputError
        It is not installed.
    """
    if find_spec(module) is None:
        raise InputError(f"{purpose} needs {module}: pip install 'giantlike[{extra}]'")
