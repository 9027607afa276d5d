"""Named alternatives to a fix and their odds; images by the independent renderer."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.outcomes import Quality
from giantlike.gauntlet.lights import shift_image
from giantlike.image_model.columns import Block, Columns, Prior, Solution
from giantlike.independent import EllipsoidBody, PinholeView, Pose, Psf, ReliefBody, record, render_body
from giantlike.ray_tracing import Body
from giantlike.relative.judge import Alternative, Judgement
from giantlike.relative.verification.alternatives import CellScores, shifted_lines
from giantlike.relative.verification.cells import cells_around
from giantlike.relative.verification.coarse_fit import CoarseFit, fit_cells
from giantlike.shapes import Ellipsoid
from tests.sizes import slow
from tests.sphere_fields import bumps

RADII_KM = np.array([10.0, 8.8, 8.2])
SIZE, FOCAL_PX, MIDDLE = 160, 4000.0, 79.5
POSITION_KM = np.array([0.3, -0.5, 1200.0])  # a radius of 30 px
TURN = Rotation.from_rotvec([0.4, -0.9, 0.3])
CAMERA = Camera(
    name="square",
    columns=SIZE,
    rows=SIZE,
    model=PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=MIDDLE, cy_px=MIDDLE),
    psf=GaussianPsf(sigma_px=0.7),
    detector=Detector(gain_e_per_dn=1.0, read_noise_e=5.0),
)


def sun_at(phase_deg: float) -> Float:
    phase = math.radians(phase_deg)
    return np.array([0.8 * math.sin(phase), 0.6 * math.sin(phase), -math.cos(phase)])


@cache
def light(phase_deg: float, law: str = "mcewen", markings: float = 0.0, relief: float = 0.0, seed: int = 1) -> Float:
    body: EllipsoidBody | ReliefBody = EllipsoidBody(RADII_KM, bumps(seed, rms=markings) if markings else None)
    if relief:
        body = ReliefBody(RADII_KM, bumps(seed, rms=relief, widths_deg=(3.0, 15.0)))
    view = PinholeView(FOCAL_PX, (MIDDLE, MIDDLE), SIZE, SIZE)
    signal: Float = render_body(body, view, Pose(POSITION_KM, TURN, sun_at(phase_deg)), law=law, psf=Psf(0.7))
    return signal


def fitted(signal: Float, phase_deg: float) -> CoarseFit:
    """The body at its right place fitted to an image."""
    pixels_dn = record(signal, np.random.default_rng(1)).pixels - 0.0
    body = Body(shape=Ellipsoid(radii_km=RADII_KM), camera_from_body=TURN, position_camera_km=POSITION_KM)
    good = np.ones(pixels_dn.shape, dtype=bool)
    cells = cells_around(pixels_dn, good, ~good, CAMERA, body)
    assert cells is not None
    trace = cells.trace(body, sun_at(phase_deg))
    assert trace is not None
    own = cells.render(trace)
    assert own is not None
    fit = fit_cells(cells, trace, own, albedo=0.15)
    assert fit is not None
    return fit


def odds(signal: Float, phase_deg: float) -> Mapping[Alternative, float]:
    return fitted(signal, phase_deg).alternatives


def flags(signal: Float, phase_deg: float) -> Quality:
    return Judgement(alternatives=odds(signal, phase_deg)).flags


@pytest.mark.parametrize("phase_deg", [20.0, 60.0, 100.0])
@pytest.mark.parametrize("shift_px", [(13, -15), (-20, 9), (0, 30)])
def test_a_second_exposure_is_a_second_light(phase_deg: float, shift_px: tuple[int, int]) -> None:
    first = light(phase_deg, markings=0.15)
    assert flags(first + 0.3 * shift_image(first, shift_px), phase_deg) == Quality.UNEXPLAINED_LIGHT


@pytest.mark.parametrize("phase_deg", [20.0, 60.0, 100.0])
@pytest.mark.parametrize("shift_px", [(13, -15), (-20, 9), (0, 30)])
def test_one_of_two_equal_exposures_is_no_body_alone(phase_deg: float, shift_px: tuple[int, int]) -> None:
    first = light(phase_deg, markings=0.15)
    fit = fitted(first + shift_image(first, shift_px), phase_deg)
    nothing_there = fit.gain_dn == 0.0
    assert nothing_there or Judgement(alternatives=fit.alternatives).flags == Quality.UNEXPLAINED_LIGHT


@pytest.mark.parametrize("phase_deg", [20.0, 60.0, 100.0])
def test_a_ghost_is_a_second_light(phase_deg: float) -> None:
    """Of a tenth of the light, blurred by 2 px."""
    first = light(phase_deg)
    ghost = gaussian_filter(0.1 * shift_image(first, (22, 17)), 2.0)
    assert flags(first + ghost, phase_deg) == Quality.UNEXPLAINED_LIGHT


def test_a_fainter_second_light_is_less_likely() -> None:
    first = light(60.0)
    seen = [odds(first + share * shift_image(first, (13, -15)), 60.0) for share in (1.0, 0.3, 0.1, 0.03, 0.0)]
    numbers = [one[Alternative.SECOND_LIGHT] for one in seen]
    assert numbers == sorted(numbers, reverse=True)
    assert numbers[-1] < 0.0


@pytest.mark.parametrize("phase_deg", [10.0, 60.0, 110.0])
@pytest.mark.parametrize("law", ["lambert", "hapke", "lommel_seeliger", "minnaert"])
def test_another_law_is_no_alternative(law: str, phase_deg: float) -> None:
    assert max(odds(light(phase_deg, law), phase_deg).values()) < 0.0


@pytest.mark.parametrize(
    ("phase_deg", "seed"),
    [
        (phase_deg, seed) if (phase_deg, seed) in ((20.0, 1),) else slow(phase_deg, seed)
        for phase_deg in (20.0, 60.0, 100.0)
        for seed in (1, 2, 3)
    ],
)
def test_markings_and_relief_are_no_alternatives(phase_deg: float, seed: int) -> None:
    assert flags(light(phase_deg, markings=0.25, seed=seed), phase_deg) == Quality.NONE
    assert flags(light(phase_deg, relief=0.01, seed=seed), phase_deg) == Quality.NONE


@pytest.mark.parametrize("phase_deg", [20.0, 60.0])
def test_a_right_body_speaks_against_every_alternative(phase_deg: float) -> None:
    assert max(odds(light(phase_deg), phase_deg).values()) < 0.0


def scores_of(data: Float, temper: float) -> tuple[CellScores, Float]:
    """Scores of a bell of unknown gain and place fitted to data of unit noise, and its derivative along rows."""
    rows, columns = np.mgrid[: len(data), : len(data)] - 0.5 * (len(data) - 1)
    bell = 20.0 * np.exp(-0.5 * (rows**2 + columns**2) / 8.0**2)
    along_x, along_y = bell * columns / 8.0, bell * rows / 8.0
    blocks = [
        Block(effect=name, cause=Cause.NOISE, matrix=image[None], prior=Prior.of_sigmas([math.inf]))
        for name, image in (("gain", bell), ("x", along_x), ("y", along_y))
    ]
    solution = Columns.from_blocks(blocks, data + bell, np.ones_like(data)).solve()
    assert isinstance(solution, Solution)
    return CellScores(solution=solution, temper=temper), along_x


def test_log_odds_are_those_of_students_t_of_as_many_residuals_as_there_are_parts() -> None:
    """An image that no unknown moves with: closed form, of cells and of a hundredth of them."""
    data, side = np.random.default_rng(4).normal(size=(41, 41)), np.zeros((41, 41))
    side[:, 20:] = 1.0
    seen = data + 0.3 * side
    sigma = 2.0
    for temper in (1.0, 0.01):
        scores, _ = scores_of(seen, temper)
        gain = Block(effect="side", cause=Cause.NOISE, matrix=side[None], prior=Prior.of_sigmas([math.inf]))
        found = scores.solution.score_omitted(gain)
        information, gradient = float(found.information[0, 0]), float(found.gradient[0])
        parts = temper * side.sum()
        before = parts + temper * float(np.sum(side * scores.solution.residuals**2))
        after = before - temper * gradient**2 / (information + sigma**-2)
        occam = 0.5 * math.log1p(temper * information * sigma**2 * 2.0 * parts / before)
        expected = parts * math.log(before / after) - occam
        assert scores.log_odds(side[None], sigma)[0] == pytest.approx(expected, rel=1e-9)


def test_a_lower_temper_makes_every_evidence_weaker() -> None:
    rows = np.arange(41)[:, None]
    data = np.random.default_rng(4).normal(size=(41, 41))
    _, along_x = scores_of(data, 1.0)
    seen = data + 0.4 * np.where(rows > 20, along_x, 0.0)
    found = [shifted_lines(scores_of(seen, temper)[0], along_x, axis=0) for temper in (1.0, 0.1, 0.01)]
    assert found == sorted(found, reverse=True)
    assert found[0] > math.log(1000.0)
    assert shifted_lines(scores_of(data, 1.0)[0], along_x, axis=0) < 0.0


@pytest.mark.parametrize("axis", [0, 1])
def test_lines_shifted_from_one_on_are_found_and_likelier_than_lines_across_them(axis: int) -> None:
    data = np.random.default_rng(5).normal(size=(41, 41))
    rows = np.arange(41)[:, None]
    _, along_x = scores_of(data, 1.0)
    seen = data + 0.5 * np.where(rows > 23, along_x, 0.0)
    motion, seen = (along_x, seen) if axis == 0 else (along_x.T, seen.T)
    scores, _ = scores_of(seen, 1.0)
    along, across = shifted_lines(scores, motion, axis=axis), shifted_lines(scores, motion.T, axis=1 - axis)
    assert along > across + math.log(1000.0)
    assert along > math.log(1000.0)


@pytest.mark.monte_carlo(few=3, full=8)
def test_markings_of_right_bodies_raise_false_alarms_at_most_at_the_rate(draws: int) -> None:
    """The mean of their odds is far below 1, as Markov's inequality wants it."""
    rng = np.random.default_rng(8)
    means = []
    for seed in range(draws):
        phase_deg = float(rng.uniform(0.0, 110.0))
        found = odds(light(phase_deg, markings=float(rng.uniform(0.0, 0.3)), seed=10 + seed), phase_deg)
        means.append(float(np.mean(np.exp([*found.values()]))))
    assert float(np.mean(means)) < 1.0
