"""Preview pictures of images."""

from __future__ import annotations

import cv2
import numpy as np

from giantlike.core.arrays import Float

_GAMMA = 0.4  # exponent of the display: a star a thousand times fainter than the body is shown at 6 % of white


def preview_png(pixels_dn: Float) -> bytes:
    """Encode an image as an 8 bit gray PNG: a power of the signal above the median, scaled to the brightest pixel."""
    values = np.asarray(pixels_dn, dtype=np.float64)
    above = np.maximum(values - float(np.median(values)), 0.0)
    gray = (above / max(float(above.max()), 1e-12)) ** _GAMMA
    done, data = cv2.imencode(".png", np.rint(255.0 * gray).astype(np.uint8))
    assert done
    return bytes(data)
