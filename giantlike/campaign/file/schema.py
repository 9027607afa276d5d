"""Keys of a campaign file: one pydantic field per key holds its type, default, limits and description.

The checks on reading and the page ``docs/campaign_file.md`` both follow from these fields.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Field, PlainValidator

from giantlike.calibration import CalibrationCriteria, CalibrationOptions
from giantlike.calibration.star_images import DEFAULT_MIN_SNR
from giantlike.campaign.file.options import options_validator
from giantlike.campaign.file.toml_file import Section, key
from giantlike.core.errors import InputError
from giantlike.processing.detection.options import DetectionOptions
from giantlike.stars.options import StarOptions
from giantlike.stars.transfer import TransferMethod

Radii: TypeAlias = tuple[float, float, float]
"""Radii of an ellipsoid along its body-fixed x, y and z axes, km."""


def _checked_hdu(value: object) -> int | str:
    if isinstance(value, bool) or not isinstance(value, int | str):
        raise InputError(f"expected a number or a name, got {value!r}")
    return value


def _checked_shape(value: object) -> str | Radii:
    if isinstance(value, str):
        return value
    radii = value.get("radii_km") if isinstance(value, Mapping) and len(value) == 1 else None
    if not isinstance(radii, list) or len(radii) != 3:
        raise InputError(f"expected a mesh file or {{ radii_km = [a, b, c] }}, got {value!r}")
    if any(isinstance(r, bool) or not isinstance(r, int | float) or not math.isfinite(r) or not r > 0 for r in radii):
        raise InputError(f"radii_km must be three positive and finite numbers, got {radii!r}")
    return float(radii[0]), float(radii[1]), float(radii[2])


class CampaignSection(Section):
    """``[campaign]``: the name and the run folder."""

    name: str = key("Name of the campaign, for the report.", min_length=1)
    output: str = key("Run folder; a folder in use is only continued, with `--resume`.", min_length=1)


class ImagesSection(Section):
    """``[images]``: the image files and their a priori geometry."""

    files: list[str] = key(
        "File names or glob patterns (`**` for subfolders) of images in any readable format.", min_length=1
    )
    geometry: str | None = key("Table of a priori geometry; what it leaves out comes from headers, then SPICE.", None)
    hdu: Annotated[int | str | None, PlainValidator(_checked_hdu)] = key(
        "Number (from 0) or name of the FITS extension; default: the first with an image.", None
    )
    bottom_up: bool = key("The first stored row is the bottom of the picture: reverse the rows.", False)


class SpiceSection(Section):
    """``[spice]``: kernels, the spacecraft and the frame of the camera."""

    kernels: list[str] = key("File names or glob patterns of SPICE kernels, in loading order.", min_length=1)
    spacecraft: str = key("NAIF name or code of the spacecraft.")
    frame: str | None = key("SPICE frame of the camera; without it SPICE gives no a priori attitude.", None)
    camera_from_frame_xyzw: list[float] = key(
        "Quaternion, scalar last, from that frame to camera axes (+x along columns, +y along rows, +z "
        "boresight), where the two differ.",
        [0.0, 0.0, 0.0, 1.0],
    )


class StarsSection(Section):
    """``[stars]``: star identification, and the transfer of attitudes to short exposures.

    Without this section no stars are processed and the a priori attitudes are used.
    """

    catalog: str = key("`default` (Gaia and Hipparcos), or the file of a built catalog or CSV.", "default")
    max_magnitude: float | None = key("Faintest star used, in the band of the catalog (Gaia G for the default).", None)
    lost_in_space: bool = key("Search the whole sky where the a priori attitude does not lead to a solution.", False)
    long_exposure_s: float | None = key(
        "At or above this exposure, s, an image is a star image; a shorter one takes its attitude from "
        "its neighbors in time. Default: every image is both a star image and an image of bodies.",
        None,
        gt=0,
    )
    transfer: TransferMethod = key("Method by which a short exposure gets its attitude.", TransferMethod.INTERPOLATE)
    rates: str | None = key('Table of angular rates (a gyro\'s) for `transfer = "propagate"`.', None)
    max_gap_s: float = key("Largest distance in time to a star image, s.", math.inf)
    drift_arcsec_per_sqrt_s: float = key(
        "Random walk of the attitude between images, arcsec per square root of a second.", 0.1
    )
    max_disagreement_deg: float = key(
        "Largest difference between the a priori turn and the turn that the method assumes, deg; catches "
        "slews, and 180 switches the check off.",
        1.0,
    )
    options: Annotated[StarOptions, options_validator(StarOptions, elsewhere=("max_magnitude", "lost_in_space"))] = key(
        "Options of the star solution that have no key of their own.", StarOptions()
    )
    detection: Annotated[DetectionOptions, options_validator(DetectionOptions)] = key(
        "Options of the detection of stars.", DetectionOptions()
    )


class CalibrationSection(Section):
    """``[calibration]``: parameters of the camera to estimate from the stars of the campaign.

    With this section the camera is calibrated first, and everything else uses the calibrated camera.
    """

    estimate: list[str] = key("Names of the parameters of the camera model to estimate.", min_length=1)
    model: str | None = key("Type of the model, where it is not that of the camera.", None)
    min_snr: float = key("Lowest signal-to-noise ratio of the stars to calibrate from.", DEFAULT_MIN_SNR, ge=0)
    scale_error: float = key("Relative error that the focal length of the camera may have.", 0.1, gt=0, le=0.2)
    temperature_keyword: str | None = key("Header keyword that holds the temperature of the camera, Celsius.", None)
    options: Annotated[CalibrationOptions, options_validator(CalibrationOptions)] = key(
        "Options of the fit.", CalibrationOptions()
    )
    criteria: Annotated[CalibrationCriteria, options_validator(CalibrationCriteria)] = key(
        "Limits that a calibration must meet to be used.", CalibrationCriteria()
    )


class BodySection(Section):
    """A body: its name, shape, brightness law and name in SPICE."""

    name: str = key("Name of the target in tables; the default of `spice_body`.", min_length=1)
    shape: Annotated[str | Radii, PlainValidator(_checked_shape)] = key(
        "Mesh file, or an ellipsoid as `{ radii_km = [a, b, c] }`."
    )
    units: Literal["km", "m", "auto"] = key(
        "Unit of the mesh file; `auto` decides by the size of the body, with a warning.", "km"
    )
    reflectance: dict[str, Any] | None = key(
        'Reflectance law and its parameters; default: `{ model = "mcewen" }`.', None
    )
    spice_body: str | None = key("NAIF name or code, where it is not `name`.", None)
    frame: str | None = key("Body-fixed SPICE frame, where it is not the body's default.", None)


class TargetSection(BodySection):
    """``[[targets]]``: a body, and the estimators to run on it."""

    estimators: list[str] = key("Names of the estimators; `giantlike estimators` lists them.", min_length=1)
    options: dict[str, dict[str, Any]] = key(
        "Options by estimator; `giantlike estimators NAME` shows those of one.", {}
    )


class ReportSection(Section):
    """``[report]``: the contents of ``report.html``."""

    max_overlays: int = key("Number of images shown with what was found in them.", 24, ge=0)


class CampaignFile(Section):
    """A whole campaign file."""

    campaign: CampaignSection
    images: ImagesSection
    camera: dict[str, Any] = key("`file`, the name of a camera file, or the keys of one.")
    spice: SpiceSection | None = None
    stars: StarsSection | None = None
    calibration: CalibrationSection | None = None
    targets: list[TargetSection] = Field(default_factory=list)
    report: ReportSection = ReportSection()
