"""What a run keeps of each image: plain values that survive JSON exactly.

A record is written the moment its image is done and everything else, tables and report, is made from
records. Results therefore never depend on whether a run was interrupted.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

from pydantic import BaseModel, ConfigDict

from giantlike.core.outcomes import Reason

Vector: TypeAlias = list[float]
Matrix: TypeAlias = list[list[float]]
Status: TypeAlias = Literal["ok", "suspect", "failed"]


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Problem(_Record):
    """Why there is no result: reason and detail as in :class:`~giantlike.core.outcomes.Failure`.

    ``traceback`` is there only for programming errors.
    """

    reason: Reason
    detail: str
    traceback: str | None = None


class Attitude(_Record):
    """An attitude and how good it is.

    ``quaternion_xyzw`` is ``camera_from_inertial``, ``covariance_rad2`` (3 x 3) that of the small rotation about
    the camera axes, absent where unknown. ``source`` is one of
    :class:`~giantlike.image.AttitudeSource`.
    """

    source: str
    quaternion_xyzw: Vector
    covariance_rad2: Matrix | None = None


class StarMatches(_Record):
    """Stars of one solution, for residual plots and overlays: (n, 2) px, (n,) px and magnitudes.

    ``rejected_px`` are the places (m, 2) of matches thrown out.
    """

    star_ids: list[int]
    observed_px: Matrix
    predicted_px: Matrix
    sigma_px: Vector
    magnitudes: Vector
    rejected_px: Matrix = []


class AttitudeRecord(_Record):
    """One image: what it is, and what its stars said.

    Parameters
    ----------
    index, file : int, str
        Position in input order and name in the tables.
    path : str
        Image file relative to the run folder.
    sha256, columns, rows : str, int, int
        Empty and 0 where the image could not be read.
    epoch_utc, et, exposure_s : mid-exposure and exposure, where known
    star_image, body_image : bool
        Whether its own stars were to be solved, and whether estimators run on it.
    transferred : bool
        Whether the attitude was looked for in its neighbors.
    status, problem : outcome of the attitude
    apriori_xyzw : a priori ``camera_from_inertial``, where known
    attitude : Attitude, optional
        The result; None when failed.
    n_detected, n_matched, n_rejected, rms_px, false_match_probability : of the star solution
    ra_deg, dec_deg, roll_deg, fov_deg : of the result, see CAMPAIGN files
    flags : names of quality flags
    time_s : float
        Time that reading and solving took.
    stars, detected_px : matches, and everything that looked like a star
    notes : what was odd
    """

    index: int
    file: str
    path: str
    sha256: str = ""
    columns: int = 0
    rows: int = 0
    epoch_utc: str | None = None
    et: float | None = None
    exposure_s: float | None = None
    star_image: bool = False
    body_image: bool = True
    transferred: bool = False
    status: Status
    problem: Problem | None = None
    apriori_xyzw: Vector | None = None
    attitude: Attitude | None = None
    n_detected: int | None = None
    n_matched: int | None = None
    n_rejected: int | None = None
    rms_px: float | None = None
    false_match_probability: float | None = None
    ra_deg: float | None = None
    dec_deg: float | None = None
    roll_deg: float | None = None
    fov_deg: float | None = None
    flags: list[str] = []
    provenance: dict[str, str] = {}
    time_s: float
    stars: StarMatches | None = None
    detected_px: Matrix = []
    notes: list[str] = []

    @property
    def readable(self) -> bool:
        """Whether there is an image to work on."""
        return self.columns > 0

    def light(self) -> AttitudeRecord:
        """Return the record without its lists of stars: what is kept in memory of thousands of images."""
        return self.model_copy(update={"stars": None, "detected_px": []})


class CalibrationRecord(_Record):
    """What calibration keeps of one star image; arrays as in :class:`~giantlike.calibration.star_images.StarImage`.

    ``problem`` says why there is nothing.
    """

    index: int
    file: str
    problem: Problem | None = None
    et: float | None = None
    observer_position_km: Vector | None = None
    observer_velocity_km_s: Vector | None = None
    temperature_c: float = 0.0
    apriori_xyzw: Vector | None = None
    quaternion_xyzw: Vector = []
    focal_length_px: float = 0.0
    points_px: Matrix = []
    covariance_px2: list[Matrix] = []
    snr: Vector = []
    star_ids: list[int] = []
    source_indices: list[int] = []
    sigma_px: Vector = []


class ObservationRecord(_Record):
    """What one estimator said about one target in one image; units and frames as in the tables.

    Covariances are of the image measurement alone, but for ``covariance_with_attitude_px2`` and
    ``covariance_inertial_km2``: these hold the uncertainty of the attitude as well, and are absent where it is
    unknown. The partials are those of the center in the image with respect to the apparent vector from camera to
    body (inertial axes, px/km) and to the small rotation about the camera axes (px/rad), each 2 x 3.
    """

    index: int
    file: str
    epoch_utc: str | None = None
    target: str
    estimator: str
    status: Status
    problem: Problem | None = None
    attitude: Attitude | None = None
    predicted_px: Vector | None = None
    predicted_camera_km: Vector | None = None
    center_px: Vector | None = None
    covariance_px2: Matrix | None = None
    covariance_with_attitude_px2: Matrix | None = None
    partial_position_inertial_px_km: Matrix | None = None
    partial_attitude_px_rad: Matrix | None = None
    position_camera_km: Vector | None = None
    covariance_camera_km2: Matrix | None = None
    position_inertial_km: Vector | None = None
    covariance_inertial_km2: Matrix | None = None
    range_km: float | None = None
    sigma_range_km: float | None = None
    score: float | None = None
    n_used: int | None = None
    n_rejected: int | None = None
    flags: list[str] = []
    provenance: dict[str, str] = {}
    limb_px: Matrix = []
    time_s: float


class TargetView(_Record):
    """Where a target was expected, for overlays: predicted center and outline, px; ``lit`` marks lit points."""

    target: str
    predicted_px: Vector
    radius_px: float
    outline_px: Matrix
    outline_lit: list[bool]


class ObservationsRecord(_Record):
    """All observations of one image."""

    index: int
    file: str
    observations: list[ObservationRecord] = []
    views: list[TargetView] = []
    notes: list[str] = []

    def light(self) -> ObservationsRecord:
        """Return the record without limb points and outlines: what is kept in memory of thousands of images."""
        observations = [record.model_copy(update={"limb_px": []}) for record in self.observations]
        return self.model_copy(update={"observations": observations, "views": []})
