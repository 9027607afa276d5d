"""Outlines and hit points at every range, and what they cost; prints JSON.

Run with ``OMP_NUM_THREADS=1 python benchmarks/outlines.py``. The outline of a convex mesh is held against the
convex hull of its projected vertices, the hit points of an ellipsoid against its equation.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from giantlike.camera_models import PinholeModel
from giantlike.ray_tracing import Body, trace_silhouette
from giantlike.ray_tracing.tracer import tracer_for
from giantlike.shapes import Ellipsoid, TriangleMesh, limb, mesh_from_ellipsoid

RUNS = 5
RANGES_RADII = [2.0, 10.0, 1e3, 1e6]
DIAMETER_PX = 2000.0
ELLIPSOID = Ellipsoid(radii_km=np.array([1.0, 0.7, 0.6]))
TURN = Rotation.from_euler("xyz", [80.0, 20.0, 30.0], degrees=True)
CIRCLE = np.linspace(0.0, 2.0 * np.pi, 360, endpoint=False)
SUN = [0.0, 0.0, -1.0]


def cpu_ms(function: Callable[..., Any], *arguments: Any, **options: Any) -> float:
    times = []
    for _ in range(RUNS):
        start = time.process_time()
        function(*arguments, **options)
        times.append(time.process_time() - start)
    return round(1e3 * float(np.median(times)), 2)


def view(shape: Ellipsoid | TriangleMesh, range_km: float) -> tuple[Body, PinholeModel]:
    focal_px = 0.5 * DIAMETER_PX * range_km
    body = Body(shape=shape, camera_from_body=TURN, position_camera_km=range_km * np.array([1e-3, 2e-3, 1.0]))
    return body, PinholeModel(fx_px=focal_px, fy_px=focal_px, cx_px=1000.0, cy_px=900.0)


def accuracy(mesh: TriangleMesh, range_km: float) -> dict[str, float]:
    body, model = view(mesh, range_km)
    found = trace_silhouette(body, model, CIRCLE, sun_direction_camera=SUN)
    smooth = trace_silhouette(*view(ELLIPSOID, range_km), CIRCLE, sun_direction_camera=SUN)
    corners = model.project(body.to_camera(mesh.vertices_km) + body.position_camera_km)
    hull = ConvexHull(corners - found.center_px).equations
    heights = ((found.points_px - found.center_px) @ hull[:, :2].T + hull[:, 2]).max(axis=1)
    camera = range_km * np.array([0.48, -0.6, 0.64])
    rays = np.random.default_rng(1).uniform(-0.6, 0.6, size=(200_000, 3)) - camera
    hits, flat = (tracer_for(shape).intersect(camera, rays) for shape in (ELLIPSOID, mesh))
    equation = np.sum((hits.points_km[hits.hit] / ELLIPSOID.radii_km) ** 2, axis=1) - 1.0
    facets = flat.facets[flat.hit]
    offsets = flat.points_km[flat.hit] - mesh.vertices_km[mesh.faces[facets, 0]]
    weights = mesh.barycentric(flat.points_km[flat.hit], facets)
    return {
        "range_radii": range_km,
        "mesh_outline_off_hull_px": float(np.abs(heights).max()),
        "ellipsoid_minus_mesh_outline_px": float(np.abs(found.points_px - smooth.points_px).max()),
        "ellipsoid_hit_off_surface_of_range": float(np.abs(equation).max() / range_km),
        "mesh_hit_off_facet_plane_of_range": float(
            np.abs(np.einsum("ij,ij->i", offsets, mesh.normals[facets])).max() / range_km
        ),
        "mesh_hits_beside_their_facet": float(np.mean(weights.min(axis=1) < -1e-9)),
    }


def cost(facets: int) -> dict[str, float]:
    mesh = mesh_from_ellipsoid(ELLIPSOID, facets=facets)
    body, model = view(mesh, 10.0)
    directions = np.random.default_rng(1).normal(size=(360, 3))
    start = time.process_time()
    trace_silhouette(body, model, CIRCLE, sun_direction_camera=SUN)
    first_ms = 1e3 * (time.process_time() - start)
    return {
        "facets": len(mesh.faces),
        "first_silhouette_with_bvh_ms": round(first_ms, 1),
        "silhouette_360_ms": cpu_ms(trace_silhouette, body, model, CIRCLE, sun_direction_camera=SUN),
        "limb_with_derivatives_360_ms": cpu_ms(limb, mesh, body.camera_body_km, directions),
    }


def main() -> None:
    mesh = mesh_from_ellipsoid(ELLIPSOID, facets=197_000)
    print(
        json.dumps(
            {
                "diameter_px": DIAMETER_PX,
                "accuracy": [accuracy(mesh, range_km) for range_km in RANGES_RADII],
                "ellipsoid_silhouette_360_ms": cpu_ms(
                    trace_silhouette, *view(ELLIPSOID, 10.0), CIRCLE, sun_direction_camera=SUN
                ),
                "cost": [cost(facets) for facets in (49_000, 197_000, 3_100_000)],
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
