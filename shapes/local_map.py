"""Local maps: grids of heights over a patch of a body, alone or laid over a coarse global shape.

They are the maplets of stereophotoclinometry: a position on the body, local axes, and heights on a square grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, Indices, Mask, as_finite, as_floats, require
from giantlike.core.values import Value
from giantlike.shapes.albedo import FacetAlbedo, VertexAlbedo
from giantlike.shapes.mesh import Faces, TriangleMesh

_REACH = 0.1  # of the radius of the body: more than the relief, less than the distance of the far side


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalMap(Value):
    """Heights over a patch of a body.

    Parameters
    ----------
    center_body_km : (3,) float64, km, body; middle of the grid at height zero
    body_from_map : Rotation; from map axes: x along columns, y along rows, z up
    heights_km : (rows, columns) float64, km; along z; NaN where the map has none; at least 2 by 2
    spacing_km : float, km; distance of neighboring heights: the ground sample distance
    albedo : (rows, columns) float64, optional; relative albedo at the same positions
    name : str

    Raises
    ------
    InputError
        A shape is wrong, nothing has a height, or a value is out of range.
    """

    center_body_km: Float
    body_from_map: Rotation
    heights_km: Float
    spacing_km: float
    albedo: Float | None = None
    name: str = "map"

    def __post_init__(self) -> None:
        object.__setattr__(self, "center_body_km", as_finite(self.center_body_km, (3,), "center_body_km"))
        heights = np.array(as_floats(self.heights_km, (), "heights_km"))
        require(
            heights.ndim == 2 and min(heights.shape) >= 2,
            f"heights_km must be a grid of at least 2 by 2, got shape {heights.shape}",
        )
        require(not np.isinf(heights).any(), "heights_km must be finite, or NaN where there is none")
        require(0.0 < self.spacing_km < np.inf, f"spacing_km must be > 0, got {self.spacing_km}")
        object.__setattr__(self, "heights_km", heights)
        if self.albedo is not None:
            object.__setattr__(self, "albedo", as_finite(self.albedo, heights.shape, "albedo"))
        require(len(self._faces()) > 0, f"{self.name!r}: no cell of the map has heights at three corners")
        Value.__post_init__(self)

    @property
    def half_extent_km(self) -> tuple[float, float]:
        """Half the length of the grid along x and y, km."""
        rows, columns = self.heights_km.shape
        return 0.5 * (columns - 1) * self.spacing_km, 0.5 * (rows - 1) * self.spacing_km

    def mesh(self) -> TriangleMesh:
        """Mesh of the map alone: an open surface with two facets for each cell of the grid, in body axes."""
        albedo = None if self.albedo is None else VertexAlbedo(self.albedo.ravel())
        return TriangleMesh(self.to_body(np.nan_to_num(self._grid())), self._faces(), self.name, albedo=albedo)

    def to_map(self, points_body_km: Float) -> Float:
        """Transform points (n, 3), km, from body axes to the axes of the map."""
        return (points_body_km - self.center_body_km) @ self.body_from_map.as_matrix()

    def to_body(self, points_map_km: Float) -> Float:
        """Transform points (n, 3), km, from the axes of the map to body axes."""
        return points_map_km @ self.body_from_map.as_matrix().T + self.center_body_km

    def _grid(self) -> Float:
        """Points (rows * columns, 3), km, map axes."""
        half_x, half_y = self.half_extent_km
        rows, columns = self.heights_km.shape
        x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
        return np.stack([x, y, self.heights_km], axis=-1).reshape(-1, 3)

    def _faces(self) -> Faces:
        """Facets (m, 3) of the cells, counter-clockwise from above, without those that lack a height."""
        rows, columns = self.heights_km.shape
        number = np.arange(rows * columns).reshape(rows, columns)
        a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
        faces = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)], axis=2).reshape(-1, 3)
        return np.asarray(faces[np.isfinite(self.heights_km.ravel()[faces]).all(axis=1)])


def overlaid(body: TriangleMesh, maps: Sequence[LocalMap], *, reach_km: float | None = None) -> TriangleMesh:
    """Lay local maps over a global shape, later ones over earlier ones.

    Parameters
    ----------
    body : TriangleMesh; the global shape; usually coarser than the maps
    maps : sequence of LocalMap; with heights everywhere
    reach_km : float, km, optional
        A map replaces the global surface from this far below its lowest height to this far above its highest; None
        takes a tenth of the body's radius. Surface farther along z, such as the far side of the body, stays.

    Returns
    -------
    TriangleMesh
        Facets: the remaining ones of the body, then the facets of the last map, at the end its seam.

    Raises
    ------
    InputError
        A map has gaps, or covers nothing of the body.

    Notes
    -----
    Over the rectangle of its grid, along its z axis, a map is the only surface: global facets under or over it
    are cut along the four sides, and the inner parts are taken away. Nothing of the body is left to shine through a map
    or to shade it. The seam is a wall along those sides: from both cut edges it hangs down, deeper than the surfaces
    differ there. Where map and body do not meet in height the wall shows as a step, as high as the difference;
    elsewhere it is inside the body. Light does not leak in, but the surface is closed to the eye only: it has border
    vertices, and its volume counts the walls.

    Albedo, if the body or a map has one, becomes albedo by vertex, 1 where none is given: a global map of albedo is
    sampled at the vertices.
    """
    result = body
    for local in maps:
        require(bool(np.isfinite(local.heights_km).all()), f"{local.name!r} has gaps: it cannot replace the body there")
        depth = _REACH * body.circumscribing_radius_km if reach_km is None else reach_km
        result = _laid_over(result, local, depth)
    return result


class _Surface:
    """Vertices in map axes with their albedo, to which cuts add."""

    def __init__(self, points_km: Float, albedo: Float) -> None:
        self.points = np.column_stack([points_km, albedo])

    def split(self, faces: Faces, axis: int, side: float) -> tuple[Faces, Faces, Indices]:
        """Cut triangles (m, 3) where ``axis`` is ``side``: those above, those below, and the edges between."""
        offset = self.points[faces, axis] - side
        beyond = offset > 0.0
        count = beyond.sum(axis=1)
        mixed = (count == 1) | (count == 2)
        lone = np.where(count[mixed] == 1, beyond[mixed].argmax(axis=1), (~beyond[mixed]).argmax(axis=1))
        order = (lone[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(faces[mixed], order, axis=1).T
        ends = np.sort(np.concatenate([np.stack([a, b], axis=1), np.stack([a, c], axis=1)]), axis=1)
        edges, which = np.unique(ends, axis=0, return_inverse=True)
        start, stop = self.points[edges[:, 0]], self.points[edges[:, 1]]
        fraction = (side - start[:, axis]) / (stop[:, axis] - start[:, axis])
        added = start + fraction[:, None] * (stop - start)
        added[:, axis] = side
        ab, ac = (which.reshape(-1) + len(self.points)).reshape(2, -1)
        self.points = np.concatenate([self.points, added])
        tip = np.stack([a, ab, ac], axis=1)
        rest = np.concatenate([np.stack([ab, b, c], axis=1), np.stack([ab, c, ac], axis=1)])
        tip_beyond = count[mixed] == 1
        rest_beyond = np.tile(~tip_beyond, 2)
        above = np.concatenate([faces[count == 3], tip[tip_beyond], rest[rest_beyond]])
        below = np.concatenate([faces[count == 0], tip[~tip_beyond], rest[~rest_beyond]])
        return above, below, np.stack([ab, ac], axis=1)

    def add(self, points: Float) -> Indices:
        """Append vertices (n, 4); their numbers."""
        first = len(self.points)
        self.points = np.concatenate([self.points, points])
        return np.arange(first, len(self.points))


def _laid_over(body: TriangleMesh, local: LocalMap, reach_km: float) -> TriangleMesh:
    """Lay one map over a body; surface farther than ``reach_km`` below or above the map is kept."""
    vertices, faces, albedo = _with_vertex_albedo(body)
    surface = _Surface(local.to_map(vertices), albedo)
    half = local.half_extent_km
    under = _overlapping(surface.points[:, :3], faces, local, reach_km)
    require(bool(under.any()), f"{local.name!r} covers nothing of {body.name!r}: is it in the same axes and units?")
    kept, inside, rims = [faces[~under]], faces[under], []
    for axis, side, sign in ((0, half[0], 1), (0, -half[0], -1), (1, half[1], 1), (1, -half[1], -1)):
        above, below, cut = surface.split(inside, axis, side)
        outside, inside = (above, below) if sign > 0 else (below, above)
        kept.append(outside)
        across = surface.points[cut, 1 - axis]
        near = (across.min(axis=1) < half[1 - axis]) & (across.max(axis=1) > -half[1 - axis])
        rims.append((cut[near], axis, -sign))
    grid = surface.add(np.column_stack([local._grid(), _albedo_of(local)]))
    border = _border(grid.reshape(local.heights_km.shape))
    rims += [(edges, axis, sign) for edges, axis, sign in border]
    touched = np.concatenate([edges.ravel() for edges, _, _ in rims])
    depth = float(np.ptp(surface.points[touched, 2])) + local.spacing_km
    walls = [_wall(surface, edges, axis, sign, depth) for edges, axis, sign in rims]
    faces = np.concatenate([*kept, local._faces() + grid[0], *walls])
    used, numbers = np.unique(faces, return_inverse=True)
    points = surface.points[used]
    painted = body.albedo is not None or local.albedo is not None
    return TriangleMesh(
        local.to_body(points[:, :3]),
        numbers.reshape(-1, 3),
        body.name,
        albedo=VertexAlbedo(np.maximum(points[:, 3], 0.0)) if painted else None,
    )


def _with_vertex_albedo(body: TriangleMesh) -> tuple[Float, Faces, Float]:
    """Vertices, facets, and albedo (n,) of the vertices; facets with a separate albedo share no vertices."""
    vertices, faces, albedo = body.vertices_km, body.faces, body.albedo
    if albedo is None:
        return vertices, faces, np.ones(len(vertices))
    if isinstance(albedo, FacetAlbedo):
        corners = vertices[faces].reshape(-1, 3)
        return corners, np.arange(len(corners)).reshape(-1, 3), np.repeat(albedo.values, 3)
    if isinstance(albedo, VertexAlbedo):
        return vertices, faces, albedo.values
    return vertices, faces, albedo.at(vertices, np.zeros(len(vertices), dtype=np.int64), None)


def _albedo_of(local: LocalMap) -> Float:
    return np.ones(local.heights_km.size) if local.albedo is None else local.albedo.ravel()


def _overlapping(points: Float, faces: Faces, local: LocalMap, reach_km: float) -> Mask:
    """Facets (m,) whose bounding box touches the bounding box of a map, widened by ``reach_km`` along z."""
    half_x, half_y = local.half_extent_km
    top, bottom = float(local.heights_km.max()) + reach_km, float(local.heights_km.min()) - reach_km
    low, high = (extreme(points[faces], axis=1) for extreme in (np.min, np.max))
    return np.asarray(np.all((low < [half_x, half_y, top]) & (high > [-half_x, -half_y, bottom]), axis=1))


def _border(grid: Indices) -> list[tuple[Indices, int, int]]:
    """Edges (e, 2) along the sides of a grid of vertex numbers, with the axis and the sense that they face."""
    sides = ((grid[:, -1], 0, 1), (grid[:, 0], 0, -1), (grid[-1], 1, 1), (grid[0], 1, -1))
    return [(np.stack([line[:-1], line[1:]], axis=1), axis, sign) for line, axis, sign in sides]


def _wall(surface: _Surface, edges: Indices, axis: int, sign: int, depth_km: float) -> Faces:
    """Facets of a wall that hangs ``depth_km`` down from edges (e, 2) and faces ``sign`` along ``axis``."""
    along = surface.points[edges[:, 1], 1 - axis] - surface.points[edges[:, 0], 1 - axis]
    turn = (along > 0.0) != (sign > 0) if axis == 0 else (along > 0.0) == (sign > 0)
    edges = np.where(turn[:, None], edges[:, ::-1], edges)
    lowered = surface.points[edges.ravel()] - np.array([0.0, 0.0, depth_km, 0.0])
    feet = surface.add(lowered).reshape(-1, 2)
    first = np.stack([edges[:, 0], feet[:, 0], feet[:, 1]], axis=1)
    second = np.stack([edges[:, 0], feet[:, 1], edges[:, 1]], axis=1)
    return np.concatenate([first, second])
