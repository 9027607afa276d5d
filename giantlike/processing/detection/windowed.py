"""Windowed centroid: the position of a small source of any shape, with its covariance from noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, Mask, as_finite, require
from giantlike.core.values import Value

_MAX_STEPS = 50  # bound for iterations that do not converge
_SETTLED_PX = 1e-5  # last step, px: a hundredth of the best centroids


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WindowedCentroid(Value):
    """Windowed centroid of a source."""

    point_px: Float
    covariance_px2: Float  # from the noise of the pixels alone
    snr: float  # windowed flux / standard deviation


def windowed_centroid(
    values: Float, variance: Float, usable: Mask, start_px: ArrayLike, *, window_sigma_px: float
) -> WindowedCentroid | None:
    """Centroid under a Gaussian window on the source; None if that leaves the array, has no flux or does not converge.

    The fixed point of ``x += 2 sum(w I (u - x)) / sum(w I)``, where ``w`` is the Gaussian centered at ``x`` and ``u``
    the pixel: the windowed position of E. Bertin's SExtractor. Its covariance follows from the implicit function
    theorem: with ``g_i = w_i (u_i - x)`` and ``A = sum I_i w_i (1 - (u_i - x)(u_i - x)^T / s^2)``, a change ``d I_i``
    of a pixel moves ``x`` by ``A^-1 g_i d I_i``.
    """
    require(values.shape == variance.shape == usable.shape, "values, variance and usable must have one shape")
    require(window_sigma_px > 0, f"window_sigma_px must be > 0, got {window_sigma_px}")
    rows, columns = np.nonzero(usable)
    light, noise = values[rows, columns], variance[rows, columns]
    pixels = np.stack([columns, rows], axis=1).astype(np.float64)
    point = as_finite(start_px, (2,), "start_px")
    frame = np.array(values.shape[::-1])
    for _ in range(_MAX_STEPS):
        away = pixels - point
        window = np.exp(-np.sum(away**2, axis=1) / (2 * window_sigma_px**2))
        flux = float(window @ light)
        if flux <= 0 or (point < -0.5).any() or (point > frame - 0.5).any():
            return None
        step = 2 * (window * light) @ away / flux
        point = point + step
        if np.abs(step).max() < _SETTLED_PX:
            break
    else:
        return None
    pull = window[:, None] * away
    curvature = flux * np.eye(2) - (away * (window * light)[:, None]).T @ away / window_sigma_px**2
    if np.linalg.eigvals(curvature).real.min() <= 0:
        return None
    inverse = np.linalg.inv(curvature)
    covariance = inverse @ ((pull * noise[:, None]).T @ pull) @ inverse.T
    return WindowedCentroid(point_px=point, covariance_px2=covariance, snr=flux / float(np.sqrt(window**2 @ noise)))
