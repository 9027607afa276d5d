"""Results of each image as plain values that survive JSON exactly, written the moment the image is done."""

from __future__ import annotations

from copy import copy
from functools import cache
from types import MappingProxyType
from typing import Any, ClassVar, Self

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from giantlike.campaign.store.record_values import (
    Covariance,
    FlagName,
    Landmarks,
    Pair,
    PlainRecord,
    Residuals,
    Rows,
    SightingRecord,
    StarMatches,
    Status,
    Triple,
    TurnRecord,
    TwoByThree,
    TwoByTwo,
    UnitQuaternion,
    Vector,
)
from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.outcomes import AttitudeErrors, Failure, Outcome, Quality, Reason


class Problem(PlainRecord):
    """Reason for a missing result."""

    reason: Reason
    detail: str  # as in :class:`~giantlike.core.outcomes.Failure`
    traceback: str | None = None  # of a programming error
    kind: Outcome = Outcome.FAILED  # ``failed``, or the reason why it does not count as a failure

    @classmethod
    def from_failure(cls, failure: Failure) -> Self:
        """Problem of a failed fit."""
        kind = Outcome.NOT_APPLICABLE if failure.not_applicable else Outcome.FAILED
        return cls(reason=failure.reason, detail=failure.detail, kind=kind)

    @property
    def outcome(self) -> Outcome:
        """The kind; of records of older versions, which have none, by the reason."""
        return _OUTCOMES.get(self.reason, self.kind)


_OUTCOMES = MappingProxyType({Reason.REJECTED: Outcome.REJECTED, Reason.NOT_UNRESOLVED: Outcome.NOT_APPLICABLE})
"""Outcomes that follow from the reason."""


class Acceptance(PlainRecord):
    """The decision of a user to use a suspect result."""

    who: str
    when_utc: str
    why: str

    def __str__(self) -> str:
        return f"accepted by {self.who} on {self.when_utc}: {self.why}"


class RunSummary(PlainRecord):
    """Section ``run`` of the provenance of a finished run."""

    name: str  # of the campaign
    hdu: int | str | None  # FITS extension that was read
    bottom_up: bool = False  # True if the rows were reversed on reading
    max_overlays: int  # number of images shown in the report
    warnings: list[str]
    time_s: float  # of the last part of the run
    empty_images: list[str] = Field(default_factory=list)  # images that are expected to hold nothing


class Attitude(PlainRecord):
    """An attitude and its covariance."""

    source: str  # a value of :class:`~giantlike.image.AttitudeSource`
    quaternion_xyzw: UnitQuaternion  # (4,); ``camera_from_inertial``, scalar last
    covariance_rad2: Covariance | None = None  # of the small rotation about the camera axes; None where unknown
    parts: dict[Cause, Covariance] = Field(default_factory=dict)  # Cause to (3, 3) rad^2; empty where all is noise
    by_camera: Rows | None = None  # (3, m) rad per unit; derivative of the small rotation, as in ``AttitudeErrors``
    flags: list[FlagName] = Field(default_factory=list)  # names of the flags that fixes made with this attitude inherit

    @property
    def rotation(self) -> Rotation:
        """``camera_from_inertial``."""
        return Rotation.from_quat(self.quaternion_xyzw)

    @property
    def errors(self) -> AttitudeErrors:
        """Error budget, errors in common with the camera, and flags."""
        flags = Quality.NONE
        for name in self.flags:
            flags |= Quality[name.upper()]
        return AttitudeErrors(
            parts={cause: np.array(part) for cause, part in self.parts.items()},
            by_camera=None if self.by_camera is None else np.array(self.by_camera),
            flags=flags,
        )

    @property
    def sigma_rad(self) -> Float:
        """Standard deviations (3,) about the camera axes, rad; NaN where unknown."""
        if self.covariance_rad2 is None:
            return np.full(3, np.nan)
        return np.sqrt(np.diag(self.covariance_rad2))


class ImageRecord(PlainRecord):
    """Base of the result of one step of a run for an image, or a target in it; one row in the run folder."""

    part: ClassVar[str]  # name of the step
    points_of: ClassVar[tuple[str, ...]] = ()  # fields that hold lists of points, which :meth:`light` leaves out

    index: int  # position in input order
    file: str  # name in the tables

    @property
    def problems(self) -> list[Problem]:
        """Everything that went wrong."""
        return []

    @property
    def subject(self) -> tuple[str, str]:
        """Target and estimator that it is of; empty where the step has none."""
        return "", ""

    def light(self) -> Self:
        """Return the record without its lists of points, which is kept in memory for thousands of images."""
        empty = _without_points(type(self))
        return self.model_copy(update={name: copy(value) for name, value in empty.items()})

    @property
    def is_light(self) -> bool:
        """True if it has no lists of points."""
        return all(getattr(self, name) == value for name, value in _without_points(type(self)).items())


@cache
def _without_points(kind: type[ImageRecord]) -> dict[str, Any]:
    """Values of the lists of points of a record that has none."""
    fields = kind.model_fields
    return {name: fields[name].get_default(call_default_factory=True) for name in kind.points_of}


