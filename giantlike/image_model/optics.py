"""Optics as an effect on profiles across an edge."""

from __future__ import annotations

import numpy as np

from giantlike.core.arrays import Float


def ovality(normals_px: Float) -> Float:
    """Derivatives (2, n) of the variance of an oval point spread function along unit normals (n, 2).

    By half the excess of the variance along x over that along y, and by their covariance.
    """
    x, y = normals_px.T
    return np.stack([x**2 - y**2, 2.0 * x * y])
