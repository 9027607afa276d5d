"""Selection of landmarks on a shape model: places spread over it with texture to match."""

from __future__ import annotations

import threading
import weakref
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, require, unit
from giantlike.core.errors import InputError
from giantlike.ray_tracing.trace import surface_albedo
from giantlike.ray_tracing.tracer import Tracer, tracer_for
from giantlike.shapes import LocalMap, TriangleMesh
from giantlike.shapes.landmarks import Landmark, LandmarkCatalog, landmark_of

_CANDIDATES = 6  # places tried for each landmark wanted
_LOOK_SAMPLES = 11  # along each side of a rough map, for the texture of a place
_FIRST_SPACING = 1.1  # between neighbors, over the side of the square of area that each could have
_TIGHTER = 0.9  # factor between the spacings tried, until there are enough
_LOWEST_SPACING = 0.5  # of the size of a landmark: nearer ones see the same ground
_SPACING_STEPS = 40  # spacings tried, at most
_RAYS_AT_A_TIME = 200_000  # to bound the memory


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkBuildOptions:
    """Options of :func:`build_landmarks`."""

    count: int = 150  # largest number of landmarks; fewer where they would lie on top of each other
    size_km: float | None = None  # side of a landmark; a fifth of the mean radius if not given
    samples: int = 33  # heights along each side of a map
    seed: int = 0  # of the places that are tried

    def __post_init__(self) -> None:
        require(1 <= self.count <= 100_000, f"count must be in [1, 100000], got {self.count}")
        require(self.size_km is None or 0.0 < self.size_km < np.inf, f"size_km must be > 0, got {self.size_km}")
        require(3 <= self.samples <= 1001, f"samples must be in [3, 1001], got {self.samples}")
        require(self.seed >= 0, f"seed must be >= 0, got {self.seed}")


_PLACE = ("point_body_km", "normal_body")
DEFAULT_BUILD = LandmarkBuildOptions()
DEFAULT_SIZE = 0.2  # of the mean radius


def build_landmarks(mesh: TriangleMesh, options: LandmarkBuildOptions = DEFAULT_BUILD) -> LandmarkCatalog:
    """Choose landmarks on a mesh.

    Places are drawn evenly over the surface. At each, a square grid is laid across the mean normal of the ground
    around it and rays sent down: what they meet is the map. Its texture is what turns into brightness: the rms tilt
    and the rms relative albedo. The strongest are taken first, none nearer to another than a distance that is reduced
    until there are enough.
    """
    size_km = DEFAULT_SIZE * mesh.mean_radius_km if options.size_km is None else options.size_km
    require(
        size_km < mesh.circumscribing_radius_km,
        f"size_km must be less than the radius of the body, {mesh.circumscribing_radius_km:g} km, got {size_km:g}",
    )
    points, normals = _places(mesh, size_km, options)
    looked_at = _maps(mesh, points, normals, size_km, min(_LOOK_SAMPLES, options.samples))
    chosen = _select_apart(looked_at, np.sqrt(mesh.area_km2 / options.count), size_km, options.count)
    points, normals = (np.array([getattr(one, name) for one in chosen]).reshape(-1, 3) for name in _PLACE)
    found = _maps(mesh, points, normals, size_km, options.samples)
    if not found:
        raise InputError(
            f"{mesh.name!r}: nowhere is there ground throughout a map of {size_km:g} km; try a smaller one"
        )
    ranked = sorted(found, key=lambda landmark: -landmark.texture)
    named = tuple(
        replace(landmark, map=replace(landmark.map, name=f"L{number:04d}")) for number, landmark in enumerate(ranked)
    )
    return LandmarkCatalog(named, body_name=mesh.name, shape_sha256=mesh.sha256)


_CATALOGS: weakref.WeakKeyDictionary[TriangleMesh, LandmarkCatalog] = weakref.WeakKeyDictionary()
_CATALOGS_LOCK = threading.Lock()


def landmarks_of(mesh: TriangleMesh) -> LandmarkCatalog:
    """Return the landmarks of a mesh by :data:`DEFAULT_BUILD`, chosen once for each mesh object."""
    with _CATALOGS_LOCK:
        catalog = _CATALOGS.get(mesh)
        if catalog is None:
            catalog = _CATALOGS[mesh] = build_landmarks(mesh)
        return catalog


