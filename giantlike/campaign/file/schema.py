"""Keys of a campaign file: one pydantic field per key, with the description below it.

The checks on reading, the defaults and the page ``docs/campaign_file.md`` follow from these fields.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import BeforeValidator, Field, PlainValidator

from giantlike.atmosphere import Atmosphere
from giantlike.calibration import CalibrationOptions
from giantlike.calibration.criteria import CalibrationCriteria
from giantlike.calibration.options import Loss, Treatment
from giantlike.calibration.star_images import DEFAULT_MIN_SNR
from giantlike.campaign.file.options import options_validator
from giantlike.campaign.file.toml_file import TomlSection
from giantlike.core.errors import InputError
from giantlike.core.photometry import Photometry
from giantlike.processing.detection.options import DetectionOptions
from giantlike.rings import Rings
from giantlike.stars.options import StarOptions
from giantlike.stars.transfer import TransferMethod

_MOST_POLE_DEG = 25
Radii: TypeAlias = tuple[float, float, float]  # radii of an ellipsoid along its body-fixed x, y and z axes, km


def _checked_hdu(value: object) -> int | str:
    if isinstance(value, bool) or not isinstance(value, int | str):
        raise InputError(f"expected a number or a name, got {value!r}")
    return value


def _checked_shape(value: object) -> str | Radii | None:
    """Name of a mesh file, radii, or None for the radii of a PCK."""
    if isinstance(value, str):
        return value
    if value == {"radii": "pck"}:
        return None
    radii = value.get("radii_km") if isinstance(value, Mapping) and len(value) == 1 else None
    if not isinstance(radii, list) or len(radii) != 3:
        raise InputError(f"expected a mesh file or {{ radii_km = [a, b, c] }} or {{ radii = 'pck' }}, got {value!r}")
    if any(isinstance(r, bool) or not isinstance(r, int | float) or not math.isfinite(r) or not r > 0 for r in radii):
        raise InputError(f"radii_km must be three positive and finite numbers, got {radii!r}")
    return float(radii[0]), float(radii[1]), float(radii[2])


def _checked_pole(value: object) -> float | str:
    """Error of a pole, or that it is unknown."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if value != "unknown" and not (number and 0 <= value <= _MOST_POLE_DEG):  # type: ignore[operator]
        raise InputError(f'expected a number from 0 to {_MOST_POLE_DEG}, or "unknown", got {value!r}')
    return "unknown" if value == "unknown" else float(value)  # type: ignore[arg-type]


def _checked_rings(value: object) -> Rings | None:
    """Name of a body, or two radii."""
    if value is None or isinstance(value, Rings):
        return value
    if isinstance(value, str):
        return Rings.of(value)
    if not isinstance(value, Mapping) or set(value) != {"inner_km", "outer_km"}:
        raise InputError(f"expected the name of a body or a table of inner_km and outer_km, got {value!r}")
    return Rings(*(_checked_number(key, value[key]) for key in ("inner_km", "outer_km")))


def _checked_number(key: object, number: object) -> float:
    if isinstance(number, bool) or not isinstance(number, int | float):
        raise InputError(f"{key} must be a number, got {number!r}")
    return float(number)


def _checked_atmosphere(value: object) -> Atmosphere | None:
    """Name of a body, an altitude, or all numbers of an atmosphere."""
    if value is None or isinstance(value, Atmosphere):
        return value
    if isinstance(value, str):
        return Atmosphere.of(value)
    if not isinstance(value, Mapping):
        raise InputError(f"expected the name of a body or a table, got {value!r}")
    table = {str(key): _checked_number(key, number) for key, number in value.items()}
    if set(table) == {"altitude_km", "sigma_km"}:
        return Atmosphere.at(table["altitude_km"], sigma_km=table["sigma_km"])
    names = {one.name for one in dataclasses.fields(Atmosphere)}
    needed = {"scale_height_km", "optical_depth", "sigma_km"}
    if not needed <= set(table) <= names:
        raise InputError(
            "expected altitude_km and sigma_km, or scale_height_km, optical_depth and sigma_km with "
            f"{', '.join(sorted(names - needed))}; got {', '.join(sorted(table)) or 'nothing'}"
        )
    return Atmosphere(**table)


