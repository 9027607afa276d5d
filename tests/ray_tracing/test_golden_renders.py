"""Renders against stored ones, and against what a rigid motion, a mirror or energy say they must be.

A golden image fails when the brightness centroid has moved, or when more than a few pixels differ: a shift of 0.1 px or
a Sun off by 1 degree changes the RMS by less than 0.3 % of the peak, so RMS would not see them. Image, golden image and
difference are then saved in the folder of the test. ``python -m tests.ray_tracing.test_golden_renders "reason"
[NAME...]`` renews all or some of them and writes the reason down in ``tests/ray_tracing/golden/reasons.md``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera_models import BrownModel, CameraModel, PinholeModel
from giantlike.core.arrays import Float, unit
from giantlike.core.detector import GaussianPsf
from giantlike.core.frames import rotate
from giantlike.ray_tracing import (
    Akimov,
    Body,
    Hapke,
    Lambert,
    LommelSeeliger,
    McEwen,
    OrenNayar,
    Reflectance,
    RenderOptions,
    Template,
    render,
)
from giantlike.shapes import Ellipsoid, Shape, TriangleMesh, mesh_from_ellipsoid
from tests.tolerances import FIVE_DIGITS

GOLDEN = Path(__file__).parent / "golden"
SIZE_PX = 64
STEPS = 40_000  # of the 16 bits of a golden image for a brightness of 1; 1e-4 of the peak of the faintest
CENTROID_PX = 0.01  # the navigator's gate
PIXEL_OFF = 2e-3  # of the peak
FRACTION_OFF = 1e-3  # 4 pixels; one ray of the 64 in a pixel that falls to the other side of an edge changes one
FLUX = 5e-3  # relative, 256 rays across the body
INVARIANT_PX = 1e-3  # centroid; a ray at an edge may fall to the other side as float32 rounds, 1e-4 px each


def _peanut() -> TriangleMesh:
    """A bilobate body, 2 km long, with hills and a waist that its lobes shade: 9000 facets, by formula alone."""
    latitude = np.pi * (np.arange(1, 48) / 48 - 0.5)
    longitude = 2.0 * np.pi * np.arange(96) / 96
    lat, lon = np.meshgrid(latitude, longitude, indexing="ij")
    directions = np.stack([np.sin(lat), np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon)], axis=-1).reshape(-1, 3)
    directions = np.vstack([directions, [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])
    x, y, z = directions.T
    cos_twice = 2.0 * x**2 - 1.0
    radius = np.sqrt(cos_twice + np.sqrt(1.08**4 - 1.0 + cos_twice**2)) / 1.45
    radius *= 1.0 + 0.05 * np.sin(7.0 * x + 1.0) * np.cos(5.0 * y) + 0.03 * np.sin(9.0 * z + 3.0 * y)
    ring = np.arange(96)
    following = (ring + 1) % 96
    faces = [np.stack([np.full(96, 47 * 96), following, ring], -1)]
    for row in range(46):
        a, b = row * 96 + ring, row * 96 + following
        faces += [np.stack([a, b, b + 96], -1), np.stack([a, b + 96, a + 96], -1)]
    faces += [np.stack([np.full(96, 47 * 96 + 1), 46 * 96 + ring, 46 * 96 + following], -1)]
    return TriangleMesh(directions * radius[:, None], np.vstack(faces))


PEANUT = _peanut()
ELLIPSOID = Ellipsoid(radii_km=np.array([1.0, 0.7, 0.55]))
MESH = mesh_from_ellipsoid(ELLIPSOID, facets=2000)
MIDDLE_PX = (SIZE_PX - 1) / 2
PINHOLE = PinholeModel(fx_px=2.4e4, fy_px=2.4e4, cx_px=MIDDLE_PX, cy_px=MIDDLE_PX)
BROWN = BrownModel(fx_px=60.0, fy_px=61.0, cx_px=24.0, cy_px=28.0, skew_px=0.3, k1=-0.25, k2=0.05, p1=4e-3, p2=-3e-3)
TURN = Rotation.from_euler("xyz", [70.0, 25.0, 40.0], degrees=True)


Three = tuple[float, float, float]


def _three(vector: Float) -> Three:
    x, y, z = (float(value) for value in vector)
    return x, y, z


@dataclass(frozen=True, kw_only=True)
class Case:
    """One render."""

    shape: Shape
    law: Reflectance = field(default_factory=McEwen)
    model: CameraModel = PINHOLE
    turn: Rotation = TURN
    position_km: Three = (0.0, 0.0, 1000.0)
    sun: Three = (0.8, 0.1, -0.6)
    psf: GaussianPsf | None = field(default_factory=lambda: GaussianPsf(sigma_px=0.8))
    rays_per_pixel_side: int = 8

    def rendered(self) -> Template:
        """The template, cut to the frame."""
        body = Body(
            shape=self.shape,
            camera_from_body=self.turn,
            position_camera_km=np.array(self.position_km),
            reflectance=self.law,
        )
        options = RenderOptions(rays_per_pixel_side=self.rays_per_pixel_side)
        sun = unit(np.array(self.sun))
        template = render(
            body, self.model, sun_direction_camera=sun, psf=self.psf, columns=SIZE_PX, rows=SIZE_PX, options=options
        )
        assert isinstance(template, Template)
        return template

    def frame(self) -> Float:
        """Brightness (64, 64)."""
        return self.rendered().placed(SIZE_PX, SIZE_PX)


CASES = {
    "ellipsoid_lambert": Case(shape=ELLIPSOID, law=Lambert()),
    "peanut_shadow_mcewen": Case(shape=PEANUT, sun=(0.97, 0.25, 0.1)),
    "peanut_distorted_hapke": Case(
        shape=PEANUT,
        law=Hapke(w=0.2, b0=1.0, h=0.06, hg1=-0.3, theta_bar_deg=20.0),
        model=BROWN,
        position_km=(0.8, 0.3, 2.6),
        sun=(-0.5, -0.6, -0.6),
    ),
    "peanut_cut_by_the_frame": Case(shape=PEANUT, law=LommelSeeliger(), position_km=(-1.4, 0.9, 1000.0)),
    "ellipsoid_crescent_rough": Case(shape=ELLIPSOID, law=OrenNayar(sigma_deg=25.0), sun=(0.6, -0.4, 0.7)),
    "peanut_of_three_pixels": Case(shape=PEANUT, law=Akimov(), position_km=(12.0, -8.0, 16000.0)),
}


def _centroid(image: Float) -> Float:
    y, x = np.indices(image.shape)
    return np.asarray(np.array([(x * image).sum(), (y * image).sum()]) / image.sum())


def _difference(found: Float, golden: Float) -> tuple[float, float]:
    """Shift of the brightness centroid, px, and fraction of pixels off by more than ``PIXEL_OFF`` of the peak."""
    shift_px = float(np.linalg.norm(_centroid(found) - _centroid(golden)))
    return shift_px, float(np.mean(np.abs(found - golden) > PIXEL_OFF * golden.max()))


def _stored(image: Float) -> NDArray[np.uint16]:
    return np.clip(np.rint(image * STEPS), 0, 65535).astype(np.uint16)


def _golden(name: str) -> Float:
    image = cv2.imread(str(GOLDEN / f"{name}.png"), cv2.IMREAD_UNCHANGED)
    assert image is not None, f"there is no golden image of {name}: see the first lines of this file"
    assert image.dtype == np.uint16
    return np.asarray(image, dtype=np.float64) / STEPS


def _require_equal(found: Float, golden: Float, folder: Path) -> None:
    shift_px, off = _difference(found, golden)
    if shift_px <= CENTROID_PX and off <= FRACTION_OFF:
        return
    images = {"found": found, "golden": golden, "difference": 0.5 + found - golden}
    for name, image in images.items():
        cv2.imwrite(str(folder / f"{name}.png"), _stored(image))
    pytest.fail(f"centroid moved by {shift_px:.4f} px, {off:.2%} of the pixels are off: see the images in {folder}")


@pytest.mark.parametrize("name", CASES)
def test_renders_are_those_that_were_looked_at(name: str, tmp_path: Path) -> None:
    _require_equal(CASES[name].frame(), _golden(name), tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        lambda case: replace(case, position_km=(8e-4, 0.0, 1000.0)),  # 0.02 px
        lambda case: replace(case, sun=_three(rotate(Rotation.from_euler("y", 1.0, degrees=True), case.sun))),
        lambda case: replace(case, law=McEwen(phase_scale_deg=66.0)),
        lambda case: replace(case, psf=GaussianPsf(sigma_px=0.82)),
        lambda case: replace(case, turn=Rotation.from_euler("z", 0.3, degrees=True) * case.turn),
    ],
    ids=["shift", "sun", "law", "psf", "turn"],
)
def test_small_changes_of_a_scene_do_not_pass_as_equal(change: Callable[[Case], Case], tmp_path: Path) -> None:
    case = CASES["peanut_shadow_mcewen"]
    with pytest.raises(pytest.fail.Exception, match="see the images"):
        _require_equal(change(case).frame(), _golden("peanut_shadow_mcewen"), tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"found.png", "golden.png", "difference.png"}


# --- what holds without a stored image ------------------------------------------------------------------------------

SCENE = Case(shape=PEANUT, sun=(0.97, 0.25, 0.1), rays_per_pixel_side=4)
rotations = st.tuples(*[st.floats(-3.0, 3.0)] * 3).map(lambda vector: Rotation.from_rotvec(vector))
offsets = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


def _assert_invariant(found: Float, expected: Float) -> None:
    shift_px, off = _difference(found, expected)
    assert shift_px < INVARIANT_PX
    assert off <= FRACTION_OFF
    assert found.sum() == pytest.approx(expected.sum(), rel=FIVE_DIGITS)


@settings(max_examples=6, deadline=None)
@given(world=rotations, axes=rotations, origin_km=offsets)
def test_a_scene_that_is_moved_as_a_whole_and_described_in_other_axes_looks_the_same(
    world: Rotation, axes: Rotation, origin_km: Float
) -> None:
    expected = SCENE.frame()
    # In the world: camera, body and Sun turn together. In the body: other axes, another origin.
    camera_from_world, world_from_body = world.inv(), world * SCENE.turn
    position_world_km, sun_world = (rotate(world, vector) for vector in (SCENE.position_km, SCENE.sun))
    body_from_new = axes.inv()
    mesh = TriangleMesh(rotate(axes, PEANUT.vertices_km.copy()) + origin_km, PEANUT.faces)
    turn = camera_from_world * world_from_body * body_from_new
    moved = replace(
        SCENE,
        shape=mesh,
        turn=turn,
        position_km=_three(rotate(camera_from_world, position_world_km) - rotate(turn, origin_km)),
        sun=_three(rotate(camera_from_world, sun_world)),
    )
    _assert_invariant(moved.frame(), expected)


def test_a_camera_turned_by_a_quarter_about_its_axis_sees_the_turned_image() -> None:
    quarter = Rotation.from_matrix([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    case = replace(SCENE, position_km=(0.3, -0.2, 1000.0))
    turned = replace(
        case,
        turn=quarter * case.turn,
        position_km=_three(rotate(quarter, case.position_km)),
        sun=_three(rotate(quarter, case.sun)),
    )
    _assert_invariant(turned.frame(), np.rot90(case.frame(), -1))  # x to y: clockwise as rows count down


def test_a_mirrored_body_under_a_mirrored_sun_gives_the_mirrored_image() -> None:
    plain = replace(SCENE, turn=Rotation.identity(), position_km=(0.3, -0.2, 1000.0))
    mirror = np.array([-1.0, 1.0, 1.0])
    mirrored = replace(
        plain,
        shape=TriangleMesh(PEANUT.vertices_km * mirror, PEANUT.faces),
        position_km=_three(mirror * plain.position_km),
        sun=_three(mirror * plain.sun),
    )
    _assert_invariant(mirrored.frame(), plain.frame()[:, ::-1])


@pytest.mark.parametrize("scale", [1e-3, 1e5])
def test_a_scene_of_another_size_looks_the_same(scale: float) -> None:
    mesh = TriangleMesh(PEANUT.vertices_km * scale, PEANUT.faces)
    scaled = replace(SCENE, shape=mesh, position_km=_three(scale * np.array(SCENE.position_km)))
    _assert_invariant(scaled.frame(), SCENE.frame())


@pytest.mark.parametrize("law", [McEwen(), Hapke(w=0.3, theta_bar_deg=25.0)], ids=["mcewen", "hapke"])
def test_a_far_convex_body_gives_the_light_that_its_facets_add_up_to(law: Reflectance) -> None:
    case = replace(SCENE, shape=MESH, law=law)
    to_camera, to_sun = unit(-np.array(case.position_km)), unit(np.array(case.sun))
    normals = rotate(case.turn, MESH.normals.copy())
    mu0, mu = normals @ to_sun, normals @ to_camera
    facets = law(mu0, mu, np.arccos(to_camera @ to_sun)) * np.maximum(mu, 0.0) * MESH.areas_km2
    expected = facets.sum() * (2.4e4 / 1000.0) ** 2
    assert case.frame().sum() == pytest.approx(expected, rel=FLUX)


@settings(max_examples=8, deadline=None)
@given(x=st.floats(-0.5, 0.5), y=st.floats(-0.5, 0.5), distance=st.floats(2.0, 300.0))
def test_the_light_of_a_body_falls_with_the_square_of_its_distance_wherever_in_a_pixel_it_is(
    x: float, y: float, distance: float
) -> None:
    near, far_km = SCENE.frame().sum(), 1000.0 * distance
    position = np.array([x, y, 0.0]) / 2.4e4 * far_km + np.array([0.0, 0.0, far_km])
    far = replace(SCENE, position_km=_three(position)).rendered()
    assert far.brightness.sum() * distance**2 == pytest.approx(near, rel=FLUX)


def _renew(reason: str, names: list[str]) -> None:
    for name in names:
        cv2.imwrite(str(GOLDEN / f"{name}.png"), _stored(CASES[name].frame()))
    with (GOLDEN / "reasons.md").open("a", encoding="utf-8") as file:
        file.write(f"- {', '.join(names)}: {reason}\n")


if __name__ == "__main__":
    if len(sys.argv) < 2 or not sys.argv[1].strip() or not set(sys.argv[2:]) <= set(CASES):
        sys.exit(f'python -m tests.ray_tracing.test_golden_renders "reason" [NAME...]; names are {", ".join(CASES)}')
    _renew(sys.argv[1], sys.argv[2:] or list(CASES))