def _places(mesh: TriangleMesh, size_km: float, options: LandmarkBuildOptions) -> tuple[Float, Float]:
    """Points (n, 3), km, spread evenly over the surface, and mean normals (n, 3) of the ground around them."""
    random = np.random.default_rng(options.seed)
    count = _CANDIDATES * options.count
    shares = np.cumsum(mesh.areas_km2)
    drawn = (np.arange(count) + random.uniform(size=count)) / count * shares[-1]
    facets = np.searchsorted(shares, drawn)
    u, v = np.sort(random.uniform(size=(2, count)), axis=0)
    a, b, c = (mesh.vertices_km[mesh.faces[facets, corner]] for corner in range(3))
    points = u[:, None] * a + (v - u)[:, None] * b + (1.0 - v)[:, None] * c
    tree = cKDTree(mesh.vertices_km[mesh.faces].mean(axis=1))
    normals = np.empty_like(points)
    for number, near in enumerate(tree.query_ball_point(points, 0.5 * size_km)):
        ground = [*near, int(facets[number])]
        same_side = mesh.normals[ground] @ mesh.normals[facets[number]] > 0.0
        normals[number] = (mesh.areas_km2[ground] * same_side) @ mesh.normals[ground]
    return points, unit(normals)


def _maps(mesh: TriangleMesh, points: Float, normals: Float, size_km: float, samples: int) -> list[Landmark]:
    """Maps at places where every ray of the grid meets ground nearby."""
    tracer = tracer_for(mesh)
    axis = np.linspace(-0.5 * size_km, 0.5 * size_km, samples)
    x, y = np.meshgrid(axis, axis)
    grid = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    turns = [_axes(normal) for normal in normals]
    step = max(_RAYS_AT_A_TIME // len(grid), 1)
    found = []
    for start in range(0, len(points), step):
        part = slice(start, start + step)
        heights, albedo = _heights(mesh, tracer, points[part], turns[part], grid, size_km)
        for number in np.flatnonzero(np.isfinite(heights).all(axis=1)):
            level = float(heights[number].mean())
            local = LocalMap(
                center_body_km=points[start + number] + level * normals[start + number],
                body_from_map=Rotation.from_matrix(turns[start + number]),
                heights_km=(heights[number] - level).reshape(x.shape),
                spacing_km=float(axis[1] - axis[0]),
                albedo=None if albedo is None else albedo[number].reshape(x.shape),
            )
            found.append(landmark_of(local))
    return found


def _heights(
    mesh: TriangleMesh, tracer: Tracer, points: Float, turns: list[Float], grid: Float, reach_km: float
) -> tuple[Float, Float | None]:
    """Heights (n, g), km, of the ground along the normals at places (n, 3), NaN where it is far, and its albedo."""
    axes = np.stack(turns)
    up = axes[:, None, :, 2]
    starts = points[:, None] + grid @ np.swapaxes(axes, -1, -2) + reach_km * up
    down = np.broadcast_to(-up, starts.shape).reshape(-1, 3)
    hits = tracer.intersect(starts.reshape(-1, 3), down)
    heights = reach_km - np.einsum("ij,ij->i", hits.points_km - starts.reshape(-1, 3), down)
    ground = (np.abs(heights) < reach_km) & (np.einsum("ij,ij->i", hits.normals, down) < 0.0)
    heights = np.where(ground, heights, np.nan).reshape(starts.shape[:2])
    if mesh.albedo is None:
        return heights, None
    albedo, seen = np.ones(hits.hit.size), np.flatnonzero(hits.hit)
    albedo[seen] = surface_albedo(mesh, hits.points_km[seen], hits.facets[seen])
    return heights, albedo.reshape(heights.shape)


def _axes(normal: Float) -> Float:
    """Axes (3, 3) of a map, in columns: x to the south, y to the east as in SPC's maps, z along the normal."""
    east = np.cross([0.0, 0.0, 1.0], normal)
    if float(np.linalg.norm(east)) < 1e-6:
        east = np.array([0.0, 1.0, 0.0])
    east = unit(east)
    return np.stack([np.cross(east, normal), east, normal], axis=-1)


def _select_apart(found: list[Landmark], side_km: float, size_km: float, count: int) -> list[Landmark]:
    """The strongest of the landmarks, apart from each other; at most ``count``."""
    order = np.argsort([-landmark.texture for landmark in found], kind="stable")
    places = np.array([found[number].point_body_km for number in order]).reshape(-1, 3)
    apart_km = _FIRST_SPACING * side_km
    taken: list[int] = []
    for _ in range(_SPACING_STEPS):
        taken = _apart(places, apart_km, count)
        if len(taken) == count or apart_km * _TIGHTER < _LOWEST_SPACING * size_km:
            break
        apart_km *= _TIGHTER
    return [found[order[number]] for number in taken]


def _apart(places: Float, apart_km: float, count: int) -> list[int]:
    """Numbers of the first places (n, 3) of which none is nearer to one before it."""
    tree, free, taken = cKDTree(places), np.ones(len(places), dtype=bool), []
    for number in range(len(places)):
        if free[number]:
            taken.append(number)
            if len(taken) == count:
                break
            free[tree.query_ball_point(places[number], apart_km)] = False
    return taken
