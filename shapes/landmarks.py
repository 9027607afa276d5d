"""Landmarks: local maps of points on a body, to be matched with images, and catalogs of them in files."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike._system.atomic import replacing
from giantlike._system.reading import check, reads
from giantlike.core.arrays import Float, frozen, require
from giantlike.core.errors import DataError, InputError
from giantlike.core.values import Value
from giantlike.shapes.files.maplet import read_maplet
from giantlike.shapes.files.npz import archive_arrays
from giantlike.shapes.local_map import LocalMap
from giantlike.shapes.mesh import TriangleMesh

CATALOG_SUFFIX = ".npz"
MAPLET_SUFFIX = ".map"
_FORMAT, _VERSION = "giantlike landmarks", 1


@dataclass(frozen=True, eq=False)
class Landmark(Value):
    """A landmark: a local map around a point on a body."""

    map: LocalMap  # heights, and albedo if it is known; its z axis is the normal of the point
    texture: float  # contrast: rms tilt, rad, about a uniform curvature, and rms relative albedo, in quadrature

    def __post_init__(self) -> None:
        require(0.0 <= self.texture < math.inf, f"texture must be >= 0 and finite, got {self.texture}")
        Value.__post_init__(self)

    @property
    def name(self) -> str:
        """Name of the map."""
        return self.map.name

    @cached_property
    def point_body_km(self) -> Float:
        """Position of the landmark (3,), km, body axes: over the middle of the map, at its mean height."""
        return frozen(self.map.to_body(np.array([0.0, 0.0, float(np.nanmean(self.map.heights_km))])))

    @cached_property
    def normal_body(self) -> Float:
        """Unit normal (3,) of the map, body axes."""
        return frozen(self.map.body_from_map.as_matrix()[:, 2].copy())

    @cached_property
    def mesh(self) -> TriangleMesh:
        """Map as an open surface in body axes: always the same object, whose tracer is cached."""
        return self.map.mesh()

    @property
    def size_km(self) -> float:
        """Length of the shorter side, km."""
        return 2.0 * min(self.map.half_extent_km)

    def grid_body_km(self, count: int) -> Float:
        """Points of the surface, spread over the map. Returns (k, 3), body axes."""
        rows, columns = (
            np.unique(np.linspace(0, n - 1, min(count, n)).round().astype(np.int64)) for n in self.map.heights_km.shape
        )
        heights = self.map.heights_km[np.ix_(rows, columns)]
        half_x, half_y = self.map.half_extent_km
        x, y = np.meshgrid(columns * self.map.spacing_km - half_x, rows * self.map.spacing_km - half_y)
        points = np.stack([x, y, heights], axis=-1).reshape(-1, 3)
        return self.map.to_body(points[np.isfinite(points[:, 2])])


@dataclass(frozen=True, eq=False)
class LandmarkCatalog(Value):
    """Landmarks of one body."""

    landmarks: tuple[Landmark, ...]
    body_name: str = ""  # name of the body; empty where it is not known
    shape_sha256: str = ""  # hash of the shape that they were taken from; empty for maps from elsewhere

    def __post_init__(self) -> None:
        object.__setattr__(self, "landmarks", tuple(self.landmarks))
        names = [landmark.name for landmark in self.landmarks]
        require(len(names) > 0, "a catalog needs at least one landmark")
        require(len(set(names)) == len(names), "two landmarks of a catalog have one name")
        Value.__post_init__(self)

    def __len__(self) -> int:
        return len(self.landmarks)

    @cached_property
    def sha256(self) -> str:
        """Hash of all maps, hexadecimal."""
        total = hashlib.sha256()
        for landmark in self.landmarks:
            local = landmark.map
            total.update(f"{local.name} {local.spacing_km!r}".encode())
            for array in (local.center_body_km, local.body_from_map.as_matrix(), local.heights_km, local.albedo):
                total.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
        return total.hexdigest()


def load_landmarks(path: Path) -> LandmarkCatalog:
    """Read a catalog of landmarks."""
    path = Path(path)
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() == MAPLET_SUFFIX)
        if not files:
            raise DataError(path, "the folder holds no maplet (.MAP)")
        return LandmarkCatalog(tuple(landmark_of(read_maplet(file)) for file in files))
    if path.suffix.lower() == MAPLET_SUFFIX:
        return LandmarkCatalog((landmark_of(read_maplet(path)),))
    if path.suffix.lower() != CATALOG_SUFFIX:
        raise InputError(f"{path}: landmarks are a {CATALOG_SUFFIX} catalog, a .MAP file or a folder of them")
    return _read_catalog(path)


def save_landmarks(catalog: LandmarkCatalog, path: Path, *, overwrite: bool = False) -> None:
    """Write a catalog of landmarks.

    A compressed numpy archive without pickle: ``format``, ``version``, ``body_name`` and ``shape_sha256``; for n
    landmarks ``names``, ``centers_body_km`` (n, 3), ``body_from_map`` (n, 4; quaternions, scalar last), ``spacing_km``
    (n,), ``texture`` (n,), ``shapes`` (n, 2; rows and columns of the maps), all maps one after the other in
    ``heights_km`` (float32, NaN where there is none) and, for those with ``has_albedo`` (n,), in ``albedo``.
    """
    require(path.suffix.lower() == CATALOG_SUFFIX, f"{path}: a catalog of landmarks ends in {CATALOG_SUFFIX}")
    if path.exists() and not overwrite:
        raise InputError(f"{path} exists; give --overwrite to replace it")
    maps = [landmark.map for landmark in catalog.landmarks]
    painted = [local.albedo for local in maps if local.albedo is not None]
    arrays: dict[str, NDArray[Any]] = {
        "body_name": np.array(catalog.body_name),
        "shape_sha256": np.array(catalog.shape_sha256),
        "names": np.array([local.name for local in maps]),
        "centers_body_km": np.stack([local.center_body_km for local in maps]),
        "body_from_map": np.stack([local.body_from_map.as_quat() for local in maps]),
        "spacing_km": np.array([local.spacing_km for local in maps]),
        "texture": np.array([landmark.texture for landmark in catalog.landmarks]),
        "shapes": np.array([local.heights_km.shape for local in maps]),
        "heights_km": np.concatenate([local.heights_km.ravel() for local in maps]).astype(np.float32),
        "has_albedo": np.array([local.albedo is not None for local in maps]),
        "albedo": np.concatenate([np.zeros(0), *[albedo.ravel() for albedo in painted]]).astype(np.float32),
    }
    with replacing(path) as part, part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, format=_FORMAT, version=_VERSION, **arrays)


def landmark_of(local: LocalMap) -> Landmark:
    """Make a landmark of a map and measure its texture."""
    tilts = np.arctan(np.stack([np.gradient(local.heights_km, local.spacing_km, axis=axis) for axis in (0, 1)]))
    known = np.isfinite(tilts).all(axis=0)
    rows, columns = np.nonzero(known)
    bend = np.column_stack([np.ones(rows.size), rows, columns])  # uniform curvature: nothing to match
    residual = tilts[:, known].T - bend @ np.linalg.lstsq(bend, tilts[:, known].T, rcond=None)[0]
    roughness = float(np.sum(residual**2)) / max(rows.size, 1)
    contrast = 0.0
    if local.albedo is not None and float(local.albedo.mean()) > 0.0:
        contrast = float(np.var(local.albedo[np.isfinite(local.heights_km)]) / np.mean(local.albedo) ** 2)
    return Landmark(local, math.sqrt(roughness + contrast))


@reads("a catalog of landmarks")
def _read_catalog(path: Path) -> LandmarkCatalog:
    archive = archive_arrays(path, _FORMAT, _VERSION)
    check(archive["shapes"].dtype.kind in "iu", f"shapes must be whole numbers, got {archive['shapes'].dtype}")
    shapes: NDArray[np.int64] = archive["shapes"].astype(np.int64)
    sizes, painted = np.prod(shapes, axis=1), archive["has_albedo"].astype(bool)
    with np.errstate(invalid="ignore"):  # a damaged file may hold signaling NaN
        all_heights, all_albedo = archive["heights_km"].astype(np.float64), archive["albedo"].astype(np.float64)
    heights = np.split(all_heights, np.cumsum(sizes)[:-1])
    albedo = iter(np.split(all_albedo, np.cumsum(sizes[painted])[:-1]))
    landmarks = []
    for k, name in enumerate(archive["names"].tolist()):
        local = LocalMap(
            center_body_km=archive["centers_body_km"][k],
            body_from_map=Rotation.from_quat(archive["body_from_map"][k]),
            heights_km=heights[k].reshape(shapes[k]),
            spacing_km=float(archive["spacing_km"][k]),
            albedo=next(albedo).reshape(shapes[k]) if painted[k] else None,
            name=str(name),
        )
        landmarks.append(Landmark(local, float(archive["texture"][k])))
    return LandmarkCatalog(tuple(landmarks), str(archive["body_name"]), str(archive["shape_sha256"]))
