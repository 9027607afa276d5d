"""Accuracy and consistency of the centre of brightness, over size, phase angle and reflectance law; prints JSON.

Irregular bodies rendered with rays at other places than the templates, Poisson and read noise, a priori errors of 10 px
and a normal deviate of 2 % in range. Errors are given in percent of the radius, beside the correction of paper 1 eq. 3;
the mean squared error over covariance (2 where that is honest) beside the band in which 95 % of such means lie.

Usage: python benchmarks/estimators_moment.py [--draws N]
"""

from __future__ import annotations

import argparse
import json
import sys

import numpy as np
from estimators_template import CAMERA, Draw, draw, timed
from scipy.stats import chi2

from giantlike.core.outcomes import CenterFix
from giantlike.ray_tracing import Lambert, LommelSeeliger, McEwen, Reflectance
from giantlike.relative.moment import Moment, MomentOptions

PHASES_DEG = (0.5, 20.0, 40.0, 60.0, 80.0, 100.0)
LAWS: dict[str, Reflectance] = {"exact law": McEwen(), "Lommel-Seeliger": LommelSeeliger(), "Lambert": Lambert()}


def measured(draws: list[Draw], radius_px: float, options: MomentOptions) -> dict[str, object]:
    estimator = Moment(options)
    errors, nees, seconds, failed = [], [], [], []
    for one in draws:
        fix, spent = timed(lambda one=one: estimator.estimate(one.image, CAMERA, one.scene))  # type: ignore[misc]
        seconds.append(spent)
        if not isinstance(fix, CenterFix):
            failed.append(str(fix))
            continue
        error = fix.center_px - one.center_px
        errors.append(error)
        nees.append(float(error @ np.linalg.solve(fix.covariance_px2, error)))
    band = [round(float(chi2.ppf(chance, 2 * len(nees))) / len(nees), 2) for chance in (0.025, 0.975)]
    size = np.linalg.norm(errors, axis=1)
    return {
        "draws": len(draws),
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
    count = parser.parse_args().draws
    report: dict[str, object] = {}
    for diameter_px in (20.0, 60.0, 300.0):
        for name, law in LAWS.items():
            draws = [
                draw(diameter_px, PHASES_DEG[seed % len(PHASES_DEG)], law, seed, range_sigma=0.02)
                for seed in range(count)
            ]
            options = {"rendered": MomentOptions()}
            if name == "exact law":
                options["kaasalainen_tanga"] = MomentOptions(correction="kaasalainen_tanga")
            for correction, chosen in options.items():
                key = f"{diameter_px:g} px, {name}, {correction}"
                report[key] = measured(draws, 0.5 * diameter_px, chosen)
                print(key, json.dumps(report[key]), file=sys.stderr, flush=True)
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
