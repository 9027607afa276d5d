"""The center of light of ellipsoids in closed form: beside sums over the surface, quadrature of spheres, renders."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float, unit
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.ray_tracing import Body, Lambert, LommelSeeliger, RenderOptions, Template, render
from giantlike.ray_tracing.disk import disk_photocenter
from giantlike.relative.light.phase_correction import ellipsoid_photocenter_km
from giantlike.shapes.base import Ellipsoid, PlacedEllipsoid
from tests.tolerances import SETTLED

SPHERE = PlacedEllipsoid(
    ellipsoid=Ellipsoid(radii_km=np.ones(3)), center_body_km=np.zeros(3), body_from_axes=Rotation.identity()
)
POTATO = PlacedEllipsoid(
    ellipsoid=Ellipsoid(radii_km=np.array([3.0, 2.0, 1.2])),
    center_body_km=np.array([0.1, -0.2, 0.3]),
    body_from_axes=Rotation.from_rotvec([0.4, -0.7, 0.2]),
)
QUADRATURE = 1e-9  # of the radius
SUM = 3e-3  # of a sum over a grid on the surface, cut at limb and terminator, km
RENDER = 3e-3  # of the radius: rays on a grid, and a camera that is a thousand radii away


def directions(phase_deg: float) -> tuple[Float, Float]:
    phase = math.radians(phase_deg)
    return np.array([math.sin(phase), 0.0, math.cos(phase)]), np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("phase_deg", [0.0, 1e-5, 0.5, 30.0, 90.0, 120.0, 150.0, 175.0])
def test_a_sphere_agrees_with_quadrature_at_any_phase(phase_deg: float) -> None:
    sun, observer = directions(phase_deg)
    found = ellipsoid_photocenter_km(SPHERE, sun_direction_body=sun, observer_direction_body=observer)
    expected = float(disk_photocenter(LommelSeeliger(), math.radians(phase_deg)))
    assert_allclose(found[:2], [expected, 0.0], rtol=0, atol=SETTLED if phase_deg < 1e-3 else QUADRATURE)


@pytest.mark.parametrize("phase_deg", [20.0, 90.0, 150.0])
def test_the_quadrature_itself_agrees_with_the_closed_form_of_a_lambert_sphere(phase_deg: float) -> None:
    """Moments of cos(latitude)^2 cos(longitude) cos(longitude - phase) over the lune, integrated by hand."""
    a = math.radians(phase_deg)
    closed = 3.0 * math.pi / 16.0 * math.sin(a) * (1.0 + math.cos(a)) / ((math.pi - a) * math.cos(a) + math.sin(a))
    assert_allclose(float(disk_photocenter(Lambert(), a)), closed, rtol=0, atol=QUADRATURE)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_an_ellipsoid_agrees_with_a_sum_over_its_surface(seed: int) -> None:
    random = np.random.default_rng(seed)
    sun, observer = unit(random.normal(size=3)), unit(random.normal(size=3))
    if float(sun @ observer) < -0.9:  # a crescent thinner than the grid
        sun = -sun
    z, turn = np.meshgrid((np.arange(300) + 0.5) / 150 - 1.0, (np.arange(600) + 0.5) * 2 * np.pi / 600)
    points = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=-1).reshape(-1, 3)
    radii = np.asarray(POTATO.ellipsoid.radii_km)
    to_axes = POTATO.body_from_axes.inv()
    lit, seen = (np.maximum((points / radii) @ rotate(to_axes, vector), 0.0) for vector in (sun, observer))
    light = lit * seen / np.maximum(lit + seen, 1e-12)  # the area of a piece goes with the length of its normal
    mean = (points * radii * light[:, None]).sum(axis=0) / light.sum()
    expected = POTATO.center_body_km + rotate(POTATO.body_from_axes, mean)
    found = ellipsoid_photocenter_km(POTATO, sun_direction_body=sun, observer_direction_body=observer)
    assert_allclose(found, expected, rtol=0, atol=SUM)


@pytest.mark.parametrize("phase_deg", [10.0, 70.0, 130.0])
def test_an_ellipsoid_agrees_with_its_render(phase_deg: float) -> None:
    model = PinholeModel(fx_px=40_000.0, fy_px=40_000.0, cx_px=63.0, cy_px=63.0)
    position, turn = np.array([0.0, 0.0, 3000.0]), Rotation.from_rotvec([0.3, 1.1, -0.5])
    phase = math.radians(phase_deg)
    sun = np.array([0.6 * math.sin(phase), 0.8 * math.sin(phase), -math.cos(phase)])
    template = render(
        Body(shape=POTATO.ellipsoid, camera_from_body=turn, position_camera_km=position, reflectance=LommelSeeliger()),
        model,
        sun_direction_camera=sun,
        columns=127,
        rows=127,
        options=RenderOptions(rays_per_pixel_side=6),
    )
    assert isinstance(template, Template)
    centered = POTATO.ellipsoid.best_fit_ellipsoid
    found = ellipsoid_photocenter_km(
        centered,
        sun_direction_body=rotate(turn.inv(), sun),
        observer_direction_body=rotate(turn.inv(), [0.0, 0.0, -1.0]),
    )
    shift_px = model.project_jacobian(position) @ rotate(turn, found)
    radius_px = 40_000.0 * POTATO.ellipsoid.mean_radius_km / 3000.0
    assert_allclose(template.photocenter_px - template.center_px, shift_px, rtol=0, atol=RENDER * radius_px)


def test_directions_that_are_no_unit_vectors_and_new_phase_are_refused() -> None:
    with pytest.raises(InputError, match="sun_direction_body"):
        ellipsoid_photocenter_km(SPHERE, sun_direction_body=[0, 0, 2], observer_direction_body=[0, 0, 1])
    with pytest.raises(InputError, match="behind"):
        ellipsoid_photocenter_km(SPHERE, sun_direction_body=[0, 0, -1], observer_direction_body=[0, 0, 1])
