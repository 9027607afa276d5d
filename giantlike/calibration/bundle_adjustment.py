"""Bundle adjustment: Levenberg-Marquardt fit of one camera model and the poses of all images.

Poses are eliminated image by image (Schur complement), so that the cost grows with their number and not its cube.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.calibration.observations import ImageObservations
from giantlike.calibration.options import Loss
from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask
from giantlike.core.errors import InputError
from giantlike.core.frames import skew
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value
from giantlike.processing import levenberg_marquardt

TEMPERATURE_TERMS = frozenset({"a1_per_c", "a2_per_c2", "a3_per_c3"})
"""Names of the parameters whose effect depends on the temperature of an image."""
MAX_CONDITION = 1e13
"""Condition number of a scaled normal matrix above which a parameter is undetermined: float64 has 16 digits."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Data(Value):
    """Observations of m images, n in all, with the unknowns and their a priori values."""

    targets: Float  # (n, 3); unit vectors or points, reference axes
    points_px: Float  # (n, 2)
    sigma_px: Float  # (n,); per axis
    offsets: NDArray[np.intp]  # (m + 1,); first observation of each image, and n
    temperatures_c: Float  # (m,)
    pose: int  # unknowns of an image: 3 (orientation) or 6 (orientation and position)
    estimated: NDArray[np.intp]  # (k,); indices of the estimated parameters of the model
    prior: Float  # prior, prior_sigma: (k,); a priori, in units of the parameters; sigmas infinite for none
    prior_sigma: Float
    start: Rotation  # a priori orientations of the m images
    attitude_weight: Float  # (m,) 1/rad^2; inverse variance per axis of the a priori orientations, 0 for none

    @classmethod
    def from_images(
        cls,
        images: Sequence[ImageObservations],
        start: Rotation,
        estimated: NDArray[np.intp],
        prior: Float,
        prior_sigma: Float,
    ) -> Data:
        """Concatenate the observations of images, which are all of directions or all of finite points."""
        sigmas = [image.attitude_sigma_rad for image in images]
        return cls(
            targets=np.concatenate([image.targets for image in images]),
            points_px=np.concatenate([image.points_px for image in images]),
            sigma_px=np.concatenate([image.sigma_px for image in images]),
            offsets=np.concatenate([[0], np.cumsum([len(image) for image in images])]).astype(np.intp),
            temperatures_c=np.array([image.temperature_c for image in images]),
            pose=6 if images[0].finite else 3,
            estimated=estimated,
            prior=prior,
            prior_sigma=prior_sigma,
            start=start,
            attitude_weight=np.array([0.0 if sigma is None else sigma**-2 for sigma in sigmas]),
        )

    @property
    def prior_weight(self) -> Float:
        """Inverse variances (k,) of the a priori values; 0 where there is none."""
        return self.prior_sigma**-2.0

    @property
    def image_index(self) -> NDArray[np.intp]:
        """Index (n,) of the image of each observation."""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))


@dataclass(frozen=True, slots=True, eq=False)
class State(Value):
    """A camera model and the poses of m images: ``camera_from_reference`` and positions (m, 3) in camera axes."""

    model: CameraModel
    rotation: Rotation
    position: Float

    def vectors(self, data: Data) -> Float:
        """Targets (n, 3) in camera axes."""
        index = data.image_index
        turned: Float = np.einsum("nij,nj->ni", self.rotation.as_matrix()[index], data.targets)
        return turned if data.pose == 3 else turned + self.position[index]

    def apply_step(self, step: Step, data: Data) -> State | None:
        """State after a step; None if the model refuses its parameters."""
        values = self.model.parameters
        values[data.estimated] += step.camera
        try:
            model = self.model.with_parameters(values)
        except InputError:
            return None
        rotation = Rotation.from_rotvec(step.poses[:, :3].copy()) * self.rotation
        position = self.position + step.poses[:, 3:] if data.pose == 6 else self.position
        return State(model, rotation, position)


@dataclass(frozen=True, slots=True, eq=False)
class Step(Value):
    """Change of the k camera parameters and of the poses (m, 3 or 6), and the predicted decrease of the cost."""

    camera: Float
    poses: Float
    decrement: float


def predict(state: State, data: Data) -> Float:
    """Project all targets to pixels (n, 2); NaN for those that the model cannot project."""
    vectors = state.vectors(data)
    result = np.empty((len(vectors), 2))
    for which, model, _ in _by_temperature(state.model, data):
        result[which] = model.project(vectors[which])
    return result


