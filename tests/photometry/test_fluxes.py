"""Fluxes at known places: against photutils and sep, right on average for stars that nobody sees, errors that hold."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import sep
from numpy.testing import assert_allclose
from photutils.aperture import CircularAperture, aperture_photometry
from scipy.spatial.transform import Rotation

import giantlike as gl
from giantlike.core.arrays import Float
from giantlike.independent.psf import Psf
from giantlike.independent.sky import StarField, star_image
from giantlike.independent.views import PinholeView
from giantlike.photometry import Fluxes, FluxOptions, measure_fluxes
from giantlike.photometry.fluxes import _circle_below
from giantlike.processing.detection.detections import DetectionFlag

SUM, ERROR = 1e-3, 0.05  # what the same aperture of the same frame must agree to
SIZE, FOCAL_PX, GAIN, READ_NOISE_E, SKY = 400, 4000.0, 4.0, 8.0, 50.0
CAMERA = dataclasses.replace(
    gl.Camera.from_fov(float(2.0 * np.degrees(np.arctan(SIZE / 2.0 / FOCAL_PX))), SIZE, SIZE),
    detector=gl.Detector(gain_e_per_dn=GAIN, read_noise_e=READ_NOISE_E, saturation_dn=30_000.0),
    psf=gl.GaussianPsf(sigma_px=0.8),
)


def image_of(places: Float, flux_dn: Float, seed: int, psf: Psf | None = None) -> gl.Image:
    """Stars of known flux at known places, by the independent renderer, with sky and noise."""
    view = PinholeView(columns=SIZE, rows=SIZE, focal_px=FOCAL_PX, center_px=((SIZE - 1) / 2, (SIZE - 1) / 2))
    rays = np.column_stack([(places - (SIZE - 1) / 2) / FOCAL_PX, np.ones(len(places))])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    stars = StarField(rays, -2.5 * np.log10(flux_dn))
    light, found = star_image(stars, view, Rotation.identity(), psf=psf or Psf(0.9), zero_point_dn=1.0)
    assert_allclose(found, places, atol=1e-9)
    random = np.random.default_rng(seed)
    electrons = random.poisson((light + SKY) * GAIN) + random.normal(0.0, READ_NOISE_E, light.shape)
    return gl.Image(pixels=electrons / GAIN, exposure_s=2.0, name="stars")


def measured(*arguments: Any) -> Fluxes:
    fluxes = measure_fluxes(*arguments)
    assert isinstance(fluxes, Fluxes)
    return fluxes


def grid(step: float, random: np.random.Generator) -> Float:
    nodes = np.arange(20.0, SIZE - 20.0, step)
    return np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2) + random.uniform(-0.5, 0.5, (len(nodes) ** 2, 2))


def test_sums_and_errors_of_circles_are_those_of_photutils_and_sep() -> None:
    random = np.random.default_rng(1)
    places = grid(32.0, random)
    image = image_of(places, 10.0 ** random.uniform(3.0, 5.0, len(places)), 2)
    fluxes = measured(image, CAMERA, places, FluxOptions(method="aperture", growth=False))
    noise = np.sqrt(SKY / GAIN + (READ_NOISE_E / GAIN) ** 2)
    above = np.ascontiguousarray(image.pixels - SKY)
    circle = CircularAperture(fluxes.points_px, 3.0)
    error = np.sqrt(noise**2 + np.maximum(above, 0.0) / GAIN)
    table = aperture_photometry(image.pixels, circle, error=error)
    sky = fluxes.level_dn * circle.area
    assert_allclose(fluxes.flux_dn, table["aperture_sum"] - sky, rtol=SUM)
    total, theirs, _ = sep.sum_circle(above, *fluxes.points_px.T.copy(), 3.0, err=float(noise), gain=GAIN, subpix=0)
    assert_allclose(fluxes.flux_dn, total - (sky - SKY * circle.area), rtol=SUM)
    assert_allclose(np.median(fluxes.sigma_dn / table["aperture_sum_err"]), 1.0, atol=ERROR)
    assert_allclose(np.median(fluxes.sigma_dn / theirs), 1.0, atol=ERROR)


@pytest.mark.parametrize("method", ["psf", "aperture"])
def test_faint_and_close_stars_are_right_on_average_and_their_errors_hold(method: Any) -> None:
    """Stars of SNR 0 to 300, of which neighbors 3 px apart are told apart; squared errors by the whole covariance."""
    random = np.random.default_rng(3)
    places = grid(28.0, random)
    places = np.vstack([places, places[::3] + np.array([3.0, 1.0])])
    flux = 10.0 ** random.uniform(0.5, 4.5, len(places))
    scaled, chi2 = [], []
    for seed in range(4):
        fluxes = measured(
            image_of(places, flux, seed, Psf(0.9, wing_share=0.04)), CAMERA, places, FluxOptions(method=method)
        )
        assert abs(fluxes.width_px - 0.9) < 0.05
        away = fluxes.flux_dn - flux
        useful = fluxes.useful & (flux < 3000.0)  # brighter ones have model errors of the wings of their neighbors
        scaled.append((away / fluxes.sigma_dn)[useful])
        chosen = np.flatnonzero(useful)
        covariance = fluxes.covariance_dn2[np.ix_(chosen, chosen)]
        chi2.append(away[chosen] @ np.linalg.solve(covariance, away[chosen]) / len(chosen))
    together = np.concatenate(scaled)
    assert 0.85 < np.sqrt(np.mean(together**2)) < 1.15
    assert abs(together.mean()) < 3.0 / np.sqrt(len(together)) + 0.05
    assert 0.8 < np.mean(chi2) < 1.25


def test_stars_that_share_pixels_share_noise() -> None:
    places = np.array([[100.0, 100.0], [102.3, 100.0], [120.0, 100.0], [300.0, 300.0], [200.0, 200.0]])
    flux = np.array([300.0, 300.0, 300.0, 300.0, 1e5])  # the last one tells the width
    found = [measured(image_of(places, flux, seed), CAMERA, places) for seed in range(100)]
    drawn = np.corrcoef(np.array([each.flux_dn for each in found])[:, :4].T)
    noise = np.mean([each.noise_covariance_dn2 for each in found], axis=0)[:4, :4]
    stated = noise / np.sqrt(np.outer(noise.diagonal(), noise.diagonal()))
    assert stated[0, 1] < -0.15
    assert 0.0 < stated[0, 2] < 0.02  # rings that overlap
    assert stated[0, 3] == 0.0
    assert_allclose(drawn, stated, atol=0.3)  # three sigma of 100 draws
    assert np.linalg.eigvalsh(found[0].covariance_dn2).min() > 0.0


def test_saturated_masked_cut_and_blended_stars_have_their_flags() -> None:
    places = np.array([[60.0, 60.0], [150.0, 60.0], [1.0, 200.0], [250.0, 250.0], [253.0, 250.0], [350.0, 350.0]])
    image = image_of(places, np.array([4e5, 1e4, 1e4, 2e4, 500.0, 1e4]), 4)
    pixels = np.minimum(image.pixels, 30_000.0)
    mask = np.zeros(pixels.shape, bool)
    mask[60, 151] = True
    fluxes = measured(dataclasses.replace(image, pixels=pixels, mask=mask), CAMERA, places)
    kinds = ("SATURATED", "MASKED", "CUT_BY_FRAME", "NONE", "BLENDED", "NONE")
    assert fluxes.flags.tolist() == [DetectionFlag[kind] for kind in kinds]
    assert fluxes.useful.tolist() == [False, False, False, True, False, True]


def test_the_part_of_a_circle_is_exact() -> None:
    random = np.random.default_rng(5)
    points = random.uniform(-1.0, 1.0, (400_000, 2))
    points = points[np.hypot(*points.T) < 1.0]
    for x, y in random.uniform(-1.2, 1.2, (20, 2)):
        share = np.pi * np.mean((points[:, 0] <= x) & (points[:, 1] <= y))
        assert_allclose(_circle_below(np.array(x), np.array(y)), share, atol=0.01)


def test_bad_input_is_refused_by_name() -> None:
    image = gl.Image(pixels=np.random.default_rng(6).normal(9.0, 1.0, (SIZE, SIZE)), exposure_s=1.0, name="dark.fits")
    for other, points, message in (
        (dataclasses.replace(image, exposure_s=0.0), [[5.0, 5.0]], r"dark.fits: .*above 0 s .*got 0.0"),
        (dataclasses.replace(image, exposure_s=None), [[5.0, 5.0]], "got None"),
        (image, [], "no points"),
        (image, [[5.0, np.nan]], r"1 points lie outside.*nan"),
        (image, [[5.0, 5.0], [-9.0, 5.0]], r"1 points lie outside.*-9.0"),
    ):
        with pytest.raises(gl.InputError, match=message):
            measure_fluxes(other, CAMERA, points)
    blank = measure_fluxes(dataclasses.replace(image, pixels=np.ones((SIZE, SIZE))), CAMERA, [[5.0, 5.0]])
    assert isinstance(blank, gl.Failure)
    assert blank.reason is gl.Reason.NO_SIGNAL
    for options in ({"aperture_px": 0.0}, {"annulus_px": (9.0, 8.0)}, {"aperture_px": 10.0}, {"method": "sum"}):
        with pytest.raises(gl.InputError):
            FluxOptions(**options)
