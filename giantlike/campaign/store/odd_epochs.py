"""Epochs that do not belong to their run: a clock that was never set, or was reset, as if it were 1990 or 2150."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from giantlike.core.units import SECONDS_PER_JULIAN_YEAR

_LEAST_S = 5.0 * SECONDS_PER_JULIAN_YEAR  # odd distance from the median: longer than a phase of a mission
_SPREADS = 20.0  # smallest distance in median absolute deviations: images of decades, evenly spread, reach 2
_LEAST_IMAGES = 3  # of two images none is known to be the odd one


def odd_epochs(epochs_et: Mapping[str, float | None]) -> dict[str, float]:
    """Images whose epoch is far from those of the others, with its distance from the median in years.

    >>> odd_epochs({"a": 7.6e8, "b": 7.6e8 + 60.0, "c": 7.6e8 + 120.0, "d": -3.15e8})
    {'d': -34.1}
    """
    known = {name: et for name, et in epochs_et.items() if et is not None and np.isfinite(et)}
    if len(known) < _LEAST_IMAGES:
        return {}
    et = np.array(list(known.values()))
    away_s = et - np.median(et)
    limit_s = max(_LEAST_S, _SPREADS * float(np.median(np.abs(away_s))))
    return {
        name: round(float(away) / SECONDS_PER_JULIAN_YEAR, 1)
        for name, away in zip(known, away_s, strict=True)
        if abs(away) > limit_s
    }
