"""Functions that are compiled to machine code when they are called first: loops that numpy cannot take together."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """Compile a function of numbers and arrays.

    The code is kept for later processes, beside the module or in the cache of the user; where neither can be written,
    each process compiles it anew. Divisions by zero give infinities, as in numpy. It is compiled again when its own
    module changes, not when one does whose functions it calls: ``make clean`` deletes what is kept.

    Parameters
    ----------
    function : callable

    Returns
    -------
    callable
    """
    options = {"error_model": "numpy", "nogil": True}
    try:
        result: Function = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder for the cache
        result = numba.njit(**options)(function)
    return result
