"""Index of star patterns: triads or quads of catalog stars by their shape, made on demand and cached.

The sky is covered with caps; the brightest stars of each cap form patterns. A pattern is stored as the cell of its
code and the indices of its stars, sorted by cell: a few megabytes for any field of view.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections import OrderedDict
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from giantlike._system.archives import array_of, open_archive_of_arrays
from giantlike._system.reading import reads
from giantlike.catalogs import StarCatalog, StarTable, apparent_directions, cache_folder
from giantlike.catalogs.cache import write_to_cache
from giantlike.catalogs.table import et_of_julian_year
from giantlike.core.arrays import Float, Mask
from giantlike.core.errors import DataError
from giantlike.core.frames import rotate
from giantlike.core.values import Value
from giantlike.stars.field import EPOCH_WHEN_UNKNOWN

_FORMAT = 1  # of the files in the cache; raise it when patterns change
_STEP = math.sqrt(2.0)  # ratio of neighboring cap radii: a cap holds at least half the stars of the radius wanted
_WIDEST_STEP = 9  # largest radius: 22.6 degrees
_NARROWEST_STEP = -7  # smallest radius: 0.088 degrees
_FIRST_MAGNITUDE, _LAST_MAGNITUDE = 5.0, 22.0  # first and last limit tried: naked-eye stars, deepest catalogs
_KEPT = 8  # indices in memory, each of a few megabytes
_CELLS = {3: 256, 4: 64}  # cells along each axis of the code, by its dimension: 2^24 in all
_CHUNK = 1 << 16  # patterns described at once: bounds the memory
_MIX = np.array(
    [
        0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB, 0xD6E8FEB86659FD93,
        0xA0761D6478BD642F, 0xE7037ED1A0B428DB, 0x8EBC6AF09C88C6E3, 0x589965CC75374CC3,
    ],
    dtype=np.uint64,
)  # fmt: skip  # odd multipliers that scatter small numbers over 64 bits


@dataclass(frozen=True, slots=True)
class Density:
    """Density of patterns: spacing of the caps over their radius, and number of stars of each cap."""

    spacing: float
    per_cap: int

    def stars_wanted(self, radius_rad: float) -> int:
        """Number of stars of the whole sky that fill the caps even where stars are few."""
        return int(10.0 * self.per_cap / radius_rad**2)


# By smallest cap radius in degrees: fewer patterns of each part of the sky where caps are small and many.
_DENSITIES = ((2.5, Density(0.75, 9)), (0.9, Density(1.1, 8)), (0.4, Density(1.2, 7)), (0.0, Density(1.3, 7)))


class Pattern(StrEnum):
    """Kind of star pattern; the value is part of file names."""

    TRIAD = "triad"  # three stars and the angles between them: the camera is calibrated
    QUAD = "quad"  # four stars and their shape: the focal length is unknown

    @property
    def stars(self) -> int:
        """Number of stars in a pattern."""
        return 3 if self is Pattern.TRIAD else 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StarIndex(Value):
    """Patterns of stars that can be looked up by shape."""

    pattern: Pattern
    radius_rad: float  # radius of the caps; no pattern is wider than twice as much
    ids: NDArray[np.int64]  # (n,); catalog identifiers of the stars in patterns
    directions: Float  # (n, 3), inertial axes; unit vectors to the stars
    # (m, 3) or (m, 4) uint32; indices of stars, in the order of ``describe_triads`` or ``describe_quads``
    patterns: NDArray[np.uint32]
    cells: NDArray[np.uint32]  # (m,) uint32; cell of each pattern's code, ascending

    def __len__(self) -> int:
        return int(self.cells.size)

    @property
    def widest(self) -> float:
        """Chord of the widest pattern, unitless: the unit of triad codes."""
        return float(2.0 * np.sin(min(self.radius_rad, np.pi / 2.0)))

    def find(self, codes: Float, tolerance: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Look up patterns, ``asked`` and ``found`` (k,), within a tolerance of codes (q, d) along every axis."""
        d = codes.shape[1]
        n = _CELLS[d]
        low = np.clip(np.floor((codes - tolerance) * n).astype(np.int64), 0, n - 1)
        high = np.clip(np.floor((codes + tolerance) * n).astype(np.int64), 0, n - 1)
        reach = high[:, :-1] - low[:, :-1]
        steps = np.array(list(itertools.product(range(int(reach.max(initial=0)) + 1), repeat=d - 1)))
        asked, step = np.nonzero((steps[None] <= reach[:, None]).all(axis=2))
        row = (low[asked, :-1] + steps[step]) @ (n ** np.arange(d - 1, 0, -1))
        start = np.searchsorted(self.cells, (row + low[asked, -1]).astype(np.uint32), side="left")
        stop = np.searchsorted(self.cells, (row + high[asked, -1]).astype(np.uint32), side="right")
        count = stop - start
        first = np.cumsum(count) - count
        found = np.arange(int(count.sum())) - np.repeat(first - start, count)
        return np.repeat(asked, count), found


