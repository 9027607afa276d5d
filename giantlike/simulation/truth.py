"""FITS files of simulated images with their truth in header keywords and extensions.

A campaign reads only the a priori keywords that real images have too (epoch, exposure, ``GL_Q*``, ``GL_OBS*``). The
truth is in keywords that begin with ``GT_`` and, for the targets, ``T1_``, ``T2_``, ...:

==============================  =====================================================================================
``GT_QX`` .. ``GT_QW``          true camera_from_inertial at mid-exposure, scalar last
``GT_RATEX`` .. ``GT_RATEZ``    turn of the camera about its own axes, rad/s
``GT_PSF``, ``GT_SEED``         sigma of the PSF, px; seed of everything random
``GT_GAIN``, ``GT_READ``, ...   gain, read noise, bias, saturation of the detector
``GT_NTGT``                     number of targets in view
``T1_NAME``, ``T1_SHAPE``       name of the first, and the beginning of the SHA-256 of its shape
``T1_X`` .. ``T1_Z``            camera to body center, km, inertial axes, apparent
``T1_QX`` .. ``T1_QW``          body_from_inertial when the light left it, scalar last
``T1_SUNX`` .. ``T1_SUNZ``      unit vector from body to Sun, inertial
``T1_PX``, ``T1_PY``            where its center appears, px from 0
==============================  =====================================================================================

Extensions: ``EXPECTED`` (mean electrons without noise or saturation), ``COSMIC`` (electrons left by cosmic rays),
``STARS`` (table: id, x_px, y_px, magnitude, electrons). On request also the surface point at the center of every pixel:
``BODY`` (number as in the keywords, 0: none), ``FACET``, ``RANGE`` (km), and ``INCIDENCE``, ``EMISSION``, ``PHASE``,
``LONGITUDE``, ``LATITUDE`` (degrees).
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.core.arrays import Float
from giantlike.core.frames import quaternion_xyzw, rotate
from giantlike.core.version import VERSION
from giantlike.io import navigation_header, write_fits
from giantlike.io.fits_keywords import Card
from giantlike.io.geometry_table import GeometryRow
from giantlike.ray_tracing import trace_backplanes
from giantlike.scene import TargetGeometry
from giantlike.simulation.images import SimulatedImage
from giantlike.simulation.stars import DetectorStars

_AXES = ("X", "Y", "Z")
_HASH_DIGITS = 16  # of the SHA-256 of a shape: 64 bits tell shapes apart and fit a keyword
_STAR_COLUMNS = np.dtype([("id", "i8"), ("x_px", "f8"), ("y_px", "f8"), ("magnitude", "f8"), ("electrons", "f8")])


def write_simulated(
    path: str | Path, taken: SimulatedImage, camera: Camera, *, extensions: bool = True, backplanes: bool = False
) -> None:
    """Write a simulated image with its truth; its a priori keywords hold the truth too."""
    shot = taken.shot
    observer = shot.observer
    header = navigation_header(
        epoch=shot.epoch,
        exposure_s=shot.exposure_s,
        camera_from_inertial=shot.camera_from_inertial,
        observer_position_km=None if observer is None else observer.position_km,
        observer_velocity_km_s=None if observer is None else observer.velocity_km_s,
    )
    parts = truth_extensions(taken) if extensions else {}
    if backplanes and taken.bodies:
        parts |= backplane_extensions(taken, camera)
    write_fits(path, taken.image.pixels, header={**header, **truth_header(taken, camera)}, extensions=parts)


def truth_header(taken: SimulatedImage, camera: Camera) -> dict[str, Card]:
    """Header cards of the truth, by keyword; the docstring of the module lists them."""
    shot, detector = taken.shot, camera.detector
    words = taken.seed if isinstance(taken.seed, tuple) else (taken.seed,)
    cards = {
        "ORIGIN": Card(f"giantlike {VERSION}", "simulated image"),
        "INSTRUME": Card(camera.name, "camera"),
        "GT_SEED": Card(" ".join(map(str, words)), "seed of everything random"),
        "GT_PSF": Card(0.0 if camera.psf is None else camera.psf.sigma_px, "[px] sigma of the PSF"),
        "GT_GAIN": Card(detector.gain_e_per_dn, "[electron/DN]"),
        "GT_READ": Card(detector.read_noise_e, "[electron] read noise"),
        "GT_BIAS": Card(detector.bias_dn, "[DN]"),
    }
    if math.isfinite(detector.saturation_dn):
        cards["GT_SATUR"] = Card(detector.saturation_dn, "[DN] saturation")
    cards |= _rotation("GT_Q", shot.camera_from_inertial, "true camera_from_inertial, scalar last")
    cards |= _vector("GT_RATE", shot.angular_rate_camera_rad_s, "[rad/s] turn of the camera, its axes")
    cards["GT_NTGT"] = Card(len(taken.bodies), "targets in view")
    for number, (name, geometry) in enumerate(taken.bodies.items(), start=1):
        cards |= _target(f"T{number}_", name, geometry, shot.camera_from_inertial, camera)
    return cards


def truth_extensions(taken: SimulatedImage) -> dict[str, NDArray[Any]]:
    """Extensions by EXTNAME: mean charge, cosmic rays and the table of stars."""
    return {
        "EXPECTED": taken.readout.expected_e.astype(np.float32),
        "COSMIC": taken.readout.cosmic_e.astype(np.float32),
        "STARS": _star_table(taken.stars, taken.star_electrons),
    }


def backplane_extensions(taken: SimulatedImage, camera: Camera) -> dict[str, NDArray[Any]]:
    """Backplanes at mid-exposure by EXTNAME: body (from 1, as in the header), facet, range (km), angles (degrees)."""
    planes = trace_backplanes(
        [geometry.body() for geometry in taken.bodies.values()],
        camera.model,
        sun_direction_camera=[geometry.sun_direction_camera for geometry in taken.bodies.values()],
        columns=camera.columns,
        rows=camera.rows,
    )
    angles = {
        "INCIDENCE": planes.incidence_rad,
        "EMISSION": planes.emission_rad,
        "PHASE": planes.phase_rad,
        "LONGITUDE": planes.longitude_rad,
        "LATITUDE": planes.latitude_rad,
    }
    return {
        "BODY": np.where(planes.body < 0, 0, planes.body + 1).astype(np.int32),
        "FACET": planes.facet,
        "RANGE": planes.range_km,
        **{name: np.degrees(angle).astype(np.float32) for name, angle in angles.items()},
    }


def geometry_rows(taken: SimulatedImage) -> list[GeometryRow]:
    """True geometry of an image as rows of a geometry table: one per target in view, or one without a target."""
    row = GeometryRow(
        file=taken.shot.name,
        epoch=taken.shot.epoch,
        exposure_s=taken.shot.exposure_s,
        camera_from_inertial=taken.shot.camera_from_inertial,
        observer=taken.shot.observer,
    )
    inertial_from_camera = taken.shot.camera_from_inertial.inv()
    rows = [
        dataclasses.replace(
            row,
            target=name,
            target_position_inertial_km=rotate(inertial_from_camera, body.position_camera_km),
            body_from_inertial=(inertial_from_camera * body.camera_from_body).inv(),
            sun_direction_inertial=rotate(inertial_from_camera, body.sun_direction_camera),
        )
        for name, body in taken.bodies.items()
    ]
    return rows or [row]


def _target(
    prefix: str, name: str, geometry: TargetGeometry, camera_from_inertial: Rotation, camera: Camera
) -> dict[str, Card]:
    inertial_from_camera = camera_from_inertial.inv()
    body_from_inertial = geometry.camera_from_body.inv() * camera_from_inertial
    center = camera.model.project(geometry.position_camera_km)
    cards = {
        f"{prefix}NAME": Card(name, "target"),
        f"{prefix}SHAPE": Card(geometry.target.shape.sha256[:_HASH_DIGITS], "SHA-256 of its shape"),
    }
    cards |= _vector(prefix, rotate(inertial_from_camera, geometry.position_camera_km), "[km] from camera, apparent")
    cards |= _rotation(f"{prefix}Q", body_from_inertial, "body_from_inertial, scalar last")
    cards |= _vector(
        f"{prefix}SUN", rotate(inertial_from_camera, geometry.sun_direction_camera), "to the Sun, inertial"
    )
    if np.isfinite(center).all():
        cards |= {f"{prefix}P{axis}": Card(float(center[k]), "[px] center, from 0") for k, axis in enumerate("XY")}
    return cards


def _vector(prefix: str, vector: Float, comment: str) -> dict[str, Card]:
    return {f"{prefix}{axis}": Card(float(vector[k]), comment) for k, axis in enumerate(_AXES)}


def _rotation(prefix: str, rotation: Rotation, comment: str) -> dict[str, Card]:
    numbers = quaternion_xyzw(rotation).tolist()
    return {f"{prefix}{axis}": Card(number, comment) for axis, number in zip((*_AXES, "W"), numbers, strict=True)}


def _star_table(stars: DetectorStars, electrons: Float) -> NDArray[Any]:
    table = np.zeros(len(electrons), dtype=_STAR_COLUMNS)
    table["id"], table["magnitude"], table["electrons"] = stars.ids, stars.magnitudes, electrons
    table["x_px"], table["y_px"] = stars.points_px.T
    return table
