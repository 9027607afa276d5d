"""Rules by which a number of ours agrees with one of the paper."""

from __future__ import annotations

from giantlike.missions.replay import Comparison, ComparisonKind

ROUNDING = 0.005
"""Relative: numbers that the paper gives with three digits."""
ANALYSIS = 0.10
"""Required relative agreement of linear covariance and flown runs."""
MODEL = 0.5
"""Relative: an error model fitted to other images of another renderer."""


def near(
    what: str, paper: float, ours: float, *, kind: ComparisonKind, within: float, reference: str, because: str
) -> Comparison:
    """Two numbers that agree within a relative tolerance."""
    because = f"Agrees within {100.0 * within:g} %. {because}"
    holds = abs(ours - paper) <= within * abs(paper)
    return stated(what, float(paper), float(ours), holds=holds, kind=kind, reference=reference, because=because)


def bounded(what: str, paper: float, ours: float, *, kind: ComparisonKind, reference: str, because: str) -> Comparison:
    """A number of ours that the paper's must not fall short of, such as an error within its model."""
    because, holds = f"Agrees where ours is not larger. {because}", abs(ours) <= abs(paper)
    return stated(what, float(paper), float(ours), holds=holds, kind=kind, reference=reference, because=because)


def stated(
    what: str, paper: str | float, ours: str | float, *, holds: bool, kind: ComparisonKind, reference: str, because: str
) -> Comparison:
    """A statement of the paper, and whether the replay confirms it."""
    return Comparison(
        what=what, paper=paper, ours=ours, kind=kind, agrees=bool(holds), reason=because, reference=reference
    )
