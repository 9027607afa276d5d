"""Jobs of ``speed.py`` on star images: detection and attitude of rich fields of 1024 x 1024 px.

Truth is ``giantlike.independent``, with a new sky, attitude and noise for each image. ``growth`` goes over the number
of stars and sets sep, OpenCV, photutils and tetra3rs beside, on the same images in the same run: sep extracts and
refines by windows, OpenCV lists connected pixels, photutils finds (DAOFIND), and none of them gives a covariance;
tetra3rs identifies our detections of real stars.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import sep
import tetra3rs
from detection import with_daofind
from scipy.spatial import cKDTree
from speed import Job, Outcome, least_cpu_ms
from star_fields import CAMERA, FOCAL_PX, SIZE, RichField, real_field, rich_field

from giantlike.catalogs import load_catalog
from giantlike.core.arrays import Float
from giantlike.core.outcomes import AttitudeFix, Failure
from giantlike.processing.detection.detections import Detections
from giantlike.stars import StarNavigation, StarOptions
from giantlike.stars.tetra import pattern_database

NUMBERS = (10, 30, 100, 300, 1000, 2000, 5000)
IMAGES_EACH = 2
SCALE = np.array([FOCAL_PX, FOCAL_PX, SIZE / 2])  # px per rad
INFORMATION = 0.96  # that of ``StarNavigation.detect_and_solve``


@dataclass(frozen=True, kw_only=True, eq=False)
class Detected:
    """A field, and the detections that its attitude is to come from."""

    field: RichField
    detections: Detections


def navigation(field: RichField, *, all_stars: bool = False) -> StarNavigation:
    """Star navigation with the catalog of a field."""
    return StarNavigation(CAMERA, field.catalog, StarOptions(all_stars=all_stars))


def detect(field: RichField, information: float = INFORMATION) -> Detections:
    """Detect as for an attitude by default, or all sources."""
    stars = navigation(field)
    found = stars.detect(field.image, replace(stars.detection, information=information))
    assert isinstance(found, Detections)
    return found


def judge_attitude(field: RichField, fix: AttitudeFix | Failure) -> Outcome | str:
    """Error across the line of sight per axis, its sigma, and the squared error of all axes over the covariance."""
    if isinstance(fix, Failure):
        return str(fix.reason)
    turn = (fix.camera_from_inertial * field.attitude.inv()).as_rotvec()
    return Outcome(
        error=float(np.sqrt(np.mean((turn * SCALE)[:2] ** 2))),
        sigma=float(np.sqrt(np.mean((np.diag(fix.covariance_rad2) * SCALE**2)[:2]))),
        nees_over_dof=float(turn @ np.linalg.solve(fix.covariance_rad2, turn)) / 3.0,
    )


def judge_centroids(field: RichField, found: Detections) -> Outcome | str:
    """Error of the centroids per axis, median sigma, and mean squared error over covariance, of unblended stars."""
    distance, nearest = (np.asarray(each) for each in cKDTree(field.places_px).query(found.points_px, k=2))
    alone = (distance[:, 0] < 1.0) & (distance[:, 1] > 12.0) & (found.flags == 0)
    error = (found.points_px - field.places_px[nearest[:, 0]])[alone]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_px2[alone]), error)
    return Outcome(
        error=float(np.sqrt(np.mean(error**2))),
        sigma=float(np.sqrt(np.mean(found.sigma_px[alone] ** 2))),
        nees_over_dof=float(nees.mean()) / 2.0,
    )


def jobs() -> list[Job]:
    """Stars: 1,600 sources, of which 1,000 are in the catalog."""

    def detected(number: int) -> Detected:
        field = rich_field(number)
        return Detected(field=field, detections=detect(field))

    def solved(given: Detected) -> AttitudeFix | Failure:
        return navigation(given.field).solve_detections(given.field.image, given.detections)

    def whole(all_stars: bool) -> Callable[[RichField], AttitudeFix | Failure]:
        return lambda field: navigation(field, all_stars=all_stars).solve(field.image)

    return [
        Job(name="stars detect", goal_u=0.35, fresh=rich_field, run=detect, judge=judge_centroids),
        Job(
            name="stars solve",
            goal_u=0.2,
            fresh=detected,
            run=solved,
            judge=lambda given, fix: judge_attitude(given.field, fix),
        ),
        Job(name="stars image", goal_u=0.55, fresh=rich_field, run=whole(False), judge=judge_attitude),
        Job(name="stars image, all stars", goal_u=None, fresh=rich_field, run=whole(True), judge=judge_attitude),
    ]


def growth(unit: Callable[[], None]) -> list[dict[str, Any]]:
    """Cost over the number of stars, beside other tools."""
    rows = [_of_stars(stars, unit) for stars in NUMBERS]
    return [*rows, _identified(unit)]


def _of_stars(stars: int, unit: Callable[[], None]) -> dict[str, Any]:
    tools: dict[str, Callable[[RichField], Any]] = {
        "detect": detect,
        "detect_all": lambda field: detect(field, 1.0),
        "detect_and_solve": lambda field: navigation(field).solve(field.image),
        "detect_and_solve_all_stars": lambda field: navigation(field, all_stars=True).solve(field.image),
        "sep": _with_sep,
        "opencv": _with_opencv,
        "photutils_daofind": lambda field: with_daofind(field.image.pixels),
    }
    spent: dict[str, list[float]] = {name: [] for name in tools}
    units, sigmas, counts = [], [], []
    for number in range(IMAGES_EACH + 1):
        field = rich_field(1000 + number, stars)
        ms = {name: least_cpu_ms(partial(tool, field), 1) for name, tool in tools.items()}
        if number == 0:
            continue  # to warm up
        for name, value in ms.items():
            spent[name].append(value)
        units.append(least_cpu_ms(unit, 2))
        fixes = [navigation(field, all_stars=every).solve(field.image) for every in (False, True)]
        good = [fix for fix in fixes if isinstance(fix, AttitudeFix)]
        if len(good) == len(fixes):
            sigmas.append([float(np.sqrt(np.trace(fix.covariance_rad2[:2, :2]) / 2.0)) for fix in good])
            counts.append([fix.n_used for fix in good])
    row: dict[str, Any] = {"growth": "stars", "stars": stars, "sources": len(detect(field, 1.0))}
    row |= {f"{name}_ms": round(float(np.median(values)), 1) for name, values in spent.items()}
    row |= {f"{name}_u": round(float(np.median(np.array(values) / units)), 2) for name, values in spent.items()}
    if sigmas:
        few, every = np.median(sigmas, axis=0)
        row |= {"used": np.median(counts, axis=0).tolist(), "sigma_px": round(few * FOCAL_PX, 5)}
        row["sigma_over_that_of_all"] = round(few / every, 4)
    return row | {"images": IMAGES_EACH, "solved": len(sigmas)}


def _with_opencv(field: RichField) -> Float:
    """Centers of components above five sigma, unweighted: no window, no neighbors, no covariance."""
    pixels = field.image.pixels.astype(np.float32)
    pixels -= np.median(pixels)
    noise = 1.4826 * float(np.median(np.abs(pixels)))
    bright = (pixels > 5.0 * noise).astype(np.uint8)
    _, _, _, centers = cv2.connectedComponentsWithStats(bright)
    return np.asarray(centers[1:], dtype=np.float64)


def _with_sep(field: RichField) -> Float:
    pixels = field.image.pixels.astype(np.float32)
    background = sep.Background(pixels)
    pixels -= background.back()
    found = sep.extract(pixels, 5.0, err=background.globalrms)
    x, y, _ = sep.winpos(pixels, found["x"], found["y"], np.full(len(found), 0.7))
    return np.stack([x, y], axis=1)


def _identified(unit: Callable[[], None]) -> dict[str, Any]:
    """Attitude from nothing, of images of real stars: ours, and tetra3rs alone on the same detections."""
    catalog = load_catalog()
    ours, theirs, units, solved = [], [], [], [0, 0]
    for number in range(IMAGES_EACH + 1):
        image, _ = real_field(number, catalog)
        stars = StarNavigation(CAMERA, catalog, StarOptions(lost_in_space=True))
        found = stars.detect(image)
        assert isinstance(found, Detections)
        fov_deg = float(np.degrees(2.0 * np.arctan(SIZE / 2.0 / FOCAL_PX)))
        centroids = np.column_stack([found.points_px - CAMERA.center_px, found.flux_dn])
        database = pattern_database(fov_deg)

        alone = partial(
            database.solve_from_centroids, centroids, fov_estimate_deg=fov_deg, image_width=SIZE, image_height=SIZE
        )
        mine = least_cpu_ms(partial(stars.solve_detections, image, found), 1)
        other = least_cpu_ms(alone, 1)
        if number == 0:
            continue
        ours.append(mine)
        theirs.append(other)
        units.append(least_cpu_ms(unit, 2))
        solved[0] += isinstance(stars.solve_detections(image, found), AttitudeFix)
        solved[1] += isinstance(alone(), tetra3rs.SolveResult)
    return {
        "growth": "lost in space, real stars",
        "ours_ms": round(float(np.median(ours)), 1),
        "tetra3rs_ms": round(float(np.median(theirs)), 1),
        "unit_ms": round(float(np.median(units)), 1),
        "solved_of": [*solved, IMAGES_EACH],
    }
