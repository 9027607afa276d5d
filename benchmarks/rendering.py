"""Speed and accuracy of rendering, beside bare calls of embreex and trimesh's own Embree wrapper; prints JSON.

Run with ``OMP_NUM_THREADS=1 python benchmarks/rendering.py``; it takes two minutes and 1.5 GB, most of them for a mesh
of three million facets. Times are the least of several runs: CPU time, and wall time where it says so. ``bare`` repeats
the calls of embreex that a render makes, with the same rays, and nothing else. trimesh runs once, since it takes
seconds from afar.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from giantlike.camera_models import BrownModel, PinholeModel
from giantlike.core.arrays import Float, unit
from giantlike.core.detector import GaussianPsf
from giantlike.ray_tracing import Body, Lambert, RenderOptions, Template, render, trace_silhouette
from giantlike.ray_tracing.cached_trace import Trace, trace_body
from giantlike.ray_tracing.tracer import MeshTracer, tracer_for
from giantlike.shapes import Ellipsoid, TriangleMesh, irregular_body, load_shape, mesh_from_ellipsoid, save_shape

FACETS = 197_000
MANY_FACETS = 3_100_000
DIAMETER_PX = 300.0
RUNS = 8
RADII_AWAY = (2.0, 10.0, 1e3, 1e6)
CAMERA = BrownModel(fx_px=3473.3, fy_px=3473.4, cx_px=1295.5, cy_px=971.5, k1=-0.539, k2=0.4, p1=1e-4, p2=1e-4)
COLUMNS, ROWS = 2592, 1944
TURN = Rotation.from_euler("xyz", [80.0, 20.0, 30.0], degrees=True)
SUN = unit(np.array([0.8, 0.1, -0.6]))
ELLIPSOID = Ellipsoid(radii_km=np.array([0.28, 0.2, 0.17]))

Timed = dict[str, Callable[[], Any]]


def least_ms(functions: Timed, *, wall: bool = False, runs: int = RUNS) -> dict[str, float]:
    """Least time of each function, all of them in turn, so that a busy machine slows them alike."""
    clock = time.perf_counter if wall else time.process_time
    least = dict.fromkeys(functions, np.inf)
    for _ in range(runs):
        for name, function in functions.items():
            start = clock()
            function()
            least[name] = min(least[name], clock() - start)
    return {name: round(1e3 * seconds, 2) for name, seconds in least.items()}


def body_of(shape: TriangleMesh, diameter_px: float = DIAMETER_PX) -> Body:
    distance_km = 2.0 * shape.circumscribing_radius_km * CAMERA.fx_px / diameter_px
    return Body(shape=shape, camera_from_body=TURN, position_camera_km=distance_km * np.array([0.08, -0.05, 1.0]))


def rendered(body: Body, **options: Any) -> Template:
    psf, settings = GaussianPsf(), RenderOptions(**options)
    result = render(body, CAMERA, sun_direction_camera=SUN, psf=psf, columns=COLUMNS, rows=ROWS, options=settings)
    assert isinstance(result, Template)
    return result


def traced(body: Body) -> Trace:
    result = trace_body(body, CAMERA, sun_direction_camera=SUN, psf=GaussianPsf(), columns=COLUMNS, rows=ROWS)
    assert isinstance(result, Trace)
    return result


def bare_calls(body: Body, **options: Any) -> tuple[int, Callable[[], None]]:
    """How many rays a render casts, and a function that casts the same rays by embreex alone."""
    surface = body.tracer._surface  # type: ignore[union-attr]
    run, calls = surface._run, []

    def recorded(origins: Any, directions: Any, **query: Any) -> Any:
        calls.append((np.ascontiguousarray(origins), np.ascontiguousarray(directions), query))
        return run(origins, directions, **query)

    surface._run = recorded
    rendered(body, **options)
    surface._run = run

    def again() -> None:
        for origins, directions, query in calls:
            run(origins, directions, **query)

    return sum(len(call[0]) for call in calls), again


def whole_template(shape: TriangleMesh) -> dict[str, Any]:
    """A template beside the bare calls, on one thread and on two; and what parts of it cost when a trace is cached."""
    body = body_of(shape)
    rays, bare = bare_calls(body)
    cached, other_sun = traced(body), unit(np.array([0.5, 0.3, -0.8]))
    one: Timed = {
        "bare_embreex": bare,
        "trace": lambda: traced(body),
        "template": lambda: rendered(body),
        "template_9_rays_per_pixel": lambda: rendered(body, rays_per_pixel_side=3),
        "cached_trace_other_law": lambda: cached.with_reflectance(Lambert()).template(),
        "cached_trace_other_sun": lambda: cached.with_sun(other_sun).template(),
        "silhouette_360": lambda: trace_silhouette(body, CAMERA, np.radians(np.arange(360)), sun_direction_camera=SUN),
    }
    cpu_ms = least_ms(one)
    wall: Timed = {
        "bare_embreex": bare,
        "template_1_thread": lambda: rendered(body),
        "template_2_threads": lambda: rendered(body, threads=2),
    }
    return {
        "facets": len(shape.faces),
        "template_px": rendered(body).brightness.shape,
        "rays": rays,
        "cpu_ms": cpu_ms,
        "wall_ms": least_ms(wall, wall=True),
        "bare_mray_per_s": round(rays / cpu_ms["bare_embreex"] / 1e3, 2),
        "trace_over_bare_rays_per_s": round(cpu_ms["bare_embreex"] / cpu_ms["trace"], 3),
        "template_over_bare_cpu": round(cpu_ms["template"] / cpu_ms["bare_embreex"], 3),
        "bvh_ms": least_ms({"bvh": lambda: MeshTracer(shape)}, runs=2)["bvh"],
    } | sampling_errors(body)


def sampling_errors(body: Body) -> dict[str, float]:
    """Shift of the brightness centroid, px, of coarser and of jittered rays against 12 x 12 to a pixel."""
    reference = centroid(rendered(body, rays_per_pixel_side=12))
    shifts = {}
    for rays in (2, 3):
        for name, seed in (("", None), ("_jittered", 1)):
            found = centroid(rendered(body, rays_per_pixel_side=rays, jitter_seed=seed))
            shifts[f"centroid_shift_px_{rays}x{rays}{name}"] = round(float(np.abs(found - reference).max()), 5)
    return shifts


def centroid(template: Template) -> Float:
    y, x = np.indices(template.brightness.shape)
    light = template.brightness
    return np.asarray(np.array([(x * light).sum(), (y * light).sum()]) / light.sum() + template.corner_px)


def scaling(shape: TriangleMesh) -> dict[str, Any]:
    """CPU time by size in the image, for one mesh, and by number of facets, at one size."""
    sizes: Timed = {f"{px} px": lambda px=px: rendered(body_of(shape, px)) for px in (75.0, 150.0, 300.0, 600.0)}  # type: ignore[misc]
    lit = {
        f"{px} px": rendered(body_of(shape, px)).coverage.sum() * rendered(body_of(shape, px)).lit_fraction
        for px in (75.0, 150.0, 300.0, 600.0)
    }
    by_size_ms = least_ms(sizes, runs=4)
    bodies = [body_of(irregular_body(1, facets=facets)) for facets in (49_000, FACETS)]
    facets_ms = least_ms({str(len(b.shape.faces)): lambda b=b: rendered(b) for b in bodies})  # type: ignore[misc,attr-defined]
    return {
        "cpu_ms_by_diameter": by_size_ms,
        "us_per_lit_pixel": {name: round(1e3 * by_size_ms[name] / float(lit[name]), 2) for name in lit},
        "cpu_ms_by_facets": facets_ms,
    }


def many_facets() -> dict[str, Any]:
    """A mesh of three million facets in a process of its own: loaded from a file and rendered."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "many.npz"
        save_shape(irregular_body(1, facets=MANY_FACETS), path)
        done = subprocess.run([sys.executable, __file__, str(path)], capture_output=True, text=True, check=True)
        result: dict[str, Any] = json.loads(done.stdout)
        return result


