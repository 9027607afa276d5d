"""The Levenberg-Marquardt loop of all bundle adjustments: cameras from stars, control networks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from giantlike.core.outcomes import Failure, Reason

_FIRST_DAMPING = 1e-3  # relative to the diagonal of the normal matrix: nearly Gauss-Newton
_SMALLEST_DAMPING, _LARGEST_DAMPING = 1e-15, 1e12  # below the rounding of float64; steps of 1e-12 of a gradient step
_FACTOR = 10.0  # of the damping after a step, as in step 4 of the paper
_CONVERGED, ROUGHLY = 1e-8, 1e-2  # predicted decrease of chi-square at which a fit, and a rough fit, has converged
_ROUNDING = 1e-12  # relative increase of the cost that is rounding and does not refuse a step


class Linearized(Protocol):
    """Normal equations at a state."""

    @property
    def cost(self) -> float:
        """Chi-square, or what a robust loss makes of it."""
        ...

    def solve(self, damping: float) -> Any:
        """Step with its ``decrement``, the predicted decrease of the cost; None if a matrix is singular."""
        ...


AnyState = TypeVar("AnyState")
AnyNormal = TypeVar("AnyNormal", bound=Linearized)


@dataclass(frozen=True, slots=True, eq=False)
class Minimum(Generic[AnyState, AnyNormal]):
    """Minimum of the cost: state, normal equations there without damping, and the number of steps."""

    state: AnyState
    normal: AnyNormal
    steps: int


def minimize(
    state: AnyState,
    linearize: Callable[[AnyState], AnyNormal | None],
    apply_step: Callable[[AnyState, Any], AnyState | None],
    *,
    max_steps: int,
    rough: bool = False,
    tolerance: float | None = None,
) -> Minimum[AnyState, AnyNormal] | Failure:
    r"""Levenberg-Marquardt: steps of :math:`(H^T W H + \lambda\,\mathrm{diag}(H^T W H))^{-1} H^T W r`.

    ``tolerance``: predicted decrease of the cost at convergence, by default 1e-8, 1e-2 for a rough fit; its root is the
    largest remaining step in units of sigma. ``linearize`` and ``apply_step`` return None for states that cannot be
    observed. A rough fit ends after ``max_steps`` without a failure. Damping changes tenfold, up after a step that
    increases the cost. (The paper's update lacks the weight on its right-hand side.)

    Source: Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, Camera Calibration,
    steps 1-5.
    """
    normal = linearize(state)
    if normal is None:
        return Failure(Reason.NOT_CONVERGED, "the starting model cannot project a target that was observed")
    damping, enough = _FIRST_DAMPING, tolerance or (ROUGHLY if rough else _CONVERGED)
    for count in range(max_steps):
        step = normal.solve(damping)
        if step is None and damping > _FIRST_DAMPING:
            return Failure(Reason.DEGENERATE_GEOMETRY, "the normal equations are singular")
        if step is not None and step.decrement <= enough and damping <= _FIRST_DAMPING:
            return Minimum(state, normal, count)
        moved = None if step is None else apply_step(state, step)
        ahead = None if moved is None else linearize(moved)
        if moved is not None and ahead is not None and ahead.cost <= normal.cost * (1.0 + _ROUNDING):
            state, normal = moved, ahead
            damping = max(damping / _FACTOR, _SMALLEST_DAMPING)
        elif damping < _LARGEST_DAMPING:
            damping *= _FACTOR
        else:
            break
    if rough:
        return Minimum(state, normal, max_steps)
    return Failure(Reason.NOT_CONVERGED, f"no convergence in {max_steps} steps (chi-square {normal.cost:.4g})")