class CampaignSection(TomlSection):
    """``[campaign]``: the name and the run folder."""

    name: str = Field(min_length=1)
    """Name of the campaign, for the report."""
    output: str = Field(min_length=1)
    """Run folder; a run goes on with the results that it holds ([runs](runs.md))."""


class MissionSection(TomlSection):
    """``[mission]``: a mission whose camera, frames, labels and kernels the package knows ([list](missions.md)).

    It completes `[camera]`, `[images]` and `[spice]`; existing keys take precedence.
    """

    name: str
    """Name of the mission's camera, such as `dawn_fc2`."""
    kernels: str | None = None
    """Folder that holds the SPICE kernels of the mission, itself or in folders below; those with names as in the
    mission file are loaded. `spice.kernels` wins over it."""


class ImagesSection(TomlSection):
    """``[images]``: the image files and their a priori geometry."""

    files: list[str] = Field(min_length=1)
    """File names or glob patterns (`**` for subfolders) of images in any readable format."""
    geometry: str | None = None
    """Table of a priori geometry ([columns](howto/a-priori.md)), or the JSON that NASA's EPIC API gives for a day of
    pictures, or a folder of SUMFILEs of stereophotoclinometry; missing values come from headers, then SPICE."""
    hdu: Annotated[int | str | None, PlainValidator(_checked_hdu)] = None
    """Number (from 0) or name of the FITS extension; default: the first with an image."""
    bottom_up: bool = False
    """The first stored row is the bottom of the picture: reverse the rows. A camera preset may declare this too."""
    label_geometry: bool = False
    """Take the position, orientation and Sun of the target from labels of Galileo SSI, and attitude, position and Sun
    from labels of NEAR MSI, where the geometry table has no row."""
    expect: Literal["none"] | dict[str, Literal["none"]] | None = None
    """`"none"` for images that are expected to hold nothing, or a table of names or patterns of them, such as
    `{ "dark_*.fits" = "none" }`: a refusal is then a success, and a fix that is `ok` a failure, in the exit code."""
    attitude_sigma_deg: float | None = Field(default=None, gt=0, le=30)
    """One sigma of a priori attitudes about each camera axis, deg, for the covariances of fixes made with them; without
    it they hold no uncertainty of the attitude."""


class ClockSection(TomlSection):
    """A count of the spacecraft clock in labels, for the epoch of images whose labels have no time of the exposure."""

    item: str
    """Item of the label."""
    pattern: str
    """Regular expression that finds the count in the item."""
    count: str | None = None
    """Count as SPICE reads it, with the groups of the expression as `{0}`, `{1}`."""
    zero_utc: str | None = None
    """In place of `count`, for a clock of seconds that needs no kernel: the UTC at which it read 0."""
    after_exposure_s: float = 0.0
    """Time from the closing of the shutter to that count, s."""


class CalibrationFramesSection(TomlSection):
    """``[calibration_frames]``: exposures that take bias, dark current and response of the pixels off every image.

    `(raw - bias - dark * exposure / dark exposure) / flat`. Each is one file or several, which are averaged without
    particles; their scatter gives the noise that they add.
    """

    bias: list[str] = Field(default_factory=list)
    """Files or patterns of exposures of zero length."""
    dark: list[str] = Field(default_factory=list)
    """Files or patterns of dark exposures, all of one length."""
    dark_exposure_s: float | None = Field(default=None, gt=0)
    """Their exposure, s, where headers do not have it."""
    dark_has_bias: bool = True
    """The darks hold the bias, as raw exposures do; false for a dark from which it was taken off."""
    flat: list[str] = Field(default_factory=list)
    """Files or patterns of exposures to even light; each is scaled to a median of 1."""
    flat_has_bias: bool = True
    """The flats hold bias and dark current, as raw exposures do; false for a flat from which they were taken off."""
    bad_pixels: str | None = None
    """Image that is not 0 where a pixel is bad. Hot pixels of the dark and dead ones of the flat are found."""
    hdu: Annotated[int | str | None, PlainValidator(_checked_hdu)] = None
    """FITS extension of all of these; default: the first with an image. Rows are ordered as in the images."""


