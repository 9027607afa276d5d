"""Backplanes of an image of a run: which point of which body each pixel shows, as FITS cubes with world coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.atomic import replacing
from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.version import VERSION
from giantlike.io.camera_sip import PosedModel, sip_header
from giantlike.ray_tracing import Backplanes, trace_backplanes
from giantlike.viewer.session import SeenImage, Session, chosen_fix

PLANES: Mapping[str, str] = MappingProxyType(
    {
        "body": "number of the body, from 0; -1 off all",
        "range": "range from the camera, km",
        "phase": "phase angle, deg",
        "incidence": "incidence angle, deg",
        "emission": "emission angle, deg",
        "latitude": "planetocentric latitude, deg",
        "longitude": "east longitude, deg",
        "shadowed": "1 where no sunlight falls",
        "resolution": "resolution across the line of sight, km/px",
        "oblique_resolution": "resolution over cos(emission), km/px",
        "slope": "normal to direction from center, deg",
        "slope_azimuth": "downhill, clockwise from north, deg",
    }
)
"""Planes of a cube in their order, with unit and meaning."""


_HORIZON_DEG = 90.0
_BY_DAY = 0.5  # minimum fraction of a piece of a terminator that borders on sunlit pixels
_LEAST_PIECE = 0.05  # minimum extent of a drawn piece of a terminator, relative to the longest


def backplanes_of(session: Session, file: str, *, estimator: str | None = None, predicted: bool = False) -> Backplanes:
    """Trace the backplanes of an image, each body where a fix has it.

    Parameters
    ----------
    session : Session
    file : str; name of the image
    estimator : str, optional; whose fix; default: the best one, and the prediction where there is none
    predicted : bool; the prediction in any case

    Returns
    -------
    Backplanes
        Bodies are numbered in the order of :meth:`Session.geometry`.

    Raises
    ------
    InputError
        No target has a geometry in this image, or the estimator did not run.
    DataError
        The campaign or the image cannot be read.
    """
    seen, geometry = session.seen(file), session.geometry(file)
    if not geometry:
        raise InputError(f"{file}: no target has a known geometry in this image")
    bodies = []
    for name, known in geometry.items():
        fix = None if predicted else chosen_fix(seen, name, estimator)
        bodies.append(known.body(session.position_camera_km(known, fix)))
    return trace_backplanes(
        bodies,
        session.camera.model,
        sun_direction_camera=np.array([known.sun_direction_camera for known in geometry.values()]),
        columns=seen.record.columns,
        rows=seen.record.rows,
    )


def with_terminators(session: Session, seen: SeenImage, planes: Backplanes) -> SeenImage:
    """Add the lines of an image where the Sun is at the horizon of the surface."""
    from matplotlib.figure import Figure

    found: dict[str, tuple[Float, ...]] = {}
    for number, name in enumerate(session.geometry(seen.record.file)):
        height = np.where(planes.body == number, np.degrees(planes.incidence_rad), np.nan)
        if not (np.nanmin(height, initial=np.inf) < _HORIZON_DEG < np.nanmax(height, initial=-np.inf)):
            continue
        lines = Figure().add_subplot().contour(np.ma.masked_invalid(height), levels=[_HORIZON_DEG]).allsegs[0]
        day = ((planes.body == number) & (height < _HORIZON_DEG) & ~planes.shadowed).astype(np.uint8)
        near = cv2.dilate(day, np.ones((3, 3), np.uint8)) > 0
        lines = [line for line in lines if np.mean(near[tuple(np.rint(line).astype(int).T[::-1])]) > _BY_DAY]
        sizes = [float(np.ptp(line, axis=0).max()) for line in lines]
        least = max(_LEAST_PIECE * max(sizes, default=0.0), 1.0)
        found[name] = tuple(line for line, size in zip(lines, sizes, strict=True) if size >= least)
    return replace(seen, terminators=found)


def values_at(planes: Backplanes, pixel: tuple[int, int] | None = None) -> dict[str, Float]:
    """Planes by name, of all pixels or of one (row, column); NaN off all bodies, where the body is -1."""
    at: Any = ...
    if pixel is not None:
        window, at = tuple(slice(place, place + 1) for place in pixel), (0, 0)
        planes = Backplanes(**{field.name: getattr(planes, field.name)[window] for field in fields(Backplanes)})
    values = {
        "body": planes.body[at],
        "range": planes.range_km[at],
        "phase": np.degrees(planes.phase_rad[at]),
        "incidence": np.degrees(planes.incidence_rad[at]),
        "emission": np.degrees(planes.emission_rad[at]),
        "latitude": np.degrees(planes.latitude_rad[at]),
        "longitude": np.degrees(planes.longitude_rad[at]),
        "shadowed": np.where(planes.body[at] >= 0, planes.shadowed[at].astype(float), np.nan),
        "resolution": planes.resolution_km[at],
        "oblique_resolution": planes.oblique_resolution_km[at],
        "slope": np.degrees(planes.slope_rad[at]),
        "slope_azimuth": np.degrees(planes.slope_azimuth_rad[at]),
    }
    return {name: np.asarray(values[name], dtype=np.float64) for name in PLANES}


def cube_of(planes: Backplanes) -> Float:
    """Planes as one array. Returns (p, rows, columns)."""
    return np.stack(list(values_at(planes).values()))


def write_backplanes(
    path: Path, session: Session, file: str, *, estimator: str | None = None, predicted: bool = False
) -> None:
    """Write backplanes, as of :func:`backplanes_of`, as a FITS cube with their names and world coordinates."""
    from astropy.io import fits

    planes = backplanes_of(session, file, estimator=estimator, predicted=predicted)
    header = fits.Header()
    header["CREATOR"] = f"giantlike {VERSION}"
    header["IMAGE"] = Path(file).name.encode("ascii", "replace").decode("ascii")
    for number, (name, meaning) in enumerate(PLANES.items(), start=1):
        header[f"PLANE{number}"] = (name, meaning)
    for number, name in enumerate(session.geometry(file)):
        header[f"BODY{number}"] = name
    header.update(_world_coordinates(session, file, planes.body.shape))
    with replacing(path) as part:
        fits.PrimaryHDU(cube_of(planes).astype(np.float32), header=header).writeto(part)


def _world_coordinates(session: Session, file: str, shape: tuple[int, ...]) -> Mapping[str, str | int | float]:
    rotation: Rotation = session.require_attitude(file)
    posed = PosedModel(model=session.camera.model, camera_from_inertial=rotation, columns=shape[1], rows=shape[0])
    return sip_header(posed).cards
