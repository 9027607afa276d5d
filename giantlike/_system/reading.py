"""Exception boundary of all file readers: exceptions of a parser on a damaged file become a DataError with the path.

A reader raises ``ValueError`` with a full sentence for unexpected content (:func:`check`), and passes on exceptions of
libraries; the decorator :func:`reads` adds the path, and for libraries the remedy. Mistakes in giantlike itself
(``TypeError``, ``AttributeError``, ``NameError``, ``AssertionError``) are not caught.
"""

from __future__ import annotations

import functools
import gzip
import hashlib
import io
import re
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ParamSpec, Protocol, TypeVar, cast

from giantlike.core.errors import DataError, InputError

Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")

_OF_CONTENT = (
    OSError, EOFError, ValueError, LookupError, ArithmeticError, MemoryError, RecursionError, NotImplementedError,
    SyntaxError,
)  # fmt: skip
"""Built-in exceptions that content causes; ``ElementTree.ParseError`` is a ``SyntaxError``."""
_LONGEST_TEXT = 200  # characters of a library's message that are passed on: some quote the whole file


_SMALL_BYTES = 200_000_000  # unpacked, read in any case: an image of 7000 x 7000 in single precision
_MOST_COMPRESSION = 20  # maximum ratio of unpacked to packed size: tables of stars pack to a third to a sixth
_CHUNK_BYTES = 1_000_000  # unpacked at a time
_MOST_KEY_PARTS = 64  # of a dotted key of TOML, whose tables take memory by the square of their number
_KEY_PART = r"(?:[A-Za-z0-9_-]++|\"[^\"\n]*+\"|'[^'\n]*+')"
_DEEP_KEY = re.compile(rf"(?<![A-Za-z0-9_-]){_KEY_PART}(?:[ \t]*+\.[ \t]*+{_KEY_PART}){{{_MOST_KEY_PARTS}}}")


def check(condition: bool, sentence: str) -> None:
    """Raise ``ValueError`` with ``sentence`` on the error in the content of a file, unless ``condition``."""
    if not condition:
        raise ValueError(sentence)


def check_declared_bytes(declared: int, file_bytes: int) -> None:
    """Raise ``ValueError`` where a header declares far more bytes of content than a file of its size can hold."""
    if declared > max(_SMALL_BYTES, _MOST_COMPRESSION * file_bytes):
        raise ValueError(
            f"it declares {declared / 1e6:.0f} MB of content, more than a file of {file_bytes / 1e6:.1f} MB can hold"
        )


class _Decorator(Protocol):
    """A decorator that keeps the signature of the function."""

    def __call__(self, read: Callable[Arguments, Answer], /) -> Callable[Arguments, Answer]: ...


def reads(what: str) -> _Decorator:
    """Decorator for functions that read a file, whose path is their first argument."""

    def decorate(read: Callable[Arguments, Answer]) -> Callable[Arguments, Answer]:
        @functools.wraps(read)
        def wrapper(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Answer:
            try:
                return read(*args, **kwargs)
            except DataError:
                raise
            except Exception as error:
                if not is_of_content(error):
                    raise
                path = cast(Path, args[0] if args else kwargs["path"])
                raise DataError(path, problem_text(error, what)) from error

        return wrapper

    return decorate


@contextmanager
def resolving(path: Path, what: str) -> Iterator[None]:
    """Convert errors in the inputs named by a file, in a ``with`` block, to a :class:`DataError` with its path."""
    try:
        yield
    except DataError:
        raise
    except InputError as error:
        raise DataError(path, str(error)) from error
    except Exception as error:
        if not is_of_content(error):
            raise
        raise DataError(path, problem_text(error, what)) from error


def toml_table(path: Path, what: str) -> dict[str, Any]:
    """Read a TOML file."""
    try:
        text = path.read_bytes().decode("utf-8")
        deep = _DEEP_KEY.search(text)
        if deep is not None:
            line = text.count("\n", 0, deep.start()) + 1
            raise DataError(path, f"line {line}: a key has more than {_MOST_KEY_PARTS} parts between its dots")
        table = tomllib.loads(text)
        _require_64_bits(table)
        return table
    except OSError as error:
        raise DataError(path, f"cannot read the {what}: {error.strerror}") from error
    except DataError:
        raise
    except RecursionError as error:
        raise DataError(path, "is not valid TOML: its brackets are nested too deeply") from error
    except ValueError as error:
        raise DataError(path, f"is not valid TOML: {error}") from error


def _require_64_bits(value: object) -> None:
    """Raise ``ValueError`` where a value of a TOML file is a whole number beyond those that TOML has."""
    for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _require_64_bits(inner)
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise ValueError(f"needed whole numbers of 64 bits, got one of {value.bit_length()}")


def decompress_gzip(content: bytes) -> bytes:
    """Content of a file without its gzip compression, if it has one."""
    if not content.startswith(b"\x1f\x8b"):
        return content
    chunks, left = [], max(_SMALL_BYTES, _MOST_COMPRESSION * len(content))
    with gzip.GzipFile(fileobj=io.BytesIO(content)) as file:
        while chunk := file.read(_CHUNK_BYTES):
            left -= len(chunk)
            if left < 0:
                raise ValueError("it unpacks to far more than its size allows")
            chunks.append(chunk)
    return b"".join(chunks)


def file_sha256(path: Path) -> str:
    """SHA-256 of the content of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def library_message(error: BaseException) -> str:
    """One line of the text of an exception (of SPICE, both its messages), or its class if it has no text."""
    short, long = str(getattr(error, "short", "")), " ".join(str(getattr(error, "long", "") or error).split())
    first = long.split(". ")[0].rstrip(".") if short else long[:_LONGEST_TEXT]
    return f"{short}: {first}" if short else first or type(error).__name__


def is_of_content(error: Exception) -> bool:
    """True if the content of a file caused an exception, not an error in this package's own code."""
    return isinstance(error, _OF_CONTENT) or type(error).__module__ != "builtins" or not _raised_here(error)


def _raised_here(error: Exception) -> bool:
    """True if the innermost frame of the exception is one of this package."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return trace is None or str(trace.tb_frame.f_globals.get("__name__")).startswith("giantlike.")


def problem_text(error: Exception, what: str) -> str:
    """Sentence for a user on the requirement, the finding and, where the reader does not say it, the remedy."""
    if isinstance(error, FileNotFoundError):
        return "there is no such file"
    if isinstance(error, OSError) and error.strerror:
        return f"cannot be read as {what}: {error.strerror}"
    text = library_message(error)
    if isinstance(error, KeyError):
        text = f"{text} is missing"
    advice = "" if isinstance(error, ValueError) and _raised_here(error) else "; the file is damaged or of another kind"
    return f"cannot be read as {what}: {text}{advice}"
