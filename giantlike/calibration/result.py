"""Result of a calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.calibration.observability import ParameterSupport
from giantlike.camera import Camera, ModelUncertainty
from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask
from giantlike.core.display import Pictured
from giantlike.core.values import Estimate, Value


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageCalibration(Value):
    """One image of a calibration."""

    name: str
    temperature_c: float
    camera_from_reference: Rotation
    covariance_rad2: Float  # of the small rotation about the camera axes, the uncertainty of the camera included
    position_reference: Float  # vector from the camera to the board, camera axes, if the targets are finite; else zero
    n_used: int
    n_rejected: int
    rms_px: float  # radial; NaN where nothing was kept
    # shift of the camera map (rms over the field, modulo a rotation) when this image is left out; infinite if the other
    # images do not determine a parameter
    influence_px: float
    influence: float  # Cook's distance: squared shift over covariance and number. Above 1, one image dominates


@dataclass(frozen=True, slots=True, kw_only=True)
class RejectedObservation:
    """A rejected observation."""

    image: str  # name of the image
    label: int  # label of the target
    observed_px: tuple[float, float]
    predicted_px: tuple[float, float]
    distance_px: float  # NaN if the model cannot project the target
    sigmas: float  # distance over the sigma of the observation
    cause: str  # ``outlier``, ``not_imaged`` by the model, or ``image``: too few of the whole image agree


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibrationResult(Pictured, Estimate):
    """A calibrated camera model with its covariance, residuals and diagnostics.

    Parameters
    ----------
    model : CameraModel
    start : CameraModel; model from which the fit started
    columns, rows : int
    estimated : tuple of str; names of the k parameters estimated; the others have the values of ``start``
    covariance : (k, k) float64; of those parameters, in their units, ``covariance_scale`` included
    covariance_scale : float; factor on the covariance for residuals that the given sigmas do not explain, else 1
    images : tuple of ImageCalibration
    image_index : (n,) int; image of each observation; the arrays below contain all observations, used or not
    observed_px, predicted_px : (n, 2) float64, px; predicted by the calibrated model, NaN where it cannot
    sigma_px, magnitudes : (n,) float64
    labels : (n,) int64
    used : (n,) bool
    rejected : tuple of RejectedObservation; worst first
    residual_sigma_px : float, px; post-fit residual per axis, corrected for the degrees of freedom
    reduced_chi2 : float
    condition_number : float; of the scaled information of the parameters
    support : tuple of ParameterSupport; verdict on each parameter
    map_points_px, map_sigma_px : (g, 2), (g,) float64, px; radial uncertainty of the map, modulo a rotation
    problems : tuple of str; criteria that were missed, each with the limit and the value; empty if accepted
    steps, rounds : int; Levenberg-Marquardt steps in all, and rounds of rejection
    provenance : mapping of str to str
    """

    model: CameraModel
    start: CameraModel
    columns: int
    rows: int
    estimated: tuple[str, ...]
    covariance: Float
    covariance_scale: float
    images: tuple[ImageCalibration, ...]
    image_index: NDArray[np.intp]
    observed_px: Float
    predicted_px: Float
    sigma_px: Float
    magnitudes: Float
    labels: NDArray[np.int64]
    used: Mask
    rejected: tuple[RejectedObservation, ...]
    residual_sigma_px: float
    reduced_chi2: float
    condition_number: float
    support: tuple[ParameterSupport, ...]
    map_points_px: Float
    map_sigma_px: Float
    problems: tuple[str, ...]
    steps: int
    rounds: int
    provenance: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        verdict = "accepted" if self.accepted else f"not accepted: {self.problems[0]}"
        return (
            f"CalibrationResult({verdict}, {type(self.model).__name__}, {len(self.estimated)} parameters from "
            f"{self.n_used} observations of {len(self.images)} images, rms {self.rms_px:.3g} px, "
            f"map known to {self.map_sigma_px.max():.2g} px)"
        )

    @property
    def accepted(self) -> bool:
        """True if every criterion is met."""
        return not self.problems

    @property
    def residuals_px(self) -> Float:
        """Observed minus predicted, (n, 2), px, of all observations."""
        return self.observed_px - self.predicted_px

    @property
    def rms_px(self) -> float:
        """Radial residual rms of the observations used, px."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_px[self.used] ** 2, axis=1))))

    def weighted_rms_px(self, image: int | None = None) -> float:
        """Radial residual rms, px, of the observations used in one image or all, with their weights in the fit.

        Faint stars, dominated by noise, have little weight in it. NaN without observations.
        """
        mine = self.used if image is None else self.used & (self.image_index == image)
        if not mine.any():
            return math.nan
        weights = self.sigma_px[mine] ** -2.0
        return math.sqrt(float(np.average(np.sum(self.residuals_px[mine] ** 2, axis=1), weights=weights)))

    @property
    def n_used(self) -> int:
        """Number of observations kept."""
        return int(self.used.sum())

    @property
    def n_rejected(self) -> int:
        """Number of observations rejected."""
        return len(self.rejected)

    @property
    def correlation(self) -> Float:
        """Correlation matrix (k, k) of the estimated parameters."""
        sigma = np.sqrt(np.diag(self.covariance))
        result: Float = self.covariance / np.outer(sigma, sigma)
        return result

    def camera_from(self, camera: Camera) -> Camera:
        """Return a camera with the model of this calibration and its covariance; name, PSF and detector are kept."""
        uncertainty = ModelUncertainty(
            estimated=self.estimated,
            covariance=self.covariance,
            residual_sigma_px=self.residual_sigma_px,
            n_observations=self.n_used,
            n_images=sum(image.n_used > 0 for image in self.images),
        )
        return replace(camera, model=self.model, uncertainty=uncertainty)
