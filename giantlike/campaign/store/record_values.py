"""Plain values that records of a run are made of, checked where they are read: numbers, stars, landmarks, states."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self, TypeAlias

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from giantlike._system.reading import check
from giantlike.core.outcomes import Quality

Vector: TypeAlias = list[float]
Matrix: TypeAlias = list[list[float]]
Pair: TypeAlias = Annotated[Vector, Field(min_length=2, max_length=2)]
Triple: TypeAlias = Annotated[Vector, Field(min_length=3, max_length=3)]
TwoByTwo: TypeAlias = Annotated[list[Pair], Field(min_length=2, max_length=2)]
TwoByThree: TypeAlias = Annotated[list[Triple], Field(min_length=2, max_length=2)]
_UNIT = 1e-6  # departure of the length of a quaternion from 1 that is rounding


def _unit_quaternion(values: Vector) -> Vector:
    if len(values) != 4 or not abs(math.hypot(*values) - 1.0) < _UNIT:
        raise ValueError(f"a unit quaternion of four numbers is needed, got {values}")
    return values


def _of_equal_rows(values: Matrix) -> Matrix:
    check(len({len(row) for row in values}) == 1, "a matrix with rows of equal length is needed")
    return values


def _flag_name(name: str) -> str:
    check(name.upper() in Quality.__members__, f"there is no quality flag {name!r}")
    return name


UnitQuaternion: TypeAlias = Annotated[Vector, AfterValidator(_unit_quaternion)]
Covariance: TypeAlias = Annotated[list[Triple], Field(min_length=3, max_length=3)]
Rows: TypeAlias = Annotated[Matrix, AfterValidator(_of_equal_rows)]
FlagName: TypeAlias = Annotated[str, AfterValidator(_flag_name)]
Status: TypeAlias = Literal["ok", "suspect", "failed"]


class PlainRecord(BaseModel):
    """Base of values that survive JSON exactly."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    def replace(self, **changes: object) -> Self:
        """Return a checked copy with other values of some fields."""
        return self.model_validate(self.__dict__ | changes)


class StarMatches(PlainRecord):
    """Stars of one solution, for residual plots and overlays."""

    star_ids: list[int]
    observed_px: list[Pair]  # (n, 2)
    predicted_px: list[Pair]  # (n, 2)
    sigma_px: Vector  # sigma_px, magnitudes: (n,) px and magnitudes
    magnitudes: Vector
    rejected_px: list[Pair] = Field(default_factory=list)  # (m, 2); matches rejected as outliers
    star_names: list[str] = Field(default_factory=list)  # (n,); proper names or empty; no list in older runs


class Landmarks(PlainRecord):
    """Landmarks of one fix."""

    names: list[str]  # (n,) list of str
    observed_px: list[Pair]  # observed_px, predicted_px: (n, 2); measured, and projected by the pose that they give
    predicted_px: list[Pair]
    covariance_px2: list[TwoByTwo]  # n (2, 2) lists; of each alone: noise and the excess of the residuals
    body_km: list[Triple]  # (n, 3), body-fixed axes
    rejected_names: list[str] = Field(default_factory=list)  # (k,) list of str; of those looked for and not used
    rejected_px: list[Pair] = Field(default_factory=list)  # (k, 2); projected by the pose
    rejected_because: list[str] = Field(default_factory=list)  # (k,) list of str


class TurnRecord(PlainRecord):
    """Rotation of a body about the line of sight, and its position with this rotation."""

    turn_rad: float  # as in :class:`~giantlike.core.outcomes.BodyTurn`
    center_px: Pair  # as in :class:`~giantlike.core.outcomes.BodyTurn`
    covariance: Covariance  # as in :class:`~giantlike.core.outcomes.BodyTurn`
    by_rotation: Covariance  # as in :class:`~giantlike.core.outcomes.BodyTurn`


class Residuals(PlainRecord):
    """Residuals of a fix with their positions in the image, for pictures."""

    at_px: list[Pair]  # (n, 2)
    values: Vector  # (n,); as in :class:`~giantlike.core.outcomes.CenterFix`
    cell_px: float  # 0: all residuals one by one; else the side of the square that each value is the mean of


class SightingRecord(PlainRecord):
    """A priori data of a target in an image, for its observables.

    origin, observer_position_km, ..., light_time_s: as in :class:`~giantlike.scene.Circumstances`; None where unknown.
    camera_from_body_xyzw: (4,); orientation at the emission time of the light, by the attitude used; scalar last.
    sun_direction_camera: from the body to the Sun.
    scale_sigma, ..., sun_sigma_rad, ephemeris_icrf_km2: as in :class:`~giantlike.scene.TargetUncertainty`.
    """

    target: str
    origin: str | None = None
    observer_position_km: Triple | None = None
    observer_velocity_km_s: Triple | None = None
    target_velocity_km_s: Triple | None = None
    target_motion_km: Triple | None = None
    light_time_s: float | None = None
    camera_from_body_xyzw: UnitQuaternion
    sun_direction_camera: Triple
    scale_sigma: float = 0.0
    pole_sigma_rad: float = 0.0
    spin_sigma_rad: float = 0.0
    ephemeris_sigma_km: float = 0.0
    sun_sigma_rad: float = 0.0
    ephemeris_icrf_km2: Covariance | None = None
