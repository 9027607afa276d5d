"""One picture of what a demonstration found: stars, a limb, and every error beside its sigma.

Run after ``giantlike demo``, with its folder and the picture to write::

    python examples/demo_picture.py demo-output docs/images/demo.png
"""

from __future__ import annotations

import csv
import io
import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

import giantlike as gl
from giantlike.catalogs import load_catalog
from giantlike.io import read_geometry
from giantlike.plotting.overlays import MARKS, stretch_image
from giantlike.plotting.style import BLUE, GREEN, INK, ORANGE, PURPLE, drawing
from giantlike.ray_tracing import trace_silhouette
from giantlike.shapes import load_shape

STARS, BODY = "rock_10_long1.fits", "rock_10_short.fits"
TARGET = "ROCK"
MARGIN_PX = 30.0
COLORS = {"unresolved": ORANGE, "cross_correlation": BLUE, "limb_matching": GREEN, "ellipsoid_cra": PURPLE}


def draw_stars(axis: Axes, image: gl.Image, fix: gl.AttitudeFix) -> None:
    """Detected stars of an image, and where the catalog puts them."""
    axis.imshow(stretch_image(image.pixels), cmap="gray", extent=(-0.5, image.columns - 0.5, image.rows - 0.5, -0.5))
    axis.plot(*fix.observed_px.T, "o", mfc="none", mec=MARKS["matched star"], ms=7, mew=0.8)
    axis.set_title(f"attitude, lost in space: {fix.n_used} stars, {fix.rms_px:.2f} px rms")


def draw_body(axis: Axes, image: gl.Image, fix: gl.PositionFix, outline_px: np.ndarray) -> None:
    """Close-up of a body: where it was predicted, and the limb that was found."""
    axis.imshow(stretch_image(image.pixels, longest_px=max(image.pixels.shape)), cmap="gray")
    axis.plot(*outline_px.T, "--", color=MARKS["a priori outline and center"], lw=1.2, label="predicted outline")
    axis.plot(*fix.limb_px.T, ".", color=MARKS["limb points used"], ms=3.5, label="limb found")
    axis.plot(*fix.center_px, "x", color="#ff5c7a", ms=8, mew=1.8, label="center found")
    low = np.minimum(outline_px.min(axis=0), fix.limb_px.min(axis=0)) - MARGIN_PX
    high = np.maximum(outline_px.max(axis=0), fix.limb_px.max(axis=0)) + MARGIN_PX
    axis.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]))
    axis.set_title(f"limb_matching: center to {np.sqrt(np.trace(fix.covariance_px2) / 2):.3f} px, 1 sigma")
    axis.legend(loc="lower left", labelcolor="white", fontsize=7.5)


def draw_errors(axis: Axes, folder: Path) -> None:
    """Errors of all centers in a run, with the sigmas that they state, over the size of the body."""
    with (folder / "truth.csv").open(encoding="utf-8") as stream:
        truth = {(row["file"], row["target"]): row for row in csv.DictReader(stream)}
    with (folder / "run" / "observations.csv").open(encoding="utf-8") as stream:
        found = [row for row in csv.DictReader(stream) if row["status"] == "ok"]
    for place, (name, color) in enumerate(COLORS.items()):
        rows = [(row, truth[row["file"], row["target"]]) for row in found if row["estimator"] == name]
        size = np.array([float(true["diameter_px"]) for _, true in rows]) * 1.06 ** (place - 1.5)
        for coordinate, mark in (("x", "o"), ("y", "s")):
            error = [float(row[f"{coordinate}_px"]) - float(true[f"{coordinate}_px"]) for row, true in rows]
            sigma = [float(row[f"sigma_{coordinate}_px"]) for row, _ in rows]
            label = name if coordinate == "x" else None
            axis.errorbar(size, error, sigma, fmt=mark, ms=3.5, color=color, lw=1, mfc="white", label=label)
    axis.axhline(0.0, color=INK, lw=0.8)
    axis.set(xscale="log", xlabel="size of the body, px", ylabel="error of the center, x and y, px", ylim=(-0.05, 0.05))
    axis.set_title("every fix against truth, with its own sigma")
    axis.legend(fontsize=7.5, loc="upper left")


def picture(folder: Path) -> Figure:
    """Solve one star image and one body image of a demonstration, and draw them beside all its errors."""
    camera = gl.Camera.load(folder / "camera.toml")
    options = gl.StarOptions(lost_in_space=True, max_magnitude=8.5)
    star_image, image = (gl.Image.open(folder / "images" / name) for name in (STARS, BODY))
    attitude = gl.StarNavigation(camera, load_catalog("default"), options).solve(star_image).unwrap()
    image = image.with_attitude(attitude)
    geometry_row = read_geometry(folder / "geometry.csv").image(BODY)
    assert geometry_row is not None  # a demonstration has every image in it
    row = geometry_row.targets[TARGET]
    assert row.target_position_inertial_km is not None  # and fills every column
    assert row.body_from_inertial is not None
    assert row.sun_direction_inertial is not None
    place = gl.ApparentGeometry(
        position_inertial_km=row.target_position_inertial_km,
        inertial_from_body=row.body_from_inertial.inv(),
        sun_direction_inertial=row.sun_direction_inertial,
    )
    shape = load_shape(folder / "shapes" / "rock.obj", units="km")
    scene = gl.Scene(targets=(gl.Target(name=TARGET, shape=shape, ephemeris=place),))
    fix = gl.LimbMatching().estimate(image, camera, scene).unwrap()
    geometry = scene.geometry(image, TARGET)
    assert not isinstance(geometry, gl.Failure)
    angles = np.linspace(0.0, 2.0 * np.pi, 361)
    sun = geometry.sun_direction_camera
    outline = trace_silhouette(geometry.body(), camera.model, angles, sun_direction_camera=sun)
    with drawing():
        figure = Figure(figsize=(12.6, 4.4), layout="constrained", facecolor="white")
        panels = figure.subplots(1, 3, width_ratios=(1, 1, 1.15))
        for axis in panels[:2]:
            axis.grid(visible=False)
            axis.set(xticks=[], yticks=[])
        draw_stars(panels[0], star_image, attitude)
        draw_body(panels[1], image, fix, np.asarray(outline.points_px))
        draw_errors(panels[2], folder)
    return figure


def main() -> None:
    """Draw the picture of the folder and into the file given on the command line."""
    folder, path = (Path(argument) for argument in sys.argv[1:3])
    with drawing(), io.BytesIO() as buffer:
        picture(folder).savefig(buffer, format="png", dpi=80)
        Image.open(buffer).convert("RGB").quantize(128).save(path, optimize=True)


if __name__ == "__main__":
    main()
