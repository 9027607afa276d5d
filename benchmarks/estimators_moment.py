"""Accuracy and consistency of the center of brightness, over size, phase angle and reflectance law; prints JSON.

Irregular bodies rendered with rays at other places than the templates, Poisson and read noise, a priori errors of 10 px
and a normal deviate of 2 % in range. Errors are given in percent of the radius, beside the correction of
Liounis et al. eq. 3; the mean squared error over covariance (2 where that is honest) beside the band in which 95 % of
such means lie.

Usage: python benchmarks/estimators_moment.py [--draws N] [--sizes PX ...]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator

import numpy as np
from scipy.stats import chi2
from template_truth import CAMERA, Draw, draw_of, truth_of

from giantlike.core.outcomes import CenterFix
from giantlike.ray_tracing import Lambert, LommelSeeliger, McEwen, Reflectance
from giantlike.relative.light.moment import Moment, MomentOptions

PHASES_DEG = (0.5, 20.0, 40.0, 60.0, 80.0, 100.0)
LAWS: dict[str, Reflectance] = {"exact law": McEwen(), "Lommel-Seeliger": LommelSeeliger(), "Lambert": Lambert()}


def drawn(diameter_px: float, law: Reflectance, count: int) -> Iterator[Draw]:
    """Images under ``law``, said to be McEwen's: two of each body, pose and phase."""
    for number in range((count + 1) // 2):
        truth = truth_of(number, diameter_px, PHASES_DEG[number % len(PHASES_DEG)], law=law)
        for seed in range(2):
            yield draw_of(truth, seed, range_error=0.0, range_sigma=0.02, law=McEwen())


def measured(draws: Iterator[Draw], radius_px: float, options: dict[str, MomentOptions]) -> dict[str, object]:
    fixes: dict[str, list[tuple[object, Draw, float]]] = {name: [] for name in options}
    for one in draws:
        for name, chosen in options.items():
            started = time.process_time()
            fix = Moment(chosen).estimate(one.image, CAMERA, one.scene)
            fixes[name].append((fix, one, time.process_time() - started))
    return {name: summary(found, radius_px) for name, found in fixes.items()}


def summary(found: list[tuple[object, Draw, float]], radius_px: float) -> dict[str, object]:
    errors, nees, failed = [], [], []
    for fix, one, _ in found:
        if not isinstance(fix, CenterFix):
            failed.append(str(fix))
            continue
        error = fix.center_px - one.truth.center_px
        errors.append(error)
        nees.append(float(error @ np.linalg.solve(fix.covariance_px2, error)))
    seconds = [spent for _, _, spent in found]
    band = [round(float(chi2.ppf(chance, 2 * len(nees))) / len(nees), 2) for chance in (0.025, 0.975)]
    size = np.linalg.norm(errors, axis=1)
    return {
        "draws": len(found),
        "failed": failed,
        "rms_per_axis_px": round(float(np.sqrt(np.mean(np.square(errors)))), 3),
        "rms_percent_of_radius": round(100.0 * float(np.sqrt(np.mean(size**2))) / radius_px, 2),
        "worst_percent_of_radius": round(100.0 * float(size.max()) / radius_px, 2),
        "nees_of_2": round(float(np.mean(nees)), 2),
        "nees_band_95": band,
        "median_cpu_s": round(float(np.median(seconds)), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=204)
    parser.add_argument("--sizes", type=float, nargs="+", default=[20.0, 60.0, 300.0])
    arguments = parser.parse_args()
    count = arguments.draws
    report: dict[str, object] = {}
    for diameter_px in arguments.sizes:
        for name, law in LAWS.items():
            options = {"rendered": MomentOptions()}
            if name == "exact law":
                options["kaasalainen_tanga"] = MomentOptions(correction="kaasalainen_tanga")
            key = f"{diameter_px:g} px, {name}"
            report[key] = measured(drawn(diameter_px, law, count), 0.5 * diameter_px, options)
            print(key, json.dumps(report[key]), file=sys.stderr, flush=True)
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
