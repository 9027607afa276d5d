"""Errors of the estimators over the size of the disk and over the phase angle, beside the Cramer-Rao bound: a figure.

An ellipsoid of known law, so that every estimator has something to do; noise, PSF and predictions as in monte_carlo.py.
Writes ``error_curves.json`` and ``error_curves.svg``.

Usage: python benchmarks/error_curves.py OUTPUT_FOLDER [--draws 4] [--truths 3] [--quick]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from monte_carlo import bound_of, trials, truth_of

from giantlike.core.outcomes import CenterFix, PositionFix
from giantlike.plotting.style import MARKERS, SERIES, drawing, svg_text
from giantlike.ray_tracing import McEwen
from giantlike.relative import (
    CrossCorrelation,
    EllipseFit,
    EllipsoidCRA,
    Estimator,
    LimbMatching,
    LimbMatchingOptions,
    Moment,
    SigmoidLimb,
    Unresolved,
)
from giantlike.shapes import Ellipsoid

SIZES_PX = (4.0, 10.0, 20.0, 40.0, 100.0, 300.0, 1000.0)
PHASES_DEG = (0.0, 20.0, 40.0, 60.0, 80.0, 100.0, 120.0, 140.0)
SIZE_PX, PHASE_DEG = 300.0, 60.0
SHAPE = Ellipsoid(radii_km=np.array([0.3, 0.26, 0.22]))
ESTIMATORS: Mapping[str, Estimator] = {
    estimator.name: estimator
    for estimator in (
        Unresolved(),
        Moment(),
        CrossCorrelation(),
        LimbMatching(LimbMatchingOptions(min_diameter_px=15.0)),
        EllipsoidCRA(),
        SigmoidLimb(),
        EllipseFit(),
    )
}


def cell(diameter_px: float, phase_deg: float, draws: int, count: int) -> dict[str, object]:
    """Rms errors of each estimator at one size and phase; None where it found nothing."""
    frame = 512 if diameter_px <= 300.0 else 2048
    truths = [truth_of(SHAPE, diameter_px, phase_deg, McEwen(), 300 + k, size_px=frame) for k in range(count)]
    bounds = np.sqrt(np.mean([bound_of(truth, limb_only=False) for truth in truths], axis=0))
    found: dict[str, object] = {"bound": {"px": math.hypot(*bounds[:2]) / math.sqrt(2.0), "range": float(bounds[2])}}
    for name, estimator in ESTIMATORS.items():
        fixes = [
            (trial.answer, trial.draw.truth)
            for trial in trials(estimator, truths, draws)
            if isinstance(trial.answer, CenterFix)
        ]
        errors = np.array([fix.center_px - truth.center_px for fix, truth in fixes])
        ranges = [fix.range_km / truth.range_km - 1.0 for fix, truth in fixes if isinstance(fix, PositionFix)]
        found[name] = {
            "fixes": len(fixes),
            "px": float(np.sqrt(np.mean(errors**2))) if len(fixes) else None,
            "range": float(np.sqrt(np.mean(np.square(ranges)))) if ranges else None,
        }
    print(json.dumps({f"{diameter_px:g} px, {phase_deg:g} deg": found}), file=sys.stderr, flush=True)
    return {"diameter_px": diameter_px, "phase_deg": phase_deg} | found


def figure(by_size: list[dict[str, object]], by_phase: list[dict[str, object]]) -> str:
    """Center and range over size and over phase, as SVG."""
    with drawing():
        drawn = Figure(figsize=(10.0, 7.0), facecolor="white", layout="constrained")
        panels = drawn.subplots(2, 2)
        for column, (cells, key, label) in enumerate(
            ((by_size, "diameter_px", f"diameter, px (phase {PHASE_DEG:g} deg)"),
             (by_phase, "phase_deg", f"phase angle, deg (diameter {SIZE_PX:g} px)"))
        ):  # fmt: skip
            at = [one[key] for one in cells]
            for row, (quantity, name) in enumerate((("px", "rms per axis, px"), ("range", "rms of range, relative"))):
                axis = panels[row, column]
                for number, estimator in enumerate(ESTIMATORS):
                    values = np.array([_value(one, estimator, quantity) for one in cells])
                    if np.isfinite(values).any():
                        color, marker = SERIES[number % len(SERIES)], MARKERS[number % len(MARKERS)]
                        axis.plot(at, values, color=color, marker=marker, markersize=4, linewidth=1.1, label=estimator)
                bound = [_value(one, "bound", quantity) for one in cells]
                axis.plot(at, bound, "k--", linewidth=1.2, label="Cramer-Rao bound")
                axis.set(yscale="log", xlabel=label, ylabel=name)
                if key == "diameter_px":
                    axis.set_xscale("log")
        panels[0, 0].legend(loc="best", fontsize=7.5)
    return svg_text(drawn, "error curves")


def _value(one: dict[str, object], name: str, quantity: str) -> float:
    values = one[name]
    assert isinstance(values, dict)
    return math.nan if values[quantity] is None else float(values[quantity])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--draws", type=int, default=4, help="of every truth")
    parser.add_argument("--truths", type=int, default=3, help="of every cell")
    parser.add_argument("--quick", action="store_true", help="three sizes and three phases")
    arguments = parser.parse_args()
    sizes, phases = (SIZES_PX[::3], PHASES_DEG[1::3]) if arguments.quick else (SIZES_PX, PHASES_DEG)
    by_size = [cell(size, PHASE_DEG, arguments.draws, arguments.truths) for size in sizes]
    by_phase = [cell(SIZE_PX, phase, arguments.draws, arguments.truths) for phase in phases]
    arguments.output.mkdir(parents=True, exist_ok=True)
    report = {"by_size": by_size, "by_phase": by_phase}
    (arguments.output / "error_curves.json").write_text(json.dumps(report, indent=1) + "\n")
    (arguments.output / "error_curves.svg").write_text(figure(by_size, by_phase))


if __name__ == "__main__":
    main()
