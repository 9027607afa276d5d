"""Effects that nobody declared: probable where they are, improbable beside markings and other laws."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.outcomes import CenterFix, Quality
from giantlike.ephemeris import ApparentGeometry
from giantlike.image_model.columns import UNDECLARED, Block, Columns, Prior
from giantlike.relative import CrossCorrelation
from giantlike.relative.template.covariance import LinearFit
from giantlike.relative.template.undeclared import undeclared_effects
from giantlike.scene import Scene, TargetUncertainty
from tests.relative.light.test_light_truth import Shot, shot
from tests.sizes import slow

DIAMETER_PX, PHASE_DEG = 90.0, 50.0
NOISE_DN = 2.0


def told(one: Shot, turn_deg: float, uncertainty: TargetUncertainty | None = None) -> Shot:
    """The same image of a body whose orientation is told wrong."""
    target = one.scene.targets[0]
    ephemeris = target.ephemeris
    assert isinstance(ephemeris, ApparentGeometry)
    turned = Rotation.from_rotvec([math.radians(turn_deg), 0.0, 0.0]) * ephemeris.inertial_from_body
    wrong = replace(ephemeris, inertial_from_body=turned)
    target = replace(target, ephemeris=wrong, uncertainty=uncertainty or TargetUncertainty())
    return replace(one, scene=Scene(targets=(target,)))


@pytest.mark.parametrize("seed", [1, slow(2), slow(3)])
def test_a_pole_told_4_degrees_off_is_a_larger_error_declared_or_not(seed: int) -> None:
    one = shot(seed, phase_deg=PHASE_DEG, diameter_px=DIAMETER_PX)
    right = one.fix(CrossCorrelation())
    declared = TargetUncertainty(pole_rad=0.07, spin_rad=0.07)
    for wrong in (told(one, 4.0), told(one, 4.0, declared)):
        fix = wrong.fix(CrossCorrelation())
        assert sigmas_off(fix, one) < 3.0
        assert np.trace(fix.covariance_px2) > np.trace(right.covariance_px2)


def sigmas_off(fix: CenterFix, one: Shot) -> float:
    """Error of a center, in standard deviations."""
    error = fix.center_px - one.center_px
    return math.sqrt(error @ np.linalg.solve(fix.covariance_px2, error))


@pytest.mark.parametrize(("law", "marked"), [("mcewen", True), slow("lambert", False), slow("hapke", True)])
def test_markings_and_other_laws_are_no_other_figure_and_no_smear(law: str, marked: bool) -> None:
    for seed in (4, 5):
        fix = shot(seed, law=law, phase_deg=PHASE_DEG, diameter_px=DIAMETER_PX, marked=marked).fix(CrossCorrelation())
        assert not fix.flags & (Quality.WRONG_FIGURE | Quality.BLURRED)


def normal_columns(seed: int, strain: Float) -> tuple[LinearFit, Block]:
    """A spot fitted in place, size and light to an image that is strained, and the strain that the fit leaves out."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[-20:21, -20:21] / 8.0
    spot = 1000.0 * np.exp(-0.5 * (x**2 + y**2)) * (1.0 + 0.5 * x)
    by_y, by_x = np.gradient(spot)
    columns = np.stack([-by_x, -by_y, spot * (x**2 + y**2), np.zeros_like(x) + 1.0, spot])
    changes = np.stack([by_x * y, by_y * x, by_x * x - by_y * y]) * 8.0
    image = np.tensordot(strain, changes, 1) + rng.normal(0.0, NOISE_DN, x.shape)
    blocks = [
        Block(effect=effect, cause=Cause.NOISE, matrix=part, prior=Prior.of_sigmas([math.inf] * len(part)))
        for effect, part in (("center", columns[:2]), ("range", columns[2:3]), ("light", columns[3:]))
    ]
    model = Columns.from_blocks(blocks, image, np.full(x.shape, NOISE_DN**-2.0))
    solution = model.solve()
    assert solution is not None
    left_out = Block(effect="strain", cause=Cause.RELIEF, matrix=changes, prior=Prior.of_sigmas([0.02] * 3))
    return LinearFit(model, solution.values), left_out


def test_a_strain_is_probable_where_it_is_and_adds_how_far_it_moves_the_place() -> None:
    fit, block = normal_columns(1, np.array([0.01, -0.02, 0.015]))
    found = undeclared_effects(fit, {block: float(fit.residuals.size)})["strain"]
    assert found.chance > 0.999
    beside = fit.columns.extend([block]).solve()
    assert beside is not None
    moved = (beside.values - np.append(fit.values, np.zeros(3)))[:5]
    np.testing.assert_allclose(found.score.step, moved, rtol=0, atol=1e-6)
    assert np.all(np.diag(found.covariance) >= found.chance * moved**2)


def test_where_there_is_no_strain_it_is_improbable_and_adds_little() -> None:
    chances = list[float]()
    for seed in range(20):
        fit, block = normal_columns(seed, np.zeros(3))
        found = undeclared_effects(fit, {block: float(fit.residuals.size)})["strain"]
        chances.append(found.chance)
    assert np.mean(chances) < UNDECLARED


def test_the_fewer_independent_parts_pixels_stand_for_the_less_is_known_of_an_effect() -> None:
    fit, block = normal_columns(1, np.array([0.01, -0.02, 0.015]))
    chances = [undeclared_effects(fit, {block: parts})["strain"].chance for parts in (2.0, 8.0, 32.0)]
    assert chances[0] < UNDECLARED
    assert np.all(np.diff(chances) > 0.0)
