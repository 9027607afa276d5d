"""Display of a run in notebooks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from giantlike.campaign.store.results import RunResult
from giantlike.core.arrays import require
from giantlike.core.display import paints
from giantlike.plotting.style import GRAY, MARKERS, SERIES, drawing, new_panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_AXES = ("x", "y")


@paints(RunResult)
def draw_run(run: RunResult, axes: Axes | None = None, *, target: str | None = None, axis: str = "x") -> Axes:
    """Draw observed minus predicted centers of a target over the images of a run, with bars of one sigma."""
    if axes is None:
        with drawing():
            _, panels = new_panels(7.2, 3.2, shown=True)
        axes = panels[0]
    require(axis in _AXES, f"there is no axis {axis!r}; there are x and y")
    targets = list(dict.fromkeys(one.target for one in run.observations))
    axes.set(xlabel="image", title=run.name)
    if not targets:
        axes.plot([record.n_matched or 0 for record in run.attitudes], "o", color=SERIES[0])
        axes.set_ylabel("stars matched")
        return axes
    target = target or targets[0]
    require(target in targets, f"there is no target {target!r}; there are {', '.join(targets)}")
    k = _AXES.index(axis)
    for number, ((name, estimator), records) in enumerate(run.by_estimator.items()):
        found = [one for one in records if name == target and one.center_px and one.predicted_px and one.covariance_px2]
        if not found:
            continue
        off = [one.center_px[k] - one.predicted_px[k] for one in found if one.center_px and one.predicted_px]
        sigma = [np.sqrt(one.covariance_px2[k][k]) for one in found if one.covariance_px2]
        marker, color, at = MARKERS[number % len(MARKERS)], SERIES[number % len(SERIES)], [one.index for one in found]
        axes.errorbar(at, off, yerr=sigma, fmt=marker, color=color, markersize=4.5, capsize=2.0, label=estimator)
    axes.axhline(0.0, color=GRAY, linewidth=0.9)
    axes.set(ylabel=f"observed - predicted {axis}, px", title=f"{run.name}: {target}")
    axes.legend()
    return axes
