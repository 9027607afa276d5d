"""Image files of any supported format: one call, one value."""

from __future__ import annotations

import hashlib
import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike._system.reading import decompress_gzip, reads
from giantlike.core.arrays import Mask
from giantlike.core.errors import DataError, InputError
from giantlike.core.observer import ObserverState
from giantlike.core.pixel_noise import EightBitValues
from giantlike.core.values import Value
from giantlike.io.decoded import DecodedImage, HeaderValue
from giantlike.io.fits import decode_fits
from giantlike.io.isis_cube import CUBE_START, decode_isis_cube
from giantlike.io.label_times import label_epoch, label_exposure_s
from giantlike.io.pds3 import LABEL_START, decode_pds3, image_pointer, parse_pds3
from giantlike.io.pds4 import PRODUCT_START, data_file_of, decode_pds4
from giantlike.io.raster import decode_raster
from giantlike.io.vicar import decode_vicar

if TYPE_CHECKING:
    from astropy.time import Time

_MAGIC = {
    "fits": re.compile(rb"SIMPLE  ="),
    "png": re.compile(rb"\x89PNG\r\n\x1a\n"),
    "jpeg": re.compile(rb"\xff\xd8\xff"),
    "tiff": re.compile(rb"II[*+]\0|MM\0[*+]"),
    "vicar": re.compile(rb"LBLSIZE\s*="),
    "pds3": LABEL_START,
    "pds4": PRODUCT_START,
    "isis": CUBE_START,
}
"""First bytes of the files of each format."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageFile(Value):
    """Image of a file: pixels, mask, and the navigation data of its header.

    Parameters
    ----------
    pixels : (rows, columns) float32 or integer, DN; as stored, native byte order, read-only; bad floats are 0
    mask : (rows, columns) bool; True where a pixel is bad: not finite, blank, or in a line not received
    epoch : Time or None; mid-exposure, where the file determines it
    exposure_s : float or None, s
    camera_from_inertial : Rotation or None; a priori attitude, only from headers that this package wrote
    observer : ObserverState or None; spacecraft state with respect to the solar system barycenter
    header : dict of str to str, int, float or bool; header or label items; empty for PNG, TIFF and JPEG
    format : {'fits', 'png', 'tiff', 'jpeg', 'vicar', 'pds3', 'pds4', 'isis'}
    sha256 : str; of the file that holds the pixels
    path : Path; as it was given
    eight_bit : EightBitValues or None; of 8-bit JPEG and PNG files
    """

    pixels: NDArray[Any]
    mask: Mask
    epoch: Time | None
    exposure_s: float | None
    camera_from_inertial: Rotation | None
    observer: ObserverState | None
    header: dict[str, HeaderValue]
    format: str
    sha256: str
    path: Path
    eight_bit: EightBitValues | None = None


def read_image_file(path: str | Path, *, hdu: int | str | None = None, bottom_up: bool = False) -> ImageFile:
    """Read an image file; its content, not its name, decides the format.

    Parameters
    ----------
    path : path-like
        A FITS, PNG, TIFF, JPEG or VICAR file, an ISIS cube, an image with a PDS3 label attached, a PDS3 or PDS4 label
        that points to its image, or a raw image with such a label next to it (same name, ``.LBL`` or ``.xml``). Files
        may be gzipped, but for ISIS cubes and PDS4 products, which are read by libraries of the extra ``planetary``.
    hdu : int or str, optional; for FITS: index or EXTNAME of the HDU; the first with a 2-D image by default
    bottom_up : bool
        The first stored row is the bottom of the picture, as telescopes store the sky: turn the rows around, so that
        the picture is not mirrored. Row y of the result is row ``rows - 1 - y`` of the file.

    Raises
    ------
    DataError
        The file is missing, empty, truncated, damaged, of no supported format, or the HDU holds no image.
    InputError
        ``hdu`` is given for a file that is not FITS.

    Notes
    -----
    Items that give epoch and exposure: :mod:`giantlike.io.fits_keywords` for FITS,
    :mod:`giantlike.io.label_times` for VICAR and PDS3. The other formats carry none. Warnings of the libraries
    underneath never come through.
    """
    given = Path(path)
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # astropy and erfa: damage of the pixels is checked; odd cards and years are harmless
        file = _read_image(given, hdu)
    if not bottom_up:
        return file
    pixels, mask = (np.ascontiguousarray(array[::-1]) for array in (file.pixels, file.mask))
    return replace(file, pixels=pixels, mask=mask)


def _read_image(path: Path, hdu: int | str | None) -> ImageFile:
    data = _content(path)
    digest = hashlib.sha256(data).hexdigest()
    data = _unzip(path, data)
    kind = _sniff(data)
    if hdu is not None and kind != "fits":
        raise InputError(f"hdu={hdu!r} is for FITS files, but {path} is {kind or 'of no known format'}")
    if kind == "pds3":
        decoded, digest = _decode_labeled(path, data, digest)
    elif kind == "pds4":
        decoded, digest = _decode_product(path, data)
    elif kind is not None:
        decoded = _decode(path, data, kind, hdu)
    else:
        label = _label_beside(path)
        if label is None:
            raise DataError(
                path, "is of no supported format; supported are FITS, PNG, TIFF, JPEG, VICAR, PDS3, PDS4 and ISIS cubes"
            )
        content = _content(label)
        pds4 = _sniff(content) == "pds4"
        decoded, digest = _decode_product(label, content) if pds4 else _decode_labeled(label, content, digest)
    return _finish(path, decoded, digest)


def _decode(path: Path, data: bytes, kind: str, hdu: int | str | None) -> DecodedImage:
    if kind == "fits":
        return decode_fits(path, data, hdu)
    if kind == "isis":
        return decode_isis_cube(path, data)
    return decode_vicar(path, data) if kind == "vicar" else decode_raster(path, data, kind)


def _decode_product(label: Path, content: bytes) -> tuple[DecodedImage, str]:
    """Decode the image of a PDS4 label; the hash is of the file with the pixels."""
    pixels = label.parent / data_file_of(label, content)
    return decode_pds4(label), hashlib.sha256(_content(pixels)).hexdigest()


def _decode_labeled(path: Path, data: bytes, digest: str) -> tuple[DecodedImage, str]:
    """Decode the image of a PDS3 label; the hash is of the file with the pixels.

    A FITS or VICAR file is read as such; the label gives the epoch and exposure that it lacks.
    """
    label = parse_pds3(path, data)
    pointer = image_pointer(path, label)
    if pointer.file is None:
        return decode_pds3(path, data, label, pointer.offset_bytes), digest
    target = _find_beside(path, pointer.file)
    if target is None:
        raise DataError(path, f"the image file {pointer.file!r} that this label points to is not beside it")
    pixels = _content(target)
    kind, digest = _sniff(pixels), hashlib.sha256(pixels).hexdigest()
    if kind not in {"fits", "vicar"}:
        return decode_pds3(target, pixels, label, pointer.offset_bytes), digest
    decoded = _decode(target, pixels, kind, None)
    exposure_s = label_exposure_s(label.values, label.units) if decoded.exposure_s is None else decoded.exposure_s
    epoch = label_epoch(label.values, exposure_s) if decoded.epoch is None else decoded.epoch
    return replace(decoded, epoch=epoch, exposure_s=exposure_s), digest


def _finish(path: Path, decoded: DecodedImage, digest: str) -> ImageFile:
    """Native byte order, float32 for all floating pixels, bad pixels masked and zero, arrays read-only."""
    pixels = decoded.pixels
    mask = np.zeros(pixels.shape, dtype=bool) if decoded.mask is None else decoded.mask.copy()
    if pixels.dtype.kind == "f":
        with np.errstate(over="ignore"):
            pixels = pixels.astype(np.float32)
        bad = ~np.isfinite(pixels)
        pixels[bad] = 0.0
        mask |= bad
    else:
        pixels = np.array(pixels, dtype=pixels.dtype.newbyteorder("="))
    return ImageFile(
        pixels=pixels,
        mask=mask,
        epoch=decoded.epoch,
        exposure_s=decoded.exposure_s,
        camera_from_inertial=decoded.camera_from_inertial,
        observer=decoded.observer,
        header=decoded.header,
        format=decoded.format,
        sha256=digest,
        path=path,
        eight_bit=decoded.eight_bit,
    )


@reads("an image")
def _content(path: Path) -> bytes:
    data = path.read_bytes()
    if not data:
        raise DataError(path, "the file is empty")
    return data


@reads("a gzip file")
def _unzip(path: Path, data: bytes) -> bytes:
    return decompress_gzip(data)


def _sniff(data: bytes) -> str | None:
    """Format of a file by its first bytes; None for one that is not known."""
    return next((kind for kind, magic in _MAGIC.items() if magic.match(data)), None)


def _label_beside(path: Path) -> Path | None:
    """A PDS3 or PDS4 label of the same name whose image is this file."""
    for suffix in (".LBL", ".xml"):
        label = _find_beside(path, path.with_suffix(suffix).name)
        if label is None or label == path:
            continue
        content = _content(label)
        if _sniff(content) == "pds4":
            named: str | None = data_file_of(label, content)
        else:
            named = image_pointer(label, parse_pds3(label, content)).file
        if (named or "").lower() == path.name.lower():
            return label
    return None


@reads("an image")
def _find_beside(path: Path, name: str) -> Path | None:
    """Find a file by name in the folder of another file; an exact match wins, otherwise case is ignored."""
    if name in {"", ".", ".."} or "/" in name or "\\" in name or "\0" in name:
        raise ValueError(f"the image that its label points to must be a file beside it, got {name[:100]!r}")
    exact = path.parent / name
    if exact.is_file():
        return exact
    return next((p for p in sorted(path.parent.iterdir()) if p.name.lower() == name.lower()), None)
