"""Columns of the tables of a run folder: ``attitudes`` and ``observations``, as CSV and as Parquet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from giantlike.io.tables import column

_parquet = partial(column, csv=False)  # A column that only the Parquet file has
_CAMERA = "camera"
_IMAGE = "distorted image"
_INERTIAL = "inertial (ICRF)"
_STATUS = "`ok`, `suspect` (kept, but a named check objects) or `failed`."
_REASON = "Reason of a failure."
_OUTCOME = (
    "The status; of a suspect result that a user accepted, `accepted`; or, of what is no failure, `rejected` (by a "
    "user), `not_applicable` (the estimator is not made for such a body) or `not_in_field` (the target is predicted "
    "far outside of the image), all with the status `failed`."
)
_ACCEPTED_BY = "User who accepted a suspect result."
_ACCEPTED_WHY = "The reason."
_FLAGS = "Names of quality flags, joined by `|`."
_TIME = "Computing time."
_DETAIL = "Reason of a failure in words."
_PROVENANCE = "Versions, hashes and options the result was made from, as JSON."
_TRIANGLE = "upper triangle by rows (xx, xy, xz, yy, yz, zz)"


@dataclass(frozen=True, slots=True, kw_only=True)
class AttitudeRow:
    """One row per image: its attitude, from its own stars, its neighbors in time, or a priori."""

    file: str = column("Image file: its base name or, where two files share one, the path relative to the TOML.")
    epoch_utc: str | None = column("Mid-exposure, ISO 8601.", "UTC")
    status: str = column(_STATUS)
    reason: str | None = column(_REASON)
    source: str | None = column("`stars`, `interpolated` or `a_priori`; of a failure, where it was looked for.")
    n_detected: int | None = column("Number of detections offered to the identification.")
    n_matched: int | None = column("Number of stars used.")
    rms_px: float | None = column("Radial residual of the stars, sqrt(mean(dx² + dy²)).", "px", _IMAGE)
    qx: float | None = column("Attitude quaternion, x.", "", "camera_from_inertial")
    qy: float | None = column("Attitude quaternion, y.", "", "camera_from_inertial")
    qz: float | None = column("Attitude quaternion, z.", "", "camera_from_inertial")
    qw: float | None = column("Attitude quaternion, scalar part.", "", "camera_from_inertial")
    ra_deg: float | None = column("Right ascension of the image center.", "deg", _INERTIAL)
    dec_deg: float | None = column("Declination of the image center.", "deg", _INERTIAL)
    roll_deg: float | None = column(
        "Position angle of the camera's -y axis, north through east; empty at a pole.", "deg", _INERTIAL
    )
    fov_deg: float | None = column("Field of view of the model used, 2·atan(columns/(2·fx)).", "deg")
    sigma_x_arcsec: float | None = column("One sigma of the rotation about x.", "arcsec", _CAMERA)
    sigma_y_arcsec: float | None = column("One sigma of the rotation about y.", "arcsec", _CAMERA)
    sigma_z_arcsec: float | None = column("One sigma of the rotation about z.", "arcsec", _CAMERA)
    flags: str | None = column(_FLAGS)
    outcome: str | None = column(_OUTCOME)
    accepted_by: str | None = column(_ACCEPTED_BY)
    accepted_why: str | None = column(_ACCEPTED_WHY)
    time_s: float | None = column(_TIME, "s")
    detail: str | None = _parquet(_DETAIL)
    sha256: str | None = _parquet("Hash of the image file; empty where it could not be read.")
    provenance: str | None = _parquet(_PROVENANCE)
    et: float | None = _parquet("Mid-exposure, seconds past J2000.", "TDB s")
    exposure_s: float | None = _parquet("Exposure.", "s")
    false_match_probability: float | None = _parquet("Bound on the probability of a chance identification.")
    n_rejected: int | None = _parquet("Number of matches rejected as outliers.")
    notes: Sequence[str] | None = _parquet("Oddities found on the way.")
    covariance_rad2: Sequence[float] | None = _parquet(
        f"Covariance of the small rotation about the camera axes, {_TRIANGLE}.", "rad²", _CAMERA
    )
    apriori_xyzw: Sequence[float] | None = _parquet(
        "A priori attitude quaternion, scalar last.", "", "camera_from_inertial"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservationRow:
    """One row per image, target and estimator: the center of a body (the origin of its shape model), and its position.

    Positions are apparent: light time and aberration are still in. Their lengths are the distances by which sizes in
    the image go: ``r g (1 + n.b)``, with the light-time distance r in direction n, the velocity b of the observer in
    units of the speed of light, and ``g = 1 / sqrt(1 - b^2)``. Sigmas hold the errors of the measurement and of the
    model of the body. ``sigma_range_km`` and ``covariance_camera_km2`` include errors of the camera model;
    ``..._total_px``, ``covariance_with_attitude_px2`` and ``covariance_inertial_km2`` errors of camera model and
    attitude.
    """

    file: str = column("Image file, as in `attitudes`.")
    epoch_utc: str | None = column("Mid-exposure, ISO 8601.", "UTC")
    target: str = column("Name of the target.")
    estimator: str = column("Name of the estimator.")
    status: str = column(_STATUS)
    reason: str | None = column(_REASON)
    predicted_x_px: float | None = column("Center by the a priori geometry, x.", "px", _IMAGE)
    predicted_y_px: float | None = column("Center by the a priori geometry, y.", "px", _IMAGE)
    x_px: float | None = column("Measured center, x.", "px", _IMAGE)
    y_px: float | None = column("Measured center, y.", "px", _IMAGE)
    sigma_x_px: float | None = column("One sigma of `x_px`.", "px", _IMAGE)
    sigma_y_px: float | None = column("One sigma of `y_px`.", "px", _IMAGE)
    rho_xy: float | None = column("Correlation of `x_px` and `y_px`.", "", _IMAGE)
    sigma_x_total_px: float | None = column(
        "One sigma of `x_px` with camera and attitude; empty where the attitude's is unknown.", "px", _IMAGE
    )
    sigma_y_total_px: float | None = column("The same of `y_px`.", "px", _IMAGE)
    rho_xy_total: float | None = column("Correlation of `x_px` and `y_px` with camera and attitude.", "", _IMAGE)
    x_camera_km: float | None = column("Measured vector from camera to center, x.", "km", _CAMERA)
    y_camera_km: float | None = column("Measured vector from camera to center, y.", "km", _CAMERA)
    z_camera_km: float | None = column("Measured vector from camera to center, z.", "km", _CAMERA)
    range_km: float | None = column("Measured apparent distance from camera to center.", "km")
    sigma_range_km: float | None = column("One sigma of `range_km`.", "km")
    rho_x_range: float | None = column("Correlation of `x_px` and `range_km`, without the camera.", "", _IMAGE)
    rho_y_range: float | None = column("Correlation of `y_px` and `range_km`, without the camera.", "", _IMAGE)
    rho_x_range_total: float | None = column(
        "Correlation of `x_px` and `range_km` with camera and attitude; empty where the attitude's is unknown.",
        "",
        _IMAGE,
    )
    rho_y_range_total: float | None = column("The same of `y_px`.", "", _IMAGE)
    score: float | None = column("Measure of fit of the estimator.")
    n_used: int | None = column("Number of pixels or points used.")
    n_rejected: int | None = column("Number of pixels or points rejected.")
    flags: str | None = column(_FLAGS)
    outcome: str | None = column(_OUTCOME)
    accepted_by: str | None = column(_ACCEPTED_BY)
    accepted_why: str | None = column(_ACCEPTED_WHY)
    time_s: float | None = column(_TIME, "s")
    detail: str | None = _parquet(_DETAIL)
    attitude_source: str | None = _parquet("Source of the attitude used, as in `attitudes`.")
    provenance: str | None = _parquet(_PROVENANCE)
    camera_from_inertial_xyzw: Sequence[float] | None = _parquet(
        "Quaternion of the attitude used, scalar last.", "", "camera_from_inertial"
    )
    attitude_covariance_rad2: Sequence[float] | None = _parquet(
        f"Covariance of that attitude, {_TRIANGLE}.", "rad²", _CAMERA
    )
    predicted_camera_km: Sequence[float] | None = _parquet("A priori vector from camera to center.", "km", _CAMERA)
    parts: str | None = _parquet(
        "Covariance of x, y (px) and, where there is a range, of its logarithm by cause, as JSON: matrices by name."
    )
    covariance_px2: Sequence[float] | None = _parquet("Covariance of the measured center (xx, xy, yy).", "px²", _IMAGE)
    covariance_with_attitude_px2: Sequence[float] | None = _parquet(
        "The same with the uncertainty of the attitude; empty where that is unknown.", "px²", _IMAGE
    )
    partial_position_inertial_px_km: Sequence[float] | None = _parquet(
        "Derivative (2 x 3, by rows) of the center by the apparent vector from camera to center in inertial axes.",
        "px/km",
        "distorted image by inertial (ICRF)",
    )
    partial_attitude_px_rad: Sequence[float] | None = _parquet(
        "Derivative (2 x 3, by rows) of the center by the small rotation about the camera axes.",
        "px/rad",
        "distorted image by camera",
    )
    covariance_camera_km2: Sequence[float] | None = _parquet(
        f"Covariance of the measured vector, {_TRIANGLE}.", "km²", _CAMERA
    )
    position_inertial_km: Sequence[float] | None = _parquet("Measured vector from camera to center.", "km", _INERTIAL)
    covariance_inertial_km2: Sequence[float] | None = _parquet(
        f"Its covariance with the uncertainty of the attitude, {_TRIANGLE}; empty where that is unknown.",
        "km²",
        _INERTIAL,
    )