def linearize(state: State, data: Data) -> tuple[Float, Float, Float]:
    """Pixels (n, 2), and derivatives by the k estimated parameters (n, 2, k) and by the pose of the image (n, 2, p)."""
    vectors = state.vectors(data)
    pixels = np.empty((len(vectors), 2))
    camera = np.empty((len(vectors), 2, len(data.estimated)))
    pose = np.empty((len(vectors), 2, data.pose))
    arms = vectors if data.pose == 3 else vectors - state.position[data.image_index]
    for which, model, temperature_c in _by_temperature(state.model, data):
        pixels[which] = model.project(vectors[which])
        by_point = model.project_jacobian(vectors[which])
        pose[which, :, :3] = -by_point @ skew(arms[which])
        if data.pose == 6:
            pose[which, :, 3:] = by_point
        by_parameter = state.model.parameter_jacobian(vectors[which], temperature_c=temperature_c)
        camera[which] = by_parameter[..., data.estimated]
    return pixels, camera, pose


def _by_temperature(model: CameraModel, data: Data) -> list[tuple[Mask | slice, CameraModel, float]]:
    """Observations of each temperature with the model there; a single group if the model does not depend on it."""
    estimated = {model.parameter_names[k] for k in data.estimated}
    if estimated.isdisjoint(TEMPERATURE_TERMS) and bool(
        (model.at_temperature(1.0).parameters == model.parameters).all()
    ):
        return [(slice(None), model, 0.0)]
    temperatures, group = np.unique(data.temperatures_c, return_inverse=True)
    of_point = group[data.image_index]
    return [(of_point == k, model.at_temperature(float(t)), float(t)) for k, t in enumerate(temperatures)]


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations(Value):
    """Blocks at a state: camera (k, k), coupling (m, k, p), poses (m, p, p), right-hand sides, and the cost.

    ``image_camera`` (m, k, k) and ``image_gradient`` (m, k) are the contributions of the images to the camera block.
    """

    camera: Float
    coupling: Float
    poses: Float
    camera_gradient: Float
    pose_gradient: Float
    image_camera: Float
    image_gradient: Float
    cost: float

    def solve(self, damping: float) -> Step | None:
        """Levenberg-Marquardt step for a damping relative to the diagonal; None if a matrix is singular."""
        camera = self.camera * (1.0 + damping * np.eye(len(self.camera)))
        try:
            by_camera, alone = self._pose_steps(damping)
            reduced = camera - np.einsum("mkp,mpl->kl", self.coupling, by_camera)
            gradient = self.camera_gradient - np.einsum("mkp,mp->k", self.coupling, alone)
            units = 1.0 / np.sqrt(np.diag(camera))
            step = np.linalg.solve(reduced * np.outer(units, units), gradient * units) * units
        except np.linalg.LinAlgError:
            return None
        poses = alone - np.einsum("mpk,k->mp", by_camera, step)
        decrement = float(self.camera_gradient @ step + np.sum(self.pose_gradient * poses))
        return Step(step, poses, decrement) if np.isfinite(decrement) else None

    def _pose_steps(self, damping: float = 0.0) -> tuple[Float, Float]:
        """Change of the poses with the camera parameters (m, p, k), and their step (m, p) for an unchanged camera."""
        poses = self.poses * (1.0 + damping * np.eye(self.poses.shape[1]))
        by_camera: Float = np.asarray(np.linalg.solve(poses, np.swapaxes(self.coupling, 1, 2)), dtype=np.float64)
        alone: Float = np.asarray(np.linalg.solve(poses, self.pose_gradient[..., None]), dtype=np.float64)[..., 0]
        return by_camera, alone

    def shifts_without_image(self) -> Float:
        """Shift of the camera parameters (m, k) when an image is left out, to first order; inf where that frees one."""
        by_camera, alone = self._pose_steps()
        information = self.image_camera - self.coupling @ by_camera  # of each image on the camera alone
        gradient = self.image_gradient - np.einsum("mkp,mp->mk", self.coupling, alone)
        total = self.information()
        units = 1.0 / np.sqrt(np.diag(total))
        shifts = np.full(gradient.shape, np.inf)
        for number, (mine, pull) in enumerate(zip(information, gradient, strict=True)):
            rest = (total - mine) * np.outer(units, units)
            if np.linalg.cond(rest) < MAX_CONDITION:
                shifts[number] = -np.linalg.solve(rest, pull * units) * units
        return shifts

    def pose_covariance(self, camera_covariance: Float) -> Float:
        """Covariance (m, p, p) of the poses, with that (k, k) of the camera, rad^2 (and squares of lengths)."""
        by_camera, _ = self._pose_steps()
        return np.linalg.inv(self.poses) + by_camera @ camera_covariance @ np.swapaxes(by_camera, 1, 2)

    def information(self) -> Float:
        """Inverse covariance (k, k) of the camera parameters, poses eliminated."""
        by_camera, _ = self._pose_steps()
        result: Float = self.camera - np.einsum("mkp,mpl->kl", self.coupling, by_camera)
        return (result + result.T) / 2.0


