"""A small body traced once: moved in closed form it looks as if rendered anew, and changes as its derivatives say."""

import dataclasses
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import Failure
from giantlike.ray_tracing import Body, FocalPlane, Lambert, McEwen, Template
from giantlike.ray_tracing.cached_trace import Trace
from giantlike.relative.template.moved_body import MovedBody
from giantlike.relative.template.rendering import TemplateRenderer, place_template
from giantlike.relative.template.state import TemplateImages, TemplateState
from giantlike.shapes import Ellipsoid, Shape
from tests.numerical import numerical_jacobian

RENDERED = 0.005  # of the brightest pixel: rays through other places of the body, 240 across
DERIVATIVE = 1e-6  # of the brightest pixel per px: differences over 1e-4 px of values of 1e-16
SIZE_PX = 64
MODEL = PinholeModel(fx_px=5000.0, fy_px=5000.0, cx_px=31.5, cy_px=31.5)
STEPS = {"x": (0.4, 0.0, 0.0, 0.0), "y": (0.0, -0.3, 0.0, 0.0), "range": (0.0, 0.0, 0.03, 0.0), "blur": (0, 0, 0, 0.1)}


def renderer_of(shape: Shape, diameter_px: float) -> TemplateRenderer:
    sight = MODEL.unproject(np.array([30.3, 33.2]))
    range_km = 2.0 * shape.mean_radius_km * 5000.0 / diameter_px
    across = np.cross(sight, [0.3, 0.8, 0.0])
    sun = -math.cos(1.2) * sight + math.sin(1.2) * across / np.linalg.norm(across)
    body = Body(
        shape=shape,
        camera_from_body=Rotation.from_rotvec([0.4, -0.9, 0.3]),
        position_camera_km=range_km * sight,
        reflectance=McEwen(),
    )
    plane = FocalPlane(model=MODEL, columns=SIZE_PX, rows=SIZE_PX, psf=GaussianPsf(sigma_px=0.7))
    return TemplateRenderer(target=body, plane=plane, sun_direction_camera=sun, rays_across=240)


def moved(state: TemplateState, step: Float) -> TemplateState:
    return TemplateState(
        center_px=state.center_px + step[:2],
        log_range=state.log_range + float(step[2]),
        psf_variance_px2=state.psf_variance_px2 + float(step[3]),
    )


@pytest.fixture(scope="module", params=[2.0, 8.0])
def renderer(request: pytest.FixtureRequest) -> TemplateRenderer:
    return renderer_of(Ellipsoid(radii_km=np.array([1.0, 0.8, 0.7])), request.param)


@pytest.mark.parametrize("step", STEPS.values(), ids=STEPS.keys())
def test_a_moved_body_looks_as_if_rendered_anew(renderer: TemplateRenderer, step: tuple[float, ...]) -> None:
    box = renderer.box(np.array([15.0, 18.0]), np.array([45.0, 48.0]), 0)
    synthesize = renderer.synthesis(box, other_law=False)
    assert isinstance(synthesize(renderer.start, True), TemplateImages)  # traced here
    state = moved(renderer.start, np.array(step))
    images, template = synthesize(state, True), renderer.render(state, renderer.sampling(4))
    assert isinstance(images, TemplateImages)
    assert isinstance(template, Template)
    anew = place_template(template, box)
    assert_allclose(images.light, anew, rtol=0, atol=RENDERED * float(anew.max()))


def test_the_derivatives_are_those_of_the_image(renderer: TemplateRenderer) -> None:
    trace = renderer.trace(renderer.start, renderer.sampling(4))
    assert isinstance(trace, Trace)
    small = MovedBody(trace=trace, state=renderer.start)
    box = renderer.box(np.array([15.0, 18.0]), np.array([45.0, 48.0]), 0)

    cells = small.shade((McEwen(), Lambert()))

    weights = np.array([0.7, 0.4])

    def light(step: Float) -> Float:
        return np.tensordot(weights, small.lights(box, moved(renderer.start, step), cells)[0], 1).ravel()

    (first, second), derivatives = small.lights(box, renderer.start, cells)
    numerical = numerical_jacobian(light, np.zeros(4), 1e-4)
    analytic = derivatives(weights).reshape(4, -1).T
    assert_allclose(analytic, numerical, rtol=0, atol=DERIVATIVE * float(first.max()))
    assert float(np.abs(second - first).max()) > RENDERED * float(first.max())  # another law is another image


def test_a_body_that_is_dark_from_where_the_fit_goes_is_a_failure(renderer: TemplateRenderer) -> None:
    dark = dataclasses.replace(renderer, sun_direction_camera=MODEL.unproject(renderer.start.center_px))
    synthesize = dark.synthesis(renderer.box(np.zeros(2), np.full(2, 60.0), 0), other_law=False)
    assert isinstance(synthesize(renderer.start, True), Failure)
