"""Fixed grids of geostationary imagers: places on the Earth where the guides of their data say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.camera_models import SweepXModel, SweepYModel
from giantlike.presets import camera_preset
from tests.numerical import numerical_jacobian

EQUATOR_KM, POLE_KM = 6378.137, 6356.75231414
GOES_KM = 42164.16
"""Distance of the satellite of the fixed grid from the center of the Earth, GOES-R product definition."""
HIMAWARI_KM = 42164.0


def seen_from(distance_km: float, latitude_deg: float, east_deg: float) -> np.ndarray:
    """Camera to a place on the ellipsoid by geodetic latitude and longitude from below the satellite; north is up."""
    geocentric = math.atan((POLE_KM / EQUATOR_KM) ** 2 * math.tan(math.radians(latitude_deg)))
    flat = 1.0 - (POLE_KM / EQUATOR_KM) ** 2
    radius_km = POLE_KM / math.sqrt(1.0 - flat * math.cos(geocentric) ** 2)
    east = math.radians(east_deg)
    return np.array(
        [
            radius_km * math.cos(geocentric) * math.sin(east),
            -radius_km * math.sin(geocentric),
            distance_km - radius_km * math.cos(geocentric) * math.cos(east),
        ]
    )


def test_the_worked_example_of_the_goes_guide_is_met() -> None:
    """33.846162 N, 84.690932 W from 75 W: y 0.095340, x -0.024052 rad."""
    camera = camera_preset("goes_abi_full_disk").camera
    pixel = camera.model.project(seen_from(GOES_KM, 33.846162, -84.690932 + 75.0))
    assert_allclose((pixel - 2711.5) * 56e-6, [-0.024052, -0.095340], rtol=0, atol=1e-6)


def test_himawari_sees_places_as_the_normalized_geostationary_projection_puts_them() -> None:
    camera = camera_preset("himawari_ahi_full_disk").camera
    for latitude_deg, east_deg in ((35.0, -1.0), (-60.0, 40.0), (10.0, 70.0)):
        east, down, forward = seen_from(HIMAWARI_KM, latitude_deg, east_deg)
        x_deg = math.degrees(math.atan(east / forward))
        y_deg = math.degrees(math.asin(down / math.hypot(east, down, forward)))
        columns, lines = (2750.5 + angle * 20466275 / 2**16 for angle in (x_deg, y_deg))  # from 1
        assert_allclose(camera.model.project([east, down, forward]), [columns - 1, lines - 1], rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", [SweepXModel, SweepYModel])
def test_scan_angles_lead_back_to_directions_and_have_their_derivatives(kind: type[SweepXModel]) -> None:
    model = kind(fx_px=700.0, fy_px=600.0, cx_px=500.0, cy_px=400.0, skew_px=3.0)
    rays = np.random.default_rng(4).normal(size=(40, 3)) * [0.6, 0.6, 0.1] + [0.0, 0.0, 1.0]
    assert_allclose(
        model.unproject(model.project(rays)), rays / np.linalg.norm(rays, axis=1)[:, None], rtol=0, atol=1e-14
    )
    for ray in rays[:5]:
        assert_allclose(model.project_jacobian(ray), numerical_jacobian(model.project, ray, 1e-6), rtol=1e-6, atol=1e-5)
    assert np.isnan(model.project([0.1, 0.2, -1.0])).all()
    assert np.isnan(model.unproject([500.0 + 700.0 * 1.6, 400.0])).all()
