"""Progress on stderr: a bar on a terminal, lines elsewhere, notebooks included."""

import io
import sys

import pytest

from giantlike.cli.progress import progress_bar

ESCAPE = "\x1b["


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def _shown(monkeypatch: pytest.MonkeyPatch, **environment: str) -> str:
    """What 40 images show on a terminal in an environment."""
    terminal = Terminal()
    monkeypatch.delenv("JPY_PARENT_PID", raising=False)
    for name, value in {"MPLBACKEND": "agg", "TERM": "xterm-color", **environment}.items():
        monkeypatch.setenv(name, value)
    with monkeypatch.context() as patched:
        patched.setattr(sys, "stderr", terminal)
        with progress_bar(lines=True) as progress:
            for done in range(41):
                progress("stars", done, 40)
    return terminal.getvalue()


def test_a_terminal_shows_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    assert ESCAPE in _shown(monkeypatch)


@pytest.mark.parametrize(
    ("name", "value"), [("JPY_PARENT_PID", "1"), ("MPLBACKEND", "module://matplotlib_inline.backend_inline")]
)
def test_a_command_in_a_notebook_shows_lines_although_it_is_given_a_terminal(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str
) -> None:
    shown = _shown(monkeypatch, **{name: value})
    assert ESCAPE not in shown
    assert [line.split(",")[0] for line in shown.splitlines()] == [
        f"giantlike: stars: {done} of 40 images" for done in (10, 20, 30, 40)
    ]