def normal_equations(state: State, data: Data, used: Mask, loss: Loss) -> NormalEquations | None:
    """Assemble the normal equations; None if a target in use cannot be projected."""
    predicted, by_camera, by_pose = linearize(state, data)
    residuals = data.points_px - predicted
    if not np.isfinite(residuals[used]).all():
        return None
    squares = np.sum(residuals**2, axis=1) / data.sigma_px**2
    weight = np.where(used, np.sqrt(loss.weight(np.where(used, squares, 0.0))) / data.sigma_px, 0.0)
    stacked = np.concatenate([by_camera, by_pose, residuals[..., None]], axis=-1) * weight[:, None, None]
    stacked[~used] = 0.0
    grams = np.stack([np.tensordot(rows, rows, ([0, 1], [0, 1])) for rows in np.split(stacked, data.offsets[1:-1])])
    k, p = len(data.estimated), data.pose
    ahead = data.prior - state.model.parameters[data.estimated]
    turn = (data.start * state.rotation.inv()).as_rotvec()
    poses, pose_gradient = grams[:, k : k + p, k : k + p].copy(), grams[:, k : k + p, -1].copy()
    poses[:, :3, :3] += data.attitude_weight[:, None, None] * np.eye(3)
    # an image without observations keeps its pose
    poses[np.bincount(data.image_index, used, len(poses)) == 0] += np.eye(p)
    pose_gradient[:, :3] += data.attitude_weight[:, None] * turn
    cost = float(np.sum(loss.cost(squares[used])))
    cost += float(data.prior_weight @ ahead**2 + data.attitude_weight @ np.sum(turn**2, axis=1))
    return NormalEquations(
        camera=grams[:, :k, :k].sum(axis=0) + np.diag(data.prior_weight),
        coupling=grams[:, :k, k : k + p],
        poses=poses,
        camera_gradient=grams[:, :k, -1].sum(axis=0) + data.prior_weight * ahead,
        pose_gradient=pose_gradient,
        image_camera=grams[:, :k, :k],
        image_gradient=grams[:, :k, -1],
        cost=cost,
    )


Minimum: TypeAlias = levenberg_marquardt.Minimum[State, NormalEquations]
"""Minimum of the cost: state, normal equations there without damping, and the number of steps."""


def minimize(
    state: State, data: Data, used: Mask, loss: Loss, *, max_steps: int, rough: bool = False
) -> Minimum | Failure:
    """Fit camera and poses to the observations in use (n,)."""
    return levenberg_marquardt.minimize(
        state,
        lambda at: normal_equations(at, data, used, loss),
        lambda at, step: at.apply_step(step, data),
        max_steps=max_steps,
        rough=rough,
    )


def covariance_of(normal: NormalEquations, names: tuple[str, ...]) -> tuple[Float, float] | Failure:
    """Covariance (k, k) of the camera parameters and condition number of their scaled information."""
    if not names:
        return np.zeros((0, 0)), 1.0
    if not np.isfinite(np.linalg.cond(normal.poses)).all() or np.linalg.cond(normal.poses).max() > MAX_CONDITION:
        return Failure(
            Reason.DEGENERATE_GEOMETRY,
            "an image has too few targets for its orientation: at least two stars are needed, or an a priori attitude",
        )
    information = normal.information()
    diagonal = np.diag(information)
    if not (diagonal > 0).all():
        free = [name for name, value in zip(names, diagonal, strict=True) if not value > 0]
        return Failure(
            Reason.DEGENERATE_GEOMETRY, f"the observations do not depend on {', '.join(free)}: do not estimate it"
        )
    units = 1.0 / np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(information * np.outer(units, units))
    condition = float(values[-1] / values[0]) if values[0] > 0 else float("inf")
    if not condition < MAX_CONDITION:
        worst = np.abs(vectors[:, 0])
        mixed = [name for name, share in zip(names, worst, strict=True) if share > 0.3 * worst.max()]
        return Failure(
            Reason.DEGENERATE_GEOMETRY,
            f"the observations cannot separate {', '.join(mixed)} (condition number {condition:.1e}): estimate fewer "
            "of them, or give an a priori sigma",
        )
    covariance = (vectors / values) @ vectors.T
    return covariance * np.outer(units, units), condition
