"""Columns of the tables of a run folder: ``attitudes`` and ``observations``, as CSV and as Parquet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from giantlike.io.tables import column

_CAMERA = "camera"
_IMAGE = "distorted image"
_INERTIAL = "inertial (ICRF)"
_STATUS = "`ok`, `suspect` (kept, but a named check objects) or `failed`."
_REASON = "Reason of a failure."
_FLAGS = "Names of quality flags, joined by `|`."
_TIME = "Computing time."
_DETAIL = "Reason of a failure in words."
_PROVENANCE = "Versions, hashes and options the result was made from, as JSON."
_TRIANGLE = "upper triangle by rows (xx, xy, xz, yy, yz, zz)"


@dataclass(frozen=True, slots=True, kw_only=True)
class AttitudeRow:
    """One row per image: its attitude, from its own stars, its neighbors in time, or a priori."""

    file: str = column("Image file: its base name or, where two files share one, the path relative to the TOML.")
    epoch_utc: str | None = column("Mid-exposure, ISO 8601.", unit="UTC")
    status: str = column(_STATUS)
    reason: str | None = column(_REASON)
    source: str | None = column("`stars`, `interpolated` or `a_priori`; of a failure, where it was looked for.")
    n_detected: int | None = column("Number of detections offered to the identification.")
    n_matched: int | None = column("Number of stars used.")
    rms_px: float | None = column("Radial residual of the stars, sqrt(mean(dx² + dy²)).", unit="px", frame=_IMAGE)
    qx: float | None = column("Attitude quaternion, x.", frame="camera_from_inertial")
    qy: float | None = column("Attitude quaternion, y.", frame="camera_from_inertial")
    qz: float | None = column("Attitude quaternion, z.", frame="camera_from_inertial")
    qw: float | None = column("Attitude quaternion, scalar part.", frame="camera_from_inertial")
    ra_deg: float | None = column("Right ascension of the image center.", unit="deg", frame=_INERTIAL)
    dec_deg: float | None = column("Declination of the image center.", unit="deg", frame=_INERTIAL)
    roll_deg: float | None = column(
        "Position angle of the camera's -y axis, north through east; empty at a pole.", unit="deg", frame=_INERTIAL
    )
    fov_deg: float | None = column("Field of view of the model used, 2·atan(columns/(2·fx)).", unit="deg")
    sigma_x_arcsec: float | None = column("One sigma of the rotation about x.", unit="arcsec", frame=_CAMERA)
    sigma_y_arcsec: float | None = column("One sigma of the rotation about y.", unit="arcsec", frame=_CAMERA)
    sigma_z_arcsec: float | None = column("One sigma of the rotation about z.", unit="arcsec", frame=_CAMERA)
    flags: str | None = column(_FLAGS)
    time_s: float | None = column(_TIME, unit="s")
    detail: str | None = column(_DETAIL, csv=False)
    sha256: str | None = column("Hash of the image file; empty where it could not be read.", csv=False)
    provenance: str | None = column(_PROVENANCE, csv=False)
    et: float | None = column("Mid-exposure, seconds past J2000.", unit="TDB s", csv=False)
    exposure_s: float | None = column("Exposure.", unit="s", csv=False)
    false_match_probability: float | None = column("Bound on the probability of a chance identification.", csv=False)
    n_rejected: int | None = column("Number of matches rejected as outliers.", csv=False)
    notes: Sequence[str] | None = column("Oddities found on the way.", csv=False)
    covariance_rad2: Sequence[float] | None = column(
        f"Covariance of the small rotation about the camera axes, {_TRIANGLE}.", unit="rad²", frame=_CAMERA, csv=False
    )
    apriori_xyzw: Sequence[float] | None = column(
        "A priori attitude quaternion, scalar last.", frame="camera_from_inertial", csv=False
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservationRow:
    """One row per image, target and estimator: the center of a body (the origin of its shape model), and its position.

    Positions are apparent: light time and aberration are still in. Sigmas are of the image measurement alone; only
    ``covariance_with_attitude_px2`` and ``covariance_inertial_km2`` hold the uncertainty of the attitude as well.
    """

    file: str = column("Image file, as in `attitudes`.")
    epoch_utc: str | None = column("Mid-exposure, ISO 8601.", unit="UTC")
    target: str = column("Name of the target.")
    estimator: str = column("Name of the estimator.")
    status: str = column(_STATUS)
    reason: str | None = column(_REASON)
    predicted_x_px: float | None = column("Center by the a priori geometry, x.", unit="px", frame=_IMAGE)
    predicted_y_px: float | None = column("Center by the a priori geometry, y.", unit="px", frame=_IMAGE)
    x_px: float | None = column("Measured center, x.", unit="px", frame=_IMAGE)
    y_px: float | None = column("Measured center, y.", unit="px", frame=_IMAGE)
    sigma_x_px: float | None = column("One sigma of `x_px`.", unit="px", frame=_IMAGE)
    sigma_y_px: float | None = column("One sigma of `y_px`.", unit="px", frame=_IMAGE)
    rho_xy: float | None = column("Correlation of `x_px` and `y_px`.", frame=_IMAGE)
    x_camera_km: float | None = column("Measured vector from camera to center, x.", unit="km", frame=_CAMERA)
    y_camera_km: float | None = column("Measured vector from camera to center, y.", unit="km", frame=_CAMERA)
    z_camera_km: float | None = column("Measured vector from camera to center, z.", unit="km", frame=_CAMERA)
    range_km: float | None = column("Measured distance from camera to center.", unit="km")
    sigma_range_km: float | None = column("One sigma of `range_km`.", unit="km")
    score: float | None = column("Measure of fit of the estimator.")
    n_used: int | None = column("Number of pixels or points used.")
    n_rejected: int | None = column("Number of pixels or points rejected.")
    flags: str | None = column(_FLAGS)
    time_s: float | None = column(_TIME, unit="s")
    detail: str | None = column(_DETAIL, csv=False)
    attitude_source: str | None = column("Source of the attitude used, as in `attitudes`.", csv=False)
    provenance: str | None = column(_PROVENANCE, csv=False)
    camera_from_inertial_xyzw: Sequence[float] | None = column(
        "Quaternion of the attitude used, scalar last.", frame="camera_from_inertial", csv=False
    )
    attitude_covariance_rad2: Sequence[float] | None = column(
        f"Covariance of that attitude, {_TRIANGLE}.", unit="rad²", frame=_CAMERA, csv=False
    )
    predicted_camera_km: Sequence[float] | None = column(
        "A priori vector from camera to center.", unit="km", frame=_CAMERA, csv=False
    )
    covariance_px2: Sequence[float] | None = column(
        "Covariance of the measured center (xx, xy, yy).", unit="px²", frame=_IMAGE, csv=False
    )
    covariance_with_attitude_px2: Sequence[float] | None = column(
        "The same with the uncertainty of the attitude; empty where that is unknown.",
        unit="px²", frame=_IMAGE, csv=False,
    )  # fmt: skip
    partial_position_inertial_px_km: Sequence[float] | None = column(
        "Derivative (2 x 3, by rows) of the center by the apparent vector from camera to center in inertial axes.",
        unit="px/km", frame="distorted image by inertial (ICRF)", csv=False,
    )  # fmt: skip
    partial_attitude_px_rad: Sequence[float] | None = column(
        "Derivative (2 x 3, by rows) of the center by the small rotation about the camera axes.",
        unit="px/rad", frame="distorted image by camera", csv=False,
    )  # fmt: skip
    covariance_camera_km2: Sequence[float] | None = column(
        f"Covariance of the measured vector, {_TRIANGLE}.", unit="km²", frame=_CAMERA, csv=False
    )
    position_inertial_km: Sequence[float] | None = column(
        "Measured vector from camera to center.", unit="km", frame=_INERTIAL, csv=False
    )
    covariance_inertial_km2: Sequence[float] | None = column(
        f"Its covariance with the uncertainty of the attitude, {_TRIANGLE}; empty where that is unknown.",
        unit="km²", frame=_INERTIAL, csv=False,
    )  # fmt: skip
