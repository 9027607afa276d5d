"""Keys of a scene file for ``giantlike render``: one pydantic field per key holds its type, limits and description.

The checks on reading and the page ``docs/scene_file.md`` both follow from these fields.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import ConfigDict, Field

from giantlike.campaign.file.options import options_validator
from giantlike.campaign.file.schema import BodySection, SpiceSection
from giantlike.campaign.file.toml_file import Section
from giantlike.simulation.cosmic_rays import CosmicRays
from giantlike.simulation.effects import DarkCurrent, FrameTransfer, FullWell, StrayLight

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class SceneSection(Section):
    """Base of the tables of a scene file: numbers must be finite."""

    model_config = ConfigDict(allow_inf_nan=False)


class RenderSection(SceneSection):
    """``[render]``: where the images go, and how they are made."""

    output: str = Field(default="rendered", description="Folder of the images.")
    seed: int = Field(default=0, ge=0, description="Seed of all noise; equal seeds give equal images.")
    rays_per_pixel_side: int = Field(
        default=4, ge=1, le=32, description="Rays along the side of a pixel; its square is their number in a pixel."
    )
    geometry: str | None = Field(default=None, description="Geometry table that takes the place of `[[images]]`.")
    truth: bool = Field(default=True, description="Add the truth as FITS extensions.")
    backplanes: bool = Field(default=False, description="Add maps of what each pixel sees as FITS extensions.")
    preview: bool = Field(default=False, description="Write a PNG for each image.")
    campaign: bool = Field(default=False, description="Write a campaign, camera and geometry for `giantlike run`.")
    estimators: list[str] = Field(
        default=["cross_correlation", "limb_matching"], description="Estimators of that campaign."
    )


class LightSection(SceneSection):
    """``[light]``: the Sun."""

    direction: Vector | None = Field(
        default=None, description="From the targets to the Sun, inertial axes, of any length; default: from SPICE."
    )
    distance_au: float = Field(default=1.0, gt=0, description="Distance of the Sun from the targets, au.")
    extended: bool = Field(default=False, description="The Sun has a disk, so that shadows have soft edges.")


class PhotometrySection(SceneSection):
    """``[photometry]``: brightness of stars."""

    zero_point_e_s: float = Field(
        default=2.0e5, gt=0, description="Signal of a star of magnitude 0, electrons per second."
    )


class SkySection(SceneSection):
    """``[stars]``: the star catalog; without this section there are no stars."""

    catalog: str = Field(default="default", description="`default`, or the file of a built catalog or CSV.")
    max_magnitude: float | None = Field(default=None, description="Faintest star drawn.")


class HotPixelSection(SceneSection):
    """``[detector.hot_pixels]``: pixels of high dark current."""

    count: int = Field(default=0, ge=0, description="Number of hot pixels.")
    median_e_s: float = Field(default=500.0, gt=0, description="Median of their rates, electrons per second.")


class DetectorSection(SceneSection):
    """``[detector]``: detector effects beyond the ``[detector]`` of the camera file."""

    pattern_seed: int = Field(
        default=0, ge=0, description="Seed of what all images share: pixel response, hot and dead pixels."
    )
    shot_noise: bool = Field(default=True, description="Add the Poisson noise of light and dark current.")
    bits: int = Field(default=16, description="Bits of the converter.")
    dark: Annotated[DarkCurrent, options_validator(DarkCurrent)] = Field(
        default_factory=DarkCurrent, description="Dark current."
    )
    stray: Annotated[StrayLight, options_validator(StrayLight)] = Field(
        default_factory=StrayLight, description="Stray light."
    )
    transfer: Annotated[FrameTransfer, options_validator(FrameTransfer)] = Field(
        default_factory=FrameTransfer, description="Smear of a frame-transfer detector."
    )
    cosmic_rays: Annotated[CosmicRays, options_validator(CosmicRays)] = Field(
        default_factory=CosmicRays, description="Hits of cosmic rays."
    )
    well: Annotated[FullWell, options_validator(FullWell)] = Field(
        default_factory=FullWell, description="Full well and blooming."
    )
    hot_pixels: HotPixelSection = HotPixelSection()
    dead_pixels: int = Field(default=0, ge=0, description="Number of pixels without signal.")
    response_rms: float = Field(default=0.0, ge=0, lt=0.3, description="Relative rms of the pixel response.")
    response_file: str | None = Field(default=None, description="Image of the pixel response, instead of a random one.")
    vignetting: float = Field(default=0.0, ge=0, le=1, description="Relative loss of light in the corners.")


class PlaceSection(SceneSection):
    """Position, orientation and illumination of a target."""

    position_km: Vector | None = Field(
        default=None, description="Apparent vector from camera to target center, inertial axes, km."
    )
    body_from_inertial_xyzw: Quaternion | None = Field(
        default=None, description="Orientation when the light left, quaternion, scalar last."
    )
    sun_direction: Vector | None = Field(
        default=None, description="From the target to the Sun, inertial axes, where it is not `light.direction`."
    )


class RenderTargetSection(PlaceSection, BodySection):
    """``[[targets]]``: a body, and its place unless an image gives another."""

    albedo: float = Field(default=0.045, gt=0, description="Geometric albedo.")


class ObserverSection(SceneSection):
    """``observer``: the spacecraft relative to the solar system barycenter, for parallax and aberration."""

    position_km: Vector = Field(description="Inertial axes, km.")
    velocity_km_s: Vector = Field(description="Inertial axes, km/s.")


class ImageSection(SceneSection):
    """``[[images]]``: an exposure; its attitude is a quaternion or a pointing."""

    file: str = Field(min_length=1, description="FITS file to write, relative to the output folder.")
    epoch_utc: str = Field(description="Mid-exposure, ISO 8601.")
    exposure_s: float = Field(gt=0, description="Exposure, s.")
    camera_from_inertial_xyzw: Quaternion | None = Field(default=None, description="Attitude, quaternion, scalar last.")
    pointing_deg: Vector | None = Field(
        default=None, description="Right ascension, declination and roll of the boresight, deg."
    )
    angular_rate_deg_s: Vector = Field(
        default=(0.0, 0.0, 0.0), description="Rotation of the camera during the exposure, about its own axes, deg/s."
    )
    observer: ObserverSection | None = None
    targets: dict[str, PlaceSection] = Field(
        default_factory=dict, description="Places of targets in this image, by name."
    )


class RenderFile(SceneSection):
    """A whole scene file."""

    render: RenderSection = RenderSection()
    camera: dict[str, Any] = Field(description="`file`, the name of a camera file with `[psf]`, or the keys of one.")
    light: LightSection = LightSection()
    photometry: PhotometrySection = PhotometrySection()
    stars: SkySection | None = None
    spice: SpiceSection | None = None
    detector: DetectorSection = DetectorSection()
    targets: list[RenderTargetSection] = Field(default_factory=list)
    images: list[ImageSection] = Field(default_factory=list)
