"""Ray tracing: hits, shadows, templates and silhouettes against geometry and physics in closed form."""

from __future__ import annotations

import gc
import json
import weakref
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from giantlike.camera_models import BrownModel, CameraModel, PinholeModel
from giantlike.core.detector import GaussianPsf
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure, Reason
from giantlike.ray_tracing import (
    Body,
    Lambert,
    LommelSeeliger,
    McEwen,
    RenderOptions,
    Template,
    render,
    trace_silhouette,
)
from giantlike.ray_tracing.sampling import AxisCells, RayGrid, Tile
from giantlike.ray_tracing.tracer import tracer_for
from giantlike.shapes import Ellipsoid, TriangleMesh, irregular_body, load_shape, mesh_from_ellipsoid, sphere
from tests.sizes import slow
from tests.tolerances import FIVE_DIGITS, FLOAT32, FLOAT32_SUM, FLOAT64, FLOAT64_CHAIN, FLOAT64_SUM, SAMPLED

SILHOUETTE_PX = 1e-4  # float32 rays from the bounding sphere: 6e-8 of the radius, and a bisection to 5e-7 px
EXACT_PX = 2e-6  # bisection of half a pixel, 20 times
POINT_OF_RANGE = 1e-9  # what is promised; rounding is 1e-15
POINT_KM = 1e-9  # float64 planes, body of 1 km
PHOTOCENTER_RADII = 2e-3  # 256 rays across the disk
FLUX = 5e-3  # relative, same reason; crescents of 120 deg have a quarter of the rays
SHAPE_PX = 0.01  # brightness centroid, the navigator's gate for equal images

ELLIPSOID = Ellipsoid(radii_km=np.array([1.0, 0.7, 0.6]))
TILTED = Rotation.from_euler("xyz", [80.0, 20.0, 30.0], degrees=True)
SUN = np.array([0.8, 0.1, -0.6]) / np.linalg.norm([0.8, 0.1, -0.6])
BROWN = BrownModel(
    fx_px=1500.0, fy_px=1510.0, cx_px=640.0, cy_px=500.0, skew_px=1.0, k1=-0.2, k2=0.05, p1=1e-3, p2=-5e-4
)
PINHOLE = PinholeModel(fx_px=1e5, fy_px=1e5, cx_px=512.0, cy_px=512.0)
DEFAULTS = RenderOptions()
CIRCLE = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _render(body: Body, model: CameraModel, *, sun: np.ndarray = SUN, options: RenderOptions = DEFAULTS) -> Template:
    psf = GaussianPsf(sigma_px=0.8)
    template = render(body, model, sun_direction_camera=sun, psf=psf, columns=1280, rows=1024, options=options)
    assert isinstance(template, Template)
    return template


