"""A fine trace told by a rough one where a body is lit: the same light, for a fraction of the rays."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float, Mask, unit
from giantlike.ray_tracing import Body, Lambert, RenderOptions
from giantlike.ray_tracing.cached_trace import Trace, trace_body
from giantlike.ray_tracing.daylight import Daylight
from giantlike.ray_tracing.embree import Float32
from giantlike.ray_tracing.sampling import AxisCells
from giantlike.ray_tracing.tracer import MeshTracer, Sight
from giantlike.shapes import irregular_body

MODEL = PinholeModel(fx_px=1000.0, fy_px=1000.0, cx_px=63.5, cy_px=63.5)
SHAPE = irregular_body(3, facets=5000)
PLACE, NEARER = np.array([0.02, -0.01, 25.0]), np.array([0.1, 0.06, 24.5])  # radii of the body
LOST = 2e-3  # of the light: spots of less than a rough cell
SUNS = {"low": (0.98, 0.1, 0.17), "high": (0.5, 0.1, -0.86)}
CAMERA_RAYS, SUN_RAYS = {"low": 0.6, "high": 0.95}, {"low": 0.3, "high": 0.3}  # of those of an untold trace


def body_at(place: Float) -> Body:
    position_km = place * SHAPE.circumscribing_radius_km
    return Body(shape=SHAPE, camera_from_body=Rotation.from_rotvec([0.4, -0.9, 0.3]), position_camera_km=position_km)


def traced(place: Float, rays: int, sun: str, daylight: Daylight | None = None) -> Trace:
    trace = trace_body(
        body_at(place),
        MODEL,
        sun_direction_camera=unit(np.array(SUNS[sun])),
        columns=128,
        rows=128,
        options=RenderOptions(rays_per_pixel_side=rays, min_rays_across=1),
        daylight=daylight,
    )
    assert isinstance(trace, Trace)
    return trace


def told(sun: str) -> Daylight:
    """Daylight nearer by, from a rough trace farther away."""
    rough = traced(PLACE, 1, sun)
    return Daylight(
        cells=rough.cells,
        lit=rough.lit_cells,
        center_px=body_at(NEARER).center_px(MODEL),
        traced_center_px=body_at(PLACE).center_px(MODEL),
        scale=math.sqrt(float(PLACE @ PLACE) / float(NEARER @ NEARER)),
    )


@pytest.mark.parametrize("sun", SUNS)
def test_told_rays_bring_the_light_of_all_and_are_fewer(sun: str, monkeypatch: pytest.MonkeyPatch) -> None:
    cast: list[tuple[int, int]] = []
    sight, dark = MeshTracer.sight, MeshTracer.dark

    def seen(tracer: MeshTracer, origin_km: Float, directions: Float) -> Sight:
        cast.append((len(directions), 0))
        return sight(tracer, origin_km, directions)

    def shaded(tracer: MeshTracer, points_km: Float32, normals: Float32, to_sun: Float) -> Mask:
        cast.append((0, len(points_km)))
        return dark(tracer, points_km, normals, to_sun)

    monkeypatch.setattr(MeshTracer, "sight", seen)
    monkeypatch.setattr(MeshTracer, "dark", shaded)
    daylight = told(sun)
    counts, lights = [], []
    for known in (None, daylight):
        cast.clear()
        lights.append(traced(NEARER, 4, sun, known).cell_brightness(Lambert()))
        counts.append(np.sum(cast, axis=0))
    assert np.abs(lights[1] - lights[0]).sum() < LOST * lights[0].sum()
    assert counts[1][0] < CAMERA_RAYS[sun] * counts[0][0]
    assert counts[1][1] < SUN_RAYS[sun] * counts[0][1]


def test_beyond_a_rough_trace_nothing_is_told() -> None:
    here = np.zeros(2)
    rough = AxisCells(first=0, count=4, per_px=1), AxisCells(first=0, count=4, per_px=1)
    for lit in (True, False):
        daylight = Daylight(cells=rough, lit=np.full((4, 4), lit), center_px=here, traced_center_px=here, scale=1.0)
        dark, bright = daylight.classify(
            (AxisCells(first=-2, count=8, per_px=1), AxisCells(first=0, count=4, per_px=1))
        )
        told_there = bright if lit else dark
        assert told_there[2:6].all()
        assert not (dark & bright).any()
        assert not (dark | bright)[:2].any()
        assert not (dark | bright)[6:].any()


def test_a_rough_trace_of_a_part_tells_nothing_dark() -> None:
    lit = np.zeros((8, 8), dtype=bool)
    lit[:, :5] = True
    rough = AxisCells(first=0, count=8, per_px=1), AxisCells(first=0, count=8, per_px=1)
    here = np.zeros(2)
    dark, bright = Daylight(
        cells=rough, lit=lit, center_px=here, traced_center_px=here, scale=1.0, whole=False
    ).classify(rough)
    assert not dark.any()
    assert bright[1:-1, 1:4].all()
    assert not bright[:, 4:].any()
