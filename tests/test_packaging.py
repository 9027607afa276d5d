"""What the package list promises: wheel, source distribution, and clones whose links git could not make."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
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
        if link.is_symlink():
            assert link.resolve() == ROOT / name
        else:  # git made no links (Windows), or this is a source distribution
            assert not link.exists() or link.read_text() == f"../{name}"


def test_every_public_name_can_be_imported() -> None:
    for name in giantlike.__all__:
        assert getattr(giantlike, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'Nonsense'"):
        _ = giantlike.Nonsense


def test_the_citation_names_this_version() -> None:
    assert f"\nversion: {giantlike.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = "import sys, giantlike, giantlike.cli; print(','.join(sorted(sys.modules)))"
    loaded = set(
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split(",")
    )
    assert not loaded & {"numpy", "scipy", "cv2", "astropy", "matplotlib", "trimesh", "spiceypy", "pyarrow"}


def test_a_camera_model_loads_no_compiler_before_it_projects() -> None:
    code = "import sys, giantlike.camera_models; print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_the_package_logs_nothing_unless_asked() -> None:
    code = "import giantlike, logging; logging.getLogger('giantlike.stars').error('text')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")


# distributions: built without an index and without isolation -----------------------------------------------


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project as a clone on Windows has it: small text files in place of the links."""
    folder = tmp_path_factory.mktemp("clone") / "giantlike"
    ignored = shutil.ignore_patterns(
        ".*", "__pycache__", "build", "dist", "*.egg-info", "demo-output", "runs", *OUTSIDE
    )
    shutil.copytree(ROOT, folder, ignore=ignored)
    for name in OUTSIDE:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        (folder / "giantlike" / name).write_text(f"../{name}")
    return folder


def run_python(*arguments: str | Path, cwd: Path, python: str | Path = sys.executable) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [str(python), *map(str, arguments)]
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def contents(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.mark.slow
def test_wheel_and_source_distribution_hold_every_module_and_the_second_makes_the_first(
    clone: Path, tmp_path: Path
) -> None:
    run_python("-m", "build", "--no-isolation", "--wheel", "--outdir", tmp_path / "direct", clone, cwd=tmp_path)
    run_python("-m", "build", "--no-isolation", "--outdir", tmp_path / "dist", clone, cwd=tmp_path)  # wheel from sdist
    (direct,), (through,) = (sorted((tmp_path / name).glob("*.whl")) for name in ("direct", "dist"))
    assert contents(direct) == contents(through)
    modules = {str(path.relative_to(ROOT).as_posix()) for path in (ROOT / "giantlike").rglob("*.py")}
    for name in OUTSIDE:
        modules |= {f"giantlike/{path.relative_to(ROOT).as_posix()}" for path in (ROOT / name).rglob("*.py")}
    packed = contents(direct)
    assert {name for name in packed if name.endswith(".py")} == modules
    assert {"giantlike/py.typed", "giantlike/campaign/report/report.html.j2"} <= set(packed)
    (metadata,) = (text.decode() for name, text in packed.items() if name.endswith("/METADATA"))
    assert f"\nVersion: {giantlike.__version__}\n" in metadata


@pytest.mark.slow
def test_an_editable_install_of_a_clone_without_links_imports_the_outer_folders(clone: Path, tmp_path: Path) -> None:
    run_python("-m", "venv", "--without-pip", "venv", cwd=tmp_path)
    python = tmp_path / "venv" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    code = "import sysconfig; print(sysconfig.get_paths()['purelib'])"
    home = Path(run_python("-c", code, cwd=tmp_path, python=python).strip())
    libraries = [path for path in sys.path if path.endswith("site-packages")]  # giantlike is linked there, not in them
    (home / "libraries.pth").write_text("\n".join(libraries))
    run_python("-m", "pip", "--python", python, "install", "-q", "--no-deps", "--no-build-isolation", "--no-index",
               "-e", clone, cwd=tmp_path)  # fmt: skip
    check = (
        "import giantlike, giantlike.shapes.files, giantlike.catalogs.readers, giantlike.ray_tracing.reflectance as r;"
        "print(giantlike.__file__, r.__file__, sep='\\n')"
    )
    found = run_python("-c", check, cwd=tmp_path, python=python).split()
    assert [Path(path).resolve() for path in found] == [
        (clone / part).resolve() for part in ("giantlike/__init__.py", "ray_tracing/reflectance/__init__.py")
    ]