def load_and_render(path: Path) -> dict[str, Any]:
    import resource

    start = time.process_time()
    shape = load_shape(path)
    load_s = time.process_time() - start
    assert isinstance(shape, TriangleMesh)
    body = body_of(shape)
    start = time.process_time()
    rendered(body)
    first_s = time.process_time() - start
    peak_mb = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)  # before the rays are recorded
    few = body_of(irregular_body(1, facets=49_000))
    rays, bare = bare_calls(body)
    times_ms = least_ms({"few": lambda: rendered(few), "many": lambda: rendered(body), "bare": bare}, runs=4)
    return {
        "facets": len(shape.faces),
        "load_cpu_s": round(load_s, 2),
        "first_render_with_bvh_cpu_s": round(first_s, 2),
        "cpu_ms": times_ms["many"],
        "bare_mray_per_s": round(rays / times_ms["bare"] / 1e3, 2),
        "over_49k_facets": round(times_ms["many"] / times_ms["few"], 2),
        "peak_rss_mb": peak_mb,
    }


def rays_beside_trimesh() -> dict[str, Any]:
    """Time, and error of the hit points: how far they lie from the ellipsoid that the fine mesh stands for."""
    mesh = mesh_from_ellipsoid(ELLIPSOID, facets=FACETS)
    other = trimesh.Trimesh(mesh.vertices_km, mesh.faces, process=False).ray
    tracer = tracer_for(mesh)
    result: dict[str, Any] = {}
    for distance_km in (10.0, 4e5):
        origin = distance_km * unit(np.array([1.0, 2.0, 3.0]))
        targets = np.random.default_rng(1).uniform(-0.2, 0.2, size=(40_000, 3))
        directions, origins = unit(targets - origin), np.tile(origin, (len(targets), 1))
        exact = tracer_for(ELLIPSOID).intersect(origin, directions)
        ours = tracer.intersect(origin, directions)
        start = time.process_time()
        points, index, _ = other.intersects_location(origins, directions, multiple_hits=False)
        trimesh_ms = round(1e3 * (time.process_time() - start), 2)
        theirs = np.full_like(ours.points_km, np.nan)
        theirs[index] = points
        both = exact.hit & ours.hit & np.isfinite(theirs[:, 0])
        off = {
            name: np.linalg.norm(found[both] - exact.points_km[both], axis=1)
            for name, found in {"ours": ours.points_km, "trimesh": theirs}.items()
        }
        cast: Timed = {"ms": lambda origin=origin, rays=directions: tracer.intersect(origin, rays)}  # type: ignore[misc]
        result[f"from_{distance_km:g}_km"] = least_ms(cast, runs=5) | {
            "trimesh_ms": trimesh_ms,
            "wrong_hits": int(np.count_nonzero(ours.hit != exact.hit)),
            "trimesh_wrong_hits": int(np.count_nonzero(np.isfinite(theirs[:, 0]) != exact.hit)),
            "q90_error_m": float(1e3 * np.quantile(off["ours"], 0.9)),
            "trimesh_q90_error_m": float(1e3 * np.quantile(off["trimesh"], 0.9)),
        }
    return result