def _brute_force(mesh: TriangleMesh, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance to the first hit by Moller and Trumbore's test of every facet, float64; infinite for a miss."""
    a, b, c = (mesh.vertices_km[mesh.faces[:, i]] for i in range(3))
    distances = np.full(len(origins), np.inf)
    for n, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        p = np.cross(direction, c - a)
        determinant = np.einsum("ij,ij->i", b - a, p)
        s = origin - a
        u = np.einsum("ij,ij->i", s, p) / determinant
        q = np.cross(s, b - a)
        v, t = q @ direction / determinant, np.einsum("ij,ij->i", c - a, q) / determinant
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        distances[n] = np.min(t[inside], initial=np.inf)
    return distances


# --- rays -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("distance_km", [1.5, 40.0, 4e5])
def test_mesh_hits_agree_with_a_test_of_every_facet_at_any_distance(distance_km: float) -> None:
    mesh = irregular_body(4, radii_km=(1.0, 0.7, 0.6), facets=500)
    random = np.random.default_rng(1)
    origins = _unit(random.normal(size=(400, 3))) * distance_km
    directions = _unit(random.uniform(-1.0, 1.0, size=(400, 3)) - origins)
    expected = _brute_force(mesh, origins, directions)
    hits = tracer_for(mesh).intersect(origins, directions)
    assert 100 < hits.hit.sum() < 350
    assert np.array_equal(hits.hit, np.isfinite(expected))
    rounding_km = POINT_KM + 1e-15 * distance_km * 100
    points = origins + expected[:, None] * directions
    assert_allclose(hits.points_km[hits.hit], points[hits.hit], rtol=0, atol=rounding_km)
    assert_allclose(hits.normals[hits.hit], mesh.normals[hits.facets[hits.hit]], rtol=0, atol=0)
    assert np.isnan(hits.points_km[~hits.hit]).all()
    assert np.array_equal(tracer_for(mesh).is_occluded(origins, directions), hits.hit)


def test_ellipsoid_and_its_fine_mesh_are_hit_at_the_same_places() -> None:
    mesh = mesh_from_ellipsoid(ELLIPSOID, facets=100_000)
    sagitta_km = 1.0 * (2.5 * np.sqrt(4 * np.pi / 1e5)) ** 2 / 8
    random = np.random.default_rng(2)
    directions = _unit(random.uniform(-0.5, 0.5, size=(2000, 3)) - [0.0, 0.0, 50.0])
    smooth, flat = (tracer_for(shape).intersect([0.0, 0.0, 50.0], directions) for shape in (ELLIPSOID, mesh))
    assert np.all(smooth.hit & flat.hit)
    assert_allclose(np.sum((smooth.points_km / ELLIPSOID.radii_km) ** 2, axis=1), 1.0, rtol=0, atol=FLOAT64)
    assert_allclose(flat.points_km, smooth.points_km, rtol=0, atol=2 * sagitta_km)
    assert_allclose(flat.normals, smooth.normals, rtol=0, atol=0.03)


@pytest.mark.parametrize("shape", [ELLIPSOID, mesh_from_ellipsoid(ELLIPSOID, facets=2000)], ids=["ellipsoid", "mesh"])
def test_rays_that_are_nan_point_away_or_pass_by_hit_nothing(shape: Ellipsoid | TriangleMesh) -> None:
    directions = np.array([[np.nan, 0.0, 1.0], [0.0, 0.0, 1.0], [0.5, 0.0, -1.0], [0.0, 0.0, -3.0]])
    tracer = tracer_for(shape)
    hits = tracer.intersect([0.0, 0.0, 5.0], directions)
    assert hits.hit.tolist() == [False, False, False, True]
    assert hits.facets[0] == -1
    assert tracer.is_occluded([0.0, 0.0, 5.0], directions).tolist() == [False, False, False, True]
    assert_allclose(hits.points_km[3], [0.0, 0.0, 0.6], rtol=0, atol=1e-2)
    assert tracer.intersect(np.zeros((0, 3)), np.zeros((0, 3))).hit.shape == (0,)
    with pytest.raises(InputError, match="origins"):
        tracer.intersect(np.zeros((2, 3)), directions)


@pytest.mark.parametrize("radii", [2.0, 10.0, 1e3, 1e6])
def test_rays_tell_inside_from_outside_of_an_outline_at_any_range(radii: float) -> None:
    mesh = mesh_from_ellipsoid(ELLIPSOID, facets=180)
    model = PinholeModel(fx_px=150.0 * radii, fy_px=150.0 * radii, cx_px=512.0, cy_px=512.0)
    body = Body(shape=mesh, camera_from_body=TILTED, position_camera_km=radii * np.array([1e-3, 2e-3, 1.0]))
    corners = model.project(body.to_camera(mesh.vertices_km) + body.position_camera_km)
    hull = ConvexHull(corners)
    normals = hull.equations[:, None, :2]
    along = np.linspace(0.05, 0.95, 50)[None, :, None]
    edges = corners[hull.simplices]
    outline = (1.0 - along) * edges[:, None, 0] + along * edges[:, None, 1]
    for offset_px, meets in ((-SILHOUETTE_PX, True), (SILHOUETTE_PX, False)):
        directions = np.zeros((outline.size // 2, 4))
        directions[:, :3] = body.to_body(model.unproject((outline + offset_px * normals).reshape(-1, 2)))
        rays = body.tracer.sight(body.camera_body_km, directions).rays
        assert rays.size == (len(directions) if meets else 0)
        hits = body.tracer.intersect(body.camera_body_km, directions[:, :3])
        assert np.all(hits.hit == meets)
        if meets:
            plane = np.einsum("ij,ij->i", hits.normals, hits.points_km - mesh.vertices_km[mesh.faces[hits.facets, 0]])
            aside = np.cross(hits.points_km - body.camera_body_km, directions[:, :3])
            assert np.abs(plane).max() < POINT_OF_RANGE * radii
            assert np.linalg.norm(aside, axis=1).max() < POINT_OF_RANGE * radii


def test_a_convex_body_casts_no_shadow_on_itself() -> None:
    mesh = mesh_from_ellipsoid(ELLIPSOID, facets=20_000)
    tracer, random = tracer_for(mesh), np.random.default_rng(3)
    targets = ELLIPSOID.radii_km * _unit(random.normal(size=(1_000_000, 3)))
    origin = np.array([3.0, 2.0, -250_000.0])
    directions = np.zeros((len(targets), 4))
    directions[:, :3] = _unit(targets - origin)
    sight = tracer.sight(origin, directions)
    sun = np.append(SUN, 0.0)
    facing = sight.only(sight.normals @ sun > 0.0)
    assert facing.rays.size > 700_000
    assert not tracer.dark(facing.points_km, facing.normals, sun).any()


@pytest.mark.parametrize("shape", [ELLIPSOID, mesh_from_ellipsoid(ELLIPSOID, facets=80)], ids=["ellipsoid", "mesh"])
def test_a_camera_inside_a_body_is_told_so(shape: Ellipsoid | TriangleMesh) -> None:
    results = []
    for position in ([0.0, 0.0, 0.4], [0.0, 0.0, 0.7]):  # the shortest radius is 0.6 km
        body = Body(shape=shape, camera_from_body=Rotation.identity(), position_camera_km=np.array(position))
        results.append(render(body, PINHOLE, sun_direction_camera=[0.0, 0.0, -1.0], columns=64, rows=64))
    assert isinstance(results[0], Failure)
    assert results[0].reason is Reason.DEGENERATE_GEOMETRY
    assert isinstance(results[1], Template)


def test_no_light_is_negative_however_far_the_body() -> None:
    position = np.array([0.0, 0.0, 1e15])
    template = _render(Body(shape=sphere(1.0), camera_from_body=TILTED, position_camera_km=position), PINHOLE, sun=-SUN)
    assert isinstance(template, Template)
    assert template.brightness.min() >= 0.0 < template.brightness.sum()


def test_a_tower_throws_a_shadow_as_long_as_the_sun_is_low() -> None:
    body = _block_with_tower()
    elevation = np.radians(30.0)
    sun = np.array([np.cos(elevation), 0.0, np.sin(elevation)])
    x = np.linspace(-3.9, 3.9, 2001)
    x = x[np.abs(x) > 0.11]  # beside the tower, which stands on |x| < 0.1 and is 1 high
    points = np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=-1)
    origin = np.array([0.0, 0.0, 1e4])
    tracer = tracer_for(body)
    hits = tracer.intersect(origin, points - origin)
    assert hits.hit.all()
    dark = tracer.is_shadowed(hits, sun)
    length = 1.0 / np.tan(elevation)
    assert_allclose([x[dark].min(), x[dark].max()], [-0.1 - length, -0.11], rtol=0, atol=0.01)
    near_km = 3e-5  # a shadow ray that starts 6e-6 km over the slab, 1e-6 of the radius, looks 1e-5 km into the shadow
    end = np.array([[-0.1 - length + near_km, 0.0, 0.0], [-0.1 - length - near_km, 0.0, 0.0]])
    assert tracer.is_shadowed(tracer.intersect(origin, end - origin), sun).tolist() == [True, False]


def _block_with_tower(half: float = 0.1) -> TriangleMesh:
    """A flat slab, top at z = 0, with a square tower of height 1 on it."""
    slab, tower = _box((-4.0, -4.0, -0.5), (4.0, 4.0, 0.0)), _box((-half, -half, 0.0), (half, half, 1.0))
    return TriangleMesh(np.vstack([slab[0], tower[0]]), np.vstack([slab[1], tower[1] + 8]))


def _box(low: tuple[float, ...], high: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[(low, high)[(n >> axis) & 1][axis] for axis in range(3)] for n in range(8)])
    faces = ConvexHull(corners).simplices
    inward = np.linalg.det(corners[faces] - corners.mean(axis=0)) < 0
    return corners, np.where(inward[:, None], faces[:, ::-1], faces)


def test_the_tracer_of_a_mesh_is_built_once_and_goes_with_the_mesh() -> None:
    mesh = irregular_body(1, facets=500)
    assert tracer_for(mesh) is tracer_for(mesh)
    gone = weakref.ref(tracer_for(mesh))
    del mesh
    gc.collect()
    assert gone() is None


# --- templates ------------------------------------------------------------------------------------------------------


def _sun_at_phase(position: np.ndarray, phase_deg: float) -> np.ndarray:
    """Sun direction at a phase angle, towards +x in the image."""
    toward = _unit(position)
    sideways = _unit(np.array([1.0, 0.0, 0.0]) - toward[0] * toward)
    return np.asarray(-toward * np.cos(np.radians(phase_deg)) + sideways * np.sin(np.radians(phase_deg)))


@lru_cache
def _sphere_integrals(law: Lambert | McEwen | LommelSeeliger, phase_deg: float) -> tuple[float, float]:
    """Flux over disk area, and photocenter over radius, of a far sphere: by quadrature over what is seen and lit."""
    a = np.radians(phase_deg)
    nodes, weights = np.polynomial.legendre.leggauss(80)
    half_width = 0.5 * (np.pi - a)  # of the lune, in longitude from the camera towards the Sun
    longitude, latitude = (grid.ravel() for grid in np.meshgrid(0.5 * a + half_width * nodes, 0.5 * np.pi * nodes))
    cos_emission, x = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude)
    value = law(np.cos(latitude) * np.cos(longitude - a), cos_emission, np.full(x.shape, a))
    area = half_width * 0.5 * np.pi * np.outer(weights, weights).ravel() * np.cos(latitude) * cos_emission
    flux = float(area @ value)
    return flux / np.pi, float(area @ (x * value)) / flux


