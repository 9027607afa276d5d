"""Many images of the gauntlet in several processes, their verdicts, and the sums of them."""

from __future__ import annotations

import multiprocessing
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from itertools import count, islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from giantlike._system.processes import one_thread_each
from giantlike.core.arrays import require
from giantlike.core.errors import InputError
from giantlike.core.values import Value
from giantlike.gauntlet.kinds import KINDS
from giantlike.gauntlet.real import REAL_KIND, image_files, real_rows
from giantlike.gauntlet.rule import Verdict
from giantlike.gauntlet.stage import kind_of, stage_of
from giantlike.gauntlet.trial import NAMES, TrialRow, trial
from giantlike.image import Image

THUMBNAIL_PX = 96  # side of a thumbnail, px: a thousand of them fill 3 MB of a page
_FAINT, _BRIGHT, _GAMMA = 1.0, 99.8, 0.5  # percentiles shown black and white; the power shows faint light
_QUALITY = 60  # quality of the JPEG of a thumbnail, percent


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gauntlet(Value):
    """Selection of the images and estimators to run."""

    images: int  # number of images
    seed: int  # of everything
    kinds: tuple[str, ...] = ()  # kinds to run: the first so many images of these; all if empty
    estimators: tuple[str, ...] = ()  # estimators to run; all if empty
    indices: tuple[int, ...] = ()  # images to run, by their number; the first ones if empty
    workers: int = 1  # processes
    real: Path | None = None  # folder of real images that do not show the target; they come after the others

    def __post_init__(self) -> None:
        require(self.images >= 1, f"images must be >= 1, got {self.images}")
        require(self.seed >= 0, f"seed must be >= 0, got {self.seed}")
        require(self.workers >= 1, f"workers must be >= 1, got {self.workers}")
        require(all(index >= 0 for index in self.indices), f"numbers of images must be >= 0, got {self.indices}")
        for name, known in ((self.kinds, KINDS), (self.estimators, NAMES)):
            for one in name:
                require(one in known, f"no {one!r} in the gauntlet; there is {', '.join(known)}")
        Value.__post_init__(self)

    def numbers(self) -> list[int]:
        """Numbers of the images to run."""
        if self.indices:
            return list(self.indices)
        chosen = (index for index in count() if not self.kinds or kind_of(self.seed, index).name in self.kinds)
        return list(islice(chosen, self.images))


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageResult:
    """Results of one image."""

    index: int
    kind: str
    rows: tuple[TrialRow, ...]  # one per estimator
    cpu_s: float  # of estimators, renderer and comparison
    thumbnail: bytes  # JPEG


def run_image(seed: int, index: int, estimators: Sequence[str] = ()) -> ImageResult:
    """Make an image, run the estimators on it, and judge."""
    began = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # damaged images raise many; the rows report the outcomes
        stage = stage_of(seed, index)
        rows = tuple(trial(stage, estimators))
    return ImageResult(
        index=index,
        kind=stage.kind.name,
        rows=rows,
        cpu_s=time.process_time() - began,
        thumbnail=thumbnail(stage.image),
    )


def run_real(seed: int, index: int, estimators: Sequence[str], path: Path) -> ImageResult | None:
    """Run the estimators on a real image that does not show the target."""
    began = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = real_rows(path, index, seed, estimators)
    if found is None:
        return None
    spent = time.process_time() - began
    picture = thumbnail(found[0])
    return ImageResult(index=index, kind=REAL_KIND, rows=tuple(found[1]), cpu_s=spent, thumbnail=picture)


def thumbnail(image: Image) -> bytes:
    """Return a small JPEG of an image."""
    pixels = image.pixels.astype(float)
    low, high = np.percentile(pixels, [_FAINT, _BRIGHT])
    share = np.clip((pixels - low) / max(high - low, 1.0), 0.0, 1.0) ** _GAMMA
    small = cv2.resize((255.0 * share).astype(np.uint8), (THUMBNAIL_PX, THUMBNAIL_PX), interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return bytes(data)


def run_gauntlet(
    wanted: Gauntlet, *, finished: Sequence[ImageResult] = (), progress: Callable[[int, int], None] | None = None
) -> Iterator[ImageResult]:
    """Run images, and yield the results of each in order of completion."""
    known = {result.index for result in finished}
    numbers = wanted.numbers()
    jobs: list[_Job] = [
        partial(run_image, wanted.seed, number, wanted.estimators) for number in numbers if number not in known
    ]
    after = max(numbers) + 1
    if wanted.real is not None:
        files = enumerate(image_files(wanted.real), after)
        jobs += [
            partial(run_real, wanted.seed, number, wanted.estimators, path)
            for number, path in files
            if number not in known
        ]
    for done, result in enumerate(_results(wanted.workers, jobs), 1):
        if progress is not None:
            progress(done, len(jobs))
        if result is not None:
            yield result


_Job = Callable[[], "ImageResult | None"]


def _results(workers: int, jobs: Sequence[_Job]) -> Iterator[ImageResult | None]:
    if workers == 1:
        for job in jobs:
            yield job()
        return
    try:
        with one_thread_each(), ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
            for future in as_completed([pool.submit(job) for job in jobs]):
                yield future.result()
    except BrokenProcessPool as error:
        raise InputError("a worker process was ended; run with one worker to see the image that does it") from error


COUNTED = (*(str(verdict) for verdict in Verdict),)  # names of the counts of a breakdown


def counts_of(rows: Iterable[TrialRow]) -> dict[str, int]:
    """Count the verdicts of some rows."""
    found = Counter(row.verdict for row in rows)
    return {"verdicts": sum(found.values())} | {name: found[name] for name in COUNTED}


def summary_of(wanted: Gauntlet, results: Sequence[ImageResult]) -> dict[str, Any]:
    """Sum up the verdicts of a gauntlet."""
    rows = [row for result in results for row in result.rows]
    all_of_them = counts_of(rows)
    cpu = [result.cpu_s for result in results]
    return {
        "images": len(results),
        "verdicts": all_of_them.pop("verdicts"),
        "silent_wrong": all_of_them.pop("silent_wrong"),
        "needless_refusals": all_of_them.pop("needless_refusal"),
        **all_of_them,
        "seed": wanted.seed,
        "false_alarms_nominal": _alarms([row for row in rows if row.kind in ("nominal", "stars_nominal")]),
        "cpu_s_mean": float(np.mean(cpu)) if cpu else 0.0,
        "cpu_s_max": float(np.max(cpu)) if cpu else 0.0,
        "by_kind": {
            name: counts_of(row for row in rows if row.kind == name)
            for name in _in_order(rows, "kind", (*KINDS, REAL_KIND))
        },
        "by_estimator": {
            name: counts_of(row for row in rows if row.estimator == name)
            for name in _in_order(rows, "estimator", NAMES)
        },
    }


def _in_order(rows: Sequence[TrialRow], field: str, names: Iterable[str]) -> list[str]:
    there = {getattr(row, field) for row in rows}
    return [name for name in names if name in there]


def _alarms(rows: Sequence[TrialRow]) -> dict[str, int]:
    """Fixes of nominal images, and the suspect ones among them."""
    fixes = [row for row in rows if row.status in ("ok", "suspect")]
    return {"fixes": len(fixes), "suspect": sum(row.status == "suspect" for row in fixes)}
