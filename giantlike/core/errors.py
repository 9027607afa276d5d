"""The exceptions of giantlike: one small tree, one class per kind of error.

A failed fit is not an exception: see :class:`giantlike.core.outcomes.Failure`.
"""

from __future__ import annotations

from pathlib import Path


class OpNavError(Exception):
    """Base of every exception that giantlike raises on purpose."""


class InputError(OpNavError, ValueError):
    """A value handed in has a wrong shape, unit, range or name."""


class FrameMismatchError(InputError):
    """Two quantities that were combined are not in the same frame.

    Parameters
    ----------
    have, need : str; names of the frame that came and of the one that was needed
    """

    def __init__(self, have: str, need: str) -> None:
        super().__init__(f"needed a quantity in frame {need!r}, got one in {have!r}")
        self.have = have
        self.need = need


class DataError(OpNavError):
    """A file is missing, damaged, or has unexpected content.

    Parameters
    ----------
    path : path-like; the file
    problem : str; what was expected there, what was found and what to do
    """

    def __init__(self, path: str | Path, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.path = Path(path)
        self.problem = problem

    def __reduce__(self) -> tuple[type[DataError], tuple[Path, str]]:
        return type(self), (self.path, self.problem)


BREAKDOWNS = (ValueError, ArithmeticError, IndexError, MemoryError)
"""Built-in exceptions by which a computation breaks down on its numbers; ``LinAlgError`` is a ``ValueError``."""


def breakdown_text(error: BaseException) -> str:
    """Class, place in this package and text of an exception, in one line."""
    trace, place = error.__traceback__, ""
    while trace is not None:
        code = trace.tb_frame.f_code
        if str(trace.tb_frame.f_globals.get("__name__")).startswith("giantlike."):
            place = f" at {Path(code.co_filename).name}:{trace.tb_lineno}"
        trace = trace.tb_next
    return f"{type(error).__name__}{place}: {' '.join(str(error).split())[:200]}"


class EstimationError(OpNavError):
    """A :class:`~giantlike.core.outcomes.Failure` was unwrapped as if it were a fix."""
