"""What every image reader hands back, before it becomes an :class:`~giantlike.io.image_files.ImageFile`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.core.observer import ObserverState

if TYPE_CHECKING:
    from astropy.time import Time

HeaderValue: TypeAlias = str | int | float | bool
"""What a header item may be once read: a plain value."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DecodedImage:
    """Pixels as stored and whatever the file's own header says about them.

    ``pixels`` is 2-D, rows as stored, any byte order, and may hold NaN; ``mask`` marks pixels that the
    format itself declares missing (None: no such pixels).
    """

    pixels: NDArray[Any]
    format: str
    mask: NDArray[np.bool_] | None = None
    epoch: Time | None = None
    exposure_s: float | None = None
    camera_from_inertial: Rotation | None = None
    observer: ObserverState | None = None
    header: dict[str, HeaderValue] = field(default_factory=dict)
