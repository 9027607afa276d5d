"""Parameters of tests that run in `make test-all` alone, as others of the same test cover the same code."""

from __future__ import annotations

from typing import Any

import pytest


def slow(*values: Any) -> Any:
    """One set of parameters that is marked slow."""
    return pytest.param(*values, marks=pytest.mark.slow)
