"""Result of the adjustment of a network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.calibration.observability import ParameterSupport, WeakCombination
from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask, finite_or_none
from giantlike.core.causes import Cause
from giantlike.core.values import Estimate, Value
from giantlike.network.photos import Photo, Tracks
from giantlike.network.rotation import Rotating


class PointStatus(StrEnum):
    """Check of a point by its measures."""

    CHECKED = "checked"
    UNCHECKED = "unchecked"
    """Two measures or fewer are used: an error of one along the line of sight of the other cannot be seen."""
    AMBIGUOUS = "ambiguous"  # rejecting another measure of the point fits as well


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameDirection:
    """One of the seven directions of the frame of a network that no pixel shows."""

    name: str  # shift or rotation along or about a body axis, or scale
    # km, rad, or relative; of what the a priori values say about it; infinite where they say nothing, and the direction
    # is held at the a priori poses
    sigma: float
    share: float  # of the variance of the points that it makes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CovariancePart(Value):
    """Covariance by one cause, of points (p, 3, 3) km^2, poses (m, 6, 6), and the k shared parameters (k, k)."""

    points_km2: Float
    poses: Float
    shared: Float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NetworkFix(Estimate):
    """Adjusted network.

    Parameters
    ----------
    photos : tuple of Photo; images with adjusted attitudes, positions and covariances, and the adjusted camera
    tracks : Tracks; measures, in the order of all arrays of measures
    points_km : (p, 3) float64, km, body axes; NaN for points that the measures in use do not determine
    covariance_points_km2 : (p, 3, 3) float64, km^2
    point_status : (p,) str; values of :class:`PointStatus`
    covariance_poses : (m, 6, 6) float64, rad^2, rad km, km^2; rotation vectors about the camera axes, and positions
    body : Rotating or None; rotation of the body after the adjustment, with its covariance at J2000
    shared_names : tuple of str
        The k parameters common to all images: ``pole_east``, ``pole_north`` and ``w`` (rad, at ``mean_et``), ``rate``
        (rad/s), ``size`` (relative) and those of the camera.
    shared : (k,) float64; their departures from the a priori values
    covariance_shared : (k, k) float64
    mean_et : float, s; mean epoch of the images, TDB seconds past J2000
    residuals_px : (n, 2) float64, px; measured minus computed
    used : (n,) bool; measures that were not rejected
    redundancy : (n,) float64; of each measure, 0 to 2; NaN for rejected ones
    detectable_px : (n,) float64, px
        Smallest error that would be rejected with a probability of 80 %, in the worst direction (reliability after
        Baarda); infinite where none would be.
    noise : float; standard deviation of the measures in units of the stated one, robust
    chi2, freedom : float, int; weighted squares of residuals and departures from a priori values; degrees of freedom
    covariance_scale : float; factor that is in all covariances
    support : tuple of ParameterSupport; classification of each shared parameter that is estimated
    weak : tuple of WeakCombination
        Combinations of shared parameters, the common attitude error and the common scale of ranges that the images do
        not determine.
    frame : tuple of FrameDirection; the seven directions that no pixel shows
    datum : str; what ties the frame of the points
    parts : mapping of Cause to CovariancePart; covariances by cause, which sum to the total
    steps, rounds : int
    """

    photos: tuple[Photo, ...]
    tracks: Tracks
    points_km: Float
    covariance_points_km2: Float
    point_status: NDArray[np.str_]
    covariance_poses: Float
    body: Rotating | None
    shared_names: tuple[str, ...]
    shared: Float
    covariance_shared: Float
    mean_et: float
    residuals_px: Float
    used: Mask
    redundancy: Float
    detectable_px: Float
    noise: float
    chi2: float
    freedom: int
    covariance_scale: float
    support: tuple[ParameterSupport, ...]
    weak: tuple[WeakCombination, ...]
    frame: tuple[FrameDirection, ...]
    datum: str
    parts: Mapping[Cause, CovariancePart]
    steps: int
    rounds: int

    @property
    def poses(self) -> tuple[Rotation, Float]:
        """Adjusted ``camera_from_inertial`` of all images, and positions (m, 3), km."""
        rotations = Rotation.concatenate([photo.camera_from_inertial for photo in self.photos])
        return rotations, np.array([photo.position_km for photo in self.photos])

    @property
    def camera(self) -> CameraModel:
        """Camera of the first image."""
        return self.photos[0].model

    def summary(self) -> dict[str, Any]:
        """Return what ``result.json`` of ``giantlike network adjust`` holds."""
        status = [str(each) for each in self.point_status]
        tracks, used = self.tracks, self.used
        photos = []
        for number, photo in enumerate(self.photos):
            mine = tracks.photo == number
            left = self.residuals_px[mine & used]
            sigma = np.sqrt(np.diagonal(self.covariance_poses[number]))
            photos.append(
                {
                    "name": photo.name,
                    "measures": int(mine.sum()),
                    "rejected": int((mine & ~used).sum()),
                    "rms_px": finite_or_none(float(np.sqrt(np.mean(left**2)))) if len(left) else None,
                    "position_km": photo.position_km.tolist(),
                    "sigma_position_km": sigma[3:].tolist(),
                    "sigma_attitude_deg": np.degrees(sigma[:3]).tolist(),
                }
            )
        shared = [
            {
                "name": each.name,
                "departure": each.value - each.start,
                "sigma": each.sigma,
                "verdict": str(each.verdict),
                "partner": each.partner,
                "correlation": each.correlation,
            }
            for each in self.support
        ]
        return {
            "images": photos,
            "points": len(tracks.names),
            "measures": len(tracks.point),
            "rejected": [
                {"point": tracks.names[tracks.point[k]], "image": self.photos[tracks.photo[k]].name,
                 "residual_px": [finite_or_none(float(value)) for value in self.residuals_px[k]]}
                for k in np.flatnonzero(~used)
            ],
            "point_status": {str(each): status.count(each) for each in PointStatus},
            "noise_over_stated": self.noise,
            "sigma0": float(np.sqrt(self.chi2 / max(self.freedom, 1))),
            "freedom": self.freedom,
            "covariance_scale": self.covariance_scale,
            "datum": self.datum,
            "frame": [{"name": e.name, "sigma": finite_or_none(e.sigma), "share": e.share} for e in self.frame],
            "shared": shared,
            "weak": [str(each) for each in self.weak],
            "steps": self.steps,
            "rounds": self.rounds,
        }  # fmt: skip