def density_for(radius_rad: float) -> Density:
    """Density of patterns for caps of a radius."""
    return next(density for limit_deg, density in _DENSITIES if np.degrees(radius_rad) >= limit_deg)


def build_index(
    pattern: Pattern,
    ids: NDArray[np.int64],
    directions: Float,
    radius_rad: float,
    *,
    axis: ArrayLike = (0.0, 0.0, 1.0),
    reach_rad: float = np.pi,
) -> StarIndex:
    """Build the index of the patterns of the brightest of stars (n, 3), brightest first, of every cap."""
    size, density = pattern.stars, density_for(radius_rad)
    centers = caps(density.spacing * radius_rad, axis, reach_rad)
    members = _brightest_in_caps(directions, radius_rad, centers, density.per_cap)
    combinations = members[:, subsets(density.per_cap, size)].reshape(-1, size)
    combinations = combinations[combinations[:, -1] < len(directions)]
    combinations = combinations[np.unique(hash_rows(combinations), return_index=True)[1]]
    widest = float(2.0 * np.sin(min(radius_rad, np.pi / 2.0)))
    parts = [
        _cells(pattern, directions, combinations[start : start + _CHUNK], widest)
        for start in range(0, max(len(combinations), 1), _CHUNK)
    ]
    cell, ordered = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(cell, kind="stable")
    used, place = np.unique(ordered, return_inverse=True)
    return StarIndex(
        pattern=pattern,
        radius_rad=radius_rad,
        ids=ids[used],
        directions=directions[used],
        patterns=place.reshape(ordered.shape)[order].astype(np.uint32),
        cells=cell[order].astype(np.uint32),
    )


@lru_cache(maxsize=32)
def subsets(n: int, size: int) -> NDArray[np.intp]:
    """All subsets (m, size) of the numbers below n, each ascending."""
    return np.array(list(itertools.combinations(range(n), size)), dtype=np.intp).reshape(-1, size)


def hash_rows(rows: NDArray[np.intp]) -> NDArray[np.uint64]:
    """Hash (m,) of each row (m, up to 8): two different rows collide with a probability of 1e-19."""
    return rows.astype(np.uint64) @ _MIX[: rows.shape[1]]


def caps(spacing_rad: float, axis: ArrayLike = (0.0, 0.0, 1.0), reach_rad: float = np.pi) -> Float:
    """Evenly spread unit vectors (n, 3) within an angle of an axis, the closest to it first (a Fibonacci lattice)."""
    n = max(int(np.ceil(4.0 * np.pi / spacing_rad**2)), 12)
    count = min(n, int(np.ceil(n * (1.0 - np.cos(min(reach_rad, np.pi))) / 2.0)) + 1)
    number = np.arange(count)
    z = 1.0 - (2.0 * number + 1.0) / n
    turn = np.pi * (3.0 - np.sqrt(5.0)) * number
    across = np.sqrt(1.0 - z**2)
    lattice = np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=-1)
    return np.asarray(rotate(rotation_to(axis), lattice))


def rotation_to(axis: ArrayLike) -> Rotation:
    """Rotation that takes +z to a unit vector (3,)."""
    x, y, z = np.asarray(axis, dtype=np.float64)
    turn = np.arctan2(y, x)
    return Rotation.from_rotvec(np.arctan2(np.hypot(x, y), z) * np.array([-np.sin(turn), np.cos(turn), 0.0]))


