"""Keeping the results of a run: one SQLite file, against a Parquet file per image and JSON texts, measured.

Records are those of a star image with some 1,500 sources and 500 stars, and of a body with three estimators. Prints
JSON: size and time of writing and reading, and what is left after ``kill -9`` at many moments, on a full disk (files of
at most 2 MB, which only the one file reaches), and with two readers at work.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from giantlike.campaign.store.record_values import StarMatches
from giantlike.campaign.store.records import Attitude, AttitudeRecord, ImageRecord, ObservationRecord
from giantlike.campaign.store.run_folder import RESULTS_FILE, RunFolder
from giantlike.core.causes import Cause
from giantlike.core.errors import DataError

N_SOURCES, N_STARS, N_LIMB = 1500, 500, 400


def records(k: int) -> list[ImageRecord]:
    """What a run keeps of image k."""
    random = np.random.default_rng(k)
    file = f"image_{k:06d}.fits"
    covariance = np.diag([1e-11, 1e-11, 1e-9]).tolist()
    attitude = Attitude(
        source="stars",
        quaternion_xyzw=[0.5, 0.5, 0.5, 0.5],
        covariance_rad2=covariance,
        parts={Cause.NOISE: covariance, Cause.CAMERA: covariance},
    )
    stars = StarMatches(
        star_ids=random.integers(2**60, size=N_STARS).tolist(),
        observed_px=random.uniform(0, 2000, (N_STARS, 2)).tolist(),
        predicted_px=random.uniform(0, 2000, (N_STARS, 2)).tolist(),
        sigma_px=random.uniform(0, 1, N_STARS).tolist(),
        magnitudes=random.uniform(0, 10, N_STARS).tolist(),
    )
    image = AttitudeRecord(
        index=k, file=file, path=file, sha256=f"{k:064d}", columns=2000, rows=2000, et=float(k), status="ok",
        attitude=attitude, stars=stars, detected_px=random.uniform(0, 2000, (N_SOURCES, 2)).tolist(),
    )  # fmt: skip
    part = np.eye(3).tolist()
    bodies = [
        ObservationRecord(
            index=k, file=file, target="ROCK", estimator=name, status="ok", attitude=attitude,
            center_px=[1.0, 2.0], covariance_px2=[[1.0, 0.0], [0.0, 1.0]],
            limb_px=random.uniform(0, 2000, (N_LIMB, 2)).tolist(),
            parts=dict.fromkeys((Cause.NOISE, Cause.RELIEF, Cause.CAMERA, Cause.ATTITUDE), part),
        )
        for name in ("cross_correlation", "limb_matching", "ellipsoid_cra")
    ]  # fmt: skip
    return [image, *bodies]


# --- three ways ------------------------------------------------------------------------------------------------------


def write_sqlite(folder: Path, first: int, last: int) -> None:
    run = RunFolder(folder) if (folder / "provenance.json").exists() else RunFolder.start(folder, {}, {})
    with run.writing():
        for k in range(first, last):
            for record in records(k):
                run.save(record, "key")


def read_sqlite(folder: Path) -> int:
    run = RunFolder(folder)
    return len(run.attitudes()) if (folder / RESULTS_FILE).exists() else 0


def write_json(folder: Path, first: int, last: int) -> None:
    for k in range(first, last):
        for number, record in enumerate(records(k)):
            part = folder / f".{k}.{number}.part"
            part.write_text(record.model_dump_json())
            os.replace(part, folder / f"{k:06d}.{number}.json")


def read_json(folder: Path) -> int:
    return len([AttitudeRecord.model_validate_json(path.read_bytes()) for path in sorted(folder.glob("*.0.json"))])


def write_parquet(folder: Path, first: int, last: int) -> None:
    for k in range(first, last):
        rows = records(k)
        light = [record.light().model_dump_json() for record in rows]
        points = [np.array(_points(record)).ravel().tolist() for record in rows]
        part = folder / f".{k}.part"
        parquet.write_table(pa.table({"light": light, "points": points}), part, compression="zstd")
        os.replace(part, folder / f"{k:06d}.parquet")


def read_parquet(folder: Path) -> int:
    found = 0
    for path in sorted(folder.glob("*.parquet")):
        texts = parquet.read_table(path, columns=["light"]).column("light").to_pylist()
        found += isinstance(AttitudeRecord.model_validate_json(texts[0]), AttitudeRecord)
    return found


def _points(record: ImageRecord) -> list[Any]:
    if isinstance(record, AttitudeRecord) and record.stars is not None:
        return [*record.detected_px, *record.stars.observed_px, *record.stars.predicted_px]
    return record.limb_px if isinstance(record, ObservationRecord) else []


WAYS: dict[str, tuple[Callable[[Path, int, int], None], Callable[[Path], int]]] = {
    "sqlite": (write_sqlite, read_sqlite),
    "parquet part per image": (write_parquet, read_parquet),
    "json file per record": (write_json, read_json),
}


# --- measurements ----------------------------------------------------------------------------------------------------


def size_and_time(way: str, images: int) -> dict[str, Any]:
    """Bytes per image and CPU seconds, the making of the records taken out."""
    write, read = WAYS[way]
    start = time.process_time()
    for k in range(images):
        records(k)
    making_s = time.process_time() - start
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        start = time.process_time()
        write(folder, 0, images)
        writing_s = time.process_time() - start - making_s
        start = time.process_time()
        assert read(folder) == images
        reading_s = time.process_time() - start
        files = [path for path in folder.rglob("*") if path.is_file()]
        total = sum(path.stat().st_size for path in files)
    return {
        "kB_per_image": round(total / images / 1e3, 1),
        "files": len(files),
        "write_ms_per_image": round(1e3 * writing_s / images, 2),
        "read_light_ms_per_image": round(1e3 * reading_s / images, 2),
    }


def killed(way: str, kills: int, images: int) -> dict[str, Any]:
    """Kill the writer at many moments; each time what is there must be readable and must not have shrunk."""
    write, read = WAYS[way]
    random = np.random.default_rng(5)
    lost, before = 0, 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for _ in range(kills):
            process = multiprocessing.get_context("fork").Process(target=write, args=(folder, before, before + images))
            process.start()
            time.sleep(float(random.uniform(0.01, 0.6)))
            assert process.pid is not None
            os.kill(process.pid, signal.SIGKILL)
            process.join()
            now = read(folder)
            lost += now < before
            before = now
    return {"kills": kills, "images_at_the_end": before, "times_something_was_lost": lost}


def full_disk(way: str, images: int) -> dict[str, Any]:
    """Let the disk be full after 2 MB: what was written before must be readable, and there must be an error."""
    write, read = WAYS[way]

    def fill(folder: Path) -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, 2_000_000))
        try:
            write(folder, 0, images)
        except (OSError, DataError):
            os._exit(3)
        os._exit(0)

    with tempfile.TemporaryDirectory() as name:
        process = multiprocessing.get_context("fork").Process(target=fill, args=(Path(name),))
        process.start()
        process.join()
        kept = read(Path(name))
        write(Path(name), kept, kept + 5)
        return {"error_told": process.exitcode == 3, "readable": kept, "goes_on": read(Path(name)) == kept + 5}


def two_readers(way: str, images: int) -> dict[str, Any]:
    """Read all the time in two processes while one writes; count what they could not read."""
    write, read = WAYS[way]

    def look(folder: Path, answers: Any) -> None:
        looks = failures = 0
        while not (folder / "end").exists():
            try:
                read(folder)
            except (DataError, OSError, ValueError):
                failures += 1
            looks += 1
        answers.put((looks, failures))

    context = multiprocessing.get_context("fork")
    with tempfile.TemporaryDirectory() as name:
        folder, answers = Path(name), context.Queue()
        write(folder, 0, 2)
        readers = [context.Process(target=look, args=(folder, answers)) for _ in range(2)]
        for reader in readers:
            reader.start()
        start = time.perf_counter()
        write(folder, 2, images)
        writing_s = time.perf_counter() - start
        (folder / "end").touch()
        found = [answers.get() for _ in readers]
        for reader in readers:
            reader.join()
    looks, failures = (sum(part) for part in zip(*found, strict=True))
    return {"looks": looks, "failures": failures, "writing_s": round(writing_s, 2)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=200)
    parser.add_argument("--kills", type=int, default=50)
    wanted = parser.parse_args()
    answer = {
        way: size_and_time(way, wanted.images)
        | {"killed": killed(way, wanted.kills, wanted.images)}
        | {"full_disk": full_disk(way, wanted.images), "two_readers": two_readers(way, wanted.images // 4)}
        for way in WAYS
    }
    print(json.dumps(answer, indent=1))


if __name__ == "__main__":
    main()
