"""A campaign from its file to its run folder: calibration, attitudes, transfer, bodies, tables and report."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeAlias

from giantlike._system.atomic import make_folder
from giantlike._system.processes import available_cpus, process_count
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.report.run_page import write_report
from giantlike.campaign.run.common_errors import find_common_errors
from giantlike.campaign.run.making import Announce, Progress, RunExecutor
from giantlike.campaign.run.network import make_network
from giantlike.campaign.run.pool import Pool, WorkerPool
from giantlike.campaign.run.provenance import Identities, environment_of, inputs_of
from giantlike.campaign.run.steps import digest
from giantlike.campaign.run.worker_context import Workbench
from giantlike.campaign.store.edits import EDITS_FILE, read_edits
from giantlike.campaign.store.lock import hold_lock
from giantlike.campaign.store.log import RunLogHandler
from giantlike.campaign.store.observables import (
    OBSERVABLES_FILE,
    ImageRecords,
    ObservableGroups,
    table_of,
    write_run_observables,
)
from giantlike.campaign.store.records import RunSummary
from giantlike.campaign.store.results import RunResult, camera_of_run, changes
from giantlike.campaign.store.run_folder import REPORT_PAGE, RunFolder
from giantlike.campaign.store.tables import TABLE_FILES, write_tables
from giantlike.core.errors import DataError, InputError

PoolMaker: TypeAlias = Callable[[Workbench, int], Pool]
"""Called with the workbench and the number of images; makes the executor of the work."""
Check: TypeAlias = Callable[[Workbench], Iterable[str]]
"""Called with the workbench; returns warnings, or raises for an error that reaches every image."""


def run_campaign(
    campaign: Campaign,
    *,
    workers: int | None = None,
    resume: bool = True,
    bodies: bool = True,
    progress: Progress | None = None,
    announce: Announce | None = None,
    pool: PoolMaker | None = None,
    check: Check | None = None,
) -> RunResult:
    """Run a campaign and write its run folder.

    Results that the folder holds and that nothing has changed for are kept; all others are made.

    With a ``[calibration]`` section the camera is calibrated first, and everything else uses the calibrated camera.
    If calibration fails or is not accepted, the run goes on with the given camera and a warning.

    Parameters
    ----------
    campaign : Campaign
    workers : int, optional
        Number of processes; default one per CPU, never more than images. With fewer images, estimators of one image run
        in parallel, in at most this number of threads in total.
    resume : bool; accepted and without effect: a run always continues from its folder
    bodies : bool; run the estimators of bodies too; without them the run ends with the attitudes (and can be continued)
    progress : callable, optional; called with the name of the step, the number of images done, and their total
    announce : callable, optional; called with lines on changes and pending work before the work starts
    pool : callable, optional; makes the executor from workbench and number of images; default: processes
    check : callable, optional; called with the workbench first; returns warnings for the report, or raises

    Raises
    ------
    InputError
        The run folder holds something else, or another run is at work in it.
    DataError
        A kernel, shape or catalog is damaged, or the run folder cannot be written.
    """
    start = time.perf_counter()
    RunFolder(campaign.output).check_usable()
    bench = Workbench.load(campaign)

    def processes(bench: Workbench, jobs: int) -> Pool:
        return WorkerPool(bench, process_count(workers, jobs), cores=workers or available_cpus())

    try:
        known = set(campaign.warnings)
        for warning in check(bench) if check else ():
            if warning not in known:
                bench = bench.with_warning(warning)
        campaign = bench.campaign
        make_folder(campaign.output)
        with hold_lock(campaign.output) as dead, RunLogHandler(campaign.output):
            folder = RunFolder(campaign.output)
            before = _provenance(folder)
            inputs = inputs_of(campaign, bench)
            changed = changes(before.get("inputs", {}), inputs) if before else []
            if before.get("run") is not None and before.get("edits", "") != _edits_digest(folder):
                changed.append("the edit list")
            RunFolder.start(campaign.output, inputs, environment_of(campaign))
            folder.log("run_started", images=len(campaign.images), changed=changed, taken_over_from=dead)
            for warning in campaign.warnings:
                folder.log("warning", detail=warning)
            with folder.writing():
                _require_same_images(campaign, folder)
                folder.set_images([(entry.key, campaign.path_from_output(entry.path)) for entry in campaign.images])
                edits = read_edits(folder.path)
                run = RunExecutor(
                    bench=bench,
                    folder=folder,
                    progress=progress or silent,
                    announce=announce or _unheard,
                    edits=edits,
                    measuring=edits.measuring(),
                    identities=Identities(folder),
                    goes_on=bool(before),
                )
                if before:
                    run.announce(_what_changed(campaign, changed, dead))
                with (pool or processes)(bench, len(campaign.images)) as workforce:
                    run, calibration = run.calibrate(workforce)
                    run.make_all(workforce, bodies=bodies)
                    attitudes = tuple(run.edits.attitudes(folder.attitudes()))
                    found = tuple(run.edits.bodies(folder.bodies()))
                    observations = [record for image in found for record in image.observations]
                    network = make_network(run, workforce, attitudes) if bodies else None
                    common = find_common_errors(run.bench.campaign, attitudes, observations)
                    result = RunResult(
                        folder=folder.path,
                        name=campaign.name,
                        attitudes=attitudes,
                        bodies=found,
                        hdu=campaign.hdu,
                        bottom_up=campaign.bottom_up,
                        max_overlays=campaign.max_overlays,
                        warnings=(*run.bench.campaign.warnings, *common),
                        time_s=time.perf_counter() - start,
                        calibration=calibration,
                        empty_images=campaign.empty_images,
                        steps=run.counts,
                        network=network,
                    )
                    if not _as_before(before, inputs, folder, run):
                        _write_results(folder, result, workforce)
                _finish(folder, result)
    finally:
        bench.close()
    return result


def _provenance(folder: RunFolder) -> dict[str, Any]:
    """Provenance of the run that the folder holds; empty for a new one."""
    try:
        return folder.provenance()
    except DataError:
        return {}


def _require_same_images(campaign: Campaign, folder: RunFolder) -> None:
    """Raise if the folder holds the results of unrelated images: a name used twice by error."""
    known = folder.images()
    if known and not any(entry.key in known for entry in campaign.images):
        raise InputError(
            f"{folder.path}: holds a run of other images ({next(iter(known))!r}, ...), none of which is in this "
            "campaign; choose another output"
        )


def _what_changed(campaign: Campaign, changed: list[str], dead: str | None) -> str:
    names = ", ".join(changed[:8]) + (f" and {len(changed) - 8} more" if len(changed) > 8 else "")
    text = f"{campaign.output}: goes on with the run that is there; changed: {names or 'no option'}"
    return text if dead is None else f"{text}; taken over from {dead}, which died"


def _as_before(before: dict[str, Any], inputs: dict[str, Any], folder: RunFolder, run: RunExecutor) -> bool:
    """True if tables and report of the last run still hold."""
    return (
        not any(count.redone for count in run.counts.values())
        and before.get("run") is not None
        and before.get("edits") == _edits_digest(folder)
        and not changes(before.get("inputs", {}), folder.provenance().get("inputs", {}))
        and all((folder.path / name).is_file() for name in (*TABLE_FILES, OBSERVABLES_FILE, REPORT_PAGE))
    )


def _edits_digest(folder: RunFolder) -> str:
    path = folder.path / EDITS_FILE
    return digest(path) if path.is_file() else ""


def _write_results(folder: RunFolder, result: RunResult, pool: Pool) -> None:
    """Write tables, report and observables, whose groups workers make while this process draws the report."""
    write_tables(folder.path, result.attitudes, result.observations)
    groups = ObservableGroups(folder, result, camera_of_run(folder.path))
    answers = pool.run(_observables_table, groups)
    write_report(result)
    write_run_observables(result, tables=_in_order(groups, answers))


def _observables_table(_: Workbench, images: list[ImageRecords]) -> Any:
    return table_of(images)


def _in_order(groups: ObservableGroups, answers: Iterator[tuple[int, Any]]) -> Iterator[Any]:
    """Tables of groups in their order; tables lost with a dead worker are made here."""
    held, number = dict[int, Any](), 0
    for position, table in answers:
        held[position] = table_of(groups[position]) if table is None else table
        while number in held:
            yield held.pop(number)
            number += 1


def _finish(folder: RunFolder, result: RunResult) -> None:
    run = RunSummary(
        name=result.name,
        hdu=result.hdu,
        bottom_up=result.bottom_up,
        max_overlays=result.max_overlays,
        warnings=list(result.warnings),
        time_s=round(result.time_s, 3),
        empty_images=sorted(result.empty_images),
    )
    images = {record.file: record.sha256 for record in result.attitudes}
    more = {"images_sha256": images, "run": run.model_dump(), "edits": _edits_digest(folder)}
    folder.write_provenance(folder.provenance() | more)
    folder.log("run_finished", failed_images=len(result.failed_images), time_s=run.time_s)


def silent(stage: str, done: int, total: int) -> None:
    """Report nothing."""


def _unheard(text: str) -> None:
    """Ignore progress."""
