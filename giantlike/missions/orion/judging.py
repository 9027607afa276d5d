"""Rules by which a number of ours agrees with one of the paper."""

from __future__ import annotations

from giantlike.missions.replay import Comparison, ComparisonKind, Stated

ROUNDING = 0.005
"""Relative: numbers that the paper gives with three digits."""
ANALYSIS = 0.10
"""Required relative agreement of linear covariance and flown runs."""
MODEL = 0.5
"""Relative: an error model fitted to other images of another renderer."""


class Number(Stated):
    """A number of the paper, and ours."""

    __slots__ = ()

    def __init__(self, reference: str, what: str, paper: float, ours: float, kind: ComparisonKind) -> None:
        Stated.__init__(self, reference, what, float(paper), float(ours), kind)

    def near(self, within: float, because: str) -> Comparison:
        """Compare the two: they agree within a relative tolerance."""
        paper, ours = float(self.paper), float(self.ours)
        return self.agrees(abs(ours - paper) <= within * abs(paper), f"Agrees within {100.0 * within:g} %. {because}")

    def at_most(self, because: str) -> Comparison:
        """Compare the two: ours must not be larger, such as an error within its model."""
        agrees = abs(float(self.ours)) <= abs(float(self.paper))
        return self.agrees(agrees, f"Agrees where ours is not larger. {because}")
