"""Exception boundary of a worker: errors of an image go to its record, and cannot end a run."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from giantlike.campaign.store.records import Problem
from giantlike.core.errors import OpNavError
from giantlike.core.outcomes import Reason
from giantlike.io.spice import CoverageError

Answer = TypeVar("Answer")
Arguments = ParamSpec("Arguments")


def reading(
    function: Callable[Arguments, Answer], *args: Arguments.args, **kwargs: Arguments.kwargs
) -> Answer | Problem:
    """Call a function that reads an image; damage becomes a :class:`Problem`."""
    try:
        return function(*args, **kwargs)
    except OpNavError as error:
        return Problem(reason=Reason.UNREADABLE_IMAGE, detail=str(error))


def attempt(
    function: Callable[Arguments, Answer], *args: Arguments.args, **kwargs: Arguments.kwargs
) -> Answer | Problem:
    """Call a function; any exception but an interrupt becomes a :class:`Problem`."""
    try:
        return function(*args, **kwargs)
    except CoverageError as error:
        return Problem(reason=Reason.NO_GEOMETRY, detail=str(error))
    except OpNavError as error:
        return Problem(reason=Reason.INTERNAL_ERROR, detail=str(error))
    except Exception as error:  # noqa: BLE001 - the border of a worker: one image must never end a run
        if isinstance(error.__cause__, KeyboardInterrupt):  # compiled code makes a SystemError of an interrupt
            raise error.__cause__ from None
        detail = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Problem(reason=Reason.INTERNAL_ERROR, detail=detail, traceback=traceback.format_exc())
