"""Accuracy, consistency and speed of the estimators that work on limbs; prints JSON.

Bodies of the template benchmark for limb_matching and a triaxial ellipsoid for ellipsoid_cra, at phase angles from 20
to 120 degrees, rendered with the law that the estimator knows and with another one. Beside the errors stands the mean
squared error of the position over its covariance (3 where that is honest) and the band in which 95 % of such means lie.

Usage: python benchmarks/estimators_limb.py [draws per size and law]
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
from estimators_template import CAMERA, Draw, draw, timed
from scipy.stats import chi2

from giantlike.core.outcomes import PositionFix
from giantlike.ray_tracing import Lambert, McEwen, Reflectance
from giantlike.relative import EllipsoidCRA, Estimator, LimbMatching, LimbMatchingOptions
from giantlike.scene import Scene
from giantlike.shapes import Ellipsoid, Shape

PHASES_DEG = (20.0, 40.0, 60.0, 80.0, 100.0, 120.0)
ELLIPSOID = Ellipsoid(radii_km=np.array([0.3, 0.26, 0.22]))
KNOWN, OTHER = McEwen(), Lambert()


def taken(diameter_px: float, law: Reflectance, seed: int, shape: Shape | None) -> Draw:
    """An image under ``law`` of which the estimator is told the known one."""
    one = draw(diameter_px, PHASES_DEG[seed % len(PHASES_DEG)], law, seed, shape=shape)
    target = one.scene.targets[0]
    return replace(one, scene=Scene(targets=(replace(target, reflectance=KNOWN),)))


def measured(estimator: Estimator, draws: list[Draw]) -> dict[str, object]:
    errors, ranges, nees, seconds, failed = [], [], [], [], []
    for one in draws:
        fix, spent = timed(lambda one=one: estimator.estimate(one.image, CAMERA, one.scene))  # type: ignore[misc]
        seconds.append(spent)
        if not isinstance(fix, PositionFix):
            failed.append(str(fix))
            continue
        error_km = fix.position_camera_km - one.body.position_camera_km
        errors.append(fix.center_px - one.center_px)
        ranges.append(fix.range_km / one.range_km - 1.0)
        nees.append(float(error_km @ np.linalg.solve(fix.covariance_camera_km2, error_km)))
    band = [round(float(chi2.ppf(chance, 3 * len(nees))) / len(nees), 2) for chance in (0.025, 0.975)]
    return {
        "draws": len(draws),
        "failed": failed,
        "rms_px": np.sqrt(np.mean(np.square(errors), axis=0)).round(4).tolist(),
        "rms_range": float(f"{np.sqrt(np.mean(np.square(ranges))):.2g}"),
        "nees_of_3": round(float(np.mean(nees)), 2),
        "nees_band_95": band,
        "worst_nees": round(float(np.max(nees)), 1),
        "median_cpu_s": round(float(np.median(seconds)), 2),
    }


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 102
    report: dict[str, object] = {}
    estimators: tuple[tuple[Estimator, Shape | None], ...] = (
        (LimbMatching(LimbMatchingOptions(min_diameter_px=20.0)), None),
        (EllipsoidCRA(), ELLIPSOID),
    )
    for estimator, shape in estimators:
        for diameter_px in (30.0, 100.0, 300.0):
            for name, law in (("exact law", KNOWN), ("other law", OTHER)):
                draws = [taken(diameter_px, law, seed, shape) for seed in range(count)]
                key = f"{estimator.name} {diameter_px:g} px, {name}"
                report[key] = measured(estimator, draws)
                print(key, json.dumps(report[key]), file=sys.stderr, flush=True)
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