class SpiceSection(TomlSection):
    """``[spice]``: kernels, the spacecraft and the frame of the camera."""

    kernels: list[str] = Field(min_length=1)
    """File names or glob patterns of SPICE kernels, in loading order."""
    spacecraft: str
    """NAIF name or code of the spacecraft."""
    frame: str | None = None
    """SPICE frame of the camera, or the instrument code of a CK without a frame kernel; without it SPICE
    gives no a priori attitude."""
    ck_tolerance_s: float = Field(default=0.0, ge=0)
    """Largest distance in time, s, to an attitude of a CK of single (discrete) attitudes; the nearest one counts."""
    camera_from_frame_xyzw: list[float] = Field(default=[0.0, 0.0, 0.0, 1.0])
    """Quaternion, scalar last, from that frame to camera axes (+x along columns, +y along rows, +z boresight), where
    the two differ."""
    clock: ClockSection | None = None


class StarsSection(TomlSection):
    """``[stars]``: star identification, and the transfer of attitudes to short exposures.

    Without this section no stars are processed and the a priori attitudes are used.
    """

    catalog: str = "default"
    """`default` (Gaia and Hipparcos), or the file of a built catalog or CSV."""
    max_magnitude: float | None = None
    """Faintest star used, in the band of the catalog (Gaia G for the default)."""
    lost_in_space: bool = False
    """Search the whole sky where the a priori attitude does not lead to a solution."""
    long_exposure_s: float | None = Field(default=None, gt=0)
    """At or above this exposure, s, an image is a star image; a shorter one takes its attitude from its neighbors in
    time. Default: every image is both a star image and an image of bodies."""
    transfer: TransferMethod = TransferMethod.INTERPOLATE
    """Method by which a short exposure gets its attitude."""
    rates: str | None = None
    """Table of angular rates (a gyro's) for `transfer = "propagate"`: CSV with `epoch_utc` or `et`, and `rate_x_rad_s`,
    `rate_y_rad_s`, `rate_z_rad_s` about the camera axes."""
    max_gap_s: float = math.inf
    """Largest distance in time to a star image, s."""
    drift_arcsec_per_sqrt_s: float = 0.1
    """Random walk of the attitude between images, arcsec per square root of a second."""
    max_disagreement_deg: float = 1.0
    """Largest difference between the a priori rotation and the rotation that the method assumes, deg; catches slews,
    and 180 switches the check off."""
    options: Annotated[StarOptions, options_validator(StarOptions, elsewhere=("max_magnitude", "lost_in_space"))] = (
        StarOptions()
    )
    """Options of the star solution without a separate key."""
    detection: Annotated[DetectionOptions, options_validator(DetectionOptions)] = DetectionOptions()
    """Options of the detection of stars."""


class CalibrationSection(TomlSection):
    """``[calibration]``: parameters of the camera to estimate from the stars of the campaign.

    With this section the camera is calibrated first, and everything else uses the calibrated camera.
    """

    estimate: list[str] = Field(min_length=1)
    """Names of the parameters of the camera model to estimate."""
    model: str | None = None
    """Type of the model, where it differs from the camera's."""
    min_snr: float = Field(default=DEFAULT_MIN_SNR, ge=0)
    """Lowest signal-to-noise ratio of the stars to calibrate from."""
    scale_error: float = Field(default=0.1, gt=0, le=0.2)
    """Relative error that the focal length of the camera may have."""
    temperature_keyword: str | None = None
    """Header keyword that holds the temperature of the camera, Celsius."""
    options: Annotated[CalibrationOptions, options_validator(CalibrationOptions)] = CalibrationOptions()
    """Options of the fit."""
    criteria: Annotated[CalibrationCriteria, options_validator(CalibrationCriteria)] = CalibrationCriteria()
    """Limits that a calibration must meet to be used."""


class BodySection(TomlSection):
    """A body: its name, shape, brightness law and name in SPICE."""

    name: str = Field(min_length=1)
    """Name of the target in tables; the default of `spice_body`."""
    shape: Annotated[str | Radii | None, PlainValidator(_checked_shape)]
    """Mesh file, or an ellipsoid: `{ radii_km = [a, b, c] }`, or `{ radii = "pck" }` for those that a planetary
    constants kernel of `[spice]` gives the `spice_body`."""
    units: Literal["km", "m", "auto"] = "km"
    """Unit of the mesh file; `auto` decides by the size of the body, with a warning."""
    reflectance: dict[str, Any] | None = None
    """Reflectance law and its parameters; default: `{ model = "mcewen" }`."""
    spice_body: str | None = None
    """NAIF name or code, where it is not `name`."""
    frame: str | None = None
    """Body-fixed SPICE frame, where it is not the body's default."""


