"""All stars of real frames by their weight: residuals as large as their sigmas say, whatever the brightness."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from giantlike.calibration.star_images import calibrate_stars, identify_first
from giantlike.camera import Camera
from giantlike.catalogs import load_catalog
from giantlike.core.arrays import Float
from giantlike.core.statistics import error_terms
from giantlike.image import Image
from giantlike.stars import StarNavigation

FRAMES = Path(__file__).resolve().parents[3] / "shared" / "data" / "stars" / "tetra3"
NORMALIZED = (0.8, 1.25)  # of each quarter of brightness, 190 stars each: 0.04 of it is chance
BRIGHT_STARS = 150  # of these frames have a signal to noise ratio of 20: all that was used before


def _drawn(rng: np.random.Generator, factor: float, floor: float) -> tuple[Float, Float]:
    """Residuals (n, 2) of 300 stars of all brightnesses, and the covariances that their noise alone promises."""
    sigma = 0.03 * 10.0 ** rng.uniform(0.0, 1.0, 300)
    errors = np.hypot(factor * sigma, floor)[:, None] * rng.normal(size=(300, 2))
    return errors, sigma[:, None, None] ** 2 * np.eye(2)


@pytest.mark.parametrize(("factor", "floor"), [(1.0, 0.08), (1.4, 0.08), (1.8, 0.0)])
def test_a_factor_and_a_floor_are_told_apart_by_stars_of_all_brightnesses(factor: float, floor: float) -> None:
    rng = np.random.default_rng(6)
    found = np.array([error_terms(*_drawn(rng, factor, floor), freedom=600) for _ in range(30)])
    assert abs(found[:, 0].mean() - factor) < 0.05
    assert abs(np.sqrt(np.mean(found[:, 1] ** 2)) - floor) < 0.02


@pytest.mark.slow
@pytest.mark.skipif(not FRAMES.is_dir(), reason="the real frames of ../shared/data are not here")
def test_each_quarter_of_brightness_of_real_frames_has_the_residuals_that_its_sigmas_promise() -> None:
    images = [Image.open(path) for path in sorted(FRAMES.glob("*.tiff"))[1::2]]
    camera = Camera.from_fov(11.4, images[0].columns, images[0].rows)
    navigation = StarNavigation(camera, load_catalog("default"))
    stars = [identify_first(image, camera, navigation, scale_error=0.1).unwrap() for image in images]
    result = calibrate_stars(stars, camera, estimate=("fx_px", "fy_px", "k1", "p1", "p2")).unwrap().result
    assert result.accepted
    assert result.n_used > 4 * BRIGHT_STARS
    used = result.used
    squares = np.sum(result.residuals_px[used] ** 2, axis=1) / result.sigma_px[used] ** 2 / 2.0
    quarters = np.array_split(squares[np.argsort(result.magnitudes[used])], 4)
    normalized = [float(np.sqrt(quarter.mean())) for quarter in quarters]
    assert all(NORMALIZED[0] < value < NORMALIZED[1] for value in normalized), normalized
