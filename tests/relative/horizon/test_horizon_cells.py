"""Compiled loops of cells along a horizon beside numpy: pixels by distance to a circle, fits by least squares."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float
from giantlike.relative.horizon.cell_sums import fit_profiles
from giantlike.relative.horizon.geometry import Figure
from giantlike.relative.horizon.pixels import limb_pixels
from giantlike.relative.horizon.profile import HorizonArc, ProfileTable, horizon_arc
from tests.limb_images import CAMERA

ROUNDING = 1e-9  # relative: sums of some hundred terms, solved with a ridge of 1e-12
CIRCLE_PX = 0.02  # a sphere off the axis is an ellipse
DARK_DN2, GAIN = 25.0, 2.0


def sphere_arc(center_px: tuple[float, float]) -> HorizonArc:
    position_km: Float = CAMERA.model.unproject(np.array(center_px)) * 40.0
    arc = horizon_arc(CAMERA.model, Figure(radii_km=np.ones(3), camera_from_axes=Rotation.identity()), position_km)
    assert isinstance(arc, HorizonArc)
    return arc


def test_pixels_of_cells_are_those_within_the_window_of_a_circle() -> None:
    arc, window_px = sphere_arc((200.4, 199.7)), 6.0
    usable = np.ones((400, 400), dtype=bool)
    usable[:, 205] = False
    some = limb_pixels(arc, usable, window_px=window_px, cell_px=9.0, displaced_px=np.zeros(len(arc.points_px)))
    assert some is not None
    middle = arc.points_px.mean(axis=0)
    radius_px = float(np.linalg.norm(arc.points_px - middle, axis=1).mean())
    rows, columns = np.indices(usable.shape)
    distance = np.hypot(columns - middle[0], rows - middle[1]) - radius_px
    found = np.zeros(usable.shape)
    np.add.at(found, (some.rows, some.columns), 1.0)
    surely, never = usable & (np.abs(distance) < window_px - CIRCLE_PX), np.abs(distance) > window_px + CIRCLE_PX
    assert np.all(found[surely] == 1.0)
    assert not found[never].any()
    assert not found[~usable].any()
    assert np.abs(some.outward_px - distance[some.rows, some.columns]).max() < CIRCLE_PX
    along = arc.points_px[some.middles[np.repeat(np.arange(len(some.middles)), np.diff(some.first))]]
    near = np.hypot(some.columns - along[:, 0], some.rows - along[:, 1])
    assert near.max() < window_px + 9.0


def test_a_cell_says_what_least_squares_of_all_its_columns_say() -> None:
    random = np.random.default_rng(4)
    n, powers, mixed = 240, 3, 2
    along, outward = random.uniform(-0.5, 0.5, n), random.uniform(-6.0, 6.0, n)
    edge = 1.0 / (1.0 + np.exp(2.0 * outward))
    value = edge[:, None] * random.uniform(0.2, 1.0, (n, powers + mixed))
    slope, curve = random.normal(size=(2, n, powers)) * edge[:, None]
    data = 2000.0 * value[:, 0] + 300.0 * value[:, 1] + 40.0 + random.normal(size=n) * 20.0
    information, pull, rest = fit_profiles(
        np.array([0, n]), data, along, value, slope, curve, np.inf, DARK_DN2, GAIN, 0.0
    )
    free = powers - 1
    own = np.column_stack([value[:, :free], along * value[:, 0], np.ones(n)])
    weights = 1.0 / (DARK_DN2 + np.maximum(data, 0.0) / GAIN)
    for _ in range(2):
        solution = np.linalg.lstsq(own * np.sqrt(weights)[:, None], data * np.sqrt(weights), rcond=None)[0]
        weights = 1.0 / (DARK_DN2 + np.maximum(own @ solution, 0.0) / GAIN)
    solution = np.linalg.lstsq(own * np.sqrt(weights)[:, None], data * np.sqrt(weights), rcond=None)[0]
    inside = (value[:, :free] @ solution[:free]).max()
    gains = inside / value.max(axis=0)
    shared = np.column_stack(
        [
            -slope[:, :free] @ solution[:free],
            0.5 * curve[:, :free] @ solution[:free],
            value[:, free] * gains[0],
            value[:, free + 1 :] * gains[free + 1 :],
        ]
    )
    root = np.sqrt(weights)[:, None]
    q, _ = np.linalg.qr(own * root)
    across = shared * root - q @ (q.T @ (shared * root))
    expected = across.T @ across
    estimate = np.linalg.lstsq(np.column_stack([own, shared]) * root, data * root[:, 0], rcond=None)[0][own.shape[1] :]
    scale = np.sqrt(np.diagonal(expected))
    assert np.abs((information[0] - expected) / np.outer(scale, scale)).max() < ROUNDING
    assert np.abs((np.linalg.solve(information[0], pull[0]) - estimate) * scale).max() < 1e-6
    left = (
        data
        - np.column_stack([own, shared])
        @ np.linalg.lstsq(np.column_stack([own, shared]) * root, data * root[:, 0], rcond=None)[0]
    )
    freedom = n - own.shape[1] - shared.shape[1]
    assert abs(rest[0, 0] - float(weights @ left**2) / freedom) < 1e-6
    assert abs(rest[1, 0] - gains[0]) < 1e-6 * gains[0]
    assert rest[4, 0] == 1.0


def test_pixels_far_from_the_fit_are_left_out_of_their_cell_alone() -> None:
    random = np.random.default_rng(5)
    n = 200
    value = random.uniform(0.2, 1.0, (2 * n, 2))
    slope, curve = random.normal(size=(2, 2 * n, 2))
    data = 1000.0 * value[:, 0] + random.normal(size=2 * n) * 20.0
    along = random.uniform(-0.5, 0.5, 2 * n)
    first = np.array([0, n, 2 * n])
    clean = fit_profiles(first, data, along, value, slope, curve, 0.2, DARK_DN2, GAIN, 0.0)
    data[3] += 5000.0
    hit = fit_profiles(first, data, along, value, slope, curve, 0.2, DARK_DN2, GAIN, 0.0)
    assert hit[2][4, 0] == (n - 1) / n
    assert hit[2][4, 1] == 1.0
    assert np.array_equal(hit[0][1], clean[0][1])


def test_a_table_is_read_as_cubics_across_and_straight_lines_along_the_horizon() -> None:
    distances = np.arange(-4.0, 4.1, 0.5)

    def cubic(x: Float) -> tuple[Float, Float, Float]:
        return 1.0 - 0.3 * x + 0.05 * x**2 - 0.01 * x**3, -0.3 + 0.1 * x - 0.03 * x**2, 0.1 - 0.06 * x

    at_knots = np.stack([np.stack(cubic(distances), axis=-1) * factor for factor in (1.0, 3.0)])
    table = ProfileTable(knots_px=np.array([10.0, 20.0]), first_px=-4.0, step_px=0.5, values=at_knots, powers=1)
    along, outward = np.array([10.0, 15.0, 20.0, 25.0]), np.array([-3.3, 0.1, 2.77, 3.9])
    factor = np.array([1.0, 2.0, 3.0, 3.0])
    for found, expected in zip(table.at(along, outward), cubic(outward), strict=True):
        assert np.abs(found[:, 0] - factor * expected).max() < 1e-12
