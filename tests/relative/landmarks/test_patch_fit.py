"""The fit of a landmark to its pixels: exact where the image is what the fit takes it to be."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.polynomial.polynomial import polyder, polyval2d
from numpy.testing import assert_allclose

from giantlike.core.arrays import Float
from giantlike.core.pixel_box import BoxPixels, PixelBox
from giantlike.relative.landmarks.matching import LandmarkMatch, fit_patch
from giantlike.relative.landmarks.rendering import Patch

SIZE, CORNER = 26, (11, 7)
LIGHT = np.array([[1.0, 0.02, 4e-3, -2e-4], [0.03, -2e-3, 1e-4, 0.0], [-3e-3, 2e-4, 0.0, 0.0], [1e-4, 0.0, 0.0, 0.0]])
OTHER = np.array([[0.9, -0.03, 2e-3, 1e-4], [0.01, 3e-3, -1e-4, 0.0], [2e-3, 1e-4, 0.0, 0.0], [-2e-4, 0.0, 0.0, 0.0]])
MOTION_PX, GAINS = np.array([0.21, -0.34]), (900.0, 12.0, -7.0, 40.0, 250.0)
LEFT_PX, LEFT = 1e-3, 2e-2
"""What three rounds leave, px and of the covariance; derivatives of fourth order are exact for these polynomials."""
READ_NOISE_DN2 = 25.0


def scene(light: Float, motion_px: Float) -> Float:
    """Values of a polynomial (x, y), moved by a little along its derivatives."""
    grid = np.arange(SIZE) - 0.5 * (SIZE - 1)
    x, y = np.meshgrid(grid, grid)
    by_x, by_y = (polyval2d(x, y, polyder(light, axis=axis)) for axis in (0, 1))
    return np.asarray(polyval2d(x, y, light) - motion_px[0] * by_x - motion_px[1] * by_y)


def sloped(light: Float) -> Float:
    """Coefficients of a polynomial times the gains of the light."""
    result = np.zeros((5, 5))
    result[:4, :4] += GAINS[0] * light
    result[1:, :4] += GAINS[1] * light
    result[:4, 1:] += GAINS[2] * light
    return result


@pytest.mark.parametrize("two_laws", [False, True])
def test_a_fit_finds_motion_and_covariance_of_an_image_that_is_its_model(two_laws: bool) -> None:
    mask = np.zeros((SIZE, SIZE), dtype=bool)
    mask[3:-3, 3:-3] = True
    image = np.zeros((60, 60))
    inside = np.s_[CORNER[1] : CORNER[1] + SIZE, CORNER[0] : CORNER[0] + SIZE]
    image[inside] = scene(sloped(LIGHT), MOTION_PX) + GAINS[3]
    if two_laws:
        image[inside] += GAINS[4] * scene(OTHER, MOTION_PX)
    pixels = BoxPixels(
        values_dn=image,
        usable=np.ones(image.shape, dtype=bool),
        censored=None,
        noise_variance_dn2=lambda signal: np.full_like(signal, READ_NOISE_DN2),
    )
    patch = Patch(
        number=3,
        box=PixelBox(x=CORNER[0], y=CORNER[1], width=SIZE, height=SIZE),
        light=scene(LIGHT, np.zeros(2)),
        other=scene(OTHER, np.zeros(2)) if two_laws else None,
        mask=mask,
        whole=False,
    )
    match = fit_patch(pixels, patch, np.zeros(2, np.int64), 0.9)
    assert isinstance(match, LandmarkMatch)
    assert_allclose(match.offset_px, MOTION_PX, rtol=0, atol=LEFT_PX)
    # The same by a dense matrix of analytic columns.
    grid = np.arange(SIZE) - 0.5 * (SIZE - 1)
    x, y = (each[mask] for each in np.meshgrid(grid, grid))
    values = [polyval2d(x, y, LIGHT), x * polyval2d(x, y, LIGHT), y * polyval2d(x, y, LIGHT), np.ones_like(x)]
    by_x, by_y = (polyval2d(x, y, polyder(sloped(LIGHT), axis=axis)) for axis in (0, 1))
    if two_laws:
        values.append(polyval2d(x, y, OTHER))
        by_x, by_y = (
            slope + GAINS[4] * polyval2d(x, y, polyder(OTHER, axis=axis)) for axis, slope in enumerate((by_x, by_y))
        )
    design = np.stack([by_x, by_y, *values], axis=1)
    expected = READ_NOISE_DN2 * np.linalg.inv(design.T @ design)[:2, :2]
    assert_allclose(match.covariance_px2, expected, rtol=LEFT, atol=0)