@pytest.mark.parametrize("phase_deg", [0.0, 60.0, 120.0])
@pytest.mark.parametrize("diameter_px", [0.02, 0.2, 3.0, 80.0])
def test_a_lambert_sphere_of_any_size_has_the_flux_and_photocenter_of_theory(
    diameter_px: float, phase_deg: float
) -> None:
    position = 2.0 / diameter_px * 1e5 * np.array([3e-4, -4e-4, 1.0])
    body = Body(shape=sphere(1.0), camera_from_body=TILTED, position_camera_km=position, reflectance=Lambert())
    template = _render(body, PINHOLE, sun=_sun_at_phase(position, phase_deg))
    a = np.radians(phase_deg)
    theory = np.sin(a) + (np.pi - a) * np.cos(a)
    flux = 2.0 / (3.0 * np.pi) * theory * np.pi * diameter_px**2 / 4  # 2/3 of the disk at full phase
    offset = 3.0 * np.pi / 16.0 * np.sin(a) * (1.0 + np.cos(a)) / theory * diameter_px / 2
    assert template.brightness.sum() == pytest.approx(flux, rel=FLUX)
    assert template.coverage.sum() == pytest.approx(np.pi * diameter_px**2 / 4, rel=FLUX)
    found = template.photocenter_px - template.center_px
    assert_allclose(found, [offset, 0.0], rtol=0, atol=PHOTOCENTER_RADII * diameter_px)
    blurred = _centroid(template)
    assert_allclose(blurred, template.photocenter_px, rtol=0, atol=1e-5)  # a PSF of 0.8 px aliases by some 1e-6


