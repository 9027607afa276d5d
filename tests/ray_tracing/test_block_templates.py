"""Templates from one ray to a block of pixels: nearly those of many rays to each pixel, under every law."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float, unit
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import Failure, Reason
from giantlike.ray_tracing import Body, FocalPlane, Lambert, McEwen, RenderOptions, Template, render
from giantlike.ray_tracing.block_templates import BlockedPlane, block_templates
from giantlike.shapes import irregular_body

MODEL = PinholeModel(fx_px=1000.0, fy_px=1000.0, cx_px=63.5, cy_px=63.5)
PLANE = FocalPlane(model=MODEL, columns=128, rows=128, psf=GaussianPsf(sigma_px=0.7))
BODY = Body(
    shape=irregular_body(3, facets=5000),
    camera_from_body=Rotation.from_rotvec([0.4, -0.9, 0.3]),
    position_camera_km=np.array([0.0, 0.0, 25.0]),
)
RADIUS_KM = BODY.shape.circumscribing_radius_km
SUN = unit(np.array([0.8, 0.1, -0.6]))
LAWS = (McEwen(), Lambert())
CENTER_PX = 0.03  # of the center of light: a thousandth of the radius
LIGHT = 0.002  # of all light
NORM = 0.03  # of the light, as a norm: edges through pixels


def found(size_px: int, at: tuple[float, float] = (0.02, -0.01), sun: Float = SUN) -> tuple[Template, ...] | Failure:
    blocked = BlockedPlane(plane=PLANE, model=MODEL.binned(size_px), size_px=size_px)
    body = BODY.at(np.array([*at, 25.0]) * RADIUS_KM)
    options = RenderOptions(rays_per_pixel_side=1, margin_px=4)
    return block_templates(body, blocked, LAWS, sun_direction_camera=sun, options=options)


@pytest.mark.parametrize("size_px", [2, 3])
def test_they_are_nearly_those_of_many_rays(size_px: int) -> None:
    templates = found(size_px)
    assert not isinstance(templates, Failure)
    for law, template in zip(LAWS, templates, strict=True):
        body = Body(
            shape=BODY.shape,
            camera_from_body=BODY.camera_from_body,
            position_camera_km=np.array([0.02, -0.01, 25.0]) * RADIUS_KM,
            reflectance=law,
        )
        options = RenderOptions(rays_per_pixel_side=6)
        fine = render(body, MODEL, sun_direction_camera=SUN, psf=PLANE.psf, columns=128, rows=128, options=options)
        assert isinstance(fine, Template)
        light, wanted = (each.placed(128, 128) for each in (template, fine))
        assert float(light.sum()) == pytest.approx(float(wanted.sum()), rel=LIGHT * size_px)
        np.testing.assert_allclose(template.photocenter_px, fine.photocenter_px, atol=CENTER_PX * size_px)
        np.testing.assert_allclose(template.center_px, fine.center_px, atol=1e-9)
        assert float(np.linalg.norm(light - wanted)) < NORM * size_px * float(np.linalg.norm(wanted))
        assert template.lit_fraction == pytest.approx(fine.lit_fraction, abs=0.02)
        assert float(template.coverage.sum()) == pytest.approx(float(fine.coverage.sum()), rel=0.02)


def test_a_body_beyond_the_frame_or_dark_in_it_is_out_of_it() -> None:
    beyond = found(2, at=(5.0, 0.0))
    assert isinstance(beyond, Failure)
    assert beyond.reason is Reason.OUT_OF_FRAME
    assert "128 x 128" in beyond.detail
    cut = found(2, at=(-1.9, 0.0), sun=unit(np.array([-0.9, 0.0, 0.4])))
    assert isinstance(cut, Failure)
    assert cut.reason is Reason.OUT_OF_FRAME
    behind = found(2, sun=np.array([0.0, 0.0, 1.0]))
    assert isinstance(behind, Failure)
    assert behind.reason is Reason.NOT_LIT
