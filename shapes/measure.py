"""Size, volume, center, axes and moments of inertia of a mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.shapes.defects import edges_of
from giantlike.shapes.mesh import TriangleMesh


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measures(Value):
    """Size, volume and moments of a mesh, body axes, uniform density."""

    facets: int  # facets, vertices: numbers of them; vertices count only where a facet uses them
    vertices: int
    extents_km: Float  # size along body x, y and z
    volume_km3: float
    area_km2: float
    center_of_figure_km: Float  # in body axes
    principal_axes: Float  # (3, 3), body axes; unit vectors as rows, right-handed, smallest moment first
    principal_moments: Float  # (3,) km^5; about the center of figure for a density of 1
    best_fit_radii_km: Float  # of the ellipsoid of the same moments and center, longest first
    circumscribing_radius_km: float  # circumscribing_..., mean_radius_km: from the origin; by volume
    mean_radius_km: float
    euler_number: int  # vertices minus edges plus facets: 2 for one closed surface without handles


def measure_mesh(mesh: TriangleMesh) -> Measures:
    """Measure a mesh.

    A uniform ellipsoid of radii a, b, c has the central second moments a^2 / 5, b^2 / 5, c^2 / 5 per volume, so that
    its moment of inertia about a is V (b^2 + c^2) / 5; the best-fit ellipsoid has the moments of the mesh.
    """
    placed = mesh.best_fit_ellipsoid
    squares = placed.ellipsoid.radii_km**2
    used = np.unique(mesh.faces)
    return Measures(
        facets=len(mesh.faces),
        vertices=used.size,
        extents_km=np.ptp(mesh.vertices_km[used], axis=0),
        volume_km3=mesh.volume_km3,
        area_km2=mesh.area_km2,
        center_of_figure_km=placed.center_body_km,
        principal_axes=placed.body_from_axes.as_matrix().T,
        principal_moments=mesh.volume_km3 / 5.0 * (squares.sum() - squares),
        best_fit_radii_km=placed.ellipsoid.radii_km,
        circumscribing_radius_km=mesh.circumscribing_radius_km,
        mean_radius_km=mesh.mean_radius_km,
        euler_number=used.size - len(edges_of(mesh.faces).ends) + len(mesh.faces),
    )
