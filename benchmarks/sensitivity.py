"""Sensitivity of errors, sigmas and outcomes to half and double of each constant, on fixed simulated images.

The constants are those of the modules of ``relative``, ``processing`` and ``stars`` and the numeric options of the
estimators. Which of them an estimator uses is seen by profiling it; each is then halved and doubled, alone. Prints
JSON; ``--page`` prints ``sensitivity.md`` from the JSON of one run or several, and writes ``results/sensitivity.csv``.
Left out are constants that a cache on disk depends on, mathematics and physics.

Usage: python benchmarks/sensitivity.py [--only stars,processing] [--minutes 15] [--images 3] > sensitivity.json
       python benchmarks/sensitivity.py --page sensitivity.json ... > benchmarks/sensitivity.md
"""

from __future__ import annotations

import argparse
import ast
import csv
import dataclasses
import importlib
import inspect
import json
import math
import pkgutil
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any, TypeGuard

import cv2
import numpy as np
from monte_carlo import Draw, draws_of, truth_of
from scipy.spatial.transform import Rotation

import giantlike as gl
from giantlike.catalogs import StarCatalog, load_catalog
from giantlike.core.arrays import Float
from giantlike.ray_tracing import McEwen
from giantlike.relative import Estimator, LimbMatchingOptions, SurfaceFeaturesOptions
from giantlike.shapes import Ellipsoid, Shape, irregular_body
from giantlike.simulation import ApproachOptions, Visit, plan_approach, write_approach
from giantlike.simulation.write import TRUTH_FILE

HERE = Path(__file__).resolve().parent
PACKAGES = ("giantlike.relative", "giantlike.processing", "giantlike.stars")
CACHED_ON_DISK = ("index_store", "pattern_database", "star_index", "quads", "tetra")
"""Modules that build indexes of patterns, which are kept in files: see ``identification.py`` for those."""
NOT_A_CHOICE = frozenset(
    {
        "EPOCH_WHEN_UNKNOWN", "NOT_A_STAR", "PIXEL_VARIANCE_PX2", "SAMPLING_VARIANCE_PX2", "_CHI2_MEDIAN", "_FULL_MOON",
        "_IQR_PER_SIGMA", "_MEDIAN_CHI2", "_MEDIAN_SIGMA", "_PIXEL_AND_HOLD_PX2", "_QUANTIZATION_DN", "_SPLINE_NOISE",
        "_SPLINE_NOISE_VARIANCE_PX2",
    }
)  # fmt: skip
"""Mathematics, physics and conventions: another value would be wrong."""
FACTORS = (0.5, 2.0)
MOST_CASES = 2
"""Estimators that a constant is tried on at most, fastest first."""
CLEAR_SHIFT, CLEAR_RATIO = 0.05, 0.02
"""Changes of a result in sigmas, and of a sigma relative to itself, below which a constant decides nothing."""
BROKEN = (ArithmeticError, AssertionError, AttributeError, LookupError, RuntimeError, TypeError, ValueError, cv2.error)
DIAMETER_PX, FRAME_PX = 100.0, 256
PHASES_DEG = (30.0, 60.0, 90.0)
ROCK, EGG = irregular_body(1, facets=20_000), Ellipsoid(radii_km=np.array([0.3, 0.26, 0.22]))


