"""Rays of one place taken for those of another nearby: the light, the coverage and the shadows that new rays find."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float, unit
from giantlike.core.detector import GaussianPsf
from giantlike.ray_tracing import Body, FocalPlane, RenderOptions, Template, Trace, trace_body
from giantlike.ray_tracing.cached_trace import moved_trace
from giantlike.ray_tracing.sampling import MovedCells
from giantlike.shapes import irregular_body
from tests.tolerances import FLOAT64_SUM

SUN = unit(np.array([0.8, 0.3, -0.4]))
OTHER_SUN = unit(np.array([-0.3, 0.8, -0.4]))
SHAPE = irregular_body(3, facets=5000)
FOCAL_PX, SIZE = 1200.0, 240
PLACE, NEARER = np.array([0.02, -0.01, 40.0]), np.array([0.05, 0.06, 39.6])  # radii of the body
LIGHT, CENTER_PX = 3e-3, 0.02  # of all light, and of its center: sampling of 180 rays across
OF_PIXELS = 0.03  # of the brightest pixel, rms: the same


def plane_of(pixels_to_one: int, *, psf_px: float = 0.4) -> FocalPlane:
    """A camera, or the same with its pixels in blocks."""
    middle = (0.5 * SIZE / pixels_to_one - 0.5, 0.5 * SIZE / pixels_to_one - 0.5)
    focal = FOCAL_PX / pixels_to_one
    model = PinholeModel(fx_px=focal, fy_px=focal, cx_px=middle[0], cy_px=middle[1])
    size = SIZE // pixels_to_one
    return FocalPlane(model=model, columns=size, rows=size, psf=GaussianPsf(sigma_px=psf_px))


def body_at(place: Float) -> Body:
    position_km = place * SHAPE.circumscribing_radius_km
    return Body(shape=SHAPE, camera_from_body=Rotation.from_rotvec([0.4, -0.9, 0.3]), position_camera_km=position_km)


def traced(place: Float, plane: FocalPlane, rays: int) -> Trace:
    trace = trace_body(
        body_at(place),
        plane.model,
        sun_direction_camera=SUN,
        psf=plane.psf,
        columns=plane.columns,
        rows=plane.rows,
        options=RenderOptions(rays_per_pixel_side=rays, min_rays_across=1),
    )
    assert isinstance(trace, Trace)
    return trace


def template_of(trace: Trace) -> Template:
    template = trace.template()
    assert isinstance(template, Template)
    return template


@pytest.mark.parametrize("sun", [SUN, OTHER_SUN])
def test_moved_rays_bring_the_light_of_new_ones_on_larger_pixels(sun: Float) -> None:
    blocks = plane_of(4)
    moved = template_of(moved_trace(traced(PLACE, plane_of(1), 3), body_at(NEARER), blocks).with_sun(sun))
    new = template_of(traced(NEARER, blocks, 12).with_sun(sun))
    assert_allclose(moved.center_px, new.center_px, rtol=0, atol=FLOAT64_SUM)
    assert_allclose(moved.photocenter_px, new.photocenter_px, rtol=0, atol=CENTER_PX)
    assert_allclose(moved.brightness.sum(), new.brightness.sum(), rtol=LIGHT)
    assert_allclose(moved.coverage.sum(), new.coverage.sum(), rtol=LIGHT)
    one, other = (template.placed(blocks.columns, blocks.rows) for template in (moved, new))
    assert math.sqrt(np.mean((one - other)[other > 0.0] ** 2)) < OF_PIXELS * other.max()


def test_rays_nearest_to_the_middles_of_pixels_are_lit_as_new_rays_there() -> None:
    blocks = plane_of(4)
    moved = moved_trace(traced(PLACE, plane_of(1), 2), body_at(NEARER), blocks).one_to_a_pixel()
    new = traced(NEARER, blocks, 1)
    images = []
    for trace in (moved, new):
        light, (x, y) = trace.at_middles()
        frame = np.zeros((blocks.rows, blocks.columns))
        frame[y : y + light.shape[0], x : x + light.shape[1]] = light
        images.append(frame)
    assert sum(rays.sight.rays.size for rays in moved.tiles) <= 1.1 * sum(rays.sight.rays.size for rays in new.tiles)
    assert np.corrcoef(images[0].ravel(), images[1].ravel())[0, 1] > 0.97


@pytest.mark.parametrize("step_px", [0.27, 1.7])
def test_the_light_of_cells_anywhere_keeps_its_amount_place_and_width(step_px: float) -> None:
    cells, sigma_px = MovedCells(first=0, count=9, per_px=1, start_px=12.37, step_px=step_px), 0.9
    shares, pixels = cells.spread(-10, 60, sigma_px).toarray(), np.arange(-10, 50)
    assert_allclose(shares.sum(axis=0), step_px, rtol=1e-5)  # the tail of the Gaussian beyond five sigma
    centers = pixels @ shares / step_px
    assert_allclose(centers, 12.37 + step_px * np.arange(9), rtol=0, atol=1e-4)
    widths = [float(share @ (pixels - center) ** 2) for share, center in zip(shares.T / step_px, centers, strict=True)]
    assert_allclose(widths, sigma_px**2 + step_px**2 / 12 + 1 / 12, rtol=1e-3)


@pytest.mark.parametrize("step_px", [0.27, 1.7])
def test_without_blur_a_cell_lights_what_it_covers(step_px: float) -> None:
    cells = MovedCells(first=0, count=9, per_px=1, start_px=12.37, step_px=step_px)
    low = 12.37 + step_px * (np.arange(9) - 0.5)
    pixels = np.arange(-10, 50)[:, None]
    covered = np.minimum(low + step_px, pixels + 0.5) - np.maximum(low, pixels - 0.5)
    assert_allclose(cells.spread(-10, 60, 0.0).toarray(), np.maximum(covered, 0.0), rtol=0, atol=FLOAT64_SUM)
    assert (cells.pixels == np.floor(low + 0.5 * step_px + 0.5)).all()