class UncertaintySection(TomlSection):
    """One sigma of the a priori data of a target, for the covariances of fixes; 0 for exact values."""

    scale: float = Field(default=0.0, ge=0, le=0.3)
    """Relative error of the size of the shape."""
    pole_deg: Annotated[float | Literal["unknown"], PlainValidator(_checked_pole)] = 0.0
    """Error of the direction of the body-fixed z axis, about each of the other two axes, deg, up to 25; or `"unknown"`,
    for ellipsoids whose radii differ by at most 12 %: fixes then hold how far they move over all orientations, of which
    none needs to be given."""
    spin_deg: float = Field(default=0.0, ge=0, le=25)
    """Error of the rotation about the body-fixed z axis, deg."""
    ephemeris_km: float = Field(default=0.0, ge=0)
    """Error of the predicted position along each axis, km; part of observed minus computed, not of the fix."""
    ephemeris_table: str | None = None
    """Table of the covariance of that position along the arc, by epoch, in place of `ephemeris_km`
    ([columns](howto/a-priori.md#an-orbit-covariance-that-varies))."""
    sun_deg: float = Field(default=0.0, ge=0, le=25)
    """Error of the direction to the Sun, about each axis across it, deg."""
    albedo: float = Field(default=0.15, ge=0.01, le=2.0)
    """Brightness of the surface about its law: albedo variations, clouds (0.5). Residuals from them raise no flag."""


class PhotometrySection(TomlSection):
    """``[photometry]``: zero point that replaces the one in the camera file, where the table is the same."""

    zero_point_e_s: float | None = None
    """Signal of a star of magnitude 0 and BP-RP 1 on the optical axis, electrons per second."""
    zero_point_mag: float | None = None
    """In its place: the magnitude of a star that gives 1 electron per second."""
    aperture_m2: float | None = None
    """In its place: area of the aperture, m^2; the zero point then follows from the light of the Sun."""
    shortest_um: float = 0.4
    """Start of the pass band, with `aperture_m2`."""
    longest_um: float = 0.9
    """End of the pass band, with `aperture_m2`."""
    quantum_efficiency: float = 0.5
    """Mean over the pass band with the optics, with `aperture_m2`."""
    band: str = "Gaia G"
    """Band of the magnitudes."""
    color_term: float = 0.0
    """Change of the zero point with BP-RP, mag per mag."""
    field_term_mag: float = 0.0
    """Change from the axis to `field_angle_deg`, with the square of the angle, mag; negative where it darkens."""
    field_angle_deg: float = 1.0
    """Angle from the axis at which `field_term_mag` is stated."""
    sigma_mag: float = 0.0
    """Standard deviation of the zero point, mag; 0 is exact."""
    covariance_mag2: list[list[float]] | None = None
    """In its place: covariance of zero point, color term and field term, mag^2."""
    scatter_mag: float = 0.0
    """Standard deviation of single stars about the relation, mag."""
    epoch: str = ""
    """UTC at which it was measured."""
    sun_magnitude: float | None = None
    """Magnitude of the Sun at 1 au in the band; known for Gaia G and V."""

    @property
    def value(self) -> Photometry | None:
        """The zero point; None where no key is given."""
        given = self.model_dump(exclude_unset=True, include=set(PhotometrySection.model_fields))
        return Photometry.from_mapping(given) if given else None


class CampaignPhotometrySection(PhotometrySection):
    """``[photometry]``: zero point that replaces the one in the camera file; options of `giantlike photometry`."""

    apertures_px: tuple[float, float, float] = (3.0, 9.0, 14.0)
    """Radius of the circle, and inner and outer radius of the ring of the level."""
    method: Literal["psf", "aperture"] = "psf"
    """Least squares with the point spread function, or the sum of the circle."""


