"""Attitudes to and from FITS headers with world coordinates (TAN-SIP), as plate solvers write them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.atomic import replacing
from giantlike.camera_models import CameraModel
from giantlike.camera_models.convert import frame_grid
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.core.time import time_from_et, utc_text
from giantlike.core.version import VERSION
from giantlike.io.camera_sip import PosedModel, SipHeader, camera_of_sip, sip_header

_NODES = 21  # directions along each side of the frame to which an attitude is fitted, 441 in all
_SIP_TERM = re.compile(r"(?P<letter>[AB])P?_(?P<column>[0-9])_(?P<row>[0-9])")


def write_wcs(
    path: str | Path,
    posed: PosedModel,
    *,
    et: float | None = None,
    name: str = "",
    order: int = 5,
    bottom_up: bool = False,
) -> SipHeader:
    """Write world coordinates, for the pixels of the image as stored, as a FITS file without data."""
    from astropy.io import fits

    fitted = sip_header(posed, order=order)
    header = fits.Header()
    header["CREATOR"] = f"giantlike {VERSION}"
    if name:
        header["FILENAME"] = name.encode("ascii", "replace").decode("ascii")
    if et is not None:
        epoch = time_from_et(et)
        header["DATE-AVG"] = (utc_text(epoch), "mid-exposure, UTC")
        header["MJD-AVG"] = float(epoch.utc.mjd)
    header["IMAGEW"], header["IMAGEH"] = posed.columns, posed.rows
    header["SIPMAX"] = (fitted.max_px, "[pixel] largest error of the polynomials")
    header.update(_stored_from_below(fitted.cards, posed.rows) if bottom_up else fitted.cards)
    with replacing(path) as part:
        fits.PrimaryHDU(header=header).writeto(part)
    return fitted


def _stored_from_below(cards: Mapping[str, str | int | float], rows: int) -> dict[str, str | int | float]:
    """World coordinates for rows in the other order."""
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
    """Attitude of an image by its world coordinates."""

    camera_from_inertial: Rotation
    rms_px: float  # differences of the camera model at this attitude from the world coordinates, rms over the frame


def attitude_of_wcs(
    header: Mapping[str, Any], model: CameraModel, *, columns: int, rows: int, bottom_up: bool = False
) -> WcsAttitude:
    """Attitude at which a camera model sees the sky where TAN or TAN-SIP world coordinates put it."""
    solved = camera_of_sip(header, columns=columns, rows=rows)
    if solved.camera.rows_reversed != bottom_up:
        advice = "read the image with bottom_up" if solved.camera.rows_reversed else "read it as stored"
        raise InputError(f"by its world coordinates the image shows the sky mirrored: {advice}")
    points_px = frame_grid(columns, rows, nodes=_NODES).reshape(-1, 2)
    inertial = rotate(solved.camera_from_inertial.inv(), solved.camera.model.unproject(points_px))
    attitude, _ = Rotation.align_vectors(model.unproject(points_px), inertial)
    residuals = model.project(rotate(attitude, inertial)) - points_px
    rms = float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))
    return WcsAttitude(camera_from_inertial=attitude, rms_px=rms)


def has_world_coordinates(header: Mapping[str, Any]) -> bool:
    """Return True if a header has TAN or TAN-SIP world coordinates."""
    return str(header.get("CTYPE1", "")).startswith("RA---TAN") and "CRVAL1" in header
