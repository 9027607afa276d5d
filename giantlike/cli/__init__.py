"""The command line: arguments in, exit codes, tables and JSON out."""

from __future__ import annotations


def main() -> None:
    """Run the command line; what ``giantlike`` on a shell does."""
    from giantlike.cli.app import app

    app()