INTRODUCTION = """# Sensitivity of the results to the constants

Made by `python benchmarks/sensitivity.py`. Each constant is halved and doubled, alone, and the estimators that use it
measure {images} simulated images each: bodies of 100 px (200 px for `surface_features`, 2 px for `unresolved`) at 30,
60 and 90 degrees of phase, 10 px and 1.5 % of range off their predictions, and star images of the demonstration's
camera. Errors are those of center and range, the latter in px of the radius, or of the attitude, as shifts of the
image.

| estimator | rms error, px | sigma, px | outcomes |
| --- | --- | --- | --- |"""
COLUMNS = """
[results/sensitivity.csv](results/sensitivity.csv) has a row for each constant and estimator. Columns of half and
double: largest shift of a result in its sigmas, ratio of the rms errors, ratio of the sigmas, and outcomes that change.
`effect` is `none` where no outcome changes, no result by more than {shift} sigma and no sigma by more than {ratio:.0%},
and `not reached` where these images do not use a constant, or it is read when a module is imported. With so few images
ratios of errors are chance below 1 sigma of shift, and outcomes indicate a cliff, not a rate.

Of {rows:,} rows {changing} change an outcome. These are below, with those that shift a result by {large:g} sigma and
more; names are those of the code that was measured. Constants that such figures decided are in
[thresholds](thresholds.md).

| constant | value | estimator | half | double |
| --- | --- | --- | --- | --- |"""
HEADINGS = ("constant", "value", "estimator", "half", "double", "effect")
TABLE = Path("results") / "sensitivity.csv"
SHOWN_SHIFT = 2.0
"""Shift of a result, in sigmas, from which a row is shown on the page."""
Row = dict[str, str]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Result:
    """Result of one image: a verdict and, for a fix, errors (k,) and stated sigmas (k,) in px."""

    verdict: str
    error: Float = dataclasses.field(default_factory=lambda: np.zeros(0))
    sigma: Float = dataclasses.field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """An estimator with its images: ``run`` gives one result an image; ``options`` are those that can be changed."""

    name: str
    run: Callable[[Any], list[Result]]
    options: Any