def _centroid(template: Template) -> np.ndarray:
    return _centroid_of(template.brightness, template.corner_px)


def _centroid_of(image: np.ndarray, corner: np.ndarray) -> np.ndarray:
    y, x = np.indices(image.shape)
    return np.asarray(np.array([(x * image).sum(), (y * image).sum()]) / image.sum() + corner)


def test_the_closed_form_of_the_lambert_photocenter_agrees_with_quadrature() -> None:
    a = np.radians(60.0)
    theory = np.sin(a) + (np.pi - a) * np.cos(a)
    flux, offset = _sphere_integrals(Lambert(), 60.0)
    assert flux == pytest.approx(2.0 / (3.0 * np.pi) * theory, rel=FLOAT32_SUM)
    assert offset == pytest.approx(3.0 * np.pi / 16.0 * np.sin(a) * (1.0 + np.cos(a)) / theory, rel=FLOAT32_SUM)


@pytest.mark.parametrize("law", [McEwen(), LommelSeeliger()], ids=["mcewen", "lommel_seeliger"])
@pytest.mark.parametrize("phase_deg", [0.0, 90.0])
def test_other_laws_have_the_flux_and_photocenter_of_a_quadrature(
    law: McEwen | LommelSeeliger, phase_deg: float
) -> None:
    position = 2.0 / 40.0 * 1e5 * np.array([0.0, 0.0, 1.0])
    body = Body(shape=sphere(1.0), camera_from_body=TILTED, position_camera_km=position, reflectance=law)
    template = _render(body, PINHOLE, sun=_sun_at_phase(position, phase_deg))
    flux, offset = _sphere_integrals(law, phase_deg)
    assert template.brightness.sum() == pytest.approx(flux * np.pi * 400.0, rel=FLUX)
    assert_allclose(
        template.photocenter_px - template.center_px, [offset * 20.0, 0.0], rtol=0, atol=PHOTOCENTER_RADII * 20.0
    )


def test_a_template_through_a_distorted_camera_matches_a_dense_render_without_our_shortcuts() -> None:
    position = np.array([6.5, -5.0, 25.0])
    body = Body(shape=ELLIPSOID, camera_from_body=TILTED, position_camera_km=position)
    template = _render(body, BROWN, options=RenderOptions(rays_per_pixel_side=9))
    fine, side = 9, 1.0 / 9
    height, width = template.brightness.shape
    x = np.arange(width * fine) * side + side / 2 - 0.5 + template.corner_px[0]
    y = np.arange(height * fine) * side + side / 2 - 0.5 + template.corner_px[1]
    directions = BROWN.unproject(np.stack(np.meshgrid(x, y), axis=-1)).reshape(-1, 3)
    matrix = TILTED.as_matrix() @ np.diag(ELLIPSOID.radii_km**-2) @ TILTED.as_matrix().T
    along, across = directions @ matrix @ position, np.einsum("ij,jk,ik->i", directions, matrix, directions)
    discriminant = along**2 - across * (position @ matrix @ position - 1.0)
    met = discriminant > 0
    distance = (along[met] - np.sqrt(discriminant[met])) / across[met]
    normals = _unit((distance[:, None] * directions[met] - position) @ matrix)
    light = np.zeros(len(directions))
    cosines = normals @ SUN, -np.einsum("ij,ij->i", normals, directions[met])
    light[met] = McEwen()(*cosines, np.arccos(-directions[met] @ SUN))
    dense = gaussian_filter(light.reshape(height * fine, width * fine), 0.8 * fine, truncate=6, mode="constant")
    dense = dense.reshape(height, fine, width, fine).mean(axis=(1, 3))
    covered = met.reshape(height, fine, width, fine).mean(axis=(1, 3))
    off = np.abs(template.brightness - dense) > 2e-3 * dense.max()
    assert off.mean() < 1e-3
    assert_allclose(_centroid(template), _centroid_of(dense, template.corner_px), rtol=0, atol=SHAPE_PX)
    assert_allclose(template.coverage, covered, rtol=0, atol=1.5 / 81)  # one ray of a pixel's 81 may go either way
    lit = np.count_nonzero(light) / np.count_nonzero(met)
    assert template.lit_fraction == pytest.approx(lit, abs=FIVE_DIGITS)
    assert_allclose(template.center_px, BROWN.project(position), rtol=0, atol=FLOAT64)


