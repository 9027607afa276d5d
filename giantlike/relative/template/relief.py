"""Unmodeled relief of a template, and the error of the position that residuals do not show."""

from __future__ import annotations

import numpy as np

from giantlike.core.arrays import Float
from giantlike.processing.outline_errors import outline_errors
from giantlike.relative.template.covariance import LinearFit

_SECTOR_PX = 3.0
"""Width of a sector along the limb, px: sharp point spread functions reach no farther. Outlines are averaged further;
with half or double squared errors per degree of freedom of 62 crescents are 0.1 larger at most, in the mean."""
_LEAST_SHARE = 0.01
"""Information of a sector over the median of all, at least: sigmas ten times as large, of horns without light. With
three times as much the same to 0.02."""
_LEAST_SECTORS = 8
"""Sectors, at least: five degrees of freedom beside the place, from which a spectrum is hardly determined."""


def relief_covariance(fit: LinearFit, center_px: Float, sun: Float, *, radius_px: float) -> Float:
    r"""Covariance of the parameters of a template from relief that its shape does not hold.

    ``center_px``: center of the body, from the first pixel of the images; ``sun`` (2,); returns (k, k), zero where too
    few sectors of the limb are in view.

    Relief ``h``, over the radius, moves all light of a sector of the body along it: it changes the model by
    ``-h dM/dlog(range)``. Each sector of the lit half of the limb has an ``h`` by its residuals, of which the fit has
    taken up what looks like another place or range. What that was follows from the spectrum of the rest, see
    :func:`~giantlike.processing.outline_errors.outline_errors`. A crescent needs it most: it shows less than half of
    the limb, over which the long waves of relief are all but a shift, and holds too few blocks for a jackknife. So does
    a shape that is wrong by a tenth of its radius, whose errors a jackknife over blocks does not see as common ones.
    """
    columns, weights = fit.columns, fit.columns.weights.ravel()
    at_y, at_x = np.indices(fit.residuals.shape)
    x, y = (at_x - center_px[0]).ravel(), (at_y - center_px[1]).ravel()
    count = int(2.0 * np.pi * radius_px / _SECTOR_PX)
    zero = np.zeros_like(columns.information)
    lit = np.flatnonzero((x * sun[0] + y * sun[1] >= 0.0) & (weights > 0.0))
    sectors = ((np.arctan2(y[lit], x[lit]) / (2.0 * np.pi) + 0.5) * count).astype(np.int64) % max(count, 1)
    by_relief = weights[lit] * columns["range"].ravel()[lit]

    sums = [np.bincount(sectors, by_relief * row, count) for row in columns.rows[:, lit]]
    scores: Float = np.stack(sums, axis=1).astype(np.float64, copy=False)
    pull = np.asarray(np.bincount(sectors, by_relief * fit.residuals.ravel()[lit], count), dtype=np.float64)
    information = scores[:, columns.layout.span("range")].ravel()
    enough = information > _LEAST_SHARE * np.median(information[information > 0.0])
    if np.count_nonzero(enough) < _LEAST_SECTORS:
        return zero
    order = np.flatnonzero(enough)
    order = np.roll(order, -int(np.argmax(np.diff(order, append=order[0] + count))) - 1)  # the widest gap is no limb
    information, scores = information[order], scores[order]
    angle = 2.0 * np.pi * ((order + 0.5) / count - 0.5)
    points = np.column_stack([np.cos(angle), np.sin(angle)])
    heights, sigma = pull[order] / information, np.asarray(information**-0.5, dtype=np.float64)
    errors = outline_errors(
        heights,
        scores[:, columns.layout.span("center", "range")] / information[:, None],
        sigma,
        points,
        radius=1.0,
        least_length=_SECTOR_PX / radius_px,
    )
    relief = errors.covariances(sigma, points).relief
    moved = np.linalg.solve(columns.information, scores.T)
    return np.asarray(moved @ relief @ moved.T)