class _TriedRecord(ImageRecord):
    """Base of the results of steps that may fail."""

    problem: Problem | None = None

    @property
    def problems(self) -> list[Problem]:
        """The problem, if there is one."""
        return [] if self.problem is None else [self.problem]


class _StatusRecord(_TriedRecord):
    """Base of the results that stand in the tables."""

    status: Status
    accepted: Acceptance | None = None  # of a suspect result; set where a run is read, from its edit list

    @property
    def outcome(self) -> Outcome:
        """The status, its acceptance, or the reason why a missing result does not count as a failure."""
        if self.problem is not None:
            return self.problem.outcome
        return Outcome(self.status) if self.accepted is None else Outcome.ACCEPTED


class AttitudeRecord(_StatusRecord):
    """The image itself, and its attitude."""

    part: ClassVar[str] = "attitude"
    points_of: ClassVar[tuple[str, ...]] = ("stars", "detected_px")

    path: str  # image file relative to the run folder
    sha256: str = ""  # sha256, columns, rows: empty and 0 where the image could not be read
    columns: int = 0
    rows: int = 0
    epoch_utc: str | None = None  # epoch_utc, et, exposure_s: mid-exposure (UTC; TDB seconds past J2000), s
    et: float | None = None
    exposure_s: float | None = None
    observer_position_km: Triple | None = None  # observer_...: of the spacecraft, barycentric, ICRF axes
    observer_velocity_km_s: Triple | None = None
    star_image: bool = False  # star_image, body_image: its own stars were to be solved; estimators run on it
    body_image: bool = True
    transferred: bool = False  # True if the attitude was sought from its neighbors in time
    rate_rad_s: Triple | None = None  # of the rotation of the camera about its axes, by SPICE
    apriori_xyzw: UnitQuaternion | None = None  # (4,); a priori ``camera_from_inertial``, scalar last
    attitude: Attitude | None = None  # the result; None when failed
    attitude_shares: dict[str, float] = Field(default_factory=dict)  # star images it was transferred from, and weights
    n_detected: int | None = None  # n_detected to false_match_probability: of the star solution, as in ``AttitudeFix``
    n_matched: int | None = None
    n_rejected: int | None = None
    rms_px: float | None = None
    false_match_probability: float | None = None
    star_zero_point_e_s: float | None = None  # electron/s; median by matched stars, at magnitude 0
    ra_deg: float | None = None  # as in :class:`~giantlike.io.run_tables.AttitudeRow`
    dec_deg: float | None = None  # as in :class:`~giantlike.io.run_tables.AttitudeRow`
    roll_deg: float | None = None  # as in :class:`~giantlike.io.run_tables.AttitudeRow`
    fov_deg: float | None = None  # as in :class:`~giantlike.io.run_tables.AttitudeRow`
    flags: list[str] = Field(default_factory=list)
    provenance: dict[str, str] = Field(default_factory=dict)
    time_s: float = 0.0  # time of reading and solving
    stars: StarMatches | None = None
    detected_px: list[Pair] = Field(default_factory=list)  # (n, 2); everything that looked like a star
    notes: list[str] = Field(default_factory=list)  # oddities

    @property
    def readable(self) -> bool:
        """True if the image could be read."""
        return self.columns > 0

    @property
    def apriori(self) -> Rotation | None:
        """A priori ``camera_from_inertial``; None where unknown."""
        return None if self.apriori_xyzw is None else Rotation.from_quat(self.apriori_xyzw)

    @property
    def wanted_source(self) -> str | None:
        """Source from which the attitude was to come; None for an image that could not be read."""
        if not self.readable:
            return None
        return "stars" if self.star_image else "interpolated" if self.transferred else "a_priori"


class CalibrationRecord(_TriedRecord):
    """Sources and identified stars of an image, for calibration.

    sha256: hash of the image file; empty where it could not be read.
    problem: the reason why there are none.
    apriori_xyzw: (4,); a priori ``camera_from_inertial``, scalar last.
    et, ..., sigma_px: as in :class:`~giantlike.calibration.star_images.StarImage` and its sky.
    """

    part: ClassVar[str] = "calibration"
    points_of: ClassVar[tuple[str, ...]] = (
        "points_px", "covariance_px2", "snr", "star_ids", "source_indices", "sigma_px",
    )  # fmt: skip

    sha256: str = ""
    et: float | None = None
    observer_position_km: Triple | None = None
    observer_velocity_km_s: Triple | None = None
    temperature_c: float = 0.0
    apriori_xyzw: UnitQuaternion | None = None
    quaternion_xyzw: Vector = Field(default_factory=list)
    focal_length_px: float = 0.0
    points_px: list[Pair] = Field(default_factory=list)
    covariance_px2: list[TwoByTwo] = Field(default_factory=list)
    snr: Vector = Field(default_factory=list)
    star_ids: list[int] = Field(default_factory=list)
    source_indices: list[int] = Field(default_factory=list)
    sigma_px: Vector = Field(default_factory=list)


