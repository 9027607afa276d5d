"""Images of a pass: measured and predicted values, the derivatives by shared errors, and the waves that limbs share."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike.camera import ModelUncertainty
from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, as_finite, as_floats, require, require_number
from giantlike.core.causes import Cause
from giantlike.core.frames import rotate, skew
from giantlike.core.outcomes import AttitudeErrors
from giantlike.core.values import Value, check_covariance
from giantlike.processing.limb.measurement import LimbMeasurement, SmoothError
from giantlike.relative.horizon.geometry import Figure, PixelRays, ray_residuals

ROTATION, DISPLACEMENT, ALTITUDE, OFFSET = slice(0, 3), slice(3, 6), 6, 7
"""Places of an error of one image among its effects: rad about camera axes, km in camera axes, km, px outward."""
EFFECTS = 8  # number of these; errors that limbs share come after
_ALTITUDE_STEP = 1e-4  # of the smallest radius
_SMOOTH_WAVES = 12  # around the limb, for a smooth error: 95 % of the power at a length of half a radius


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimbPoints(Value):
    """Points on the lit limb of an ellipsoid in one image.

    Parameters
    ----------
    points_px : (n, 2) float64, px; in the distorted image
    sigma_px : (n,) float64, px; standard deviations across the limb by noise that is new in every point
    model : CameraModel
    figure : Figure; the body without the altitude of the limb, in the predicted attitude
    shared_px : mapping of str to (n, c) float64, px
        Outward shifts of the points by one standard deviation of each of c errors that all images with the same key
        have in common, in the same order.
    """

    points_px: Float
    sigma_px: Float
    model: CameraModel
    figure: Figure
    shared_px: Mapping[str, Float] = field(default_factory=dict)
    _rays: PixelRays = field(init=False, repr=False)

    def __post_init__(self) -> None:
        points = as_floats(self.points_px, (2,), "points_px")
        require(points.ndim == 2 and len(points) > 0, f"points_px must have shape (n, 2), got {points.shape}")
        sigma = np.broadcast_to(as_floats(self.sigma_px, (), "sigma_px"), len(points)).copy()
        require(bool(np.all(sigma > 0.0)), "sigma_px must be > 0: leave points without an error out")
        shared = {str(key): as_floats(shift, (), f"shared_px[{str(key)!r}]") for key, shift in self.shared_px.items()}
        for key, shift in shared.items():
            require(shift.ndim == 2 and len(shift) == len(points), f"shared_px[{key!r}] needs a row for each point")
        rays = PixelRays.through(points, self.model)
        require(bool(np.isfinite(rays.directions).all()), "points_px must lie where the camera model has directions")
        self._keep(points_px=points, sigma_px=sigma, shared_px=shared, _rays=rays)

    @classmethod
    def of(
        cls,
        measured: LimbMeasurement,
        model: CameraModel,
        figure: Figure,
        uncertainty: ModelUncertainty | None = None,
        attitude_errors: AttitudeErrors | None = None,
    ) -> LimbPoints:
        """Points of a measured limb, with their shared errors.

        ``figure`` is the body without the altitude of the limb; ``uncertainty`` of the camera model, such as
        ``camera.uncertainty``: without it the camera is exact; ``attitude_errors`` of the image's attitude, which
        follows the parameters of the camera where it is from stars. Blur, law, relief and camera are errors that all
        images of the pass have in common.
        """
        points, keep = measured.observed_px[measured.keep], measured.keep
        shared = {str(cause): px[keep] for cause, px in measured.common_px.items()}
        smooth = [*measured.smooth_errors, *([] if measured.relief is None else [measured.relief])]
        center = model.project(measured.position_camera_km)
        for number, error in enumerate(smooth):
            if error.sigma_px > 0.0:
                shared[f"{error.cause} {number}"] = smooth_waves(points, center, error)
        if uncertainty is not None and uncertainty.estimated:
            errors = attitude_errors or AttitudeErrors()
            shared[str(Cause.CAMERA)] = _camera_shifts(points, measured.normals_px[keep], model, uncertainty, errors)
        return cls(points_px=points, sigma_px=measured.sigma_px[keep], model=model, figure=figure, shared_px=shared)

    @property
    def least_radius_km(self) -> float:
        """Least radius of the body, km."""
        return float(self.figure.radii_km.min())

    @property
    def size(self) -> int:
        """Number of points."""
        return len(self.points_px)

    def effects(self, position_camera_km: Float, altitude_km: float, errors: Float) -> tuple[Float, Float]:
        """Residuals (n,), sigmas, and their design (n, 8 + c), sigmas per unit of each error of the image.

        ``position_camera_km`` (3,), km, camera axes: predicted position of the body; ``altitude_km``, km, of the limb
        before ``errors`` (8 + c,): rotation (rad), displacement (km), altitude (km), outward shift (px), shared errors
        (sigmas). Residuals are measured minus predicted, NaN where the horizon has no point nearby; the design is the
        growth of the prediction.
        """
        turn = Rotation.from_rotvec(errors[ROTATION])
        position = rotate(turn, position_camera_km + errors[DISPLACEMENT])
        axes = turn * self.figure.camera_from_axes
        radii = self.figure.radii_km + altitude_km + errors[ALTITUDE]
        step = _ALTITUDE_STEP * float(radii.min())

        def at(height_km: float) -> tuple[Float, Float, Float]:
            return ray_residuals(self._rays, Figure(radii_km=radii + height_km, camera_from_axes=axes), position)

        residuals, by_position, normals = at(0.0)
        lift = (at(-step)[0] - at(step)[0]) / (2.0 * step)
        in_image = np.linalg.pinv(self._rays.by_pixel) @ -skew(self._rays.directions)
        shared = np.concatenate([np.zeros((self.size, 0)), *self.shared_px.values()], axis=1)
        design = np.concatenate(
            [
                np.einsum("ni,nij->nj", normals, in_image),
                by_position @ turn.as_matrix(),
                lift[:, None],
                np.ones((self.size, 1)),
                shared,
            ],
            axis=1,
        )
        left = residuals - errors[OFFSET] - shared @ errors[EFFECTS:]
        return left / self.sigma_px, design / self.sigma_px[:, None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredPosition(Value):
    """Position of a body as an estimator measured it in one image."""

    position_camera_km: Float
    covariance_camera_km2: Float  # by errors that are new in every image
    radius_km: float  # radius of the body without the altitude of the limb
    apparent_radius_px: float  # radius in the image, by which shifts of the limb in px become shifts of the range
    # mapping of str to (3, c), camera axes; shifts of the position by one standard deviation of each of c errors that
    # all images with the same key have in common, in the same order
    shared_km: Mapping[str, Float] = field(default_factory=dict)
    _whiten: Float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        position = as_finite(self.position_camera_km, (3,), "position_camera_km")
        covariance = as_finite(self.covariance_camera_km2, (3, 3), "covariance_camera_km2")
        require_number(self.radius_km, "radius_km", above=0.0)
        require_number(self.apparent_radius_px, "apparent_radius_px", above=0.0)
        check_covariance(covariance, "covariance_camera_km2")
        values, axes = np.linalg.eigh(covariance)
        require(float(values[0]) > 0.0, "covariance_camera_km2 must be positive definite")
        shared = {str(key): as_floats(km, (), f"shared_km[{str(key)!r}]") for key, km in self.shared_km.items()}
        for key, shift in shared.items():
            require(
                shift.ndim == 2 and len(shift) == 3, f"shared_km[{key!r}] must have shape (3, c), got {shift.shape}"
            )
        self._keep(
            position_camera_km=position,
            covariance_camera_km2=covariance,
            shared_km=shared,
            _whiten=(axes / np.sqrt(values)).T,
        )

    @property
    def least_radius_km(self) -> float:
        """Radius of the body, km."""
        return self.radius_km

    @property
    def size(self) -> int:
        """Number of coordinates, 3."""
        return 3

    @property
    def shared_px(self) -> Mapping[str, Float]:
        """Errors in common by key, as in :class:`LimbPoints`; here in km."""
        return self.shared_km

    def effects(self, position_camera_km: Float, altitude_km: float, errors: Float) -> tuple[Float, Float]:
        """Residuals (3,) and their derivatives (3, 8 + c), in sigmas, by the errors as in :meth:`LimbPoints.effects`.

        The size in the image goes by the radius with the altitude of the limb over the range. A limb that is higher
        than assumed makes the body come out nearer, by the ratio of the radii, and so does one found farther outside.
        """
        turn = Rotation.from_rotvec(errors[ROTATION])
        moved = position_camera_km + errors[DISPLACEMENT]
        assumed_km = self.radius_km + altitude_km
        seen_km, grown = assumed_km + errors[ALTITUDE], 1.0 + errors[OFFSET] / self.apparent_radius_px
        ratio = assumed_km / (seen_km * grown)
        place = rotate(turn, moved) * ratio
        shared = np.concatenate([np.zeros((3, 0)), *self.shared_km.values()], axis=1)
        design = np.concatenate(
            [
                -skew(place),
                turn.as_matrix() * ratio,
                (-place / seen_km)[:, None],
                (-place / (self.apparent_radius_px * grown))[:, None],
                shared,
            ],
            axis=1,
        )
        left = self.position_camera_km - place - shared @ errors[EFFECTS:]
        return self._whiten @ left, self._whiten @ design


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PassImage(Value):
    """One image of a pass.

    Parameters
    ----------
    name : str
    time_s : float, s; its timetag, from any origin that the pass shares
    position_camera_km : (3,) float64, km, camera axes; apparent, by trajectory and attitude as given
    rate_camera_km_s : (3,) float64, km/s, camera axes; of that position: its change by a late exposure
    observed : LimbPoints or MeasuredPosition
    exposure_s : float, s; needed by the terms of the exposure alone
    sensor : str; sensor that the attitude comes from
    by_trajectory : (3, m) float64, km per unit of each, camera axes; position by parameters of the trajectory
    """

    name: str
    time_s: float
    position_camera_km: Float
    observed: LimbPoints | MeasuredPosition
    rate_camera_km_s: Float = field(default_factory=lambda: np.zeros(3))
    exposure_s: float = math.nan
    sensor: str = ""
    by_trajectory: Float = field(default_factory=lambda: np.zeros((3, 0)))

    def __post_init__(self) -> None:
        require_number(self.time_s, "time_s")
        by_trajectory = as_floats(self.by_trajectory, (), "by_trajectory")
        require(
            by_trajectory.ndim == 2 and len(by_trajectory) == 3,
            f"by_trajectory must have shape (3, m), got {by_trajectory.shape}",
        )
        names = ("position_camera_km", "rate_camera_km_s")
        vectors = {name: as_finite(getattr(self, name), (3,), name) for name in names}
        self._keep(**vectors, by_trajectory=by_trajectory)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NavigationPass(Value):
    """Images of one body that are taken one after the other.

    Parameters
    ----------
    images : tuple of PassImage
    limb_altitude_km : float, km; a priori altitude of the limb, or that assumed in measured positions
    covariance_trajectory : (m, m) float64; of its parameters, in their units squared; empty where exact
    trajectory_names : tuple of str; their names; by default numbers
    """

    images: tuple[PassImage, ...]
    limb_altitude_km: float = 0.0
    covariance_trajectory: Float = field(default_factory=lambda: np.zeros((0, 0)))
    trajectory_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        require(len(self.images) > 0, "a pass needs at least one image")
        require_number(self.limb_altitude_km, "limb_altitude_km")
        covariance = as_floats(self.covariance_trajectory, (), "covariance_trajectory")
        count = len(covariance)
        require(covariance.shape == (count, count), f"covariance_trajectory must be square, got {covariance.shape}")
        named = len(self.trajectory_names)
        require(
            named in (0, count), f"trajectory_names must be {count} names, as covariance_trajectory has, got {named}"
        )
        for image in self.images:
            require(
                image.by_trajectory.shape[1] == count,
                f"{image.name}: by_trajectory must have {count} columns as covariance_trajectory has, got "
                f"{image.by_trajectory.shape[1]}",
            )
        self._keep(
            images=tuple(self.images), covariance_trajectory=covariance, trajectory_names=tuple(self.trajectory_names)
        )

    @property
    def times_s(self) -> Float:
        """Timetags (n,), s."""
        return np.array([image.time_s for image in self.images])


def smooth_waves(points_px: Float, center_px: Float, error: SmoothError) -> Float:
    """Waves (n, c), px, around a limb of points (n, 2) that stand for an error that changes slowly along it."""
    arms = points_px - center_px
    radius_px = float(np.mean(np.linalg.norm(arms, axis=1)))
    amplitudes = wave_amplitudes(error.sigma_px, error.length_px / radius_px, _SMOOTH_WAVES)
    return limb_waves(np.arctan2(arms[:, 1], arms[:, 0]), amplitudes)


def _camera_shifts(
    points_px: Float, normals_px: Float, model: CameraModel, uncertainty: ModelUncertainty, errors: AttitudeErrors
) -> Float:
    """Outward shifts (n, k), px, of points by the camera, in units of the root of its covariance."""
    rays = model.unproject(points_px)
    chosen = [model.parameter_names.index(name) for name in uncertainty.estimated]
    moved = model.parameter_jacobian(rays)[..., chosen]
    if errors.by_camera is not None:
        moved = moved - model.project_jacobian(rays) @ skew(rays) @ errors.by_camera[:, chosen]
    shifts: Float = np.einsum("ni,nik->nk", normals_px, moved) @ covariance_root(uncertainty.covariance)
    return shifts


def covariance_root(covariance: Float) -> Float:
    """Symmetric root (k, k): the same shifts in all images whose part is the same."""
    values, axes = np.linalg.eigh((covariance + covariance.T) / 2.0)
    root: Float = (axes * np.sqrt(np.maximum(values, 0.0))) @ axes.T
    return root


def shared_names(images: tuple[PassImage, ...]) -> tuple[tuple[str, int], ...]:
    """Keys of the errors that limbs share, with the number of errors of each."""
    sizes: dict[str, int] = {}
    for image in images:
        for key, shift in image.observed.shared_px.items():
            size = sizes.setdefault(key, shift.shape[1])
            require(
                size == shift.shape[1],
                f"{image.name}: the shared error {key!r} has {shift.shape[1]} parts, in other images {size}",
            )
    return tuple(sizes.items())


_GRID = 720  # angles at which the correlation of a smooth error is sampled: a tenth of the shortest wave


def limb_waves(angles_rad: ArrayLike, amplitudes: ArrayLike) -> Float:
    """Waves (n, 2 w + 1) around a limb, 1, cos, sin, cos 2, sin 2, ..., times their amplitudes (w + 1,)."""
    angles = as_floats(angles_rad, (), "angles_rad")
    sigmas = as_floats(amplitudes, (), "amplitudes")
    columns = [np.full(angles.shape, sigmas[0])]
    for wave in range(1, sigmas.size):
        columns += [sigmas[wave] * np.cos(wave * angles), sigmas[wave] * np.sin(wave * angles)]
    return np.stack(columns, axis=-1)


def wave_amplitudes(sigma: float, length_rad: float, waves: int) -> Float:
    r"""Amplitudes (waves + 1,) of an error correlated along the limb by ``exp(-chord / length)``, length in radii.

    >>> amplitudes = wave_amplitudes(1.0, 0.3, 200)
    >>> bool(abs(amplitudes[0] ** 2 + (amplitudes[1:] ** 2).sum() - 1.0) < 0.01)
    True
    """
    require_number(sigma, "sigma", least=0.0)
    require_number(length_rad, "length_rad", above=0.0)
    require_number(waves, "waves", least=0, most=_GRID // 2 - 1)
    angles = 2.0 * np.pi * np.arange(_GRID) / _GRID
    correlation = np.exp(-2.0 * np.abs(np.sin(angles / 2.0)) / length_rad)
    power = np.maximum(np.fft.rfft(correlation).real / _GRID, 0.0)[: waves + 1]
    power[1:] *= 2.0
    return sigma * np.sqrt(power)
