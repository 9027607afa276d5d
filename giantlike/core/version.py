"""The version of giantlike: the package metadata, provenance and ``giantlike --version`` take it from here."""

from __future__ import annotations

VERSION = "0.3.0.dev0"
