"""An image as the decoder of one file format returns it, see :mod:`giantlike.io.image_files`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Mask
from giantlike.core.observer import ObserverState
from giantlike.core.pixel_noise import EightBitValues
from giantlike.core.values import Value

if TYPE_CHECKING:
    from astropy.time import Time

HeaderValue: TypeAlias = str | int | float | bool  # value of a header or label item


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DecodedImage(Value):
    """Pixels as stored, and the contents of the file's own header."""

    pixels: NDArray[Any]  # in DN; rows as stored, any byte order; may hold NaN
    format: str  # ``fits``, ``png``, ``tiff``, ``jpeg``, ``vicar``, ``pds3``, ``pds4`` or ``isis``
    mask: Mask | None = None  # True where the format itself declares a pixel missing; None where no pixel is
    epoch: Time | None = None  # Mid-exposure
    exposure_s: float | None = None
    camera_from_inertial: Rotation | None = None
    observer: ObserverState | None = None  # spacecraft with respect to the solar system barycenter
    header: dict[str, HeaderValue] = field(default_factory=dict)  # header or label items
    eight_bit: EightBitValues | None = None  # of 8-bit JPEG and PNG files