def _cells(
    pattern: Pattern, vectors: Float, combinations: NDArray[np.intp], widest: float
) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Cells (k,) of the codes of patterns, and their ordered stars (k, size)."""
    describe = describe_quads if pattern is Pattern.QUAD else describe_triads
    codes, ordered, _ = describe(vectors, combinations)
    if pattern is Pattern.TRIAD:
        codes = codes / widest
    d = codes.shape[1]
    n = _CELLS[d]
    cell = np.clip((codes * n).astype(np.int64), 0, n - 1)
    return cell @ (n ** np.arange(d - 1, -1, -1)), ordered


def _brightest_in_caps(directions: Float, radius_rad: float, centers: Float, per_cap: int) -> NDArray[np.intp]:
    """Indices (caps, per_cap) of the brightest stars in each cap, ascending; ``len(directions)`` for none."""
    n = len(directions)
    tree = cKDTree(directions)
    chord = 2.0 * np.sin(min(radius_rad, np.pi) / 2.0)
    nearest, _ = tree.query(centers, distance_upper_bound=chord)
    centers = centers[np.isfinite(nearest)]
    table = np.full((len(centers), per_cap), n, dtype=np.intp)
    for row, inside in zip(table, tree.query_ball_point(centers, chord, return_sorted=True), strict=True):
        row[: len(inside)] = inside[:per_cap]
    return table


_memory: OrderedDict[tuple[int, Pattern, int, float | None], tuple[StarCatalog, StarIndex]] = OrderedDict()


def cap_radius_rad(wanted_rad: float) -> float:
    """Largest cap radius of an index, rad, not above ``wanted_rad``; radii are a factor of sqrt(2) apart."""
    return math.radians(_STEP ** _step(wanted_rad))


def sky_index(
    catalog: StarCatalog, pattern: Pattern, radius_rad: float, *, max_magnitude: float | None = None
) -> StarIndex:
    """Index of the whole sky of a catalog, from memory, from the cache folder, or made now.

    Making one takes well below a second for fields from 10 degrees up, and about 10 s at 1 degree.
    """
    key = (id(catalog), pattern, _step(radius_rad), max_magnitude)
    held = _memory.get(key)
    if held is None:
        held = (catalog, _load_or_build(catalog, pattern, cap_radius_rad(radius_rad), max_magnitude))
        _memory[key] = held
        while len(_memory) > _KEPT:
            _memory.popitem(last=False)
    _memory.move_to_end(key)
    return held[1]


def _step(radius_rad: float) -> int:
    step = math.floor(math.log(math.degrees(radius_rad)) / math.log(_STEP) + 1e-9)
    return min(max(step, _NARROWEST_STEP), _WIDEST_STEP)


def _load_or_build(catalog: StarCatalog, pattern: Pattern, radius_rad: float, max_magnitude: float | None) -> StarIndex:
    stars = _brightest(catalog, density_for(radius_rad).stars_wanted(radius_rad), max_magnitude)
    digest = hashlib.sha256(stars.ids.tobytes() + stars.ra_deg.tobytes() + stars.dec_deg.tobytes()).hexdigest()[:16]
    name = f"star-index-{_FORMAT}-{pattern}-{math.degrees(radius_rad):.3f}-{digest}.npz"
    index = _read(cache_folder() / name, pattern, radius_rad)
    if index is not None:
        return index
    directions = apparent_directions(stars, et_of_julian_year(EPOCH_WHEN_UNKNOWN))
    made = build_index(pattern, stars.ids, directions, radius_rad)
    write_to_cache(
        name,
        lambda path: np.savez(path, ids=made.ids, directions=made.directions, patterns=made.patterns, cells=made.cells),
    )
    return made


def _brightest(catalog: StarCatalog, count: int, max_magnitude: float | None) -> StarTable:
    """The ``count`` brightest stars of a catalog, or all its stars."""
    deepest = _LAST_MAGNITUDE if max_magnitude is None else max_magnitude
    limit = min(_FIRST_MAGNITUDE, deepest)
    while True:
        stars = catalog.cone([0.0, 0.0, 1.0], np.pi, max_magnitude=limit)
        if len(stars) >= count or limit >= deepest:
            return stars.select(np.arange(min(count, len(stars))))
        step = math.log(count / max(len(stars), 10)) / math.log(3.0) if len(stars) else 2.0
        limit = min(limit + max(step, 0.3), deepest)


_UNIT = 1e-9  # maximum departure of the norm of a direction from one: rounding leaves 1e-15


def _read(path: Path, pattern: Pattern, radius_rad: float) -> StarIndex | None:
    """Index from a file; None if the file is missing or damaged, so that it is rebuilt."""
    try:
        index = StarIndex(pattern=pattern, radius_rad=radius_rad, **_read_columns(path))
        return index if _is_whole(index) else None
    except (DataError, TypeError, ValueError, AttributeError):
        return None


@reads("a star index")
def _read_columns(path: Path) -> dict[str, NDArray[Any]]:
    with open_archive_of_arrays(path) as columns:
        return {name: array_of(columns, name) for name in columns.files}


def _is_whole(index: StarIndex) -> bool:
    """True if the arrays of an index are of the types and lengths that they are written with."""
    stars, count = index.ids.size, index.cells.size
    forms: list[tuple[NDArray[Any], type[np.generic], tuple[int, ...]]] = [
        (index.ids, np.int64, (stars,)),
        (index.directions, np.float64, (stars, 3)),
        (index.patterns, np.uint32, (count, index.pattern.stars)),
        (index.cells, np.uint32, (count,)),
    ]
    if any(array.dtype != kind or array.shape != shape for array, kind, shape in forms):
        return False
    ordered = bool((np.diff(index.cells.astype(np.int64)) >= 0).all())
    with np.errstate(over="ignore", invalid="ignore"):
        ordered &= bool((np.abs(np.linalg.norm(index.directions, axis=1) - 1.0) < _UNIT).all())
    return ordered and int(index.patterns.max(initial=0)) < max(stars, 1)


CODE_LOW, CODE_SPAN = 0.5 - np.sqrt(0.5), np.sqrt(2.0)
"""Lowest coordinate and diameter of the circle through (0, 0) and (1, 1) that contains C and D."""
# Pairs of the stars of a quad, and the other two stars of each.
_PAIRS = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
_REST = _PAIRS[::-1]


def describe_triads(vectors: Float, triads: NDArray[np.intp]) -> tuple[Float, NDArray[np.intp], Mask]:
    """Sides (m, 3) of triads of unit vectors (n, 3), longest first, with the stars ordered by them, and their sense.

    The three interstar angles are the invariants of three directions under rotation; here as chords, ``2 sin(angle /
    2)``, which need no arc cosine. A mirror image has the same chords and the opposite sense.

    Source: The ODIN paper (004 of the specification), Star Identification: eq. 7, and triads for calibrated cameras.
    """
    corners = vectors[triads]
    across = corners[:, [1, 2, 0]] - corners[:, [2, 0, 1]]
    opposite = np.sqrt(np.einsum("mij,mij->mi", across, across))
    order = np.argsort(-opposite, axis=1, kind="stable")
    ordered = np.take_along_axis(triads, order, axis=1)
    a, b, c = (vectors[ordered[:, j]] for j in range(3))
    right_handed: Mask = np.einsum("ij,ij->i", a, np.cross(b, c)) > 0.0
    return np.take_along_axis(opposite, order, axis=1), ordered, right_handed


def describe_quads(vectors: Float, quads: NDArray[np.intp]) -> tuple[Float, NDArray[np.intp], NDArray[np.intp]]:
    """Codes of quads of unit vectors: the positions of two stars in the frame of the two most distant ones.

    A similarity of the plane tangent to the sphere at the center of the quad takes the most distant stars, A and B, to
    (0, 0) and (1, 1); the positions of the other two, C and D, are the code (k, 4), scaled from the extent of the
    circle over AB, in which they must be, to [0, 1]. A is the end to which C and D are closer, C the star of smaller
    first coordinate. Returned, too: indices (k, 4) of A to D, and of the quads kept (k,).

    Source: The ODIN paper (004 of the specification), Star Identification: quads for uncalibrated cameras.
    """
    corners = vectors[quads]
    apart = np.einsum("mij,mkj->mik", corners, corners)[:, _PAIRS[:, 0], _PAIRS[:, 1]]
    longest = np.argmin(apart, axis=1)
    order = np.concatenate([_PAIRS, _REST], axis=1)[longest]
    corners = np.take_along_axis(corners, order[..., None], axis=1)
    middle = corners.sum(axis=1)
    middle /= np.linalg.norm(middle, axis=1)[:, None]
    plane = corners / np.einsum("mij,mj->mi", corners, middle)[..., None]
    base = plane[:, 1] - plane[:, 0]
    across = np.cross(middle, base)
    away = plane[:, 2:] - plane[:, :1]
    length = np.sum(base**2, axis=1)[:, None]
    x, y = np.einsum("mij,mj->mi", away, base) / length, np.einsum("mij,mj->mi", away, across) / length
    places = np.stack([x - y, x + y], axis=-1)
    which = np.flatnonzero((np.sum((places - 0.5) ** 2, axis=2) <= 0.5).all(axis=1))
    places, ordered = places[which], np.take_along_axis(quads, order, axis=1)[which]
    swap = places[:, :, 0].sum(axis=1) > 1.0
    places[swap] = 1.0 - places[swap]
    ordered[swap, :2] = ordered[swap, 1::-1]
    turn = places[:, 0, 0] > places[:, 1, 0]
    places[turn] = places[turn, ::-1]
    ordered[turn, 2:] = ordered[turn, 3:1:-1]
    codes: Float = (places.reshape(-1, 4) - CODE_LOW) / CODE_SPAN
    return codes, ordered, which
