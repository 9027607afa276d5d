"""The navigation filter of 21 states: beside dense matrices, beside Stone Soup, and consistent over many runs.

    python benchmarks/filter.py [--runs 500] [--output FILE.json]

A day on the way back from the Moon with a pass of images of the Moon and one of the Earth, flown by the independent
truth of ``giantlike.independent.flight``. Prints JSON: the largest differences of covariance (over products of sigmas)
and mean (over sigmas), and the normalized squared errors and innovations with their 95 % bands. ``filter.md`` holds
the results; ``giantlike replay orion`` has linear covariance beside flown runs.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from giantlike.cislunar import (
    FilterModel,
    FilterState,
    estimate_batch,
    measurement_update,
    time_update,
)
from giantlike.core.arrays import Float
from giantlike.core.outcomes import Failure
from tests.cislunar.cislunar_case import MODEL, flown
from tests.cislunar.test_cislunar_filter import CONSIDERED, correlated_start, dense_joseph, images
from tests.cislunar.test_stone_soup import by_stone_soup

SEED = 2026


def filtered() -> FilterState:
    """The filter at the end of the images that the others are given."""
    state = correlated_start()
    for observation in images(np.random.default_rng(5)):
        state, _ = measurement_update(time_update(state, observation.et, MODEL), observation, MODEL)
    return state


def difference(state: FilterState, mean: Float, covariance: Float) -> dict[str, float]:
    """Largest differences in units of sigmas."""
    sigma = np.sqrt(np.diag(covariance))
    apart = (state.factors.composed() - covariance) / np.outer(sigma, sigma)
    return {"covariance": float(np.abs(apart).max()), "mean": float(np.abs((state.mean - mean) / sigma).max())}


def consistency(runs: int, model: FilterModel) -> dict[str, Any]:
    """Mean normalized squared errors and innovations of many runs, with bands that hold them in 95 of 100 cases."""
    started = time.process_time()
    result = flown(runs, SEED, model)
    measurements = 3 * len(result.innovations)
    squared = {
        "nees": (result.state.squared_error(result.truth), 21),
        "nis": (np.sum([each.squared() for each in result.innovations], axis=0), measurements),
    }
    found: dict[str, Any] = {"cpu_s": time.process_time() - started}
    for name, (each_run, degrees) in squared.items():
        band = [float(chi2.ppf(tail, degrees * runs)) / runs for tail in (0.025, 0.975)]
        value = float(np.mean(each_run))
        found[name] = {
            "mean": value,
            "standard_error": float(np.std(each_run, ddof=1)) / np.sqrt(runs),
            "degrees": degrees,
            "band_95": band,
            "in_band": band[0] <= value <= band[1],
        }
    error = result.state.error(result.truth)
    found["rms_over_sigma"] = np.sqrt(np.mean((error / result.state.factors.sigmas()) ** 2, axis=0)).round(3).tolist()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    seen, state = images(np.random.default_rng(5)), filtered()
    batch = estimate_batch(correlated_start(), seen, MODEL)
    result: dict[str, Any] = {
        "joseph": difference(state, *dense_joseph(correlated_start(), seen, MODEL)),
        "stone_soup": difference(state, *by_stone_soup(seen)),
        "batch": None if isinstance(batch, Failure) else difference(state, batch.last_mean, batch.covariance_last),
        "runs": arguments.runs,
        "estimated": consistency(arguments.runs, MODEL),
        "considered": consistency(arguments.runs, replace(MODEL, considered=CONSIDERED)),
    }
    text = json.dumps(result, indent=1)
    if arguments.output is not None:
        arguments.output.write_text(text + "\n")
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
