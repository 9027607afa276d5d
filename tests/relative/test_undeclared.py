"""What residuals of a template ask for: another figure or a second exposure, but no markings and no other law."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from giantlike.core.causes import Cause
from giantlike.core.outcomes import CenterFix, Quality
from giantlike.ephemeris import ApparentGeometry
from giantlike.gauntlet.stage import stage_of
from giantlike.image_model.columns import Block, Columns, Prior
from giantlike.relative import CrossCorrelation

from giantlike.relative.template.covariance import LinearFit
from giantlike.scene import Scene, TargetUncertainty
from tests.relative.test_light_truth import Shot, shot

DIAMETER_PX, PHASE_DEG = 90.0, 50.0
NOISE_DN = 2.0
SIGMAS = 4.0


def told(one: Shot, turn_deg: float, uncertainty: TargetUncertainty | None = None) -> Shot:
    """The same image of a body whose orientation is told wrong."""
    target = one.scene.targets[0]
    ephemeris = target.ephemeris
    assert isinstance(ephemeris, ApparentGeometry)
    turned = Rotation.from_rotvec([math.radians(turn_deg), 0.0, 0.0]) * ephemeris.inertial_from_body
    wrong = replace(ephemeris, inertial_from_body=turned)
    target = replace(target, ephemeris=wrong, uncertainty=uncertainty or TargetUncertainty())
    return replace(one, scene=Scene(targets=(target,)))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_pole_told_4_degrees_off_is_another_figure_unless_declared(seed: int) -> None:
    one = shot(seed, phase_deg=PHASE_DEG, diameter_px=DIAMETER_PX)
    assert not one.fix(CrossCorrelation()).flags.suspect
    assert Quality.WRONG_FIGURE in told(one, 4.0).fix(CrossCorrelation()).flags
    declared = TargetUncertainty(pole_rad=0.07, spin_rad=0.07)
    assert Quality.WRONG_FIGURE not in told(one, 4.0, declared).fix(CrossCorrelation()).flags


@pytest.mark.parametrize(("sigma_rad", "wrong"), [(None, False), (0.02, False), (1e-5, True)])
def test_a_roll_of_the_camera_is_another_figure_only_where_the_attitude_is_known_better(
    sigma_rad: float | None, wrong: bool
) -> None:
    one = shot(6, phase_deg=PHASE_DEG, diameter_px=DIAMETER_PX)
    known = None if sigma_rad is None else sigma_rad**2 * np.eye(3)
    rolled = Rotation.from_rotvec([0.0, 0.0, math.radians(0.3)])
    image = replace(one.image, camera_from_inertial=rolled, attitude_covariance_rad2=known)
    fix = replace(one, image=image).fix(CrossCorrelation())
    assert (Quality.WRONG_FIGURE in fix.flags) is wrong, fix.findings


@pytest.mark.parametrize(("law", "marked"), [("mcewen", True), ("lambert", False), ("hapke", True)])
def test_markings_and_other_laws_are_no_other_figure_and_no_smear(law: str, marked: bool) -> None:
    for seed in (4, 5):
        fix = shot(seed, law=law, phase_deg=PHASE_DEG, diameter_px=DIAMETER_PX, marked=marked).fix(CrossCorrelation())
        assert not fix.flags & (Quality.WRONG_FIGURE | Quality.BLURRED)


def test_two_exposures_that_an_even_motion_does_not_explain_are_a_blur() -> None:
    """6 px apart, 0.9 as bright: the fix lies between them, 3.4 px and 7 of its sigmas off, where nothing objects."""
    stage = stage_of(9502, 789)
    assert stage.scene is not None
    fix = CrossCorrelation().estimate(stage.image, stage.camera, stage.scene)
    assert isinstance(fix, CenterFix)
    assert Quality.BLURRED in fix.flags


def test_a_strain_is_found_beside_the_parameters_of_a_fit_with_what_it_moves() -> None:
    rng = np.random.default_rng(1)
    y, x = np.mgrid[-20:21, -20:21] / 8.0
    spot = 1000.0 * np.exp(-0.5 * (x**2 + y**2)) * (1.0 + 0.5 * x)
    by_y, by_x = np.gradient(spot)
    columns = np.stack([-by_x, -by_y, spot * (x**2 + y**2), np.zeros_like(x) + 1.0, spot])
    changes = np.stack([by_x * y, by_y * x, by_x * x - by_y * y]) * 8.0
    strain = np.array([0.01, -0.02, 0.015])
    noise = np.full(x.shape, NOISE_DN**2)
    image = np.tensordot(strain, changes, 1) + rng.normal(0.0, NOISE_DN, x.shape)
    flat = columns.reshape(len(columns), -1).T
    without = np.linalg.lstsq(flat, image.ravel(), rcond=None)[0]
    both = np.concatenate([flat, changes.reshape(3, -1).T], axis=1)
    found = np.linalg.lstsq(both, image.ravel(), rcond=None)[0]
    blocks = [
        Block(effect=effect, cause=Cause.NOISE, matrix=part, prior=Prior.of_sigmas([math.inf] * len(part)))
        for effect, part in (("center", columns[:2]), ("range", columns[2:3]), ("light", columns[3:]))
    ]
    fit = LinearFit(Columns.of(blocks, image, 1.0 / noise), without)
    asked = asked_beside(
        fit,
        strain=changes,
        smear=None,
        considered=None,
        radius_px=11.0,
        noise=noise,
        error=np.zeros_like(x),
        blur_px=0.8,
        block_px=4,
    )
    np.testing.assert_allclose(asked.strain, found[5:], rtol=0, atol=1e-4)
    np.testing.assert_allclose(asked.moved, found[:3] - without[:3], rtol=0, atol=1e-3)
    sigmas = np.abs(asked.strain - strain) / np.sqrt(np.diag(asked.strain_covariance))
    assert sigmas.max() < SIGMAS
    assert asked.strain_chance(np.zeros((3, 3))) < 1e-6 < asked.strain_chance(0.01 * np.eye(3))
