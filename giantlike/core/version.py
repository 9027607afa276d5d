"""The version of giantlike, for provenance."""

from __future__ import annotations

from importlib.metadata import version

VERSION = version("giantlike")
