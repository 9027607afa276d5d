"""``giantlike gauntlet``: off-nominal images, every estimator on each, and a verdict on each answer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from giantlike._system.atomic import make_folder
from giantlike._system.processes import process_count
from giantlike.campaign.store.lock import hold_lock
from giantlike.cli.arguments import Json, Overwrite, Resume, Workers
from giantlike.cli.outcome import ExitCode, print_json, say
from giantlike.cli.progress import progress_bar
from giantlike.core.arrays import require
from giantlike.core.errors import InputError
from giantlike.gauntlet.files import has_results, load_results, save_results
from giantlike.gauntlet.kinds import KINDS
from giantlike.gauntlet.run import Gauntlet, ImageResult, run_gauntlet, summary_of


def gauntlet(
    images: Annotated[int, typer.Option(min=1, help="Number of images.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Everything of image i follows from the seed and i.")] = 1,
    output: Annotated[
        Path | None, typer.Option(help="Folder for gauntlet.json, verdicts.csv and report.html.", metavar="DIR")
    ] = None,
    kinds: Annotated[str, typer.Option(help="Run the first images of these kinds only.", metavar="A,B")] = "",
    estimators: Annotated[str, typer.Option(help="Run these estimators only.", metavar="X,Y")] = "",
    only: Annotated[str, typer.Option(help="Run these images only, by number; list all rows.", metavar="I,J")] = "",
    real: Annotated[
        Path | None,
        typer.Option(help="Folder of real images that do not show the target; run them too.", metavar="DATA"),
    ] = None,
    workers: Workers = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    list_kinds: Annotated[bool, typer.Option("--list-kinds", help="List the kinds of images and stop.")] = False,
    json: Json = False,
) -> ExitCode:
    """Run every estimator on off-nominal images with known truth, and classify each answer.

    Images come from a renderer that shares no code with the estimators. docs/gauntlet.md describes the kinds, the a
    priori data of the estimators, and the rules of the outcome classes.
    """
    if list_kinds:
        for kind in KINDS.values():
            typer.echo(f"{kind.name:<24}{kind.summary}")
        return ExitCode.DONE
    wanted = Gauntlet(
        images=images,
        seed=seed,
        kinds=_names(kinds),
        estimators=_names(estimators),
        indices=_numbers(only),
        workers=process_count(workers, len(_numbers(only)) or images),
        real=real,
    )
    if output is None:
        results = _run(wanted, None, resume=resume, overwrite=overwrite)
    else:
        make_folder(output)
        with hold_lock(output):
            results = _run(wanted, output, resume=resume, overwrite=overwrite)
    report = summary_of(wanted, results)
    if only:
        report["rows"] = [asdict(row) for result in results for row in result.rows]
    if json:
        print_json(report)
    else:
        _show(report)
    return ExitCode.DONE


def _names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(",") if part.strip())


def _numbers(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in _names(text))
    except ValueError:
        raise InputError(f"--only takes numbers of images separated by commas, got {text!r}") from None


def _run(wanted: Gauntlet, output: Path | None, *, resume: bool, overwrite: bool) -> list[ImageResult]:
    """Run the images that are missing, and keep the folder up to date."""
    finished: list[ImageResult] = []
    if output is not None and has_results(output) and not overwrite:
        require(resume, f"{output} holds a gauntlet already: use --resume, --overwrite or another folder")
        finished = load_results(output, wanted)
    results = {result.index: result for result in finished}
    with progress_bar() as progress:
        for result in run_gauntlet(
            wanted, finished=finished, progress=lambda done, all_: progress("images", done, all_)
        ):
            results[result.index] = result
            if output is not None:
                save_results(output, wanted, [result], append=True)
    ordered = [results[index] for index in sorted(results)]
    if output is not None:
        save_results(output, wanted, ordered, append=False)
    return ordered


def _show(report: Mapping[str, Any]) -> None:
    """Counts by estimator and by kind, as text."""
    alarms = report["false_alarms_nominal"]
    typer.echo(
        f"{report['images']} images, {report['verdicts']} verdicts: {report['silent_wrong']} silent wrong, "
        f"{report['needless_refusals']} needless refusals, {report['vague']} vague, {report['doubtful']} doubtful, "
        f"{report['misleading']} misleading; {alarms['suspect']} of {alarms['fixes']} nominal fixes suspect; "
        f"{report['cpu_s_mean']:.2f} s of computing an image"
    )
    for title in ("by_estimator", "by_kind"):
        names = [name for name in next(iter(report[title].values()), {}) if name != "verdicts"]
        typer.echo(
            f"\n{title.replace('_', ' '):<24}{'all':>7}" + "".join(f"{name.replace('_', ' '):>18}" for name in names)
        )
        for name, counts in report[title].items():
            cells = "".join(f"{counts[each] or '-':>18}" for each in names)
            typer.echo(f"{name:<24}{counts['verdicts']:>7}{cells}")
    for row in report.get("rows", []):
        say(f"{row['image']:>6} {row['kind']:<18}{row['estimator']:<18}{row['verdict']:<18}{row['reason'] or ''}")
