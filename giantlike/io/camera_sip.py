"""Camera models from and to FITS headers with a gnomonic projection and SIP distortion (TAN-SIP).

SIP moves pixels, counted from CRPIX, by two polynomials; a linear map takes them to the tangent plane of the sky. FITS
calls the center of the first pixel (1, 1). The keywords are used as astropy.wcs does, which the tests compare with.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.reading import reads
from giantlike.camera_models import CameraModel
from giantlike.camera_models.convert import Conversion, fit_lens, frame_grid
from giantlike.camera_models.registry import lens_class
from giantlike.core.arrays import Float, require, unit
from giantlike.core.errors import InputError
from giantlike.core.frames import direction_from_radec, east_north, radec_from_direction, rotate
from giantlike.core.values import Value
from giantlike.io.mission_frame import ImportedCamera

_FIRST_PIXEL = 1.0  # FITS calls the center of the first pixel so: FITS Standard 4.0, section 8.1
_NODES = 41  # grid points along each side of the frame to which lens and polynomials are fitted, 1681 in all
_ORDERS = range(2, 10)  # the keywords have one digit for each power: Shupe et al., The SIP Convention, 2005


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SipCamera(Value):
    """Camera and attitude of a TAN-SIP header."""

    camera: ImportedCamera  # ``rows_reversed`` for a mirrored array, as sky images stored from the bottom
    camera_from_inertial: Rotation  # attitude, boresight at CRVAL, x along increasing columns
    conversion: Conversion  # differences of the fitted lens from the polynomials, over the frame


@dataclass(frozen=True, slots=True, kw_only=True)
class PosedModel:
    """A camera model with the size of its image and its attitude, to be written as world coordinates."""

    model: CameraModel
    columns: int  # columns, rows: size of the image
    rows: int
    camera_from_inertial: Rotation


@dataclass(frozen=True, slots=True, kw_only=True)
class SipHeader:
    """TAN-SIP keywords of a camera model and an attitude, and the errors of their polynomials."""

    cards: Mapping[str, str | int | float]
    max_px: float  # max_px, rms_px: of the forward polynomials against the model, over the frame
    rms_px: float
    inverse_max_px: float  # of the inverse polynomials (AP, BP) against the forward ones


@reads("a FITS header with TAN-SIP coordinates")
def read_sip_camera(path: str | Path, *, hdu: int = 0, type_name: str = "brown") -> SipCamera:
    """Read camera and attitude from the header of a FITS image."""
    from astropy.io import fits

    header = fits.getheader(path, hdu)
    return camera_of_sip(
        header, columns=header["NAXIS1"], rows=header["NAXIS2"], type_name=type_name, name=Path(path).stem
    )


def camera_of_sip(
    header: Mapping[str, Any], *, columns: int, rows: int, type_name: str = "brown", name: str = "camera"
) -> SipCamera:
    """Fit a lens model to the TAN-SIP keywords of a header."""
    lens = lens_class(type_name)
    for axis, wanted in (("CTYPE1", "RA---TAN"), ("CTYPE2", "DEC--TAN")):
        kind = str(header.get(axis, ""))
        require(kind in (wanted, wanted + "-SIP"), f"{axis} must be {wanted} or {wanted}-SIP, got {kind!r}")
    require(float(header.get("LONPOLE", 180.0)) == 180.0, "LONPOLE must be 180")
    sky_from_px = np.radians(_linear(header))
    reverse = bool(np.linalg.det(sky_from_px) < 0)
    first = np.array([_number(header, "CRPIX1"), _number(header, "CRPIX2")]) - _FIRST_PIXEL
    points_px = frame_grid(columns, rows, nodes=_NODES)
    stored = np.stack([points_px[..., 0], rows - 1 - points_px[..., 1]], -1) if reverse else points_px
    offsets = stored - first
    moved = offsets + np.stack([_polynomial(header, letter, offsets) for letter in "AB"], axis=-1)
    if reverse:
        sky_from_px = sky_from_px * [1.0, -1.0]
        moved = moved * [1.0, -1.0]
        first = np.array([first[0], rows - 1 - first[1]])
    along_x = sky_from_px[:, 0] / np.linalg.norm(sky_from_px[:, 0])
    plane_from_sky = np.array([along_x, [-along_x[1], along_x[0]]])
    plane_from_px = plane_from_sky @ sky_from_px  # upper triangular
    directions = unit(np.concatenate([moved @ plane_from_px.T, np.ones((*moved.shape[:-1], 1))], axis=-1))
    px_from_plane = np.linalg.inv(plane_from_px)
    start = lens(
        fx_px=px_from_plane[0, 0], fy_px=px_from_plane[1, 1], skew_px=px_from_plane[0, 1], cx_px=first[0],
        cy_px=first[1],
    )  # fmt: skip
    model = fit_lens(start, directions.reshape(-1, 3), points_px.reshape(-1, 2))
    ra_deg, dec_deg = _number(header, "CRVAL1"), _number(header, "CRVAL2")
    (east, north), up = east_north(ra_deg, dec_deg), direction_from_radec(ra_deg, dec_deg)
    x = along_x[0] * east + along_x[1] * north
    return SipCamera(
        camera=ImportedCamera(
            name=name, model=model, columns=columns, rows=rows, camera_from_mission=Rotation.identity(),
            rows_reversed=reverse,
        ),
        camera_from_inertial=Rotation.from_matrix(np.array([x, np.cross(up, x), up])),
        conversion=Conversion(model=model, points_px=points_px, residuals_px=model.project(directions) - points_px),
    )  # fmt: skip


def sip_header(posed: PosedModel, *, order: int = 4) -> SipHeader:
    """Fit TAN-SIP keywords to a camera model and an attitude (linear least squares over the frame)."""
    require(order in _ORDERS, f"the order of SIP polynomials is 2 to 9, got {order}")
    model, camera_from_inertial = posed.model, posed.camera_from_inertial
    points_px = frame_grid(posed.columns, posed.rows, nodes=_NODES).reshape(-1, 2)
    directions = model.unproject(points_px)
    require(
        bool((directions[:, 2] > 0).all()),
        "a tangent plane can't show all of this frame: the lens sees too wide an angle",
    )
    boresight_px = model.project([0.0, 0.0, 1.0])
    inertial_from_camera = camera_from_inertial.inv()
    ra_deg, dec_deg = radec_from_direction(rotate(inertial_from_camera, [0.0, 0.0, 1.0]))
    (east, north), up = east_north(ra_deg, dec_deg), direction_from_radec(ra_deg, dec_deg)
    seen = rotate(inertial_from_camera, directions)
    sky = np.degrees(np.stack([seen @ east, seen @ north], axis=-1) / (seen @ up)[:, None])
    scale = max(posed.columns, posed.rows) / 2.0
    powers = [(p, q) for p in range(order + 1) for q in range(order + 1) if 1 <= p + q <= order]
    offsets = points_px - boresight_px
    design = _design(offsets / scale, powers)
    fitted = np.linalg.lstsq(design, sky, rcond=None)[0]
    linear = np.array([fitted[powers.index((1, 0))], fitted[powers.index((0, 1))]]).T  # sky from scaled pixels
    forward = np.linalg.solve(linear, fitted.T).T * scale
    flat = sky @ np.linalg.inv(linear).T  # scaled pixels that the linear map alone would need
    back = np.linalg.lstsq(_design(flat, powers), offsets / scale - flat, rcond=None)[0] * scale
    cards = _cards(ra_deg, dec_deg, boresight_px, linear / scale, order)
    for (p, q), (a, b), (ap, bp) in zip(powers, forward, back, strict=True):
        if p + q > 1:
            cards |= {f"A_{p}_{q}": float(a / scale ** (p + q)), f"B_{p}_{q}": float(b / scale ** (p + q))}
        cards |= {f"AP_{p}_{q}": float(ap / scale ** (p + q)), f"BP_{p}_{q}": float(bp / scale ** (p + q))}
    plane = np.radians(design @ fitted)
    seen = rotate(camera_from_inertial, up + plane[:, :1] * east + plane[:, 1:] * north)
    lost = np.linalg.norm(model.project(seen) - points_px, axis=1)
    at = (design @ fitted) @ np.linalg.inv(linear).T
    inverse = np.linalg.norm(scale * at + _design(at, powers) @ back - offsets, axis=1)
    return SipHeader(
        cards=cards,
        max_px=float(lost.max()),
        rms_px=float(np.sqrt(np.mean(lost**2))),
        inverse_max_px=float(inverse.max()),
    )


def _cards(ra_deg: Float, dec_deg: Float, boresight_px: Float, cd: Float, order: int) -> dict[str, str | int | float]:
    reference = boresight_px + _FIRST_PIXEL
    return {
        "WCSAXES": 2, "CTYPE1": "RA---TAN-SIP", "CTYPE2": "DEC--TAN-SIP", "CUNIT1": "deg", "CUNIT2": "deg",
        "RADESYS": "ICRS", "CRVAL1": float(ra_deg), "CRVAL2": float(dec_deg), "CRPIX1": float(reference[0]),
        "CRPIX2": float(reference[1]), "CD1_1": float(cd[0, 0]), "CD1_2": float(cd[0, 1]), "CD2_1": float(cd[1, 0]),
        "CD2_2": float(cd[1, 1]), "A_ORDER": order, "B_ORDER": order, "AP_ORDER": order, "BP_ORDER": order,
    }  # fmt: skip


def _design(offsets: Float, powers: list[tuple[int, int]]) -> Float:
    """Powers x^p y^q (n, k) of offsets (n, 2)."""
    return np.stack([offsets[:, 0] ** p * offsets[:, 1] ** q for p, q in powers], axis=-1)


def _number(header: Mapping[str, Any], key: str) -> float:
    value = header.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"keyword {key} must be a number, got {value!r}")
    return float(value)


def _linear(header: Mapping[str, Any]) -> Float:
    """CD matrix (2, 2) of the header: degrees on the tangent plane per pixel."""
    names = [["1_1", "1_2"], ["2_1", "2_2"]]
    if any(f"CD{name}" in header for row in names for name in row):
        return np.array([[float(header.get(f"CD{name}", 0.0)) for name in row] for row in names])
    require(not header.get("CROTA2"), "CROTA2 is not supported: CD or PC keywords are needed")
    steps = np.array([_number(header, "CDELT1"), _number(header, "CDELT2")])
    turn = np.array([[float(header.get(f"PC{name}", float(name[0] == name[2]))) for name in row] for row in names])
    return np.asarray(steps[:, None] * turn)


def _polynomial(header: Mapping[str, Any], letter: str, offsets: Float) -> Float:
    order = int(header.get(f"{letter}_ORDER", 0))
    terms = [
        float(header.get(f"{letter}_{p}_{q}", 0.0)) * offsets[..., 0] ** p * offsets[..., 1] ** q
        for p in range(order + 1)
        for q in range(order + 1 - p)
    ]
    return np.sum(terms, axis=0) if order else np.zeros(offsets.shape[:-1])
