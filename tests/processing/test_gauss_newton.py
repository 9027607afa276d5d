"""Fits of stars one by one: the minimum is that of scipy, the covariance that of the information of the pixels."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares
from scipy.stats import norm

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector
from giantlike.processing.detection.centroid import fit_stars
from giantlike.processing.detection.patches import Patches, cut_patches

GAIN, NOISE_DN, PSF_PX, HALF_PX = 4.0, 3.0, 0.9, 4
WIDTH_PRIOR = 0.25  # of ln sigma, by default
SAME_MINIMUM = 0.15  # sigmas: a last step is a third of a sigma at most, and what is left a fifth of it, near enough
SAME_INFORMATION = 0.05  # relative: that before the last step
AT = np.array([12.3, 11.8])


def model(unknowns: Float, shape: tuple[int, int] = (24, 24)) -> Float:
    """Image (rows, columns) of a star on a plane, whose level is that of the middle of the patch around it."""
    x, y, flux, level, log_width, slope_x, slope_y = unknowns
    width = np.exp(log_width)
    rows, columns = (np.arange(n) for n in shape)
    across, down = (norm.cdf(c + 0.5, at, width) - norm.cdf(c - 0.5, at, width) for c, at in ((columns, x), (rows, y)))
    plane = level + slope_x * (columns - 12.0)[None, :] + slope_y * (rows - 12.0)[:, None]
    return np.asarray(flux * np.outer(down, across) + plane)


def patch(image: Float, saturation_dn: float = np.inf) -> Patches:
    detector = Detector(gain_e_per_dn=GAIN, saturation_dn=saturation_dn)
    return cut_patches(image, None, np.array([[12, 12]]), HALF_PX, detector=detector, noise_dn=NOISE_DN)


def expected_fit(image: Float, flux_dn: float) -> tuple[Float, Float]:
    """Unknowns and covariance by scipy, with weights from the model found so far until they stay."""
    part = np.s_[12 - HALF_PX : 13 + HALF_PX, 12 - HALF_PX : 13 + HALF_PX]
    found = np.array([12.0, 12.0, flux_dn, 100.0, np.log(PSF_PX), 0.0, 0.0])
    for _ in range(8):
        sky = np.concatenate([found[:2], [0.0], found[3:]])
        sigma = np.sqrt(NOISE_DN**2 + (model(found) - model(sky))[part] / GAIN)

        def residuals(unknowns: Float, sigma: Float = sigma) -> Float:
            own = ((model(unknowns)[part] - image[part]) / sigma).ravel()
            return np.append(own, (unknowns[4] - np.log(PSF_PX)) / WIDTH_PRIOR)

        result = least_squares(residuals, found, x_scale="jac")
        found, jacobian = result.x, np.asarray(result.jac)
    return found, np.linalg.inv(jacobian.T @ jacobian)


@pytest.mark.parametrize("flux_dn", [400.0, 3000.0, 50_000.0])
def test_a_fit_ends_at_the_minimum_of_scipy_with_the_covariance_of_its_information(flux_dn: float) -> None:
    rng = np.random.default_rng(int(flux_dn))
    truth = np.array([*AT, flux_dn, 100.0, np.log(1.05), 0.4, -0.3])
    light = model(truth) - 100.0
    image = model(truth) + rng.normal(size=light.shape) * np.sqrt(NOISE_DN**2 + np.maximum(light, 0.0) / GAIN)
    fits = fit_stars(patch(image), flux_dn=np.array([0.7 * flux_dn]), psf_sigma_px=PSF_PX)
    unknowns, covariance = expected_fit(image, flux_dn)
    found = np.array(
        [*fits.points_px[0], fits.flux_dn[0], fits.planes[0, 0], np.log(fits.width_px[0]), *fits.planes[0, 1:]]
    )
    assert fits.converged[0]
    assert np.abs((found - unknowns) / np.sqrt(np.diag(covariance))).max() < SAME_MINIMUM
    second_order = 1.0 + 3.0 * covariance[2, 2] / flux_dn**2
    assert_allclose(
        np.diag(fits.covariance_px2[0]) / np.diag(covariance)[:2] / second_order, 1.0, rtol=0, atol=SAME_INFORMATION
    )


def test_saturated_pixels_only_bound_the_light_from_below() -> None:
    truth = np.array([*AT, 40_000.0, 100.0, np.log(PSF_PX), 0.0, 0.0])
    fits = fit_stars(patch(np.minimum(model(truth), 3000.0), 3000.0), flux_dn=np.array([15_000.0]), psf_sigma_px=PSF_PX)
    assert_allclose(fits.points_px[0], AT, rtol=0, atol=3.0 * np.sqrt(fits.covariance_px2[0].max()))
    assert fits.flux_dn[0] > 0.9 * truth[2]


def test_the_light_of_a_fitted_neighbor_is_taken_off() -> None:
    places = np.array([[20.2, 20.1], [24.6, 21.3]])
    image = np.full((45, 45), 50.0)
    for (x, y), flux in zip(places, (9000.0, 2000.0), strict=True):
        image += model(np.array([x, y, flux, 0.0, np.log(PSF_PX), 0.0, 0.0]), image.shape)
    patches = cut_patches(
        image, None, np.rint(places).astype(np.int64), HALF_PX, detector=Detector(gain_e_per_dn=GAIN), noise_dn=0.5
    )
    alone, both = (
        fit_stars(patches, flux_dn=np.array([9000.0, 2000.0]), psf_sigma_px=PSF_PX, isolated=isolated).points_px
        - places
        for isolated in (True, False)
    )
    assert np.abs(both[1]).max() < 0.1 * np.abs(alone[1]).max()


def test_a_star_without_pixels_has_a_finite_covariance_that_says_so() -> None:
    image = np.full((24, 24), 100.0)
    bad = np.ones(image.shape, dtype=bool)
    patches = cut_patches(
        image, bad, np.array([[12, 12]]), HALF_PX, detector=Detector(gain_e_per_dn=GAIN), noise_dn=3.0
    )
    fits = fit_stars(patches, flux_dn=np.array([500.0]), psf_sigma_px=PSF_PX)
    assert not fits.converged[0]
    assert np.isfinite(fits.covariance_px2).all()
    assert fits.covariance_px2[0, 0, 0] > 1e3


def test_without_a_folder_for_machine_code_functions_are_compiled_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    real = numba.njit

    def without_cache(*arguments: Any, cache: bool = False, **options: Any) -> Any:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return real(*arguments, **options)

    monkeypatch.setattr(numba, "njit", without_cache)

    @compiled
    def inverse(value: float) -> float:
        return 1.0 / value

    assert inverse(4.0) == 0.25
    assert inverse(0.0) == np.inf
