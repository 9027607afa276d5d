"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

BESIDE = Path(__file__).resolve().parents[2] / "shared" / "data"
DATA = Path(os.environ.get("GIANTLIKE_TEST_DATA", BESIDE))


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of real images, kernels and shapes; skips where it is missing (it is not part of the project)."""
    if not DATA.is_dir():
        pytest.skip(f"real data not found at {DATA}")
    return DATA
