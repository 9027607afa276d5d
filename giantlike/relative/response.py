"""Values that do not grow in proportion to light: tables of square roots, gamma, detectors near their full well."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

from giantlike.core.findings import Response

LEAST_BEND = 0.25
"""Bend that residuals ask for from which on it is tried. Of the gauntlet tables of square roots ask for 0.34 and more,
images with nothing but another law for 0.03 at most, markings for 0.3."""
DISPLAY_BEND_SIGMA = 1.0
"""A priori standard deviation of the bend, about 0, of values of 8-bit JPEG and PNG files whose camera declares no
gamma and no noise: they may be proportional to light (0), or coded for display, where light goes as their power of 2.2
(nearly 1, which is the square)."""
BEND_STEP = 0.1
"""Bend by which values are changed to see how a fix follows."""
MOST_BEND = 0.98
_BENDINGS, _SETTLED_BEND = 6, 0.02
"""Trials of a response, at most, and the change of its bend, if not its standard deviation, below which it is found:
what remains is estimated."""

Trial = TypeVar("Trial")


def settled(
    first: Response, tried: Callable[[Response], Trial | None], asked: Callable[[Trial], tuple[Response, float]]
) -> Trial | None:
    """Straighten values by the bend that residuals ask for, until they ask for no other.

    Returns None where the bend does not settle, or settles where there is next to none.
    """
    response = first
    for _ in range(_BENDINGS):
        response = replace(response, bend=min(max(response.bend, 0.0), MOST_BEND))
        trial = tried(response)
        if trial is None:
            return None
        found, sigma = asked(trial)
        if abs(found.bend - response.bend) < max(_SETTLED_BEND, sigma):
            return trial if found.bend > LEAST_BEND else None
        response = found
    return None
