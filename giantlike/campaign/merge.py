"""Runs of parts of a campaign, from several machines or days, made one run."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from giantlike._system.atomic import make_folder
from giantlike.campaign.report.run_page import write_report
from giantlike.campaign.store.edits import add_edits, read_edits
from giantlike.campaign.store.observables import write_run_observables
from giantlike.campaign.store.results import RunResult, changes, load_result
from giantlike.campaign.store.run_folder import CAMERA_FILE, RunFolder
from giantlike.campaign.store.tables import write_tables
from giantlike.core.arrays import require
from giantlike.core.errors import InputError

_MAY_DIFFER = (
    "image_files",
    "campaign.campaign",
    "campaign.images",
    "campaign.report",
    "geometry_sha256",
    "rates_sha256",
)
"""Inputs in which runs of parts of one campaign differ; all others must be the same."""


def merge_runs(runs: Sequence[Path], output: Path) -> RunResult:
    """Make one run folder of several, without computing anything; of images in two the first counts.

    They must be of the same camera, catalog, kernels, targets, options and version. Edit lists are joined.
    """
    require(len(runs) > 1, "give two or more runs to merge")
    require(not output.exists() or not any(output.iterdir()), f"{output}: is not empty; choose another output")
    folders = [RunFolder.open(run) for run in runs]
    results = [load_result(run) for run in runs]
    provenances = [folder.provenance() for folder in folders]
    for run, provenance in zip(runs[1:], provenances[1:], strict=True):
        _require_alike(runs[0], provenances[0]["inputs"], run, provenance["inputs"])
    cameras = {(run / CAMERA_FILE).read_bytes() if (run / CAMERA_FILE).exists() else b"" for run in runs}
    require(
        len(cameras) == 1,
        f"{runs[0]} and the others have different calibrated cameras: run one campaign for all images",
    )
    _require_same_files(runs, folders)
    make_folder(output)
    first = provenances[0]
    files = list(dict.fromkeys(record.file for result in results for record in result.attitudes))
    inputs = first["inputs"] | {"image_files": files}
    merged = RunFolder.start(output, inputs, first.get("environment", {}) | {"merged_from": [str(run) for run in runs]})
    if cameras != {b""}:
        (output / CAMERA_FILE).write_bytes(cameras.pop())
    for run, folder in zip(runs, folders, strict=True):
        merged.adopt(folder, partial(_path_from, os.path.relpath(run, output)))
        add_edits(output, read_edits(run).edits)
    hashes = {record.file: record.sha256 for result in results for record in reversed(result.attitudes)}
    warnings = list(dict.fromkeys(text for result in results for text in result.warnings))
    summary = first["run"] | {"warnings": warnings, "time_s": sum(result.time_s for result in results)}
    summary["empty_images"] = sorted({key for result in results for key in result.empty_images})
    merged.write_provenance(merged.provenance() | {"images_sha256": hashes, "run": summary})
    result = load_result(output)
    write_tables(output, result.attitudes, result.observations)
    write_run_observables(result)
    write_report(result)
    return result


def _path_from(base: str, path: str) -> str:
    return Path(os.path.normpath(Path(base, path))).as_posix()


def _require_alike(first: Path, before: Mapping[str, Any], other: Path, now: Mapping[str, Any]) -> None:
    differing = [name for name in changes(before, now) if not name.startswith(_MAY_DIFFER)]
    if differing:
        raise InputError(
            f"{first} and {other} cannot be merged, because they differ in {', '.join(differing[:5])}: run both with "
            "the same options first"
        )


def _require_same_files(runs: Sequence[Path], folders: Sequence[RunFolder]) -> None:
    """Raise if two runs have different files of one name."""
    known: dict[str, tuple[str, Path]] = {}
    for run, folder in zip(runs, folders, strict=True):
        for file, image in folder.images().items():
            sha256, before = known.setdefault(file, (image.sha256, run))
            require(
                sha256 == image.sha256,
                f"{before} and {run} cannot be merged: {file!r} is another image in each; rename one and run it again",
            )
