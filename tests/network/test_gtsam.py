"""Minima and covariances of networks beside those of GTSAM (in the extra ``dev``)."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.frames import rotate
from giantlike.network import NetworkFix, NetworkOptions, Photo, Tracks, adjust
from tests.network.networks import world
from tests.network.test_real_networks import apollo, apollo_network, kept_points, vesta

pytestmark = pytest.mark.slow
gtsam: Any = pytest.importorskip("gtsam")
__all__ = ["apollo", "apollo_network"]  # fixtures

ALL = NetworkOptions(outlier_sigmas=math.inf, loss="linear")  # type: ignore[arg-type]
AGREES = 1e-4
CAUCHY = 2.385 * math.sqrt(2.0)  # scale of the loss of ours for two coordinates, in standard deviations


def pose_in_body_axes(photo: Photo) -> Any:
    """Pose of the camera in axes of the body, as GTSAM has it."""
    camera_from_body = photo.camera_from_inertial * photo.inertial_from_body
    return gtsam.Pose3(
        gtsam.Rot3(camera_from_body.inv().as_matrix()), rotate(photo.inertial_from_body.inv(), photo.position_km)
    )


def tangent(photo: Photo) -> Float:
    """Tangent of a pose of GTSAM, all in camera axes, by a rotation vector and a position of ours."""
    result = -np.eye(6)
    result[3:, 3:] = photo.camera_from_inertial.as_matrix()
    return result


def graph_of(photos: list[Photo], tracks: Tracks, *, robust: bool = False) -> Any:
    """Measures and a priori values; an image whose covariance is zero is held."""
    graph = gtsam.NonlinearFactorGraph()
    calibrations = []
    for k, photo in enumerate(photos):
        assert isinstance(photo.model, PinholeModel)
        fx, fy, cx, cy = photo.model.parameters[:4]
        calibrations.append(gtsam.Cal3_S2(fx, fy, 0.0, cx, cy))
        if photo.covariance_pose is None:
            continue
        pose, key = pose_in_body_axes(photo), gtsam.symbol("x", k)
        if photo.covariance_pose.any():  # a prior of the whole pose would couple its two errors to second order
            body = photo.inertial_from_body.inv().as_matrix()
            turn, place = photo.covariance_pose[:3, :3], body @ photo.covariance_pose[3:, 3:] @ body.T
            turn, place = (gtsam.noiseModel.Gaussian.Covariance(each) for each in (turn, place))
            graph.add(gtsam.PoseRotationPrior3D(key, pose.rotation(), turn))
            graph.add(gtsam.PoseTranslationPrior3D(key, pose.translation(), place))
        else:
            graph.add(gtsam.NonlinearEqualityPose3(key, pose))
    for i, covariance in enumerate(np.asarray(tracks.covariance_points_km2)):
        if np.isfinite(covariance).all():
            noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
            graph.add(gtsam.PriorFactorPoint3(gtsam.symbol("p", i), np.asarray(tracks.points_km)[i], noise))
    noises = {sigma: gtsam.noiseModel.Isotropic.Sigma(2, sigma) for sigma in set(tracks.sigma_px.tolist())}
    if robust:
        loss = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY)
        noises = {sigma: gtsam.noiseModel.Robust.Create(loss, noise) for sigma, noise in noises.items()}
    for i, k, pixel, sigma in zip(tracks.point, tracks.photo, tracks.points_px, tracks.sigma_px, strict=True):
        graph.add(
            gtsam.GenericProjectionFactorCal3_S2(
                pixel, noises[sigma], gtsam.symbol("x", k), gtsam.symbol("p", i), calibrations[k]
            )
        )
    return graph


def values_of(photos: tuple[Photo, ...], points_km: Float) -> Any:
    """Estimates of all poses and points."""
    values = gtsam.Values()
    for k, photo in enumerate(photos):
        values.insert(gtsam.symbol("x", k), pose_in_body_axes(photo))
    for i, point in enumerate(points_km):
        values.insert(gtsam.symbol("p", i), point)
    return values


def optimum(graph: Any, start: Any) -> Any:
    """Minimum by Levenberg-Marquardt; its default tolerance of 1e-5 ends beside it."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    parameters.setAbsoluteErrorTol(0.0)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()


