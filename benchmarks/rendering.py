"""Speed and accuracy of ray tracing, beside trimesh's own Embree wrapper; prints JSON.

Run with ``OMP_NUM_THREADS=1 python benchmarks/rendering.py``. Speed is the median of several runs on one
thread; trimesh runs once, since it takes half a minute from afar.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from giantlike.camera_models import BrownModel, PinholeModel
from giantlike.core.arrays import Float, unit
from giantlike.core.detector import GaussianPsf
from giantlike.ray_tracing import Body, RenderOptions, Template, render, trace_silhouette
from giantlike.ray_tracing.tracer import MeshTracer, tracer_for
from giantlike.shapes import Ellipsoid, irregular_body, mesh_from_ellipsoid

FACETS = 197_000
DIAMETER_PX = 300.0
RUNS = 5
CAMERA = BrownModel(fx_px=3473.3, fy_px=3473.4, cx_px=1295.5, cy_px=971.5, k1=-0.539, k2=0.4, p1=1e-4, p2=1e-4)
TURN = Rotation.from_euler("xyz", [80.0, 20.0, 30.0], degrees=True)
SUN = unit(np.array([0.8, 0.1, -0.6]))


def median_ms(function: Callable[..., Any], *arguments: Any, **options: Any) -> float:
    times = []
    for _ in range(RUNS):
        start = time.perf_counter()
        function(*arguments, **options)
        times.append(time.perf_counter() - start)
    return round(1e3 * float(np.median(times)), 2)


def centroid(template: Template) -> Float:
    y, x = np.indices(template.brightness.shape)
    light = template.brightness
    return np.asarray(np.array([(x * light).sum(), (y * light).sum()]) / light.sum() + template.corner_px)


def renders() -> dict[str, Any]:
    shape = irregular_body(1, facets=FACETS)
    distance_km = 2.0 * shape.circumscribing_radius_km * CAMERA.fx_px / DIAMETER_PX
    body = Body(shape=shape, camera_from_body=TURN, position_camera_km=distance_km * np.array([0.08, -0.05, 1.0]))

    def rendered(rays: int, shadows: bool = True, seed: int | None = None) -> Template:
        options = RenderOptions(rays_per_pixel_side=rays, shadows=shadows, jitter_seed=seed)
        result = render(
            body, CAMERA, sun_direction_camera=SUN, psf=GaussianPsf(), columns=2592, rows=1944, options=options
        )
        assert isinstance(result, Template)
        return result

    reference = rendered(12)
    table: dict[str, Any] = {
        "facets": len(shape.faces),
        "bvh_ms": median_ms(MeshTracer, shape),
        "template_px": reference.brightness.shape,
    }
    for rays in (2, 3):
        shifts = [centroid(rendered(rays, seed=seed)) - centroid(reference) for seed in (None, 1)]
        table[f"rays_{rays}x{rays}"] = {
            "ms": median_ms(rendered, rays),
            "ms_without_shadows": median_ms(rendered, rays, shadows=False),
            "centroid_shift_px": round(float(np.abs(shifts[0]).max()), 5),
            "centroid_shift_jittered_px": round(float(np.abs(shifts[1]).max()), 5),
        }
    silhouette = median_ms(trace_silhouette, body, CAMERA, np.radians(np.arange(360)), sun_direction_camera=SUN)
    return table | {"silhouette_360_ms": silhouette}


def rays_beside_trimesh() -> dict[str, Any]:
    """Time, and error of the hit points: how far they lie from the ellipsoid that the fine mesh stands for."""
    ellipsoid = Ellipsoid(radii_km=np.array([0.28, 0.2, 0.17]))
    mesh = mesh_from_ellipsoid(ellipsoid, facets=FACETS)
    other = trimesh.Trimesh(mesh.vertices_km, mesh.faces, process=False).ray
    tracer = tracer_for(mesh)
    result: dict[str, Any] = {}
    for distance_km in (10.0, 4e5):
        origin = distance_km * unit(np.array([1.0, 2.0, 3.0]))
        targets = np.random.default_rng(1).uniform(-0.2, 0.2, size=(250_000, 3))
        directions, origins = unit(targets - origin), np.tile(origin, (len(targets), 1))
        exact = tracer_for(ellipsoid).intersect(origin, directions)
        ours = tracer.intersect(origin, directions)
        start = time.perf_counter()
        points, index, _ = other.intersects_location(origins, directions, multiple_hits=False)
        trimesh_ms = round(1e3 * (time.perf_counter() - start), 2)
        theirs = np.full_like(ours.points_km, np.nan)
        theirs[index] = points
        both = exact.hit & ours.hit & np.isfinite(theirs[:, 0])
        off = {
            name: np.linalg.norm(found[both] - exact.points_km[both], axis=1)
            for name, found in {"ours": ours.points_km, "trimesh": theirs}.items()
        }
        result[f"from_{distance_km:g}_km"] = {
            "ms": median_ms(tracer.intersect, origin, directions),
            "trimesh_ms": trimesh_ms,
            "wrong_hits": int(np.count_nonzero(ours.hit != exact.hit)),
            "trimesh_wrong_hits": int(np.count_nonzero(np.isfinite(theirs[:, 0]) != exact.hit)),
            "q90_error_m": float(1e3 * np.quantile(off["ours"], 0.9)),
            "trimesh_q90_error_m": float(1e3 * np.quantile(off["trimesh"], 0.9)),
        }
    return result


def silhouette_error() -> dict[str, float]:
    """Largest distance of silhouette points of a polyhedron to its projected edges, px, at 300 px."""
    mesh = mesh_from_ellipsoid(Ellipsoid(radii_km=np.array([0.28, 0.2, 0.17])), facets=180)
    errors = {}
    for distance_km in (2.0, 4e5):
        focal_px = DIAMETER_PX / 0.56 * distance_km
        model = PinholeModel(fx_px=focal_px, fy_px=focal_px, cx_px=512.0, cy_px=512.0)
        body = Body(shape=mesh, camera_from_body=TURN, position_camera_km=np.array([0.0, 0.0, distance_km]))
        limb = trace_silhouette(body, model, np.radians(np.arange(360)), sun_direction_camera=SUN)
        corners = model.project(body.to_camera(mesh.vertices_km) + body.position_camera_km)
        start, stop = corners[mesh.faces], corners[np.roll(mesh.faces, -1, axis=1)]
        edge = stop - start
        offset = limb.points_px[:, None, None] - start
        along = np.clip(np.sum(offset * edge, axis=-1) / np.sum(edge**2, axis=-1), 0.0, 1.0)
        distance = np.linalg.norm(offset - along[..., None] * edge, axis=-1)
        errors[f"max_px_from_{distance_km:g}_km"] = float(distance.min(axis=(1, 2)).max())
    return errors


if __name__ == "__main__":
    report = {"render": renders(), "rays": rays_beside_trimesh(), "silhouette": silhouette_error()}
    print(json.dumps(report, indent=2))
