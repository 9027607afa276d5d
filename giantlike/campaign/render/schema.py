"""The keys of a scene file for ``giantlike render``: which there are and of what type."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import ConfigDict, Field

from giantlike.campaign.file.schema import SpiceSection
from giantlike.campaign.file.toml_file import Section

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class SceneSection(Section):
    """A table of a scene file: its numbers are finite."""

    model_config = ConfigDict(allow_inf_nan=False)


class RenderSection(SceneSection):
    """``[render]``: where images go and how they are made.

    ``rays_per_pixel_side`` squared is the number of rays in a pixel. ``geometry`` names a table that stands for
    ``[[images]]``. ``truth`` and ``backplanes`` add extensions to the images, ``preview`` a PNG beside each, and
    ``campaign`` what ``giantlike run`` needs, with these ``estimators``.
    """

    output: str = "rendered"
    seed: int = Field(default=0, ge=0)
    rays_per_pixel_side: int = Field(default=4, ge=1, le=32)
    geometry: str | None = None
    truth: bool = True
    backplanes: bool = False
    preview: bool = False
    campaign: bool = False
    estimators: list[str] = Field(default=["cross_correlation", "limb_matching"])


class LightSection(SceneSection):
    """``[light]``: the Sun; ``direction`` is from the targets, inertial axes, and need not be of length one."""

    direction: Vector | None = None
    distance_au: float = Field(default=1.0, gt=0)
    extended: bool = False


class PhotometrySection(SceneSection):
    """``[photometry]``: electrons per second of a star of magnitude 0."""

    zero_point_e_s: float = Field(default=2.0e5, gt=0)


class SkySection(SceneSection):
    """``[stars]``: the catalog, and its faintest star that is drawn."""

    catalog: str = "default"
    max_magnitude: float | None = None


class HotPixelSection(SceneSection):
    """``[detector.hot_pixels]``: how many, and the median of their rates."""

    count: int = Field(default=0, ge=0)
    median_e_s: float = Field(default=500.0, gt=0)


class DetectorSection(SceneSection):
    """``[detector]``: what the detector does beyond the ``[detector]`` of its camera file.

    ``pattern_seed`` places what does not change from image to image: pixel response, hot and dead pixels. The tables
    take the options of the classes of the same names in :mod:`giantlike.simulation`.
    """

    pattern_seed: int = Field(default=0, ge=0)
    shot_noise: bool = True
    bits: int = 16
    dark: dict[str, Any] = Field(default_factory=dict)
    stray: dict[str, Any] = Field(default_factory=dict)
    transfer: dict[str, Any] = Field(default_factory=dict)
    cosmic_rays: dict[str, Any] = Field(default_factory=dict)
    well: dict[str, Any] = Field(default_factory=dict)
    hot_pixels: HotPixelSection = HotPixelSection()
    dead_pixels: int = Field(default=0, ge=0)
    response_rms: float = Field(default=0.0, ge=0, lt=0.3)
    response_file: str | None = None
    vignetting: float = Field(default=0.0, ge=0, le=1)


class PlaceSection(SceneSection):
    """Where a target is: apparent vector from the camera, orientation, and its Sun where that differs."""

    position_km: Vector | None = None
    body_from_inertial_xyzw: Quaternion | None = None
    sun_direction: Vector | None = None


class RenderTargetSection(PlaceSection):
    """``[[targets]]``: a body, and where it is unless an image says otherwise."""

    name: str = Field(min_length=1)
    shape: Any
    units: Literal["km", "m", "auto"] = "km"
    reflectance: dict[str, Any] | None = None
    albedo: float = Field(default=0.045, gt=0)
    spice_body: str | None = None
    frame: str | None = None


class ObserverSection(SceneSection):
    """``observer``: the spacecraft with respect to the solar system barycenter, for parallax and aberration."""

    position_km: Vector
    velocity_km_s: Vector


class ImageSection(SceneSection):
    """``[[images]]``: an exposure. The attitude is a quaternion or the pointing (RA, Dec, roll) of the boresight.

    ``targets`` holds places of targets in this image by name.
    """

    file: str = Field(min_length=1)
    epoch_utc: str
    exposure_s: float = Field(gt=0)
    camera_from_inertial_xyzw: Quaternion | None = None
    pointing_deg: Vector | None = None
    angular_rate_deg_s: Vector = (0.0, 0.0, 0.0)
    observer: ObserverSection | None = None
    targets: dict[str, PlaceSection] = Field(default_factory=dict)


class RenderFile(SceneSection):
    """A whole scene file."""

    render: RenderSection = RenderSection()
    camera: dict[str, Any]
    light: LightSection = LightSection()
    photometry: PhotometrySection = PhotometrySection()
    stars: SkySection | None = None
    spice: SpiceSection | None = None
    detector: DetectorSection = DetectorSection()
    targets: list[RenderTargetSection] = Field(default_factory=list)
    images: list[ImageSection] = Field(default_factory=list)