def precision() -> dict[str, Any]:
    """How near to the outline of a polyhedron rays still tell hit from miss, and how far hit points are off."""
    mesh = mesh_from_ellipsoid(ELLIPSOID, facets=180)
    radius_km = mesh.circumscribing_radius_km
    result: dict[str, Any] = {}
    for radii in RADII_AWAY:
        focal_px = 0.5 * DIAMETER_PX * radii
        model = PinholeModel(fx_px=focal_px, fy_px=focal_px, cx_px=512.0, cy_px=512.0)
        position = radii * radius_km * np.array([1e-3, 2e-3, 1.0])
        body = Body(shape=mesh, camera_from_body=TURN, position_camera_km=position)
        outline, normals = edges_px(model.project(body.to_camera(mesh.vertices_km) + position))
        surest_px = np.inf
        for offset_px in np.geomspace(1e-3, 1e-6, 31):
            inside, outside = (
                body.tracer.is_occluded(body.camera_body_km, body.to_body(model.unproject(outline + side * normals)))
                for side in (-offset_px, offset_px)
            )
            if not inside.all() or outside.any():
                break
            surest_px = float(offset_px)
        rays = body.to_body(model.unproject(outline - 0.5 * normals))
        hits = body.tracer.intersect(body.camera_body_km, rays)
        planes = np.einsum("ij,ij->i", hits.normals, hits.points_km - mesh.vertices_km[mesh.faces[hits.facets, 0]])
        aside = np.linalg.norm(np.cross(hits.points_km - body.camera_body_km, rays), axis=1)
        result[f"{radii:g}_radii"] = {
            "hit_or_miss_sure_from_px": round(surest_px, 7),
            "hit_point_off_over_range": float(max(np.abs(planes).max(), aside.max()) / (radii * radius_km)),
        }
    return result | {"false_shadows_in_1e6_rays": false_shadows()}


def edges_px(corners_px: Float) -> tuple[Float, Float]:
    """Points (n, 2) on the hull of projected corners, and outward normals (n, 2) there."""
    hull = ConvexHull(corners_px)
    along = np.linspace(0.02, 0.98, 400)[None, :, None]
    ends = corners_px[hull.simplices]
    points = (1.0 - along) * ends[:, None, 0] + along * ends[:, None, 1]
    return points.reshape(-1, 2), np.broadcast_to(hull.equations[:, None, :2], points.shape).reshape(-1, 2)


def false_shadows() -> int:
    """How many of a million hits on a convex body are taken to lie in its own shadow though they face the Sun."""
    mesh = mesh_from_ellipsoid(ELLIPSOID, facets=FACETS)
    origin = np.array([3.0, 2.0, -250_000.0])
    targets = ELLIPSOID.radii_km * unit(np.random.default_rng(3).normal(size=(1_000_000, 3)))
    hits = tracer_for(mesh).intersect(origin, targets - origin)
    facing = hits.normals @ SUN > 0.0
    return int(np.count_nonzero(tracer_for(mesh).is_shadowed(hits, SUN) & facing))


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(load_and_render(Path(sys.argv[1]))))
    else:
        body_shape = irregular_body(1, facets=FACETS)
        parts: Timed = {
            "template": lambda: whole_template(body_shape),
            "scaling": lambda: scaling(body_shape),
            "precision": precision,
            "rays": rays_beside_trimesh,
            "many_facets": many_facets,
        }
        for part, measure in parts.items():
            print(json.dumps({part: measure()}, indent=2), flush=True)
