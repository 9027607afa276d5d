"""Bodies to render: a triaxial ellipsoid in closed form, and a star-shaped body with relief by marching along rays."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.independent.fields import SphereField
from giantlike.independent.laws import Float

MARCH_STEP = 1e-3
"""Least step of a march, in radii: 0.15 px at a radius of 150 px. A crest that lies wholly within one is missed: its
height is the square of the step over eight radii of curvature, 2.5e-6 radii (4e-4 px) where it bends within 3 deg."""

SECANT_STEPS = 6
"""Steps of the secant rule that keeps the root bracketed (Illinois); leaves below 1e-9 radii of a step of 1e-3."""

SHADOW_START = 2e-5
"""Height above the ground at which a march toward the Sun starts, in radii: above the error of the hits."""


@dataclass(frozen=True, eq=False)
class RayHits:
    """Where rays meet a body."""

    hit: NDArray[np.bool_]  # (n,); rays that meet it
    points: Float  # (m, 3) km, body-fixed; first points, of the rays that hit, in their order
    normals: Float  # (m, 3), body-fixed; outward unit normals


class Body(Protocol):
    """A figure that rays can be sent to."""

    @property
    def bounding_radius_km(self) -> float:
        """Radius of a sphere around the origin that holds the body, km."""
        ...

    def intersect(self, origin_km: Float, directions: Float) -> RayHits:
        """Meet rays (n, 3) of any length from one origin (3,), body-fixed."""
        ...

    def shadowed(self, points_km: Float, sun: Float) -> NDArray[np.bool_]:
        """Tell the points (m, 3) from which the body itself hides the Sun (3,), body-fixed."""
        ...

    def albedo_at(self, points_km: Float) -> Float | None:
        """Relative albedo (m,) of points (m, 3) of the surface; None for a body of one albedo."""
        ...


def _unit_sphere_hits(origin: Float, directions: Float, radius: float = 1.0) -> tuple[Float, Float]:
    """Ray parameters (n,) where rays enter and leave a sphere around zero; NaN for those that pass it."""
    squared = np.einsum("ij,ij->i", directions, directions)
    nearest = -(directions @ origin) / squared
    closest = origin + nearest[:, None] * directions
    inside = radius**2 - np.einsum("ij,ij->i", closest, closest)
    with np.errstate(invalid="ignore"):
        half = np.sqrt(np.where(inside >= 0.0, inside, np.nan) / squared)
    return nearest - half, nearest + half


@dataclass(frozen=True, eq=False)
class EllipsoidBody:
    """Triaxial ellipsoid; rays meet it in closed form."""

    radii_km: ArrayLike  # half axes
    albedo: SphereField | None = None  # relative albedo less one, by direction from the center
    _radii: Float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_radii", np.broadcast_to(np.asarray(self.radii_km, dtype=float), (3,)).copy())

    @property
    def bounding_radius_km(self) -> float:
        """Largest half axis, km."""
        return float(self._radii.max())

    def intersect(self, origin_km: Float, directions: Float) -> RayHits:
        """Meet rays (n, 3) from one origin (3,), body-fixed, km."""
        origin, scaled = origin_km / self._radii, directions / self._radii
        entry, _ = _unit_sphere_hits(origin, scaled)
        hit = entry > 0.0
        on_sphere = origin + entry[hit, None] * scaled[hit]
        normals = on_sphere / self._radii
        normals /= np.sqrt(np.einsum("ij,ij->i", normals, normals))[:, None]
        return RayHits(hit=hit, points=on_sphere * self._radii, normals=normals)

    def shadowed(self, points_km: Float, sun: Float) -> NDArray[np.bool_]:
        """Return False for all points: a convex body casts no shadow on what faces the Sun."""
        return np.zeros(len(points_km), dtype=bool)

    def albedo_at(self, points_km: Float) -> Float | None:
        """Relative albedo (m,) of points (m, 3)."""
        return None if self.albedo is None else 1.0 + self.albedo(points_km)

    def mesh(self, cells: int = 160) -> tuple[Float, NDArray[np.int64]]:
        """Vertices (km) and facets of the same figure; see :func:`facet_mesh`."""
        directions, facets = facet_mesh(cells)
        return directions * self._radii * _outward(cells), facets


@dataclass(frozen=True, eq=False)
class ReliefBody:
    """Ellipsoid with heights: the surface lies at ``radii u (1 + h(u))`` for unit vectors u. Rays march to it.

    Marching is safe: a height above the ground divided by the steepest slope of the distance function is a step that
    cannot cross the ground; what is left is found by bisection.
    """

    radii_km: ArrayLike  # half axes of the base
    relief: SphereField  # heights over the base, as a share of the radius, by the direction u
    albedo: SphereField | None = None  # relative albedo less one, by the direction u
    _radii: Float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_radii", np.broadcast_to(np.asarray(self.radii_km, dtype=float), (3,)).copy())

    @property
    def bounding_radius_km(self) -> float:
        """Radius of a sphere that holds the body, km."""
        return float(self._radii.max() * (1.0 + self.relief.extremes[1]))

    @property
    def _steepness(self) -> float:
        """Largest change of the height function per length, in the scaled space, outside the lowest ground."""
        return float(np.hypot(1.0, self.relief.steepest / (1.0 + self.relief.extremes[0])))

    def _height(self, points: Float) -> Float:
        """Height (n,) of points of the scaled space over the ground, along the radius."""
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", points, points)) - 1.0 - self.relief(points), dtype=float)

    def intersect(self, origin_km: Float, directions: Float) -> RayHits:
        """Meet rays (n, 3) from one origin (3,), body-fixed, km."""
        origin, scaled = origin_km / self._radii, directions / self._radii
        length = np.sqrt(np.einsum("ij,ij->i", scaled, scaled))
        scaled = scaled / length[:, None]
        entry, leave = _unit_sphere_hits(origin, scaled, 1.0 + self.relief.extremes[1] + 1e-9)
        candidates = np.flatnonzero(entry > 0.0)
        found, place = self._march(origin, scaled[candidates], entry[candidates], leave[candidates])
        hit = np.zeros(len(directions), dtype=bool)
        hit[candidates[found]] = True
        points = origin + place[found, None] * scaled[hit]
        return RayHits(hit=hit, points=points * self._radii, normals=self._normals(points))

    def _march(self, origin: Float, rays: Float, start: Float, end: Float) -> tuple[NDArray[np.bool_], Float]:
        """March along unit rays between two places each: (crossed the ground, place of it)."""
        steepness = self._steepness
        bracket = np.stack(
            [start, start, np.zeros_like(start), np.zeros_like(start)]
        )  # places, heights before and after
        crossed = np.zeros(len(rays), dtype=bool)
        active, ways, places = np.arange(len(rays)), rays, start
        height = self._height(origin + start[:, None] * rays)
        while active.size:
            before, above = places, height
            places = places + np.maximum(height / steepness, MARCH_STEP)
            height = self._height(origin + places[:, None] * ways)
            below = height < 0.0
            found = active[below]
            crossed[found] = True
            bracket[:, found] = before[below], places[below], above[below], height[below]
            stay = ~below & (places < end[active])
            active, ways, places, height = active[stay], ways[stay], places[stay], height[stay]
        result = start.copy()
        result[crossed] = self._root(origin, rays[crossed], bracket[:, crossed])
        return crossed, result

    def _root(self, origin: Float, rays: Float, bracket: Float) -> Float:
        """Places (n,) along rays where the height is zero, between a place above the ground and one below (4, n)."""
        low, high, above, below = bracket
        middle = high
        for _ in range(SECANT_STEPS):
            middle = (low * below - high * above) / (below - above)
            height = self._height(origin + middle[:, None] * rays)
            over = height > 0.0
            # The end that stays has its height halved, so that both ends move in (Illinois).
            low, high = np.where(over, middle, low), np.where(over, high, middle)
            above, below = np.where(over, height, 0.5 * above), np.where(over, 0.5 * below, height)
        return np.asarray(middle, dtype=float)

    def _normals(self, points: Float) -> Float:
        """Outward normals in body axes of points (m, 3) of the scaled space on the ground."""
        distance = np.sqrt(np.einsum("ij,ij->i", points, points))[:, None]
        outward = points / distance - self.relief.gradient(points) / distance
        normals = outward / self._radii
        return np.asarray(normals / np.sqrt(np.einsum("ij,ij->i", normals, normals))[:, None], dtype=float)

    def shadowed(self, points_km: Float, sun: Float) -> NDArray[np.bool_]:
        """Tell the points (m, 3), km, from which the ground hides the Sun (3,)."""
        ray = sun / self._radii
        ray = ray / np.linalg.norm(ray)
        points = points_km / self._radii
        places = points * (1.0 + SHADOW_START / np.sqrt(np.einsum("ij,ij->i", points, points)))[:, None]
        steepness, highest = self._steepness, 1.0 + self.relief.extremes[1]
        hidden = np.zeros(len(points), dtype=bool)
        active = np.arange(len(points))
        while active.size:
            height = self._height(places)
            hidden[active[height < 0.0]] = True
            away = (np.einsum("ij,ij->i", places, places) > highest**2) & (places @ ray > 0.0)
            stay = (height >= 0.0) & ~away
            active, places = active[stay], places[stay]
            places = places + np.maximum(height[stay] / steepness, MARCH_STEP)[:, None] * ray
        return hidden

    def albedo_at(self, points_km: Float) -> Float | None:
        """Relative albedo (m,) of points (m, 3)."""
        return None if self.albedo is None else 1.0 + self.albedo(points_km / self._radii)

    def mesh(self, cells: int = 160) -> tuple[Float, NDArray[np.int64]]:
        """Vertices (km) and facets of the same figure; see :func:`facet_mesh`."""
        directions, facets = facet_mesh(cells)
        return directions * (1.0 + self.relief(directions))[:, None] * self._radii * _outward(cells), facets


def _outward(cells: int) -> float:
    """Factor on vertices that makes up for half the mean depth of facets below a sphere, about that of an outline."""
    return 1.0 + (np.pi / (2.0 * cells)) ** 2 / 12.0


def facet_mesh(cells: int) -> tuple[Float, NDArray[np.int64]]:
    """Return a closed mesh of the unit sphere from a cube with equal angles.

    Facets lie up to ``a^2 / 4`` and on the average ``a^2 / 6`` of the radius below the sphere, a the angle of a cell,
    and the ``mesh`` of a body moves its vertices out by ``a^2 / 12``. At 160 cells (307,200 facets) and a radius of
    150 px, outline and surface so are right to 0.0025 px at worst, 0.0012 px on the average.

    Returns (n, 3), unit vectors of the vertices, and (12 * cells**2, 3), their indices by facet, counterclockwise seen
    from outside.
    """
    half = cells // 2
    steps = np.arange(-half, half + 1)
    first, second = np.meshgrid(steps, steps, indexing="ij")
    lattice: list[NDArray[np.int64]] = []
    quads: list[NDArray[np.int64]] = []
    side = 2 * half + 1
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    for axis in range(3):
        for sign in (-1, 1):
            face = np.empty((side * side, 3), dtype=np.int64)
            face[:, axis] = sign * half
            face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = first.ravel(), second.ravel()
            square = np.stack([corner, corner + side, corner + side + 1, corner + 1], axis=1)
            quads.append((square if sign > 0 else square[:, ::-1]) + len(lattice) * side * side)
            lattice.append(face)
    nodes, index = np.unique(np.concatenate(lattice), axis=0, return_inverse=True)
    cube = np.tan(nodes * (np.pi / 4.0 / half))
    square = index.reshape(-1)[np.concatenate(quads)]
    facets = np.concatenate([square[:, [0, 1, 2]], square[:, [0, 2, 3]]])
    return cube / np.linalg.norm(cube, axis=1, keepdims=True), facets.astype(np.int64)
