"""Covariances of an adjusted network by cause, reliability of its measures, and what its images do not determine."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.calibration.observability import ParameterSupport, WeakCombination, support_of, weak_combinations
from giantlike.calibration.options import Treatment
from giantlike.core.arrays import Float, Mask, symmetric
from giantlike.core.causes import Cause
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.network._kernels import covariance_through, cross_covariance
from giantlike.network.outliers import find_alternatives
from giantlike.network.problem import (
    DIRECTIONS,
    POSE,
    NormalEquations,
    Problem,
    State,
    find_undetermined,
    frame_directions,
    mirror,
)
from giantlike.network.result import CovariancePart, FrameDirection, NetworkFix, PointStatus
from giantlike.network.rotation import Rotating

_POWER = 0.8416  # normal quantile of 80 %, the probability with which a smallest detectable error is rejected
_WEAK = 7.0  # sigma of a combination by that of its parts alone: a correlation of 0.99
_CAUSES = {"pole_east": Cause.POLE, "pole_north": Cause.POLE, "w": Cause.SPIN, "rate": Cause.SPIN,
           "size": Cause.SHAPE_SCALE}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Joint(Value):
    """Covariance of the unknowns as ``z``."""

    reduced: Float  # (r', r'); of poses and shared parameters, padded to whole blocks
    own: Float  # (p, 3, 3); of the points with all else known
    gain: Float  # (b, 3, 6); minus the change of a point with each of its blocks
    rows: NDArray[np.int64]  # as in the normal equations
    first: NDArray[np.int64]  # as in the normal equations

    def points(self, matrix: Float) -> Float:
        """Covariance (p, 3, 3) of the points by a covariance (r, r) of the reduced unknowns."""
        padded = np.zeros_like(self.reduced)
        padded[: len(matrix), : len(matrix)] = matrix
        result = np.zeros_like(self.own)
        covariance_through(result, padded, np.array(self.rows), np.array(self.first), np.array(self.gain))
        return symmetric(result)


def make_fix(
    problem: Problem,
    state: State,
    normal: NormalEquations,
    used: Mask,
    noise: float,
    *,
    body: Rotating | None,
    steps: int,
    rounds: int,
) -> NetworkFix | Failure:
    """Make the fix of a minimum, with covariances by cause, reliability and observability."""
    found = _reduced_covariances(problem, normal)
    if isinstance(found, Failure):
        return found
    total, parts_reduced, inverse = found
    rows, first, blocks = normal.blocks
    point = np.repeat(np.arange(len(inverse)), np.diff(first))
    padded = np.zeros((normal.padded_size, normal.padded_size))
    padded[: problem.size, : problem.size] = total
    joint = _Joint(reduced=padded, own=inverse, gain=inverse[point] @ np.swapaxes(blocks, 1, 2), rows=rows, first=first)
    tracks, k = problem.tracks, len(problem.names)
    freedom = 2 * int(used.sum()) - _free_unknowns(problem, used)
    scale = normal.cost / max(freedom, 1) if problem.options.scale_by_residuals else 1.0
    covariance = _total_points(problem, joint, total)
    size = 1.0 + problem.value(state, "size")
    lost = np.bincount(tracks.point, used, len(tracks.names)) == 0
    lost &= ~(problem.points.known | problem.points.held).all(axis=1)

    def points_km2(z: Float) -> Float:
        scaled = problem.points.basis * size * math.sqrt(scale)
        result: Float = symmetric(scaled @ z @ np.swapaxes(scaled, 1, 2))
        return np.where(lost[:, None, None], np.nan, result)

    parts = {
        cause: _in_units(problem, points_km2(_part_points(problem, joint, cause, each)), each, scale)
        for cause, each in parts_reduced.items()
    }
    whole = _in_units(problem, points_km2(covariance), total, scale)
    if tracks.common_sigma_km:
        common = tracks.common_sigma_km**2 * np.eye(3)
        whole = replace(whole, points_km2=whole.points_km2 + common)
        none = CovariancePart(points_km2=0.0 * whole.points_km2, poses=0.0 * whole.poses, shared=0.0 * whole.shared)
        relief = parts.get(Cause.RELIEF, none)
        parts[Cause.RELIEF] = replace(relief, points_km2=relief.points_km2 + common)
    noise_part = CovariancePart(
        points_km2=whole.points_km2 - sum(each.points_km2 for each in parts.values()),
        poses=whole.poses - sum(each.poses for each in parts.values()),
        shared=whole.shared - sum(each.shared for each in parts.values()),
    )
    redundancy, detectable = _reliability(problem, state, joint, covariance, used)
    values = problem.shared_departure(state) * problem.sigma_shared
    photos = tuple(
        replace(photo, model=state.models[problem.models[k]], camera_from_inertial=state.rotation[k],
                position_km=state.position[k], covariance_pose=whole.poses[k],
                inertial_from_body=Rotation.from_matrix(problem.inertial_from_body(state)[k]))
        for k, photo in enumerate(problem.photos)
    )  # fmt: skip
    support, weak = _observability(problem, state, total, values, scale)
    points = np.where(lost[:, None], np.nan, problem.points_km(state))
    return NetworkFix(
        photos=photos,
        tracks=tracks,
        points_km=points,
        covariance_points_km2=whole.points_km2,
        point_status=_status(problem, state, used),
        covariance_poses=whole.poses,
        body=None if body is None else _body(problem, state, body, whole.shared),
        shared_names=problem.names,
        shared=values,
        covariance_shared=whole.shared if k else np.zeros((0, 0)),
        mean_et=problem.et,
        residuals_px=tracks.points_px - problem.predict(state),
        used=used,
        redundancy=redundancy,
        detectable_px=detectable,
        noise=noise,
        chi2=normal.cost,
        freedom=freedom,
        covariance_scale=scale,
        support=support,
        weak=weak,
        frame=_frame(problem, whole.points_km2[~lost], lost),
        datum=_datum(problem),
        parts={Cause.NOISE: noise_part} | parts,
        steps=steps,
        rounds=rounds,
    )


def _in_units(problem: Problem, points_km2: Float, reduced: Float, scale: float) -> CovariancePart:
    """A part of the covariances (p, 3, 3) and, as ``z``, (r, r), multiplied by ``scale`` and in units."""
    units = problem.sigma_shared * math.sqrt(scale)
    shared = symmetric(reduced[POSE * len(problem.photos) :, POSE * len(problem.photos) :])
    return CovariancePart(
        points_km2=points_km2, poses=_poses(problem, reduced) * scale, shared=shared * np.outer(units, units)
    )


def _free_unknowns(problem: Problem, used: Mask) -> int:
    """Unknowns without an a priori value, of points and images in use."""
    free_points = (~problem.points.known & ~problem.points.held)[np.unique(problem.tracks.point[used])]
    free_poses = ~problem.poses.known & ~problem.poses.held
    estimated = problem.options.points is Treatment.ESTIMATE
    return (int(free_points.sum()) if estimated else 0) + int(free_poses.sum())


def _reduced_covariances(
    problem: Problem, normal: NormalEquations
) -> tuple[Float, dict[Cause, Float], Float] | Failure:
    """Covariance (r, r) of the reduced unknowns, its parts but the noise, and (p, 3, 3) of points, these known."""
    try:
        upper, _, inverse = normal.without_points()
        matrix = mirror(upper)
        present = np.diagonal(normal.reduced) > 0.0
        which, held = np.flatnonzero(problem.estimated & present), np.flatnonzero(~problem.estimated & present)
        total = np.zeros((problem.size, problem.size))
        if len(which):
            kept, units = normal.scale(matrix, which)
            factor = scipy.linalg.cho_factor(kept, overwrite_a=True, check_finite=False)
            found, _ = scipy.linalg.lapack.dpotri(factor[0])
            found *= units
            found *= units[:, None]
            total[np.ix_(which, which)] = mirror(found)
    except np.linalg.LinAlgError:
        return Failure(
            Reason.DEGENERATE_GEOMETRY,
            "the measures do not determine all points and poses: give a priori covariances, or leave out what is free",
        )
    causes = np.array([*_pose_causes(problem).ravel(), *(_CAUSES.get(name, Cause.CAMERA) for name in problem.names)])
    known = np.concatenate([problem.poses.known.ravel(), np.ones(len(problem.names), dtype=bool)])
    parts = {}
    considered = np.zeros((problem.size, len(held)))
    considered[np.ix_(which, np.arange(len(held)))] = -total[np.ix_(which, which)] @ matrix[np.ix_(which, held)]
    considered[held, np.arange(len(held))] = 1.0
    for cause in dict.fromkeys(causes[known].tolist()):
        own = total[:, (causes == cause) & known & problem.estimated]
        moved = considered[:, causes[held] == cause]
        parts[Cause(cause)] = own @ own.T + moved @ moved.T
    weights = np.where(problem.points.known, 1.0, 0.0)[:, :, None] * np.eye(3)
    if problem.options.points is Treatment.CONSIDER:
        inverse, relief = weights, total @ mirror(-normal.eliminate(weights)) @ total
        parts[Cause.RELIEF] = relief
        total = total + relief
    elif problem.points.known.any():
        parts[Cause.RELIEF] = total @ mirror(-normal.eliminate(inverse @ weights @ inverse)) @ total
    return total + considered @ considered.T, parts, inverse


def _pose_causes(problem: Problem) -> NDArray[np.str_]:
    """Cause (m, 6) of the a priori error of each ``z``: the larger part of a direction where both are correlated."""
    attitude = np.sum((problem.poses.basis[:, :3] * np.swapaxes(problem.poses.inverse, 1, 2)[:, :3]), axis=1)
    return np.where(attitude > 0.5, str(Cause.ATTITUDE), str(Cause.EPHEMERIS))


def _total_points(problem: Problem, joint: _Joint, total: Float) -> Float:
    """Covariance (p, 3, 3) of the points as ``z``."""
    if problem.options.points is not Treatment.ESTIMATE:
        return joint.own
    return joint.own + joint.points(total)


def _part_points(problem: Problem, joint: _Joint, cause: Cause, reduced: Float) -> Float:
    """Covariance (p, 3, 3) of the points as ``z`` by a cause."""
    if problem.options.points is not Treatment.ESTIMATE:
        return np.array(joint.own) if cause is Cause.RELIEF else np.zeros_like(joint.own)
    result = joint.points(reduced)
    if cause is not Cause.RELIEF:
        return result
    own = joint.own * problem.points.known[:, None, :]
    mixed = own @ (joint.points(joint.reduced[: problem.size, : problem.size]))
    return result + own @ np.swapaxes(own, 1, 2) + symmetric(2.0 * mixed)


def _poses(problem: Problem, reduced: Float) -> Float:
    """Covariance (m, 6, 6) of the poses."""
    m = len(problem.photos)
    blocks = reduced[: POSE * m, : POSE * m].reshape(m, POSE, m, POSE)[np.arange(m), :, np.arange(m)]
    return symmetric(problem.poses.basis @ blocks @ np.swapaxes(problem.poses.basis, 1, 2))


def _reliability(problem: Problem, state: State, joint: _Joint, points: Float, used: Mask) -> tuple[Float, Float]:
    """Redundancy (n,) of the measures, and the smallest error (n,), px, that each would be rejected for."""
    tracks, m = problem.tracks, len(problem.photos)
    found = problem.linearize(state)
    weight = 1.0 / tracks.sigma_px[:, None, None]
    by_point = found.by_point @ problem.points.basis[tracks.point] * weight
    by_pose = found.by_pose @ problem.poses.basis[tracks.photo] * weight
    by_shared = found.by_shared * problem.sigma_shared * weight
    cross = np.empty_like(joint.gain)
    reduced = np.array(joint.reduced)
    cross_covariance(cross, reduced, np.array(joint.rows), np.array(joint.first), np.array(joint.gain))
    if problem.options.points is not Treatment.ESTIMATE:
        cross[:] = 0.0
    is_pose = joint.rows < POSE * m
    size, k = POSE * m, len(problem.names)
    own = reduced[:size, :size].reshape(m, POSE, m, POSE)[np.arange(m), :, np.arange(m)][tracks.photo]
    leverage = by_point @ points[tracks.point] @ np.swapaxes(by_point, 1, 2) / 2.0
    leverage -= by_point @ cross[is_pose] @ np.swapaxes(by_pose, 1, 2)
    leverage += by_pose @ own @ np.swapaxes(by_pose, 1, 2) / 2.0
    if k:
        more = cross[~is_pose].reshape(len(tracks.names), -1, 3, POSE).swapaxes(1, 2).reshape(len(tracks.names), 3, -1)
        shared = np.swapaxes(by_shared, 1, 2)
        leverage -= by_point @ more[tracks.point][:, :, :k] @ shared
        leverage += by_pose @ reduced[:size, size : size + k].reshape(m, POSE, k)[tracks.photo] @ shared
        leverage += by_shared @ reduced[size : size + k, size : size + k] @ shared / 2.0
    left = np.eye(2) - (leverage + np.swapaxes(leverage, 1, 2))
    left[~used] = np.nan
    redundancy = np.trace(left, axis1=1, axis2=2)
    mean, apart = redundancy / 2.0, np.hypot((left[:, 0, 0] - left[:, 1, 1]) / 2.0, left[:, 0, 1])
    smallest = mean - apart
    limit = problem.options.outlier_sigmas if math.isfinite(problem.options.outlier_sigmas) else 3.5
    seen = smallest > 1e-6
    detectable = np.where(seen, (limit + _POWER) * tracks.sigma_px / np.sqrt(np.where(seen, smallest, 1.0)), np.inf)
    return redundancy, np.where(used, detectable, np.nan)


def _status(problem: Problem, state: State, used: Mask) -> NDArray[np.str_]:
    """Check of each point."""
    tracks = problem.tracks
    count = np.bincount(tracks.point, used, len(tracks.names))
    free = ~(problem.points.known | problem.points.held).all(axis=1)
    status = np.where((count <= 2) & free, PointStatus.UNCHECKED, PointStatus.CHECKED).astype("U9")
    bad, _, excess = find_alternatives(problem, state, used)
    at = tracks.point[bad[excess <= problem.options.outlier_sigmas**2]]
    status[at[status[at] != PointStatus.UNCHECKED]] = PointStatus.AMBIGUOUS
    return np.asarray(status)


def _observability(
    problem: Problem, state: State, total: Float, values: Float, scale: float
) -> tuple[tuple[ParameterSupport, ...], tuple[WeakCombination, ...]]:
    """Classify the shared parameters; attitude errors and the scale of ranges common to all images are partners."""
    m, k = len(problem.photos), len(problem.names)
    estimated = np.flatnonzero(problem.estimated[POSE * m :])
    if not len(estimated):
        return (), ()
    common = np.zeros((4, m, POSE))
    common[:3] = np.moveaxis(np.swapaxes(state.rotation.as_matrix(), 1, 2) @ problem.poses.basis[:, :3], 0, 1) / m
    ahead = state.position / np.sum(state.position**2, axis=1)[:, None]
    common[3] = np.einsum("mi,mij->mj", ahead, problem.poses.basis[:, 3:]) / m
    rows = np.zeros((len(estimated) + 4, problem.size))
    rows[np.arange(len(estimated)), POSE * m + estimated] = problem.sigma_shared[estimated]
    rows[len(estimated) :, : POSE * m] = common.reshape(4, -1)
    covariance = symmetric(rows @ total @ rows.T) * scale
    names = [problem.names[j] for j in estimated] + ["attitude x", "attitude y", "attitude z", "range"]
    known = np.flatnonzero(np.diagonal(covariance) > 0.0)
    covariance, names = covariance[np.ix_(known, known)], [names[j] for j in known]
    model = problem.start.models[0]
    is_lens = [name in model.parameter_names and not name.endswith("_px") for name in problem.names]
    start = np.zeros(k)
    for j in np.flatnonzero(is_lens):
        start[j] = model.parameters[model.parameter_names.index(problem.names[j])]
    reach = np.linalg.norm(problem.linearize(state).by_shared, axis=1)
    support = support_of(
        names,
        (start + values)[estimated],
        start[estimated],
        problem.sigma_shared[estimated],
        covariance,
        np.nanmax(reach, axis=0)[estimated],
        frozenset(name for name, lens in zip(problem.names, is_lens, strict=True) if not lens),
    )
    units = np.sqrt(np.diagonal(covariance))
    information = np.linalg.pinv(covariance / np.outer(units, units), hermitian=True) / np.outer(units, units)
    weak = weak_combinations(tuple(names), information, above=_WEAK)
    return support, tuple(each for each in weak if set(each.weights) & set(problem.names))


def _body(problem: Problem, state: State, body: Rotating, shared: Float) -> Rotating:
    """Rotation of the body after the adjustment."""
    full = np.zeros((4, 4))
    names = ("pole_east", "pole_north", "w", "rate")
    have = [(names.index(name), k) for k, name in enumerate(problem.names) if name in names]
    for i, a in have:
        for j, b in have:
            full[i, j] = shared[a, b]
    return body.correct(problem.et, state.turn, problem.value(state, "rate"), full)


def _frame(problem: Problem, covariance: Float, lost: Mask) -> tuple[FrameDirection, ...]:
    """A priori knowledge of the seven directions of the frame, and what of the points' variance it makes."""
    _, points, information = frame_directions(problem)
    radius = float(np.linalg.norm(points[0, :, 0]))
    free = find_undetermined(information)
    open_ = np.linalg.norm(free, axis=1) > 1e-3 * np.abs(free).max(initial=1.0)
    scale = np.sqrt(np.maximum(np.diagonal(information), 1e-300))
    known = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)
    total = float(np.trace(covariance, axis1=1, axis2=2).sum())
    found = []
    for k, name in enumerate(DIRECTIONS):
        variance = float(known[k, k])
        made = variance * float(np.sum(points[~lost, :, k] ** 2))
        held = bool(open_[k])
        sigma = math.inf if held else math.sqrt(max(variance, 0.0)) * (radius if k < 3 else 1.0)
        found.append(FrameDirection(name=name, sigma=sigma, share=0.0 if held else min(made / max(total, 1e-300), 1.0)))
    return tuple(found)


def _datum(problem: Problem) -> str:
    """What ties the frame of the points."""
    points = int((problem.points.known | problem.points.held).all(axis=1).sum())
    if problem.datum.shape[1]:
        return (
            f"{problem.datum.shape[1]} of 7 directions are held at the mean a priori pose: no a priori value ties them"
        )
    if points >= 3:
        return f"{points} known points"
    fixed = not {"pole_east", "w"} & set(problem.names)
    return "a priori poses" + (", with pole and W held" if fixed else "") + "; the scale comes from the a priori ranges"
