"""End of a command: exit codes, and one line for an error of the user."""

from __future__ import annotations

import contextlib
import functools
import json
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import IntEnum
from typing import Any, ParamSpec, TypeAlias

import typer

from giantlike.core.errors import OpNavError

Arguments = ParamSpec("Arguments")
Results: TypeAlias = list[dict[str, Any]]  # one object of a JSON list per file


class ExitCode(IntEnum):
    """Exit codes of the commands."""

    DONE = 0
    """All is done."""
    SOME_IMAGES_FAILED = 1
    """Finished with exceptions, which the output names: images without an attitude or not readable, computations that
    broke down (`internal_error`), a calibration that is refused, a dossier that is no longer valid. Failed fixes
    do not count where another estimator found the body; neither do results that you reject, estimators that do not suit
    a body, and targets that are not in the field."""
    GOALS_MISSED = 1
    """The demonstration or the gauntlet ran, and missed a goal. A replay that disagrees with its paper ends with 0."""
    BAD_INPUT = 2
    """An argument, a file or an option is wrong, in one line on stderr; `check` has a line on stdout for each error.
    Nothing was computed."""
    INTERRUPTED = 130
    """You pressed Ctrl-C. Finished results are kept; the same command resumes."""
    HUNG_UP = 129
    """The terminal was closed (signal HUP); as for Ctrl-C."""
    TERMINATED = 143
    """Another program ended it (signal TERM); as for Ctrl-C."""


def command(function: Callable[Arguments, ExitCode]) -> Callable[Arguments, None]:
    """Make a typer command of a function that returns an exit code; errors of the user become one line on stderr."""

    @functools.wraps(function)
    def wrapper(*args: Arguments.args, **kwargs: Arguments.kwargs) -> None:
        try:
            with _signals_raised():
                code = function(*args, **kwargs)
        except OpNavError as error:
            say(f"giantlike: {' '.join(str(error).split())}")
            code = ExitCode.BAD_INPUT
        except _EndedError as error:
            say(f"giantlike: ended by the signal {error.signal.name}; what is finished is kept")
            code = ExitCode(128 + error.signal)
        except KeyboardInterrupt:
            say("giantlike: interrupted; what is finished is kept")
            code = ExitCode.INTERRUPTED
        raise typer.Exit(code)

    return wrapper


class _EndedError(KeyboardInterrupt):
    """A signal that ends this process."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.signal = signal.Signals(number)


@contextlib.contextmanager
def _signals_raised() -> Iterator[None]:
    """Raise :class:`_EndedError` in the main thread at TERM and HUP, unless they are ignored."""

    def end(number: int, _: object) -> None:
        raise _EndedError(number)

    before = {}
    if threading.current_thread() is threading.main_thread():
        numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
        before = {one: signal.signal(one, end) for one in numbers if signal.getsignal(one) == signal.SIG_DFL}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def say(text: str) -> None:
    """Write one line to stderr."""
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


def show_result(
    value: Mapping[str, Any] | Sequence[Any], lines: str | Iterable[str], *, json: bool, failed: bool = False
) -> ExitCode:
    """Write the results of a command."""
    if json:
        print_json(value)
    else:
        for line in [lines] if isinstance(lines, str) else lines:
            typer.echo(line)
    return ExitCode.SOME_IMAGES_FAILED if failed else ExitCode.DONE


def show_results(results: Results, lines: Callable[[Results], Iterable[str]], *, json: bool) -> ExitCode:
    """Write the results of a command that goes from file to file."""
    failed = any(result["status"] == "failed" for result in results)
    return show_result(results, lines(results), json=json, failed=failed)


def rows_of(columns: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Objects of a JSON list, from columns of equal length."""
    return [dict(zip(columns, cells, strict=True)) for cells in zip(*columns.values(), strict=True)]


def print_json(value: Mapping[str, Any] | Sequence[Any]) -> None:
    """Write JSON to stdout; with ``--json`` nothing else goes there."""
    sys.stdout.write(json.dumps(value, indent=1, allow_nan=False, default=str) + "\n")
    sys.stdout.flush()
