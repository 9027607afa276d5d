"""Ellipses through the lit limb: position from the cone, without a reflectance law, and refusals."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure, PositionFix, Quality, Reason
from giantlike.ray_tracing import Lambert, LommelSeeliger, McEwen
from giantlike.relative import ESTIMATORS, EllipseFit, EllipseFitOptions, Estimator
from giantlike.shapes import Ellipsoid, Point, irregular_body
from tests.limb_images import BodyImage, body_image, mean_nees_band

SIGMA_PX, SIGMA_RANGE = 1.0, 0.01  # what an ellipse of 160 px must say of itself at worst
BODY = Ellipsoid(radii_km=np.array([0.3, 0.26, 0.22]))
LAWS = (McEwen(), LommelSeeliger(), Lambert())


def found(case: BodyImage) -> PositionFix:
    fix = EllipseFit().estimate(case.image, case.camera, case.scene)
    assert isinstance(fix, PositionFix), fix
    return fix


@cache
def seen(seed: int) -> tuple[BodyImage, PositionFix]:
    """An ellipsoid under one of three laws, at 25 to 110 degrees; prediction off by pixels and range."""
    rng = np.random.default_rng(seed)
    case = body_image(BODY, seed, phase_deg=float(rng.uniform(25, 110)), law=LAWS[seed % 3])
    case = case.believed(
        off_px=(float(rng.uniform(-9, 9)), float(rng.uniform(-9, 9))), range_error=float(rng.uniform(-0.015, 0.015))
    )
    return case, found(case)


@pytest.mark.monte_carlo(few=4, full=15)
def test_positions_under_any_law_are_as_good_as_they_say(draws: int) -> None:
    cases = [seen(seed) for seed in range(draws)]
    nees = [case.nees(fix) for case, fix in cases]
    low, high = mean_nees_band(len(cases))
    assert 0.3 * low < np.mean(nees) < high  # what changing brightness leaves is a bound of three laws, not a spread
    for _, fix in cases:
        assert np.sqrt(np.linalg.eigvalsh(fix.covariance_px2)[-1]) < SIGMA_PX
        assert fix.sigma_range_km < SIGMA_RANGE * fix.range_km
        assert fix.score < 0.3
        assert not fix.flags.suspect


@pytest.mark.monte_carlo(few=4, full=15)
def test_the_errors_themselves_are_parts_of_a_pixel(draws: int) -> None:
    errors: Float = np.array([case.error_px(fix) for case, fix in map(seen, range(draws))])
    ranges = [case.range_error(fix) for case, fix in map(seen, range(draws))]
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.5
    assert np.median(np.abs(ranges)) < 0.004


def test_a_limb_cut_by_the_frame_still_gives_an_ellipse() -> None:
    for center in ((40.0, 200.0), (200.0, 370.0)):
        case = body_image(BODY, 4, phase_deg=40.0, center_px=center)
        fix = EllipseFit().estimate(case.image, case.camera, case.scene)
        if isinstance(fix, PositionFix):
            assert case.nees(fix) < 40.0
        else:
            assert fix.reason in (Reason.NO_LIMB, Reason.DEGENERATE_GEOMETRY)


def test_craters_of_light_and_hot_pixels_are_left_out() -> None:
    case, clean = seen(0)
    pixels = case.image.pixels.copy()
    rng = np.random.default_rng(2)
    rows, columns = rng.integers(0, 400, (2, 150))
    pixels[rows, columns] = 4000
    dirty = found(replace(case, image=replace(case.image, pixels=pixels)))
    assert np.linalg.norm(dirty.center_px - clean.center_px) < 3.0 * np.sqrt(np.trace(clean.covariance_px2))


def test_what_has_no_limb_is_refused_with_its_reason() -> None:
    case, _ = seen(0)

    def reason(changed: BodyImage, options: EllipseFitOptions | None = None) -> Reason:
        failure = EllipseFit(options).estimate(changed.image, changed.camera, changed.scene)
        assert isinstance(failure, Failure)
        return failure.reason

    empty = np.random.default_rng(1).normal(100.0, 5.0, case.image.pixels.shape)
    assert reason(replace(case, image=replace(case.image, pixels=empty))) is Reason.NO_LIMB
    assert reason(body_image(BODY, 4, phase_deg=40.0, radius_px=900.0)) is Reason.NO_LIMB  # the surface fills the image
    assert reason(case.believed(off_px=(150.0, 0.0))) is Reason.NO_LIMB
    rock = body_image(irregular_body(3, facets=2_000), 4, phase_deg=40.0)
    assert reason(rock, EllipseFitOptions(max_relief=0.001)) is Reason.WRONG_SHAPE
    with pytest.raises(InputError, match="min_edges"):
        EllipseFitOptions(min_edges=400)
    with pytest.raises(InputError, match="search_range"):
        EllipseFitOptions(search_range=2.0)


def test_a_mesh_is_replaced_by_its_ellipsoid_and_says_so() -> None:
    rock = body_image(irregular_body(3, facets=2_000), 4, phase_deg=40.0)
    fix = EllipseFit().estimate(rock.image, rock.camera, rock.scene)
    if isinstance(fix, PositionFix):
        assert Quality.SHAPE_APPROXIMATED in fix.flags
    else:
        assert fix.reason in (Reason.WRONG_SHAPE, Reason.NO_LIMB)


def test_it_is_among_the_estimators() -> None:
    estimator = ESTIMATORS["ellipse_fit"]()
    assert isinstance(estimator, Estimator)
    assert isinstance(estimator, EllipseFit)


@pytest.mark.monte_carlo(few=2, full=10)
def test_relief_is_in_the_covariance_of_a_mesh(draws: int) -> None:
    squares = []
    for seed in range(draws):
        shape = irregular_body(seed % 4 + 1, facets=8000, relief=0.03)
        case = body_image(shape, 40 + seed, phase_deg=30.0 + 10.0 * (seed % 6)).believed(off_px=(4.0, -3.0))
        fix = EllipseFit().estimate(case.image, case.camera, case.scene)
        if isinstance(fix, PositionFix):
            squares.append(case.nees(fix))
    assert len(squares) >= 0.5 * draws
    # Relief is no Gaussian process: its long waves are the body's own shape, so each square may be twice chi-square's.
    assert np.mean(squares) < 2.0 * mean_nees_band(len(squares))[1]


@pytest.mark.parametrize("name", ["ellipse_fit", "ellipsoid_cra", "sigmoid_limb", "surface_features", "limb_matching"])
def test_a_point_has_no_limb_and_no_landmarks(name: str) -> None:
    case = body_image(BODY, 3, phase_deg=60.0)
    point = replace(case, target=replace(case.target, shape=Point()))
    outcome = ESTIMATORS[name]().estimate(point.image, point.camera, point.scene)
    assert isinstance(outcome, Failure)
    assert outcome.reason in (Reason.WRONG_SHAPE, Reason.NO_LIMB)


def test_a_prediction_outside_the_frame_is_a_refusal_on_every_side() -> None:
    """Beyond the last column or row the part of the frame to search was empty, which ended in an error of OpenCV."""
    case, _ = seen(0)
    for off_px in ((900.0, 0.0), (-900.0, 0.0), (0.0, 900.0), (0.0, -900.0)):
        far = case.believed(off_px=off_px)
        fix = EllipseFit().estimate(far.image, far.camera, far.scene)
        assert isinstance(fix, Failure)
        assert fix.reason is Reason.NO_LIMB