@pytest.mark.parametrize("seed", [None, 7])
def test_another_sampling_changes_the_image_but_not_where_the_body_is(seed: int | None) -> None:
    shape = irregular_body(2, facets=20_000)
    body = Body(shape=shape, camera_from_body=TILTED, position_camera_km=np.array([0.3, 0.2, 6.0]))
    plain = _render(body, BROWN, options=RenderOptions(rays_per_pixel_side=3))
    other = _render(body, BROWN, options=RenderOptions(rays_per_pixel_side=6, jitter_seed=seed))
    assert not np.array_equal(plain.brightness, other.brightness)
    assert_allclose(_centroid(other), _centroid(plain), rtol=0, atol=SHAPE_PX)
    assert other.brightness.sum() == pytest.approx(plain.brightness.sum(), rel=SAMPLED)


def test_a_mesh_template_equals_that_of_its_ellipsoid() -> None:
    pose = {"camera_from_body": TILTED, "position_camera_km": np.array([1.5, -1.0, 14.0])}
    smooth = _render(Body(shape=ELLIPSOID, **pose), BROWN)  # type: ignore[arg-type]
    faceted = _render(Body(shape=mesh_from_ellipsoid(ELLIPSOID, facets=100_000), **pose), BROWN)  # type: ignore[arg-type]
    images = [template.placed(1280, 1024) for template in (smooth, faceted)]
    assert (np.abs(images[0] - images[1]) > 0.01).mean() < 1e-3
    assert_allclose(_centroid(faceted), _centroid(smooth), rtol=0, atol=SHAPE_PX)


def test_a_template_cut_by_the_frame_shows_the_same_pixels_as_the_whole() -> None:
    body = Body(
        shape=irregular_body(2, facets=5000), camera_from_body=TILTED, position_camera_km=np.array([0.0, 0.0, 1.5])
    )
    model = PinholeModel(fx_px=1000.0, fy_px=1000.0, cx_px=300.0, cy_px=250.0)
    whole = _render(body, model).placed(1280, 1024)
    cuts = {
        margin: render(
            body, model, sun_direction_camera=SUN, psf=GaussianPsf(sigma_px=0.8), columns=320, rows=200,
            options=RenderOptions(margin_px=margin),
        )
        for margin in (0, 40)
    }  # fmt: skip
    for margin, cut in cuts.items():
        assert isinstance(cut, Template)
        assert np.all(cut.corner_px + cut.brightness.shape[::-1] == [320 + margin, 200 + margin])
        assert_allclose(cut.placed(320, 200), whole[:200, :320], rtol=0, atol=FLOAT32)  # the PSF is cut at 5 sigma


def test_a_body_moved_by_whole_pixels_gives_the_same_template_elsewhere() -> None:
    body = Body(
        shape=irregular_body(2, facets=5000), camera_from_body=TILTED, position_camera_km=np.array([0.0, 0.0, 500.0])
    )
    model = PinholeModel(fx_px=1e5, fy_px=1e5, cx_px=300.0, cy_px=250.0)
    moved = PinholeModel(fx_px=1e5, fy_px=1e5, cx_px=317.0, cy_px=239.0)
    first, second = _render(body, model), _render(body, moved)
    assert (second.corner_px - first.corner_px).tolist() == [17, -11]
    assert_allclose(second.photocenter_px - first.photocenter_px, [17.0, -11.0], rtol=0, atol=SAMPLED / 2)


@pytest.mark.parametrize(
    ("position", "sun", "reason"),
    [
        ([500.0, 0.0, 10.0], SUN, Reason.OUT_OF_FRAME),
        ([0.0, 0.0, -10.0], SUN, Reason.OUT_OF_FRAME),
        ([-6.5, 0.0, 10.0], SUN, Reason.OUT_OF_FRAME),
        ([0.0, 0.0, 10.0], np.array([0.0, 0.0, 1.0]), Reason.NOT_LIT),
    ],
)
def test_a_body_that_gives_no_light_is_a_failure_with_a_reason(
    position: list[float], sun: np.ndarray, reason: Reason
) -> None:
    body = Body(shape=ELLIPSOID, camera_from_body=TILTED, position_camera_km=np.array(position))
    result = render(body, BROWN, sun_direction_camera=sun, columns=1280, rows=1024)
    assert isinstance(result, Failure)
    assert result.reason is reason


def test_misuse_is_refused_with_what_was_needed() -> None:
    body = Body(shape=ELLIPSOID, camera_from_body=TILTED, position_camera_km=np.array([0.0, 0.0, 10.0]))
    with pytest.raises(InputError, match="unit vector"):
        render(body, BROWN, sun_direction_camera=[0.0, 0.0, -1.5], columns=10, rows=10)
    with pytest.raises(InputError, match="columns and rows"):
        render(body, BROWN, sun_direction_camera=SUN, columns=0, rows=10)
    with pytest.raises(InputError, match="position_camera_km"):
        body.at([0.0, 0.0, 0.0])
    with pytest.raises(InputError, match="rays_per_pixel_side"):
        RenderOptions(rays_per_pixel_side=0)
    with pytest.raises(InputError, match="angles_rad"):
        trace_silhouette(body, BROWN, [np.nan], sun_direction_camera=SUN)
    with pytest.raises(InputError, match="got a str"):
        tracer_for("bennu")  # type: ignore[arg-type]