def known_vesta(data_dir: Path) -> tuple[list[Photo], Tracks]:
    """Vesta, as the other code was given it."""
    folder = data_dir / "networks" / "vesta"
    if not folder.is_dir():
        pytest.skip(f"{folder} is missing")
    return vesta(folder, sign=-1.0, min_views=4, sigma_px=0.5, apriori=(0.05, 10.0))


def network(name: str, apollo_network: tuple[list[Photo], Tracks], data_dir: Path) -> tuple[list[Photo], Tracks]:
    """Five networks: known poses, known points, two images held, and two real ones."""
    if name == "Apollo, one image held":
        photos, tracks = apollo_network
        return [replace(photos[0], covariance_pose=np.zeros((6, 6))), *photos[1:]], tracks
    if name == "Vesta":
        photos, tracks = vesta(
            data_dir / "networks" / "vesta", sign=-1.0, min_views=4, sigma_px=0.5, apriori=(0.05, 10)
        )
        return photos, kept_points(tracks, 400)
    truth = world(21, sigma_pose=(2e-4, 0.02))
    if name == "known poses":
        return truth.photos, truth.tracks
    if name == "known points":
        covariances = np.full((40, 3, 3), np.diag([np.inf] * 3))
        covariances[:8] = np.diag([1e-4, 4e-4, 9e-4]) + 5e-5
        moved = truth.points_km + np.random.default_rng(2).normal(0.0, 0.01, (40, 3))
        known = replace(truth.tracks, points_km=moved, covariance_points_km2=covariances)
        return [replace(photo, covariance_pose=None) for photo in truth.photos], known
    held = [replace(photo, covariance_pose=np.zeros((6, 6))) for photo in truth.photos[:2]]
    return [*held, *(replace(photo, covariance_pose=None) for photo in truth.photos[2:])], truth.tracks


@pytest.mark.parametrize("name", ["known poses", "known points", "two images held", "Apollo, one image held", "Vesta"])
def test_minimum_and_marginal_covariances_are_those_of_gtsam(
    name: str, apollo_network: tuple[list[Photo], Tracks], data_dir: Path
) -> None:
    photos, tracks = network(name, apollo_network, data_dir)
    fix = adjust(photos, tracks, options=ALL)
    assert isinstance(fix, NetworkFix), fix
    graph, start = graph_of(photos, tracks), values_of(fix.photos, fix.points_km)
    values = optimum(graph, start)
    assert graph.error(start) <= (1.0 + AGREES) * graph.error(values)
    marginals = gtsam.Marginals(graph, values)
    for k, photo in enumerate(fix.photos):
        back = np.linalg.inv(tangent(photo))
        theirs = back @ marginals.marginalCovariance(gtsam.symbol("x", k)) @ back.T
        apriori = photos[k].covariance_pose
        if apriori is not None and not apriori.any():
            assert_allclose(theirs, 0.0, atol=1e-15)
            continue
        assert_allclose(np.sqrt(np.diag(fix.covariance_poses[k])), np.sqrt(np.diag(theirs)), rtol=AGREES)
    for i, covariance in enumerate(fix.covariance_points_km2):
        theirs = marginals.marginalCovariance(gtsam.symbol("p", i))
        assert_allclose(np.sqrt(np.diag(covariance)), np.sqrt(np.diag(theirs)), rtol=AGREES)


def test_robust_fit_of_vesta_ends_at_the_cost_of_gtsam(data_dir: Path) -> None:
    photos, tracks = known_vesta(data_dir)
    tracks = kept_points(tracks, 5000)
    fix = adjust(photos, tracks, options=NetworkOptions(outlier_sigmas=math.inf))
    assert isinstance(fix, NetworkFix), fix
    graph, start = graph_of(photos, tracks, robust=True), values_of(fix.photos, fix.points_km)
    values = optimum(graph, values_of(tuple(photos), fix.points_km))
    print(f"cost {graph.error(start):.2f}, by GTSAM {graph.error(values):.2f}")
    assert_allclose(graph.error(start), graph.error(values), rtol=AGREES)