class TargetSection(BodySection):
    """``[[targets]]``: a body, and the estimators to run on it."""

    estimators: list[str] = Field(min_length=1)
    """Names of the estimators; `giantlike estimators` lists them."""
    options: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Options by estimator; `giantlike estimators NAME` lists them."""
    uncertainty: UncertaintySection = UncertaintySection()
    terrain: str | None = None
    """Height map of a body whose shape is an ellipsoid: a PDS3 image with its label (such as LOLA's), a GeoTIFF or a
    numpy archive; estimators on limbs then predict the outline with its relief ([terrain](terrain.md))."""
    terrain_sigma_km: float | None = Field(default=None, ge=0, le=100)
    """One sigma of the heights of the map over wide areas, km; default from the file, else 0."""
    atmosphere: Annotated[Atmosphere | None, PlainValidator(_checked_atmosphere)] = None
    """Altitude at which the limb of an ellipsoid is seen: `"EARTH"`, `"MARS"`, `"VENUS"`, `"JUPITER"`, `"SATURN"`,
    `"URANUS"`, `"NEPTUNE"`, `"TITAN"`, `"TRITON"` or `"PLUTO"`, a known `{ altitude_km = 25, sigma_km = 3 }`, or
    `{ scale_height_km, optical_depth, sigma_km, base_km, reference_nm, exponent, wavelength_nm }`
    ([terrain](terrain.md))."""
    air: bool | None = None
    """`true` for a body with air or haze: an ellipsoid without `atmosphere` gets the one that is known by its
    `spice_body` or `name`. `false` for an airless one: no haze. Left out: haze is tested for,
    except on the Moon, Mercury, moons and asteroids that are known to be airless ([terrain](terrain.md))."""
    rings: Annotated[Rings | None, PlainValidator(_checked_rings)] = None
    """Rings in the equator of an ellipsoid, whose light and shadow are not part of it: `"SATURN"`, or
    `{ inner_km, outer_km }` ([terrain](terrain.md))."""


class NetworkSection(TomlSection):
    """``[network]``: landmarks of a shape, found in all images and adjusted together ([networks](network.md)).

    The step follows all others and writes the folder `network` of the run.
    """

    target: str | None = None
    """Name of the target; may be left out where the campaign has one."""
    shape: str | None = None
    """Mesh file of the landmarks; default: the shape of the target."""
    pose: Treatment = Treatment.ESTIMATE
    """`estimate`, `consider` (kept, while its covariance enters that of the points) or `fixed`."""
    sigma_pole_deg: float = Field(default=2.0, ge=0, le=25)
    """A priori sigma of pole and prime meridian, deg; 0 keeps them. They are estimated only where a planetary constants
    kernel gives the orientation of the target by pole, prime meridian and rate alone."""
    sigma_rate: float = Field(default=1e-4, ge=0, le=1)
    """That of the rate of rotation, relative; 0 keeps it."""
    sigma_size: float = Field(default=0.01, ge=0, le=1)
    """That of the size of the shape, relative; 0 keeps it."""
    camera: Treatment = Treatment.CONSIDER
    """Treatment of the parameters of the camera whose uncertainty its file has."""
    loss: Loss = Loss.CAUCHY
    """Loss of the fit that finds outliers: `cauchy`, `huber` or `linear`."""


class ReportSection(TomlSection):
    """``[report]``: the contents of ``report.html``."""

    max_overlays: int = Field(default=24, ge=0)
    """Number of images shown with their results."""


class AdesSection(TomlSection):
    """``[ades]``: submissions of astrometry to the Minor Planet Center; ``giantlike export --format ades`` reads it."""

    station: str
    """Code of the observatory: that of the spacecraft."""
    submitter: str
    """Name, as initials and family name."""
    measurers: list[str] = Field(min_length=1)
    """Names."""
    earth_kernel: str
    """Ephemeris of the Earth (SPK), of the same series as the states of the spacecraft: the Earth of ERFA's `epv00`
    was 115 km from that of DE440 in January 2024."""
    design: str
    """Design of the telescope, such as `"Refractor"`."""
    aperture_m: float
    """Aperture of the telescope, m."""
    detector: str = "CCD"
    """Detector."""
    star_catalog: str = "Gaia3"
    """Catalog of the attitudes, by its name at the Minor Planet Center."""
    objects: dict[str, str] = Field(default_factory=dict)
    """Designation of each target: `RHEA = "Saturn 5"`, `BENNU = "101955"`, `P1 = "P10u2Ab"` (a name of your own of at
    most 8 characters, for what is not known). Moons and numbered asteroids that SPICE knows need none."""
    sigma_position_km: float | None = Field(default=None, gt=0.0)
    """Standard deviation of the position of the spacecraft along each axis, km."""
    sigma_time_s: float | None = Field(default=None, gt=0.0)
    """Standard deviation of the epochs, s."""


class AdesFile(TomlSection):
    """A file with a table ``[ades]``."""

    ades: AdesSection


class GeometrySection(TomlSection):
    """``[geometry]``: where body, pole and Sun are in an image, as read off a picture or a press kit.

    One table per image and target (`[[geometry]]` for several), in place of a row of `images.geometry`. Azimuths are
    angles in the image, clockwise from up (the direction of the first row). The orientation needs the north azimuth and
    the sub-observer point, a sphere needs none; the Sun needs the sub-solar point, or the phase angle and the Sun
    azimuth, and what is given beyond that has to agree. Without an a priori attitude, camera axes are used as inertial
    axes ([how](howto/a-priori.md#off-a-picture-or-a-press-kit)).
    """

    file: str | None = None
    """Image; may be left out where the campaign has one."""
    target: str | None = None
    """Name of the target; may be left out where the campaign has one."""
    epoch_utc: str | None = None
    """Mid-exposure, ISO 8601; not needed for a fix in camera axes."""
    exposure_s: float | None = Field(default=None, ge=0)
    """Exposure, s."""
    center_px: list[float] | None = None
    """Pixel [x, y] of the center of the body, roughly; default: the center of the image."""
    range_km: float | None = Field(default=None, gt=0)
    """Distance from the camera to the center of the body, km."""
    diameter_px: float | None = Field(default=None, gt=0)
    """Widest diameter of the body in the image, px, in place of `range_km`; where both are given, they have to agree
    to 5 %."""
    azimuth_zero: Literal["up", "right"] = "up"
    """Direction from which azimuths are counted; `"right"` for the north azimuth of PDS labels."""
    north_azimuth_deg: float | None = None
    """Direction of the north pole (body-fixed +z axis) in the image, deg."""
    sub_observer_latitude_deg: float | None = Field(default=None, ge=-90, le=90)
    """Planetocentric latitude of the point below the camera, deg."""
    sub_observer_longitude_deg: float | None = Field(default=None, ge=-360, le=360)
    """Its east longitude, deg (west: with a minus sign); not needed for a body of revolution with a Sun azimuth."""
    sub_solar_latitude_deg: float | None = Field(default=None, ge=-90, le=90)
    """Planetocentric latitude of the point below the Sun, deg."""
    sub_solar_longitude_deg: float | None = Field(default=None, ge=-360, le=360)
    """Its east longitude, deg."""
    sun_azimuth_deg: float | None = None
    """Direction of the Sun in the image, from the center of the body to the middle of its bright limb, deg."""
    phase_angle_deg: float | None = Field(default=None, ge=0, le=180)
    """Angle at the body between Sun and camera, deg: 0 for a full disk, 90 for half of it."""


def _as_list(value: object) -> object:
    return [value] if isinstance(value, Mapping) else value


class CampaignFile(TomlSection):
    """A whole campaign file."""

    campaign: CampaignSection
    mission: MissionSection | None = None
    images: ImagesSection
    camera: dict[str, Any]
    """`file`, the name of a camera file; `preset`, the name of a real camera that comes with the package
    ([list](camera_presets.md)); or the keys of a [camera file](campaigns.md#the-camera-file). A `[mission]` may provide
    it. To the first two, `binned` adds a reduction of the images: the pixels along one side of a block that was summed
    (2, or 1.6), or the scale of a smaller picture (0.625), or its size (`[640, 640]`); and keys of the tables
    `camera.detector` and `camera.psf`, such as `gamma`, win over theirs, for the images as they are."""
    spice: SpiceSection | None = None
    stars: StarsSection | None = None
    calibration: CalibrationSection | None = None
    calibration_frames: CalibrationFramesSection | None = None
    geometry: Annotated[list[GeometrySection], BeforeValidator(_as_list)] = Field(default_factory=list)
    targets: list[TargetSection] = Field(default_factory=list)
    network: NetworkSection | None = None
    report: ReportSection = ReportSection()
    photometry: CampaignPhotometrySection = CampaignPhotometrySection()
    ades: AdesSection | None = None
