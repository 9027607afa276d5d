"""Whole-pass estimator over many simulated Earth passes: errors of all parameters over their covariance; prints JSON.

The truth of a pass (altitude of the limb, pointing, drift, interlock, timetags, radius by exposure, trajectory) is made
anew in each run; limb points come from the parametric form of an ellipsoid, of which the estimator knows nothing.

Usage: python benchmarks/pass_estimator.py [--runs 300]
"""

from __future__ import annotations

import argparse
import json
import math
import time

import numpy as np
from scipy.stats import chi2, kstest

from giantlike.calibration.options import Treatment
from giantlike.passes import PassFix, PassOptions, PassTerm, estimate_pass
from tests.passes.simulated_pass import TRUE_ALTITUDE_KM, Truth, as_positions, simulated_pass

TRAJECTORY_SIGMAS = np.array([4.0, 4.0, 8.0, 1e-3, 1e-3, 1e-3])
SIGMAS = {
    PassTerm.POINTING_BIAS: 1e-4,
    PassTerm.POINTING_DRIFT: 3e-8,
    PassTerm.INTERLOCK: 1e-4,
    PassTerm.TIMETAG_BIAS: 0.5,
}
JITTER_S = 0.3
CHANCE = 1e-3  # of a band that an honest estimator leaves, on either side


def options(kind: str) -> PassOptions:
    estimate = {PassTerm.LIMB_ALTITUDE: math.inf, **SIGMAS, PassTerm.EXPOSURE_STEPS: math.inf}
    if kind == "positions":
        del estimate[PassTerm.INTERLOCK]
    return PassOptions(
        estimate=estimate,
        trajectory=Treatment.ESTIMATE if kind == "trajectory estimated" else Treatment.CONSIDER,
        timetag_jitter_s=0.0 if kind == "positions" else JITTER_S,
        estimate_jitter=kind == "jitter estimated",
    )


def run(kind: str, seed: int) -> tuple[float, int, float, float]:
    """Squared error over covariance, number of parameters, chance of the altitude, error of the jitter in sigmas."""
    rng = np.random.default_rng([seed, len(kind)])
    turns = {term: SIGMAS[term] * rng.normal(size=3) for term in SIGMAS if term is not PassTerm.TIMETAG_BIAS}
    positions = kind == "positions"
    truth = Truth(
        bias_rad=turns[PassTerm.POINTING_BIAS],
        drift_rad_s=turns[PassTerm.POINTING_DRIFT],
        interlock_rad=turns[PassTerm.INTERLOCK] * (not positions),
        late_s=SIGMAS[PassTerm.TIMETAG_BIAS] * rng.normal(),
        jitter_s=0.0 if positions else JITTER_S,
        step_px=0.5 * rng.normal(),
        trajectory=TRAJECTORY_SIGMAS * rng.normal(size=6),
    )
    given = simulated_pass(
        truth, rng, images=30, points=4 if positions else 20, sensors=("a", "b"), trajectory_sigmas=TRAJECTORY_SIGMAS
    )
    if positions:
        given = as_positions(given, truth, rng)
    fix = estimate_pass(given, options(kind))
    if not isinstance(fix, PassFix):
        raise SystemExit(f"{kind}, seed {seed}: {fix.detail}")
    true = {
        PassTerm.LIMB_ALTITUDE: [TRUE_ALTITUDE_KM],
        PassTerm.POINTING_BIAS: truth.bias_rad,
        PassTerm.POINTING_DRIFT: truth.drift_rad_s,
        PassTerm.INTERLOCK: truth.interlock_rad,
        PassTerm.TIMETAG_BIAS: [truth.late_s],
        PassTerm.EXPOSURE_STEPS: [truth.step_px],
        "trajectory": truth.trajectory,
    }
    expected = np.concatenate([np.atleast_1d(true[term]) for term in dict.fromkeys(fix.terms)])
    error = (fix.values - expected) / fix.sigmas
    altitude = float(chi2.sf(error[0] ** 2, 1))
    jitter = math.nan
    if fix.jitter is not None and fix.jitter.sigma_of_log > 0.0:
        jitter = math.log(fix.jitter.sigma_s / JITTER_S) / fix.jitter.sigma_of_log
    return float(error @ np.linalg.solve(fix.correlation, error)), error.size, altitude, jitter


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=300)
    runs = parser.parse_args().runs
    report = {}
    for kind in ("trajectory considered", "trajectory estimated", "jitter estimated", "positions"):
        start = time.process_time()
        results = [run(kind, seed) for seed in range(runs)]
        count = results[0][1]
        low, high = (float(chi2.ppf(chance, count * runs)) / (count * runs) for chance in (CHANCE, 1.0 - CHANCE))
        mean = float(np.mean([each[0] for each in results])) / count
        jitters = [each[3] for each in results if math.isfinite(each[3])]
        report[kind] = {
            "runs": runs,
            "parameters": count,
            "squared_error_over_covariance_per_parameter": round(mean, 4),
            "band": [round(low, 4), round(high, 4)],
            "in_band": low < mean < high,
            "chances_of_the_altitude_uniform_p": round(
                float(kstest([each[2] for each in results], "uniform").pvalue), 4
            ),
            "jitter_error_rms_in_sigmas": round(float(np.sqrt(np.mean(np.square(jitters)))), 3) if jitters else None,
            "cpu_s_per_pass": round((time.process_time() - start) / runs, 3),
        }
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
