"""Bennu twice: as it is, and as the shape model of a phase has it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from giantlike.core.arrays import Float, require, unit
from giantlike.independent import ReliefBody, bumps, craters, rough, tabulate
from giantlike.missions.osiris_rex.setup import ModelSetup
from giantlike.ray_tracing.tracer import tracer_for
from giantlike.shapes import TriangleMesh, load_shape
from giantlike.shapes.generate import geodesic_directions, surface_waves

_WAVENUMBERS = (5.0, 12.0, 30.0)
"""Radians of phase per radian on the body, of the errors of a shape model: patches of 36, 15 and 6 degrees. The maplets
that such models are made of overlap, so that errors go on from one to the next [assumed]."""
_WAVES = 96  # plane waves that make up a field; enough for its values to be nearly normal
_SAMPLES = 12  # points of the truth that a vertex of a model averages, within the facets around it


def true_body(setup: SimpleNamespace, shape: Path | None, *, seed: int, cells: int) -> ReliefBody:
    """Make Bennu as it is in the images: a spinning top or the shape of a file, with relief and albedo."""
    boulders = rough(seed, rms=setup.roughness, degrees=(20.0, 200.0), count=300, cells=cells)
    if shape is None:
        relief = tabulate(lambda directions: _top_heights(setup.exponent, directions), cells=cells)
        relief += bumps(seed + 1, rms=setup.lumps, widths_deg=(8.0, 40.0), cells=cells)
        relief += craters(seed + 2, depth=0.06, radii_deg=(2.0, 15.0), cells=cells)
        radii_km = np.array(setup.axes_km)
    else:
        mesh = load_shape(shape, units="km")
        mesh, radii_km = mesh.translated(-mesh.center_of_figure_km), np.full(3, mesh.mean_radius_km)
        relief = tabulate(lambda directions: _radii_km(mesh, directions) / mesh.mean_radius_km - 1.0, cells=cells)
    albedo = rough(seed + 3, rms=setup.albedo_rms, degrees=(3.0, 40.0), count=200, cells=cells)
    body = ReliefBody(radii_km, relief + boulders, albedo)
    directions, _ = geodesic_directions(50_000)
    heights_km = radii_of(body, directions)
    center_km = 0.75 * np.mean(heights_km[:, None] ** 4 * directions, axis=0) / np.mean(heights_km**3)
    shift = tabulate(lambda towards: -unit(towards * radii_km) @ center_km / setup.mean_radius_km, cells=cells)
    scale = 1.0 if shape is not None else setup.mean_radius_km / float(np.mean(heights_km**3) ** (1.0 / 3.0))
    return replace(body, radii_km=radii_km * scale, relief=body.relief + shift)


def radii_of(body: ReliefBody, directions: Float) -> Float:
    """Radii (n,) of a body in directions (n, 3), km."""
    scaled = directions / np.asarray(body.radii_km)
    length = np.linalg.norm(scaled, axis=1)
    return np.asarray((1.0 + body.relief(scaled / length[:, None])) / length)


def model_of(truth: ReliefBody, setup: ModelSetup, *, seed: int, facets: int | None = None) -> TriangleMesh:
    """Make the shape model of a phase: a coarser mesh through the truth, with errors of heights and of scale."""
    directions, faces = geodesic_directions(facets or setup.facets)
    rng = np.random.default_rng([seed, 2])
    reach = np.sqrt(4.0 * np.pi / len(directions))  # side of the patch of a vertex, rad
    radii_km = np.zeros(len(directions))
    for offset in rng.uniform(-0.5 * reach, 0.5 * reach, (_SAMPLES, len(directions), 3)):
        radii_km += radii_of(truth, unit(directions + offset)) / _SAMPLES
    waves = [surface_waves(directions, rng, wavenumber=number, waves=_WAVES) for number in _WAVENUMBERS]
    errors_km = 1e-3 * setup.error_m * np.sum(waves, axis=0) / np.sqrt(len(_WAVENUMBERS))
    heights_km = (radii_km + errors_km) * (1.0 + setup.scale)
    return TriangleMesh(directions * heights_km[:, None], faces, f"Bennu, model of {len(faces)} facets")


def _top_heights(exponent: float, directions: Float) -> Float:
    """Heights (n,) over the unit sphere of a spinning top, ``rho^p + z^p = 1``, in directions (n, 3)."""
    waist = np.hypot(directions[:, 0], directions[:, 1]) ** exponent
    return np.asarray((waist + np.abs(directions[:, 2]) ** exponent) ** (-1.0 / exponent) - 1.0)


def _radii_km(mesh: TriangleMesh, directions: Float) -> Float:
    """Radii (n,) of a mesh in directions (n, 3), from its origin."""
    hits = tracer_for(mesh).intersect(4.0 * mesh.circumscribing_radius_km * unit(directions), -directions)
    require(bool(hits.hit.all()), "a ray to the center of figure misses the shape, which has to be closed")
    return np.asarray(np.linalg.norm(hits.points_km, axis=1))
