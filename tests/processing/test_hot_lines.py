"""Hot rows and columns: found in front of a body and beside it, and nothing that optics draw is taken for one."""

from __future__ import annotations

import numpy as np
import pytest

from giantlike.core.arrays import Float
from giantlike.independent import record
from giantlike.processing.detection.frame_lines import FrameLines
from giantlike.processing.detection.hot_lines import hot_lines
from tests.processing.test_dead_lines import NOISE_DN, RECORDER, SIZE, signal

FAINT_DN = 150.0  # beside a brighter one


def seen(light: Float, seed: int = 1) -> Float:
    return np.asarray(record(light, np.random.default_rng(seed), RECORDER).pixels, dtype=float)


def test_hot_lines_are_found_over_half_of_the_frame_alone_and_in_pairs() -> None:
    image = seen(signal((0.2, 0.1, -1.0)))
    image[:, 40] += 400.0
    image[SIZE // 2 :, 60:62] += [FAINT_DN, 200.0]
    image[50] += 100.0
    found = hot_lines(FrameLines.from_frame(image, 0.0), noise_dn=NOISE_DN)
    assert found is not None
    assert np.flatnonzero(found.all(axis=0)).tolist() == [40, 60, 61]
    assert np.flatnonzero(found.all(axis=1)).tolist() == [50]


@pytest.mark.parametrize("width_px", [0.5, 0.7, 1.5])
def test_a_line_through_the_optics_is_no_hot_line(width_px: float) -> None:
    away = np.arange(SIZE) - 47.0
    drawn = 1000.0 * np.exp(-0.5 * (away / width_px) ** 2) * np.ones((SIZE, 1))
    for light in (drawn, drawn.T, drawn + signal((0.2, 0.1, -1.0))):
        assert hot_lines(FrameLines.from_frame(seen(light), 0.0), noise_dn=NOISE_DN) is None


def test_bodies_stars_noise_and_rows_that_all_differ_are_no_hot_lines() -> None:
    rng = np.random.default_rng(5)
    stars = np.zeros((SIZE, SIZE))
    stars[rng.integers(0, SIZE, 40), rng.integers(0, SIZE, 40)] = 5000.0
    striped = np.where(np.arange(SIZE)[:, None] % 4 == 0, 50.0, 0.0) * np.ones(SIZE)
    lights = (signal((0.2, 0.1, -1.0)), signal((1.0, 0.0, 6.0), psf_px=0.4), stars, striped, np.zeros((SIZE, SIZE)))
    for number, light in enumerate(lights):
        assert hot_lines(FrameLines.from_frame(seen(light, number), 0.0), noise_dn=NOISE_DN) is None
