"""Levels of detail: the coarsest mesh that a camera cannot tell from the finest."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.camera_models import PinholeModel
from giantlike.core.errors import InputError
from giantlike.ray_tracing import Body, trace_silhouette
from giantlike.shapes import AlbedoMap, Ellipsoid, FacetAlbedo, Shape, TriangleMesh, mesh_from_ellipsoid, sphere
from giantlike.shapes.detail import LevelsOfDetail, facet_size_km, levels_of_detail
from tests.tolerances import SAMPLED

ELLIPSOID = Ellipsoid(radii_km=np.array([1.0, 0.7, 0.6]))
MESHES = tuple(mesh_from_ellipsoid(ELLIPSOID, facets=count) for count in (320, 5120, 81_920))
CIRCLE = np.linspace(0.0, 2.0 * np.pi, 90, endpoint=False) + 0.01


def test_the_coarsest_level_with_facets_below_the_stated_size_is_taken() -> None:
    levels = LevelsOfDetail(meshes=MESHES, facet_px=0.5)
    sizes = levels.facet_sizes_km
    assert_allclose(sizes, [facet_size_km(mesh) for mesh in MESHES], rtol=0, atol=0)
    chosen = {
        scale: levels.for_scale(scale * 2.0) for scale in (1.01 * sizes[0], 0.99 * sizes[0], 0.99 * sizes[1], 0.0)
    }
    assert list(chosen.values()) == [MESHES[0], MESHES[1], MESHES[2], MESHES[2]]


def test_facets_have_the_size_of_equilateral_triangles_of_their_area() -> None:
    tetrahedron = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
    mesh = TriangleMesh(tetrahedron, np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]))
    assert facet_size_km(mesh) == pytest.approx(np.sqrt(8.0))


def test_estimators_are_answered_by_the_finest_level() -> None:
    levels: Shape = LevelsOfDetail(meshes=MESHES)
    assert (levels.mean_radius_km, levels.name) == (MESHES[-1].mean_radius_km, MESHES[-1].name)
    assert levels.circumscribing_radius_km == pytest.approx(1.0, abs=SAMPLED / 2)
    assert_allclose(levels.best_fit_ellipsoid.ellipsoid.radii_km, ELLIPSOID.radii_km, rtol=SAMPLED / 2)
    assert levels.sha256 != LevelsOfDetail(meshes=MESHES[1:]).sha256
    assert levels.sha256 != LevelsOfDetail(meshes=MESHES, facet_px=1.0).sha256
    assert pickle.loads(pickle.dumps(levels)).sha256 == levels.sha256  # noqa: S301


def test_levels_made_from_a_mesh_quarter_its_facets_and_share_its_map() -> None:
    fine = mesh_from_ellipsoid(ELLIPSOID, facets=20_480).with_albedo(AlbedoMap(values=np.array([[0.5, 1.0]])))
    levels = levels_of_detail(fine)
    counts = [len(mesh.faces) for mesh in levels.meshes]
    assert len(counts) == 3
    assert_allclose(counts, [1250, 5000, 20_480], rtol=0.03)
    assert all(mesh.albedo is fine.albedo for mesh in levels.meshes)
    assert levels.finest.sha256 == fine.sha256
    given = levels_of_detail(
        MESHES[1], facets=[300, 1200], simplify=lambda mesh, count: mesh_from_ellipsoid(ELLIPSOID, facets=count)
    )
    assert [len(mesh.faces) for mesh in given.meshes] == [320, 1280, 5120]


def test_a_level_that_would_break_the_surface_is_left_out_unless_it_was_asked_for() -> None:
    def fragile(mesh: TriangleMesh, count: int) -> TriangleMesh:
        if count < 2000 or len(mesh.faces) == 5120:
            raise InputError("it broke")
        return mesh_from_ellipsoid(ELLIPSOID, facets=count)

    levels = levels_of_detail(MESHES[2], simplify=fragile)
    assert [len(mesh.faces) for mesh in levels.meshes] == [5120, 20_480, 81_920]
    with pytest.raises(InputError, match="it broke"):
        levels_of_detail(MESHES[2], facets=[320], simplify=fragile)


@pytest.mark.parametrize("range_km", [30.0, 600.0, 4000.0])
def test_the_level_that_a_camera_gets_has_the_outline_of_the_finest(range_km: float) -> None:
    model = PinholeModel(fx_px=5000.0, fy_px=5000.0, cx_px=500.0, cy_px=500.0)
    levels = LevelsOfDetail(meshes=MESHES)
    chosen = levels.for_scale(range_km / model.fx_px)
    tilted = Rotation.from_euler("xyz", [80.0, 20.0, 30.0], degrees=True)
    outlines = [
        trace_silhouette(
            Body(shape=mesh, camera_from_body=tilted, position_camera_km=[0.0, 0.0, range_km]),  # type: ignore[arg-type]
            model, CIRCLE, sun_direction_camera=[0.0, 0.0, -1.0],
        ).points_px
        for mesh in (chosen, MESHES[-1])
    ]  # fmt: skip
    assert (chosen is MESHES[-1]) == (range_km == 30.0)
    facet_px = facet_size_km(chosen) / range_km * model.fx_px
    radius_px = 0.36 / range_km * model.fx_px  # the sharpest curve of the ellipsoid
    sagitta_px = (2.0 * facet_px) ** 2 / 8 / radius_px  # the longest facets have twice the mean length
    assert_allclose(outlines[0], outlines[1], rtol=0, atol=2.0 * sagitta_px + 1e-12)


@pytest.mark.parametrize(
    ("meshes", "facet_px", "needle"),
    [
        ((), 0.5, "at least one"),
        (MESHES[::-1], 0.5, "coarse to fine"),
        ((mesh_from_ellipsoid(sphere(3.0), facets=20), MESHES[1]), 0.5, "same units"),
        (MESHES, 0.0, "facet_px"),
    ],
)
def test_levels_that_are_none_are_refused(meshes: tuple[TriangleMesh, ...], facet_px: float, needle: str) -> None:
    with pytest.raises(InputError, match=needle):
        LevelsOfDetail(meshes=meshes, facet_px=facet_px)


def test_albedo_by_facet_has_no_coarser_levels() -> None:
    painted = MESHES[0].with_albedo(FacetAlbedo(np.ones(320)))
    with pytest.raises(InputError, match="AlbedoMap"):
        levels_of_detail(painted)
