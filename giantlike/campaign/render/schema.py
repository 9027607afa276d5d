"""Keys of a scene file for ``giantlike render``: one pydantic field per key holds its type, limits and description.

The checks on reading and the page ``docs/scene_file.md`` both follow from these fields.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import ConfigDict, Field

from giantlike.campaign.file.options import options_validator
from giantlike.campaign.file.schema import BodySection, SpiceSection
from giantlike.campaign.file.toml_file import Section, key
from giantlike.simulation.cosmic_rays import CosmicRays
from giantlike.simulation.effects import DarkCurrent, FrameTransfer, FullWell, StrayLight

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class SceneSection(Section):
    """Base of the tables of a scene file: numbers must be finite."""

    model_config = ConfigDict(allow_inf_nan=False)


class RenderSection(SceneSection):
    """``[render]``: where the images go, and how they are made."""

    output: str = key("Folder of the images.", "rendered")
    seed: int = key("Seed of all noise; equal seeds give equal images.", 0, ge=0)
    rays_per_pixel_side: int = key(
        "Rays along the side of a pixel; its square is their number in a pixel.", 4, ge=1, le=32
    )
    geometry: str | None = key("Geometry table that takes the place of `[[images]]`.", None)
    truth: bool = key("Add the truth as FITS extensions.", True)
    backplanes: bool = key("Add maps of what each pixel sees as FITS extensions.", False)
    preview: bool = key("Write a PNG for each image.", False)
    campaign: bool = key("Write a campaign, camera and geometry for `giantlike run`.", False)
    estimators: list[str] = key("Estimators of that campaign.", ["cross_correlation", "limb_matching"])


class LightSection(SceneSection):
    """``[light]``: the Sun."""

    direction: Vector | None = key(
        "From the targets to the Sun, inertial axes, of any length; default: from SPICE.", None
    )
    distance_au: float = key("Distance of the Sun from the targets, au.", 1.0, gt=0)
    extended: bool = key("The Sun has a disk, so that shadows have soft edges.", False)


class PhotometrySection(SceneSection):
    """``[photometry]``: brightness of stars."""

    zero_point_e_s: float = key("Signal of a star of magnitude 0, electrons per second.", 200000.0, gt=0)


class SkySection(SceneSection):
    """``[stars]``: the star catalog; without this section there are no stars."""

    catalog: str = key("`default`, or the file of a built catalog or CSV.", "default")
    max_magnitude: float | None = key("Faintest star drawn.", None)


class HotPixelSection(SceneSection):
    """``[detector.hot_pixels]``: pixels of high dark current."""

    count: int = key("Number of hot pixels.", 0, ge=0)
    median_e_s: float = key("Median of their rates, electrons per second.", 500.0, gt=0)


class DetectorSection(SceneSection):
    """``[detector]``: detector effects beyond the ``[detector]`` of the camera file."""

    pattern_seed: int = key("Seed of what all images share: pixel response, hot and dead pixels.", 0, ge=0)
    shot_noise: bool = key("Add the Poisson noise of light and dark current.", True)
    bits: int = key("Bits of the converter.", 16)
    dark: Annotated[DarkCurrent, options_validator(DarkCurrent)] = key("Dark current.", DarkCurrent())
    stray: Annotated[StrayLight, options_validator(StrayLight)] = key("Stray light.", StrayLight())
    transfer: Annotated[FrameTransfer, options_validator(FrameTransfer)] = key(
        "Smear of a frame-transfer detector.", FrameTransfer()
    )
    cosmic_rays: Annotated[CosmicRays, options_validator(CosmicRays)] = key("Hits of cosmic rays.", CosmicRays())
    well: Annotated[FullWell, options_validator(FullWell)] = key("Full well and blooming.", FullWell())
    hot_pixels: HotPixelSection = HotPixelSection()
    dead_pixels: int = key("Number of pixels without signal.", 0, ge=0)
    response_rms: float = key("Relative rms of the pixel response.", 0.0, ge=0, lt=0.3)
    response_file: str | None = key("Image of the pixel response, instead of a random one.", None)
    vignetting: float = key("Relative loss of light in the corners.", 0.0, ge=0, le=1)


class PlaceSection(SceneSection):
    """Position, orientation and illumination of a target."""

    position_km: Vector | None = key("Apparent vector from camera to target center, inertial axes, km.", None)
    body_from_inertial_xyzw: Quaternion | None = key("Orientation when the light left, quaternion, scalar last.", None)
    sun_direction: Vector | None = key(
        "From the target to the Sun, inertial axes, where it is not `light.direction`.", None
    )


class RenderTargetSection(PlaceSection, BodySection):
    """``[[targets]]``: a body, and its place unless an image gives another."""

    albedo: float = key("Geometric albedo.", 0.045, gt=0)


class ObserverSection(SceneSection):
    """``observer``: the spacecraft relative to the solar system barycenter, for parallax and aberration."""

    position_km: Vector = key("Inertial axes, km.")
    velocity_km_s: Vector = key("Inertial axes, km/s.")


class ImageSection(SceneSection):
    """``[[images]]``: an exposure; its attitude is a quaternion or a pointing."""

    file: str = key("FITS file to write, relative to the output folder.", min_length=1)
    epoch_utc: str = key("Mid-exposure, ISO 8601.")
    exposure_s: float = key("Exposure, s.", gt=0)
    camera_from_inertial_xyzw: Quaternion | None = key("Attitude, quaternion, scalar last.", None)
    pointing_deg: Vector | None = key("Right ascension, declination and roll of the boresight, deg.", None)
    angular_rate_deg_s: Vector = key(
        "Rotation of the camera during the exposure, about its own axes, deg/s.", (0.0, 0.0, 0.0)
    )
    observer: ObserverSection | None = None
    targets: dict[str, PlaceSection] = key("Places of targets in this image, by name.", {})


class RenderFile(SceneSection):
    """A whole scene file."""

    render: RenderSection = RenderSection()
    camera: dict[str, Any] = key("`file`, the name of a camera file with `[psf]`, or the keys of one.")
    light: LightSection = LightSection()
    photometry: PhotometrySection = PhotometrySection()
    stars: SkySection | None = None
    spice: SpiceSection | None = None
    detector: DetectorSection = DetectorSection()
    targets: list[RenderTargetSection] = Field(default_factory=list)
    images: list[ImageSection] = Field(default_factory=list)
