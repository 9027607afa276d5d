"""The fix of a target in an image that a filter should take, of those that several estimators made."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from giantlike.core.outcomes import CenterFix
from giantlike.relative.consensus import agreement_of

_DISAGREE = 1e-3  # probability below which two fixes contradict each other: one false alarm in 1,000
_CHECKED = "auto"


@dataclass(frozen=True, slots=True)
class Preference:
    """The preferred one of some fixes."""

    index: int | None  # its index; None where none can be preferred
    reason: str  # one line


def preferred(fixes: Sequence[CenterFix], *, accepted: Collection[int] = ()) -> Preference:
    """Choose the fix that a filter should take.

    Suspect fixes are chosen only where a user accepted them. ``auto`` is taken where it was run. Else fixes
    are compared by the errors that they do not share; of those that agree with the most others, the one with the
    smallest error ellipse in the image is chosen.

    >>> preferred([])
    Preference(index=None, reason='no fix')
    """
    good = [index for index, fix in enumerate(fixes) if not fix.flags.suspect or index in accepted]
    if not good:
        return Preference(None, "no fix" if not fixes else "all fixes are suspect")
    for index in good:
        if fixes[index].estimator == _CHECKED:
            checked = fixes[index].findings.checked_by
            return Preference(index, f"auto, checked by {checked}" if checked else "auto, which nothing else confirms")
    if len(good) == 1:
        kind = "accepted by a user" if fixes[good[0]].flags.suspect else "not suspect"
        return Preference(good[0], f"the only fix that is {kind}")
    friends = {i: sum(agreement_of(fixes[i], fixes[j]) >= _DISAGREE for j in good if j != i) for i in good}
    most = max(friends.values())
    agreeing = [index for index in good if friends[index] == most]
    best = min(agreeing, key=lambda index: _size_px(fixes[index]))
    size, others = f"{_size_px(fixes[best]):.3g} px", len(good) - 1
    if most == 0:
        return Preference(best, f"smallest sigma ({size}); the {len(good)} fixes contradict one another")
    return Preference(best, f"smallest sigma ({size}) of the fixes that agree with {most} of {others} others")


def _size_px(fix: CenterFix) -> float:
    """Largest semi-axis of the error ellipse in the image, px."""
    return float(np.sqrt(np.linalg.eigvalsh(fix.covariance_px2)[-1]))
