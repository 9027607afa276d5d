"""Accuracy, consistency and speed of the estimators that work on limbs, beside the Cramer-Rao bound; prints JSON.

Rows of the table of targets: bodies of 300 px (and others with ``--sizes``), phase angles from 20 to 120 degrees, the
reflectance law that the estimator is told, or another one. ``nees_of_3`` is the mean squared error of the position over
its covariance, 3 where that is honest; where errors are shared by the draws of one truth, as those of a wrong law are,
its standard error is that among truths and not the width of the band.

Usage: python benchmarks/estimators_limb.py [--draws 12] [--truths 18] [--rows limb_matching] [--sizes 20,30,...]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from monte_carlo import PHASES_DEG, Truth, render_cost_s, run_cell, summary, trials, truth_of

from giantlike.ray_tracing import LommelSeeliger, McEwen
from giantlike.relative import EllipsoidCRA, Estimator, LimbMatching, LimbMatchingOptions
from giantlike.shapes import Ellipsoid, Shape, irregular_body

TRUE_LAW, OTHER_LAW = McEwen(), LommelSeeliger()
LARGEST_IN_1024_PX = 600.0


@dataclass(frozen=True)
class Row:
    """An estimator and the bodies that it is tried on."""

    name: str
    estimator: Estimator
    shapes: Sequence[Shape]


ROWS = (
    Row(
        "limb_matching",
        LimbMatching(LimbMatchingOptions(min_diameter_px=15.0)),
        [irregular_body(seed, facets=50_000) for seed in (1, 2, 3)],
    ),
    Row("ellipsoid_cra", EllipsoidCRA(), [Ellipsoid(radii_km=np.array([0.3, 0.26, 0.22]))]),
)


def truths_for(row: Row, diameter_px: float, phases_deg: Sequence[float], count: int) -> list[Truth]:
    """Truths with the phase angles and shapes in turn."""
    return [
        truth_of(
            row.shapes[number % len(row.shapes)],
            diameter_px,
            phases_deg[number % len(phases_deg)],
            TRUE_LAW,
            100 + number,
            size_px=1024 if diameter_px <= LARGEST_IN_1024_PX else 2048,
        )
        for number in range(count)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=12, help="of every truth")
    parser.add_argument("--truths", type=int, default=18, help="of every cell")
    parser.add_argument("--rows", default=",".join(row.name for row in ROWS))
    parser.add_argument("--sizes", default="300", help="mean diameters, px, with commas")
    parser.add_argument("--by-phase", action="store_true", help="a cell for each phase angle")
    arguments = parser.parse_args()
    report: dict[str, object] = {}
    for row in (row for row in ROWS if row.name in arguments.rows.split(",")):
        for diameter_px in (float(size) for size in arguments.sizes.split(",")):
            for phases_deg in [(p,) for p in PHASES_DEG] if arguments.by_phase else [PHASES_DEG]:
                truths = truths_for(row, diameter_px, phases_deg, arguments.truths)
                label = f"{row.name} {diameter_px:g} px" + (f" {phases_deg[0]:g} deg" if arguments.by_phase else "")
                for name, told in (("exact law", None), ("other law", OTHER_LAW)):
                    done = trials(row.estimator, truths, arguments.draws, told=told)
                    run_cell(f"{label}, {name}", summary(done, truths), report)
                run_cell(f"{label}, bare render", {"cpu_s": render_cost_s(truths[0])}, report)
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
