"""Cells split where light is uneven: nearly the image of rays as fine everywhere, for a fraction of them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Mask, unit
from giantlike.core.errors import InputError
from giantlike.ray_tracing import Body, Lambert, McEwen, RenderOptions
from giantlike.ray_tracing.cached_trace import Trace, trace_body
from giantlike.ray_tracing.refined import RefinedTrace, refine_trace
from giantlike.shapes import irregular_body

MODEL = PinholeModel(fx_px=1000.0, fy_px=1000.0, cx_px=63.5, cy_px=63.5)
UNEVEN_LEFT = 0.3  # of the squared difference between coarse and fine rays
RAYS = 0.5  # of those that are as fine everywhere


def traced(rays: int, wanted: Mask | None = None) -> Trace:
    shape = irregular_body(3, facets=5000)
    body = Body(
        shape=shape,
        camera_from_body=Rotation.from_rotvec([0.4, -0.9, 0.3]),
        position_camera_km=np.array([0.02, -0.01, 25.0]) * shape.circumscribing_radius_km,
    )
    trace = trace_body(
        body,
        MODEL,
        sun_direction_camera=unit(np.array([0.8, 0.1, -0.6])),
        columns=128,
        rows=128,
        options=RenderOptions(rays_per_pixel_side=rays, min_rays_across=1),
        wanted=wanted,
    )
    assert isinstance(trace, Trace)
    return trace


@pytest.fixture(scope="module")
def split() -> RefinedTrace:
    return refine_trace(traced(2), 3)


@pytest.mark.parametrize("law", [McEwen(), Lambert()])
def test_split_cells_bring_the_light_of_fine_rays(split: RefinedTrace, law: McEwen | Lambert) -> None:
    fine = traced(6).cell_brightness(law)
    coarse = traced(2).cell_brightness(law).repeat(3, axis=0).repeat(3, axis=1)
    found = split.cell_brightness(law).repeat(3, axis=0).repeat(3, axis=1)
    columns, rows = split.part_places
    assert not found[columns, rows].any()
    found[columns, rows] = split.part_brightness(law)
    (x, y), (fine_x, fine_y) = split.part_cells, traced(6).cells
    assert (x.per_px, y.per_px) == (fine_x.per_px, fine_y.per_px)
    within = (
        slice(fine_x.first - x.first, fine_x.first - x.first + fine_x.count),
        slice(fine_y.first - y.first, fine_y.first - y.first + fine_y.count),
    )
    left, without = (float(np.sum((one[within] - fine) ** 2)) for one in (found, coarse))
    assert left < UNEVEN_LEFT * without


def test_even_cells_are_not_split(split: RefinedTrace) -> None:
    x, y = split.part_cells
    rays = split.rays.directions.shape[0] + x.count * y.count / 9
    assert 0 < rays < RAYS * x.count * y.count


def test_rays_through_some_pixels_bring_what_all_rays_do_and_the_others_nothing() -> None:
    wanted = np.zeros((128, 128), bool)
    wanted[40:70, 50:90] = True
    whole, part = traced(2), traced(2, wanted)
    (x, y), light = whole.cells, whole.cell_brightness(McEwen())
    inside = wanted[np.ix_(*(np.floor(cells.centers_px + 0.5).astype(int) for cells in (y, x)))].T
    assert light[~inside].max() > 0.0
    np.testing.assert_array_equal(part.cell_brightness(McEwen()), np.where(inside, light, 0.0))
    assert part.lit < whole.lit
    with pytest.raises(InputError, match="wanted"):
        traced(2, wanted[1:])