@pytest.mark.parametrize("sigma_px", [0.0, 0.3, 1.2])
def test_light_of_a_cell_spreads_over_pixels_as_cell_psf_and_pixel_say(sigma_px: float) -> None:
    cells = AxisCells.covering(9.6, 11.4, 3)
    weights = cells.spread(0, 21, sigma_px).matrix() * 3.0  # a cell is a third of a pixel wide
    assert_allclose(weights.sum(axis=0), 1.0, rtol=0, atol=2e-6)  # five sigma of the PSF
    center, pixel = cells.centers_px[0], 10
    fine = np.linspace(-12.0, 12.0, 24_001)
    box = (np.abs(fine - (center - pixel)) < 1 / 6) * 3.0
    step = fine[1] - fine[0]
    blurred = gaussian_filter(box, sigma_px / step, truncate=8) if sigma_px else box
    assert weights[pixel, 0] == pytest.approx(blurred[np.abs(fine) <= 0.5].sum() * step, abs=SAMPLED)


def test_light_beyond_the_pixels_is_lost_and_the_rest_falls_where_it_did() -> None:
    cells, light = AxisCells.covering(-3.0, 8.0, 2), np.random.default_rng(4).uniform(size=(24, 3))
    whole = cells.spread(-20, 60, 0.8).apply(light[: cells.count])
    assert_allclose(whole.sum(axis=0), 0.5 * light[: cells.count].sum(axis=0), rtol=0, atol=2e-5)  # half a pixel each
    assert np.array_equal(cells.spread(1, 5, 0.8).apply(light[: cells.count]), whole[21:26])


@pytest.mark.parametrize("k1", [-0.05, -0.4], ids=["everywhere", "up to a fold"])
def test_ray_directions_are_those_of_the_camera_model_also_where_it_ends(k1: float) -> None:
    model = BrownModel(fx_px=500.0, fy_px=500.0, cx_px=640.0, cy_px=500.0, k1=k1, p1=1e-3)
    x, y = AxisCells.covering(0.0, 640.0, 1), AxisCells.covering(400.0, 500.0, 1)
    exact = model.unproject(np.stack(np.meshgrid(x.centers_px, y.centers_px), axis=-1)) @ TILTED.as_matrix()
    assert np.isnan(exact).any() == (k1 == -0.4)
    assert np.isfinite(exact).any()
    grid = RayGrid(model, x, y, TILTED.as_matrix().T)
    directions = grid.directions(Tile(10, 60, 5, x.count)).reshape(x.count - 5, 50, 4)  # column after column
    assert_allclose(np.swapaxes(directions[..., :3], 0, 1), exact[10:60, 5:], rtol=0, atol=FLOAT64_CHAIN / 5)
    assert np.all(directions[..., 3] == 0.0)


def test_jittered_rays_stay_in_their_cells_and_fill_them() -> None:
    x, y = AxisCells.covering(100.0, 140.0, 3), AxisCells.covering(80.0, 100.0, 3)
    rays = RayGrid(BROWN, x, y, np.eye(3), jitter_seed=1).directions(Tile(0, y.count, 0, x.count))[:, :3]
    pixels = np.swapaxes(BROWN.project(rays).reshape(x.count, y.count, 2), 0, 1)
    within = 3.0 * (pixels - np.stack(np.meshgrid(x.edges_px[:-1], y.edges_px[:-1]), axis=-1))
    assert within.min() > -1e-4
    assert within.max() < 1.0 + 1e-4
    assert_allclose(within.mean(axis=(0, 1)), 0.5, rtol=0, atol=4.0 / np.sqrt(12.0 * x.count * y.count))
    across, down = np.moveaxis(within - 0.5, -1, 0)
    assert abs(np.mean(across * down)) < 4.0 / (12.0 * np.sqrt(x.count * y.count))  # as of independent uniforms


# --- silhouettes ----------------------------------------------------------------------------------------------------


def _limb_distance_px(body: Body, model: CameraModel, points_px: np.ndarray) -> np.ndarray:
    """First-order distance of pixels to the limb of an ellipsoid: zero of its discriminant, over its gradient."""
    turn = body.camera_from_body.as_matrix()
    matrix = turn @ np.diag(ELLIPSOID.radii_km**-2) @ turn.T
    position = body.position_camera_km

    def discriminant(pixels: np.ndarray) -> np.ndarray:
        rays = model.unproject(pixels)
        across = np.einsum("ij,jk,ik->i", rays, matrix, rays)
        return np.asarray((rays @ matrix @ position) ** 2 - across * (position @ matrix @ position - 1.0))

    step = 1e-3
    gradient = [(discriminant(points_px + e) - discriminant(points_px - e)) / (2 * step) for e in np.eye(2) * step]
    return np.asarray(discriminant(points_px) / np.linalg.norm(gradient, axis=0))


