"""The iteration: damped steps until none promises anything."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from giantlike.calibration.normal import MAX_CONDITION, Data, NormalEquations, State, normal_equations
from giantlike.calibration.robust import Loss
from giantlike.core.arrays import Float, Mask
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.values import Value

_FIRST_DAMPING = 1e-3
_SMALLEST_DAMPING, _LARGEST_DAMPING = 1e-15, 1e12
_FACTOR = 10.0
_CONVERGED, _ROUGHLY = 1e-8, 1e-2
"""Promised decrease of chi-square at which a fit is done: every parameter is within its root of its sigma."""
_ROUNDING = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Minimum(Value):
    """Where the cost is least: state, normal equations there without damping, and the number of steps."""

    state: State
    normal: NormalEquations
    steps: int


def minimize(
    state: State, data: Data, used: Mask, loss: Loss, *, max_steps: int, rough: bool = False
) -> Minimum | Failure:
    r"""Levenberg-Marquardt: steps of :math:`(H^T W H + \lambda\,\mathrm{diag}(H^T W H))^{-1} H^T W r`.

    Parameters
    ----------
    state : State
        Start; every used target can be imaged.
    data : Data
    used : (n,) bool
    loss : Loss
    max_steps : int
    rough : bool
        A tenth of a sigma is near enough, and so is wherever the steps end: for a look at which residuals are large.

    Returns
    -------
    Minimum or Failure
        Reasons: not_converged, degenerate_geometry.

    Notes
    -----
    The update of the paper lacks the weight on its right-hand side; without it the fixed point of a weighted fit
    would be another one. Damping grows tenfold after a step that does not help and shrinks tenfold after one that
    does (its step 4). The fit is done when a step promises to lower chi-square by less than 1e-8.

    References
    ----------
    .. [1] Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, Camera Calibration,
       steps 1-5.
    """
    normal = normal_equations(state, data, used, loss)
    if normal is None:
        return Failure(Reason.NOT_CONVERGED, "the starting model cannot image a target that was seen")
    damping, enough = _FIRST_DAMPING, _ROUGHLY if rough else _CONVERGED
    for count in range(max_steps):
        step = normal.solve(damping)
        if step is None and damping > _FIRST_DAMPING:
            return Failure(Reason.DEGENERATE_GEOMETRY, "the normal equations are singular")
        if step is not None and step.decrement <= enough and damping <= _FIRST_DAMPING:
            return Minimum(state, normal, count)
        moved = None if step is None else state.moved(step, data)
        ahead = None if moved is None else normal_equations(moved, data, used, loss)
        if moved is not None and ahead is not None and ahead.cost <= normal.cost * (1.0 + _ROUNDING):
            state, normal = moved, ahead
            damping = max(damping / _FACTOR, _SMALLEST_DAMPING)
        elif damping < _LARGEST_DAMPING:
            damping *= _FACTOR
        else:
            break
    if rough:
        return Minimum(state, normal, max_steps)
    return Failure(
        Reason.NOT_CONVERGED,
        f"the fit still moves after {max_steps} steps (chi-square {normal.cost:.4g} of {int(used.sum())} observations)",
    )


def covariance_of(normal: NormalEquations, names: tuple[str, ...]) -> tuple[Float, float] | Failure:
    """Covariance (k, k) of the camera parameters and the condition number of their scaled information.

    Returns
    -------
    covariance : (k, k) float64
    condition_number : float
        Of the information matrix scaled to a unit diagonal: 1 where parameters are independent.

    Or a :class:`~giantlike.core.outcomes.Failure` of reason degenerate_geometry that names the parameters which the
    observations cannot tell apart.
    """
    if not names:
        return np.zeros((0, 0)), 1.0
    if not np.isfinite(np.linalg.cond(normal.poses)).all() or np.linalg.cond(normal.poses).max() > MAX_CONDITION:
        return Failure(
            Reason.DEGENERATE_GEOMETRY,
            "an image has too few targets for its orientation: two stars at least, or an a priori attitude",
        )
    information = normal.information()
    diagonal = np.diag(information)
    if not (diagonal > 0).all():
        free = [name for name, value in zip(names, diagonal, strict=True) if not value > 0]
        return Failure(Reason.DEGENERATE_GEOMETRY, f"the observations say nothing of {', '.join(free)}")
    units = 1.0 / np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(information * np.outer(units, units))
    condition = float(values[-1] / values[0]) if values[0] > 0 else float("inf")
    if not condition < MAX_CONDITION:
        worst = np.abs(vectors[:, 0])
        mixed = [name for name, share in zip(names, worst, strict=True) if share > 0.3 * worst.max()]
        return Failure(
            Reason.DEGENERATE_GEOMETRY,
            f"the observations cannot tell {', '.join(mixed)} apart (condition number {condition:.1e}): estimate fewer "
            "of them, or give an a priori sigma",
        )
    covariance = (vectors / values) @ vectors.T
    return covariance * np.outer(units, units), condition
