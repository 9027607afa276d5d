"""Rows of odd and even number that are shifted against each other, as seen in the images of stars."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import stdtrit

from giantlike.core.arrays import Float, Mask

_FALSE_ALARM = 1e-3  # rate of false alarms, as for fixes of bodies
_REACH_SIGMAS, _ROOM_PX = 3, 2
"""Half width of the windows: standard deviations of the point spread function, and px for the shift."""
_LEAST_STARS = 8  # minimum number of stars: scatter estimated from fewer is too uncertain


def is_interlaced(
    pixels: Float, bad: Mask | None, points_px: Float, background_dn: Float, psf_sigma_px: float, sigma_px: float
) -> bool:
    """Return True where odd and even rows disagree on the positions of stars by more than the sigma of an attitude.

    ``pixels``, ``bad`` (rows, columns); ``points_px`` (n, 2), ``background_dn`` (n,); ``sigma_px`` is the standard
    deviation along rows of the attitude, which half of the shift displaces.
    """
    shifts = _row_shifts(pixels, bad, points_px, background_dn, math.ceil(_REACH_SIGMAS * psf_sigma_px) + _ROOM_PX)
    if len(shifts) < _LEAST_STARS:
        return False
    shift = float(np.median(shifts))
    scatter = 1.4826 * float(np.median(np.abs(shifts - shift)))
    sigma = math.hypot(2.0 * sigma_px, math.sqrt(0.5 * math.pi / len(shifts)) * scatter)
    return abs(shift) > float(stdtrit(len(shifts) - 1, 1.0 - 0.5 * _FALSE_ALARM)) * sigma


def _row_shifts(pixels: Float, bad: Mask | None, points_px: Float, background_dn: Float, reach: int) -> Float:
    """Centroid in odd rows minus that in even rows (k,), px, of the stars whose windows lie in the frame."""
    rows, columns = pixels.shape
    middle = np.rint(points_px).astype(int)
    inside = np.all((middle >= reach) & (middle < np.array([columns, rows]) - reach), axis=1)
    middle, steps = middle[inside], np.arange(-reach, reach + 1)
    at = middle[:, 1, None, None] + steps[:, None], middle[:, 0, None, None] + steps
    light = np.asarray(pixels[at], dtype=np.float64) - background_dn[inside, None, None]
    whole = np.ones(len(light), dtype=bool) if bad is None else ~bad[at].any(axis=(1, 2))
    odd = (at[0] % 2 == 1).astype(np.float64)
    flux, moment = (light * odd).sum(axis=(1, 2)), (light * odd * steps).sum(axis=(1, 2))
    other_flux = light.sum(axis=(1, 2)) - flux
    other_moment = (light * steps).sum(axis=(1, 2)) - moment
    seen = whole & (flux > 0.0) & (other_flux > 0.0)
    return np.asarray(moment[seen] / flux[seen] - other_moment[seen] / other_flux[seen])
