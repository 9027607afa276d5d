"""What a camera gets to see of a body: a level of detail for its pixels, and a point as the image of its PSF."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.outcomes import CenterFix
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.ray_tracing import Body, Template, render, trace_silhouette
from giantlike.relative.light.unresolved import Unresolved, UnresolvedOptions
from giantlike.scene import Scene, Target
from giantlike.shapes import Ellipsoid, Point, Shape, mesh_from_ellipsoid
from giantlike.shapes.detail import LevelsOfDetail
from tests.tolerances import PLACE_PX

MODEL = PinholeModel(fx_px=5000.0, fy_px=5000.0, cx_px=256.0, cy_px=256.0)
ELLIPSOID = Ellipsoid(radii_km=np.array([1.0, 0.7, 0.6]))
LEVELS = LevelsOfDetail(meshes=tuple(mesh_from_ellipsoid(ELLIPSOID, facets=count) for count in (320, 5120, 20_480)))
SUN = np.array([0.8, 0.1, -0.6]) / np.linalg.norm([0.8, 0.1, -0.6])


def _body(shape: Shape, position_km: list[float]) -> Body:
    return Body(
        shape=shape,
        camera_from_body=Rotation.from_euler("xyz", [80.0, 20.0, 30.0], degrees=True),
        position_camera_km=np.array(position_km),
    )


def _template(body: Body) -> Template:
    template = render(body, MODEL, sun_direction_camera=SUN, psf=GaussianPsf(sigma_px=0.8), columns=512, rows=512)
    assert isinstance(template, Template)
    return template


@pytest.mark.parametrize(("range_km", "level"), [(30.0, 2), (700.0, 1), (5000.0, 0)])
def test_a_camera_sees_the_level_of_detail_for_its_pixels_in_images_and_outlines(range_km: float, level: int) -> None:
    body, chosen = (_body(shape, [0.1, 0.2, range_km]) for shape in (LEVELS, LEVELS.meshes[level]))
    assert body.seen_by(MODEL).shape is chosen.shape
    assert_allclose(_template(body).brightness, _template(chosen).brightness, rtol=0, atol=0)
    circle = np.linspace(0.0, 6.0, 20)
    outlines = [trace_silhouette(one, MODEL, circle, sun_direction_camera=SUN).points_px for one in (body, chosen)]
    assert_allclose(outlines[0], outlines[1], rtol=0, atol=0)


def test_rays_that_no_camera_sends_meet_the_finest_level() -> None:
    assert _body(LEVELS, [0.0, 0.0, 100.0]).tracer is _body(LEVELS.finest, [0.0, 0.0, 100.0]).tracer


def test_from_inside_its_sphere_a_body_is_seen_in_its_finest_level() -> None:
    assert _body(LEVELS, [0.0, 0.0, 0.9]).seen_by(MODEL).shape is LEVELS.finest


@pytest.mark.parametrize("range_km", [1e3, 1e8])
def test_the_image_of_a_point_is_the_psf_over_its_pixels(range_km: float) -> None:
    center = np.array([100.3, 201.6])
    template = _template(_body(Point(), (MODEL.unproject(center) * range_km).tolist()))
    light = template.brightness / template.brightness.sum()
    profiles = [light.sum(axis=0), light.sum(axis=1)]
    for profile, corner, place in zip(profiles, template.corner_px, center, strict=True):
        edges = corner + np.arange(profile.size + 1) - 0.5
        assert_allclose(
            profile, np.diff(ndtr((edges - place) / 0.8)), rtol=0, atol=2e-4
        )  # light off the center, 3e-4 px
    assert_allclose(template.center_px, center, rtol=0, atol=PLACE_PX)
    assert_allclose(template.photocenter_px, center, rtol=0, atol=5e-4)


def test_the_center_of_a_point_is_the_center_of_its_light_whatever_the_phase() -> None:
    camera = Camera(
        name="cam", columns=96, rows=80, model=PinholeModel(fx_px=3000.0, fy_px=3000.0, cx_px=47.0, cy_px=39.0),
        psf=GaussianPsf(sigma_px=0.8), detector=Detector(gain_e_per_dn=2.0, read_noise_e=8.0, saturation_dn=4095.0),
    )  # fmt: skip
    truth_px = np.array([44.3, 41.6])
    profiles = [
        np.diff(ndtr((np.arange(n + 1) - 0.5 - place) / 0.8)) for n, place in zip((96, 80), truth_px, strict=True)
    ]
    light = 8000.0 * np.outer(profiles[1], profiles[0])
    noise = np.random.default_rng(1).normal(size=light.shape) * np.sqrt(camera.detector.variance_dn2(light))
    image = Image(
        pixels=(100.0 + light + noise).astype(np.float32), camera_from_inertial=Rotation.identity(), name="point.fits"
    )
    geometry = ApparentGeometry(
        position_inertial_km=1e7 * camera.model.unproject(np.add(truth_px, [5.0, -4.0])),
        inertial_from_body=Rotation.identity(),
        sun_direction_inertial=SUN,
    )
    scene = Scene(targets=(Target(name="P", shape=Point(), ephemeris=geometry),))
    for correction in ("rendered", "kaasalainen_tanga"):
        fix = Unresolved(UnresolvedOptions(correction=correction)).estimate(image, camera, scene)
        assert isinstance(fix, CenterFix)
        error_px = fix.center_px - truth_px
        assert error_px @ np.linalg.solve(fix.covariance_px2, error_px) < 30.0  # chi-square of two: 3e-7 by chance
        assert np.sqrt(np.trace(fix.covariance_px2)) < 0.02
