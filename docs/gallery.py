"""The gallery of real images: `docs/gallery/index.md` with a picture of each, made when the site is built.

Images and what is made of them are no part of the project. Where the folder of real data (`GIANTLIKE_TEST_DATA`, or
`shared/data` beside the project) is missing, the page says how to get it. Pictures that are there are not made again.
"""

from __future__ import annotations

import json
import os
import re
import sys
import time
from collections.abc import Callable, Iterator
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from giantlike.core.outcomes import CenterFix, Failure, PositionFix
from giantlike.core.version import VERSION
from giantlike.ray_tracing import trace_silhouette
from giantlike.relative import ESTIMATORS

if TYPE_CHECKING:
    from real_body_cases import Case

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("GIANTLIKE_TEST_DATA", ROOT.parent / "shared" / "data"))
ESTIMATOR_ORDER = ("limb_matching", "cross_correlation")
"""The first of them that finds something is shown."""
SMALL = 0.35
"""Share of the frame: of bodies smaller than this the surroundings alone are shown."""
OUTLINE, LIMB, FOUND, CENTER = "#9d9bd8", "#ffd84d", "#4fd1a5", "#ff6b5e"

_INTRO = """\
# Gallery

Images of real bodies with what was predicted (dashed), the limb points that were used (yellow), the outline at the fix
(green) and its center (cross). What every estimator makes of them, beside the truth: [real bodies](../real_bodies.md).

"""
_ABSENT = """\
The images are not part of the project, so no picture is shown here. To see them, put the images, shapes and kernels
that [`examples/real_bodies.py`](../../examples/real_bodies.py) names into a folder with `bodies`, `shapes`, `kernels`
(images and shapes are in the archives of the PDS, kernels in that of NAIF), set `GIANTLIKE_TEST_DATA` to it and run
`make docs` again.
"""


def write_gallery(folder: Path) -> None:
    """Write the page, and the pictures that are missing.

    Parameters
    ----------
    folder : Path
        Made if missing.
    """
    folder.mkdir(exist_ok=True)
    page = folder / "index.md"
    if not DATA.is_dir():
        _write(page, _INTRO + _ABSENT)
        return
    known = folder / "gallery.json"
    entries: dict[str, Any] = json.loads(known.read_text()) if known.is_file() else {}
    if not entries:
        entries = {case.name: _entry(case, folder) for case in _cases()}
        known.write_text(json.dumps(entries, indent=1))
    made = "Made {made} with version {version}, {cpu_s:.0f} s of computing time.\n".format(
        **next(iter(entries.values()))
    )
    made = re.sub(r"\d+ s of", f"{sum(entry['cpu_s'] for entry in entries.values()):.0f} s of", made)
    parts = [f"## {name}\n\n{entry['words']}\n\n![{name}]({entry['picture']})\n" for name, entry in entries.items()]
    _write(page, _INTRO + made + "\n" + "\n".join(parts))


def _write(page: Path, text: str) -> None:
    if not page.is_file() or page.read_text(encoding="utf-8") != text:
        page.write_text(text, encoding="utf-8")


def _cases() -> Iterator[Case]:
    """The images of the example, one source after another."""
    sys.path.insert(0, str(ROOT / "examples"))
    import real_bodies
    import real_body_cases as cases

    sources: tuple[Callable[[Path], Iterator[Case]], ...] = (
        cases.vesta, real_bodies.eros, cases.europa, cases.jupiter, cases.voyager, cases.cassini_without_geometry,
        cases.earth,
    )  # fmt: skip
    for source in sources:
        yield from source(DATA)


def _entry(case: Case, folder: Path) -> dict[str, Any]:
    """Words and picture of one image."""
    started = time.process_time()
    fixes = (ESTIMATORS[name]().estimate(case.image, case.camera, case.scene) for name in ESTIMATOR_ORDER)
    fix = next((each for each in fixes if each), None)
    picture = re.sub(r"\W+", "_", case.name) + ".jpg"
    _draw(case, fix, folder / picture)
    return {
        "words": _words(fix),
        "picture": picture,
        "cpu_s": time.process_time() - started,
        "made": date.today().isoformat(),
        "version": VERSION,
    }


def _words(fix: CenterFix | Failure | None) -> str:
    if not isinstance(fix, CenterFix):
        return "No estimator of those tried finds a fix."
    sigma = np.sqrt(np.diag(fix.covariance_px2))
    told = f"`{fix.estimator}`: center ({fix.center_px[0]:.2f}, {fix.center_px[1]:.2f}) px"
    told += f", sigma ({sigma[0]:.2g}, {sigma[1]:.2g}) px"
    flags = ", ".join(f"`{name}`" for name in fix.flags.names())
    return told + (f"; {'suspect: ' if fix.flags.suspect else ''}{flags}." if flags else ".")


def _draw(case: Case, fix: CenterFix | Failure | None, path: Path) -> None:
    """The image with what was predicted and found."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    rows, columns = case.image.pixels.shape
    figure, axes = plt.subplots(figsize=(7.0, 7.0 * rows / columns), dpi=110, layout="constrained")
    case.scene.plot(axes, image=case.image, camera=case.camera)
    if isinstance(fix, PositionFix):
        geometry = case.scene.geometry(case.image)
        assert not isinstance(geometry, Failure)
        outline = trace_silhouette(
            geometry.body(fix.position_camera_km),
            case.camera.model,
            np.linspace(0.0, 2.0 * np.pi, 361),
            sun_direction_camera=geometry.sun_direction_camera,
        )
        axes.plot(*outline.points_px[outline.valid].T, "-", color=FOUND, linewidth=0.8)
        axes.plot(*fix.limb_px.T, ".", color=LIMB, markersize=2)
    if isinstance(fix, CenterFix):
        axes.plot(*fix.center_px, "x", color=CENTER, markersize=8)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), title="", xlabel="x, px", ylabel="y, px")
    if isinstance(fix, PositionFix) and np.ptp(outline.points_px[outline.valid], axis=0).max() < SMALL * columns:
        half = 1.2 * np.abs(outline.points_px[outline.valid] - fix.center_px).max()
        axes.set(xlim=fix.center_px[0] + (-half, half), ylim=fix.center_px[1] + (half, -half))
    figure.savefig(path, pil_kwargs={"quality": 85})
    plt.close(figure)
