"""Observations for a calibration: known directions or points, and their pixels."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, as_finite, as_floats, as_unit, require
from giantlike.core.values import Value


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageObservations(Value):
    """Known targets in one image, or in a composite of images taken with one orientation of the camera.

    Parameters
    ----------
    name : str; name of the image in reports
    targets : (n, 3) float64
        Unit vectors in a reference frame (stars: apparent directions, inertial axes), or points of a board in the
        board's own axes where ``finite``, in any unit of length.
    points_px : (n, 2) float64, px; measured pixels of the targets
    sigma_px : (n,) float64, px; standard deviation per axis; a scalar applies to all
    camera_from_reference : Rotation, optional; a priori; default for directions: estimated with the starting model
    attitude_sigma_rad : float, rad, optional; a priori, per axis; by default the orientation is only a start
    position_reference : (3,) float64, optional; of ``finite`` targets: start, from camera to origin of the board,
        camera axes, in the unit of the targets
    finite : bool; True if the targets are points at a finite distance, False if they are directions
    temperature_c : float, Celsius; of the camera
    labels : (n,) int64; catalog identifiers or numbers of corners of the targets, by default numbers from 0
    magnitudes : (n,) float64; default NaN

    Raises
    ------
    InputError
        Shapes disagree, a direction is not unit, a sigma is not positive.
    """

    name: str
    targets: Float
    points_px: Float
    sigma_px: Float
    camera_from_reference: Rotation | None = None
    attitude_sigma_rad: float | None = None
    position_reference: Float | None = None
    finite: bool = False
    temperature_c: float = 0.0
    labels: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    magnitudes: Float = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        targets = as_floats(self.targets, (3,), f"{self.name}: targets")
        if not self.finite:
            targets = as_unit(targets, f"{self.name}: targets")
        require(targets.ndim == 2 and len(targets) > 0, f"{self.name}: targets must be (n, 3), got {targets.shape}")
        count = len(targets)
        sigma = np.broadcast_to(np.asarray(self.sigma_px, dtype=np.float64), (count,))
        require(bool((np.isfinite(sigma) & (sigma > 0)).all()), f"{self.name}: sigma_px must be > 0")
        require(np.isfinite(self.temperature_c), f"{self.name}: temperature_c must be finite")
        weighted = self.attitude_sigma_rad
        require(weighted is None or weighted > 0, f"{self.name}: attitude_sigma_rad must be > 0, got {weighted}")
        require(
            weighted is None or self.camera_from_reference is not None,
            f"{self.name}: attitude_sigma_rad needs camera_from_reference",
        )
        pose = self.camera_from_reference is not None and self.position_reference is not None
        require(not self.finite or pose, f"{self.name}: finite targets need camera_from_reference, position_reference")
        points_px = as_finite(self.points_px, (count, 2), f"{self.name}: points_px")
        labels = np.arange(count) if len(self.labels) == 0 else np.asarray(self.labels)
        magnitudes = np.full(count, np.nan) if len(self.magnitudes) == 0 else np.asarray(self.magnitudes, dtype=float)
        require(
            labels.shape == (count,) and magnitudes.shape == (count,),
            f"{self.name}: labels and magnitudes must have shape ({count},), got {labels.shape} and {magnitudes.shape}",
        )
        self._keep(
            targets=targets,
            points_px=points_px,
            sigma_px=np.array(sigma),
            labels=labels.astype(np.int64),
            magnitudes=magnitudes,
        )

    def __len__(self) -> int:
        return len(self.targets)


def collimator_directions(azimuth_rad: ArrayLike, elevation_rad: ArrayLike) -> Float:
    """Directions (n, 3), unit vectors, of a fixed collimator in the axes of the gimbal stage that carries the camera.

    The stage rotates about its vertical axis (azimuth, toward +x) and then about its horizontal axis (elevation, toward
    -y, up in an image); at zero the collimator is on its +z axis. Seen from the stage it moves the other way. All
    images of a grid form one composite: one :class:`ImageObservations`.

    Source: Holt, D'Souza and Saley, Orion Optical Navigation Progress Toward Exploration Mission 1, III.A (99 images).

    >>> collimator_directions([0.1], [0.0]).round(3).tolist()
    [[-0.1, 0.0, 0.995]]
    """
    azimuth, elevation = as_floats(azimuth_rad, (), "azimuth_rad"), as_floats(elevation_rad, (), "elevation_rad")
    flat = np.cos(azimuth)
    x, z = -np.sin(azimuth), flat * np.cos(elevation)
    return np.stack([x, flat * np.sin(elevation), z], axis=-1)
