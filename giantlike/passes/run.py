"""A pass from the observables of a run folder."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, as_floats, require, require_number, unit
from giantlike.core.errors import DataError
from giantlike.core.frames import rotate, rotation_from_xyzw
from giantlike.io.observables_file import ObservableRow, read_observables
from giantlike.passes.images import MeasuredPosition, NavigationPass, PassImage, covariance_root
from giantlike.relative.place import apparent_radius_px

OBSERVABLES = "observables.parquet"
_NEW_PARTS = ("part_noise", "part_background")
_LIGHT_PARTS = ("part_psf", "part_edge", "part_reflectance", "part_albedo", "part_relief")
_LIGHT_CORRELATION = 0.5
"""Correlation between images of errors by how a body is lit, along the direction of the Sun, across it and along the
range: the mean of a uniform prior. With a wrong point spread function it is 0.7 to 0.8 along the Sun for templates and
below 0.3 for limbs (docs/observables.md); in axes of the camera it is lost when the camera rolls."""
_SHARED_PARTS = ("part_camera", "part_aberration", "part_epoch", "part_pole", "part_spin", "part_sun")
_ATTITUDE_PARTS = ("part_attitude", "part_orientation")


@dataclass(frozen=True, slots=True, kw_only=True)
class RunPass:
    """Choice of a pass among the rows of a run, and the values missing in the file.

    Parameters
    ----------
    target : str
    radius_km : float, km; mean radius of the target without the altitude of its limb
    limb_altitude_km : float, km; altitude of the limb that the run was processed with
    covariance_trajectory : (6, 6) array_like, optional
        Of the position (km) and the velocity (km/s) of the spacecraft at the middle of the pass, ICRF axes; without it
        the trajectory is taken as exact.
    from_et_s, to_et_s : float, TDB s; first and last epoch of the pass
    """

    target: str
    radius_km: float
    limb_altitude_km: float = 0.0
    covariance_trajectory: Any = field(default=None)
    from_et_s: float = -np.inf
    to_et_s: float = np.inf

    def __post_init__(self) -> None:
        require_number(self.radius_km, "radius_km", above=0.0)
        require_number(self.limb_altitude_km, "limb_altitude_km")
        require(self.from_et_s <= self.to_et_s, f"from_et_s is after to_et_s: {self.from_et_s} > {self.to_et_s}")
        if self.covariance_trajectory is not None:
            as_floats(self.covariance_trajectory, (6, 6), "covariance_trajectory")


def pass_from_run(folder: Path, choice: RunPass) -> NavigationPass:
    """Read a pass from the observables of a run folder.

    Parameters
    ----------
    folder : Path; of the run, or its ``observables.parquet``
    choice : RunPass

    Returns
    -------
    NavigationPass
        The preferred positions of the target, in order of time.

    Raises
    ------
    DataError
        The file cannot be read, or holds no position of the target with a covariance in the time of the pass.
    """
    path = folder if folder.suffix == ".parquet" else folder / OBSERVABLES
    rows, metadata = read_observables(path)
    try:
        camera = Camera.from_mapping(json.loads(metadata["camera"]))
    except (KeyError, json.JSONDecodeError) as error:
        raise DataError(path, "its metadata hold no camera: run the campaign again") from error
    given = pass_from_rows(rows, camera, choice)
    if given is None:
        targets = sorted({row.target for row in rows if row.kind == "body" and row.target is not None})
        raise DataError(
            path,
            f"holds no preferred position of {choice.target} with epoch, prediction and covariance in the time of the "
            f"pass; it has {', '.join(targets) or 'no body'}: positions need an estimator with a range, such as "
            "ellipsoid_cra, and images.attitude_sigma_deg or stars",
        )
    return given


def pass_from_rows(rows: Sequence[ObservableRow], camera: Camera, choice: RunPass) -> NavigationPass | None:
    """Make a pass of rows of observables; None where no row is of use.

    A trajectory error moves all images along a straight line: valid for passes of hours. A late exposure moves the body
    by its motion relative to the spacecraft and, where the attitude is not from its own stars, by the rotation of the
    camera if known. Of rows with one attitude, errors are shared as far as the smallest covariance goes; the drift
    beyond it is new in each.
    """
    chosen = sorted(
        (row for row in rows if _usable(row) and row.target == choice.target and _during(row, choice)), key=_epoch
    )
    if not chosen:
        return None
    middle = 0.5 * (_epoch(chosen[0]) + _epoch(chosen[-1]))
    common = _common_attitudes(chosen)
    images = tuple(_image(row, camera, choice, middle, common.get(row.shared_attitude or "")) for row in chosen)
    covariance = np.zeros((0, 0)) if choice.covariance_trajectory is None else choice.covariance_trajectory
    return NavigationPass(
        images=images,
        limb_altitude_km=choice.limb_altitude_km,
        covariance_trajectory=np.array(covariance, dtype=np.float64),
        trajectory_names=() if choice.covariance_trajectory is None else ("x", "y", "z", "vx", "vy", "vz"),
    )


def _common_attitudes(rows: Sequence[ObservableRow]) -> dict[str, Sequence[float] | None]:
    """Smallest covariance of the attitude, by its key, of those that several rows share."""
    shared: dict[str, list[ObservableRow]] = {}
    for row in rows:
        shared.setdefault(row.shared_attitude or "", []).append(row)
    return {
        key: min((row.attitude_covariance_rad2 for row in group), key=lambda cells: np.sum((cells or (np.inf,))[::4]))
        for key, group in shared.items()
        if len(group) > 1
    }


def _usable(row: ObservableRow) -> bool:
    needed = (
        row.epoch_et_s,
        row.observed_apparent_range_km,
        row.computed_pixel_px,
        row.computed_apparent_range_km,
        row.part_noise,
        row.camera_from_icrf_xyzw,
        row.sun_direction_icrf,
    )
    return row.kind == "body" and row.preferred and row.is_usable and all(value is not None for value in needed)


def _epoch(row: ObservableRow) -> float:
    return 0.0 if row.epoch_et_s is None else row.epoch_et_s


def _during(row: ObservableRow, choice: RunPass) -> bool:
    return choice.from_et_s <= _epoch(row) <= choice.to_et_s


def _image(
    row: ObservableRow, camera: Camera, choice: RunPass, middle_s: float, common: Sequence[float] | None
) -> PassImage:
    """Image of a row; ``common``: covariance of the attitude that it shares with other rows, None without any."""
    model = camera.model
    turn = rotation_from_xyzw(np.array(row.camera_from_icrf_xyzw, dtype=np.float64))
    measured = _place(model, row.observed_pixel_px, row.observed_line_px, row.observed_apparent_range_km)
    by_place = np.linalg.inv(np.vstack([model.project_jacobian(measured), unit(measured)]))
    own, shared = np.zeros((3, 3)), {}
    for name in (*_NEW_PARTS, *_LIGHT_PARTS, *_SHARED_PARTS, *_ATTITUDE_PARTS):
        cells = getattr(row, name)
        if cells is None:
            continue
        part = by_place @ np.nan_to_num(np.reshape(np.array(cells, dtype=np.float64), (3, 3))) @ by_place.T
        if not part.any():
            continue
        cause = name.removeprefix("part_")
        if name in _NEW_PARTS or (name in _ATTITUDE_PARTS and common is None):
            own += part
        elif name in _LIGHT_PARTS:
            own += (1.0 - _LIGHT_CORRELATION) * part
            shared[cause] = covariance_root(_LIGHT_CORRELATION * part) @ _light_axes(row, turn, measured)
        else:
            shifts = _signed_shifts(row, cause, camera, common)
            key = f"{cause} {row.shared_attitude}" if name in _ATTITUDE_PARTS else cause
            shared[key] = covariance_root(part) if shifts is None else by_place @ shifts
            if name == "part_attitude" and shifts is not None:
                root = covariance_root(part - shared[key] @ shared[key].T)  # the drift, without what rounding makes
                own += root @ root.T
    time_s = _epoch(row) - middle_s
    by_state = -turn.as_matrix() @ np.hstack([np.eye(3), time_s * np.eye(3)])
    return PassImage(
        name=row.file,
        time_s=time_s,
        position_camera_km=_place(model, row.computed_pixel_px, row.computed_line_px, row.computed_apparent_range_km),
        rate_camera_km_s=_rate(row, turn, measured),
        exposure_s=np.nan if row.exposure_s is None else row.exposure_s,
        sensor=row.attitude_source or "",
        by_trajectory=np.zeros((3, 0)) if choice.covariance_trajectory is None else by_state,
        observed=MeasuredPosition(
            position_camera_km=measured,
            covariance_camera_km2=(own + own.T) / 2.0,
            radius_km=choice.radius_km,
            apparent_radius_px=apparent_radius_px(
                camera, model.project(measured), choice.radius_km, float(np.linalg.norm(measured))
            ),
            shared_km=shared,
        ),
    )


def _light_axes(row: ObservableRow, turn: Rotation, measured: Float) -> Float:
    """Unit vectors (3, 3), as columns: across the line of sight toward the Sun, across both, and along it."""
    sight = unit(measured)
    across = np.cross(sight, rotate(turn, np.array(row.sun_direction_icrf, dtype=np.float64)))
    if not across.any():  # the Sun is behind the camera: no direction of the image differs from the others
        across = np.cross(sight, np.array([1.0, 0.0, 0.0]))
    across = unit(across)
    return np.stack([np.cross(across, sight), across, sight], axis=-1)


def _signed_shifts(
    row: ObservableRow, cause: str, camera: Camera, attitude_rad2: Sequence[float] | None
) -> Float | None:
    """Shifts (3, k), px, px and km, by one sigma of each parameter of a cause; None where it has no partials."""
    pole, spin, sun, known = row.sigma_pole_rad, row.sigma_spin_rad, row.sigma_sun_rad, camera.uncertainty
    covariances: dict[str, tuple[Sequence[float] | None, object]] = {
        "attitude": (row.partial_attitude, attitude_rad2),
        "pole": (row.partial_pole, None if pole is None else pole**2 * np.eye(2)),
        "spin": (row.partial_spin, None if spin is None else spin**2 * np.eye(1)),
        "sun": (row.partial_sun, None if sun is None else sun**2 * np.eye(3)),
        "camera": (row.partial_camera_parameters, None if known is None else known.covariance),
    }
    partial, covariance = covariances.get(cause, (None, None))
    if partial is None or covariance is None:
        return None
    by_parameters = np.reshape(np.array(partial, dtype=np.float64), (3, -1))
    size = by_parameters.shape[1]
    return np.asarray(by_parameters @ covariance_root(np.array(covariance, dtype=np.float64).reshape(size, size)))


def _place(model: CameraModel, pixel: float | None, line: float | None, range_km: float | None) -> Float:
    """Vector (3,), km, camera axes, of a pixel and a range."""
    place: Float = np.array(range_km, dtype=np.float64) * unit(
        model.unproject(np.array([pixel, line], dtype=np.float64))
    )
    return place


def _rate(row: ObservableRow, turn: Rotation, position_camera_km: Float) -> Float:
    """Rate (3,) of the position of the target in camera axes; zero where the velocities are not known."""
    if row.target_velocity_icrf_km_s is None or row.observer_velocity_icrf_km_s is None:
        return np.zeros(3)
    relative = np.array(row.target_velocity_icrf_km_s) - np.array(row.observer_velocity_icrf_km_s)
    rotation = np.zeros(3) if row.camera_rate_rad_s is None or row.attitude_source == "stars" else row.camera_rate_rad_s
    return rotate(turn, relative) - np.cross(rotation, position_camera_km)
