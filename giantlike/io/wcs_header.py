"""Attitudes as FITS headers with world coordinates (TAN-SIP), one file per image, as plate solvers write them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from scipy.spatial.transform import Rotation

from giantlike.camera_models import CameraModel
from giantlike.core.errors import DataError
from giantlike.core.time import time_from_et, utc_text
from giantlike.core.version import VERSION
from giantlike.io.camera_sip import sip_header


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
) -> WcsFit:
    """Write world coordinates as a FITS file that is only a header.

    The pixels are those of the image as stored: where rows are stored from the bottom, astropy and DS9 show the same.

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
    header.update(fitted.cards)
    try:
        fits.PrimaryHDU(header=header).writeto(path, overwrite=True)
    except OSError as error:
        raise DataError(Path(path), f"cannot be written: {error.strerror or error}") from error
    return WcsFit(max_px=fitted.max_px, rms_px=fitted.rms_px)
