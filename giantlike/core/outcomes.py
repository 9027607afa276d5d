"""Results of estimators: a fix with its covariance, or a failure with a reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, require
from giantlike.core.causes import IN_IMAGE, IN_POSITION, Cause, checked_partials, checked_parts, require_sum, sum_parts
from giantlike.core.display import Pictured
from giantlike.core.errors import EstimationError
from giantlike.core.findings import Corrections, Findings
from giantlike.core.reasons import Outcome as Outcome
from giantlike.core.reasons import Quality as Quality
from giantlike.core.reasons import Reason as Reason
from giantlike.core.values import Estimate, Value

_FLAGS_OF_THE_SKY = Quality.OBSERVER_UNKNOWN | Quality.EPOCH_UNKNOWN


@dataclass(frozen=True, slots=True)
class Failure:
    """A failed estimate and its reason; False in a condition, so that ``if fix:`` works.

    Parameters
    ----------
    reason : Reason; kind of failure
    detail : str; one line: the requirement, the finding, and the remedy
    not_applicable : bool; True where the estimator is not made for such a body, whatever the image shows
    """

    reason: Reason
    detail: str
    not_applicable: bool = field(default=False, repr=False)

    def __bool__(self) -> bool:
        return False

    def unwrap(self) -> NoReturn:
        """Raise an EstimationError with the text of this failure, where a caller needs the fix."""
        raise EstimationError(f"{self.reason}: {self.detail}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AttitudeErrors(Value):
    """Error budget of an attitude (a small rotation ``e``), and the errors that it has in common with the measurement.

    Parameters
    ----------
    parts : mapping of Cause to (3, 3) float64, rad^2; of ``e``, about the camera axes; empty when all is noise
    by_camera : (3, m) float64, rad per unit of each parameter, optional
        Derivative of ``e`` by the parameters of the camera model, in the order of their names: an attitude from stars
        depends on errors of the camera. None where it does not, or where this is unknown.
    flags : Quality; flags of the attitude that fixes made with it inherit
    """

    parts: Mapping[Cause, Float] = field(default_factory=dict)
    by_camera: Float | None = None
    flags: Quality = Quality.NONE

    def __post_init__(self) -> None:
        self._keep(parts=checked_parts(self.parts, 3))

    def apart_from_camera(self, covariance_rad2: Float) -> Float:
        """Covariance of the attitude for a body whose camera part already includes the rotation of the stars.

        ``covariance_rad2`` (3, 3), rad^2, of the attitude; returned without the camera part where :attr:`by_camera` is
        known.
        """
        if self.by_camera is None or Cause.CAMERA not in self.parts:
            return covariance_rad2
        return sum_parts(self.parts, [cause for cause in Cause if cause is not Cause.CAMERA])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AttitudeFix(Pictured, Estimate):
    """Camera attitude from stars.

    Parameters
    ----------
    camera_from_inertial : scipy Rotation; takes ICRF vectors to camera axes
    covariance_rad2 : (3, 3) float64, rad^2
        Of the small rotation ``e`` about the camera axes with
        ``camera_from_inertial_true = Rotation.from_rotvec(e) * camera_from_inertial``.
    star_ids : (n,) int64; catalog identifiers of the stars used
    detection_indices : (n,) int64; indices of the matched detections
    observed_px, predicted_px : (n, 2) float64, px; centroids, and catalog stars with the fixed attitude
    sigma_px : (n,) float64, px; standard deviation per axis used to weight each star
    magnitudes : (n,) float64; catalog magnitudes
    n_detected, n_rejected : int; detections offered to identification; tentative matches thrown out as outliers
    false_match_probability : float; bound on the probability that the whole identification is a chance match
    focal_length_px : float, px; along x, of the camera model used (refined if the scale was estimated)
    fov_deg : float, deg; field of view along x of the camera model used: ``2 atan(columns / (2 fx))``
    rejected_px : (n_rejected, 2) float64, px; measured centroids of the matches thrown out
    camera_name : str; name of the camera whose axes the attitude refers to; empty when unknown
    flags : Quality
    provenance : mapping of str to str; versions and hashes of the inputs of the fix
    parts : mapping of Cause to (3, 3) float64, rad^2; of ``covariance_rad2``; empty when all is noise
    by_camera : (3, m) float64, rad per unit of each parameter, optional; as in :class:`AttitudeErrors`
    star_names : tuple of n str; proper names of the stars used, empty for those that have none
    notes : tuple of str; errors of inputs that the solution shows: a priori attitude, distortion
    """

    camera_from_inertial: Rotation
    covariance_rad2: Float
    star_ids: NDArray[np.int64]
    detection_indices: NDArray[np.int64]
    observed_px: Float
    predicted_px: Float
    sigma_px: Float
    magnitudes: Float
    n_detected: int
    n_rejected: int
    false_match_probability: float
    focal_length_px: float
    fov_deg: float
    rejected_px: Float = field(default_factory=lambda: np.zeros((0, 2)))
    camera_name: str = ""
    flags: Quality = Quality.NONE
    provenance: Mapping[str, str] = field(default_factory=dict)
    parts: Mapping[Cause, Float] = field(default_factory=dict)
    by_camera: Float | None = None
    star_names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", checked_parts(self.parts, 3))
        if self.parts:
            require_sum(self.parts, tuple(Cause), self.covariance_rad2, "covariance_rad2")
        Value.__post_init__(self)

    def __repr__(self) -> str:
        sigma = np.degrees(np.sqrt(np.diag(self.covariance_rad2))) * 3600.0
        return (
            f"AttitudeFix({_status(self.flags)}, {self.n_used} of {self.n_detected} stars, rms {self.rms_px:.3g} px, "
            f"sigma {sigma[0]:.3g}, {sigma[1]:.3g}, {sigma[2]:.3g} arcsec)"
        )

    @property
    def errors(self) -> AttitudeErrors:
        """Error budget, derivatives by the camera and shared flags, as kept in an image."""
        return AttitudeErrors(parts=self.parts, by_camera=self.by_camera, flags=self.flags & _FLAGS_OF_THE_SKY)

    @property
    def residuals_px(self) -> Float:
        """Observed minus predicted, (n, 2), px."""
        return self.observed_px - self.predicted_px

    @property
    def n_used(self) -> int:
        """Number of matched stars."""
        return int(self.star_ids.size)

    @property
    def rms_px(self) -> float:
        """Radial residual ``sqrt(mean(dx^2 + dy^2))``, px."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_px**2, axis=1))))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CenterFix(Pictured, Estimate):
    """Position of the center of a body (the origin of its shape model) in an image.

    Parameters
    ----------
    estimator, target : str; names as in the tables
    center_px : (2,) float64, px; measured center, in the distorted image
    covariance_px2 : (2, 2) float64, px^2
        Covariance of the position in the image: noise and the model errors that move the measured center, the causes of
        :data:`~giantlike.core.causes.IN_IMAGE`. Errors of the camera model, the attitude and the ephemeris of the
        target do not move it and are not included.
    predicted_px : (2,) float64, px; center predicted from the a priori geometry
    residuals : (n,) float64; post-fit, in the estimator's own unit (px of limbs, brightness of templates)
    n_used, n_rejected : int; observations (pixels, limb points, detections) kept and thrown out
    score : float; goodness of fit, as defined by the estimator
    flags : Quality; quality flags
    provenance : mapping of str to str; versions and hashes of inputs; texts of ``corrections``, ``findings``
    parts : mapping of Cause to (k, k) float64
        The covariance by cause, of x and y in px (k = 2) and, in a :class:`PositionFix`, of the natural logarithm of
        the range (k = 3). Causes ``IN_IMAGE`` sum to ``covariance_px2``; the camera, the attitude, the ephemeris and
        aberration are additional, as the pixels by which they shift the direction in inertial axes: where the attitude
        comes from stars, ``CAMERA`` is the effect of the camera on stars and body together. Empty when all is noise.
    partials : mapping of Cause to (k, m) float64
        Derivative of the measured position, in the coordinates of ``parts``, by the true values of the error sources,
        where known: the attitude (a small rotation about the camera axes, rad), the scale of the shape (relative), the
        pole (two small rotations of the body about its x and y axes, rad), the spin (one about its z axis, rad), and
        the uncertain parameters of the camera, stars that follow them included.
    residuals_at_px : (n, 2) float64, px; position of each of the ``residuals``; empty where there is none
    corrections : Corrections; other effects in the image that the fix corrects for
    findings : Findings; outcomes of its checks

    Raises
    ------
    InputError
        There are positions, but not one for each residual; a part or a derivative has another shape, a part is not
        symmetric or not positive semi-definite, or the parts do not sum to the covariance.
    """

    estimator: str
    target: str
    center_px: Float
    covariance_px2: Float
    predicted_px: Float
    residuals: Float
    n_used: int
    n_rejected: int
    score: float
    flags: Quality = Quality.NONE
    provenance: Mapping[str, str] = field(default_factory=dict)
    parts: Mapping[Cause, Float] = field(default_factory=dict)
    partials: Mapping[Cause, Float] = field(default_factory=dict)
    residuals_at_px: Float = field(default_factory=lambda: np.zeros((0, 2)))
    corrections: Corrections = field(default_factory=Corrections)
    findings: Findings = field(default_factory=Findings)

    def __post_init__(self) -> None:
        texts = self.corrections.texts | self.findings.texts
        object.__setattr__(self, "provenance", {**self.provenance, **texts})
        require(
            len(self.residuals_at_px) in (0, len(self.residuals)),
            f"residuals_at_px: {len(self.residuals_at_px)} places for {len(self.residuals)} residuals",
        )
        object.__setattr__(self, "parts", checked_parts(self.parts, self._size))
        object.__setattr__(self, "partials", checked_partials(self.partials, self._size))
        if self.parts:
            self._require_sums()
        Value.__post_init__(self)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._words()})"

    def _words(self) -> str:
        """Target, status and position with its standard deviations."""
        (x, y), (sigma_x, sigma_y) = self.center_px, np.sqrt(np.diag(self.covariance_px2))
        place = f"({x:.3f}, {y:.3f}) +- ({sigma_x:.2g}, {sigma_y:.2g}) px"
        return f"{self.target} by {self.estimator}: {_status(self.flags)}, center {place}"

    def _require_sums(self) -> None:
        """Raise unless the parts sum to the covariances."""
        require_sum(self.parts, IN_IMAGE, self.covariance_px2, "covariance_px2")

    @property
    def _size(self) -> int:
        """Number of the measured coordinates: x and y."""
        return 2

    @property
    def covariance_total(self) -> Float:
        """Covariance of observed minus computed, (k, k) as ``parts``: the sum of all causes.

        ``sum_parts(fix.parts, causes)`` of :mod:`giantlike.core.causes` sums a choice of them, such as all but the
        ephemeris for the position in inertial axes.
        """
        return sum_parts(self.parts, tuple(Cause)) if self.parts else np.array(self.covariance_px2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BodyTurn(Value):
    """Rotation of a body about the line of sight, estimated with its position; it gives the roll of the camera.

    The position differs from that of the fix, which assumes the a priori orientation of the body.

    Parameters
    ----------
    turn_rad : float, rad; rotation from the a priori orientation, about the direction from the camera
    center_px : (2,) float64, px; position of its center with this rotation
    covariance : (3, 3) float64
        Of x and y in px and of the rotation in rad, by noise and the errors of the shape. The a priori orientation does
        not enter; the errors of the camera model are in the variance of the rotation alone.
    by_rotation : (3, 3) float64, px/rad and rad/rad; of x, y, rotation by a small rotation about the camera axes
    """

    turn_rad: float
    center_px: Float
    covariance: Float
    by_rotation: Float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PositionFix(CenterFix):
    """A :class:`CenterFix` with the range: the full relative position of a body.

    Parameters
    ----------
    position_camera_km : (3,) float64, km, camera axes
        Apparent position of the origin of the shape model from the camera: light time and aberration not removed. Its
        length, the range, is the distance that gives the size in the image: the light path in the frame of the
        observer, :func:`~giantlike.core.light.boosted`.
    covariance_camera_km2 : (3, 3) float64, km^2, camera axes
        Covariance of the position in camera axes: the causes of ``covariance_px2``, and the camera model alone, which
        converts pixels to directions. The attitude and the ephemeris of the target are not in it.
    limb_px : (n, 2) float64, px; for overlays: limb points or landmarks used, or the outline of a template
    limb_rejected_px : (k, 2) float64, px; points of the illuminated limb not used, as measured or else predicted
    turn : BodyTurn or None; rotation of the body about the line of sight, of estimators that measure it
    """

    position_camera_km: Float
    covariance_camera_km2: Float
    limb_px: Float
    limb_rejected_px: Float = field(default_factory=lambda: np.zeros((0, 2)))
    turn: BodyTurn | None = None

    @property
    def measured_limb_px(self) -> Float:
        """The limb points (n, 2), px, that the fix was made of, a residual each; empty where it was made otherwise."""
        made_of_them = np.array_equal(self.limb_px, self.residuals_at_px)
        return self.limb_px if made_of_them else np.zeros((0, 2))

    def _require_sums(self) -> None:
        """Raise unless the parts sum to the covariances; the covariance of the position is compared along the range."""
        CenterFix._require_sums(self)
        variance = np.array([[(self.sigma_range_km / self.range_km) ** 2]])
        along = {cause: part[2:, 2:] for cause, part in self.parts.items()}
        require_sum(along, IN_POSITION, variance, "the relative variance of range in covariance_camera_km2")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._words()}, range {self.range_km:.8g} +- {self.sigma_range_km:.2g} km)"

    @property
    def _size(self) -> int:
        """Number of the measured coordinates: x, y and the logarithm of the range."""
        return 3

    @property
    def range_km(self) -> float:
        """Apparent distance from camera to body center, km."""
        return float(np.linalg.norm(self.position_camera_km))

    @property
    def sigma_range_km(self) -> float:
        """Standard deviation of :attr:`range_km`, km."""
        direction = self.position_camera_km / self.range_km
        return float(np.sqrt(direction @ self.covariance_camera_km2 @ direction))


def _status(flags: Quality) -> str:
    """Status of a fix with these flags, and their names."""
    names = f" ({', '.join(flags.names())})" if flags else ""
    return ("suspect" if flags.suspect else "ok") + names