def test_the_silhouette_of_an_ellipsoid_lies_on_its_limb_in_a_distorted_image() -> None:
    body = Body(shape=ELLIPSOID, camera_from_body=TILTED, position_camera_km=np.array([2.0, -1.5, 9.0]))
    limb = trace_silhouette(body, BROWN, CIRCLE, sun_direction_camera=SUN)
    assert limb.valid.all()
    assert np.abs(_limb_distance_px(body, BROWN, limb.points_px)).max() < EXACT_PX
    offsets = limb.points_px - limb.center_px
    aside = offsets[:, 0] * np.sin(CIRCLE) - offsets[:, 1] * np.cos(CIRCLE)
    assert_allclose(aside, 0.0, rtol=0, atol=EXACT_PX)
    assert np.all(offsets[:, 0] * np.cos(CIRCLE) + offsets[:, 1] * np.sin(CIRCLE) > 0)
    assert_allclose(BROWN.project(limb.points_camera_km), limb.points_px, rtol=0, atol=FLOAT64_SUM)
    tangent = np.roll(limb.points_px, -1, axis=0) - np.roll(limb.points_px, 1, axis=0)
    assert np.abs(np.einsum("ij,ij->i", _unit(tangent), limb.normals_px)).max() < 0.01  # chords over 4 deg
    assert np.all(np.einsum("ij,ij->i", offsets, limb.normals_px) > 0)
    assert_allclose(limb.cos_incidence[~limb.lit].max(), 0.0, rtol=0, atol=0.05)
    assert np.array_equal(limb.lit, limb.cos_incidence > 0)


@pytest.mark.parametrize("distance_km", [8.0, 4e5])
def test_the_silhouette_of_a_polyhedron_is_the_hull_of_its_projected_corners(distance_km: float) -> None:
    mesh = mesh_from_ellipsoid(ELLIPSOID, facets=180)
    model = PinholeModel(fx_px=150.0 * distance_km, fy_px=150.0 * distance_km, cx_px=512.0, cy_px=512.0)
    body = Body(shape=mesh, camera_from_body=TILTED, position_camera_km=distance_km * np.array([1e-3, 2e-3, 1.0]))
    limb = trace_silhouette(body, model, CIRCLE, sun_direction_camera=SUN)
    corners = model.project(mesh.vertices_km @ TILTED.as_matrix().T + body.position_camera_km)
    hull = ConvexHull(corners).equations  # outward normals and offsets of the edges
    heights = limb.points_px @ hull[:, :2].T + hull[:, 2]
    assert np.abs(heights.max(axis=1)).max() < SILHOUETTE_PX
    edge = heights.argmax(axis=1)
    inner = np.sort(heights, axis=1)[:, -2] < -3.0  # the chord of the normal lies on a single edge
    assert inner.sum() > 60
    assert_allclose(limb.normals_px[inner], hull[edge[inner], :2], rtol=0, atol=2 * SILHOUETTE_PX)


@pytest.mark.parametrize("motion_km", [[1e-3, 0.0, 0.0], [0.0, 1e-3, 0.0], [0.0, 0.0, 1e-2]])
@pytest.mark.parametrize(
    ("shape", "quantile"),
    [(ELLIPSOID, 1.0), (mesh_from_ellipsoid(ELLIPSOID, facets=180), 0.75)],  # at a corner, a normal is of two edges
    ids=["ellipsoid", "polyhedron"],
)
def test_a_limb_point_moves_along_its_normal_as_the_projection_jacobian_says(
    shape: Ellipsoid | TriangleMesh, quantile: float, motion_km: list[float]
) -> None:
    body = Body(shape=shape, camera_from_body=TILTED, position_camera_km=np.array([2.0, -1.5, 9.0]))
    limb = trace_silhouette(body, BROWN, CIRCLE, sun_direction_camera=SUN)
    after, before = (
        trace_silhouette(
            body.at(body.position_camera_km + sign * np.array(motion_km)),
            BROWN, CIRCLE, sun_direction_camera=SUN, center_px=limb.center_px,
        ).points_px
        for sign in (1.0, -1.0)
    )  # fmt: skip
    measured = np.einsum("ki,ki->k", limb.normals_px, (after - before) / 2)
    predicted = np.einsum("ki,kij,j->k", limb.normals_px, BROWN.project_jacobian(limb.points_camera_km), motion_km)
    error = np.abs(measured - predicted)
    assert np.abs(predicted).max() > 1000 * SILHOUETTE_PX
    assert np.quantile(error, quantile) < SILHOUETTE_PX


def _from_the_side(shape: TriangleMesh) -> tuple[Body, PinholeModel]:
    """A view along body +y from 1000 km away at 10 px/km; body x is to the right, z up, the origin at (512, 512)."""
    turn = Rotation.from_euler("x", 90.0, degrees=True)
    body = Body(shape=shape, camera_from_body=turn, position_camera_km=np.array([0.0, 0.0, 1000.0]))
    return body, PinholeModel(fx_px=1e4, fy_px=1e4, cx_px=512.0, cy_px=512.0)


