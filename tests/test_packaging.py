"""What the package list promises."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import giantlike

ROOT = Path(__file__).resolve().parents[1]
OUTSIDE = {"shapes", "catalogs", "ray_tracing"}


def test_every_subpackage_is_in_the_package_list() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = [path.parent for top in ("giantlike", *sorted(OUTSIDE)) for path in (ROOT / top).rglob("__init__.py")]
    names = set()
    for folder in folders:
        parts = folder.relative_to(ROOT).parts
        names.add(".".join(parts if parts[0] == "giantlike" else ("giantlike", *parts)))
    assert names == set(settings["packages"])


def test_the_three_outer_folders_are_linked_for_type_checkers() -> None:
    for name in OUTSIDE:
        link = ROOT / "giantlike" / name
        assert link.is_symlink()
        assert link.resolve() == ROOT / name


def test_every_public_name_can_be_imported() -> None:
    for name in giantlike.__all__:
        assert getattr(giantlike, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'Nonsense'"):
        _ = giantlike.Nonsense


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = "import sys, giantlike, giantlike.cli; print(','.join(sorted(sys.modules)))"
    loaded = set(
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split(",")
    )
    assert not loaded & {"numpy", "scipy", "cv2", "astropy", "matplotlib", "trimesh", "spiceypy", "pyarrow"}
