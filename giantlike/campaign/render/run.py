"""Rendering a scene file: images with their truth, previews, and a campaign that can be run on them."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomli_w

from giantlike._system.atomic import make_folder, write_bytes_atomic, write_text_atomic
from giantlike.campaign.render.plan import FITS_SUFFIXES, RenderPlan
from giantlike.catalogs import StarCatalog, load_catalog
from giantlike.core.arrays import Float, require
from giantlike.core.errors import DataError
from giantlike.io import write_geometry
from giantlike.io.geometry_table import GeometryRow
from giantlike.relative import ESTIMATORS
from giantlike.simulation import Sources, simulate_image
from giantlike.simulation.images import SimulatedImage
from giantlike.simulation.truth import geometry_rows, write_simulated

_GAMMA = 0.4  # exponent of the display: a star a thousand times fainter than the body is shown at 6 % of white
_CAMPAIGN, _CAMERA, _GEOMETRY = "campaign.toml", "camera.toml", "geometry.csv"


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderedImage:
    """Summary of one image."""

    path: Path
    targets: dict[str, list[float]]  # pixel (x, y) of the center of each target in view
    stars: int  # number of stars in view
    peak_dn: float  # peak_dn, background_dn: brightest pixel and median
    background_dn: float
    saturated_px: int  # saturated_px, cosmic_px: number of pixels that are saturated, and hit by cosmic rays
    cosmic_px: int
    time_s: float  # computing time


def render_images(
    plan: RenderPlan,
    output: Path | None = None,
    *,
    overwrite: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> tuple[RenderedImage, ...]:
    """Render all images of a scene file."""
    plan, folder = _resolve_output(plan, output)
    paths = [folder / exposure.file for exposure in plan.exposures]
    _check_output(plan, folder, paths, overwrite=overwrite)
    catalog = None if plan.catalog is None else load_catalog(plan.catalog)
    rows: list[GeometryRow] = []
    results = []
    with plan.kernels():
        shots = plan.shots()
        for path in paths:
            make_folder(path.parent)
        for number, ((shot, scene), path) in enumerate(zip(shots, paths, strict=True)):
            started = time.perf_counter()
            taken = simulate_image(
                shot,
                plan.camera,
                Sources(
                    scene=scene,
                    catalog=catalog,
                    photometry=plan.photometry,
                    sun_distance_au=plan.content.light.distance_au,
                ),
                seed=(plan.content.render.seed, number),
                detector=plan.detector,
                options=plan.options,
            )
            _write(plan, path, taken)
            rows += geometry_rows(taken)
            results.append(_summary(plan, path, taken, time.perf_counter() - started))
            if progress is not None:
                progress("rendering", number + 1, len(shots))
    if plan.content.render.campaign:
        _write_campaign(plan, folder, rows, catalog)
    return tuple(results)


def _resolve_output(plan: RenderPlan, output: Path | None) -> tuple[RenderPlan, Path]:
    """Plan, with its only image renamed if ``output`` is a file, and the output folder."""
    if output is None:
        return plan, plan.path.parent / plan.content.render.output
    if output.suffix.lower() not in FITS_SUFFIXES:
        return plan, output
    images = len(plan.exposures)
    require(images == 1, f"--output {output} names one image, but the scene file has {images}: give a folder")
    return replace(plan, exposures=(replace(plan.exposures[0], file=output.name),)), output.parent


def _check_output(plan: RenderPlan, folder: Path, paths: list[Path], *, overwrite: bool) -> None:
    """Refuse files that exist, and unknown estimators."""
    section = plan.content.render
    for name in section.estimators:
        if name not in ESTIMATORS:
            raise DataError(
                plan.path, f"render.estimators: unknown estimator {name!r}; there are {', '.join(ESTIMATORS)}"
            )
    if overwrite:
        return
    files = [*paths]
    if section.preview:
        files += [path.with_suffix(".png") for path in paths]
    if section.campaign:
        files += [folder / name for name in (_CAMPAIGN, _CAMERA, _GEOMETRY)]
    for path in files:
        if path.exists():
            raise DataError(path, "already exists; --overwrite replaces it")


def _write(plan: RenderPlan, path: Path, taken: SimulatedImage) -> None:
    section = plan.content.render
    write_simulated(path, taken, plan.camera, extensions=section.truth, backplanes=section.backplanes)
    if section.preview:
        write_bytes_atomic(path.with_suffix(".png"), preview_png(taken.image.pixels.astype(np.float64)))


def _summary(plan: RenderPlan, path: Path, taken: SimulatedImage, time_s: float) -> RenderedImage:
    pixels = taken.image.pixels
    full = min(plan.camera.detector.saturation_dn, 2**plan.detector.bits - 1)
    centers = {name: plan.camera.model.project(body.position_camera_km) for name, body in taken.bodies.items()}
    return RenderedImage(
        path=path,
        targets={name: center.tolist() for name, center in centers.items() if np.isfinite(center).all()},
        stars=len(taken.stars.ids),
        peak_dn=float(pixels.max()),
        background_dn=float(np.median(pixels)),
        saturated_px=int((pixels >= int(full)).sum()),
        cosmic_px=int((taken.readout.cosmic_e > 0).sum()),
        time_s=time_s,
    )


def _write_campaign(plan: RenderPlan, folder: Path, rows: Iterable[GeometryRow], catalog: StarCatalog | None) -> None:
    """Write camera, geometry (the truth as a priori) and a campaign that runs on the images."""
    plan.camera.save(folder / _CAMERA)
    write_geometry(folder / _GEOMETRY, rows)
    table: dict[str, Any] = {
        "campaign": {"name": plan.path.stem, "output": "run"},
        "images": {"files": [exposure.file for exposure in plan.exposures], "geometry": _GEOMETRY},
        "camera": {"file": _CAMERA},
        "targets": [_target_table(plan, number, folder) for number in range(len(plan.targets))],
    }
    if plan.content.stars is not None and catalog is not None:
        name = plan.content.stars.catalog
        table["stars"] = {"catalog": name if name == "default" else _relative(plan.path.parent / name, folder)}
        if plan.content.stars.max_magnitude is not None:
            table["stars"]["max_magnitude"] = plan.content.stars.max_magnitude
    write_text_atomic(folder / _CAMPAIGN, tomli_w.dumps(table))


def _target_table(plan: RenderPlan, number: int, folder: Path) -> dict[str, Any]:
    setup, section = plan.targets[number], plan.content.targets[number]
    shape = setup.shape
    table = {
        "name": setup.name,
        "shape": _relative(shape, folder) if isinstance(shape, Path) else {"radii_km": list(shape)},
        "units": setup.units,
        "estimators": list(plan.content.render.estimators),
    }
    return table if section.reflectance is None else table | {"reflectance": section.reflectance}


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def preview_png(pixels_dn: Float) -> bytes:
    """Encode an image as an 8 bit gray PNG: a power of the signal above the median, scaled to the brightest pixel."""
    values = np.asarray(pixels_dn, dtype=np.float64)
    above = np.maximum(values - float(np.median(values)), 0.0)
    gray = (above / max(float(above.max()), 1e-12)) ** _GAMMA
    done, data = cv2.imencode(".png", np.rint(255.0 * gray).astype(np.uint8))
    assert done
    return bytes(data)
