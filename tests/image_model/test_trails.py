"""Charge-transfer trails as changes of images and profiles."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.core.arrays import Float
from giantlike.core.findings import Trails
from giantlike.image_model.trails import LENGTHS_PX, trails_of_image, trails_of_lines

LIGHT: Float = np.pad(np.random.default_rng(3).uniform(1.0, 2.0, (12, 9)), [(60, 60), (60, 60)])


def late(image: Float, length: float) -> Float:
    """Image (h, w) all of whose charge arrives late toward higher columns, with a decay length in pixels."""
    delays = np.exp(-np.arange(400) / length)
    return np.stack([np.convolve(row, delays / delays.sum())[: row.size] for row in image])


def test_trails_of_known_directions_are_charge_that_arrives_late() -> None:
    block = trails_of_image(LIGHT, 1, Trails(along_rows=0.01, along_columns=-0.02))
    short, long = LENGTHS_PX
    expected = [late(LIGHT, short), late(LIGHT, long), *(late(LIGHT.T[:, ::-1], one)[:, ::-1].T for one in LENGTHS_PX)]
    assert_allclose(block.matrix, np.stack(expected) - LIGHT, atol=1e-9)


def test_trails_of_unknown_directions_are_odd_and_move_light_by_their_share_of_the_length() -> None:
    along_rows, along_columns = trails_of_image(LIGHT, 1).matrix
    assert_allclose(along_rows[:, ::-1], -trails_of_image(LIGHT[:, ::-1], 1).matrix[0], atol=1e-12)
    moved = float(np.sum(along_columns * np.arange(len(LIGHT))[:, None]) / LIGHT.sum())
    mean_delay = 1.0 / (np.exp(1.0 / LENGTHS_PX[-1]) - 1.0)
    assert moved == pytest.approx(mean_delay, rel=0.01)


def test_trails_of_lines_are_those_of_a_straight_edge() -> None:
    offsets = np.arange(-150.0, 40.5, 0.5)
    profile = np.clip(0.5 - offsets, 0.0, 1.0)[None]
    normals = np.array([[-1.0, 0.0]])
    along_rows, along_columns = trails_of_lines(profile, normals, 0.5)
    # outward is toward lower columns: charge is late inside the body, so that it lacks outside
    assert along_rows[0, 302] < 0.0
    assert_allclose(along_columns, 0.0, atol=1e-12)
    fine = 0.5 * (late(profile[:, ::-1], 2.0 * LENGTHS_PX[-1])[0, ::-1] - late(profile, 2.0 * LENGTHS_PX[-1])[0])
    assert_allclose(along_rows[0, 220:], fine[220:], atol=1e-5)
