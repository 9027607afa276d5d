"""Lines of sight to bodies and stars: from a fix in an image to a direction in inertial axes, with its errors."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.catalogs import StarTable
from giantlike.catalogs.table import et_of_julian_year
from giantlike.core.arrays import Float, as_finite, require, require_number, symmetric, unit
from giantlike.core.causes import IN_IMAGE, Cause, sum_parts
from giantlike.core.frames import direction_from_radec, east_north, rotate
from giantlike.core.light import aberrate
from giantlike.core.outcomes import CenterFix, Failure, Reason
from giantlike.core.units import AU_KM, RAD_PER_MAS, SECONDS_PER_JULIAN_YEAR, SPEED_OF_LIGHT_KM_S
from giantlike.core.values import Value
from giantlike.ephemeris import BARYCENTER
from giantlike.image import Image

_STAR_STEPS = 4  # of the light time of a star: each gains a factor v/c, below 1e-3 for every star known


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sightline(Value):
    """A measured direction from the spacecraft to a body or a star.

    Parameters
    ----------
    target : str; name; lines to the same target share the error of its ephemeris
    image : str; name; lines of the same image share the error of its attitude
    et : float, TDB seconds past J2000; mid-exposure
    direction_inertial : (3,) float64, unitless, ICRF axes; unit vector to the target
    covariance_rad2 : (3, 3) float64, rad^2, ICRF axes; of the direction, without the attitude; zero along the direction
    covariance_attitude_rad2 : (3, 3) float64, rad^2, ICRF axes
        Of the small rotation ``e`` with ``true direction = direction - e x direction``; zero where the attitude is
        taken as exact. Lines of the same image use the covariance of the first.
    aberration : bool
        True where the direction is as the moving camera sees it; False where stellar aberration is out of it, as by an
        attitude from stars that were used at their positions without aberration (world coordinates of FITS headers).

    Raises
    ------
    InputError
        The direction is not a unit vector, or a matrix is not a covariance.
    """

    target: str
    image: str
    et: float
    direction_inertial: Float
    covariance_rad2: Float
    covariance_attitude_rad2: Float = dataclasses.field(default_factory=lambda: np.zeros((3, 3)))
    aberration: bool = True

    def __post_init__(self) -> None:
        require_number(self.et, f"{self.image}: et")
        for name, shape in (
            ("direction_inertial", (3,)),
            ("covariance_rad2", (3, 3)),
            ("covariance_attitude_rad2", (3, 3)),
        ):
            object.__setattr__(self, name, as_finite(getattr(self, name), shape, f"{self.target}: {name}"))
        Value.__post_init__(self)


def sightline_of_fix(fix: CenterFix, image: Image, camera: Camera) -> Sightline | Failure:
    """Turn a fix of a body in an image into a line of sight.

    Parameters
    ----------
    fix : CenterFix; of an unresolved body or a disk; of a ``PositionFix`` the direction alone
    image : Image; with an attitude and an epoch; the covariance of its attitude goes into the line
    camera : Camera

    Returns
    -------
    Sightline or Failure
        Reasons: no_attitude, no_epoch.

    Notes
    -----
    The covariance is the sum of the errors of the image position and of the camera model. Errors of the camera that the
    lines of an image share are taken as if each line had its own.
    """
    covariance_px2 = fix.covariance_px2
    if fix.parts:
        covariance_px2 = sum_parts(fix.parts, (*IN_IMAGE, Cause.CAMERA))[:2, :2]
    return sightline_of_pixel(fix.target, fix.center_px, covariance_px2, image, camera)


def sightline_of_pixel(
    target: str, center_px: ArrayLike, covariance_px2: ArrayLike, image: Image, camera: Camera
) -> Sightline | Failure:
    """Convert a position in an image into a line of sight.

    Parameters
    ----------
    target : str
    center_px : (2,), px
    covariance_px2 : (2, 2), px^2
    image : Image; with an attitude and an epoch
    camera : Camera

    Returns
    -------
    Sightline or Failure
        Reasons: no_attitude, no_epoch, out_of_frame (the camera model has no direction there).

    Raises
    ------
    InputError
        A shape is wrong, or a value is not finite.
    """
    turn, et = image.camera_from_inertial, image.et
    if turn is None:
        return Failure(Reason.NO_ATTITUDE, f"{image.name}: no attitude, so no direction of {target}: solve the stars")
    if et is None:
        return Failure(Reason.NO_EPOCH, f"{image.name}: no epoch, so it is not known where {target} was")
    center = as_finite(center_px, (2,), f"{target}: center_px")
    spread = as_finite(covariance_px2, (2, 2), f"{target}: covariance_px2")
    vector = camera.model.unproject(center)
    if not np.isfinite(vector).all():
        return Failure(Reason.OUT_OF_FRAME, f"{image.name}: the camera model sees nothing at pixel {center.tolist()}")
    direction = unit(vector)
    across = (np.eye(3) - np.outer(direction, direction)) @ camera.model.unproject_jacobian(center)
    turned = turn.inv().as_matrix() @ across / np.linalg.norm(vector)
    attitude = np.zeros((3, 3))
    if image.attitude_covariance_rad2 is not None:
        attitude = turn.inv().as_matrix() @ image.attitude_covariance_rad2 @ turn.as_matrix()
    return Sightline(
        target=target,
        image=image.name,
        et=et,
        direction_inertial=unit(rotate(turn.inv(), direction)),
        covariance_rad2=symmetric(turned @ spread @ turned.T),
        covariance_attitude_rad2=symmetric(attitude),
    )


def without_aberration(sightlines: Sequence[Sightline], velocity_km_s: ArrayLike) -> tuple[Sightline, ...]:
    """Take stellar aberration out of lines of sight. ``velocity_km_s`` in ICRF axes."""
    velocity = as_finite(velocity_km_s, (3,), "velocity_km_s")
    return tuple(
        dataclasses.replace(
            line, direction_inertial=unit(aberrate(line.direction_inertial, -velocity)), aberration=False
        )
        if line.aberration
        else line
        for line in sightlines
    )


@dataclass(frozen=True, slots=True, eq=False)
class StarEphemeris(Value):
    """A star with a parallax as a position in space, to be triangulated from like a planet.

    Parameters
    ----------
    star : StarTable; one star, with a parallax above zero
    origin : str; NAIF name of the origin of positions: parallaxes refer to the solar system barycenter

    Raises
    ------
    InputError
        The table has not one star, or it has no parallax.

    Notes
    -----
    A catalog gives the direction of a star from the barycenter, so that its position at the time of emission arrives
    a light time later. Motion is a straight line in the times of arrival, as in the catalog; the neglected change of
    the star's light time is 1e-4 of the motion.
    """

    star: StarTable
    origin: str = BARYCENTER

    def __post_init__(self) -> None:
        require(len(self.star) == 1, f"a star ephemeris needs one star, got {len(self.star)}")
        parallax = float(self.star.parallax_mas[0])
        require(parallax > 0.0, f"a star ephemeris needs a parallax above zero, got {parallax} mas")
        Value.__post_init__(self)

    def state(self, et: float) -> tuple[Float, Float]:
        """Position (3,), km, and velocity (3,), km/s, ICRF axes, when light leaves the star."""
        star = self.star
        distance_km = AU_KM / (float(star.parallax_mas[0]) * RAD_PER_MAS)
        radial = direction_from_radec(star.ra_deg[0], star.dec_deg[0])
        east, north = east_north(star.ra_deg[0], star.dec_deg[0])
        motion = (star.pm_ra_mas_yr[0] * east + star.pm_dec_mas_yr[0] * north) * RAD_PER_MAS
        velocity = distance_km * motion / SECONDS_PER_JULIAN_YEAR + star.radial_velocity_km_s[0] * radial
        epoch = float(et_of_julian_year(float(star.epoch_jyear[0])))
        position = distance_km * radial
        for _ in range(_STAR_STEPS):
            arrival = et + float(np.linalg.norm(position)) / SPEED_OF_LIGHT_KM_S
            position = distance_km * radial + velocity * (arrival - epoch)
        return position, velocity

    def inertial_from_body(self, et: float) -> Rotation:
        """Orientation of the inertial axes: the identity."""
        return Rotation.identity()
