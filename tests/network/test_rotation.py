"""Pole, prime meridian and rate by landmarks: near the Fisher bound, consistent, carried to J2000; degenerate sets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from benchmarks.network import nees
from giantlike.calibration.observability import ParameterVerdict
from giantlike.calibration.options import Treatment
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.network import NetworkFix, NetworkOptions, Photo, Rotating, Tracks, adjust
from tests.network.networks import CAMERA, looking_at_center, world
from tests.sizes import slow

FOCAL_PX, SIGMA_PX, RADIUS_KM = 10_000.0, 0.3, 0.25
TRUE_DEG = np.array([85.65, -60.37, 140.0])  # of a body like Bennu
RATE_DEG_DAY = 2010.0
PERIOD_S = 360.0 / RATE_DEG_DAY * 86400.0
EPOCH_S = 5.9e8
SIGMA_POINT_KM, SIGMA_POSE = 0.0005, np.array([5e-6] * 3 + [0.0125] * 3)
OPTIONS = NetworkOptions(pole=Treatment.ESTIMATE, w=Treatment.ESTIMATE, rate=Treatment.ESTIMATE)


def inertial_from_body(ra_deg: float, dec_deg: float, w_deg: float) -> Float:
    """Matrix (3, 3) by the definition of the angles: node, pole and prime meridian as vectors."""
    ra, dec, w = np.radians([ra_deg, dec_deg, w_deg])
    pole = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    node = np.array([-np.sin(ra), np.cos(ra), 0.0])
    x = np.cos(w) * node + np.sin(w) * np.cross(pole, node)
    return np.stack([x, np.cross(pole, x), pole], axis=1)


def truth_at(et: float) -> Float:
    """RA, Dec, W, deg."""
    return np.asarray(TRUE_DEG + np.array([0.0, 0.0, RATE_DEG_DAY * (et - EPOCH_S) / 86400.0]))


def scene(
    seed: int, *, revolutions: float = 1.0, images: int = 15, points: int = 40
) -> tuple[Rotating, list[Photo], Tracks, Float, Float]:
    """Landmarks of a rotating body of 200 px, with a declared rotation that errs.

    Returns the declared rotation, photos, tracks, true positions and attitudes of the cameras.
    """
    rng = np.random.default_rng(seed)
    camera = PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=511.5, cy_px=511.5)
    landmarks = rng.normal(size=(points, 3))
    landmarks *= RADIUS_KM / np.linalg.norm(landmarks, axis=1)[:, None]
    ets = EPOCH_S + np.linspace(0.0, revolutions * PERIOD_S, images)
    angle = 0.03 * np.arange(images)
    positions = 24.0 * np.stack([np.cos(angle), np.sin(angle), np.full(images, 0.3)], axis=1)
    attitudes = looking_at_center(positions)
    point, photo, pixels, photos = [], [], [], []
    for k in range(images):
        body = inertial_from_body(*truth_at(ets[k])) @ landmarks.T
        seen = np.flatnonzero(positions[k] @ body > 0.3 * RADIUS_KM * np.linalg.norm(positions[k]))
        look = (body[:, seen].T - positions[k]) @ attitudes[k].as_matrix().T
        error = rng.normal(size=6) * SIGMA_POSE
        photos.append(
            Photo(name=str(k), model=camera, camera_from_inertial=Rotation.from_rotvec(-error[:3]) * attitudes[k],
                  position_km=positions[k] - error[3:], covariance_pose=np.diag(SIGMA_POSE**2), et=float(ets[k]))
        )  # fmt: skip
        point += seen.tolist()
        photo += [k] * len(seen)
        pixels.append(FOCAL_PX * look[:, :2] / look[:, 2:] + 511.5 + rng.normal(0.0, SIGMA_PX, (len(seen), 2)))
    tracks = Tracks(
        names=tuple(str(number) for number in range(points)), point=np.array(point), photo=np.array(photo),
        points_px=np.concatenate(pixels), sigma_px=np.array(SIGMA_PX),
        points_km=landmarks + rng.normal(0.0, SIGMA_POINT_KM, (points, 3)),
        covariance_points_km2=np.tile(SIGMA_POINT_KM**2 * np.eye(3), (points, 1, 1)),
    )  # fmt: skip
    mean = float(ets.mean())
    rate = RATE_DEG_DAY * (1.0 + 1e-4 * rng.normal())
    ra, dec, w = truth_at(mean) + np.array([0.4, 0.2, 0.3]) * rng.normal(size=3)
    declared = Rotating(
        pole_ra_deg=np.array([ra]), pole_dec_deg=np.array([dec]), pm_deg=np.array([w - rate * mean / 86400.0, rate])
    )
    return declared, photos, tracks, positions, landmarks


def fisher(photos: list[Photo], tracks: Tracks, positions: Float, landmarks: Float) -> Float:
    """Covariance (4, 4) of RA, Dec, W at the mean epoch, deg, and rate, deg/day, with everything else estimated."""
    m, p = len(photos), len(landmarks)
    attitudes = looking_at_center(positions).as_matrix()
    mean = np.mean([photo.et for photo in photos])
    sigma_rate = 1e-4 * RATE_DEG_DAY
    tilt = 2.0 / np.cos(np.radians(TRUE_DEG[1]))
    priors = np.concatenate([[tilt, 2.0, 2.0, sigma_rate], np.tile(SIGMA_POSE, m), np.full(3 * p, SIGMA_POINT_KM)])
    information = np.diag(priors**-2.0)

    def project(k: int, i: int, change: Float) -> Float:
        angles = truth_at(photos[k].et) + change[:3] + [0.0, 0.0, change[3] * (photos[k].et - mean) / 86400.0]
        x = inertial_from_body(*angles) @ (landmarks[i] + change[10:])
        look = Rotation.from_rotvec(change[4:7]).as_matrix() @ attitudes[k] @ (x - positions[k] - change[7:10])
        return np.asarray(FOCAL_PX * look[:2] / look[2])

    for i, k in zip(tracks.point, tracks.photo, strict=True):
        step = np.array([1e-4] * 3 + [1e-3] + [1e-7] * 3 + [1e-5] * 6)
        columns = [
            (project(k, i, step * unit) - project(k, i, -step * unit)) / (2.0 * step @ unit) for unit in np.eye(13)
        ]
        jacobian = np.stack(columns, axis=1) / SIGMA_PX
        rows = np.r_[0:4, 4 + 6 * k : 10 + 6 * k, 4 + 6 * m + 3 * i : 7 + 6 * m + 3 * i]
        information[np.ix_(rows, rows)] += jacobian.T @ jacobian
    scale = 1.0 / np.sqrt(np.diag(information))
    covariance: Float = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return covariance[:4, :4]


def adjusted(declared: Rotating, photos: list[Photo], tracks: Tracks, options: NetworkOptions = OPTIONS) -> NetworkFix:
    fix = adjust(photos, tracks, body=declared, options=options)
    assert isinstance(fix, NetworkFix), fix
    return fix


@pytest.mark.parametrize(("revolutions", "scenes"), [(1.0, 4), slow(1.0, 24), slow(5.0, 24)])
def test_rotation_is_as_precise_as_the_geometry_allows_and_its_covariance_holds(
    revolutions: float, scenes: int
) -> None:
    errors, total = [], 0.0
    for seed in range(scenes):
        declared, photos, tracks, positions, landmarks = scene(seed, revolutions=revolutions)
        fix = adjusted(declared, photos, tracks)
        bound = fisher(photos, tracks, positions, landmarks)
        assert fix.body is not None
        assert fix.body.covariance_j2000 is not None
        days = fix.mean_et / 86400.0
        to_mean = np.eye(4)
        to_mean[2, 3] = days  # of W at the mean epoch of what was carried to J2000
        stated = to_mean @ fix.body.covariance_j2000 @ to_mean.T
        assert_allclose(np.sqrt(np.diag(stated) / np.diag(bound)), 1.0, rtol=0, atol=0.05)  # rejected measures
        ra, dec, w = fix.body.angles_deg(fix.mean_et)
        error = np.array([ra, dec, w, fix.body.pm_deg[1]]) - [*truth_at(fix.mean_et), RATE_DEG_DAY]
        error[2] = (error[2] + 180.0) % 360.0 - 180.0
        total += float(error @ np.linalg.solve(bound, error))
        errors.append(error / np.sqrt(np.diag(bound)))
    assert np.sqrt(np.mean(np.square(errors), axis=0)).max() < 1.3 * (1.0 + 2.0 / np.sqrt(2.0 * scenes))
    apart = 4.0 * np.sqrt(2.0 / (4.0 * scenes))  # sigmas of a mean of squares
    assert 1.0 - apart < total / (4.0 * scenes) < 1.0 + apart


def test_terms_that_are_not_estimated_stay_as_they_are_declared() -> None:
    declared, photos, tracks, *_ = scene(3)
    days = float(np.mean([photo.et for photo in photos])) / 86400.0
    further = replace(  # as declared at the mean epoch
        declared,
        pole_ra_deg=declared.pole_ra_deg + np.array([-0.02 * days / 36525.0, 0.02, 0.0]),
        pm_deg=declared.pm_deg + np.array([1e-6 * days**2, -2e-6 * days, 1e-6]),
    )
    fix = adjusted(further, photos, tracks)
    assert fix.body is not None
    assert fix.body.pole_ra_deg[1] == 0.02
    assert fix.body.pm_deg[2] == 1e-6
    plain = adjusted(declared, photos, tracks).body
    assert plain is not None
    first, second = (each.inertial_from_body(fix.mean_et).as_matrix() for each in (fix.body, plain))
    assert_allclose(first, second, rtol=0, atol=1e-5)
    assert fix.support[0].verdict is ParameterVerdict.SUPPORTED


def test_orientations_are_those_of_the_definition() -> None:
    body = Rotating(pole_ra_deg=np.array([10.0]), pole_dec_deg=np.array([20.0]), pm_deg=np.array([30.0, 100.0]))
    assert_allclose(
        body.inertial_from_body(43_200.0).as_matrix(), inertial_from_body(10.0, 20.0, 80.0), rtol=0, atol=1e-14
    )


def test_what_images_do_not_determine_is_told_and_is_supported_in_a_well_conditioned_twin() -> None:
    # rate: images of one moment, against images over twenty revolutions
    declared, photos, tracks, *_ = scene(5)
    same_time = [replace(photo, et=photos[0].et + 1e-3 * k) for k, photo in enumerate(photos[:3])]
    few = np.flatnonzero(tracks.photo < 3)
    part = replace(tracks, point=tracks.point[few], photo=tracks.photo[few], points_px=tracks.points_px[few],
                   sigma_px=tracks.sigma_px[few])  # fmt: skip
    verdicts = {each.name: each.verdict for each in adjusted(declared, same_time, part).support}
    assert verdicts["rate"] is ParameterVerdict.PRIOR_ONLY
    declared, photos, tracks, *_ = scene(5, revolutions=20.0)
    verdicts = {each.name: each.verdict for each in adjusted(declared, photos, tracks).support}
    assert set(verdicts.values()) == {ParameterVerdict.SUPPORTED}
    # size: free points, against known ones with attitude and range known as well
    truth = world(31)
    size = NetworkOptions(size=Treatment.ESTIMATE)
    free = adjust(truth.photos, truth.tracks, options=size).unwrap()
    assert [each.verdict for each in free.support] == [ParameterVerdict.PRIOR_ONLY]
    exact = np.tile(1e-6 * np.eye(3), (40, 1, 1))
    known = replace(truth.tracks, points_km=truth.points_km, covariance_points_km2=exact)
    poses = np.diag([1e-10] * 3 + [1e-6] * 3)
    close = [replace(p, camera_from_inertial=truth.rotations[k], position_km=truth.positions_km[k],
                     covariance_pose=poses) for k, p in enumerate(truth.photos)]  # fmt: skip
    held = adjust(close, known, options=size).unwrap()
    assert [each.verdict for each in held.support] == [ParameterVerdict.SUPPORTED]
    # focal length and free ranges over flat ground, against known positions
    camera = NetworkOptions(camera=Treatment.ESTIMATE, sigma_camera={"fx_px": 100.0, "fy_px": 100.0})
    flat, places = truth.points_km * [0.0, 1.0, 1.0], np.array([[10.0, 0.0, 0.01 * k] for k in range(6)])
    down = looking_at_center(places * [1.0, 0.0, 0.0])
    poses = np.diag([1e-12] * 3 + [np.inf] * 3)
    loose = [replace(p, camera_from_inertial=down[k], position_km=places[k],
                     covariance_pose=poses) for k, p in enumerate(truth.photos)]  # fmt: skip
    pixels = np.concatenate([CAMERA.project(down[k].apply(flat - places[k])) for k in range(6)])
    ground = replace(known, points_km=flat, points_px=pixels[np.argsort(np.tile(np.arange(40), 6), kind="stable")])
    fix = adjust(loose, ground, options=camera).unwrap()
    assert ParameterVerdict.SUPPORTED not in {each.verdict for each in fix.support}
    assert fix.weak
    fix = adjust(close, known, options=camera).unwrap()
    assert {each.verdict for each in fix.support} == {ParameterVerdict.SUPPORTED}


def test_errors_of_networks_with_outliers_have_their_covariance_and_without_rejection_have_not() -> None:
    found = np.array([nees(seed) for seed in range(6)])
    assert (found.mean(axis=0) > 0.8).all()
    assert (found.mean(axis=0) < 1.25).all()
    assert_allclose(np.isfinite(found), True)
