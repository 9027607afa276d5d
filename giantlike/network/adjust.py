"""Adjustment of a network: start, outliers, minimum."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from giantlike._system.processes import one_thread
from giantlike.calibration.options import Loss, Treatment
from giantlike.core.arrays import Float, Mask, require
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.units import SPEED_OF_LIGHT_KM_S
from giantlike.network.covariance import make_fix
from giantlike.network.options import NetworkOptions
from giantlike.network.outliers import exchange, find_agreeing, noise_of
from giantlike.network.photos import Photo, Tracks, require_photos
from giantlike.network.problem import Problem, State
from giantlike.network.result import NetworkFix
from giantlike.network.rotation import Rotating
from giantlike.processing.levenberg_marquardt import ROUGHLY, minimize

_MIN_POINTS = 3  # that determine a pose
_MAX_LIGHT_TIME = 0.1  # sigmas of a measure that light time across the body may move a point


@one_thread()
def adjust(
    photos: Sequence[Photo], tracks: Tracks, *, body: Rotating | None = None, options: NetworkOptions | None = None
) -> NetworkFix | Failure:
    """Adjust points, poses, and the rotation, size and camera that all images share, to measures of points in images.

    Parameters
    ----------
    photos : sequence of Photo; cameras and a priori poses
    tracks : Tracks; measures, and a priori points where there are any
    body : Rotating, optional; rotation of the body, which then replaces the orientations of the photos
    options : NetworkOptions, optional

    Returns
    -------
    NetworkFix or Failure
        Failure reasons: degenerate_geometry (poses with too few points, parts without common points, points behind
        their cameras), too_few_matches, not_converged.

    Raises
    ------
    InputError
        A measure lies outside of its image, or a group is estimated of which nothing is declared.

    Notes
    -----
    Points are eliminated block by block (Schur complement); the reduced system of poses and shared parameters is dense.
    Light time and aberration are those of the center of the body, in the a priori poses; what light time across a
    rotating body adds is refused above 0.1 standard deviations of a measure.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from giantlike.camera_models import PinholeModel
    >>> from giantlike.network import Photo, Tracks, adjust
    >>> camera = PinholeModel(fx_px=1000.0, fy_px=1000.0, cx_px=511.5, cy_px=511.5)
    >>> points = np.random.default_rng(1).uniform(-1.0, 1.0, (20, 3))
    >>> photos = [
    ...     Photo(name=f"image {k}", model=camera, camera_from_inertial=Rotation.from_rotvec([0.0, angle, 0.0]),
    ...           position_km=Rotation.from_rotvec([0.0, -angle, 0.0]).apply([0.0, 0.0, -10.0]),
    ...           covariance_pose=np.diag([1e-6] * 3 + [0.1] * 3))
    ...     for k, angle in enumerate((-0.3, 0.0, 0.3))
    ... ]
    >>> seen = [p.model.project(p.camera_from_inertial.apply(points - p.position_km)) for p in photos]
    >>> tracks = Tracks(
    ...     names=tuple("abcdefghijklmnopqrst"), point=np.tile(np.arange(20), 3), photo=np.repeat(np.arange(3), 20),
    ...     points_px=np.concatenate(seen), sigma_px=0.2,
    ... )
    >>> fix = adjust(photos, tracks)
    >>> bool(np.abs(fix.points_km - points).max() < 1e-6)
    True
    """
    options = NetworkOptions() if options is None else options
    require_photos(photos, tracks)
    start = np.array(tracks.points_km)
    unknown = np.isnan(start).any(axis=1)
    require(
        not unknown.any() or options.points is Treatment.ESTIMATE,
        f"points {options.points}: all points need a priori positions, {int(unknown.sum())} have none",
    )
    problem = Problem.from_photos(photos, tracks, body, options, np.where(unknown[:, None], 1.0, start))
    if unknown.any():
        found = np.where(unknown[:, None], _intersect(problem), start)
        problem = Problem.from_photos(photos, tracks, body, options, found)
    seen = np.asarray(np.isfinite(problem.predict(problem.start)).all(axis=1))
    if not 2 * int(seen.sum()) > len(seen):
        return Failure(
            Reason.DEGENERATE_GEOMETRY,
            f"{int((~seen).sum())} of {len(seen)} points lie behind their camera: positions have the opposite sign, or "
            "the network is mirrored (its pixels fit exactly as well)",
        )
    _require_one_light_time(problem, body)
    used = _keep_supported(problem, seen)
    refused = _find_refusal(problem, used)
    return refused if refused is not None else _fit(problem, used, body)


def _intersect(problem: Problem) -> Float:
    """Points (p, 3), km, body axes, nearest to the lines of sight of their measures."""
    tracks, state = problem.tracks, problem.start
    bodies = problem.inertial_from_body(state)
    axes = np.swapaxes(state.rotation.as_matrix() @ bodies, 1, 2)
    centers = np.einsum("mji,mj->mi", bodies, state.position)
    rays = np.empty((len(tracks.point), 3))
    models = np.array(problem.models)[tracks.photo]
    for number, model in enumerate(state.models):
        rays[models == number] = model.unproject(tracks.points_px[models == number])
    rays = np.einsum("nij,nj->ni", axes[tracks.photo], np.nan_to_num(rays))
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    total = np.zeros((len(tracks.names), 3, 3))
    right = np.zeros((len(tracks.names), 3))
    np.add.at(total, tracks.point, across)
    np.add.at(right, tracks.point, np.einsum("nij,nj->ni", across, centers[tracks.photo]))
    return np.asarray(np.linalg.solve(total + 1e-12 * np.eye(3), right[..., None])[..., 0])


def _keep_supported(problem: Problem, used: Mask) -> Mask:
    """Measures (n,) in use without those of points that they do not determine."""
    enough = np.bincount(problem.tracks.point, used, len(problem.tracks.names)) >= 2
    enough |= (problem.points.known | problem.points.held).all(axis=1)
    return np.asarray(used & enough[problem.tracks.point])


def _keep_trusted(problem: Problem, state: State, used: Mask, offered: Mask) -> Mask:
    """Measures (n,) in use without those of images most of whose measures are rejected and whose pose left its prior.

    The few that are left were matched wrongly as well: alone they take the pose along.
    """
    from scipy.special import chdtri, ndtr

    count, photo = len(problem.photos), problem.tracks.photo
    known = problem.poses.known
    left = np.sum(np.where(known, problem.prior_poses(state)[0], 0.0) ** 2, axis=1)
    limit = chdtri(known.sum(axis=1), 2.0 * ndtr(-problem.options.outlier_sigmas))
    few = 2 * np.bincount(photo, used, count) < np.bincount(photo, offered, count)
    return np.asarray(used & ~(few & (left > limit))[photo])


def _find_refusal(problem: Problem, used: Mask) -> Failure | None:
    """Failure where poses are not determined, or parts of the network share no point."""
    tracks, photos = problem.tracks, problem.photos
    if not used.any():
        return Failure(
            Reason.TOO_FEW_MATCHES, f"none of {len(used)} measures agrees with another: check poses and points"
        )
    counts = np.bincount(tracks.photo, used, len(photos))
    loose = ~(problem.poses.known | problem.poses.held).all(axis=1)
    poor = np.flatnonzero(loose & (counts < _MIN_POINTS))
    if len(poor):
        names = ", ".join(f"{photos[k].name} ({int(counts[k])})" for k in poor[:5])
        return Failure(
            Reason.DEGENERATE_GEOMETRY,
            f"a pose without an a priori covariance needs at least {_MIN_POINTS} points; fewer are in {names}",
        )
    links = (tracks.photo[used], len(photos) + tracks.point[used])
    size = len(photos) + len(tracks.names)
    count, part = connected_components(coo_matrix((np.ones(len(links[0])), links), (size, size)), directed=False)
    groups = [[photos[k].name for k in np.flatnonzero(part[: len(photos)] == number)] for number in range(count)]
    groups = [group for group in groups if group]
    if len(groups) > 1 and loose.any():
        text = " | ".join(", ".join(group[:4]) + (", ..." if len(group) > 4 else "") for group in groups[:4])
        return Failure(
            Reason.DEGENERATE_GEOMETRY,
            f"the images are {len(groups)} groups that share no point: {text}; adjust each by itself, or give their "
            "poses a priori covariances",
        )
    return None


def _require_one_light_time(problem: Problem, body: Rotating | None) -> None:
    """Refuse bodies that rotate by more than 0.1 sigma while light crosses them."""
    if body is None:
        return
    tracks, state = problem.tracks, problem.start
    radius = float(np.quantile(np.linalg.norm(problem.points_km(state), axis=1), 0.9))
    rate = abs(math.radians(float(body.pm_deg[1]))) / 86400.0
    moved_km = rate * radius * radius / SPEED_OF_LIGHT_KM_S
    range_km = np.linalg.norm(state.position, axis=1)[tracks.photo]
    focal = np.array([state.models[k].focal_length_px for k in problem.models])[tracks.photo]
    worst = float(np.max(moved_km / range_km * focal / tracks.sigma_px))
    require(
        worst <= _MAX_LIGHT_TIME,
        f"while light crosses the body it rotates by up to {worst:.2g} standard deviations of a measure, and light "
        f"time is that of its center: at most {_MAX_LIGHT_TIME} is allowed; larger sigmas or ranges are needed",
    )


def _fit(problem: Problem, used: Mask, body: Rotating | None) -> NetworkFix | Failure:
    """Robust fit, rounds of rejection and least squares, and the covariance."""
    options, state, steps, rounds, offered = problem.options, problem.start, 0, 0, used
    tried: set[bytes] = set()
    rejects = math.isfinite(options.outlier_sigmas)
    for rounds in range(1, options.max_rounds + 1 if rejects else 1):
        loss = options.loss if rounds == 1 else Loss.LINEAR
        linearize = partial(problem.normal_equations, used=used, loss=loss)
        found = minimize(
            state,
            linearize,
            problem.apply_step,
            max_steps=options.max_steps,
            rough=True,
            tolerance=1.0 if rounds == 1 else 0.1,
        )
        if isinstance(found, Failure):
            return found
        before, state, steps = used, found.state, steps + found.steps
        agreeing = find_agreeing(problem, state, used)
        used = _keep_supported(problem, _keep_trusted(problem, state, agreeing, offered))
        refused = _find_refusal(problem, used)
        if refused is not None:
            return refused
        if rounds > 1 and np.array_equal(used, before):
            used = exchange(problem, state, used)
            if np.array_equal(used, before) or used.tobytes() in tried:
                used = before
                break
            tried.add(used.tobytes())
    loss = Loss.LINEAR if rejects else options.loss
    linearize = partial(problem.normal_equations, used=used, loss=loss)
    minimum = minimize(
        state,
        linearize,
        problem.apply_step,
        max_steps=options.max_steps,
        tolerance=None if loss is Loss.LINEAR else ROUGHLY,  # reweighting converges linearly
    )
    if isinstance(minimum, Failure):
        return minimum
    return make_fix(
        problem, minimum.state, minimum.normal, used, noise_of(problem, minimum.state, used),
        body=body, steps=steps + minimum.steps, rounds=rounds,
    )  # fmt: skip
