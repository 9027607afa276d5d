"""Keys of a scene file for ``giantlike render``: one pydantic field per key, with the description below it.

The checks on reading, the defaults and the page ``docs/scene_file.md`` follow from these fields.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import ConfigDict, Field

from giantlike.campaign.file.options import options_validator
from giantlike.campaign.file.schema import BodySection, PhotometrySection, SpiceSection
from giantlike.campaign.file.toml_file import TomlSection
from giantlike.simulation.cosmic_rays import CosmicRays
from giantlike.simulation.effects import DarkCurrent, FrameTransfer, FullWell, StrayLight

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class SceneSection(TomlSection):
    """Base of the tables of a scene file: numbers must be finite."""

    model_config = ConfigDict(allow_inf_nan=False)


class RenderSection(SceneSection):
    """``[render]``: where the images go, and how they are made."""

    output: str = "rendered"
    """Folder of the images."""
    seed: int = Field(default=0, ge=0)
    """Seed of all noise; equal seeds give equal images."""
    rays_per_pixel_side: int = Field(default=4, ge=1, le=32)
    """Rays along the side of a pixel; its square is their number in a pixel."""
    geometry: str | None = None
    """Geometry table that replaces `[[images]]`."""
    truth: bool = True
    """Add the truth as FITS extensions."""
    backplanes: bool = False
    """Add backplanes of each pixel as FITS extensions."""
    preview: bool = False
    """Write a PNG for each image."""
    campaign: bool = False
    """Write a campaign, camera and geometry for `giantlike run`."""
    estimators: list[str] = Field(default=["cross_correlation", "limb_matching"])
    """Estimators of that campaign."""


class LightSection(SceneSection):
    """``[light]``: the Sun."""

    direction: Vector | None = None
    """From the targets to the Sun, inertial axes, of any length; default: from SPICE."""
    distance_au: float = Field(default=1.0, gt=0)
    """Distance of the Sun from the targets, au."""
    extended: bool = False
    """The Sun has a disk, so that shadows have soft edges."""


class SkySection(SceneSection):
    """``[stars]``: the star catalog; without this section there are no stars."""

    catalog: str = "default"
    """`default`, or the file of a built catalog or CSV."""
    max_magnitude: float | None = None
    """Faintest star drawn."""


class HotPixelSection(SceneSection):
    """``[detector.hot_pixels]``: pixels of high dark current."""

    count: int = Field(default=0, ge=0)
    """Number of hot pixels."""
    median_e_s: float = Field(default=500.0, gt=0)
    """Median of their rates, electrons per second."""


class DetectorSection(SceneSection):
    """``[detector]``: detector effects beyond the ``[detector]`` of the camera file."""

    pattern_seed: int = Field(default=0, ge=0)
    """Seed of the properties common to all images: pixel response, hot and dead pixels."""
    shot_noise: bool = True
    """Add the Poisson noise of light and dark current."""
    bits: int = 16
    """Bits of the converter."""
    dark: Annotated[DarkCurrent, options_validator(DarkCurrent)] = DarkCurrent()
    """Dark current."""
    stray: Annotated[StrayLight, options_validator(StrayLight)] = StrayLight()
    """Stray light."""
    transfer: Annotated[FrameTransfer, options_validator(FrameTransfer)] = FrameTransfer()
    """Smear of a frame-transfer detector."""
    cosmic_rays: Annotated[CosmicRays, options_validator(CosmicRays)] = CosmicRays()
    """Hits of cosmic rays."""
    well: Annotated[FullWell, options_validator(FullWell)] = FullWell()
    """Full well and blooming."""
    hot_pixels: HotPixelSection = HotPixelSection()
    dead_pixels: int = Field(default=0, ge=0)
    """Number of pixels without signal."""
    response_rms: float = Field(default=0.0, ge=0, lt=0.3)
    """Relative rms of the pixel response."""
    response_file: str | None = None
    """Image of the pixel response, instead of a random one."""
    vignetting: float = Field(default=0.0, ge=0, le=1)
    """Relative loss of light in the corners."""


class PlaceSection(SceneSection):
    """Position, orientation and illumination of a target."""

    position_km: Vector | None = None
    """Apparent vector from camera to target center, inertial axes, km."""
    body_from_inertial_xyzw: Quaternion | None = None
    """Orientation at the emission time of the light, quaternion, scalar last."""
    sun_direction: Vector | None = None
    """From the target to the Sun, inertial axes, where it is not `light.direction`."""


class RenderTargetSection(PlaceSection, BodySection):
    """``[[targets]]``: a body, and its position unless an image gives another."""

    albedo: float = Field(default=0.045, gt=0)
    """Radiance factor of the surface seen and lit along its normal."""


class ObserverSection(SceneSection):
    """``observer``: the spacecraft relative to the solar system barycenter, for parallax and aberration."""

    position_km: Vector
    """Inertial axes, km."""
    velocity_km_s: Vector
    """Inertial axes, km/s."""


class ImageSection(SceneSection):
    """``[[images]]``: an exposure; its attitude is a quaternion or a pointing."""

    file: str = Field(min_length=1)
    """FITS file to write, relative to the output folder."""
    epoch_utc: str
    """Mid-exposure, ISO 8601."""
    exposure_s: float = Field(gt=0)
    """Exposure, s."""
    camera_from_inertial_xyzw: Quaternion | None = None
    """Attitude, quaternion, scalar last."""
    pointing_deg: Vector | None = None
    """Right ascension, declination and roll of the boresight, deg."""
    angular_rate_deg_s: Vector = (0.0, 0.0, 0.0)
    """Rotation of the camera during the exposure, about its own axes, deg/s."""
    observer: ObserverSection | None = None
    targets: dict[str, PlaceSection] = Field(default_factory=dict)
    """Places of targets in this image, by name."""


class RenderFile(SceneSection):
    """A whole scene file."""

    render: RenderSection = RenderSection()
    camera: dict[str, Any]
    """`file`, the name of a [camera file](campaigns.md#the-camera-file) with `[psf]`, or the keys of one."""
    light: LightSection = LightSection()
    photometry: PhotometrySection = PhotometrySection()
    stars: SkySection | None = None
    spice: SpiceSection | None = None
    detector: DetectorSection = DetectorSection()
    targets: list[RenderTargetSection] = Field(default_factory=list)
    images: list[ImageSection] = Field(default_factory=list)
