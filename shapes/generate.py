"""Generated bodies: geodesic meshes of ellipsoids, and synthetic asteroids from a seed."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_finite, require, unit
from giantlike.shapes.base import Ellipsoid
from giantlike.shapes.mesh import Faces, TriangleMesh

_MAX_FACETS = 20_000_000  # bounds the memory that a mistyped number can request
# Relief of the synthetic asteroids: made up, no result of a real body depends on it.
_CRATERS, _BOULDERS = 60, 500  # numbers of them
_CRATER_CHORD = (0.08, 0.55)  # smallest and largest rim radius over body radius
_BOULDER_CHORD = (0.012, 0.045)  # smallest and largest radius over body radius
_POWER_LAW = 2.0  # exponent of the cumulative number of craters and boulders over size


def mesh_from_ellipsoid(ellipsoid: Ellipsoid, *, facets: int = 20_480) -> TriangleMesh:
    """Geodesic mesh whose vertices lie on an ellipsoid.

    Parameters
    ----------
    ellipsoid : Ellipsoid
    facets : int; smallest number of facets; the mesh has the next larger 20 k^2
    """
    directions, faces = geodesic_directions(facets)
    return TriangleMesh(directions * ellipsoid.radii_km, faces, f"{ellipsoid.name} (mesh)")


def irregular_body(
    seed: int,
    *,
    radii_km: ArrayLike = (0.28, 0.196, 0.168),
    facets: int = 50_000,
    relief: float = 0.06,
    roughness: float = 0.004,
    name: str | None = None,
) -> TriangleMesh:
    """Synthetic rubble-pile asteroid: lumps of low degree, craters with rims, boulders, fine roughness.

    The same seed and options give the same body everywhere. Every ray from the origin meets the surface
    once, and the origin is the center of figure.

    Parameters
    ----------
    seed : int
    radii_km : (3,) float64, km, body; semi-axes of the ellipsoid under the relief
    facets : int; smallest number of facets; the mesh has the next larger 20 k^2
    relief : float; standard deviation of the lumps, as a fraction of the local radius; craters scale with it
    roughness : float; standard deviation of the roughness near facet size, same unit; boulders scale with it
    name : str, optional

    Raises
    ------
    InputError
        A value is out of range.
    """
    require(0.0 <= relief <= 0.2, f"relief must be in [0, 0.2], got {relief}")
    require(0.0 <= roughness <= 0.05, f"roughness must be in [0, 0.05], got {roughness}")
    label = name or f"irregular-{seed}"
    radii = as_finite(radii_km, (3,), "radii_km")
    base = Ellipsoid(radii_km=radii)
    directions, faces = geodesic_directions(facets)
    random = np.random.default_rng(seed)
    points = unit(directions * base.radii_km)  # finer facets where the body is slender
    height = relief * surface_waves(points, random, wavenumber=2.6, waves=24)
    height += 0.35 * relief * surface_waves(points, random, wavenumber=6.0, waves=48)
    height += 10.0 * relief * _craters(points, random)
    height += roughness * surface_waves(points, random, wavenumber=25.0, waves=96)
    height += 0.5 * roughness * surface_waves(points, random, wavenumber=60.0, waves=96)
    height += 5.0 * roughness * _boulders(points, random)
    radius = np.linalg.norm(points / base.radii_km, axis=1) ** -1.0 * np.exp(height)
    mesh = TriangleMesh(points * radius[:, None], faces, label)
    return mesh.translated(-mesh.center_of_figure_km)


def geodesic_directions(facets: int) -> tuple[Float, Faces]:
    """Unit vectors (n, 3) and facets (m, 3) of an icosahedron whose facets are split k^2-fold."""
    require(1 <= facets <= _MAX_FACETS, f"facets must be in [1, {_MAX_FACETS}], got {facets}")
    k = math.ceil(math.sqrt(facets / 20.0))
    corners, triangles = _icosahedron()
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(k + 1), np.arange(k + 1), indexing="ij"))
    i, j = i[i + j <= k], j[i + j <= k]
    weights = np.stack([k - i - j, i, j], axis=-1) / k
    number = np.full((k + 2, k + 2), -1)
    number[i, j] = np.arange(i.size)
    up = np.stack([number[i, j], number[i + 1, j], number[i, j + 1]], axis=-1)[i + j < k]
    down = np.stack([number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]], axis=-1)[i + j < k - 1]
    local = np.concatenate([up, down])
    points = np.einsum("nc,tcx->tnx", weights, corners[triangles]).reshape(-1, 3)
    faces = (local[None] + i.size * np.arange(20)[:, None, None]).reshape(-1, 3)
    _, first, inverse = np.unique(np.round(points * 1e9) + 0.0, axis=0, return_index=True, return_inverse=True)
    return unit(points[first]), inverse.reshape(-1)[faces]


def _icosahedron() -> tuple[Float, Faces]:
    """Unit corners (12, 3) and faces (20, 3): every triple of corners that are mutual neighbors."""
    golden = (1.0 + math.sqrt(5.0)) / 2.0
    flat = np.array([[0.0, a, b * golden] for a in (-1, 1) for b in (-1, 1)])
    corners = unit(np.concatenate([np.roll(flat, shift, axis=1) for shift in range(3)]))
    near = (corners @ corners.T > 0.4) & ~np.eye(12, dtype=bool)
    triples = [
        (a, b, c) for a in range(12) for b in range(a) for c in range(b) if near[a, b] and near[b, c] and near[c, a]
    ]
    faces = np.array(triples, dtype=np.int64)
    inward = np.linalg.det(corners[faces]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return corners, faces


def surface_waves(points: Float, random: np.random.Generator, *, wavenumber: float, waves: int) -> Float:
    """Random smooth field (n,) on the sphere with unit variance: a sum of plane waves in all directions.

    ``wavenumber``: rad per unit of length, within 30 %: features are half of ``2 pi / wavenumber`` rad wide.
    """
    vectors = unit(random.normal(size=(waves, 3))) * wavenumber * random.uniform(0.7, 1.3, size=(waves, 1))
    phases = random.uniform(0.0, 2.0 * np.pi, size=waves)
    field = np.zeros(len(points))
    for vector, phase in zip(vectors, phases, strict=True):
        field += np.cos(points @ vector + phase)
    return field * math.sqrt(2.0 / waves)


def _power_law(random: np.random.Generator, limits: tuple[float, float], count: int) -> Float:
    """Sizes between limits whose cumulative number falls as size^-_POWER_LAW, largest first."""
    low, high = (limit**-_POWER_LAW for limit in limits)
    return np.asarray((high + (low - high) * np.sort(random.uniform(size=count))) ** (-1.0 / _POWER_LAW))


def _craters(points: Float, random: np.random.Generator) -> Float:
    """Bowls with raised rims in units of the body radius, at most 0.3 of their own radius deep."""
    height = np.zeros(len(points))
    centers = unit(random.normal(size=(_CRATERS, 3)))
    freshness = random.uniform(0.25, 1.0, size=_CRATERS)
    for center, size, fresh in zip(centers, _power_law(random, _CRATER_CHORD, _CRATERS), freshness, strict=True):
        chord = np.sqrt(np.maximum(2.0 - 2.0 * points @ center, 0.0)) / size
        near = chord < 2.0
        x = chord[near]
        bowl = -np.maximum(1.0 - x**2, 0.0) + 0.25 * np.exp(-((x - 1.05) ** 2) / 0.04)
        height[near] += 0.3 * size * fresh * bowl
    return height


def _boulders(points: Float, random: np.random.Generator) -> Float:
    """Half-sunk blocks, one unit high for the largest."""
    height = np.zeros(len(points))
    centers = unit(random.normal(size=(_BOULDERS, 3)))
    for center, size in zip(centers, _power_law(random, _BOULDER_CHORD, _BOULDERS), strict=True):
        chord2 = np.maximum(2.0 - 2.0 * points @ center, 0.0) / size**2
        near = chord2 < 1.0
        height[near] = np.maximum(height[near], size / _BOULDER_CHORD[1] * np.sqrt(1.0 - chord2[near]))
    return height
