"""Photons against published aberration and against symmetry."""

from __future__ import annotations

import numpy as np

from giantlike.independent import Motion, aberrated, apparent_disk, apparent_geometry
from giantlike.independent.light import LIGHT_KM_S

ARCSEC = np.degrees(1.0) * 3600.0


def test_a_star_across_the_motion_of_the_earth_moves_by_the_constant_of_aberration() -> None:
    # kappa = 20.49551 arcsec is the mean speed of 29.7847 km/s over sqrt(1 - e^2), e = 0.016709, over c (IAU 1976).
    speed = 29.7847 / np.sqrt(1.0 - 0.016709**2)
    tilt = aberrated([1.0, 0.0, 0.0], [0.0, speed, 0.0])
    assert abs(np.arctan2(tilt[1], tilt[0]) * ARCSEC - 20.49551) < 1e-4


def test_light_time_is_distance_over_speed_at_the_time_of_leaving() -> None:
    start, velocity = np.array([1e8, 2e7, 0.0]), np.array([0.0, 25.0, 3.0])
    seen, left = apparent_geometry(lambda time: start + velocity * time, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0)
    place = start + velocity * left
    assert abs(np.linalg.norm(place) + LIGHT_KM_S * left) < 1e-4
    np.testing.assert_allclose(seen, place / np.linalg.norm(place), rtol=0, atol=1e-15)


def test_who_moves_with_the_body_sees_it_as_if_both_were_at_rest() -> None:
    # Special relativity: nothing in the common rest frame tells of its motion. The contraction left out is (v/c)^2 / 2.
    position, together = np.array([200_000.0, -80_000.0, 330_000.0]), (20.0, -15.0, 22.0)
    axis, half = apparent_disk(position, 1737.4, Motion(observer_km_s=together, body_km_s=together))
    distance = np.linalg.norm(position)
    assert abs(half / np.arcsin(1737.4 / distance) - 1.0) < 1e-8
    np.testing.assert_allclose(axis, position / distance, rtol=0, atol=1e-8)


def test_the_apparent_size_at_speed_follows_light_time_and_aberration() -> None:
    # Toward a body at rest with b = v / c angles shrink by the Doppler factor, sqrt((1 - b) / (1 + b)).
    position = np.array([0.0, 0.0, 1e6])
    _, half = apparent_disk(position, 100.0, Motion(observer_km_s=(0.0, 0.0, 3000.0)))
    speed = 3000.0 / LIGHT_KM_S
    assert abs(half / np.arcsin(1e-4) / np.sqrt((1 - speed) / (1 + speed)) - 1.0) < 1e-7
