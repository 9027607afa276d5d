"""Several bodies in one image: they hide each other, shade each other and stand under a Sun of its true size."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.camera_models import BrownModel, PinholeModel
from giantlike.core.detector import GaussianPsf
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.ray_tracing import Body, Lambert, LommelSeeliger, Reflectance, RenderOptions, Template, render
from giantlike.ray_tracing.cached_trace import Trace, trace_body
from giantlike.ray_tracing.render import SceneRender, render_scene
from giantlike.ray_tracing.trace import disk_directions
from giantlike.shapes import Ellipsoid, FacetAlbedo, Shape, irregular_body, mesh_from_ellipsoid, sphere
from tests.tolerances import FLOAT64, FLOAT64_ROOT, FLOAT64_SUM, PLACE_PX

AREA = 5e-3  # relative: 2 rays along each pixel side, edges of 100 px

TILTED = Rotation.from_euler("xyz", [80.0, 20.0, 30.0], degrees=True)
BEHIND_CAMERA = np.array([0.0, 0.0, -1.0])
SIDEWAYS = np.array([0.8, 0.1, -0.6]) / np.linalg.norm([0.8, 0.1, -0.6])
FAR = PinholeModel(fx_px=1e5, fy_px=1e5, cx_px=128.0, cy_px=120.0)
BROWN = BrownModel(fx_px=500.0, fy_px=510.0, cx_px=130.0, cy_px=118.0, k1=-0.2, k2=0.05, p1=1e-3, p2=-5e-4)
LAMBERT = Lambert()
DEFAULTS = RenderOptions()
SHAPES = [sphere(1.0), mesh_from_ellipsoid(sphere(1.0), facets=20_000)]


def _body(shape: Shape, position_km: list[float], law: Reflectance = LAMBERT) -> Body:
    return Body(
        shape=shape, camera_from_body=TILTED, position_camera_km=np.array(position_km, dtype=float), reflectance=law
    )


def _scene(bodies: list[Body], sun: np.ndarray, options: RenderOptions = DEFAULTS) -> SceneRender:
    psf = GaussianPsf(sigma_px=0.7)
    return render_scene(bodies, FAR, sun_direction_camera=sun, psf=psf, columns=256, rows=240, options=options)


def test_a_scene_of_one_body_is_its_template() -> None:
    body = _body(irregular_body(2, facets=2000), [0.5, -0.4, 6.0])
    psf = GaussianPsf(sigma_px=0.7)
    scene = render_scene([body], BROWN, sun_direction_camera=SIDEWAYS, psf=psf, columns=256, rows=240)
    template = render(body, BROWN, sun_direction_camera=SIDEWAYS, psf=psf, columns=256, rows=240)
    assert isinstance(template, Template)
    assert np.array_equal(scene.brightness, template.placed(256, 240))
    assert scene.coverage(0).sum() == pytest.approx(template.coverage.sum(), rel=FLOAT64)


@pytest.mark.parametrize("near", SHAPES, ids=["ellipsoid", "mesh"])
@pytest.mark.parametrize("far", SHAPES, ids=["ellipsoid", "mesh"])
def test_a_near_sphere_cuts_its_disk_out_of_a_far_one(near: Shape, far: Shape) -> None:
    bodies = [_body(far, [0.0, 0.0, 1010.0], LommelSeeliger()), _body(near, [0.0, 1.0, 990.0])]
    alone = [_scene([body], BEHIND_CAMERA) for body in bodies]
    scene = _scene(bodies, BEHIND_CAMERA, RenderOptions(shadows=False))
    radii, apart = [1e5 / 1010.0, 1e5 / 990.0], 1e5 / 990.0
    lens = _lens_area(radii[0], radii[1], apart)
    hidden = alone[0].coverage(0) - scene.coverage(0)
    assert hidden.sum() == pytest.approx(lens, rel=AREA)
    assert hidden.min() > -FLOAT64
    assert np.array_equal(scene.coverage(1), alone[1].coverage(0))
    assert (scene.coverage(0) + scene.coverage(1)).max() < 1.0 + FLOAT64
    free = alone[1].coverage(0) == 0.0
    assert_allclose(scene.coverage(0)[free], alone[0].coverage(0)[free], rtol=0, atol=FLOAT64)
    swapped = _scene(bodies[::-1], BEHIND_CAMERA, RenderOptions(shadows=False))
    assert_allclose(swapped.brightness, scene.brightness, rtol=0, atol=FLOAT64)


def _lens_area(a: float, b: float, d: float) -> float:
    """Area that two circles of radii a and b, d apart, share."""
    if d >= a + b:
        return 0.0
    if d <= abs(a - b):
        return math.pi * min(a, b) ** 2
    alpha, beta = math.acos((d * d + a * a - b * b) / (2 * d * a)), math.acos((d * d + b * b - a * a) / (2 * d * b))
    return a * a * (alpha - math.sin(2 * alpha) / 2) + b * b * (beta - math.sin(2 * beta) / 2)


def test_a_moon_between_sun_and_planet_throws_a_round_shadow_and_only_that_way() -> None:
    plate = Ellipsoid(radii_km=np.array([1.0, 1.0, 1e-3]))  # a wall that faces the camera
    wall = Body(shape=plate, camera_from_body=Rotation.identity(), position_camera_km=np.array([0.0, 0.0, 1000.0]))
    sun = np.array([0.6, 0.0, -0.8])
    moon_at = np.array([0.0, 0.0, 1000.0]) + 5.0 * sun
    small = sphere(0.3)
    lit = _scene([wall], sun).templates[0]
    shaded = _scene([wall, _body(small, moon_at.tolist())], sun).templates[0]
    before = _scene([wall, _body(small, [0.0, 0.0, 1000.0 + 5.0])], sun).templates[0]
    assert isinstance(lit, Template)
    assert isinstance(shaded, Template)
    assert isinstance(before, Template)
    assert np.array_equal(before.brightness, lit.brightness)
    lost = (lit.brightness - shaded.brightness).sum() / lit.brightness.max()
    assert lost == pytest.approx(math.pi * 30.0**2 / 0.8, rel=AREA)  # a slanting cylinder, 100 px to the km
    assert shaded.lit_fraction == pytest.approx(1.0 - 0.09 / 0.8, abs=AREA)


def test_under_an_extended_sun_a_shadow_has_the_brightness_of_the_uncovered_part_of_its_disk() -> None:
    plate = Ellipsoid(radii_km=np.array([1.0, 0.05, 1e-3]))  # a strip across the shadow
    at = np.array([0.0, 0.0, 1000.0])
    wall = Body(shape=plate, camera_from_body=Rotation.identity(), position_camera_km=at, reflectance=LAMBERT)
    radius_rad, away_km, moon_km = 0.04, 5.0, 0.3
    sun = np.array([0.6, 0.0, -0.8])
    moon = _body(sphere(moon_km), (at + away_km * sun).tolist())
    options = RenderOptions(sun_radius_rad=radius_rad, sun_samples=64, rays_per_pixel_side=2, min_rays_across=1)
    alone, both = (_scene(bodies, sun, options) for bodies in ([wall], [wall, moon]))
    x = np.arange(58, 198)
    light = both.weighted([1.0, 0.0])[120, x] / alone.brightness[120, x]
    expected = []
    for offset_km in (x - 128.0) / 100.0:
        toward = away_km * sun - np.array([offset_km, 0.0, 0.0])
        distance = float(np.linalg.norm(toward))
        apart = math.acos(float(toward @ sun) / distance)
        expected.append(1.0 - _lens_area(radius_rad, math.asin(moon_km / distance), apart) / (math.pi * radius_rad**2))
    assert min(expected) < 0.01 < 0.99 < max(expected)
    # in every ring at most two of the 64 arcs are cut: 64 draws of a spread below 1/2, 4 rays a pixel
    assert np.abs(light - expected).max() < 5 * 0.5 / math.sqrt(64 * 4)
    assert np.abs(light - expected).mean() < 0.5 / math.sqrt(64 * 4)
    again = _scene([wall, moon], sun, options)
    assert np.array_equal(again.brightness, both.brightness)
    other = _scene([wall, moon], sun, replace(options, sun_seed=1))
    assert not np.array_equal(other.brightness, both.brightness)


def test_points_of_the_solar_disk_fill_it_evenly() -> None:
    random = np.random.default_rng(5)
    first, turn = random.uniform(size=(2, 2000))
    rays = np.stack(disk_directions(np.append(SIDEWAYS, 0.0), 0.3, 8, first, turn))
    assert np.all(rays[..., 3] == 0.0)
    rays = rays[..., :3]
    assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, rtol=0, atol=FLOAT64)
    share = (1.0 - rays @ SIDEWAYS) / (1.0 - math.cos(0.3))  # uniform in [0, 1) over a cap
    ring = np.arange(8)[:, None]
    assert np.all((share * 8 > ring - 1e-9) & (share * 8 < ring + 1 + 1e-9))
    assert abs(share.mean() - 0.5) < 5 / 8 / math.sqrt(12 * share.size)
    sideways = rays.mean(axis=(0, 1)) - SIDEWAYS * (rays @ SIDEWAYS).mean()
    assert np.linalg.norm(sideways) < 5 * 0.3 / math.sqrt(2000)  # the eight points of a ray share a turn


def test_each_body_keeps_its_law_its_albedo_and_its_sun() -> None:
    mesh = mesh_from_ellipsoid(sphere(1.0), facets=500)
    gray = mesh.with_albedo(FacetAlbedo(np.full(500, 0.25)))
    apart = [[-1.2, 0.0, 2000.0], [1.2, 0.0, 2000.0]]
    suns = np.stack([BEHIND_CAMERA, SIDEWAYS])
    scene = _scene([_body(gray, apart[0]), _body(mesh, apart[1], LommelSeeliger())], suns)
    first = _scene([_body(mesh, apart[0])], BEHIND_CAMERA)
    second = _scene([_body(mesh, apart[1], LommelSeeliger())], SIDEWAYS)
    assert_allclose(scene.brightness, 0.25 * first.brightness + second.brightness, rtol=0, atol=FLOAT64_SUM)
    assert_allclose(scene.weighted([4.0, 0.0]), first.brightness, rtol=0, atol=FLOAT64_SUM)


def test_what_is_not_seen_is_a_failure_of_that_body_alone() -> None:
    big, small = _body(sphere(1.0), [0.0, 0.0, 1000.0]), _body(sphere(0.1), [0.0, 0.2, 1010.0])
    outside = _body(sphere(1.0), [100.0, 0.0, 1000.0])
    scene = _scene([big, small, outside], BEHIND_CAMERA)
    assert isinstance(scene.templates[0], Template)
    reasons = [template.reason for template in scene.templates[1:] if isinstance(template, Failure)]
    assert reasons == [Reason.NO_SIGNAL, Reason.OUT_OF_FRAME]
    assert scene.coverage(1).sum() == 0.0
    eclipsed = _scene([big, small], np.array([0.0, 0.0, -1.0]) * -1.0).templates[0]
    assert isinstance(eclipsed, Template)
    assert eclipsed.brightness.max() == 0.0
    assert eclipsed.coverage.sum() > 0.0
    with pytest.raises(InputError, match="each of 2 bodies"):
        _scene([big, small], np.zeros((3, 3)))


# --- one trace, many templates --------------------------------------------------------------------------------------


def _near(
    body: Body,
    sun: np.ndarray = SIDEWAYS,
    psf: GaussianPsf | None = None,
    options: RenderOptions = DEFAULTS,
    *,
    recenter: bool = False,
) -> Template | Failure:
    """A render through the distorted camera."""
    return render(
        body, BROWN, sun_direction_camera=sun, psf=psf, columns=256, rows=240, options=options, recenter=recenter
    )


def _same(first: Template | Failure, second: Template | Failure) -> bool:
    assert isinstance(first, Template)
    assert isinstance(second, Template)
    same = (np.array_equal(getattr(first, name), getattr(second, name)) for name in ("brightness", "coverage"))
    return all(same) and np.array_equal(first.photocenter_px, second.photocenter_px)


@pytest.mark.parametrize("options", [DEFAULTS, RenderOptions(sun_radius_rad=0.1, sun_samples=3, jitter_seed=1)])
def test_a_cached_trace_shades_as_a_new_render_does(options: RenderOptions) -> None:
    body = _body(irregular_body(2, facets=2000), [0.5, -0.4, 6.0])
    psf, wide, other_sun = GaussianPsf(sigma_px=0.7), GaussianPsf(sigma_px=1.9), np.array([0.0, 0.6, -0.8])
    trace = trace_body(body, BROWN, sun_direction_camera=SIDEWAYS, psf=psf, columns=256, rows=240, options=options)
    assert isinstance(trace, Trace)
    seeliger = replace(body, reflectance=LommelSeeliger())
    pairs = [
        (trace, (body, SIDEWAYS, psf)),
        (trace.with_reflectance(LommelSeeliger()), (seeliger, SIDEWAYS, psf)),
        (trace.with_psf(wide), (body, SIDEWAYS, wide)),
        (trace.with_psf(None), (body, SIDEWAYS, None)),
        (trace.with_sun(other_sun).with_reflectance(LommelSeeliger()), (seeliger, other_sun, psf)),
    ]
    first = trace.template()
    for changed, (anew, sun, blur) in pairs:
        assert _same(changed.template(), _near(anew, sun, blur, options))
    assert not _same(first, pairs[-1][0].template())


def test_a_trace_that_the_frame_cuts_refuses_a_psf_that_needs_other_rays() -> None:
    body = _body(irregular_body(2, facets=2000), [1.5, 0.0, 6.0])
    trace = trace_body(body, BROWN, sun_direction_camera=SIDEWAYS, columns=256, rows=240)
    assert isinstance(trace, Trace)
    with pytest.raises(InputError, match="trace it anew"):
        trace.with_psf(GaussianPsf(sigma_px=2.0))


@pytest.mark.parametrize("seed", [None, 3])
def test_threads_change_nothing_in_the_image(seed: int | None) -> None:
    body = _body(irregular_body(2, facets=20_000), [0.1, -0.1, 5.0])
    options = RenderOptions(rays_per_pixel_side=10, jitter_seed=seed)
    one, three = (_near(body, options=replace(options, threads=n)) for n in (1, 3))
    assert isinstance(one, Template)
    assert one.coverage.sum() * 100 > 2 * 32_768  # several tiles
    assert _same(one, three)


# --- outside the field ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("position", [[9.0, -4.0, 6.0], [0.5, 0.3, -6.0], [0.0, 0.0, -6.0]])
def test_a_body_outside_the_field_is_rendered_as_if_the_camera_had_turned_to_it(position: list[float]) -> None:
    body = _body(irregular_body(2, facets=2000), position)
    away = np.array(position) / np.linalg.norm(position)
    sun = np.cross(away, [0.6, 0.8, 0.0])
    sun = 0.6 * sun / np.linalg.norm(sun) - 0.8 * away
    psf = GaussianPsf(sigma_px=0.7)
    assert isinstance(_near(body, sun, psf), Failure)
    template = _near(body, sun, psf, recenter=True)
    assert isinstance(template, Template)
    turn = template.rendered_from_camera
    assert_allclose(template.center_px, [127.5, 119.5], rtol=0, atol=PLACE_PX)
    assert_allclose(rotate(turn, away), BROWN.unproject([127.5, 119.5]), rtol=0, atol=FLOAT64_SUM)
    assert _same(template, _near(body.turned(turn), rotate(turn, sun), psf))
    assert turn.magnitude() == pytest.approx(np.arccos(away @ BROWN.unproject([127.5, 119.5])), abs=FLOAT64_ROOT)
    inside = _body(irregular_body(2, facets=2000), [0.2, 0.1, 6.0])
    kept = _near(inside, recenter=True)
    assert isinstance(kept, Template)
    assert kept.rendered_from_camera.magnitude() == 0.0