@dataclass(frozen=True, slots=True)
class Constant:
    """A number of a module, an element of a tuple, or an option of an estimator (then ``module`` is that estimator)."""

    module: str
    name: str
    value: float | int

    def scaled(self, factor: float) -> float | int:
        """The value times a factor; whole numbers stay whole and change."""
        if isinstance(self.value, int):
            return math.ceil(self.value * factor) if factor > 1 else max(self.value // 2, 0)
        return self.value * factor


# what is estimated --------------------------------------------------------------------------------------------


def body_case(estimator: Estimator, shape: Shape, diameter_px: float, images: int) -> Case:
    """Images of a body of 10 px and 1.5 % of range off its prediction, at three phase angles."""
    truths = [
        truth_of(shape, diameter_px, PHASES_DEG[k % 3], McEwen(), 40 + k, size_px=FRAME_PX) for k in range(images)
    ]
    draws = [next(draws_of(truth, 1)) for truth in truths]

    make: Callable[[Any], Estimator] = type(estimator)

    def run(options: Any) -> list[Result]:
        return [body_result(draw, make(options)) for draw in draws]

    return Case(name=estimator.name, run=run, options=estimator.options)


def body_result(draw: Draw, estimator: Estimator) -> Result:
    """Center in px and, for a position, range in px of the radius."""
    fix = estimator.estimate(draw.image, draw.truth.camera, draw.scene)
    if isinstance(fix, gl.Failure):
        return Result(verdict=str(fix.reason))
    error, sigma = fix.center_px - draw.truth.center_px, np.sqrt(np.diag(fix.covariance_px2))
    if isinstance(fix, gl.PositionFix):
        radius_px = draw.truth.body.shape.mean_radius_km / draw.truth.range_km * draw.truth.camera.model.focal_length_px
        error = np.append(error, (fix.range_km / draw.truth.range_km - 1.0) * radius_px)
        sigma = np.append(sigma, fix.sigma_range_km / fix.range_km * radius_px)
    return Result(verdict="suspect" if fix.flags.suspect else "ok", error=error, sigma=sigma)


def star_cases(folder: Path, images: int) -> Iterator[Case]:
    """Star images of the demonstration's camera: with an a priori attitude, lost in space, and with an unknown PSF."""
    visits = tuple(Visit(day=float(day), diameter_px=1.0, phase_deg=30.0) for day in range(max(images, 2)))
    approach = plan_approach(ApproachOptions(approach=visits, moon=(), facets=2000))
    catalog = load_catalog("default")
    write_approach(approach, folder, catalog, workers=1)
    with (folder / TRUTH_FILE).open(encoding="utf-8") as stream:
        truth = {row["file"]: [float(row[f"q{axis}"]) for axis in "xyzw"] for row in csv.DictReader(stream)}
    files = sorted((folder / "images").glob("*long1*"))[:images]
    off = Rotation.from_rotvec(np.radians([0.1, -0.15, 0.1]))
    taken = [
        (dataclasses.replace(gl.Image.open(path), camera_from_inertial=off * true), true)
        for path in files
        for true in [Rotation.from_quat(truth[path.name])]
    ]
    unknown = dataclasses.replace(approach.camera, psf=None)
    for name, camera, lost in (
        ("stars, a priori", approach.camera, False),
        ("stars, lost in space", approach.camera, True),
        ("stars, point spread function unknown", unknown, False),
    ):
        yield Case(
            name=name,
            run=star_run(camera, catalog, taken),
            options=gl.StarOptions(max_magnitude=8.5, lost_in_space=lost),
        )


def star_run(
    camera: gl.Camera, catalog: StarCatalog, taken: Sequence[tuple[gl.Image, Rotation]]
) -> Callable[[gl.StarOptions], list[Result]]:
    """Solution of all images with some options."""
    return lambda options: [star_result(camera, catalog, options, image, true) for image, true in taken]


def star_result(
    camera: gl.Camera, catalog: StarCatalog, options: gl.StarOptions, image: gl.Image, true: Rotation
) -> Result:
    """Errors of the attitude about x and y as a shift of the image, in px, and about z at its edge."""
    fix = gl.StarNavigation(camera, catalog, options).solve(image)
    if isinstance(fix, gl.Failure):
        return Result(verdict=str(fix.reason))
    scale = camera.model.focal_length_px * np.array([1.0, 1.0, 0.5 * math.radians(camera.fov_deg)])
    return Result(
        verdict="suspect" if fix.flags.suspect else "ok",
        error=(fix.camera_from_inertial * true.inv()).as_rotvec() * scale,
        sigma=np.sqrt(np.diag(fix.covariance_rad2)) * scale,
    )


def cases(folder: Path, images: int) -> list[Case]:
    """Every estimator with images that it can solve."""
    small = LimbMatchingOptions(min_diameter_px=15.0)
    bodies: list[tuple[Estimator, Shape, float]] = [
        (gl.Unresolved(), ROCK, 2.0),
        (gl.Moment(), ROCK, DIAMETER_PX),
        (gl.EllipseFit(), EGG, DIAMETER_PX),
        (gl.EllipsoidCRA(), EGG, DIAMETER_PX),
        (gl.SigmoidLimb(), EGG, DIAMETER_PX),
        (gl.LimbMatching(small), ROCK, DIAMETER_PX),
        (gl.CrossCorrelation(), ROCK, DIAMETER_PX),
        (gl.SurfaceFeatures(SurfaceFeaturesOptions()), ROCK, 2.0 * DIAMETER_PX),
        (gl.Auto(), EGG, DIAMETER_PX),
    ]
    made = [body_case(estimator, shape, diameter_px, images) for estimator, shape, diameter_px in bodies]
    return made + list(star_cases(folder, images))


# which constants, and who uses them -----------------------------------------------------------------------------


def modules() -> list[ModuleType]:
    """All modules whose constants are looked at."""
    found = []
    for package in map(importlib.import_module, PACKAGES):
        for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if info.name.rpartition(".")[2] not in CACHED_ON_DISK:
                found.append(importlib.import_module(info.name))
    return found


def constants_of(module: ModuleType) -> list[Constant]:
    """Numbers that a module assigns at its top level, and those in tuples."""
    names = []
    for node in ast.parse(inspect.getsource(module)).body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or "range(" in ast.unparse(node):  # names of indices
            continue
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        names += [leaf.id for target in targets for leaf in ast.walk(target) if isinstance(leaf, ast.Name)]
    found = []
    for name in dict.fromkeys(names):
        value = vars(module).get(name)
        if name in NOT_A_CHOICE:
            continue
        if is_number(value):
            found.append(Constant(module.__name__, name, value))
        elif isinstance(value, tuple) and all(map(is_number, value)):
            found += [Constant(module.__name__, f"{name}[{k}]", each) for k, each in enumerate(value)]
    return found


def is_number(value: object) -> TypeGuard[int | float]:
    """True for a finite number other than zero that is no truth value."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value != 0


def options_of(case: Case) -> list[Constant]:
    """Numeric options of an estimator, with those of its parts as ``part.name``."""
    found = []
    for field in dataclasses.fields(case.options):
        value = getattr(case.options, field.name)
        if is_number(value):
            found.append(Constant(case.name, field.name, value))
        elif dataclasses.is_dataclass(value) and not isinstance(value, type) and case.name != "auto":
            parts = ((part.name, getattr(value, part.name)) for part in dataclasses.fields(value))
            found += [
                Constant(case.name, f"{field.name}.{name}", number) for name, number in parts if is_number(number)
            ]
    return found


def names_used(case: Case) -> set[tuple[str, str]]:
    """File and global name of everything that the functions called by a case refer to."""
    called: set[CodeType] = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            called.add(frame.f_code)

    forget()
    sys.setprofile(note)
    try:
        case.run(case.options)
    finally:
        sys.setprofile(None)
    return {(code.co_filename, name) for code in called for name in code.co_names}


def is_used(constant: Constant, used: set[tuple[str, str]]) -> bool:
    """True if a case calls a function that refers to a constant, in its own module or where that is imported."""
    name = constant.name.partition("[")[0]
    return any((module.__file__, name) in used for module in holders(constant.module, name))


def holders(home: str, name: str) -> list[ModuleType]:
    """The module of a constant and, for a public one, those that import it; equal whole numbers are one object."""
    if name.startswith("_"):
        return [sys.modules[home]]
    value = getattr(sys.modules[home], name)
    ours = [module for key, module in list(sys.modules.items()) if key.startswith("giantlike")]
    return [module for module in ours if vars(module).get(name, _MISSING) is value]


_MISSING = object()


# one constant at a time ----------------------------------------------------------------------------------------


def forget() -> None:
    """Empty the caches of functions, which may hold what another value of a constant gave."""
    for key, module in list(sys.modules.items()):
        if key.startswith(PACKAGES[:2]):
            for value in list(vars(module).values()):
                if hasattr(value, "cache_clear"):
                    value.cache_clear()


@contextmanager
def changed(constant: Constant, value: float) -> Iterator[None]:
    """Another value for a constant of a module, everywhere that it was imported."""
    name, _, index = constant.name.partition("[")
    old = getattr(sys.modules[constant.module], name)
    new: object = value
    if index:
        new = tuple(value if k == int(index[:-1]) else each for k, each in enumerate(old))
    places = holders(constant.module, name)
    try:
        for module in places:
            setattr(module, name, new)
        yield
    finally:
        for module in places:
            setattr(module, name, old)


def with_option(options: Any, name: str, value: float) -> Any:
    """Options with another value of one of them."""
    part, _, inner = name.partition(".")
    if inner:
        return dataclasses.replace(options, **{part: dataclasses.replace(getattr(options, part), **{inner: value})})
    return dataclasses.replace(options, **{part: value})


def results_with(case: Case, constant: Constant, factor: float) -> list[Result] | str:
    """Results of a case with one constant changed, or the name of the exception that this raises."""
    value = constant.scaled(factor)
    forget()
    try:
        if constant.module == case.name:
            return case.run(with_option(case.options, constant.name, value))
        with changed(constant, value):
            return case.run(case.options)
    except BROKEN as error:
        return type(error).__name__


def effect(before: Sequence[Result], after: Sequence[Result] | str) -> dict[str, Any]:
    """Largest shift in sigmas, ratio of the errors and of the sigmas, and verdicts that changed."""
    if isinstance(after, str):
        return {"raises": after}
    both = [(a, b) for a, b in zip(before, after, strict=True) if a.error.size and a.error.size == b.error.size]
    turned = Counter(
        f"{a.verdict} -> {b.verdict}" for a, b in zip(before, after, strict=True) if a.verdict != b.verdict
    )
    report: dict[str, Any] = {"verdicts": dict(turned)}
    if both:
        shift = max(float(np.max(np.abs(b.error - a.error) / a.sigma)) for a, b in both)
        errors = [rms([pair[k].error for pair in both]) for k in range(2)]
        sigmas = [rms([pair[k].sigma for pair in both]) for k in range(2)]
        report |= {"shift_sigmas": shift, "error_ratio": errors[1] / errors[0], "sigma_ratio": sigmas[1] / sigmas[0]}
    return report


def rms(arrays: Sequence[Float]) -> float:
    """Root mean square of all elements."""
    return float(np.sqrt(np.mean(np.concatenate(arrays) ** 2)))


def matters(report: dict[str, Any]) -> bool:
    """True if a change is clear: of a result, of a sigma or of a verdict."""
    ratio = abs(report.get("sigma_ratio", 1.0) - 1.0)
    return bool(
        report.get("raises")
        or report.get("verdicts")
        or report.get("shift_sigmas", 0.0) > CLEAR_SHIFT
        or ratio > CLEAR_RATIO
    )


# the report -----------------------------------------------------------------------------------------------------


def baseline(case: Case) -> tuple[list[Result], dict[str, Any]]:
    """Results with the constants as they are, and their summary."""
    forget()
    before = time.process_time()
    results = case.run(case.options)
    good = [result for result in results if result.error.size]
    summary: dict[str, Any] = {
        "verdicts": dict(Counter(result.verdict for result in results)), "cpu_s": time.process_time() - before
    }  # fmt: skip
    if good:
        summary |= {"error_px": rms([r.error for r in good]), "sigma_px": rms([r.sigma for r in good])}
    return results, summary


def cell(report: dict[str, Any]) -> str:
    """An effect in a few words."""
    if "raises" in report:
        return f"refused ({report['raises']})"
    words = [f"{count} x {turn}" for turn, count in report["verdicts"].items()]
    if "shift_sigmas" in report:
        words.insert(0, f"{report['shift_sigmas']:.2g}, {report['error_ratio']:.2f}, {report['sigma_ratio']:.2f}")
    return "; ".join(words)


def table_of(report: dict[str, Any]) -> list[Row]:
    """Rows of the table."""
    rows = []
    for row in report["constants"]:
        clear = matters(row["half"]) or matters(row["double"])
        words = (cell(row["half"]), cell(row["double"]), "clear") if clear else ("", "", "none")
        rows.append((row["constant"], f"{row['value']:.6g}", row["case"], *words))
    rows += [(name, "", "", "", "", "not reached") for name in report["not_reached"]]
    rows += [(name, "", "", "", "", "not tried, for lack of time") for name in report["out_of_time"]]
    return [dict(zip(HEADINGS, row, strict=True)) for row in rows]


def is_shown(row: Row) -> bool:
    """True for rows of the page: an outcome changes, or a result by ``SHOWN_SHIFT``."""
    cells = [row[name] for name in ("half", "double")]
    shifts = [float(each.split(",")[0]) for each in cells if "," in each]
    return any("->" in each for each in cells) or max(shifts, default=0.0) >= SHOWN_SHIFT


def markdown(images: int, baseline: dict[str, Any], rows: Sequence[Row]) -> str:
    """The page: errors with the constants as they are, and the rows that matter most."""
    lines = [INTRODUCTION.format(images=images)]
    for name, base in baseline.items():
        numbers = f"{base['error_px']:.4f} | {base['sigma_px']:.4f}" if "error_px" in base else " | "
        lines.append(f"| {name} | {numbers} | {', '.join(f'{n} {v}' for v, n in base['verdicts'].items())} |")
    tried = [row for row in rows if row["estimator"]]
    changing = sum("->" in row["half"] + row["double"] for row in tried)
    limits = {"shift": CLEAR_SHIFT, "ratio": CLEAR_RATIO, "large": SHOWN_SHIFT}
    lines.append(COLUMNS.format(rows=len(tried), changing=changing, **limits))
    for row in filter(is_shown, tried):
        words = [f"`{row['constant']}`", *(row[name] for name in HEADINGS[1:-1])]
        lines.append(f"| {' | '.join(words)} |")
    return "\n".join(lines) + "\n"


def shown(constant: Constant) -> str:
    """Name of a constant in the report."""
    return f"{constant.module.removeprefix('giantlike.')}.{constant.name}"


def study(every: Sequence[Case], minutes: float, only: Sequence[str]) -> dict[str, Any]:
    """Halve and double every constant on the cases that use it, until so much processor time is spent."""
    end = time.process_time() + 60.0 * minutes
    before: dict[str, list[Result]] = {}
    report: dict[str, Any] = {"baseline": {}, "constants": [], "not_reached": [], "out_of_time": []}
    for case in every:
        case.run(case.options)  # caches on disk, imports
        before[case.name], report["baseline"][case.name] = baseline(case)
    used = {case.name: names_used(case) for case in every}
    fastest = sorted(every, key=lambda case: report["baseline"][case.name]["cpu_s"])
    plan: list[tuple[Constant, list[Case]]] = []
    for module in modules():
        for constant in constants_of(module):
            plan.append((constant, [case for case in fastest if is_used(constant, used[case.name])][:MOST_CASES]))
    plan += [(constant, [case]) for case in every for constant in options_of(case)]
    for constant, on in plan:
        name = shown(constant)
        if not name.startswith(tuple(only)):
            continue
        if not on:
            report["not_reached"].append(name)
        for case in on:
            if time.process_time() > end:
                report["out_of_time"].append(f"{name} ({case.name})")
                continue
            half, double = (effect(before[case.name], results_with(case, constant, factor)) for factor in FACTORS)
            report["constants"].append(
                {"constant": name, "value": constant.value, "case": case.name, "half": half, "double": double}
            )
            print(name, case.name, cell(half), "|", cell(double), file=sys.stderr, flush=True)
    return report


def merged(reports: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One report of several that looked at different constants; baselines are those of the last."""
    whole: dict[str, Any] = {"baseline": {}, "images": reports[-1]["images"]}
    for report in reports:
        whole["baseline"] |= report["baseline"]
        for key in ("constants", "not_reached", "out_of_time"):
            whole.setdefault(key, []).extend(report[key])
    return whole


def main() -> None:
    """Print a report as JSON, or the page of reports."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="starts of the dotted names of constants, with commas")
    parser.add_argument("--minutes", type=float, default=15.0, help="of processor time")
    parser.add_argument("--images", type=int, default=3, help="of each estimator")
    parser.add_argument("--page", nargs="+", type=Path, help="JSON files of runs")
    arguments = parser.parse_args()
    if arguments.page:
        report = merged([json.loads(path.read_text(encoding="utf-8")) for path in arguments.page])
        rows = table_of(report)
        with (HERE / TABLE).open("w", newline="", encoding="utf-8") as file:
            table = csv.DictWriter(file, HEADINGS, lineterminator="\n")
            table.writeheader()
            table.writerows(rows)
        print(markdown(report["images"], report["baseline"], rows), end="")
        return
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        report = study(cases(Path(folder), arguments.images), arguments.minutes, arguments.only.split(","))
    print(json.dumps(report | {"images": arguments.images}, indent=1))


if __name__ == "__main__":
    main()
