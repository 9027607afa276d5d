"""Jobs of ``speed.py`` that trace rays: estimators on bodies with craters in frames of 1024 x 1024 px.

Truth is ``giantlike.independent``; views and draws are those of ``stress_truth.py``. ``growth`` goes over the facets of
a mesh, with rays by ``trimesh`` beside, and over the size of the body.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from speed import IMAGES, Job, Outcome, least_cpu_ms, measured
from stress import judged
from stress_truth import Case, Draw, Seen, draw_of, view_of

from giantlike.core.arrays import unit
from giantlike.core.outcomes import CenterFix, Failure, PositionFix
from giantlike.ray_tracing.tracer import tracer_for
from giantlike.relative import ESTIMATORS
from giantlike.relative.inputs import EstimatorInputs, gather
from giantlike.relative.verification import verify
from giantlike.shapes import TriangleMesh

ROCK = Case(
    name="speed", body="rock", frame_px=1024, mesh_cells=128, diameter_px=300.0, phases_deg=(20.0, 60.0, 90.0, 120.0)
)
"""196,608 facets."""
FEW_FACETS, MANY_FACETS = 64, 508
"""Cells along the side of a cube: 49,152 and 3,096,768 facets."""
ONE_MESH: dict[str, Any] = {"warm": (0,), "numbers": (3, 6, 9)}
"""Views of one of the three meshes, which the first makes warm."""
GROWING_CELLS = (20, FEW_FACETS, 128, 256, MANY_FACETS)
"""4,800, 49,152, 196,608, 786,432 and 3,096,768 facets."""
GROWING_PX = (10.0, 30.0, 100.0, 300.0, 1000.0, 1600.0)
GROWING = {
    "rock": ("cross_correlation", "limb_matching", "moment"),
    "ellipsoid": ("ellipsoid_cra", "sigmoid_limb", "ellipse_fit"),
}
OTHER_RAYS = 80_000
"""Camera rays of a template of 300 px."""


def fresh(case: Case) -> Callable[[int], Draw]:
    """Draws of the views of a case, whose images are kept where a folder is named."""
    return lambda number: draw_of(_seen(case, number), 0)


def _seen(case: Case, number: int) -> Seen:
    folder = os.environ.get(IMAGES)
    if folder is None:
        return view_of(case, number)
    phase_deg = case.phases_deg[number % len(case.phases_deg)]
    body = case.body if case.body == "ellipsoid" else f"{case.body}{case.mesh_cells}"
    path = Path(folder) / f"{body}-{case.law}-{case.diameter_px:g}-{phase_deg:g}-{case.frame_px}-{number}.npy"
    if path.exists():
        return view_of(case, number, np.load(path))
    seen = view_of(case, number)
    np.save(path, seen.signal_dn)
    return seen


def estimated(name: str) -> Callable[[Draw], CenterFix | PositionFix | Failure]:
    """Run an estimator with its defaults."""
    return lambda draw: ESTIMATORS[name]().estimate(draw.image, draw.seen.camera, draw.scene)


def judge(draw: Draw, fix: CenterFix | PositionFix | Failure) -> Outcome | str:
    """Error of the center per axis, its sigma, and the squared error over the covariance."""
    answer = judged(draw, fix)
    if isinstance(fix, Failure):
        return answer.status
    return Outcome(error=answer.error_px, sigma=answer.sigma_px, nees_over_dof=answer.nees)


@dataclass(frozen=True, kw_only=True)
class Found:
    """A fix before it is verified, and what it was made of."""

    draw: Draw
    inputs: EstimatorInputs
    fix: Any


def found(number: int) -> Found:
    """An unverified fix of cross_correlation."""
    draw = fresh(ROCK)(number)
    estimator = ESTIMATORS["cross_correlation"]()
    inputs = gather(draw.image, draw.seen.camera, draw.scene, None, estimator=estimator.name, options=estimator.options)
    assert not isinstance(inputs, Failure)
    return Found(draw=draw, inputs=inputs, fix=estimator._estimate(inputs))


def jobs() -> list[Job]:
    """The rows of bodies."""

    def of(name: str, job: str, goal_u: float | None, case: Case, **more: Any) -> Job:
        return Job(name=f"{name}, {job}", goal_u=goal_u, fresh=fresh(case), run=estimated(name), judge=judge, **more)

    large = replace(ROCK, diameter_px=1000.0)
    few, many = (replace(ROCK, mesh_cells=cells) for cells in (FEW_FACETS, MANY_FACETS))
    return [
        of("cross_correlation", "300 px", 1.5, ROCK),
        of("cross_correlation", "1,000 px", 4.0, large, **ONE_MESH),
        of("limb_matching", "300 px", 0.8, ROCK),
        of("limb_matching", "1,000 px", None, large, **ONE_MESH),
        of("limb_matching", "300 px, 49,000 facets", None, few, **ONE_MESH),
        of("limb_matching", "300 px, 3.1 million facets", None, many, **ONE_MESH),
        of("surface_features", "300 px", 2.0, replace(ROCK, phases_deg=(30.0, 60.0, 90.0))),
        Job(
            name="verification, 300 px",
            goal_u=0.17,
            fresh=found,
            run=lambda one: verify(one.fix, one.inputs, 40.0),
            judge=lambda one, fix: judge(one.draw, fix),
        ),
    ]


def growth(unit_calls: Callable[[], None]) -> Iterator[dict[str, Any]]:
    """Cost over the number of facets, beside other tools, and over the size of the body."""
    for cells in GROWING_CELLS:
        case, over = replace(ROCK, mesh_cells=cells), {"growth": "facets", "facets": 12 * cells**2}
        mesh = fresh(case)(0).seen.shape
        assert isinstance(mesh, TriangleMesh)
        yield over | _rays(mesh)
        for name in ("cross_correlation", "limb_matching"):
            yield over | _cost(name, case, unit_calls)
    for diameter_px, (body, names) in product(GROWING_PX, GROWING.items()):
        frame_px = max(1024, int(1.25 * diameter_px))
        case, over = replace(ROCK, body=body, diameter_px=diameter_px, frame_px=frame_px), {"growth": "size"}
        for name in names:
            yield over | {"diameter_px": diameter_px} | _cost(name, case, unit_calls)


def _cost(name: str, case: Case, unit_calls: Callable[[], None]) -> dict[str, Any]:
    job = Job(name=name, goal_u=None, fresh=fresh(case), run=estimated(name), judge=judge, **ONE_MESH)
    return measured(job, unit_calls)


def _rays(mesh: TriangleMesh) -> dict[str, float]:
    """CPU of hit points of camera rays from 1000 radii away, by the project and by trimesh, ms."""
    tracer, other = tracer_for(mesh), trimesh.Trimesh(mesh.vertices_km, mesh.faces, process=False).ray
    origin = 1000.0 * mesh.mean_radius_km * unit(np.array([1.0, 2.0, 3.0]))
    targets = np.random.default_rng(1).uniform(-1.0, 1.0, (OTHER_RAYS, 3)) * mesh.mean_radius_km
    directions, origins = unit(targets - origin), np.tile(origin, (OTHER_RAYS, 1))
    tools = {
        "rays_ms": lambda: tracer.intersect(origin, directions),
        "trimesh_ms": lambda: other.intersects_location(origins, directions, multiple_hits=False),
    }
    return {name: round(least_cpu_ms(tool, 3), 1) for name, tool in tools.items()}
