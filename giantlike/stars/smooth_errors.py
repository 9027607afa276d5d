"""Errors of stars beyond their own: distortion that is not modeled, rows that slipped, turbulence, pixels.

The residuals of a fit should have no pattern. Where stars that lie side by side have residuals in the same direction,
the errors do not average out over the number of stars, and a part of them of the same size hides in the attitude
itself. Few stars determine such errors poorly, and one that is far better than the others hides its own: all that the
errors may be is weighed with its probability.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from giantlike.core.arrays import Float
from giantlike.core.statistics import whiten
from giantlike.core.values import Value

MOST_WEIGHED = 50  # stars up to which each is weighed by itself; more are gathered in cells
_CELLS = 5  # cells along the sides of the field in which more stars are gathered: as many as 25 stars
_NONE = 0.5
"""A priori probability of no errors beyond those of the stars themselves. The rest is shared equally by underestimated
noise, errors of each star, a scale error of the camera, and errors that neighbors share."""
_STEPPED, _SMOOTH = (1.0, 3.0, 9.0), (0.5, 1.0, 2.0, 4.0)
"""Lengths over which neighbors share errors, in standard deviations of the positions of the stars by axis, from 0.15
to 2.6 times the side of a field: fields with steps, as of rows that slipped, and smooth ones, as of distortion."""
_KINDS = 4
_PRIOR = (1.0 - _NONE) / _KINDS
_LIKELIER = 2.0
"""Thresholds of two likelihood ratios: errors that neighbors share against all other hypotheses, above which only these
count; and errors of any kind against none, above which all count, weighted by probability."""
_SEEN = 0.01
"""Fraction of the power of the positions under a scale that the parameters of the fit do not absorb; below it the scale
is one of them (0 but for rounding where the focal length is estimated)."""
_NEGLIGIBLE = 0.1  # probability of shared errors below which they are ignored
_LEAST, _MOST, _BEYOND, _SIZES = 0.03, 3.0, 10.0, 24
"""Sizes of the errors tried, equally likely by their logarithm: minimum and maximum relative to the median standard
deviation of the stars, maximum relative to the root mean square of the residuals, and their number."""
_DECIDES = 0.5
"""Fraction of the information on the boresight in one star, above which that star dominates and hides its own errors:
errors of all kinds then count with their probability, however small. Otherwise they count where they are likely."""
_FEWEST = 8  # stars
_SIGNIFICANT = 2.0
"""Standard deviations of the correlation of neighbors, from which on stars of a cell share errors: once in 40 attitudes
without such errors."""
_MUTUAL = 0.62
"""Fraction of random points in a plane that are the nearest neighbors of their own nearest neighbors, whose products
count twice: 6 pi / (8 pi + 3 sqrt(3)), area of a disk / area of two through each other's centers."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UnmodeledErrors(Value):
    """Effect of unmodeled errors of stars on an attitude: the mean over sizes and correlation lengths."""

    likely: bool  # whether errors of any kind are more likely than none
    covariance_rad2: Float  # of the attitude, for these errors alone
    # own_px, scale_px, shared_px: root mean square per axis, over all hypotheses, of errors of single stars, of scale
    # errors, and of errors that neighbors share (the part of smooth fields that differs from star to star). All are 0
    # where no error is likely and no star decides alone
    own_px: float
    scale_px: float
    shared_px: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AttitudeResiduals(Value):
    """Residuals of a fit of n stars, and their derivatives."""

    points_px: Float  # (n, 2)
    residuals_px: Float  # (n, 2)
    covariance_px2: Float  # (n, 2, 2); of the stars themselves
    jacobian: Float  # (n, 2, k); derivative of the positions by the parameters of the fit
    scaling_px: Float  # (n, 2); derivative of the positions by the logarithm of the focal length
    by_pixels: Float  # (3, n, 2) rad/px; derivative of the attitude by the image positions of the stars

    def alike(self, sigma_px: Float) -> bool:
        """Tell whether nearest neighbors have residuals in the same direction, significantly so. ``sigma_px`` (n,)."""
        nearest = np.asarray(cKDTree(self.points_px).query(self.points_px, k=2)[1])[:, 1]
        normalized = self.residuals_px / sigma_px[:, None]
        correlation = float(np.mean(normalized * normalized[nearest])) / max(float(np.mean(normalized**2)), 1e-12)
        return correlation > _SIGNIFICANT * math.sqrt((1.0 + _MUTUAL) / normalized.size)

    def average_cells(self) -> AttitudeResiduals:
        """Means of the stars in each cell of the field, by their weights; shared errors are preserved."""
        low, high = self.points_px.min(axis=0), self.points_px.max(axis=0)
        cells = np.minimum(_CELLS * (self.points_px - low) / np.maximum(high - low, 1.0), _CELLS - 1).astype(np.intp)
        owner = np.unique(cells @ [_CELLS, 1], return_inverse=True)[1]
        inside = (owner == np.arange(owner.max() + 1)[:, None]).astype(np.float64)
        weights = 2.0 / np.trace(self.covariance_px2, axis1=1, axis2=2)
        sums = inside @ weights
        means = inside * weights / sums[:, None]
        return AttitudeResiduals(
            points_px=means @ self.points_px,
            residuals_px=means @ self.residuals_px,
            covariance_px2=np.eye(2) / sums[:, None, None],
            jacobian=np.einsum("cn,nak->cak", means, self.jacobian),
            scaling_px=means @ self.scaling_px,
            by_pixels=np.einsum("cn,ina->ica", inside, self.by_pixels),
        )


