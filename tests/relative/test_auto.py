"""The estimator that chooses: what it takes for which body, and how it is checked."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from giantlike._system.threads import threads
from giantlike.camera import Camera
from giantlike.cli.app import app
from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.errors import InputError
from giantlike.core.outcomes import CenterFix, Failure, PositionFix, Quality, Reason
from giantlike.image import Image
from giantlike.relative import ESTIMATORS, Auto, AutoOptions, CrossCorrelation, Estimator, LimbMatching
from giantlike.relative.auto import choose
from giantlike.relative.consensus import agreement_of, fuse
from giantlike.relative.inputs import EstimatorInputs
from giantlike.scene import Scene
from giantlike.shapes import Ellipsoid, TriangleMesh
from giantlike.shapes.generate import irregular_body
from tests.limb_images import NEES_LIMIT, body_image
from tests.sizes import slow
from tests.tolerances import FLOAT64_SUM

MOON = Ellipsoid(radii_km=np.array([1.1, 1.0, 0.95]))


@pytest.fixture(scope="module")
def rock() -> TriangleMesh:
    return irregular_body(5, radii_km=(1.2, 1.0, 0.9), facets=3000)


def _sound(fix: CenterFix, center_px: Float) -> None:
    error = fix.center_px - center_px
    assert error @ np.linalg.solve(fix.covariance_px2, error) < NEES_LIMIT


@pytest.mark.parametrize(
    ("diameter_px", "is_ellipsoid", "in_frame", "limb_px", "first"),
    [
        (1.0, False, 1.0, 0.0, "unresolved"),
        (20.0, False, 1.0, 30.0, "cross_correlation"),
        (300.0, False, 1.0, 500.0, "cross_correlation"),
        (300.0, True, 1.0, 500.0, "ellipsoid_cra"),
        (1500.0, False, 0.2, 400.0, "limb_matching"),
        (1500.0, True, 0.2, 400.0, "ellipsoid_cra"),
        (3000.0, False, 0.0, 0.0, "surface_features"),
    ],
)
def test_what_is_taken_follows_from_size_shape_and_limb(
    diameter_px: float, is_ellipsoid: bool, in_frame: float, limb_px: float, first: str
) -> None:
    choice = choose(diameter_px=diameter_px, is_ellipsoid=is_ellipsoid, in_frame=in_frame, limb_px=limb_px)
    assert choice.estimators[0] == first
    assert f"{diameter_px:.3g} px" in choice.because
    assert set(choice.checks) - {first}


def test_an_ellipsoid_whose_limb_is_not_in_the_frame_cannot_be_found() -> None:
    case = body_image(MOON, 1, phase_deg=30.0, radius_px=900.0)
    outcome = Auto().estimate(case.image, case.camera, case.scene)
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.NO_LIMB
    assert "no landmarks" in outcome.detail


@pytest.mark.parametrize(("radius_px", "chosen"), [(1.0, "unresolved"), (12.0, "cross_correlation")])
def test_small_bodies_are_found_by_their_light_and_checked_by_its_moment(
    rock: TriangleMesh, radius_px: float, chosen: str
) -> None:
    case = body_image(rock, 2, phase_deg=50.0, radius_px=radius_px).believed(off_px=(3.0, -2.0))
    fix = Auto().estimate(case.image, case.camera, case.scene)
    assert isinstance(fix, CenterFix)
    assert (fix.estimator, fix.findings.chosen, fix.findings.checked_by) == ("auto", chosen, "moment")
    _sound(fix, case.center_px)


def test_an_irregular_body_is_found_by_its_light_and_checked_by_its_limb(rock: TriangleMesh) -> None:
    case = body_image(rock, 3, phase_deg=50.0).believed(off_px=(6.0, -4.0), range_error=0.01)
    fix = Auto().estimate(case.image, case.camera, case.scene)
    assert isinstance(fix, PositionFix)
    assert (fix.findings.chosen, fix.findings.checked_by) == ("cross_correlation", "limb_matching")
    assert (fix.findings.agreement or 0.0) > AutoOptions().false_alarm
    assert not fix.flags.suspect
    assert case.nees(fix) < NEES_LIMIT


def test_an_ellipsoid_is_found_by_its_horizon_and_by_its_light_which_its_limb_checks() -> None:
    case = body_image(MOON, 4, phase_deg=50.0).believed(off_px=(6.0, -4.0), range_error=0.01)
    fix = Auto().estimate(case.image, case.camera, case.scene)
    assert isinstance(fix, PositionFix)
    assert (fix.findings.chosen, fix.findings.checked_by) == ("ellipsoid_cra", "cross_correlation, limb_matching")
    assert case.nees(fix) < NEES_LIMIT


@pytest.mark.parametrize("shape", ["rock", slow("moon")])
def test_a_fix_is_the_same_to_the_last_bit_by_any_number_of_threads(rock: TriangleMesh, shape: str) -> None:
    case = body_image(rock if shape == "rock" else MOON, 3, phase_deg=50.0).believed(off_px=(6.0, -4.0))
    fixes = list[CenterFix]()
    for count in (1, 2, 4):
        with threads(count):
            fix = Auto().estimate(case.image, case.camera, case.scene)
        assert isinstance(fix, PositionFix)
        fixes.append(fix)
    one, *others = fixes
    for other in others:
        for field in fields(one):
            mine, its = getattr(one, field.name), getattr(other, field.name)
            assert _plain(mine) == _plain(its), field.name


def _plain(value: Any) -> Any:
    """Bytes of arrays, and text of all else."""
    if isinstance(value, Mapping):
        return [(str(key), _plain(one)) for key, one in value.items()]
    return value.tobytes() if isinstance(value, np.ndarray) else repr(value)


def test_two_threads_run_the_choice_and_its_check_at_once(rock: TriangleMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    case = body_image(rock, 3, phase_deg=50.0).believed(off_px=(6.0, -4.0), range_error=0.01)
    both = threading.Barrier(2)  # broken, which is an error, unless two threads wait at it

    def waiting(estimator: type[Any], real: Callable[..., Any]) -> None:
        def solve(self: Any, inputs: EstimatorInputs) -> Any:
            both.wait(60.0)
            return real(self, inputs)

        monkeypatch.setattr(estimator, "_solve", solve)

    for estimator in (CrossCorrelation, LimbMatching):
        waiting(estimator, estimator._solve)
    with threads(2):
        fix = Auto().estimate(case.image, case.camera, case.scene)
    assert isinstance(fix, CenterFix)
    assert fix.findings.checked_by == "limb_matching"


def test_an_image_of_nothing_is_a_failure_that_names_what_was_tried() -> None:
    case = body_image(MOON, 6, phase_deg=60.0)
    noise = np.random.default_rng(1).normal(100.0, 5.0, (400, 400)).round().astype(np.uint16)
    outcome = Auto().estimate(
        Image(pixels=noise, camera_from_inertial=case.image.camera_from_inertial, name="dark"), case.camera, case.scene
    )
    assert isinstance(outcome, Failure)
    assert "dark: BODY: auto: 160 px wide" in outcome.detail
    assert "cross_correlation" in outcome.detail


class _Said:
    """An estimator that gives what it was told."""

    name: ClassVar[str] = "said"
    options = None

    def __init__(self, outcome: CenterFix | Failure) -> None:
        self._outcome = outcome

    def estimate(self, image: Image, camera: Camera, scene: Scene, target: str | None = None) -> CenterFix | Failure:
        return self._outcome


def _fix(center_px: tuple[float, float], flags: Quality = Quality.NONE) -> CenterFix:
    return CenterFix(
        estimator="said", target="BODY", center_px=np.array(center_px), covariance_px2=np.diag([0.01, 0.01]),
        predicted_px=np.zeros(2), residuals=np.zeros(3), n_used=3, n_rejected=0, score=1.0, flags=flags,
    )  # fmt: skip


class _Told(Auto):
    """The choice for a rock of 160 px, with estimators that are told what to give."""

    def __init__(self, **outcomes: CenterFix | Failure) -> None:
        super().__init__()
        self.outcomes = outcomes

    def _estimator(self, name: str) -> Estimator:
        return _Said(self.outcomes.get(name, Failure(Reason.NO_LIMB, f"{name} found nothing")))


def _told(rock: TriangleMesh, **outcomes: CenterFix | Failure) -> CenterFix | Failure:
    case = body_image(rock, 7, phase_deg=50.0)
    return _Told(**outcomes).estimate(case.image, case.camera, case.scene)


def test_a_disagreement_beyond_the_covariances_makes_the_fix_less_certain(rock: TriangleMesh) -> None:
    agreed = _told(rock, cross_correlation=_fix((10.0, 10.0)), limb_matching=_fix((10.2, 10.0)))
    assert isinstance(agreed, CenterFix)
    assert not agreed.flags.suspect
    assert_allclose(agreed.covariance_px2, 0.01 * np.eye(2), rtol=0, atol=FLOAT64_SUM)
    apart = _told(rock, cross_correlation=_fix((10.0, 10.0)), limb_matching=_fix((11.0, 10.0)))
    assert isinstance(apart, CenterFix)
    assert not apart.flags.suspect
    assert apart.center_px.tolist() == [10.0, 10.0]
    ratio = 0.5 * (1.0 + 1.0**2 / 0.02 / 2.0)  # squared difference over its covariance, two degrees of freedom
    assert_allclose(apart.covariance_px2, ratio * 0.01 * np.eye(2), rtol=0, atol=FLOAT64_SUM)


def test_the_center_of_light_does_not_replace_a_fix_that_another_model_explains_better(rock: TriangleMesh) -> None:
    suspect = _fix((0, 0), Quality.FAR_FROM_PREDICTION)
    fix = _told(rock, cross_correlation=suspect, moment=_fix((9, 9)))
    assert isinstance(fix, CenterFix)
    assert (fix.findings.chosen, fix.flags.suspect) == ("cross_correlation", True)
    by_limb = _told(rock, cross_correlation=suspect, limb_matching=_fix((9, 9)), moment=_fix((9, 9)))
    assert isinstance(by_limb, CenterFix)
    assert (by_limb.findings.chosen, by_limb.flags.suspect) == ("limb_matching", False)


def test_what_rests_on_something_else_checks_before_what_rests_on_the_same(rock: TriangleMesh) -> None:
    fix = _told(rock, cross_correlation=_fix((0, 0)), moment=_fix((9, 9)), limb_matching=_fix((0, 0)))
    assert isinstance(fix, CenterFix)
    assert fix.findings.checked_by == "limb_matching"
    second_best = _told(rock, cross_correlation=_fix((0, 0)), moment=_fix((0, 0)))
    assert isinstance(second_best, CenterFix)
    assert second_best.findings.checked_by == "moment"


def test_an_irregular_body_that_one_estimator_alone_finds_is_unchecked(rock: TriangleMesh) -> None:
    fix = _told(rock, cross_correlation=_fix((0, 0)))
    assert isinstance(fix, CenterFix)
    assert fix.flags == Quality.UNCHECKED
    assert not fix.findings.checked_by


@pytest.mark.parametrize("name", ["ellipsoid_cra", "cross_correlation"])
def test_an_ellipsoid_that_one_estimator_alone_finds_is_unchecked(name: str) -> None:
    case = body_image(MOON, 8, phase_deg=50.0)
    fix = _Told(**{name: _fix((0, 0))}).estimate(case.image, case.camera, case.scene)
    assert isinstance(fix, CenterFix)
    assert fix.flags == Quality.UNCHECKED
    assert not fix.findings.checked_by


def test_light_that_the_horizon_is_too_weak_to_check_is_checked_by_the_limb() -> None:
    """As on a Jupiter of Voyager: the horizon does not constrain one axis, on which the light is 5 sigma off.

    Where no limb checks the light, the horizon is kept.
    """
    case = body_image(MOON, 8, phase_deg=50.0)
    open_axis = np.diag([0.01, 4.0])
    weak = replace(_fix((10.0, 10.0)), covariance_px2=open_axis, parts={Cause.NOISE: open_axis})
    light, limb = _with_parts((10.0, 10.5), albedo=0.01), _with_parts((10.0, 10.0), edge=0.01)
    told = {"ellipsoid_cra": weak, "cross_correlation": light}
    alone = _Told(**told).estimate(case.image, case.camera, case.scene)
    assert isinstance(alone, CenterFix)
    assert alone.findings.checked_by == "cross_correlation"
    checked = _Told(**told, limb_matching=limb).estimate(case.image, case.camera, case.scene)
    assert isinstance(checked, CenterFix)
    assert checked.findings.checked_by == "cross_correlation, limb_matching"
    assert alone.center_px.tolist() == [10.0, 10.0]
    assert_allclose(alone.covariance_px2, open_axis, rtol=0, atol=FLOAT64_SUM)
    assert alone.findings.weight is None
    assert (checked.center_px[1] - 10.0) / math.sqrt(checked.covariance_px2[1, 1]) < 2.0


def test_a_fix_to_which_its_own_checks_object_gives_way_to_the_next(rock: TriangleMesh) -> None:
    fix = _told(rock, cross_correlation=_fix((0, 0), Quality.WRONG_LIGHT), limb_matching=_fix((0.1, 0)))
    assert isinstance(fix, CenterFix)
    assert fix.findings.chosen == "limb_matching"
    only = _told(rock, cross_correlation=_fix((0, 0), Quality.WRONG_LIGHT))
    assert isinstance(only, CenterFix)
    assert only.findings.chosen == "cross_correlation"


def test_agreement_is_the_chance_of_a_larger_difference() -> None:
    # Two axes of sigma sqrt(0.02): a difference of 3 of them on one axis is as likely as exp(-9 / 2).
    assert agreement_of(_fix((0, 0)), _fix((3 * 0.02**0.5, 0))) == pytest.approx(np.exp(-4.5), rel=FLOAT64_SUM)


def test_what_two_fixes_have_in_common_excuses_no_difference() -> None:
    """The camera and the scale of the shape shift both alike: 3 sigma of their own errors stay 3 sigma."""
    noise = 0.01 * np.eye(2)
    parts = {Cause.NOISE: noise, Cause.SHAPE_SCALE: np.eye(2), Cause.CAMERA: np.eye(2)}
    first, second = (
        replace(_fix(center), parts=parts, covariance_px2=noise + np.eye(2)) for center in ((0, 0), (3 * 0.02**0.5, 0))
    )
    assert agreement_of(first, second) == pytest.approx(np.exp(-4.5), rel=FLOAT64_SUM)


@pytest.mark.parametrize(
    "bad", [{"unresolved_px": 0.0}, {"unresolved_px": 50.0}, {"min_limb_px": 0.0}, {"false_alarm": 0.5}]
)
def test_options_out_of_range_are_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        AutoOptions(**bad)


def test_the_command_lists_every_estimator_with_its_options() -> None:
    listed = json.loads(CliRunner().invoke(app, ["estimators", "--json"]).stdout)
    assert [one["name"] for one in listed] == list(ESTIMATORS)
    assert all(one["summary"].endswith(".") and one["options"] for one in listed)
    shown = CliRunner().invoke(app, ["estimators", "limb_matching"])
    assert shown.exit_code == 0
    assert "search_px = 40" in shown.stdout
    assert CliRunner().invoke(app, ["estimators", "magic"]).exit_code == 2


def test_a_fix_that_only_suspect_or_vague_fixes_speak_for_is_unchecked(rock: TriangleMesh) -> None:
    vague = replace(_fix((5, 5)), covariance_px2=np.diag([400.0, 400.0]))
    for second in (vague, _fix((0, 0), Quality.WRONG_LIGHT)):
        fix = _told(rock, cross_correlation=_fix((0, 0)), limb_matching=second)
        assert isinstance(fix, CenterFix)
        assert fix.flags == Quality.UNCHECKED
        assert not fix.findings.checked_by


@pytest.mark.parametrize("center_px", [(0, 0), (5, 5)])
def test_a_suspect_check_has_no_say(rock: TriangleMesh, center_px: tuple[float, float]) -> None:
    suspect = _fix(center_px, Quality.WRONG_LIGHT)
    fix = _told(rock, cross_correlation=_fix((0, 0)), limb_matching=suspect, moment=_fix((0, 0)))
    assert isinstance(fix, CenterFix)
    assert fix.flags == Quality.NONE
    assert fix.findings.checked_by == "moment"
    assert_allclose(fix.covariance_px2, 0.01 * np.eye(2), rtol=0, atol=FLOAT64_SUM)


def _with_parts(center_px: tuple[float, float], **variances: float) -> CenterFix:
    parts = {Cause(name): variance * np.eye(2) for name, variance in variances.items()}
    return replace(_fix(center_px), parts=parts, covariance_px2=sum(variances.values()) * np.eye(2))


def test_what_two_fixes_share_does_not_average_out_and_what_one_has_alone_does() -> None:
    model = body_image(MOON, 1, phase_deg=50.0).camera.model
    shared = fuse(_with_parts((10.0, 10.0), reflectance=0.01), _with_parts((10.1, 10.0), reflectance=0.01), model)
    assert_allclose(shared.covariance_px2, 0.01 * np.eye(2), rtol=0, atol=FLOAT64_SUM)
    alone = fuse(_with_parts((10.0, 10.0), albedo=0.01), _with_parts((10.1, 10.0), edge=0.01), model)
    assert_allclose(alone.covariance_px2, 0.005 * np.eye(2), rtol=0, atol=FLOAT64_SUM)
    assert_allclose(alone.center_px, [10.05, 10.0], rtol=0, atol=FLOAT64_SUM)
    assert alone.findings.weight == 0.5


def test_the_scale_of_the_shape_that_both_share_does_not_count_in_the_weights() -> None:
    model = body_image(MOON, 1, phase_deg=50.0).camera.model
    weights = [
        fuse(
            _with_parts((10.0, 10.0), albedo=0.01, shape_scale=first),
            _with_parts((10.0, 10.0), edge=0.02, shape_scale=second),
            model,
        ).findings.weight
        for first, second in ((1e-6, 1e-6), (1.0, 0.1), (0.1, 1.0))
    ]
    assert weights[0] is not None
    assert 0.0 < weights[0] < 1.0
    assert weights == [weights[0]] * 3


def test_a_fused_covariance_holds_for_errors_that_are_independent_or_the_same() -> None:
    """10,000 draws; the sigma of a mean square of 20,000 numbers is one percent."""
    model, rng = body_image(MOON, 1, phase_deg=50.0).camera.model, np.random.default_rng(2)
    stated = fuse(_with_parts((0, 0), noise=0.01, albedo=0.01), _with_parts((0, 0), noise=0.02, edge=0.01), model)
    weight = stated.findings.weight
    assert weight is not None
    draws = rng.normal(size=(4, 10_000, 2))
    for noise in (draws[1], draws[0]):
        first, second = 0.1 * (draws[0] + draws[2]), math.sqrt(0.02) * noise + 0.1 * draws[3]
        mean = weight * first + (1.0 - weight) * second
        assert float(np.mean(mean**2)) < 1.03 * stated.covariance_px2[0, 0]


def test_fixes_that_differ_by_more_than_their_errors_are_less_certain_together() -> None:
    model = body_image(MOON, 1, phase_deg=50.0).camera.model
    apart = fuse(_with_parts((10.0, 10.0), albedo=0.01), _with_parts((10.5, 10.0), edge=0.01), model)
    ratio = 0.5 * (1.0 + 0.5**2 / 0.02 / 2.0)  # squared difference over its covariance, two degrees of freedom
    assert_allclose(apart.covariance_px2, ratio * 0.005 * np.eye(2), rtol=0, atol=FLOAT64_SUM)


def test_a_vague_second_fix_that_differs_by_more_than_its_errors_makes_the_first_less_certain() -> None:
    """Its best weight is zero; the difference tells all the same that errors are larger than they say."""
    model = body_image(MOON, 1, phase_deg=50.0).camera.model
    first, vague = _with_parts((10.0, 10.0), noise=0.01), _with_parts((16.0, 10.0), noise=1.0)
    apart = fuse(first, vague, model)
    ratio = 0.5 * (1.0 + 6.0**2 / 1.01 / 2.0)
    assert_allclose(apart.covariance_px2, ratio * 0.01 * np.eye(2), rtol=0, atol=FLOAT64_SUM)
    assert_allclose(apart.center_px, first.center_px, rtol=0, atol=0)
    near = fuse(first, _with_parts((11.0, 10.0), noise=1.0), model)
    assert_allclose(near.covariance_px2, first.covariance_px2, rtol=0, atol=FLOAT64_SUM)


def test_an_ellipsoid_is_fused_from_its_horizon_and_its_light_and_its_position_agrees_with_its_center() -> None:
    case = body_image(MOON, 4, phase_deg=50.0).believed(off_px=(6.0, -4.0), range_error=0.01)
    fix = Auto().estimate(case.image, case.camera, case.scene)
    assert isinstance(fix, PositionFix)
    assert fix.findings.weight is not None
    assert 0.0 <= fix.findings.weight <= 1.0
    assert_allclose(case.camera.model.project(fix.position_camera_km), fix.center_px, rtol=0, atol=1e-9)
    assert case.nees(fix) < NEES_LIMIT
