"""Nonlinear response: square-root tables, gamma, detectors near their full well."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

from giantlike.core.findings import Response

LEAST_BEND = 0.25
"""Minimum curvature estimated from residuals to fit a nonlinear response. In the gauntlet the estimate is at least 0.34
for square-root tables, at most 0.03 for another law alone, and 0.3 for markings."""
DISPLAY_BEND_SIGMA = 1.0
"""A priori standard deviation of the curvature, about 0, of 8-bit JPEG and PNG files whose camera declares neither
gamma nor noise: values may be linear (0), or display-coded, where light is their power of 2.2 (nearly 1, the
square)."""
BEND_STEP = 0.1  # step of the curvature for the numerical derivative of a fix
MOST_BEND = 0.98
_BENDINGS, _SETTLED_BEND = 6, 0.02
"""Maximum number of trials of a response, and change of its curvature at convergence, unless its standard deviation is
larger; the rest is estimated linearly."""

Trial = TypeVar("Trial")


def find_response(
    first: Response, tried: Callable[[Response], Trial | None], asked: Callable[[Trial], tuple[Response, float]]
) -> Trial | None:
    """Linearize values by the curvature estimated from residuals, until it converges.

    Returns None where the curvature does not converge, or is negligible.
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
