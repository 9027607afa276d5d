"""Classes of sources: movers are no cosmic rays, stars and hot pixels stay, bodies hide and shade."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import giantlike as gl
from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.time import time_from_et
from giantlike.processing.detection.patches import draw_stars
from giantlike.search import ResidualOptions, Residuals, SourceClass, compare_residuals, residual_sources
from tests.simulated import ET, catalog_at, small_camera, sphere_scene

SIZE, SIGMA_PX, GAIN = 128, 0.8, 4.0
UNIT_DN = 2.0 * np.sqrt(np.pi * (SIGMA_PX**2 + 1.0 / 12.0)) * 2.0  # flux of signal-to-noise ratio 1
CAMERA = replace(small_camera(SIZE), detector=gl.Detector(gain_e_per_dn=GAIN, bias_dn=0.0))
STARS = np.array([[20.0, 30.0], [64.4, 100.2], [100.7, 40.1]])
UNCATALOGED = np.array([[50.3, 60.2], [90.0, 90.5]])
MOVER = np.array([[30.2, 80.1], [35.4, 81.2], [40.5, 82.5]])
DRIFT = np.array([[0.0, 0.0], [6.3, -4.2], [-5.1, 7.7]])
HOT, CATALOG = (77, 20), catalog_at(CAMERA, STARS)


def image_of(points: Float, snr: Float, seed: int, k: int = 0, *, hot: bool = True) -> gl.Image:
    """Points through the optics on noise of 2 DN, a hot pixel, and the track of a particle on row 10."""
    random = np.random.default_rng(seed)
    light = draw_stars((SIZE, SIZE), points + DRIFT[k], snr * UNIT_DN, np.full(len(points), SIGMA_PX))
    pixels = random.poisson((light + 20.0) * GAIN) / GAIN + random.normal(0.0, 1.0, light.shape)
    if hot:
        pixels[HOT[1], HOT[0]] += 150.0
        pixels[10, 50 + 9 * k : 57 + 9 * k] += 120.0
    turn = DRIFT[k] / CAMERA.model.focal_length_px
    attitude = Rotation.from_rotvec([-turn[1], turn[0], 0.0])
    return gl.Image(
        pixels=pixels, epoch=time_from_et(ET + 10.0 * k), exposure_s=1.0, camera_from_inertial=attitude, name=f"{k}"
    )


def searched(image: gl.Image, *, scene: gl.Scene | None = None, catalog: bool = True) -> Residuals:
    found = residual_sources(image, CAMERA, None, CATALOG if catalog else None, scene)
    assert isinstance(found, Residuals)
    return found


def kind_at(one: Residuals, point: Float) -> str:
    away = np.linalg.norm(one.points_px - point, axis=1)
    return str(one.kinds[away.argmin()]) if away.min() < 1.0 else "nothing"


@pytest.fixture(scope="module")
def sequence() -> list[Residuals]:
    points = [np.vstack([STARS, UNCATALOGED, MOVER[k : k + 1]]) for k in range(3)]
    snr = np.array([100.0, 60.0, 40.0, 50.0, 20.0, 20.0])
    return [searched(image_of(points[k], snr, k, k)) for k in range(3)]


def test_stars_particles_and_hot_pixels_are_told_from_what_moves(sequence: list[Residuals]) -> None:
    for k, one in enumerate(compare_residuals(sequence)):
        assert [kind_at(one, star + DRIFT[k]) for star in STARS] == [SourceClass.STAR] * 3
        assert [kind_at(one, star + DRIFT[k]) for star in UNCATALOGED] == [SourceClass.UNCATALOGED_STAR] * 2
        assert kind_at(one, MOVER[k] + DRIFT[k]) == SourceClass.UNKNOWN
        assert kind_at(one, np.array(HOT, dtype=float)) == SourceClass.HOT_PIXEL
        particle = (np.abs(one.points_px - [53.0 + 9 * k, 10.0]) < [5.0, 1.5]).all(axis=1)
        assert SourceClass.COSMIC_RAY in one.kinds[particle]
        assert not one.linkable[particle].any()
        moving = np.linalg.norm(one.points_px - MOVER[k] - DRIFT[k], axis=1).argmin()
        assert one.linkable[moving]
        assert one.optics[moving] > 0.5
        assert one.linkable.sum() <= 2


def test_movers_are_no_cosmic_rays() -> None:
    """200 of SNR 12 to 50 at all places in their pixels; of 100 alone one may look like a particle."""
    random, called = np.random.default_rng(7), []
    for seed in range(20):
        grid = np.stack(np.meshgrid(np.arange(15.0, 120.0, 25.0), [20.0, 70.0]), axis=-1).reshape(-1, 2)
        points = grid + random.uniform(-3.0, 3.0, grid.shape)
        one = searched(image_of(points, random.uniform(12.0, 50.0, len(points)), seed, hot=False), catalog=False)
        called += [kind_at(one, point) for point in points]
    assert called.count(SourceClass.UNKNOWN) == len(called)


def test_a_star_that_is_seen_once_beside_its_place_is_unmatched() -> None:
    moved = STARS + np.array([[0.0, 0.0], [0.0, 0.0], [1.8, 0.5]])  # one with an unknown proper motion
    one = searched(image_of(moved, np.full(3, 60.0), 1))
    assert kind_at(one, moved[2]) == SourceClass.CATALOG_STAR_UNMATCHED
    assert not one.linkable[np.linalg.norm(one.points_px - moved[2], axis=1).argmin()]


def test_sources_before_a_body_are_on_its_lit_or_dark_side() -> None:
    scene = sphere_scene(1500.0, 90.0)  # radius 20 px, lit from the right
    points = np.array([[63.5 + 12.0, 63.5], [63.5 - 12.0, 63.5], [63.5 + 60.0, 63.5]])
    one = searched(image_of(points, np.full(3, 50.0), 2, hot=False), scene=scene, catalog=False)
    wanted = [SourceClass.BODY, SourceClass.BODY_DARK_SIDE, SourceClass.UNKNOWN]
    assert [kind_at(one, point) for point in points] == wanted
    assert one.covered[63, 63]
    assert one.body_position_km is not None
    assert np.linalg.norm(one.body_position_km) == pytest.approx(1500.0, abs=1e-6)


def test_a_line_of_light_has_its_half_length() -> None:
    half, steps = np.array([6.0, 2.0]), np.linspace(-1.0, 1.0, 60)[:, None]
    one = searched(image_of(np.array([60.0, 60.0]) + steps * half, np.full(60, 3.0), 3, hot=False), catalog=False)
    streak = np.hypot(*one.halves_px.T).argmax()
    error = one.halves_px[streak] - half
    assert np.linalg.norm(error) < 4.0 * one.half_sigma_px[streak] * np.sqrt(2.0)
    assert np.linalg.norm(one.points_px[streak] - 60.0) < 0.3


def test_images_without_attitude_or_epoch_are_refused() -> None:
    plain = image_of(STARS, np.full(3, 60.0), 1)
    refused = residual_sources(replace(plain, camera_from_inertial=None), CAMERA, None, CATALOG, None)
    assert isinstance(refused, Failure)
    assert refused.reason is Reason.NO_ATTITUDE
    with pytest.raises(InputError, match="epoch"):
        residual_sources(replace(plain, epoch=None), CAMERA, None, CATALOG, None)
    with pytest.raises(InputError, match="max_sources"):
        ResidualOptions(max_sources=100_000)


def test_sequences_of_several_cameras_are_refused(sequence: list[Residuals]) -> None:
    other = replace(sequence[1], camera=replace(CAMERA, name="another"))
    with pytest.raises(InputError, match="one camera"):
        compare_residuals([sequence[0], other])
