"""Many short lines at once: their values moved by fractions of a sample, and weighted least squares of each."""

from __future__ import annotations

import numpy as np

from giantlike.core.arrays import Float

_WHOLE = slice(None)
_HELD = 1e12  # of a normal matrix scaled to 1: holds a parameter at zero, and leaves the matrix invertible


def moved(values: Float, steps: Float, part: slice = _WHOLE) -> Float:
    """Move lines of values by fractions of a sample, by cubics through four samples.

    Parameters
    ----------
    values : (n, m, ...) float64
        Beyond the ends they are those of the ends.
    steps : (n,) float64
        In samples, towards larger indices.
    part : slice
        Samples of each line that are returned; all by default.

    Returns
    -------
    (n, w, ...) float64
    """
    near = np.floor(-steps).astype(np.intp)
    t = -steps - near
    weights = (
        -t * (t - 1) * (t - 2) / 6,
        (t + 1) * (t - 1) * (t - 2) / 2,
        -(t + 1) * t * (t - 2) / 2,
        (t + 1) * t * (t - 1) / 6,
    )
    count = values.shape[1]
    samples = values.reshape(len(values) * count, *values.shape[2:])  # one index takes half of the time of two
    first, index = count * np.arange(len(values))[:, None], np.arange(count)[part] + near[:, None]
    result = np.zeros((*index.shape, *values.shape[2:]))
    for k, weight in enumerate(weights, start=-1):
        taken = samples.take(first + np.clip(index + k, 0, count - 1), axis=0)
        taken *= weight.reshape(-1, *[1] * (values.ndim - 1))
        result += taken
    return result


def solved(columns: Float, data: Float, weights: Float) -> Float:
    """Solve many weighted least-squares problems.

    Parameters
    ----------
    columns : (n, w, k) float64
    data, weights : (n, w) float64

    Returns
    -------
    (n, k) float64
    """
    normal, scale = scaled_normal(columns, weights)
    pulled = ((data * weights)[:, None] @ columns)[:, 0, :, None]
    result: Float = (np.linalg.inv(normal) @ (pulled / scale) / scale)[..., 0]
    return result


def solution_operators(columns: Float, weights: Float, stiffness: Float | None = None) -> Float:
    """Find the matrices that make the solutions of weighted least squares from the data.

    Parameters
    ----------
    columns : (n, w, k) float64
    weights : (n, w) float64
    stiffness : (n,) float64, optional
        Information on the last parameter before the fit, which holds it near nothing; none by default.

    Returns
    -------
    (n, k, w) float64
    """
    normal, scale = scaled_normal(columns, weights)
    if stiffness is not None:
        with np.errstate(over="ignore"):  # a parameter that nothing depends on
            normal[:, -1, -1] += np.minimum(stiffness / scale[:, -1, 0] ** 2, _HELD)
    inverse = np.linalg.inv(normal) / (scale * np.swapaxes(scale, 1, 2))
    return np.swapaxes((columns * weights[..., None]) @ inverse, 1, 2)


def scaled_normal(columns: Float, weights: Float) -> tuple[Float, Float]:
    """Make the normal matrices of weighted least squares, scaled to a diagonal of 1.

    Parameters
    ----------
    columns : (n, w, k) float64
    weights : (n, w) float64

    Returns
    -------
    normal : (n, k, k) float64
    scale : (n, k, 1) float64
        Roots of the diagonals before.
    """
    normal = np.swapaxes(columns * weights[..., None], 1, 2) @ columns
    scale = np.sqrt(np.maximum(np.diagonal(normal, axis1=1, axis2=2), 1e-300))[..., None]
    return normal / (scale * np.swapaxes(scale, 1, 2)) + 1e-12 * np.eye(normal.shape[1]), scale
