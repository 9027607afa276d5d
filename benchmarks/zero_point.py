"""Zero points of cameras: errors on independent star fields (``fields``), on real frames.

Prints JSON. The real frames lie in ``../shared/data/stars`` beside the project.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from typing import Any

import numpy as np

import giantlike as gl
from benchmarks.zero_point_truth import field


def fields(count: int, method: str) -> dict[str, Any]:
    """NEES of the three terms over fields, and the errors of the zero point."""
    started, nees, errors, sigmas, failed, scaled = time.process_time(), [], [], [], 0, []
    for seed in range(count):
        answer, truth = field(seed, method)
        if isinstance(answer, gl.Failure):
            failed += 1
            continue
        one = answer.photometry
        error = np.array([answer.value_mag, one.color_term, one.field_term_mag]) - truth
        nees.append(float(error @ np.linalg.solve(answer.covariance_mag2, error)) / 3.0)
        scaled.append(error / np.sqrt(np.diag(answer.covariance_mag2)))
        errors.append(abs(error[0]))
        sigmas.append(math.sqrt(answer.covariance_mag2[0, 0]))
    precise = np.array(sigmas) <= 0.01
    return {
        "method": method,
        "fields": count,
        "failed": failed,
        "nees": float(np.mean(nees)),
        "mean_over_sigma": np.mean(scaled, axis=0).round(3).tolist(),
        "rms_over_sigma": np.sqrt(np.mean(np.square(scaled), axis=0)).round(3).tolist(),
        "median_error_mag": float(np.median(errors)),
        "median_sigma_mag": float(np.median(sigmas)),
        "fields_of_sigma_below_0.01_mag": int(precise.sum()),
        "their_rms_error_mag": float(np.sqrt(np.mean(np.array(errors)[precise] ** 2))) if precise.any() else None,
        "cpu_s_a_field": (time.process_time() - started) / count,
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["fields"])
    parser.add_argument("--fields", type=int, default=300)
    parser.add_argument("--method", default="psf", choices=["psf", "aperture"])
    arguments = parser.parse_args()
    print(json.dumps(fields(arguments.fields, arguments.method), indent=1))
