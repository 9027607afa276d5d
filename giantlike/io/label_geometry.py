"""Geometry in the labels of images: position and orientation of the target, direction of the Sun.

Galileo SSI and NEAR MSI labels hold it. Voyager labels hold none: their frame count leads to it by SPICE kernels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, unit
from giantlike.core.errors import InputError
from giantlike.core.frames import direction_from_radec, rotate, rotation_from_xyzw
from giantlike.io.decoded import HeaderValue
from giantlike.io.viewing_geometry import StatedGeometry, ViewingGeometry

MSI_FROM_NEAR = Rotation.from_matrix([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
"""Axes of NEAR MSI from the spacecraft's axes: boresight along +X, samples along +Z, lines along -Y."""


def geometry_of_label(header: Mapping[str, HeaderValue], model: CameraModel) -> StatedGeometry | None:
    """Read the geometry that a label states.

    ``header``: ``metadata`` of an image; ``model``: of the camera, for the rotation that shows the target at the pixel
    that the label states; returns None where the label is of another mission or holds no geometry. Raises InputError:
    an item of the label is not a number.

    Notes
    -----
    Galileo SSI: ``SUB_SPACECRAFT_SAMPLE`` and ``SUB_SPACECRAFT_LINE`` (the pixel of the point below the spacecraft, the
    first being 1), ``TARGET``, ``TARGET_CENTER_DISTANCE``, planetocentric latitude and west longitude below the
    spacecraft and the Sun (``SUB_SPACECRAFT_LATITUDE``, ``SUB_SPACECRAFT_LONGITUDE``, ``SUB_SOLAR_LATITUDE``,
    ``SUB_SOLAR_LONGITUDE``), and ``NORAZ``, the azimuth of the north pole clockwise from the right of the image. The
    pixel is as good as the pointing was, about 10 px. NEAR MSI: positions of spacecraft and target from the Sun and the
    spacecraft quaternion, J2000 (``NEAR-019`` to ``NEAR-029``), and the name of the target (``NEAR-047``).
    """
    if "SUB_SPACECRAFT_SAMPLE" in header:
        return _galileo(header, model)
    if "NEAR-019" in header:
        return _near(header)
    return None


def _galileo(header: Mapping[str, HeaderValue], model: CameraModel) -> StatedGeometry:
    def number(key: str) -> float:
        return _number(header, key)

    viewer, sun = (
        direction_from_radec(-number(f"{name}_LONGITUDE"), number(f"{name}_LATITUDE"))
        for name in ("SUB_SPACECRAFT", "SUB_SOLAR")
    )
    return ViewingGeometry(
        target=str(header["TARGET"]),
        center_px=np.array([number("SUB_SPACECRAFT_SAMPLE"), number("SUB_SPACECRAFT_LINE")]) - 1.0,
        range_km=number("TARGET_CENTER_DISTANCE"),
        north_azimuth_rad=math.radians(number("NORAZ")),
        observer_direction_body=viewer,
        sun_direction_body=sun,
    ).in_camera(model)


def _near(header: Mapping[str, HeaderValue]) -> StatedGeometry:
    def vector(*items: int) -> Float:
        return np.array([_number(header, f"NEAR-{item:03d}") for item in items])

    scalar_last = vector(20, 21, 22, 19)
    near_from_inertial = rotation_from_xyzw(unit(scalar_last), "NEAR-019 to NEAR-022")
    camera_from_inertial = MSI_FROM_NEAR * near_from_inertial
    spacecraft_km, target_km = vector(23, 24, 25), vector(27, 28, 29)
    return StatedGeometry(
        target=str(header["NEAR-047"]).strip(),
        position_camera_km=rotate(camera_from_inertial, target_km - spacecraft_km),
        sun_direction_camera=rotate(camera_from_inertial, -unit(target_km)),
        camera_from_inertial=camera_from_inertial,
    )


def _number(header: Mapping[str, HeaderValue], key: str) -> float:
    try:
        return float(str(header[key]))
    except (KeyError, ValueError) as error:
        raise InputError(f"label: {key} must be a number, got {header.get(key)!r}") from error
