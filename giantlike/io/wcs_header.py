"""Attitudes to and from FITS headers with world coordinates (TAN-SIP), as plate solvers write them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera_models import CameraModel
from giantlike.camera_models.convert import frame_grid
from giantlike.core.errors import DataError, InputError
from giantlike.core.time import time_from_et, utc_text
from giantlike.core.version import VERSION
from giantlike.io.camera_sip import camera_of_sip, sip_header

_NODES = 21
_SIP_TERM = re.compile(r"(?P<letter>[AB])P?_(?P<column>[0-9])_(?P<row>[0-9])")


@dataclass(frozen=True, slots=True, kw_only=True)
class WcsFit:
    """What the polynomials of a header lose against the camera model: px, over the frame."""

    max_px: float
    rms_px: float


def write_wcs(
    path: str | Path,
    model: CameraModel,
    *,
    columns: int,
    rows: int,
    camera_from_inertial: Rotation,
    et: float | None = None,
    name: str = "",
    order: int = 5,
    bottom_up: bool = False,
) -> WcsFit:
    """Write world coordinates as a FITS file that is only a header, for the pixels of the image as stored.

    Parameters
    ----------
    path : path-like
    model : CameraModel
    columns, rows : int
    camera_from_inertial : Rotation
    et : float, optional, TDB seconds past J2000
        Mid-exposure, for ``DATE-AVG``.
    name : str
        Of the image, for ``FILENAME``.
    order : int
        Of the polynomials, 2 to 9.
    bottom_up : bool
        Whether the rows of the image were turned around on reading (:meth:`giantlike.Image.open`).

    Returns
    -------
    WcsFit

    Raises
    ------
    InputError
        A tangent plane cannot show the frame, or the order is out of range.
    DataError
        The file cannot be written.
    """
    from astropy.io import fits

    fitted = sip_header(model, columns=columns, rows=rows, camera_from_inertial=camera_from_inertial, order=order)
    header = fits.Header()
    header["CREATOR"] = f"giantlike {VERSION}"
    if name:
        header["FILENAME"] = name.encode("ascii", "replace").decode("ascii")
    if et is not None:
        epoch = time_from_et(et)
        header["DATE-AVG"] = (utc_text(epoch), "mid-exposure, UTC")
        header["MJD-AVG"] = float(epoch.utc.mjd)
    header["IMAGEW"], header["IMAGEH"] = columns, rows
    header["SIPMAX"] = (fitted.max_px, "[pixel] largest error of the polynomials")
    header.update(_stored_from_below(fitted.cards, rows) if bottom_up else fitted.cards)
    try:
        fits.PrimaryHDU(header=header).writeto(path, overwrite=True)
    except OSError as error:
        raise DataError(Path(path), f"cannot be written: {error.strerror or error}") from error
    return WcsFit(max_px=fitted.max_px, rms_px=fitted.rms_px)


def _stored_from_below(cards: Mapping[str, str | int | float], rows: int) -> dict[str, str | int | float]:
    """The same world coordinates for rows in the other order."""
    turned = dict(cards)
    turned["CRPIX2"] = rows + 1 - float(cards["CRPIX2"])
    for key, value in cards.items():
        if key in ("CD1_2", "CD2_2"):
            turned[key] = -float(value)
        elif match := _SIP_TERM.fullmatch(key):
            turns = int(match["row"]) + (match["letter"] == "B")
            turned[key] = -float(value) if turns % 2 else float(value)
    return turned


@dataclass(frozen=True, slots=True, kw_only=True)
class WcsAttitude:
    """Attitude that world coordinates tell of an image.

    Parameters
    ----------
    camera_from_inertial : Rotation
    rms_px : float, px
        How far, root mean square over the frame, the camera model then is from the world coordinates.
    """

    camera_from_inertial: Rotation
    rms_px: float


def attitude_of_wcs(
    header: Mapping[str, Any], model: CameraModel, *, columns: int, rows: int, bottom_up: bool = False
) -> WcsAttitude:
    """Attitude at which a camera model sees the sky where TAN or TAN-SIP world coordinates put it.

    Parameters
    ----------
    header : mapping of str to value
        FITS keywords, such as ``image.metadata``.
    model : CameraModel
    columns, rows : int
    bottom_up : bool
        Whether the rows of the image were turned around on reading (:meth:`giantlike.Image.open`).

    Raises
    ------
    InputError
        There are no such world coordinates, or they show the sky mirrored with the rows as they were read.
    """
    said = camera_of_sip(header, columns=columns, rows=rows)
    if said.camera.rows_reversed != bottom_up:
        advice = "read the image with bottom_up" if said.camera.rows_reversed else "read it as stored"
        raise InputError(f"by its world coordinates the image shows the sky mirrored: {advice}")
    points_px = frame_grid(columns, rows, nodes=_NODES).reshape(-1, 2)
    inertial = said.camera_from_inertial.inv().apply(said.camera.model.unproject(points_px))
    attitude, _ = Rotation.align_vectors(model.unproject(points_px), inertial)
    residuals = model.project(attitude.apply(inertial)) - points_px
    rms = float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))
    return WcsAttitude(camera_from_inertial=attitude, rms_px=rms)


def has_world_coordinates(header: Mapping[str, Any]) -> bool:
    """Whether a header has TAN or TAN-SIP world coordinates."""
    return str(header.get("CTYPE1", "")).startswith("RA---TAN") and "CRVAL1" in header
