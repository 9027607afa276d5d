"""The picture of the first page: Jupiter by Cassini, with what was predicted and what ``auto`` found.

    python docs/draw_real.py            # writes docs/images/real.png

The image, its trajectory and the kernels are in the folder of real data (``GIANTLIKE_TEST_DATA``, or ``shared/data``
beside the project), which is no part of the project; without it the script says so and writes nothing. The frame is
NASA/JPL/Space Science Institute, in the public domain.
"""

from __future__ import annotations

import io
import os
import sys
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from PIL import Image as Picture

import giantlike as gl
from giantlike.ray_tracing import trace_silhouette

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "examples"))

import real_body_cases as cases  # noqa: E402

DATA = Path(os.environ.get("GIANTLIKE_TEST_DATA", ROOT.parent / "shared" / "data"))
OUTPUT = ROOT / "docs" / "images" / "real.png"
FRAME = "n1350122987.2"
HALF_PX, ZOOM_PX = 175.0, 18.0
"""Half sides of the two panels, px."""
ZOOM_RAD = np.deg2rad(-35.0)
"""Direction from the center to the middle of the second panel, counted as in the image from +x to +y."""
PREDICTED, LIMB, FOUND, CENTER = "#9d9bd8", "#ffd84d", "#4fd1a5", "#ff6b5e"


def outline(case: cases.Case, position_km: np.ndarray) -> np.ndarray:
    """Outline (n, 2) of the body at a position, px."""
    geometry = case.scene.geometry(case.image)
    assert not isinstance(geometry, gl.Failure)
    traced = trace_silhouette(
        geometry.body(position_km),
        case.camera.model,
        np.linspace(0.0, 2.0 * np.pi, 721),
        sun_direction_camera=geometry.sun_direction_camera,
    )
    return np.asarray(traced.points_px[traced.valid])


def draw(axes: Axes, case: cases.Case, fix: gl.PositionFix, *, size: float) -> None:
    """The image with the predicted outline, limb points and the outline at the fix."""
    geometry = case.scene.geometry(case.image)
    assert not isinstance(geometry, gl.Failure)
    pixels = case.image.pixels.astype(np.float64)
    axes.imshow(pixels, cmap="gray", vmin=np.quantile(pixels, 0.02), vmax=pixels.max(), interpolation="nearest")
    axes.plot(*outline(case, geometry.position_camera_km).T, "--", color=PREDICTED, linewidth=1.2, label="predicted")
    axes.plot(*outline(case, fix.position_camera_km).T, "-", color=FOUND, linewidth=1.0, label="outline of the fix")
    axes.plot(*fix.limb_px.T, "o", color=LIMB, markersize=size, markeredgewidth=0.0, label="limb points used")
    axes.plot(*fix.center_px, "x", color=CENTER, markersize=9, markeredgewidth=2.0)
    axes.set(xticks=[], yticks=[])


def main() -> None:
    """Measure the body and write the picture."""
    if not DATA.is_dir():
        sys.exit(f"needed the folder of real data at {DATA}: set GIANTLIKE_TEST_DATA to it")
    case = next(each for each in cases.jupiter(DATA) if FRAME in each.name)
    fix = gl.Auto().estimate(case.image, case.camera, case.scene).unwrap()
    assert isinstance(fix, gl.PositionFix)
    center, found = fix.center_px, outline(case, fix.position_camera_km)
    away = found - center
    turn = np.abs(np.angle(np.exp(1j * (np.arctan2(away[:, 1], away[:, 0]) - ZOOM_RAD))))
    corner = found[np.argmin(turn)] - ZOOM_PX

    figure, (whole, part) = plt.subplots(1, 2, figsize=(9.4, 5.0), dpi=100, layout="constrained")
    draw(whole, case, fix, size=2.0)
    whole.set(xlim=center[0] + (-HALF_PX, HALF_PX), ylim=center[1] + (HALF_PX, -HALF_PX))
    whole.add_patch(Rectangle(corner, 2 * ZOOM_PX, 2 * ZOOM_PX, fill=False, edgecolor="white", linewidth=0.8))
    whole.legend(loc="lower left", fontsize=8, facecolor="black", labelcolor="white", framealpha=0.6)
    sigma = np.sqrt(np.diag(fix.covariance_px2))
    chosen = fix.findings.chosen
    whole.set_title(f"Jupiter by Cassini: center to {sigma[0]:.2f}, {sigma[1]:.2f} px ({chosen})", fontsize=10)
    draw(part, case, fix, size=5.0)
    part.set(xlim=corner[0] + np.array([0.0, 2 * ZOOM_PX]), ylim=corner[1] + np.array([2 * ZOOM_PX, 0.0]))
    part.set_title("Limb points, in haze 80 km above the outline", fontsize=10)
    buffer = io.BytesIO()
    figure.savefig(buffer)
    Picture.open(buffer).convert("RGB").save(OUTPUT, optimize=True)
    print(f"{OUTPUT}: {OUTPUT.stat().st_size} bytes; {fix}")


if __name__ == "__main__":
    main()
