"""Linear covariance analysis: how far a spacecraft strays, and how well it knows, without flying a thousand runs.

Truth and estimate are dispersed together about one reference: a measurement moves the estimate by the gain of the
filter, a correction moves both by the commanded amount. The truth may differ from the filter's model: other noise,
biases unknown to the filter. Steps are given for a filter of n states; the joint vector has 2 n.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float, require
from giantlike.core.values import Value


@dataclass(frozen=True, slots=True, eq=False)
class JointDispersion(Value):
    """Truth and estimate, each minus the reference."""

    mean: Float  # (2 n,); of the truth, then of the estimate
    covariance: Float  # (2 n, 2 n)

    @classmethod
    def at_start(cls, covariance_true: Float, covariance_error: Float) -> JointDispersion:
        """Dispersion of a truth, and of an estimate wrong by an independent error, by covariances (n, n)."""
        rows = [[covariance_true, covariance_true], [covariance_true, covariance_true + covariance_error]]
        return cls(np.zeros(2 * len(covariance_true)), np.block(rows))

    def truth(self) -> tuple[Float, Float]:
        """Mean (n,) and covariance (n, n) of the truth about the reference."""
        n = len(self.mean) // 2
        return self.mean[:n], self.covariance[:n, :n]

    def navigation_error(self) -> tuple[Float, Float]:
        """Mean and covariance of truth minus estimate. Returns ``mean`` (n,) and ``covariance`` (n, n)."""
        n = len(self.mean) // 2
        difference = np.concatenate([np.eye(n), -np.eye(n)], axis=1)
        covariance = difference @ self.covariance @ difference.T
        return difference @ self.mean, (covariance + covariance.T) / 2.0


def dispersed_step(joint: JointDispersion, matrix: Float, noise: Float) -> JointDispersion:
    """Dispersion after a step (n, n) that truth and estimate take alike, and noise (n, n) of the truth."""
    n = len(matrix)
    both = np.kron(np.eye(2), matrix)
    covariance = both @ joint.covariance @ both.T
    covariance[:n, :n] += noise
    return JointDispersion(both @ joint.mean, (covariance + covariance.T) / 2.0)


def dispersed_measurement(
    joint: JointDispersion, gain: Float, partials: Float, variance: float, bias: float = 0.0
) -> JointDispersion:
    """Dispersion after one scalar measurement. ``gain``, ``partials`` (n,)."""
    require(variance >= 0.0, f"variance must be >= 0, got {variance}")
    n = len(gain)
    moved = np.concatenate([np.zeros(n), gain])
    matrix = np.eye(2 * n) + np.outer(moved, np.concatenate([partials, -partials]))
    covariance = matrix @ joint.covariance @ matrix.T + variance * np.outer(moved, moved)
    return JointDispersion(matrix @ joint.mean + moved * bias, (covariance + covariance.T) / 2.0)


def dispersed_correction(
    joint: JointDispersion, commanded: Float, by_parameters: Float, execution: Float, sensing: Float
) -> JointDispersion:
    """Dispersion after a correction that the estimate commands and an accelerometer senses; all matrices (n, n)."""
    n = len(commanded)
    matrix = np.eye(2 * n)
    matrix[:n, n:] = commanded
    matrix[n:, n:] += commanded + by_parameters
    matrix[n:, :n] -= by_parameters
    covariance = matrix @ joint.covariance @ matrix.T + np.kron(np.ones((2, 2)), execution)
    covariance[n:, n:] += sensing
    return JointDispersion(matrix @ joint.mean, (covariance + covariance.T) / 2.0)
