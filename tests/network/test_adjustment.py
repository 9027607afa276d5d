"""Networks adjusted: exact without noise, covariances as of the whole matrix, outliers, what is held and refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.stats import chi2

from giantlike.calibration.options import Treatment
from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure, Reason
from giantlike.network import NetworkFix, NetworkOptions, Photo, Tracks, adjust
from giantlike.network.problem import Problem, State, Step
from giantlike.network.result import PointStatus
from giantlike.network.rotation import Rotating
from tests.network.networks import dense_covariance, world
from tests.tolerances import FALSE_ALARM

MARGINAL = 1e-5  # relative: central differences of the reference
EXACT_KM = 1e-6  # where the iteration stops: 1e-4 of a sigma of 2.5e-3 km (0.5 px), a few times over
ALL = NetworkOptions(outlier_sigmas=np.inf, loss="linear")  # type: ignore[arg-type]


def adjusted(photos: list[Photo], tracks: Tracks, options: NetworkOptions | None = None, **more: object) -> NetworkFix:
    fix = adjust(photos, tracks, options=options, **more)  # type: ignore[arg-type]
    assert isinstance(fix, NetworkFix), fix
    return fix


def kept(tracks: Tracks, which: NDArray[np.integer]) -> Tracks:
    """Some of the measures."""
    return replace(tracks, point=tracks.point[which], photo=tracks.photo[which], points_px=tracks.points_px[which],
                   sigma_px=tracks.sigma_px[which])  # fmt: skip


def test_points_and_poses_are_found_exactly_without_noise_when_the_first_images_are_known() -> None:
    truth = world(1, sigma_px=0.0)
    held = [replace(photo, camera_from_inertial=truth.rotations[k], position_km=truth.positions_km[k],
                    covariance_pose=np.zeros((6, 6))) for k, photo in enumerate(truth.photos[:2])]  # fmt: skip
    free = [replace(photo, covariance_pose=None) for photo in truth.photos[2:]]
    fix = adjusted([*held, *free], truth.tracks)
    assert_allclose(fix.points_km, truth.points_km, rtol=0, atol=EXACT_KM)
    assert_allclose(fix.poses[1], truth.positions_km, rtol=0, atol=10.0 * EXACT_KM)
    assert_allclose(fix.covariance_poses[:2], 0.0, atol=0)
    assert fix.used.all()


def test_covariances_are_those_of_the_whole_normal_matrix() -> None:
    apriori = np.full((40, 3, 3), np.diag([np.inf] * 3))
    apriori[:5] = np.diag([1e-4, 4e-4, 9e-4]) + 5e-5
    truth = world(2)
    correlated = np.diag([1e-6] * 3 + [2.5e-3] * 3)
    correlated[0, 3] = correlated[3, 0] = 3e-5
    photos = [replace(photo, covariance_pose=correlated) for photo in truth.photos]
    rng = np.random.default_rng(2)
    tracks = replace(
        truth.tracks, points_km=truth.points_km + rng.normal(0.0, 0.01, (40, 3)), covariance_points_km2=apriori
    )
    tracks = kept(tracks, np.flatnonzero(rng.random(240) < 0.7))
    fix = adjusted(photos, tracks, ALL)
    poses, points = dense_covariance(list(fix.photos), photos, tracks, fix.points_km)
    for mine, reference in ((fix.covariance_poses, poses), (fix.covariance_points_km2, points)):
        sigma = np.sqrt(np.diagonal(reference, axis1=1, axis2=2))
        assert_allclose((mine - reference) / (sigma[:, :, None] * sigma[:, None, :]), 0.0, atol=MARGINAL)
    for name, whole in (("points_km2", fix.covariance_points_km2), ("poses", fix.covariance_poses)):
        parts = [getattr(part, name) for part in fix.parts.values()]
        assert_allclose(sum(parts), whole, rtol=1e-9, atol=1e-18)
        assert min(float(np.linalg.eigvalsh(part).min()) for part in parts) > -1e-9 * float(np.abs(whole).max())
    assert set(fix.parts) == {Cause.NOISE, Cause.ATTITUDE, Cause.EPHEMERIS, Cause.RELIEF}


def test_errors_of_points_and_poses_have_their_covariance() -> None:
    total, freedom = 0.0, 0
    for seed in range(12):
        truth = world(100 + seed, points=15)
        fix = adjusted(truth.photos, truth.tracks, ALL)
        for k in range(6):
            turn = (truth.rotations[k] * fix.photos[k].camera_from_inertial.inv()).as_rotvec()
            error = np.concatenate([turn, truth.positions_km[k] - fix.photos[k].position_km])
            total += float(error @ np.linalg.solve(fix.covariance_poses[k], error))
            freedom += 6
    # poses of a network move together: at worst as six of them as one
    assert 6 * chi2.ppf(FALSE_ALARM, freedom // 6) < total < 6 * chi2.isf(FALSE_ALARM, freedom // 6)


@pytest.mark.parametrize("names", [("pole", "w", "rate"), ("size",), ("camera",)])
def test_jacobians_agree_with_numerical_differences(names: tuple[str, ...]) -> None:
    truth = world(3, points=7, images=3)
    body = Rotating(pole_ra_deg=np.array([30.0]), pole_dec_deg=np.array([40.0]), pm_deg=np.array([50.0, 2000.0]))
    photos = [replace(photo, et=100.0 * k) for k, photo in enumerate(truth.photos)]
    options = NetworkOptions(**dict.fromkeys(names, Treatment.ESTIMATE), sigma_camera={"fx_px": 1.0, "cx_px": 1.0})  # type: ignore[arg-type]
    problem = Problem.from_photos(photos, truth.tracks, body, options, truth.points_km)
    state = problem.start
    found = problem.linearize(state)

    def moved(pose: Float, point: Float, shared: Float) -> Float:
        step = Step(np.concatenate([np.tile(pose, 3), shared / problem.sigma_shared]), np.tile(point, (7, 1)), 0.0)
        inverse = problem.poses.inverse[0] @ pose
        after = problem.apply_step(
            state, Step(np.concatenate([np.tile(inverse, 3), step.reduced[18:]]), step.points, 0.0)
        )
        assert isinstance(after, State)
        return problem.predict(after)

    k = len(problem.names)
    zero = (np.zeros(6), np.zeros(3), np.zeros(k))
    for which, analytic, size in ((0, found.by_pose, 6), (1, found.by_point, 3), (2, found.by_shared, k)):
        for column in range(size):
            unit = 1e-6 * (problem.sigma_shared[column] if which == 2 else 1.0)
            pair = []
            for sign in (1.0, -1.0):
                change = [each.copy() for each in zero]
                change[which][column] = sign * unit
                pair.append(moved(*change))
            numerical = (pair[0] - pair[1]) / (2.0 * unit)
            scale = np.abs(analytic[:, :, column]).max()
            assert_allclose(numerical, analytic[:, :, column], rtol=0, atol=1e-5 * scale + 1e-6 / unit * 1e-4)


def test_moved_measures_are_rejected_and_points_stay() -> None:
    truth = world(4)
    rng = np.random.default_rng(4)
    bad = rng.choice(240, 12, replace=False)
    pixels = truth.tracks.points_px.copy()
    pixels[bad] += 30.0 * np.stack([np.cos(bad), np.sin(bad)], axis=1)
    before = adjusted(truth.photos, truth.tracks)
    fix = adjusted(truth.photos, replace(truth.tracks, points_px=pixels))
    assert not fix.used[bad].any()
    assert int((~fix.used).sum()) <= 15  # one good measure in 450 lies beyond 3.5 sigma in two axes
    sigma = np.sqrt(np.diagonal(fix.covariance_points_km2, axis1=1, axis2=2))
    assert float(np.abs((fix.points_km - before.points_km) / sigma).max()) < 2.0
    assert 0.8 < fix.noise < 1.2
    assert np.isnan(fix.redundancy[bad]).all()
    # the sum of all redundancies is the degrees of freedom but for what the a priori values of the poses give
    known = adjusted([replace(p, covariance_pose=np.zeros((6, 6)), camera_from_inertial=truth.rotations[k],
                              position_km=truth.positions_km[k]) for k, p in enumerate(truth.photos)],
                     truth.tracks, ALL)  # fmt: skip
    assert abs(known.redundancy.sum() - known.freedom) < 1e-6


def test_a_wrong_measure_of_few_views_is_never_sure() -> None:
    truth = world(5, images=6)
    keep = (truth.tracks.point < 20) | (truth.tracks.photo < 3)
    keep &= (truth.tracks.point < 30) | (truth.tracks.photo < 2)
    tracks = kept(truth.tracks, np.flatnonzero(keep))
    reference = adjusted(truth.photos, tracks)
    assert (reference.point_status[30:] == PointStatus.UNCHECKED).all()
    assert (reference.point_status[:30] != PointStatus.UNCHECKED).all()
    rng = np.random.default_rng(5)
    for point in range(20, 40):
        pixels = tracks.points_px.copy()
        mine = np.flatnonzero(tracks.point == point)
        turn = rng.uniform(0.0, 2.0 * np.pi)
        pixels[mine[0]] += 20.0 * np.array([np.cos(turn), np.sin(turn)])
        fix = adjusted(truth.photos, replace(tracks, points_px=pixels))
        error = fix.points_km[point] - truth.points_km[point]
        far = float(error @ np.linalg.pinv(fix.covariance_points_km2[point]) @ error) if np.isfinite(error).all() else 0
        assert far < 25.0 or fix.point_status[point] in (PointStatus.UNCHECKED, PointStatus.AMBIGUOUS)


def test_considered_points_widen_the_poses_by_their_covariance_and_fixed_ones_do_not() -> None:
    truth = world(6, points=12)
    known = replace(
        truth.tracks, points_km=truth.points_km, covariance_points_km2=np.tile(4e-6 * np.eye(3), (12, 1, 1))
    )
    fixes = [adjusted(truth.photos, known, replace(ALL, points=each)) for each in (Treatment.FIXED, Treatment.CONSIDER)]
    assert_allclose(fixes[0].poses[1], fixes[1].poses[1], rtol=0, atol=1e-7)
    fixed, considered = (np.sqrt(np.diagonal(fix.covariance_poses, axis1=1, axis2=2)) for fix in fixes)
    assert (considered > fixed * 1.02).all()
    errors = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        moved = replace(known, points_km=truth.points_km + rng.normal(0.0, 2e-3, (12, 3)))
        errors.append(adjusted(truth.photos, moved, replace(ALL, points=Treatment.FIXED)).poses[1] - fixes[0].poses[1])
    expected = np.sqrt(considered[:, 3:] ** 2 - fixed[:, 3:] ** 2)
    assert_allclose(np.std(errors, axis=0) / expected, 1.0, rtol=0, atol=0.2)  # 300 trials: 0.04, of 18 the largest
    assert_allclose(np.diagonal(fixes[1].covariance_points_km2, axis1=1, axis2=2), 4e-6)


def test_a_direction_that_is_held_has_no_covariance_and_a_free_frame_is_named() -> None:
    truth = world(7)
    covariance = np.diag([1e-6] * 3 + [2.5e-3] * 3)
    axis = np.array([0.0, 0.0, 0.0, 1.0, 2.0, 2.0]) / 3.0
    singular = covariance - 2.5e-3 * np.outer(axis, axis)
    fix = adjusted([replace(p, covariance_pose=singular) for p in truth.photos], truth.tracks)
    for number, photo in enumerate(truth.photos):
        assert abs((fix.photos[number].position_km - photo.position_km) @ axis[3:]) < 1e-12
        assert abs(axis @ fix.covariance_poses[number] @ axis) < 1e-15
    free = adjusted([replace(p, covariance_pose=None) for p in truth.photos], truth.tracks)
    assert "7 of 7" in free.datum
    assert all(np.isinf(each.sigma) for each in free.frame)
    scale = adjusted(
        [replace(p, covariance_pose=np.diag([1e-8] * 3 + [np.inf] * 3)) for p in truth.photos], truth.tracks
    )
    infinite = [each.name for each in scale.frame if np.isinf(each.sigma)]
    assert infinite == ["shift x", "shift y", "shift z", "scale"]


def test_positions_of_the_other_sign_are_named() -> None:
    truth = world(8)
    outcome = adjust([replace(p, position_km=-p.position_km) for p in truth.photos], truth.tracks)
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.DEGENERATE_GEOMETRY
    assert "opposite sign" in outcome.detail


def test_poses_of_few_points_and_parts_without_common_points_are_named() -> None:
    truth = world(9)
    loose = [replace(p, covariance_pose=None) for p in truth.photos]
    few = kept(truth.tracks, np.flatnonzero((truth.tracks.photo != 5) | (truth.tracks.point < 2)))
    outcome = adjust(loose, few)
    assert isinstance(outcome, Failure)
    assert "image 5 (2)" in outcome.detail
    parts = kept(truth.tracks, np.flatnonzero((truth.tracks.photo < 3) == (truth.tracks.point < 20)))
    outcome = adjust(loose, parts)
    assert isinstance(outcome, Failure)
    assert "image 0, image 1, image 2 | image 3, image 4, image 5" in outcome.detail
    assert isinstance(adjust(truth.photos, parts), NetworkFix)


def test_measures_of_which_none_agrees_are_a_failure() -> None:
    truth = world(12, points=8)
    tracks = kept(truth.tracks, np.flatnonzero(truth.tracks.photo == truth.tracks.point % 6))
    outcome = adjust(truth.photos, tracks)
    assert isinstance(outcome, Failure)
    assert outcome.reason is Reason.TOO_FEW_MATCHES


def test_misuse_is_refused_in_one_line() -> None:
    truth = world(10, points=4, images=2)
    tracks = truth.tracks
    cases = [
        ({"point": np.zeros(8, dtype=int)}, "measured twice"),
        ({"points_px": np.full((8, 2), np.nan)}, "must be finite"),
        ({"sigma_px": np.zeros(8)}, "sigma_px must be finite and > 0"),
        ({"covariance_points_km2": np.tile(np.diag([1.0, 1.0, -1.0]), (4, 1, 1))}, "negative variance"),
        ({"covariance_points_km2": np.tile(np.eye(3), (4, 1, 1))}, "needs an a priori position"),
    ]
    for change, text in cases:
        with pytest.raises(InputError, match=text):
            replace(tracks, **change)  # type: ignore[arg-type]
    indefinite = np.eye(6)
    indefinite[0, 1] = indefinite[1, 0] = 2.0
    for covariance, text in ((indefinite, "positive semi-definite"), (np.full((6, 6), np.nan), "must be finite")):
        with pytest.raises(InputError, match=text):
            replace(truth.photos[0], covariance_pose=covariance)
    with pytest.raises(InputError, match="outside of image"):
        adjust([replace(p, columns=100, rows=100) for p in truth.photos], tracks)
    with pytest.raises(InputError, match="need a body"):
        adjust(truth.photos, tracks, options=NetworkOptions(pole=Treatment.ESTIMATE))
    with pytest.raises(InputError, match="camera needs sigma_camera"):
        NetworkOptions(camera=Treatment.ESTIMATE)
    with pytest.raises(InputError, match="500000 points"):
        Tracks(names=("p",) * 1_000_000, point=np.zeros(0, int), photo=np.zeros(0, int), points_px=np.zeros((0, 2)),
               sigma_px=np.array(1.0))  # fmt: skip
    fast = Rotating(pole_ra_deg=np.zeros(1), pole_dec_deg=np.full(1, 90.0), pm_deg=np.array([0.0, 1e9]))
    with pytest.raises(InputError, match="while light crosses"):
        adjust(truth.photos, tracks, body=fast)


def test_measures_and_points_lie_in_the_order_of_points_whatever_came() -> None:
    truth = world(11, points=5)
    order = np.random.default_rng(1).permutation(30)
    shuffled = kept(truth.tracks, order)
    assert_allclose(shuffled.points_px, truth.tracks.points_px)
    assert (np.diff(shuffled.point) >= 0).all()
