"""Real images of planets, moons and asteroids: what must hold whatever the estimators' finer errors."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from giantlike.core.outcomes import CenterFix, Failure, PositionFix, Quality, Reason
from giantlike.relative import (
    EllipseFit,
    EllipseFitOptions,
    EllipsoidCRA,
    EllipsoidCRAOptions,
    Estimator,
    LimbMatching,
    Moment,
    MomentOptions,
)

pytestmark = pytest.mark.real_data

RINGS_WOULD_BE_OFF = 0.05  # of the range: the A ring reaches to 2.3 radii, the gap between B and C to 1.5
TRAJECTORY = 0.02  # predicted, a percent or so, and the height of a hazy limb
SIGMAS = 5.0


@pytest.fixture(scope="module")
def cases() -> Iterator[Any]:
    """The module of the examples that sets the cases up."""
    folder = str(Path(__file__).resolve().parents[2] / "examples")
    sys.path.insert(0, folder)
    yield import_module("real_body_cases")
    sys.path.remove(folder)


def limb_estimators(search_px: float) -> tuple[Estimator, ...]:
    return (
        EllipsoidCRA(EllipsoidCRAOptions(search_px=search_px)),
        EllipseFit(EllipseFitOptions(search_px=search_px)),
    )


@pytest.mark.slow
def test_rings_before_and_behind_saturn_are_not_taken_for_its_limb(cases: Any, data_dir: Path) -> None:
    corrected, raw, rings = cases.voyager(data_dir)
    for case in (corrected, raw):
        for estimator in limb_estimators(150.0):
            fix = estimator.estimate(case.image, case.camera, case.scene)
            assert isinstance(fix, PositionFix), fix
            assert abs(fix.range_km / case.range_km - 1.0) < RINGS_WOULD_BE_OFF
            assert not fix.flags.suspect, fix.flags  # rings are told, and no light that nothing explains
    for estimator in (*limb_estimators(40.0), LimbMatching(), Moment()):
        refused = estimator.estimate(rings.image, rings.camera, rings.scene)
        assert isinstance(refused, Failure), refused
        assert refused.reason in (Reason.NO_LIMB, Reason.NO_SIGNAL, Reason.OUT_OF_FRAME)


def test_saturn_whose_rings_reach_the_edge_of_the_image_has_no_center_of_brightness(cases: Any, data_dir: Path) -> None:
    case = next(iter(cases.voyager(data_dir)))
    refused = Moment(MomentOptions(search_px=150.0)).estimate(case.image, case.camera, case.scene)
    assert isinstance(refused, Failure), refused
    assert refused.reason is Reason.AMBIGUOUS


def test_a_corner_of_europa_gives_its_position_as_uncertain_as_it_is(cases: Any, data_dir: Path) -> None:
    case = next(cases.europa(data_dir))
    fix = EllipsoidCRA().estimate(case.image, case.camera, case.scene)
    assert isinstance(fix, PositionFix), fix
    assert Quality.CUT_BY_FRAME in fix.flags
    assert Quality.SHORT_ARC in fix.flags
    # a twelfth of the face: less than the unknowns of the checks, which must not believe how well they fit
    assert not fix.flags & (Quality.UNEXPLAINED_LIGHT | Quality.WRONG_FIGURE | Quality.BLURRED | Quality.DISAGREEMENT)
    error = fix.center_px - case.center_px
    covariance = fix.covariance_px2 + case.sigma_px**2 * np.eye(2)
    assert error @ np.linalg.solve(covariance, error) < SIGMAS**2
    assert abs(fix.range_km - case.range_km) < SIGMAS * np.hypot(fix.sigma_range_km, 1e-3 * case.range_km)
    edges = EllipseFit().estimate(case.image, case.camera, case.scene)
    assert isinstance(edges, PositionFix), edges  # by the known axes: a tenth of the outline fixes no free ellipse
    error = edges.center_px - case.center_px
    assert error @ np.linalg.solve(edges.covariance_px2 + case.sigma_px**2 * np.eye(2), error) < SIGMAS**2


@pytest.mark.slow
def test_jupiter_on_approach_is_as_large_as_its_range_says(cases: Any, data_dir: Path) -> None:
    case = next(cases.jupiter(data_dir))
    for estimator in limb_estimators(60.0):
        fix = estimator.estimate(case.image, case.camera, case.scene)
        assert isinstance(fix, PositionFix), fix
        assert abs(fix.range_km / case.range_km - 1.0) < TRAJECTORY


def test_where_the_surface_fills_the_frame_nothing_is_taken_for_a_limb(cases: Any, data_dir: Path) -> None:
    example = import_module("real_bodies")
    for case in example.eros(data_dir):
        for estimator in (*limb_estimators(40.0), LimbMatching(), Moment()):
            refused = estimator.estimate(case.image, case.camera, case.scene)
            assert isinstance(refused, Failure), refused


def test_vesta_larger_than_the_frame_has_no_center_of_brightness(cases: Any, data_dir: Path) -> None:
    case = next(cases.vesta(data_dir))
    fix = Moment().estimate(case.image, case.camera, case.scene)
    assert not isinstance(fix, CenterFix)
    assert fix.reason is Reason.OUT_OF_FRAME
