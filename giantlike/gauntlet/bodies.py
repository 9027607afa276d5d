"""Bodies of the gauntlet: rocks with the mesh of the same figure, laws by both names, a shadow on a body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.independent import Body, EllipsoidBody, ReliefBody, SphereField, bumps, craters
from giantlike.independent.bodies import RayHits
from giantlike.ray_tracing import Hapke, Lambert, LommelSeeliger, McEwen, Minnaert, Reflectance
from giantlike.shapes import Ellipsoid, Shape, TriangleMesh

ROCKS = 4  # rocks to choose from: each costs a process 0.5 s, once
_TABLE_CELLS = 256  # cells of the tables of relief, 0.6 degrees each: a tenth of the smallest crater
_MESH_CELLS = 96  # of the meshes along 90 degrees: facets deviate by 7e-5 of the radius, 0.005 px at 150 px

TOLD_LAWS: Mapping[str, Reflectance] = MappingProxyType(
    {
        "mcewen": McEwen(),
        "lambert": Lambert(),
        "lommel_seeliger": LommelSeeliger(),
        "minnaert": Minnaert(k=0.7),
        "hapke": Hapke(w=0.21, b0=1.0, h=0.06, theta_bar_deg=0.0, hg1=-0.3, hg2=0.0),
    }
)
"""Laws of the package by the names of :data:`giantlike.independent.LAWS`, with the same parameters."""


@lru_cache(maxsize=16)
def markings(number: int, rms: float) -> SphereField:
    """Return relative albedo minus one, a different map for each number."""
    return bumps(7000 + number, rms=rms, widths_deg=(6.0, 25.0), count=40, cells=_TABLE_CELLS)


@lru_cache(maxsize=16)
def relief(number: int, rms: float) -> SphereField:
    """Return heights that are not in the shape model, as a fraction of the radius, different for each number."""
    return bumps(8000 + number, rms=rms, widths_deg=(8.0, 30.0), count=40, cells=_TABLE_CELLS)


@lru_cache(maxsize=ROCKS)
def _rock(number: int) -> tuple[SphereField, NDArray[np.float64], TriangleMesh]:
    """Heights, half axes in km and mesh of a rock."""
    heights = bumps(9000 + number, rms=0.03, widths_deg=(12.0, 40.0), count=30, cells=_TABLE_CELLS)
    heights += craters(9100 + number, depth=0.12, count=50, radii_deg=(7.0, 25.0), cells=_TABLE_CELLS)
    rng = np.random.default_rng([9200, number])
    radii = 10.0 * np.array([1.0, rng.uniform(0.7, 1.0), rng.uniform(0.65, 0.9)])
    mesh = TriangleMesh(*ReliefBody(radii, heights).mesh(_MESH_CELLS), f"rock {number}")
    return heights, radii, mesh


def rock(number: int, extra: SphereField | None = None) -> tuple[ReliefBody, TriangleMesh]:
    """Return a rock and the mesh that is known of it."""
    heights, radii, mesh = _rock(number % ROCKS)
    return ReliefBody(radii, heights if extra is None else heights + extra), mesh


def ellipsoid(radii_km: Float, albedo: SphereField | None = None) -> tuple[EllipsoidBody, Ellipsoid]:
    """Return the rendered ellipsoid and the assumed one."""
    return EllipsoidBody(radii_km, albedo), Ellipsoid(radii_km=np.array(radii_km, dtype=float))


def scale_shape(shape: Shape, factor: float) -> Shape:
    """Return a shape with all lengths times a factor."""
    if isinstance(shape, Ellipsoid):
        return Ellipsoid(radii_km=shape.radii_km * factor)
    assert isinstance(shape, TriangleMesh)
    return TriangleMesh(shape.vertices_km * factor, shape.faces, f"{shape.name} x {factor:g}")


@dataclass(frozen=True, eq=False)
class EclipsedBody(Value):
    """A body with the round shadow of another one on it."""

    body: Body
    sun: Float  # body-fixed; unit vector to the Sun
    through_km: Float  # body-fixed; a point on the axis of the shadow
    radius_km: float  # of the shadow
    penumbra_km: float  # length over which light falls off

    @property
    def bounding_radius_km(self) -> float:
        """Radius of a sphere that holds the body, km."""
        return self.body.bounding_radius_km

    def intersect(self, origin_km: Float, directions: Float) -> RayHits:
        """Meet rays (n, 3) from one origin (3,), body-fixed, km."""
        return self.body.intersect(origin_km, directions)

    def shadowed(self, points_km: Float, sun: Float) -> NDArray[np.bool_]:
        """Tell the points (m, 3) from which the body itself hides the Sun."""
        return self.body.shadowed(points_km, sun)

    def albedo_at(self, points_km: Float) -> Float | None:
        """Relative albedo (m,) times the visible fraction of the Sun."""
        away = points_km - self.through_km
        distance = np.linalg.norm(away - (away @ self.sun)[:, None] * self.sun, axis=1)
        light = np.clip((distance - self.radius_km) / self.penumbra_km, 0.0, 1.0)
        albedo = self.body.albedo_at(points_km)
        return np.asarray(light if albedo is None else light * albedo, dtype=float)
