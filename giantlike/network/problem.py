"""Unknowns of a network, and its normal equations with the points eliminated block by block."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.calibration.options import Loss, Treatment
from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask, require
from giantlike.core.errors import InputError
from giantlike.core.frames import skew, turned_about
from giantlike.core.units import RAD_PER_DEG, SECONDS_PER_DAY
from giantlike.core.values import Value
from giantlike.network._kernels import Index, accumulate, eliminate_points
from giantlike.network.options import NetworkOptions
from giantlike.network.photos import Photo, Tracks
from giantlike.network.rotation import Rotating

POSE = 6  # unknowns of an image: rotation vector about the camera axes, then position
_SINGULAR = 1e-12  # eigenvalue of an a priori correlation matrix that is zero but for rounding


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prior(Value):
    """A priori covariances of n blocks of d unknowns, as independent unknowns ``z``: ``unknowns = basis @ z``."""

    basis: Float  # (n, d, d); a column is zero where a direction is held
    inverse: Float  # (n, d, d); ``z = inverse @ unknowns``
    known: Mask  # known, held: (n, d); ``z`` of unit variance; ``z`` that are held. The others are free.
    held: Mask

    @classmethod
    def from_covariances(cls, covariance: Float) -> Prior:
        """Take covariances (n, d, d) apart, which may be singular, or infinite on the diagonal."""
        variance = np.diagonal(covariance, axis1=1, axis2=2)
        free = np.isinf(variance)
        crossed = free[:, :, None] | free[:, None, :]
        scale = np.where(free, 1.0, np.sqrt(np.where(free, 1.0, variance)))
        units = np.where(scale > 0.0, scale, 1.0)
        finite = np.where(crossed, 0.0, covariance) / units[:, :, None] / units[:, None, :]
        marked = finite + 10.0 * free[:, :, None] * np.eye(covariance.shape[1])  # eigenvalues of free unknowns alone
        values, vectors = np.linalg.eigh(marked)
        is_free = values > 9.5
        held = values < _SINGULAR
        sigma = np.where(is_free, 1.0, np.sqrt(np.maximum(values, 0.0)))
        basis = units[:, :, None] * vectors * np.where(held, 0.0, sigma)[:, None, :]
        inverse = np.swapaxes(vectors / np.where(held, np.inf, sigma)[:, None, :], 1, 2) / units[:, None, :]
        return cls(basis=basis, inverse=inverse, known=~is_free & ~held, held=held)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class State(Value):
    """Estimates: ``camera_from_inertial`` and positions (m, 3) of images, points (p, 3) before scaling, shared ones."""

    models: tuple[CameraModel, ...]
    rotation: Rotation
    position: Float
    points: Float
    turn: Rotation  # correction of the orientation of the body at the mean epoch, inertial axes
    shared: Float  # (k,); departures of the shared parameters from their a priori values (of pole and W: by ``turn``)


@dataclass(frozen=True, slots=True, eq=False)
class Step(Value):
    """Change of the reduced unknowns (r,) and the points (p, 3), both as ``z``, and the predicted decrease."""

    reduced: Float
    points: Float
    decrement: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sensitivity(Value):
    """Predicted pixels (n, 2), and derivatives by point (n, 2, 3), pose (n, 2, 6) and shared parameters (n, 2, k)."""

    pixels: Float
    by_point: Float
    by_pose: Float
    by_shared: Float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Problem(Value):
    """Measures, a priori values and treatment of a network of m images, p points and k shared parameters."""

    photos: tuple[Photo, ...]
    tracks: Tracks
    options: NetworkOptions
    start: State
    poses: Prior
    points: Prior
    names: tuple[str, ...]
    sigma_shared: Float
    estimated: Mask
    first: Index
    ets: Float
    et: float
    declared: Rotation
    inertial_from_node: Float
    models: tuple[int, ...]
    datum: Float

    @classmethod
    def from_photos(
        cls, photos: Sequence[Photo], tracks: Tracks, body: Rotating | None, options: NetworkOptions, points: Float
    ) -> Problem:
        """Set up the unknowns; ``points`` (p, 3): start."""
        if body is not None:
            photos = [replace(photo, inertial_from_body=body.inertial_from_body(photo.et)) for photo in photos]
        shared = _shared_sigmas(body, options)
        names = tuple(name for name, _, _ in shared)
        free = np.diag([np.inf] * POSE)
        covariances = np.array([free if p.covariance_pose is None else p.covariance_pose for p in photos])
        kept = options.poses is not Treatment.FIXED
        require(
            options.poses is not Treatment.CONSIDER or bool(np.isfinite(covariances).all()),
            "poses consider: all images need an a priori covariance",
        )
        first = np.concatenate([[0], np.cumsum(tracks.views)]).astype(np.int64)
        ets = np.array([photo.et for photo in photos])
        et = float(ets.mean())
        models: list[CameraModel] = []
        for photo in photos:
            if photo.model not in models:
                models.append(photo.model)
        require(
            len(models) == 1 or options.camera is Treatment.FIXED,
            f"camera {options.camera}: all images need one camera model, got {len(models)}",
        )
        if options.camera is not Treatment.FIXED:
            unknown = sorted(set(options.sigma_camera) - set(models[0].parameter_names))
            known = ", ".join(models[0].parameter_names)
            require(not unknown, f"sigma_camera: the camera has no {', '.join(unknown)}; it has {known}")
        estimated = [treatment is Treatment.ESTIMATE for _, _, treatment in shared]
        poses_estimated = options.poses is Treatment.ESTIMATE
        points_kept = options.points is not Treatment.FIXED
        given = np.asarray(tracks.covariance_points_km2)
        node = np.eye(3)
        if body is not None:
            ra, dec, _ = body.angles_deg(et)
            node = Rotation.from_euler("ZX", [ra + 90.0, 90.0 - dec], degrees=True).as_matrix()
        problem = cls(
            photos=tuple(photos),
            tracks=tracks,
            options=options,
            start=State(
                models=tuple(models),
                rotation=Rotation.concatenate([photo.camera_from_inertial for photo in photos]),
                position=np.array([photo.position_km for photo in photos]),
                points=points,
                turn=Rotation.identity(),
                shared=np.zeros(len(names)),
            ),
            poses=Prior.from_covariances(covariances if kept else np.zeros_like(covariances)),
            points=Prior.from_covariances(given if points_kept else np.zeros_like(given)),
            names=names,
            sigma_shared=np.array([sigma for _, sigma, _ in shared]),
            estimated=np.array([poses_estimated] * (POSE * len(photos)) + estimated),
            first=first,
            ets=ets,
            et=et,
            declared=Rotation.concatenate([photo.inertial_from_body for photo in photos]),
            inertial_from_node=node,
            models=tuple(models.index(photo.model) for photo in photos),
            datum=np.zeros((POSE * len(photos) + len(names), 0)),
        )
        if options.poses is not Treatment.ESTIMATE or options.points is not Treatment.ESTIMATE:
            return problem
        moved, _, information = frame_directions(problem)
        free_poses = (problem.poses.inverse @ (moved @ find_undetermined(information))).reshape(POSE * len(photos), -1)
        return replace(problem, datum=np.concatenate([free_poses, np.zeros((len(names), free_poses.shape[1]))]))

    @property
    def size(self) -> int:
        """Number of reduced unknowns: those of all poses, and the shared ones."""
        return len(self.estimated)

    def inertial_from_body(self, state: State) -> Float:
        """Orientation (m, 3, 3) of the body in each image."""
        angle = self.value(state, "rate") * (self.ets - self.et)
        late = Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0])
        return np.asarray((state.turn * self.declared * late).as_matrix())

    def value(self, state: State, name: str) -> float:
        """Departure of a shared parameter; zero for one that is fixed."""
        return float(state.shared[self.names.index(name)]) if name in self.names else 0.0

    def points_km(self, state: State) -> Float:
        """Points (p, 3), km, body axes."""
        return state.points * (1.0 + self.value(state, "size"))

    def look(self, state: State) -> tuple[Float, Float, Float, Float]:
        """Points of all measures (n, 3) in camera and in inertial axes, and the matrices (n, 3, 3) into these."""
        bodies = self.inertial_from_body(state)[self.tracks.photo]
        cameras = state.rotation.as_matrix()[self.tracks.photo]
        inertial = np.einsum("nij,nj->ni", bodies, self.points_km(state)[self.tracks.point])
        look = np.einsum("nij,nj->ni", cameras, inertial - state.position[self.tracks.photo])
        return look, inertial, cameras, bodies

    def _by_model(self) -> list[Mask | slice]:
        """Measures of each camera model."""
        if len(self.start.models) == 1:
            return [slice(None)]
        of_measure = np.array(self.models)[self.tracks.photo]
        return [of_measure == number for number in range(len(self.start.models))]

    def predict(self, state: State) -> Float:
        """Pixels (n, 2) of all measures; NaN where the camera cannot see the point."""
        look = self.look(state)[0]
        pixels = np.empty((len(look), 2))
        for which, model in zip(self._by_model(), state.models, strict=True):
            pixels[which] = model.project(look[which])
        return pixels

    def linearize(self, state: State) -> Sensitivity:
        """Pixels and their derivatives by the unknowns themselves."""
        look, inertial, cameras, bodies = self.look(state)
        count, scale = len(look), 1.0 + self.value(state, "size")
        pixels, by_look = np.empty((count, 2)), np.empty((count, 2, 3))
        by_shared = np.zeros((count, 2, len(self.names)))
        for which, model in zip(self._by_model(), state.models, strict=True):
            pixels[which], by_look[which] = model.project(look[which]), model.project_jacobian(look[which])
        by_inertial = by_look @ cameras
        by_turn = turned_about(inertial, by_inertial)
        node = self.inertial_from_node
        columns = {"pole_east": node[:, 1], "pole_north": -node[:, 0], "w": node[:, 2]}
        for k, name in enumerate(self.names):
            if name in columns:
                by_shared[:, :, k] = by_turn @ columns[name]
            elif name == "rate":
                late = self.ets[self.tracks.photo] - self.et
                by_shared[:, :, k] = np.einsum("nij,nj->ni", by_turn, bodies[:, :, 2] * late[:, None])
            elif name == "size":
                by_shared[:, :, k] = np.einsum("nij,nj->ni", by_inertial, inertial / scale)
            else:
                number = state.models[0].parameter_names.index(name)
                by_shared[:, :, k] = state.models[0].parameter_jacobian(look)[..., number]
        return Sensitivity(
            pixels=pixels,
            by_point=by_inertial @ bodies * scale,
            by_pose=np.concatenate([turned_about(look, by_look), -by_inertial], axis=2),
            by_shared=by_shared,
        )

    def apply_step(self, state: State, step: Step) -> State | None:
        """State after a step; None if the camera model refuses its parameters."""
        poses = (self.poses.basis @ step.reduced[: POSE * len(self.photos)].reshape(-1, POSE, 1))[..., 0]
        moved = step.reduced[POSE * len(self.photos) :] * self.sigma_shared
        node = {"pole_north": (0, -1.0), "pole_east": (1, 1.0), "w": (2, 1.0)}
        turn = np.zeros(3)
        for name, change in zip(self.names, moved, strict=True):
            if name in node:
                turn[node[name][0]] += node[name][1] * change
        models, shared = state.models, state.shared + moved
        names = models[0].parameter_names
        if any(name in names for name in self.names):
            values = np.array(self.start.models[0].parameters)
            for name, change in zip(self.names, shared, strict=True):
                if name in names:
                    values[names.index(name)] += change
            try:
                models = (models[0].with_parameters(values),)
            except InputError:
                return None
        return State(
            models=models,
            rotation=Rotation.from_rotvec(poses[:, :3]) * state.rotation,
            position=state.position + poses[:, 3:],
            points=state.points + (self.points.basis @ step.points[..., None])[..., 0],
            turn=Rotation.from_rotvec(self.inertial_from_node @ turn) * state.turn,
            shared=shared,
        )

    def prior_poses(self, state: State) -> tuple[Float, Float]:
        """Departures (m, 6) of the poses from their a priori values as ``z``, and minus their derivative by ``z``."""
        turn = (self.start.rotation * state.rotation.inv()).as_rotvec()
        cross = skew(turn)
        jacobian = np.tile(np.eye(POSE), (len(turn), 1, 1))
        jacobian[:, :3, :3] += cross / 2.0 + cross @ cross / 12.0  # inverse of the right Jacobian, to third order
        ahead = np.concatenate([turn, self.start.position - state.position], axis=1)
        known = self.poses.known[:, :, None]
        inverse = np.where(known, self.poses.inverse, 0.0)
        return (inverse @ ahead[..., None])[..., 0], inverse @ jacobian @ self.poses.basis

    def prior_points(self, state: State) -> Float:
        """Departures (p, 3) of the points from their a priori values as ``z``; zero where nothing is known."""
        apriori = np.where(np.isfinite(np.asarray(self.tracks.points_km)), np.asarray(self.tracks.points_km), 0.0)
        ahead = self.points.inverse @ (apriori - state.points)[..., None]
        return np.where(self.points.known, ahead[..., 0], 0.0)

    def normal_equations(self, state: State, used: Mask, loss: Loss) -> NormalEquations | None:
        """Assemble the normal equations; None if a measure in use (n,) cannot be projected."""
        found = self.linearize(state)
        residuals = self.tracks.points_px - found.pixels
        if not np.isfinite(residuals[used]).all():
            return None
        tracks, m, k, p = self.tracks, len(self.photos), len(self.names), len(self.tracks.names)
        squares = np.where(used, np.sum(residuals**2, axis=1) / tracks.sigma_px**2, 0.0)
        weight = (np.sqrt(loss.weight(squares)) / tracks.sigma_px)[:, None, None]
        rows = np.empty((len(used), 2, POSE + k + 1))
        rows[:, :, :POSE] = found.by_pose @ self.poses.basis[tracks.photo]
        rows[:, :, POSE:-1] = found.by_shared * self.sigma_shared
        rows[:, :, -1] = residuals
        rows *= weight
        by_point = found.by_point @ self.points.basis[tracks.point] * weight
        rows[~used] = by_point[~used] = 0.0
        poses, points, shared = np.zeros((m, POSE, POSE + k + 1)), np.zeros((p, 3, 4)), np.zeros((k, k + 1))
        coupling, shared_coupling = np.zeros((len(used), POSE, 3)), np.zeros((p, k, 3))
        accumulate(tracks.photo, tracks.point, rows, by_point, poses, points, shared, coupling, shared_coupling)
        ahead, design = self.prior_poses(state)
        if self.options.poses is not Treatment.CONSIDER:
            transposed = np.swapaxes(design, 1, 2)
            poses[:, :, :POSE] += transposed @ design
            poses[:, :, -1] += (transposed @ ahead[..., None])[..., 0]
        point_ahead, departure = self.prior_points(state), self.shared_departure(state)
        points[:, :, 3] += point_ahead
        points[:, :, :3] += np.eye(3) * (self.points.known | self.points.held)[:, :, None]
        # points without measures in use keep their position
        points[:, :, :3] += np.eye(3) * (np.diagonal(points[:, :, :3], axis1=1, axis2=2) <= 0.0)[:, :, None]
        estimated = self.estimated[POSE * m :]
        reduced = np.zeros((self.size, self.size))
        blocks = reduced[: POSE * m, : POSE * m].reshape(m, POSE, m, POSE)
        blocks[np.arange(m), :, np.arange(m)] = poses[:, :, :POSE]
        reduced[: POSE * m, POSE * m :] = poses[:, :, POSE:-1].reshape(POSE * m, k)
        reduced[POSE * m :, : POSE * m] = reduced[: POSE * m, POSE * m :].T
        reduced[POSE * m :, POSE * m :] = shared[:, :-1] + np.diag(estimated.astype(np.float64))
        cost = float(np.sum(loss.cost(squares[used]))) + float(np.sum(point_ahead**2))
        cost += float(np.sum(ahead**2)) if self.options.poses is not Treatment.CONSIDER else 0.0
        return NormalEquations(
            reduced=reduced,
            gradient=np.concatenate([poses[:, :, -1].ravel(), shared[:, -1] - np.where(estimated, departure, 0.0)]),
            points=points[:, :, :3].copy(),
            point_gradient=points[:, :, 3].copy(),
            coupling=coupling,
            shared_coupling=shared_coupling,
            problem=self,
            cost=cost + float(np.sum(departure[estimated] ** 2)),
        )

    def shared_departure(self, state: State) -> Float:
        """Departures (k,) of the shared parameters as ``z``."""
        turn = self.inertial_from_node.T @ state.turn.as_rotvec()
        node = {"pole_east": turn[1], "pole_north": -turn[0], "w": turn[2]}
        values = [node.get(name, value) for name, value in zip(self.names, state.shared, strict=True)]
        return np.array(values) / self.sigma_shared


def _shared_sigmas(body: Rotating | None, options: NetworkOptions) -> list[tuple[str, float, Treatment]]:
    """Names, a priori sigmas (rad, rad/s, relative, units of the camera) and treatment of all that is not fixed."""
    rotating = (options.pole, options.w, options.rate)
    fixed = Treatment.FIXED
    require(
        body is not None or all(each is fixed for each in rotating),
        "pole, w and rate need a body whose rotation is declared: give body=Rotating(...), or keep them fixed",
    )
    pole = options.sigma_pole_deg * RAD_PER_DEG
    rate = 0.0 if body is None else abs(float(body.pm_deg[1])) * RAD_PER_DEG / SECONDS_PER_DAY
    require(rate > 0.0 or options.rate is fixed, "rate: the declared rate of the body is 0")
    shared = [
        ("pole_east", pole, options.pole),
        ("pole_north", pole, options.pole),
        ("w", options.sigma_w_deg * RAD_PER_DEG, options.w),
        ("rate", options.sigma_rate * rate, options.rate),
        ("size", options.sigma_size, options.size),
        *((name, sigma, options.camera) for name, sigma in options.sigma_camera.items()),
    ]
    return [one for one in shared if one[2] is not fixed]


def sums_by(values: Float, index: NDArray[np.int64], count: int) -> Float:
    """Sums (count, ...) of values (n, ...) by their index."""
    flat = values.reshape(len(values), -1)
    summed: Float = np.stack([np.bincount(index, column, count) for column in flat.T], axis=1)
    return np.asarray(summed.reshape(count, *values.shape[1:]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NormalEquations(Value):
    """Blocks at a state, all unknowns as ``z``.

    reduced (r, r): of poses and shared parameters (upper triangle of blocks); gradient (r,).
    points (p, 3, 3), point_gradient (p, 3).
    coupling: (n, 6, 3); of the pose and the point of each measure.
    shared_coupling: (p, k, 3).
    """

    reduced: Float
    gradient: Float
    points: Float
    point_gradient: Float
    coupling: Float
    shared_coupling: Float
    problem: Problem
    cost: float

    @property
    def blocks(self) -> tuple[Index, Index, Float]:
        """First row of each block coupled with a point, first block of each point, and the blocks (b, 6, 3)."""
        tracks, m = self.problem.tracks, len(self.problem.photos)
        k = self.shared_coupling.shape[1]
        more = -(-k // POSE)
        if not more:
            return POSE * tracks.photo, np.array(self.problem.first), self.coupling
        count = len(self.points)
        padded = np.zeros((count, more * POSE, 3))
        padded[:, :k] = self.shared_coupling
        point = np.concatenate([tracks.point, np.repeat(np.arange(count), more)])
        order = np.argsort(point, kind="stable")
        rows = np.concatenate([POSE * tracks.photo, np.tile(POSE * (m + np.arange(more)), count)])[order]
        first = self.problem.first + more * np.arange(count + 1)
        return rows, first, np.concatenate([self.coupling, padded.reshape(-1, POSE, 3)])[order]

    @property
    def padded_size(self) -> int:
        """Rows of the reduced matrix with room for whole blocks."""
        return POSE * len(self.problem.photos) + -(-len(self.problem.names) // POSE) * POSE

    def without_points(self, damping: float = 0.0) -> tuple[Float, Float, Float]:
        """Upper triangle (r, r) and gradient (r,) with the points eliminated, and inverse blocks (p, 3, 3) of these."""
        inverse: Float = np.asarray(np.linalg.inv(self.points * (1.0 + damping * np.eye(3))))
        if self.problem.options.points is not Treatment.ESTIMATE:
            inverse = np.zeros_like(inverse)
        matrix = self.eliminate(inverse, self.reduced)
        size = np.arange(len(matrix))
        matrix[size, size] += damping * np.diagonal(self.reduced)
        alone = (inverse @ self.point_gradient[..., None])[..., 0]
        return matrix, self.gradient - self.carry(alone), inverse

    def eliminate(self, inverse: Float, matrix: Float | float = 0.0) -> Float:
        """Upper triangle of a matrix (r, r) minus the sum of ``W V W^T`` over points with matrices ``V`` (p, 3, 3)."""
        size = self.problem.size
        total = np.zeros((self.padded_size, self.padded_size))
        total[:size, :size] = matrix
        eliminate_points(total, *self.blocks, inverse)
        return total[:size, :size]

    def carry(self, points: Float) -> Float:
        """Product of the coupling with values (p, 3) of the points: (r,)."""
        tracks, m = self.problem.tracks, len(self.problem.photos)
        by_pose = np.einsum("nij,nj->ni", self.coupling, points[tracks.point])
        return np.concatenate(
            [sums_by(by_pose, tracks.photo, m).ravel(), np.einsum("pkj,pj->k", self.shared_coupling, points)]
        )

    def carry_back(self, reduced: Float) -> Float:
        """Product of the transposed coupling with reduced unknowns (r,): (p, 3)."""
        tracks, m = self.problem.tracks, len(self.problem.photos)
        poses, shared = reduced[: POSE * m].reshape(m, POSE), reduced[POSE * m :]
        by_pose = np.einsum("nij,ni->nj", self.coupling, poses[tracks.photo])
        result = sums_by(by_pose, tracks.point, len(self.points))
        return np.asarray(result + np.einsum("pkj,k->pj", self.shared_coupling, shared))

    def solve(self, damping: float) -> Step | None:
        """Levenberg-Marquardt step for a damping relative to the diagonal; None if a matrix is singular."""
        problem = self.problem
        try:
            matrix, gradient, inverse = self.without_points(damping)
            free = np.flatnonzero(problem.estimated & (np.diagonal(self.reduced) > 0.0))
            step = np.zeros(problem.size)
            if len(free):
                kept, units = self.scale(matrix, free)
                factor = scipy.linalg.cho_factor(kept, overwrite_a=True, check_finite=False)
                step[free] = scipy.linalg.cho_solve(factor, gradient[free] * units) * units
        except np.linalg.LinAlgError:
            return None
        points = (inverse @ (self.point_gradient - self.carry_back(step))[..., None])[..., 0]
        decrement = float(self.gradient @ step + np.sum(self.point_gradient * points))
        return Step(step, points, decrement) if math.isfinite(decrement) else None

    def scale(self, matrix: Float, which: NDArray[np.intp]) -> tuple[Float, Float]:
        """Rows and columns of a reduced matrix in units (s,) of their diagonal, free directions of the frame held."""
        units = 1.0 / np.sqrt(np.diagonal(self.reduced)[which])
        kept = matrix.copy() if len(which) == len(matrix) else matrix[np.ix_(which, which)]
        kept *= units
        kept *= units[:, None]
        held = self.problem.datum[which] / units[:, None]
        if held.size:
            axes = np.linalg.qr(held)[0]
            kept += axes @ axes.T
        return kept, units


def mirror(upper: Float) -> Float:
    """Symmetric matrix (r, r) of its upper triangle."""
    result: Float = np.triu(upper)
    result += np.triu(upper, 1).T
    return result


def frame_directions(problem: Problem) -> tuple[Float, Float, Float]:
    """Changes of the poses (m, 6, 7) and the points (p, 3, 7) that no pixel shows, and what is known of them.

    Shifts along the body axes by the RMS radius of the points, rotations about these, and the scale, both about the
    mean of the points. Returns the information (7, 7) on them by the a priori values last; directions that are held
    count as known to 1e-6.
    """
    state = problem.start
    bodies, cameras = problem.inertial_from_body(state), state.rotation.as_matrix()
    radius = float(np.sqrt(np.mean(np.sum(state.points**2, axis=1))))
    poses = np.zeros((len(bodies), POSE, 7))
    poses[:, 3:, :3] = radius * bodies
    poses[:, :3, 3:6] = -cameras @ bodies
    center = state.points.mean(axis=0)
    arms = state.position - bodies @ center
    poses[:, 3:, 3:6] = -skew(arms) @ bodies
    poses[:, 3:, 6] = arms
    points = np.zeros((len(state.points), 3, 7))
    points[:, :, :3] = radius * np.eye(3)
    points[:, :, 3:6] = -skew(state.points - center)
    points[:, :, 6] = state.points - center
    information = np.zeros((7, 7))
    for prior, moved in ((problem.poses, poses), (problem.points, points)):
        z = prior.inverse @ moved
        known = np.where(prior.known[:, :, None], z, 0.0)
        information += np.einsum("nij,nik->jk", known, known)
        held = moved - prior.basis @ z
        scale = np.ones(moved.shape[1]) if prior is problem.points else np.repeat([1.0, radius], 3)
        held = held / scale[:, None] / (radius if prior is problem.points else 1.0)
        information += 1e12 * np.einsum("nij,nik->jk", held, held)
    return poses, points, information


DIRECTIONS = ("shift x", "shift y", "shift z", "rotation x", "rotation y", "rotation z", "scale")
"""Names of the directions, body axes."""


def find_undetermined(information: Float) -> Float:
    """Directions (7, q) of a frame of which nothing is known."""
    scale = np.sqrt(np.maximum(np.diagonal(information), 1e-300))
    scale = np.where(scale > 1e-9 * scale.max(), scale, 1.0)
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    return np.asarray(vectors[:, values < 1e-10] / scale[:, None])