def test_the_outermost_edge_is_found_beyond_a_concavity() -> None:
    body, model = _from_the_side(_block_with_tower(half=0.3))
    start = np.array([-30.0, 3.0])  # inside the slab; the line then leaves it, crosses 16 px of sky and the tower
    angle = np.arctan2(-8.0, 30.0)
    limb = trace_silhouette(body, model, [angle, 0.01], sun_direction_camera=[0.0, 0.0, -1.0], center_px=start + 512.0)
    assert limb.valid.all()
    right_of_tower, right_of_slab = 1e4 * 0.3 / 999.7, 1e4 * 4.0 / 996.0
    expected = [
        [right_of_tower, 3.0 + np.tan(angle) * (right_of_tower + 30.0)],
        [right_of_slab, 3.0 + np.tan(0.01) * (right_of_slab + 30.0)],
    ]
    assert_allclose(limb.points_px - 512.0, expected, rtol=0, atol=SILHOUETTE_PX)
    assert_allclose(limb.normals_px, [[1.0, 0.0], [1.0, 0.0]], rtol=0, atol=SILHOUETTE_PX)


def test_edge_points_in_the_shadow_of_another_part_are_not_lit() -> None:
    wall, hut = _box((-4.0, -3.0, -3.0), (-3.0, 3.0, 3.0)), _box((3.0, -1.0, -1.0), (4.0, 1.0, 1.0))
    body, model = _from_the_side(TriangleMesh(np.vstack([wall[0], hut[0]]), np.vstack([wall[1], hut[1] + 8])))
    toward_hut = np.arctan2(-1.0, 3.5)
    lit = {}
    for name, sun in {"behind the wall": [-1.0, -0.05, 0.0], "behind the camera": [0.0, -1.0, 0.0]}.items():
        sun_camera = body.to_camera(_unit(np.array(sun)))
        limb = trace_silhouette(body, model, [toward_hut], sun_direction_camera=sun_camera)
        assert_allclose(limb.points_px[0, 1] - 512.0, -1e4 / 999.0, rtol=0, atol=SILHOUETTE_PX)
        assert limb.cos_incidence[0] > 0
        lit[name] = bool(limb.lit[0])
    assert lit == {"behind the wall": False, "behind the camera": True}


def test_what_the_camera_cannot_image_is_marked_and_the_rest_is_traced() -> None:
    folding = BrownModel(fx_px=1000.0, fy_px=1000.0, cx_px=500.0, cy_px=500.0, k1=-0.4)
    edge_px = 1000.0 * 2.0 / 3.0 / np.sqrt(1.2)  # largest distorted radius, at 1 / sqrt(1.2)
    body = Body(shape=sphere(1.0), camera_from_body=TILTED, position_camera_km=np.array([1.2, 0.0, 2.2]))
    limb = trace_silhouette(body, folding, CIRCLE, sun_direction_camera=SUN)
    assert 40 < limb.valid.sum() < 160
    radii = np.linalg.norm(limb.points_px[limb.valid] - 500.0, axis=1)
    assert radii.max() < edge_px
    assert np.isnan(limb.points_px[~limb.valid]).all()
    assert not limb.lit[~limb.valid].any()
    hidden = trace_silhouette(
        body.at([0.0, 0.0, -5.0]), folding, CIRCLE, sun_direction_camera=SUN, center_px=[500.0, 500.0]
    )
    assert not hidden.valid.any()


# --- a real body ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.real_data
@pytest.mark.parametrize("name", [slow("00000000.png"), "00000002.png"])
def test_vesta_renders_as_dawn_saw_it(data_dir: Path, name: str) -> None:
    folder = data_dir / "bodies" / "dawn_vesta"
    poses = json.loads((folder / "poses.json").read_text())
    camera, pose = poses["camera"], poses["images"][name]
    model = PinholeModel(**{key: camera[key] for key in ("fx_px", "fy_px", "cx_px", "cy_px")})
    w, x, y, z = pose["q_wxyz_camera_from_body"]
    body = Body(
        shape=load_shape(data_dir / "shapes" / "vesta_5002.ply"),
        camera_from_body=Rotation.from_quat([x, y, z, w]),
        position_camera_km=pose["t_body_in_camera_km"],
    )
    sun = body.to_camera(_unit(np.array(pose["sun_body"])))
    template = render(body, model, sun_direction_camera=sun, psf=GaussianPsf(), columns=1024, rows=1024)
    assert isinstance(template, Template)
    assert template.brightness.shape == (1024, 1024)
    image = np.asarray(cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE), dtype=np.float32)
    bands = [
        (gaussian_filter(pixels, 5.0) - gaussian_filter(pixels, 40.0)).astype(np.float32)
        for pixels in (image, template.brightness)
    ]
    surface = cv2.matchTemplate(bands[0], bands[1][30:-30, 30:-30], cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(surface.argmax(), surface.shape)
    assert surface.max() > 0.85
    assert np.hypot(row - 30, column - 30) <= 3.0  # the mesh has facets of 12 px
    limb = trace_silhouette(body, model, CIRCLE, sun_direction_camera=sun)
    inside = np.all((limb.points_px > 12) & (limb.points_px < 1011), axis=1) & limb.lit
    assert limb.valid.all()
    assert inside.sum() >= 8
    contrast = [
        map_coordinates(image, (limb.points_px + side * limb.normals_px)[:, ::-1].T, order=1) for side in (-12.0, 12.0)
    ]
    assert contrast[0][inside].min() > 20 * max(float(contrast[1][inside].max()), 1.0)
