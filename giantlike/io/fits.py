"""FITS images in and out."""

from __future__ import annotations

import io
import math
import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from giantlike._system.atomic import write_bytes_atomic
from giantlike._system.child import in_child
from giantlike._system.reading import check, reads
from giantlike.core.arrays import as_finite, as_image, require
from giantlike.core.errors import InputError
from giantlike.core.fits_structure import require_whole_fits
from giantlike.core.frames import quaternion_xyzw
from giantlike.core.time import utc_text
from giantlike.io.decoded import DecodedImage, HeaderValue
from giantlike.io.fits_keywords import (
    OBSERVER_KEYS,
    QUATERNION_KEYS,
    Card,
    fits_attitude,
    fits_epoch,
    fits_exposure_s,
    fits_observer,
)

if TYPE_CHECKING:
    from astropy.time import Time

_STRUCTURAL = re.compile(
    r"SIMPLE|XTENSION|BITPIX|NAXIS\d*|EXTEND|PCOUNT|GCOUNT|GROUPS|BSCALE|BZERO|BLANK|EXTNAME|EXTVER|EXTLEVEL|INHERIT"
    r"|CHECKSUM|DATASUM|TFIELDS|THEAP|T(TYPE|FORM|UNIT|DIM|SCAL|ZERO|NULL)\d+|Z(IMAGE|CMPTYPE|BITPIX|NAXIS\d*|TILE\d+)"
)
_KEYWORD = re.compile(r"[A-Z0-9_-]{1,8}")
WRITTEN_KEYWORDS = {
    "TIMESYS": "time scale of the dates",
    "DATE-AVG": "middle of the exposure",
    "EXPTIME": "[s] exposure time",
    **dict.fromkeys(QUATERNION_KEYS, "camera_from_inertial, scalar last, ICRF"),
    **dict.fromkeys(OBSERVER_KEYS[:3], "[km] spacecraft from SSB, ICRF"),
    **dict.fromkeys(OBSERVER_KEYS[3:], "[km/s] spacecraft from SSB, ICRF"),
}
"""Keywords of :func:`navigation_header` with their comments."""


@reads("a FITS image")
def decode_fits(path: Path, data: bytes, hdu: int | str | None) -> DecodedImage:
    """Decode one image of a FITS file.

    ``BSCALE``, ``BZERO`` and ``BLANK`` are applied (blank pixels become NaN); compressed images are expanded; leading
    axes of length one are dropped. Keywords that the HDU lacks are from the primary one. Cards that break the FITS
    rules, comments and undefined values are left out. Epoch, exposure, attitude: :mod:`giantlike.io.fits_keywords`.
    """
    require_whole_fits(data)
    cards, pixels = _open(data, hdu)
    exposure_s = fits_exposure_s(cards)
    epoch = fits_epoch(cards, exposure_s)
    return DecodedImage(
        pixels=pixels,
        format="fits",
        epoch=epoch,
        exposure_s=exposure_s,
        camera_from_inertial=fits_attitude(cards),
        observer=fits_observer(cards, epoch),
        header={key: card.value for key, card in cards.items()},
    )


def navigation_header(
    *,
    epoch: Time | None = None,
    exposure_s: float | None = None,
    camera_from_inertial: Rotation | None = None,
    observer_position_km: ArrayLike | None = None,
    observer_velocity_km_s: ArrayLike | None = None,
) -> dict[str, HeaderValue]:
    """Header keywords for :func:`write_fits` that :func:`~giantlike.io.image_files.read_image_file` understands.

    Parameters
    ----------
    epoch : Time, optional; mid-exposure: ``DATE-AVG``, to the microsecond, with ``TIMESYS = 'UTC'``
    exposure_s : float, s, optional; ``EXPTIME``
    camera_from_inertial : Rotation, optional; a priori attitude: ``GL_QX, GL_QY, GL_QZ, GL_QW``, scalar last
    observer_position_km, observer_velocity_km_s : (3,), km, km/s, ICRF, optional; barycentric, both or none

    Returns
    -------
    dict of str to str or float
        Values by keyword; only for given arguments.

    Raises
    ------
    InputError
        A value is not finite, or only one of the two observer vectors is given.
    """
    header: dict[str, HeaderValue] = {}
    if epoch is not None:
        header |= {"TIMESYS": "UTC", "DATE-AVG": utc_text(epoch)}
    if exposure_s is not None:
        header["EXPTIME"] = float(as_finite(exposure_s, (1,), "exposure_s")[0])
    if camera_from_inertial is not None:
        header |= dict(zip(QUATERNION_KEYS, quaternion_xyzw(camera_from_inertial).tolist(), strict=True))
    require(
        (observer_position_km is None) == (observer_velocity_km_s is None),
        "observer_position_km and observer_velocity_km_s are needed together",
    )
    if observer_position_km is not None and observer_velocity_km_s is not None:
        position = as_finite(observer_position_km, (3,), "observer_position_km")
        velocity = as_finite(observer_velocity_km_s, (3,), "observer_velocity_km_s")
        header |= dict(zip(OBSERVER_KEYS, [*position.tolist(), *velocity.tolist()], strict=True))
    return header