class NetworkRecord(_TriedRecord):
    """Landmarks of a shape in an image, for the step ``network``."""

    part: ClassVar[str] = "network"

    target: str
    # pose, rendered: a priori, and of the templates: quaternion of ``camera_from_inertial`` (4), position (3), km,
    # quaternion of ``inertial_from_body`` (4), epoch, direction to the Sun (3)
    pose: Vector = Field(default_factory=list)
    rendered: Vector = Field(default_factory=list)
    camera: Vector = Field(default_factory=list)  # parameters of the camera model
    covariance_attitude_rad2: Covariance | None = None  # covariance_...: a priori pose; None: nothing declared
    covariance_position_km2: Covariance | None = None
    numbers: list[int] = Field(default_factory=list)  # numbers to scores: of k landmarks; covariances as rows of 4
    points_px: list[Pair] = Field(default_factory=list)
    covariance_px2: list[Vector] = Field(default_factory=list)
    scores: Vector = Field(default_factory=list)


class ObservationRecord(_StatusRecord):
    """Result of one estimator for one target in one image; units and frames as in the tables.

    Covariances are (2, 2) and (3, 3), partials (2, 3); see :class:`~giantlike.io.run_tables.ObservationRow`.

    attitude: the attitude used; None: there was none.
    predicted_px, ..., n_rejected: as in the tables; None where unknown.
    checks: finite numbers of the tests of the fix, as in :class:`~giantlike.core.findings.Findings`; empty in runs made
        before they were kept.
    parts: mapping of Cause to (k, k); covariance by cause, as in :class:`~giantlike.core.outcomes.CenterFix`.
    partials: mapping of Cause to (k, m); derivatives of the position, as there.
    limb_px, limb_rejected_px: (n, 2); limb points used, and points of the illuminated limb that were not.
    outline_px: (n, 2); outline of a template at the fix.
    """

    part: ClassVar[str] = "observation"
    points_of: ClassVar[tuple[str, ...]] = ("limb_px", "limb_rejected_px", "outline_px", "residuals", "landmarks")

    epoch_utc: str | None = None
    target: str
    estimator: str
    attitude: Attitude | None = None
    predicted_px: Pair | None = None
    predicted_camera_km: Triple | None = None
    center_px: Pair | None = None
    covariance_px2: TwoByTwo | None = None
    covariance_with_attitude_px2: TwoByTwo | None = None
    partial_position_inertial_px_km: TwoByThree | None = None
    partial_attitude_px_rad: TwoByThree | None = None
    position_camera_km: Triple | None = None
    covariance_camera_km2: Covariance | None = None
    position_inertial_km: Triple | None = None
    covariance_inertial_km2: Covariance | None = None
    range_km: float | None = None
    sigma_range_km: float | None = None
    score: float | None = None
    n_used: int | None = None
    n_rejected: int | None = None
    flags: list[str] = Field(default_factory=list)
    provenance: dict[str, str] = Field(default_factory=dict)
    checks: dict[str, float] = Field(default_factory=dict)
    parts: dict[Cause, Rows] = Field(default_factory=dict)
    partials: dict[Cause, Rows] = Field(default_factory=dict)
    turn: TurnRecord | None = None
    landmarks: Landmarks | None = None
    limb_px: list[Pair] = Field(default_factory=list)
    limb_rejected_px: list[Pair] = Field(default_factory=list)
    outline_px: list[Pair] = Field(default_factory=list)
    residuals: Residuals | None = None
    time_s: float = 0.0

    @property
    def subject(self) -> tuple[str, str]:
        """Target and estimator."""
        return self.target, self.estimator


class TargetView(PlainRecord):
    """Predicted position of a target in an image, for overlays."""

    target: str
    predicted_px: Pair  # center
    radius_px: float  # of the sphere around it
    diameter_px: float | None = None  # of the sphere of its volume, for limits of estimators; None in older runs
    outline_px: list[Pair]  # (n, 2)
    outline_lit: list[bool]  # True for points in sunlight


class TargetRecord(ImageRecord):
    """A priori data of a target in an image: its geometry, and its outline for the report."""

    part: ClassVar[str] = "target"
    points_of: ClassVar[tuple[str, ...]] = ("view",)

    target: str
    sighting: SightingRecord | None = None  # None if the geometry is unknown
    view: TargetView | None = None  # None if no picture is wanted, if it cannot be imaged, or as in ``note``
    note: str | None = None

    @property
    def subject(self) -> tuple[str, str]:
        """The target."""
        return self.target, ""


class ObservationsRecord(PlainRecord):
    """All observations of one image."""

    index: int  # as in :class:`ImageRecord`
    file: str  # as in :class:`ImageRecord`
    observations: list[ObservationRecord] = Field(default_factory=list)
    sightings: list[SightingRecord] = Field(default_factory=list)  # of the targets whose geometry is known
    notes: list[str] = Field(default_factory=list)  # oddities
