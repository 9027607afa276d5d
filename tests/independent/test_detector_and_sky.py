"""Stars, meshes and detectors of the independent truth."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.independent import (
    Defects,
    EllipsoidBody,
    PinholeView,
    Psf,
    Recorder,
    background,
    facet_mesh,
    random_stars,
    record,
    star_image,
)

VIEW = PinholeView(1500.0, (255.5, 250.0), 512, 500, k1=-0.1, p1=1e-3, p2=-2e-3)


def test_distortion_is_undone() -> None:
    pixels = np.random.default_rng(1).uniform(0, 500, size=(50, 2))
    np.testing.assert_allclose(VIEW.project(VIEW.directions(pixels)), pixels, rtol=0, atol=1e-9)


def test_stars_fall_where_the_camera_projects_them_with_all_their_light() -> None:
    stars = random_stars(np.random.default_rng(2), 1, axis=[0.0, 0.0, 1.0], radius_rad=0.05)
    image, places = star_image(stars, VIEW, Rotation.identity(), psf=Psf(0.8, 0.1, 2.5))
    rows, columns = np.indices(image.shape)
    center = np.array([(image * columns).sum(), (image * rows).sum()]) / image.sum()
    np.testing.assert_allclose(center, places[0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(center, VIEW.project(stars.directions[0]), rtol=0, atol=1e-6)
    assert abs(image.sum() / (1e6 * 10 ** (-0.4 * stars.magnitudes[0])) - 1.0) < 1e-6


def test_meshes_are_closed_and_as_large_as_the_body() -> None:
    vertices, facets = EllipsoidBody([3.0, 2.0, 1.0]).mesh(40)
    edges = np.sort(np.concatenate([facets[:, [0, 1]], facets[:, [1, 2]], facets[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    corners = vertices[facets]
    volume = np.linalg.det(corners).sum() / 6.0
    assert abs(volume / (4.0 / 3.0 * np.pi * 6.0) - 1.0) < 1e-3
    assert len(facet_mesh(8)[1]) == 12 * 8**2


def test_noise_has_the_stated_variance_and_bad_pixels_are_told() -> None:
    rng = np.random.default_rng(3)
    signal = background((400, 300), constant_dn=200.0, slope_dn=(50.0, -30.0))
    shot = record(signal, rng, Recorder(gain_e_per_dn=2.0, read_noise_e=6.0, bias_dn=10.0))
    variance = signal / 2.0 + 9.0 + 1.0 / 12.0
    pulls = (shot.pixels - signal - 10.0) / np.sqrt(variance)
    assert abs(pulls.mean()) < 0.015
    assert abs(pulls.var() - 1.0) < 0.02
    struck = record(signal, rng, defects=Defects(dead_columns=(5,), hot_pixels=20, cosmic_rays=5))
    assert struck.bad[:, 5].all()
    assert 400 + 20 < struck.bad.sum() < 700


def test_blooming_keeps_charge_in_its_column() -> None:
    signal = np.full((100, 20), 100.0)
    signal[50, 10] = 8000.0
    recorder = Recorder(read_noise_e=0.0, saturation_dn=1000.0, blooms=True)
    shot = record(signal, np.random.default_rng(5), recorder)
    assert shot.saturated[:, 10].sum() > 5
    assert abs(shot.pixels[:, 10].sum() - 99 * 100.0 - 8000.0) < 500.0
    assert not shot.saturated[:, :10].any()