def unmodeled_errors(left: AttitudeResiduals, *, own_included: bool = False) -> UnmodeledErrors:
    """Weigh errors of all sizes and lengths by the residuals of a fit, into :class:`UnmodeledErrors`.

    Errors of the size a add ``a^2 K`` to the covariance of the positions. ``K`` is this covariance over its median
    variance for underestimated noise, the unit matrix for errors of each star, ``exp(-d / l)`` or
    ``exp(-d^2 / 2 l^2)`` for errors shared by stars at the distance d, and the outer product of the positions about
    the boresight for a scale error. The restricted likelihood of each such covariance is computed from the residuals
    that the parameters of the fit cannot absorb; one eigenvalue problem for each length serves all sizes. Errors that
    move the whole field alike leave no residuals and are not observable.
    """
    n = len(left.points_px)
    design = whiten(left.jacobian, left.covariance_px2).reshape(2 * n, -1)
    freedom = np.linalg.qr(design, mode="complete")[0][:, design.shape[1] :]
    rest = freedom.T @ whiten(left.residuals_px, left.covariance_px2).ravel()
    sigma = math.sqrt(float(np.median(np.trace(left.covariance_px2, axis1=1, axis2=2))) / 2.0)
    rms = math.sqrt(float(np.mean(left.residuals_px**2)))
    sizes = np.geomspace(_LEAST * sigma, max(_MOST * sigma, _BEYOND * rms), _SIZES)
    pattern = left.scaling_px / max(math.sqrt(float(np.mean(left.scaling_px**2))), 1e-9)
    whole = whiten(pattern, left.covariance_px2).ravel()
    seen = freedom.T @ whole
    total = 1.0 + sizes**2 * float(seen @ seen)
    scaled = 0.5 * (sizes**2 * float(seen @ rest) ** 2 / total - np.log(total) - float(rest @ rest))
    by_scale = np.einsum("ina,na->i", left.by_pixels, pattern)
    larger = sizes**2 / sigma**2
    louder = -0.5 * (rest.size * np.log1p(larger) + float(rest @ rest) / (1.0 + larger))
    alike = _kernels(left.points_px)
    unit = whiten(np.tile(np.eye(2), (n, 1, 1)), left.covariance_px2).reshape(2 * n, 2)
    spread = (unit @ unit.T) * alike.repeat(2, axis=1).repeat(2, axis=2)
    powers, axes = np.linalg.eigh(freedom.T @ spread @ freedom)
    totals = 1.0 + sizes[:, None] ** 2 * np.maximum(powers, 0.0)[:, None]
    along = ((rest @ axes) ** 2)[:, None]
    logs = np.vstack([louder, scaled, -0.5 * np.sum(np.log(totals) + along / totals, axis=-1)])
    moved = np.moveaxis(left.by_pixels, -1, 0)[:, None]
    responses = np.sum(moved @ alike @ np.swapaxes(moved, -1, -2), axis=0)
    noise = np.einsum("ina,nab,jnb->ij", left.by_pixels, left.covariance_px2, left.by_pixels, optimize=True)
    responses = np.concatenate([noise[None] / sigma**2, np.outer(by_scale, by_scale)[None], responses])
    lengths = len(alike) - 1
    priors = _PRIOR * np.array([1.0, 1.0, 1.0, *lengths * [1.0 / lengths]])
    none = math.log(_NONE) - 0.5 * float(rest @ rest)
    weights = logs + np.log(priors / _SIZES)[:, None]
    if float(seen @ seen) < _SEEN * float(whole @ whole):
        weights[1] = -np.inf  # a scale that parameters of the fit, or declared ones, take up is in their covariance
    most = max(float(weights.max()), none)
    weights = np.exp(weights - most)
    without = math.exp(none - most)
    own, shared, usual, chance = float(weights[2].sum()), float(weights[3:].sum()), without, _NONE
    if own_included:
        usual, chance = without + own, _NONE + _PRIOR
    everything = float(weights.sum()) + without
    likely = (everything - usual) * chance > _LIKELIER * (1.0 - chance) * usual
    if shared * (1.0 - _PRIOR) > _LIKELIER * _PRIOR * (everything - shared):
        weights[:3], without, likely = 0.0, 0.0, True
    elif likely and shared < _NEGLIGIBLE * everything:
        weights[3:] = 0.0
    known = np.sum(design.reshape(n, 2, -1)[..., :2] ** 2, axis=(1, 2))
    decides = n >= _FEWEST and float(known.max()) > _DECIDES * float(known.sum())
    if not likely and not decides:
        weights[[0, 1, *range(3, len(weights))]] = 0.0
        weights[2] *= own > without
    squares = weights @ sizes**2 / max(float(weights.sum()) + without, 1e-300)
    return UnmodeledErrors(
        likely=likely,
        covariance_rad2=np.tensordot(squares, responses, axes=1),
        own_px=math.sqrt(float(squares[2])),
        scale_px=math.sqrt(float(squares[1])),
        shared_px=math.sqrt(float(squares[3:] @ _reported_fractions(alike[1:]))),
    )


def _kernels(points_px: Float) -> Float:
    """Correlations (m, n, n) of the errors of stars: of each for itself, and of those that neighbors share."""
    spread = math.sqrt(float(np.mean((points_px - points_px.mean(axis=0)) ** 2)))
    apart = np.linalg.norm(points_px[:, None] - points_px[None], axis=-1)
    stepped = [np.exp(-apart / max(length * spread, 1.0)) for length in _STEPPED]
    smooth = [np.exp(-0.5 * (apart / max(length * spread, 1.0)) ** 2) for length in _SMOOTH]
    return np.stack([np.eye(len(points_px)), *stepped, *smooth])


def _reported_fractions(shared: Float) -> Float:
    """Fractions (m,) of the variances of shared errors by which :class:`UnmodeledErrors` reports them."""
    smooth = 1.0 - shared[len(_STEPPED) :].mean(axis=(1, 2))
    return np.concatenate([np.ones(len(_STEPPED)), smooth])
