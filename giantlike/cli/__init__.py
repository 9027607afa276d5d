"""The command line: arguments in, exit codes, tables and JSON out."""

from __future__ import annotations


def main() -> None:
    """Run the command line, as ``giantlike`` on a shell."""
    from giantlike.cli.app import app

    app()
