"""Errors of stars beyond their own: distortion that is not modeled, rows that slipped, turbulence, pixels.

The residuals of a fit should have no pattern. Where stars that lie side by side are off in the same direction, the
errors do not average out over the number of stars, and a part of them of the same size hides in the attitude itself.
Few stars tell little of such errors, and one that is far better than the others hides its own: of up to
:data:`MOST_WEIGHED` all that the errors may be is weighed with its probability.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from giantlike.core.arrays import Float
from giantlike.core.statistics import whitened
from giantlike.core.values import Value

MOST_WEIGHED = 50
"""Stars up to which all sizes and lengths of their errors are weighed, which takes 1 ms for 12 and 5 ms for 50. More
show their errors themselves."""
_NONE = 0.5
"""Probability a priori that there are no errors beyond those of the stars themselves; the rest is for errors of each
star, and for those that neighbors share, in equal parts."""
_LENGTHS = (1.0, 3.0, 9.0)
"""Lengths over which neighbors share errors, over the standard deviation of the places of the stars by axis: from 0.3
to 2.6 times the side of a field."""
_PRIORS = np.array([1.0, *len(_LENGTHS) * [1.0 / len(_LENGTHS)]]) * 0.5 * (1.0 - _NONE)
_LEAST, _MOST, _BEYOND, _SIZES = 0.03, 3.0, 10.0, 24
"""Sizes of the errors tried, equally likely by their logarithm: least and largest over the median standard deviation of
the stars, largest over the root mean square of the residuals, and their number."""
_DECIDES = 0.5
"""Share of what all stars tell of the boresight that one of them tells, above which it decides alone and hides its own
errors: they count with their probability, however small. Else errors count where they are likely."""
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UnmodeledErrors(Value):
    """What errors beyond those of the stars themselves do to an attitude, by the mean over their sizes and lengths.

    Parameters
    ----------
    covariance_rad2 : (3, 3) float64, rad^2
        Of the attitude, for these errors alone.
    own_px, shared_px : float, px
        Root mean square per axis of errors that each star has for itself, and of those that neighbors share: one of the
        two at most, and none where they are less likely than no errors, unless one star decides alone.
    """

    covariance_rad2: Float
    own_px: float
    shared_px: float


def unmodeled_errors(
    points_px: Float, residuals_px: Float, covariance_px2: Float, jacobian: Float, by_pixels: Float
) -> UnmodeledErrors:
    """Weigh errors of all sizes and lengths by the residuals of a fit, as :class:`UnmodeledErrors` tells.

    Parameters
    ----------
    points_px : (n, 2) float64, px
    residuals_px : (n, 2) float64, px
        Of a fit to them.
    covariance_px2 : (n, 2, 2) float64, px^2
        Of the stars themselves.
    jacobian : (n, 2, k) float64
        Derivative of the places by the parameters of the fit.
    by_pixels : (3, n, 2) float64, rad/px
        Derivative of the attitude by the places of the stars.

    Returns
    -------
    UnmodeledErrors

    Notes
    -----
    Errors of the size a add ``a^2 K`` to the covariance of the places, with ``K`` the unit matrix for errors of each
    star and ``exp(-d / l)`` for those that stars at the distance d share: fields of such a correlation may have steps,
    as of rows that slipped, which smoother ones forbid. What the parameters of the fit cannot take up of the residuals
    has the likelihood of such a covariance (the restricted likelihood). With one eigenvalue problem for each length all
    sizes cost next to nothing. Errors that move the whole field alike leave no residuals, and no star tells of them.
    """
    design = whitened(jacobian, covariance_px2).reshape(2 * len(points_px), -1)
    freedom = np.linalg.qr(design, mode="complete")[0][:, design.shape[1] :]
    left = freedom.T @ whitened(residuals_px, covariance_px2).ravel()
    sigma = math.sqrt(float(np.median(np.trace(covariance_px2, axis1=1, axis2=2))) / 2.0)
    rms = math.sqrt(float(np.mean(residuals_px**2)))
    sizes = np.geomspace(_LEAST * sigma, max(_MOST * sigma, _BEYOND * rms), _SIZES)
    unit = whitened(np.tile(np.eye(2), (len(points_px), 1, 1)), covariance_px2)
    logs, responses = [], []
    for alike in _kernels(points_px):
        spread = np.einsum("iab,ij,jcb->iajc", unit, alike, unit, optimize=True).reshape(len(freedom), -1)
        powers, axes = np.linalg.eigh(freedom.T @ spread @ freedom)
        total = 1.0 + sizes[:, None] ** 2 * np.maximum(powers, 0.0)
        logs.append(-0.5 * np.sum(np.log(total) + (axes.T @ left) ** 2 / total, axis=1))
        responses.append(np.einsum("ina,nm,jma->ij", by_pixels, alike, by_pixels, optimize=True))
    none = math.log(_NONE) - 0.5 * float(left @ left)
    weights = np.array(logs) + np.log(_PRIORS / _SIZES)[:, None]
    most = max(float(weights.max()), none)
    weights = np.exp(weights - most)
    without = math.exp(none - most)
    own = float(weights[0].sum())
    known = np.sum(design.reshape(len(points_px), 2, -1)[..., :2] ** 2, axis=(1, 2))
    decides = len(points_px) >= _FEWEST and float(known.max()) > _DECIDES * float(known.sum())
    if float(weights[1:].sum()) > own + without:
        weights[0], without = 0.0, 0.0
    else:
        weights[1:] = 0.0
        weights[0] *= decides or own > without
    squares = weights @ sizes**2 / (float(weights.sum()) + without)
    return UnmodeledErrors(
        covariance_rad2=np.tensordot(squares, np.array(responses), axes=1),
        own_px=math.sqrt(float(squares[0])),
        shared_px=math.sqrt(float(squares[1:].sum())),
    )


def _kernels(points_px: Float) -> list[Float]:
    """Correlations (n, n) of the errors of stars: of each for itself, and of those that neighbors share."""
    spread = math.sqrt(float(np.mean((points_px - points_px.mean(axis=0)) ** 2)))
    apart = np.linalg.norm(points_px[:, None] - points_px[None], axis=-1)
    shared = [np.exp(-apart / max(length * spread, 1.0)) for length in _LENGTHS]
    return [np.eye(len(points_px)), *shared]
