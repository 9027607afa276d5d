"""Errors that neighboring stars share: distortion that is not modeled, rows that slipped, turbulence.

The residuals of a fit should have no pattern. Where stars that lie side by side are off in the same direction, the
errors do not average out over the number of stars, and a part of them of the same size hides in the attitude itself.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree

from giantlike.core.arrays import Float

_FEWEST = 8  # stars: of fewer, the correlation of neighbors has a standard deviation above 0.3
_SIGNIFICANT = 3.0  # standard deviations of the correlation: once in 700 attitudes without such errors
_BELIEVED = 1.0
"""Standard deviations where the noise does not explain the residuals. Squared errors over the covariance of 20 stars
with smooth errors (300 px of 1024) and with a white floor: 0.8 and 1.0 at 0, 1.05 and 1.1 at 1, 4.3 and 1.1 at 3; of
12 stars 6.1 and 1.0, 7.5 and 1.1, 11.6 and 1.1."""
_MUTUAL = 0.62
"""Share of random points in a plane that are the nearest neighbors of their own nearest neighbors, whose products count
twice: 6 pi / (8 pi + 3 sqrt(3)), the area of a disk over that of two through each other's centers."""


def shared_error_px(points_px: Float, residuals_px: Float, sigma_px: Float, *, explained: bool) -> float:
    """Size of the errors that neighbors share.

    Parameters
    ----------
    points_px : (n, 2) float64, px
    residuals_px : (n, 2) float64, px
        Of a fit to them.
    sigma_px : (n,) float64, px
        Standard deviation per axis by which they were weighted.
    explained : bool
        True if the noise explains the size of the residuals. Where it does not, there are other errors, and a weaker
        sign that neighbors share them is believed.

    Returns
    -------
    float, px
        Standard deviation per axis; 0 where the correlation of neighbors is not significant.
    """
    n = len(points_px)
    if n < _FEWEST:
        return 0.0
    nearest = np.asarray(cKDTree(points_px).query(points_px, k=2)[1])
    normalized = residuals_px / sigma_px[:, None]
    other = nearest[:, 1]
    variance = float(np.mean(normalized**2))
    correlation = float(np.mean(normalized * normalized[other])) / variance if variance > 0.0 else 0.0
    if correlation < (_SIGNIFICANT if explained else _BELIEVED) * math.sqrt((1.0 + _MUTUAL) / (2 * n)):
        return 0.0
    products = residuals_px * residuals_px[other]
    weights = 1.0 / (sigma_px * sigma_px[other]) ** 2
    return math.sqrt(max(float(np.sum(weights * products.mean(axis=1)) / np.sum(weights)), 0.0))


def shared_covariance(points_px: Float, by_pixels: Float) -> Float:
    """Covariance of an attitude for shared errors of 1 px.

    An error field of low order is a shift, a slope along and one across; the fit takes up what it can of each, and the
    residuals show the rest, so that each is as large as what they show.

    Parameters
    ----------
    points_px : (n, 2) float64, px
    by_pixels : (3, n, 2) float64, rad/px
        Derivative of the attitude by the places of the stars.

    Returns
    -------
    (3, 3) float64, rad^2/px^2
    """
    centered = points_px - points_px.mean(axis=0)
    spread = np.sqrt(np.mean(centered**2))
    modes = np.column_stack([np.ones(len(points_px)), centered / max(spread, 1.0)])
    responses = np.einsum("ina,nm->ima", by_pixels, modes).reshape(3, -1)
    covariance: Float = responses @ responses.T
    return covariance
