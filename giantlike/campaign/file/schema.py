"""The keys of a campaign file: which there are and of what type."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from giantlike.calibration.star_images import DEFAULT_MIN_SNR
from giantlike.campaign.file.toml_file import Section
from giantlike.stars.transfer import TransferMethod


class CampaignSection(Section):
    """``[campaign]``: name of the campaign and its run folder."""

    name: str = Field(min_length=1)
    output: str = Field(min_length=1)


class ImagesSection(Section):
    """``[images]``: patterns of image files, a geometry table, and which extension of a FITS file to read.

    ``bottom_up`` turns the rows of files whose first row is the bottom of the picture.
    """

    files: list[str] = Field(min_length=1)
    geometry: str | None = None
    hdu: Any = None
    bottom_up: bool = False


class SpiceSection(Section):
    """``[spice]``: kernels in loading order, the spacecraft, and the frame of the camera.

    ``camera_from_frame_xyzw`` turns the axes of a frame that is not +x along columns, +y along rows, +z boresight.
    """

    kernels: list[str] = Field(min_length=1)
    spacecraft: str
    frame: str | None = None
    camera_from_frame_xyzw: list[float] = Field(default=[0.0, 0.0, 0.0, 1.0])


class StarsSection(Section):
    """``[stars]``: catalog, identification, and how star images serve the others.

    ``options`` takes any option of :class:`giantlike.stars.StarOptions` that has no key of its own here,
    ``detection`` any of :class:`giantlike.processing.detection.detect.DetectionOptions`. ``rates`` is a table of
    angular rates for ``transfer = "propagate"`` (:func:`giantlike.stars.rates.read_rates`).
    """

    catalog: str = "default"
    max_magnitude: float | None = None
    lost_in_space: bool = False
    long_exposure_s: float | None = Field(default=None, gt=0)
    transfer: TransferMethod = TransferMethod.INTERPOLATE
    rates: str | None = None
    max_gap_s: float | None = None
    drift_arcsec_per_sqrt_s: float = 0.1
    max_disagreement_deg: float = 1.0
    options: dict[str, Any] = Field(default_factory=dict)
    detection: dict[str, Any] = Field(default_factory=dict)


class CalibrationSection(Section):
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


class TargetSection(Section):
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


class ReportSection(Section):
    """``[report]``: how many images ``report.html`` shows."""

    max_overlays: int = Field(default=24, ge=0)


class CampaignFile(Section):
    """A whole campaign file."""

    campaign: CampaignSection
    images: ImagesSection
    camera: dict[str, Any]
    spice: SpiceSection | None = None
    stars: StarsSection | None = None
    calibration: CalibrationSection | None = None
    targets: list[TargetSection] = Field(default_factory=list)
    report: ReportSection = ReportSection()