def write_fits(
    path: str | Path,
    pixels: NDArray[Any],
    *,
    header: Mapping[str, HeaderValue | Card] | None = None,
    extensions: Mapping[str, NDArray[Any]] | None = None,
) -> None:
    """Write an image as the primary HDU of a FITS file, whole or not at all.

    Parameters
    ----------
    path : path-like; replaced when it exists
    pixels : (rows, columns) integer or floating; written in their own type; half precision is widened to float32
    header : mapping, optional
        Keywords (at most eight of A-Z, 0-9, ``_``, ``-``) and plain values, or values with a comment;
        :func:`navigation_header` makes those that are read back. Keywords that describe the structure of the file
        are refused.
    extensions : mapping, optional; more HDUs by EXTNAME: a 2-D array becomes an image, a structured array a table

    Raises
    ------
    InputError
        The pixels are not a 2-D numeric array, or a keyword or value is not allowed in FITS.
    DataError
        The file cannot be written.
    """
    from astropy.io import fits

    array = as_image(pixels, "pixels")
    if array.dtype == np.float16:
        array = array.astype(np.float32)
    unit = fits.PrimaryHDU(array)
    for key, value in (header or {}).items():
        if _KEYWORD.fullmatch(key) is None or _STRUCTURAL.fullmatch(key):
            raise InputError(f"FITS keyword {key!r} is not allowed: at most eight of A-Z, 0-9, _ and -, not structural")
        given, comment = (
            (value.value, value.comment) if isinstance(value, Card) else (value, WRITTEN_KEYWORDS.get(key, ""))
        )
        plain = given.item() if isinstance(given, np.generic) else given
        try:
            unit.header[key] = (plain, comment)
        except ValueError as error:
            raise InputError(f"FITS keyword {key} cannot hold {plain!r}: {error}") from error
    others = [
        fits.BinTableHDU(part, name=name) if part.dtype.names else fits.ImageHDU(part, name=name)
        for name, part in (extensions or {}).items()
    ]
    buffer = io.BytesIO()
    fits.HDUList([unit, *others]).writeto(buffer)
    write_bytes_atomic(path, buffer.getvalue())


def _open(data: bytes, hdu: int | str | None) -> tuple[dict[str, Card], NDArray[Any]]:
    from astropy.io import fits

    with fits.open(io.BytesIO(data), memmap=False, lazy_load_hdus=False) as units:
        index = _choose(units, hdu)
        unit = units[index]
        cards = _cards(unit.header)
        if unit is not units[0] and unit.header.get("INHERIT", True) is not False:
            inherited = _cards(units[0].header).items()
            cards |= {key: card for key, card in inherited if key not in cards and not _STRUCTURAL.fullmatch(key)}
        if isinstance(unit, fits.CompImageHDU):
            pixels = _expand(data, index)
        else:
            counts = _counts(data, unit)
            pixels = np.array(unit.data) if counts is None else counts
    check(pixels.ndim >= 2 and pixels.dtype.kind in "iuf", "its image has no pixels")
    return cards, pixels.reshape(pixels.shape[-2:])


def _counts(data: bytes, unit: Any) -> NDArray[Any] | None:
    """Pixels of 16 or 32 bits without a scale, as detectors count, faster than by astropy; None of all others.

    Where half of their range is added, they are without a sign (FITS standard 4.0, section 4.4.2.5).
    """
    from astropy.io import fits

    header, width = unit.header, unit.header["BITPIX"]
    plain = type(unit) in (fits.PrimaryHDU, fits.ImageHDU)
    whole = plain and width in (16, 32) and header.get("BSCALE", 1) == 1 and "BLANK" not in header
    zero = header.get("BZERO", 0)
    if not whole or isinstance(zero, bool) or zero not in (0, 2 ** (width - 1)):
        return None
    start, shape = unit.fileinfo()["datLoc"], unit.shape
    stored = np.frombuffer(data, f">i{width // 8}", math.prod(shape), start).reshape(shape)
    if zero == 0:
        return stored
    pixels = stored.astype(f"=i{width // 8}").view(f"=u{width // 8}")
    pixels ^= pixels.dtype.type(zero)
    return pixels


def _expand(data: bytes, index: int) -> NDArray[Any]:
    """Pixels of a compressed image, expanded in a separate process: the codes of a damaged one can end it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{index}.fits"
        path.write_bytes(data)
        return in_child(read_unit, [path], libraries=["astropy.io.fits"])["pixels"]


def read_unit(paths: Sequence[Path]) -> dict[str, NDArray[Any]]:
    """Read the pixels of one HDU."""
    from astropy.io import fits

    (path,) = paths
    with fits.open(path, memmap=False) as units:
        return {"pixels": np.array(units[int(path.stem)].data)}


def _choose(units: Any, hdu: int | str | None) -> int:
    """Index of the HDU to read."""
    names = ", ".join(f"{k} {unit.name}".rstrip() for k, unit in enumerate(units))
    images = [k for k, unit in enumerate(units) if unit.is_image and _is_plane(getattr(unit, "shape", ()))]
    if hdu is None:
        check(bool(images), f"no HDU holds a 2-D image; HDUs are {names}")
        return images[0]
    if isinstance(hdu, str):
        chosen = next((k for k, unit in enumerate(units) if unit.name.upper() == hdu.strip().upper()), -1)
    else:
        chosen = hdu
    check(0 <= chosen < len(units), f"there is no HDU {hdu!r}; HDUs are {names}")
    check(chosen in images, f"HDU {hdu!r} holds no 2-D image; HDUs are {names}")
    return chosen


def _is_plane(shape: tuple[int, ...]) -> bool:
    whole = all(isinstance(n, int) and n > 0 for n in shape)  # a damaged header gives texts too
    return whole and len(shape) >= 2 and all(n == 1 for n in shape[:-2])


def _cards(header: Any) -> dict[str, Card]:
    """Keywords with plain values; the first of repeated ones."""
    from astropy.io.fits import VerifyError

    cards: dict[str, Card] = {}
    for card in header.cards:
        try:
            keyword, value, comment = str(card.keyword), card.value, str(card.comment)
        except (VerifyError, ValueError):
            continue
        if isinstance(value, complex):
            value = str(value)
        if keyword not in {"", "COMMENT", "HISTORY"} and isinstance(value, str | bool | int | float):
            cards.setdefault(keyword, Card(value, comment))
    return cards
