"""A picture of an image for people to look at."""

from __future__ import annotations

import cv2
import numpy as np

from giantlike.core.arrays import Float

_GAMMA = 0.4  # shows a star beside a body that is a thousand times brighter


def preview_png(pixels_dn: Float) -> bytes:
    """Gray picture of 8 bit as a PNG file: a power of what is above the background, up to the brightest pixel.

    Parameters
    ----------
    pixels_dn : (rows, columns), DN
        The first row is on top.
    """
    values = np.asarray(pixels_dn, dtype=np.float64)
    above = np.maximum(values - float(np.median(values)), 0.0)
    gray = (above / max(float(above.max()), 1e-12)) ** _GAMMA
    done, data = cv2.imencode(".png", np.rint(255.0 * gray).astype(np.uint8))
    assert done
    return bytes(data)
