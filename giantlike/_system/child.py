"""Calls of C libraries that a damaged file can crash, in a separate process with limits on time and memory.

A function is named by its module; it takes a path and returns arrays by name, which come back as an ``.npz`` archive.
Where the system can fork, a template process that has imported the libraries is forked for each call, in milliseconds.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import io
import json
import os
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike._system.reading import is_of_content, library_message
from giantlike.core.errors import OpNavError

Arrays = Mapping[str, NDArray[Any]]
_BASE_CPU_S, _CPU_S_PER_MB = 5, 1  # of CPU time: s, and s more for each MB of the files; a start takes 1 s
_BASE_BYTES, _BYTES_PER_BYTE = 500_000_000, 20  # of memory, and for each byte of the files (a DSK takes 6)
_REFUSED, _MISTAKE = "refused", "mistake"  # names of the arrays that hold the text of an error, a traceback
_FORKS = all(hasattr(os, name) for name in ("fork", "register_at_fork")) and hasattr(socket, "send_fds")
_LONGEST_REQUEST = 10_000_000  # bytes: the paths of a campaign's kernels, at 4096 each at most on Linux, are fewer


def in_child(
    function: Callable[[Sequence[Path]], Arrays], paths: Sequence[Path], *, libraries: Sequence[str] = ()
) -> dict[str, NDArray[Any]]:
    """Call a function of files in a separate process."""
    request = {
        "module": function.__module__,
        "name": function.__name__,
        "paths": [str(Path(path).absolute()) for path in paths],
        "search": sys.path,
        "libraries": list(libraries),
    }
    content = _TEMPLATE.answer(request) if _FORKS else _answer_of_new_process(request)
    if not content:
        raise ValueError("the library that reads it broke down; the file is damaged")
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        arrays = dict(archive)
    if _MISTAKE in arrays:
        raise RuntimeError(str(arrays[_MISTAKE]))
    if _REFUSED in arrays:
        raise ValueError(str(arrays[_REFUSED]))
    return arrays


def end_template() -> None:
    """End the process that calls were made in, if there is one; the next call starts another."""
    _TEMPLATE.end()


class _Template:
    """Process that waits for requests and answers each in a fork of itself; a new one where the last has ended."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None

    def answer(self, request: Mapping[str, Any]) -> bytes:
        """Archive that the function of a request returned; empty if its process broke down."""
        with self._lock:
            try:
                return self._send_request(request)
            except BrokenPipeError:  # somebody ended the template between two calls
                self.end()
                return self._send_request(request)
            except BaseException:  # its answer to this request must not be mistaken for the answer to the next
                self.end()
                raise

    def _send_request(self, request: Mapping[str, Any]) -> bytes:
        if self._socket is None:
            self._start()
        assert self._socket is not None
        reading, writing = os.pipe()
        with os.fdopen(reading, "rb") as answer:
            try:
                socket.send_fds(self._socket, [json.dumps(request).encode() + b"\n"], [writing])
            finally:
                os.close(writing)
            content = answer.read()
        status = self._socket.recv(1)
        if not status:
            raise BrokenPipeError("the process that reads kernels was ended")
        return content if status == b"0" else b""

    def _start(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._socket = ours
            self._process = _start_process(
                "serve", str(theirs.fileno()), pass_fds=[theirs.fileno()], start_new_session=True
            )

    def end(self) -> None:
        """End the process, if there is one."""
        if self._socket is not None:
            self._socket.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._process = self._socket = None

    def forget(self) -> None:
        """Leave the process to the parent of a fork: this one starts its own."""
        if self._socket is not None:
            self._socket.close()
        if self._process is not None:
            self._process.returncode = 0  # not a child of this process: nothing to wait for
        self.__init__()  # type: ignore[misc]


def _start_process(function: str, *arguments: str, **options: Any) -> subprocess.Popen[bytes]:
    """New Python process that calls a function of this module."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-c", f"from giantlike._system.child import {function}; {function}()", *arguments]
    quiet: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(command, env=environment, **(quiet | options))


def _answer_of_new_process(request: Mapping[str, Any]) -> bytes:
    """Archive that the function of a request returned; empty if its process broke down."""
    with _start_process("main", json.dumps(request), stdout=subprocess.PIPE) as process:
        content, _ = process.communicate()
    return content if process.returncode == 0 else b""


def main() -> None:
    """Answer the request of the command line to standard output."""
    output = os.dup(1)
    os.dup2(2, 1)  # output printed by libraries must not mix with the arrays
    _answer(json.loads(sys.argv[1]), output)


def serve() -> None:
    """Answer requests that arrive at a socket, each in a fork, until its other end is closed."""
    with socket.socket(fileno=int(sys.argv[1])) as requests:
        while True:
            text, descriptors, _, _ = socket.recv_fds(requests, _LONGEST_REQUEST, 1)
            while text and not text.endswith(b"\n"):
                text += requests.recv(_LONGEST_REQUEST)
            if not text:
                return
            request = json.loads(text)
            sys.path[:] = request["search"]
            _import(request)
            child = os.fork()
            if child == 0:
                requests.close()
                _end_after(request, descriptors[0])
            os.close(descriptors[0])
            _, status = os.waitpid(child, 0)
            requests.send(b"0" if status == 0 else b"1")


def _import(request: Mapping[str, Any]) -> None:
    """Import the modules a request needs; the forked process reports those that cannot be imported."""
    with contextlib.suppress(ImportError):
        for name in [*request["libraries"], request["module"]]:
            if name not in sys.modules:
                importlib.import_module(name)
                gc.freeze()  # objects that a collection does not touch stay shared with the forks


def _end_after(request: Mapping[str, Any], output: int) -> None:
    """Answer and end this process without Python's exit handlers, which belong to the template process."""
    code = 1
    try:
        _answer(request, output)
        code = 0
    finally:
        os._exit(code)


def _answer(request: Mapping[str, Any], output: int) -> None:
    """Call the function of a request and write its arrays to a file descriptor."""
    paths = [Path(path) for path in request["paths"]]
    try:
        function = getattr(importlib.import_module(request["module"]), request["name"])
        _limit(sum(path.stat().st_size for path in paths if path.exists()))
        arrays = dict(function(paths))
    except Exception as error:  # noqa: BLE001  an error is raised again in the calling process
        if not is_of_content(error):
            arrays = {_MISTAKE: np.array(traceback.format_exc())}
        else:
            own = isinstance(error, OpNavError) or type(error) is ValueError
            arrays = {_REFUSED: np.array(library_message(error) + ("" if own else "; the file is damaged"))}
    with os.fdopen(output, "wb") as stream:
        np.savez(stream, **arrays)


def _limit(size: int) -> None:
    """Bound CPU time and memory of this process, where the system can."""
    try:
        import resource
    except ImportError:  # Windows has no such limits
        return
    wanted = {
        resource.RLIMIT_CPU: _BASE_CPU_S + _CPU_S_PER_MB * size // 1_000_000,
        resource.RLIMIT_DATA: _BASE_BYTES + _BYTES_PER_BYTE * size,
        resource.RLIMIT_CORE: 0,  # the end of such a process is expected
    }
    for kind, most in wanted.items():
        _, hard = resource.getrlimit(kind)
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)  # a limit of the system cannot be raised
        resource.setrlimit(kind, (most, most))


_TEMPLATE = _Template()
if _FORKS:
    atexit.register(_TEMPLATE.end)
    os.register_at_fork(after_in_child=_TEMPLATE.forget)
