"""The keys of a campaign file: which there are, of what type, and one clear line for what is wrong."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from giantlike.calibration.star_images import DEFAULT_MIN_SNR
from giantlike.core.errors import DataError, InputError
from giantlike.stars.transfer import TransferMethod


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class CampaignSection(_Section):
    """``[campaign]``: name of the campaign and its run folder."""

    name: str = Field(min_length=1)
    output: str = Field(min_length=1)


class ImagesSection(_Section):
    """``[images]``: patterns of image files, a geometry table, and which extension of a FITS file to read."""

    files: list[str] = Field(min_length=1)
    geometry: str | None = None
    hdu: Any = None


class SpiceSection(_Section):
    """``[spice]``: kernels in loading order, the spacecraft, and the frame of the camera.

    ``camera_from_frame_xyzw`` turns the axes of a frame that is not +x along columns, +y along rows, +z boresight.
    """

    kernels: list[str] = Field(min_length=1)
    spacecraft: str
    frame: str | None = None
    camera_from_frame_xyzw: list[float] = [0.0, 0.0, 0.0, 1.0]


class StarsSection(_Section):
    """``[stars]``: catalogue, identification, and how star images serve the others.

    ``options`` takes any option of :class:`giantlike.stars.StarOptions` that has no key of its own here,
    ``detection`` any of :class:`giantlike.processing.detect.DetectionOptions`.
    """

    catalog: str = "default"
    max_magnitude: float | None = None
    lost_in_space: bool = False
    long_exposure_s: float | None = Field(default=None, gt=0)
    transfer: TransferMethod = TransferMethod.INTERPOLATE
    max_gap_s: float | None = None
    drift_arcsec_per_sqrt_s: float = 0.1
    max_disagreement_deg: float = 1.0
    options: dict[str, Any] = Field(default_factory=dict)
    detection: dict[str, Any] = Field(default_factory=dict)


class CalibrationSection(_Section):
    """``[calibration]``: which parameters of the camera to estimate from the stars of the campaign.

    ``model`` is the type of the model when it is not that of the camera, ``scale_error`` how wrong its focal length
    may be, ``temperature_keyword`` the header keyword that holds the temperature of the camera in Celsius.
    ``options`` takes any option of :class:`giantlike.calibration.CalibrationOptions`, ``criteria`` any of
    :class:`giantlike.calibration.CalibrationCriteria`.
    """

    estimate: list[str] = Field(min_length=1)
    model: str | None = None
    min_snr: float = Field(default=DEFAULT_MIN_SNR, ge=0)
    scale_error: float = Field(default=0.1, gt=0, le=0.2)
    temperature_keyword: str | None = None
    options: dict[str, Any] = Field(default_factory=dict)
    criteria: dict[str, Any] = Field(default_factory=dict)


class TargetSection(_Section):
    """``[[targets]]``: a body, and the estimators to run on it.

    ``spice_body`` and ``frame`` are needed only where SPICE knows the body by another name than ``name``, or where
    its axes are not those of the body's default fixed frame.
    """

    name: str = Field(min_length=1)
    shape: Any
    units: Literal["km", "m", "auto"] = "km"
    reflectance: dict[str, Any] | None = None
    estimators: list[str] = Field(min_length=1)
    options: dict[str, dict[str, Any]] = Field(default_factory=dict)
    spice_body: str | None = None
    frame: str | None = None


class ReportSection(_Section):
    """``[report]``: how many images ``report.html`` shows."""

    max_overlays: int = Field(default=24, ge=0)


class CampaignFile(_Section):
    """A whole campaign file."""

    campaign: CampaignSection
    images: ImagesSection
    camera: dict[str, Any]
    spice: SpiceSection | None = None
    stars: StarsSection | None = None
    calibration: CalibrationSection | None = None
    targets: list[TargetSection] = Field(default_factory=list)
    report: ReportSection = ReportSection()


_SECTIONS: Mapping[str, type[_Section]] = MappingProxyType(
    {
        "campaign": CampaignSection,
        "images": ImagesSection,
        "spice": SpiceSection,
        "stars": StarsSection,
        "calibration": CalibrationSection,
        "targets": TargetSection,
        "report": ReportSection,
    }
)


def read_campaign_file(path: Path) -> tuple[CampaignFile, dict[str, Any]]:
    """Parse a campaign file and check keys and types.

    Returns
    -------
    CampaignFile
    dict
        The plain TOML table, for provenance.

    Raises
    ------
    DataError
        The file is missing or no TOML, a key is unknown or missing, or a value is of the wrong type; one line.
    """
    try:
        with path.open("rb") as stream:
            table = tomllib.load(stream)
    except OSError as error:
        raise DataError(path, f"cannot read the campaign file: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DataError(path, f"is not valid TOML: {error}") from error
    try:
        # Strict JSON rules fit TOML: they allow text for an enumeration, but no text for a number.
        return CampaignFile.model_validate_json(json.dumps(table, default=_refuse_dates)), table
    except ValidationError as error:
        raise DataError(path, _first_problem(error)) from error
    except InputError as error:
        raise DataError(path, str(error)) from error


def _refuse_dates(value: object) -> Any:
    raise InputError(f"dates and times are not expected here, got {value}: put it in quotes where text is meant")


def _first_problem(error: ValidationError) -> str:
    # An unknown key explains a missing one (it is misspelt), so it comes first.
    problems = sorted(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
    more = len(problems) - 1
    return one_problem(problems[0]) + (f" (and {more} more)" if more else "")


def one_problem(problem: ErrorDetails) -> str:
    """One line for a pydantic error: the key, what was expected there and what came."""
    location = problem["loc"]
    key = key_text(location)
    if problem["type"] == "extra_forbidden":
        section = _SECTIONS[str(location[0])] if len(location) > 1 else CampaignFile
        return f"unknown key {key}; keys there are {', '.join(section.model_fields)}"
    if problem["type"] == "missing":
        return f"key {key} is missing"
    if problem["type"] in {"too_short", "string_too_short"} and not problem["input"]:
        return f"{key}: must not be empty, got {problem['input']!r}"
    expected = problem["msg"].removeprefix("Input should be ")
    return f"{key}: expected {expected}, got {problem['input']!r}"


def key_text(location: tuple[int | str, ...]) -> str:
    """Dotted name of a key, list positions from 0: ``targets[0].units``.

    >>> key_text(("targets", 0, "units"))
    'targets[0].units'
    """
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text
