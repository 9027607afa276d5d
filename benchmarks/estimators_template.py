"""Accuracy, consistency and speed of the estimators that fit a rendered template; prints JSON.

Truth is rendered with many more rays, each at a random place of its cell; noise is Poisson and read noise; a priori the
body is 10 px off. Each figure stands beside the Cramer-Rao bound of the noise, and each mean of squared error over
covariance (NEES, 2 expected of a center, 1 of a range) beside the band in which 95 % of such means lie.

``table`` has the rows of the requirements, 300 px unless said: exact shape and law, the range off by 1.5 or 5 %;
truth McEwen and estimator told Lommel-Seeliger; truth with 1 % of relief that the estimator lacks, as one knows
nothing of it and as one is told; a body of 2 px by each correction of ``unresolved``. ``sizes`` goes over disks and
phase, ``small`` over bodies of a few pixels, ``speed`` over time for an image of 1024^2 beside one render.

Usage: python benchmarks/estimators_template.py table|sizes|small|speed [--draws 200] [--sizes 20,60,...] [--rows ...]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.signal import fftconvolve
from scipy.stats import chi2
from template_truth import CAMERA, RELIEF_WAVENUMBERS, Draw, Truth, bounds, draw_of, rendered, truth_of

from giantlike.core.arrays import Float
from giantlike.core.outcomes import CenterFix, PositionFix
from giantlike.processing.correlate import CorrelationPeak, locate_template, normalized_correlation
from giantlike.ray_tracing import LommelSeeliger, McEwen, Reflectance, RenderOptions
from giantlike.relative import CrossCorrelation, CrossCorrelationOptions, Estimator, Unresolved, UnresolvedOptions
from giantlike.shapes import sphere

RELIEF = 0.01
RELIEF_LENGTH_RAD = math.sqrt(
    sum(k**-4 for k in RELIEF_WAVENUMBERS) / sum(k**-2 for k in RELIEF_WAVENUMBERS)
)  # waves of equal slopes: a Gaussian correlation with the same area under it
RANGE_SIGMA = 0.02  # what `unresolved` expects


@dataclass(frozen=True, kw_only=True)
class Row:
    """A line of the table: which truth, what the estimator is told, and at which phases."""

    estimator: Estimator
    diameter_px: float
    phases_deg: tuple[float, ...]
    law: Reflectance = field(default_factory=McEwen)
    relief: float = 0.0
    range_error: float = 0.015
    range_sigma: float = 0.0
    round: bool = False
    draws_a_truth: int = 2


ALL_PHASES = (0.0, 20.0, 40.0, 60.0, 80.0, 100.0, 120.0, 130.0)
_TOLD = CrossCorrelationOptions(relief_sigma=RELIEF, relief_length_rad=RELIEF_LENGTH_RAD)


def table_rows() -> dict[str, Row]:
    """The rows of the requirements."""
    resolved = Row(estimator=CrossCorrelation(), diameter_px=300.0, phases_deg=ALL_PHASES)
    small = Row(
        estimator=Unresolved(),
        diameter_px=2.0,
        phases_deg=(*ALL_PHASES[:-1], 150.0),
        range_error=0.0,
        range_sigma=RANGE_SIGMA,
    )

    def changed(row: Row, **changes: object) -> Row:
        return Row(**({name: getattr(row, name) for name in Row.__dataclass_fields__} | changes))

    told = CrossCorrelation(_TOLD)
    corrections = {
        f"unresolved, {kind}": changed(small, estimator=Unresolved(UnresolvedOptions(correction=kind)))
        for kind in ("rendered", "kaasalainen_tanga", "ellipsoid")
    }
    return {
        "exact": resolved,
        "exact, 5 % of range": changed(resolved, range_error=0.05),
        "other law": changed(resolved, law=LommelSeeliger(), phases_deg=ALL_PHASES[1:-1]),
        "relief": changed(resolved, relief=RELIEF, phases_deg=ALL_PHASES[1:-1]),
        "relief, told": changed(resolved, relief=RELIEF, phases_deg=ALL_PHASES[1:-1], estimator=told),
        **corrections,
        "unresolved, rendered, other law": changed(small, law=LommelSeeliger()),
        "unresolved, ellipsoid, sphere": changed(corrections["unresolved, ellipsoid"], round=True),
    }


def truths(row: Row, phase_deg: float, count: int) -> Iterator[tuple[Truth, Float]]:
    """So many truths of a row at a phase, with their bounds."""
    range_sigma = row.range_sigma or math.inf
    for number in range(count):
        shape = sphere(0.25) if row.round else None
        truth = truth_of(1000 * number + int(phase_deg), row.diameter_px, phase_deg, relief=row.relief, shape=shape)
        yield truth, bounds(truth, range_sigma=range_sigma)


def measured(row: Row, draws: int) -> dict[str, object]:
    """Figures of a row: over all phases, and by phase."""
    count = math.ceil(draws / len(row.phases_deg) / row.draws_a_truth)
    by_phase = {}
    for phase_deg in row.phases_deg:
        results: list[Float] = []
        failures: list[str] = []
        for truth, bound in truths(row, phase_deg, count):
            for seed in range(row.draws_a_truth):
                drawn = draw_of(truth, seed, range_error=row.range_error, range_sigma=row.range_sigma, law=row.law)
                result = estimated(row.estimator, drawn, bound)
                (failures if isinstance(result, str) else results).append(result)  # type: ignore[arg-type]
        by_phase[phase_deg] = np.array(results), failures
        print(json.dumps({f"{phase_deg:g} deg": summary(*by_phase[phase_deg])}), file=sys.stderr, flush=True)
    whole = np.concatenate([results for results, _ in by_phase.values() if len(results)])
    lost = [failure for _, failures in by_phase.values() for failure in failures]
    return summary(whole, lost) | {"by_phase_deg": {f"{p:g}": summary(*found) for p, found in by_phase.items()}}


def estimated(estimator: Estimator, drawn: Draw, bound: Float) -> Float | str:
    """Errors and NEES of one draw, bounds and time; the text of a failure."""
    started = time.process_time()
    fix = estimator.estimate(drawn.image, CAMERA, drawn.scene)
    seconds = time.process_time() - started
    if not isinstance(fix, CenterFix):
        return f"{drawn.image.name}: {fix.reason}"
    error = fix.center_px - drawn.truth.center_px
    nees = float(error @ np.linalg.solve(fix.covariance_px2, error))
    log_range = nees_range = math.nan
    if isinstance(fix, PositionFix):
        log_range = math.log(fix.range_km / drawn.truth.range_km)
        nees_range = (log_range * fix.range_km / fix.sigma_range_km) ** 2
    return np.array([*error, log_range, nees, nees_range, *bound.ravel(), seconds, float(fix.flags.suspect)])


def summary(results: Float, failures: Sequence[str]) -> dict[str, object]:
    """Root mean squares beside bounds, NEES beside its band."""
    if not len(results):
        return {"failed": list(failures)}
    rms = np.sqrt(np.mean(results**2, axis=0))
    n = len(results)
    ranged = bool(np.isfinite(results[:, 2]).all())
    answer: dict[str, object] = {
        "draws": n,
        "rms_px": rms[:2].round(4).tolist(),
        "bound_px": round(float(rms[5]), 4),
        "bound_as_free_px": round(float(rms[7]), 4),
        "rms_over_bound": round(float(np.hypot(*rms[:2]) / math.sqrt(2.0) / rms[7]), 2),
        "worst_px": round(float(np.abs(results[:, :2]).max()), 4),
        "nees_of_2": round(float(results[:, 3].mean()), 2),
        "nees_band_95": [round(float(chi2.ppf(q, 2 * n)) / n, 2) for q in (0.025, 0.975)],
        "median_cpu_s": round(float(np.median(results[:, 9])), 3),
        "suspect": round(float(results[:, 10].mean()), 3),
    }
    if ranged:
        answer |= {
            "rms_range_percent": float(f"{100 * rms[2]:.2g}"),
            "bound_range_percent": float(f"{100 * rms[8]:.2g}"),
            "nees_range_of_1": round(float(results[:, 4].mean()), 2),
            "nees_range_band_95": [round(float(chi2.ppf(q, n)) / n, 2) for q in (0.025, 0.975)],
        }
    return answer | ({"failed": list(failures)} if failures else {})


def over_sizes(sizes_px: Sequence[float], draws: int) -> Iterator[dict[str, object]]:
    """One line for each size and phase, to be plotted: exact shape and law."""
    for diameter_px in sizes_px:
        for phase_deg in (20.0, 60.0, 100.0, 130.0):
            row = Row(estimator=CrossCorrelation(), diameter_px=diameter_px, phases_deg=(phase_deg,))
            found = measured(row, draws)
            found.pop("by_phase_deg")
            yield {"estimator": "cross_correlation", "diameter_px": diameter_px, "phase_deg": phase_deg} | found


def small_bodies(draws: int) -> Iterator[dict[str, object]]:
    """Bodies of a few pixels over phase angle and size, by both estimators."""
    for estimator in (Unresolved(UnresolvedOptions(max_diameter_px=40.0)), CrossCorrelation()):
        for diameter_px in (0.5, 1.0, 2.0, 4.0, 8.0, 12.0):
            row = Row(
                estimator=estimator,
                diameter_px=diameter_px,
                phases_deg=(20.0, 50.0, 80.0, 120.0, 150.0),
                range_error=0.0,
                range_sigma=RANGE_SIGMA,
            )
            yield {"estimator": estimator.name, "diameter_px": diameter_px} | measured(row, draws)


def timed(function: Callable[[], object], times: int = 5) -> dict[str, float]:
    """Smallest processor and wall time of some runs, ms."""
    cpu, wall = [], []
    for _ in range(times):
        started, began = time.process_time(), time.perf_counter()
        function()
        cpu.append(time.process_time() - started)
        wall.append(time.perf_counter() - began)
    return {"cpu_ms": round(1e3 * min(cpu), 1), "wall_ms": round(1e3 * min(wall), 1)}


def speed() -> dict[str, object]:
    """Time per image of 1024^2, beside one render at 4 rays a pixel of the same body."""
    report: dict[str, object] = {"correlation of 300^2 in 380^2": correlation_times()}
    for name, estimator, diameter_px in (
        ("cross_correlation", CrossCorrelation(), 300.0),
        ("unresolved", Unresolved(), 2.0),
    ):
        drawn = draw_of(truth_of(60, diameter_px, 60.0), 0, range_error=0.015, law=McEwen())
        ours = timed(lambda e=estimator, d=drawn: e.estimate(d.image, CAMERA, d.scene))  # type: ignore[misc]
        one = timed(lambda d=drawn: rendered(d.predicted, d.truth.sun, RenderOptions()))  # type: ignore[misc]
        ratio = round(ours["cpu_ms"] / one["cpu_ms"], 2)
        report[f"{name}, {diameter_px:g} px"] = ours | {"render": one, "cpu_over_render": ratio}
    drawn = draw_of(truth_of(60, 300.0, 60.0), 0, range_error=0.015, law=McEwen())
    report["peak of the correlation alone, 300 px, error px"] = peak_alone(drawn)
    return report


def peak_alone(drawn: Draw) -> list[float] | None:
    """Error of the paraboloid's peak (the paper's way), px: the range is not estimated, and pulls it."""
    template = rendered(drawn.predicted, drawn.truth.sun, RenderOptions())
    corner = int(template.corner_px[0]), int(template.corner_px[1])
    usable = np.ones(drawn.image.pixels.shape, dtype=bool)
    peak = locate_template(drawn.image.pixels.astype(np.float64), usable, template.brightness, corner)
    if not isinstance(peak, CorrelationPeak):
        return None
    result: list[float] = (drawn.predicted_px + peak.offset_px - drawn.truth.center_px).round(3).tolist()
    return result


def correlation_times() -> dict[str, object]:
    """Processor times and largest difference from a plain correlation by FFT."""
    random = np.random.default_rng(1)
    image = random.normal(size=(380, 380))
    template = image[33:333, 47:347].copy()

    def by_fft() -> Float:
        pattern, ones = template - template.mean(), np.ones_like(template)
        cross = fftconvolve(image, pattern[::-1, ::-1], mode="valid")
        mean, square = fftconvolve(image, ones, mode="valid"), fftconvolve(image**2, ones, mode="valid")
        return np.asarray(cross / np.sqrt((pattern**2).sum() * (square - mean**2 / ones.size)))

    usable = np.ones(image.shape, dtype=bool)
    usable[0, 0] = False
    return {
        "whole": timed(lambda: normalized_correlation(image, template)),
        "masked": timed(lambda: normalized_correlation(image, template, image_usable=usable)),
        "scipy_fft": timed(by_fft),
        "largest_difference": float(np.abs(normalized_correlation(image, template) - by_fft()).max()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["table", "sizes", "small", "speed"])
    parser.add_argument("--draws", type=int, default=200, help="of each row of the table, or of each cell")
    parser.add_argument("--sizes", default="20,40,100,300,600,1000", help="diameters in px")
    parser.add_argument("--rows", default="", help="start of the names of the rows to measure; all by default")
    chosen = parser.parse_args()
    if chosen.what == "table":
        rows = {name: row for name, row in table_rows().items() if name.startswith(chosen.rows)}
        print(json.dumps({name: measured(row, chosen.draws) for name, row in rows.items()}, indent=2))
    elif chosen.what == "sizes":
        print(json.dumps([*over_sizes([float(size) for size in chosen.sizes.split(",")], chosen.draws)], indent=2))
    elif chosen.what == "small":
        print(json.dumps([*small_bodies(chosen.draws)], indent=2))
    else:
        print(json.dumps(speed(), indent=2))


if __name__ == "__main__":
    main()
