"""Other readings of an a priori attitude and of an image, for the cause of stars that match nowhere near it.

They are tried after the identification failed, and named only: no attitude rests on them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

from giantlike.camera import Camera
from giantlike.core.arrays import Float, Mask
from giantlike.core.frames import INERTIAL_FROM_ECLIPTIC
from giantlike.core.outcomes import Failure, Reason
from giantlike.stars.apriori import Identification, identify_apriori
from giantlike.stars.field import Sky
from giantlike.stars.options import StarOptions
from giantlike.stars.refine import depth_for

_BRIGHTEST = 200  # detections that are matched, brightest first: twice those that vote for a shift
_ALONG_AXIS = 0.999  # smallest component along an axis, to 2.6 degrees, from which a rotation is named by it


@dataclass(frozen=True, slots=True)
class _Reading:
    """An a priori attitude, or the pixels of an image, read in another way."""

    text: str
    camera_from_inertial: Rotation
    flip: Float = field(default_factory=lambda: np.ones(2))  # factors (2,) of x and y about the center of the image


def attitude_readings(apriori: Rotation) -> list[_Reading]:
    """Other attitudes that a header with an a priori attitude may mean."""
    x, y, z, w = apriori.as_quat()
    scalar_first = Rotation.from_quat([y, z, w, x])
    return [
        _Reading("with the a priori attitude taken as ECLIPJ2000", apriori * INERTIAL_FROM_ECLIPTIC.inv()),
        _Reading("with the a priori attitude turned from J2000 to ECLIPJ2000", apriori * INERTIAL_FROM_ECLIPTIC),
        _Reading("with the inverse of the a priori attitude", apriori.inv()),
        _Reading("with the a priori quaternion read with the scalar first", scalar_first),
        _Reading("with the inverse of the a priori quaternion read with the scalar first", scalar_first.inv()),
        *(
            _Reading(
                f"with a roll of {angle} deg of the a priori attitude",
                Rotation.from_euler("z", angle, degrees=True) * apriori,
            )
            for angle in (90, 180, -90)
        ),
    ]


def _pixel_readings(apriori: Rotation) -> Iterator[_Reading]:
    yield _Reading("mirrored: with the rows reversed (images.bottom_up)", apriori, np.array([1.0, -1.0]))
    yield _Reading("mirrored: with the columns reversed", apriori, np.array([-1.0, 1.0]))


def find_reading(points_px: Float, camera: Camera, sky: Sky, apriori: Rotation, options: StarOptions) -> Failure | None:
    """Failure that names the reading with which the detections (m, 2) match stars; None if they match with none."""
    points = points_px[:_BRIGHTEST]
    for reading in (*attitude_readings(apriori), *_pixel_readings(apriori)):
        around = sky.field(
            camera, reading.camera_from_inertial, margin_px=options.max_pixel_distance, count=depth_for(len(points))
        )
        flipped = camera.center_px + reading.flip * (points - camera.center_px)
        found = identify_apriori(
            around.directions_inertial, flipped, camera, reading.camera_from_inertial, options=options
        )
        if isinstance(found, Identification):
            reason = Reason.WRONG_APRIORI if bool((reading.flip > 0.0).all()) else Reason.MIRRORED_IMAGE
            return Failure(reason, f"{reading.text} {len(found.matches)} stars match; as given they do not")
    return None


def text_of_error(apriori: Rotation, solved: Rotation, within_rad: float) -> str:
    """Size and axis of the error of an a priori attitude, and the reading that explains it to within an angle."""
    angle_deg = math.degrees((solved * apriori.inv()).magnitude())
    inertial, camera = (turn.as_rotvec() for turn in (apriori.inv() * solved, solved * apriori.inv()))
    text = f"the a priori attitude is wrong by {angle_deg:.4g} deg about {_axis(inertial, camera)}"
    for reading in attitude_readings(apriori):
        if (solved * reading.camera_from_inertial.inv()).magnitude() < within_rad:
            return f"{text}: {reading.text} it is correct"
    return text


def _axis(inertial: Any, camera: Any) -> str:
    """Axis of a rotation vector in words, in the frame in which it is a coordinate axis, or in the camera's."""
    for frame, vector in (("inertial", inertial), ("camera", camera)):
        direction = vector / np.linalg.norm(vector)
        largest = int(np.argmax(np.abs(direction)))
        if abs(direction[largest]) > _ALONG_AXIS:
            return f"the {frame} {'xyz'[largest]} axis"
    return f"the camera axis ({', '.join(f'{part:.3f}' for part in direction)})"


_FALSE_ALARM = 1e-3  # rate of false alarms, as for fixes of bodies
_REACH_SIGMAS, _ROOM_PX = 3, 2
"""Half width of the windows: standard deviations of the point spread function, and px for the shift."""
_LEAST_STARS = 8  # minimum number of stars: scatter estimated from fewer is too uncertain


def is_interlaced(
    pixels: Float, bad: Mask | None, points_px: Float, background_dn: Float, psf_sigma_px: float, sigma_px: float
) -> bool:
    """Return True where odd and even rows disagree on the positions of stars by more than the sigma of an attitude.

    ``sigma_px``: of the attitude along rows, which half of the shift displaces.
    """
    shifts = _row_shifts(pixels, bad, points_px, background_dn, math.ceil(_REACH_SIGMAS * psf_sigma_px) + _ROOM_PX)
    if len(shifts) < _LEAST_STARS:
        return False
    shift = float(np.median(shifts))
    scatter = 1.4826 * float(np.median(np.abs(shifts - shift)))
    sigma = math.hypot(2.0 * sigma_px, math.sqrt(0.5 * math.pi / len(shifts)) * scatter)
    return abs(shift) > float(stdtrit(len(shifts) - 1, 1.0 - 0.5 * _FALSE_ALARM)) * sigma


def _row_shifts(pixels: Float, bad: Mask | None, points_px: Float, background_dn: Float, reach: int) -> Float:
    """Centroid in odd rows minus that in even rows (k,), px, of the stars whose windows lie in the frame."""
    rows, columns = pixels.shape
    middle = np.rint(points_px).astype(int)
    inside = np.all((middle >= reach) & (middle < np.array([columns, rows]) - reach), axis=1)
    middle, steps = middle[inside], np.arange(-reach, reach + 1)
    at = middle[:, 1, None, None] + steps[:, None], middle[:, 0, None, None] + steps
    light = np.asarray(pixels[at], dtype=np.float64) - background_dn[inside, None, None]
    whole = np.ones(len(light), dtype=bool) if bad is None else ~bad[at].any(axis=(1, 2))
    odd = (at[0] % 2 == 1).astype(np.float64)
    flux, moment = (light * odd).sum(axis=(1, 2)), (light * odd * steps).sum(axis=(1, 2))
    other_flux = light.sum(axis=(1, 2)) - flux
    other_moment = (light * steps).sum(axis=(1, 2)) - moment
    seen = whole & (flux > 0.0) & (other_flux > 0.0)
    return np.asarray(moment[seen] / flux[seen] - other_moment[seen] / other_flux[seen])
