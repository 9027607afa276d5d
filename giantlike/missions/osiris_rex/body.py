"""Bennu twice: as it is, and as the shape model of a phase has it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from giantlike.core.arrays import Float, require, unit
from giantlike.missions.osiris_rex.setup import BodySetup, ModelSetup
from giantlike.ray_tracing.tracer import tracer_for
from giantlike.shapes import TriangleMesh, geodesic_directions, irregular_body, load_shape
from giantlike.shapes.albedo import VertexAlbedo
from giantlike.shapes.generate import surface_waves

_WAVENUMBERS = (5.0, 12.0, 30.0)
"""Radians of phase per radian on the body, of the errors of a shape model: patches of 36, 15 and 6 degrees. The maplets
that such models are made of overlap, so that errors go on from one to the next [assumed]."""
_ALBEDO_WAVENUMBERS = (3.0, 40.0)
"""Of large patches, and of boulders with the ground between them [assumed]."""
_WAVES = 96
"""Plane waves that make up a field; enough for its values to be nearly normal."""
_LEAST_NEIGHBORS = 3
"""Vertices of the truth that a vertex of a model averages, at least: the corners of the facet below it."""


def true_body(setup: BodySetup, shape: Path | None, *, seed: int, facets: int) -> TriangleMesh:
    """Make Bennu as it is in the images."""
    lumps = setup.lumps if shape is None else 0.0
    relief = irregular_body(seed, radii_km=(1.0, 1.0, 1.0), facets=facets, relief=lumps, roughness=setup.roughness)
    heights = np.linalg.norm(relief.vertices_km, axis=1)
    directions = relief.vertices_km / heights[:, None]
    base_km = _top_radii_km(setup, directions) if shape is None else _radii_of_file_km(shape, directions)
    mesh = TriangleMesh(directions * (base_km * heights)[:, None], relief.faces, "Bennu")
    if shape is None:
        factor = setup.mean_radius_km / mesh.mean_radius_km
        mesh = TriangleMesh(mesh.vertices_km * factor, mesh.faces, "Bennu (made up)")
    mesh = mesh.translated(-mesh.center_of_figure_km)
    random = np.random.default_rng([seed, 1])
    spots = _field(directions, random, _ALBEDO_WAVENUMBERS)
    return mesh.with_albedo(VertexAlbedo(np.maximum(1.0 + setup.albedo_rms * spots, 0.2)))


def model_of(truth: TriangleMesh, setup: ModelSetup, *, seed: int, facets: int | None = None) -> TriangleMesh:
    """Make the shape model of a phase: a coarser mesh through the truth, with errors of heights and of scale."""
    facets = facets or setup.facets
    directions, faces = geodesic_directions(facets)
    count = max(round(len(truth.faces) / len(faces)), _LEAST_NEIGHBORS)
    radii_km = np.linalg.norm(truth.vertices_km, axis=1)
    _, nearest = cKDTree(truth.vertices_km / radii_km[:, None]).query(directions, count)
    errors_km = 1e-3 * setup.error_m * _field(directions, np.random.default_rng([seed, 2]), _WAVENUMBERS)
    heights_km = (radii_km[nearest].mean(axis=1) + errors_km) * (1.0 + setup.scale)
    return TriangleMesh(directions * heights_km[:, None], faces, f"Bennu, model of {len(faces)} facets")


def _field(directions: Float, random: np.random.Generator, wavenumbers: tuple[float, ...]) -> Float:
    """Random field (n,) of unit variance over directions (n, 3), in equal parts of several wavenumbers."""
    parts = [surface_waves(directions, random, wavenumber=number, waves=_WAVES) for number in wavenumbers]
    return np.asarray(np.sum(parts, axis=0) / np.sqrt(len(wavenumbers)))


def _top_radii_km(setup: BodySetup, directions: Float) -> Float:
    """Radii (n,) of a spinning top, ``(rho / a)^p + (z / c)^p = 1``, in directions (n, 3)."""
    scaled = directions / setup.axes_km
    waist = np.hypot(scaled[:, 0], scaled[:, 1]) ** setup.exponent
    return np.asarray((waist + np.abs(scaled[:, 2]) ** setup.exponent) ** (-1.0 / setup.exponent))


def _radii_of_file_km(path: Path, directions: Float) -> Float:
    """Radii (n,) of a shape file in directions (n, 3), from its center of figure."""
    mesh = load_shape(path, units="km")
    mesh = mesh.translated(-mesh.center_of_figure_km)
    away = 4.0 * mesh.circumscribing_radius_km * unit(directions)
    hits = tracer_for(mesh).intersect(away, -directions)
    require(bool(hits.hit.all()), f"{path}: a ray to the center of figure misses the shape, which has to be closed")
    return np.asarray(np.linalg.norm(hits.points_km, axis=1))
