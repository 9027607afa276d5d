r"""Shapes of a point spread function: a family from the round Gaussian to the elongated Moffat function.

With ``q`` the square of the distance from the middle in the metric of an ellipse,

.. math:: f = \frac{c\,(\beta - 1)}{\pi \sqrt{\det C}} (1 + c\,q)^{-\beta},\qquad
          q = u^T C^{-1} u,\qquad c = (2^{1/\beta} - 1) / (2 \ln 2),

falls to one half where the Gaussian of covariance ``C`` does, and is that Gaussian for :math:`1/\beta = 0`. The ellipse
is :math:`C = \sigma^2 [[1 + e_1, e_2], [e_2, 1 - e_1]]`. Parameters are ``ln sigma, e1, e2, 1/beta``.
"""

from __future__ import annotations

import math
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float

SHAPE_NAMES = ("ln_sigma", "e1", "e2", "inverse_beta")  # names of the parameters of a shape
N_SHAPE = len(SHAPE_NAMES)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_OFFSETS, _SHARES = _NODES / 2.0, _WEIGHTS / 2.0  # nodes from the pixel center, px, and their weights
_GAUSSIAN_BELOW = 1e-6  # 1/beta below which the Moffat function is computed as a Gaussian


class PsfKind(StrEnum):
    """Free parameters of the family."""

    GAUSSIAN = "gaussian"  # round: ln sigma alone
    ELONGATED = "elongated"  # an elliptical Gaussian
    MOFFAT = "moffat"  # an elliptical Moffat function: a core and wings

    @property
    def n_free(self) -> int:
        """Number of free parameters; the others are zero."""
        return {PsfKind.GAUSSIAN: 1, PsfKind.ELONGATED: 3, PsfKind.MOFFAT: 4}[self]


def shape_shares(corner_px: NDArray[np.integer], size: int, points_px: Float, shapes: Float) -> Float:
    """Share (n, size, size) of a point source in each pixel of patches, by quadrature with 5 x 5 nodes per pixel.

    ``corner_px`` (n, 2), first pixel (x, y) of each patch; ``shapes`` (n, 4): ln sigma (of px), e1, e2, 1/beta.
    """
    sigma, e1, e2, inverse_beta = np.exp(shapes[:, 0]), shapes[:, 1], shapes[:, 2], shapes[:, 3]
    steps = (np.arange(size)[:, None] + _OFFSETS).ravel()
    dx, dy = (((corner_px - points_px)[:, k, None] + steps) / sigma[:, None] for k in (0, 1))
    determinant = np.maximum(1.0 - e1**2 - e2**2, 1e-6)
    across = ((1.0 - e1) / determinant)[:, None] * dx**2
    down = ((1.0 + e1) / determinant)[:, None] * dy**2
    both = (-2.0 * e2 / determinant)[:, None] * dy
    q = down[:, :, None] + across[:, None, :] + both[:, :, None] * dx[:, None, :]
    density = np.exp(-0.5 * q) / (2.0 * math.pi)
    winged = np.flatnonzero(inverse_beta > _GAUSSIAN_BELOW)
    if winged.size:
        beta = 1.0 / inverse_beta[winged, None, None]
        scale = np.expm1(math.log(2.0) / beta) / (2.0 * math.log(2.0))
        density[winged] = scale * (beta - 1.0) / math.pi * np.exp(-beta * np.log1p(scale * q[winged]))
    density /= (sigma**2 * np.sqrt(determinant))[:, None, None]
    n = len(points_px)
    cells = density.reshape(n, size, len(_SHARES), size, len(_SHARES))
    shares: Float = np.einsum("nipjq,p,q->nij", cells, _SHARES, _SHARES, optimize=True)
    return shares
