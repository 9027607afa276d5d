"""Dossier of a run: the data for a verification report, in one folder; and its check."""

from __future__ import annotations

import csv
import dataclasses
import getpass
import json
import os
import shutil
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from giantlike._system.atomic import make_folder, write_text_atomic
from giantlike.campaign.export import ExportFormat, export_run
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.report.cards import card, center_colors
from giantlike.campaign.report.figures import attitude_figures, body_figures
from giantlike.campaign.report.templates import render_page
from giantlike.campaign.run.provenance import file_sha256, inputs_of, package_versions
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.run.steps import digest
from giantlike.campaign.run.worker_context import Workbench
from giantlike.campaign.store.edits import EDITS_FILE, read_edits
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord
from giantlike.campaign.store.results import StatusCounts, changes
from giantlike.campaign.store.run_folder import RESULTS_FILE, RunFolder
from giantlike.core.errors import DataError, InputError
from giantlike.core.version import VERSION
from giantlike.viewer.explain import explain
from giantlike.viewer.session import Session

DOSSIER_FILE, DOSSIER_PAGE = "dossier.json", "dossier.html"
_NOT_COPIED = frozenset({RESULTS_FILE, ".lock"})
"""Files of a run folder that a dossier goes without: points for pictures, which it has."""
_EXPORTS = {ExportFormat.CSV: "attitudes.csv", ExportFormat.AEM: "attitudes.aem", ExportFormat.TDM: "observables.tdm"}


@dataclass(frozen=True, slots=True, kw_only=True)
class InputFile:
    """An input file of a run."""

    role: str  # role in the campaign: ``image``, ``camera``, ``kernel``,
    path: str  # relative to the dossier
    sha256: str


def write_dossier(run: Path, output: Path | None = None, campaign: Path | None = None) -> Path:
    """Write the dossier of a finished run."""
    session = Session(run, campaign)
    output = output or run / "dossier"
    loaded = Campaign.load(session.campaign_file)
    bench = Workbench.load(loaded)
    try:
        inputs = list(_input_files(loaded, bench, output))
        _require_current(session, loaded, bench)
    finally:
        bench.close()
    _clear(output)
    _copy_run(session, loaded, output)
    notes = _write_exports(run, output)
    _write_figures(session, output)
    content = _content(session, loaded, inputs, notes, output)
    write_text_atomic(output / DOSSIER_PAGE, render_page("dossier.html.j2", **content))
    content["files"] = {
        path.relative_to(output).as_posix(): file_sha256(path) for path in sorted(output.rglob("*")) if path.is_file()
    }
    write_text_atomic(output / DOSSIER_FILE, json.dumps(content, indent=1, default=str) + "\n")
    return output


def _input_files(campaign: Campaign, bench: Workbench, output: Path) -> Iterator[InputFile]:
    """Every file that a campaign names, once; folders file by file."""
    found: dict[Path, str] = {campaign.path: "campaign"}
    for entry in campaign.images:
        found.setdefault(entry.path, "image")
    for role, path in (("camera", campaign.camera_file), ("geometry table", campaign.geometry_file)):
        if path is not None:
            found.setdefault(path, role)
    for path in () if bench.kernels is None else bench.kernels.paths:
        found.setdefault(path, "kernel")
    if campaign.stars is not None and Path(campaign.stars.catalog).is_file():
        found.setdefault(Path(campaign.stars.catalog), "star catalog")
    parts = {"calibration frame": campaign.frames, "kernel": campaign.spice, "stars": campaign.stars}
    for role, part in (*parts.items(), *((f"target {each.name}", each) for each in campaign.targets)):
        for path in _paths_in(part):
            found.setdefault(path, role)
    for path, role in found.items():
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_file():
                name = Path(os.path.relpath(file, output)).as_posix()
                yield InputFile(role=role, path=name, sha256=file_sha256(file))


def _paths_in(value: Any) -> Iterator[Path]:
    """Paths anywhere within a setup of a campaign."""
    if isinstance(value, Path):
        yield value
    elif dataclasses.is_dataclass(value):
        for each in dataclasses.fields(value):
            yield from _paths_in(getattr(value, each.name))
    elif isinstance(value, Mapping):
        for inner in value.values():
            yield from _paths_in(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _paths_in(inner)
    elif hasattr(value, "options"):  # an estimator holds its options
        yield from _paths_in(value.options)


def _require_current(session: Session, campaign: Campaign, bench: Workbench) -> None:
    """Raise unless the run is up to date with its inputs and its edit list."""
    provenance = RunFolder.open(session.folder).provenance()
    changed = changes(provenance.get("inputs", {}), inputs_of(campaign, bench))
    images = provenance.get("images_sha256", {})
    changed += [entry.key for entry in campaign.images if images.get(entry.key) != file_sha256(entry.path)]
    if provenance.get("edits", "") != _digest_of(session.folder / EDITS_FILE):
        changed.append("the edit list")
    if changed:
        names = ", ".join(changed[:6]) + (f" and {len(changed) - 6} more" if len(changed) > 6 else "")
        raise InputError(
            f"{session.folder}: since this run there changed: {names}; bring it up to date first: "
            f"giantlike run {session.campaign_file}"
        )


def _digest_of(path: Path) -> str:
    return digest(path) if path.is_file() else ""


def _clear(output: Path) -> None:
    """Prepare an empty folder at a path that does not exist or is a dossier."""
    if output.is_dir() and any(output.iterdir()):
        if not (output / DOSSIER_FILE).is_file():
            raise InputError(f"{output}: holds something else than a dossier; choose another --output")
        shutil.rmtree(output)
    make_folder(output)


def _copy_run(session: Session, campaign: Campaign, output: Path) -> None:
    """Copy the outputs of the run, and the campaign file."""
    try:
        shutil.copyfile(campaign.path, output / campaign.path.name)
        make_folder(output / "run")
        for path in sorted(session.folder.iterdir()):
            if path.is_file() and path.name not in _NOT_COPIED:
                shutil.copyfile(path, output / "run" / path.name)
    except OSError as error:
        raise DataError(output, f"cannot be written: {error.strerror or error}") from error


def _write_exports(run: Path, output: Path) -> list[str]:
    """Write exports; the reasons why some are not there."""
    notes = []
    for kind, name in _EXPORTS.items():
        try:
            export_run(run, output / "exports" / name, kind)
        except InputError as error:
            notes.append(f"{name}: {error}")
    return notes


def _write_figures(session: Session, output: Path) -> None:
    """Write the figures of the report, and a picture and the words of every image, as files."""
    result, folder = session.result, output / "figures"
    make_folder(folder)
    for number, figure in enumerate([*attitude_figures(result), *body_figures(result)], start=1):
        write_text_atomic(folder / f"figure{number:02d}.svg", figure.svg)
        write_text_atomic(folder / f"figure{number:02d}.txt", figure.caption + "\n")
    colors, words = center_colors(result), list[str]()
    for record in result.attitudes:
        words.append(explain(session.seen(record.file)))
        made = card(result, record, colors) if record.readable else None
        if made is not None and made.picture is not None:
            write_text_atomic(folder / f"image{record.index:04d}.svg", made.picture)
            for number, picture in enumerate(made.residuals, start=1):
                write_text_atomic(folder / f"image{record.index:04d}_residuals{number}.svg", picture)
    write_text_atomic(output / "explanations.txt", "\n\n\n".join(words) + "\n")


def _content(
    session: Session, campaign: Campaign, inputs: list[InputFile], notes: list[str], output: Path
) -> dict[str, Any]:
    """Content of the page, as JSON."""
    result, provenance = session.result, RunFolder.open(session.folder).provenance()
    environment = provenance.get("environment", {})
    records: list[AttitudeRecord | ObservationRecord] = [*result.attitudes, *result.observations]
    campaign_file = Path(os.path.relpath(campaign.path, output)).as_posix()
    return {
        "name": result.name,
        "made_by": getpass.getuser(),
        "made_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "run": Path(os.path.relpath(session.folder, output)).as_posix(),
        "campaign_file": campaign_file,
        "command": f"giantlike dossier {output.name} --reproduce NEW_RUN",
        "versions": {
            "giantlike": provenance["inputs"]["giantlike"],
            "python": environment.get("python", ""),
            "platform": environment.get("platform", ""),
            "packages": environment.get("packages", {}),
        },
        "catalog": provenance["inputs"].get("catalog"),
        "inputs": [asdict(each) for each in inputs],
        "campaign": provenance["inputs"].get("campaign", {}),
        "options": provenance["inputs"].get("options", {}),
        "edits": [
            edit.model_dump(mode="json", exclude_none=True) | {"name": edit.name}
            for edit in read_edits(session.folder).edits
        ],
        "verdicts": {
            "attitudes": asdict(StatusCounts.from_records(result.attitudes)),
            **{
                f"{target}: {estimator}": asdict(StatusCounts.from_records(records))
                for (target, estimator), records in result.by_estimator.items()
            },
        },
        "doubts": [_doubt(one) for one in records if one.status != "ok"],
        "warnings": list(result.warnings),
        "exports_left_out": notes,
    }


def _doubt(one: AttitudeRecord | ObservationRecord) -> dict[str, Any]:
    """A result that failed or is suspect, with reason and flags."""
    what = f"{one.target}: {one.estimator}" if isinstance(one, ObservationRecord) else "attitude"
    reason = "" if one.problem is None else f"{one.problem.reason}: {one.problem.detail}"
    status = {"status": one.status, "outcome": one.outcome}
    accepted = None if one.accepted is None else one.accepted.model_dump()
    return {"file": one.file, "what": what, **status, "reason": reason, "flags": list(one.flags), "accepted": accepted}


_TABLES = ("attitudes.csv", "observations.csv")
_TIME_COLUMN = "time_s"  # column of the tables that differs from run to run


class _Input(BaseModel):
    model_config = ConfigDict(strict=True)
    role: str
    path: str
    sha256: str


class _Versions(BaseModel):
    model_config = ConfigDict(strict=True)
    giantlike: str
    packages: dict[str, str]


class _Dossier(BaseModel):
    """The part of ``dossier.json`` that is read back."""

    model_config = ConfigDict(strict=True)
    inputs: list[_Input]
    files: dict[str, str]
    versions: _Versions
    campaign_file: str


@dataclass(frozen=True, slots=True, kw_only=True)
class DossierCheck:
    """Comparison of a dossier and its inputs with their recorded hashes."""

    same: int  # number of unchanged files
    changed: tuple[str, ...]  # changed, missing: roles and paths of inputs, and files of the dossier
    missing: tuple[str, ...]
    versions: tuple[str, ...]  # packages that have another version here; they do not make the dossier wrong

    @property
    def holds(self) -> bool:
        """True if nothing changed and nothing is missing."""
        return not self.changed and not self.missing


def check_dossier(dossier: Path) -> DossierCheck:
    """Compare a dossier and the inputs of its run with the hashes that it holds."""
    content = read_dossier(dossier)
    known = [(f"{each['role']} {each['path']}", each["path"], each["sha256"]) for each in content["inputs"]]
    known += [(f"{path} in the dossier", path, sha256) for path, sha256 in content["files"].items()]
    changed, missing = [], []
    for name, path, sha256 in known:
        file = dossier / path
        found = _sha256_of(file)
        if found is None:
            missing.append(name)
        elif found != sha256:
            changed.append(name)
    before = {"giantlike": content["versions"]["giantlike"], **content["versions"]["packages"]}
    now = {"giantlike": VERSION, **package_versions()}
    versions = [f"{name} {old}, here {now.get(name)}" for name, old in before.items() if now.get(name) != old]
    return DossierCheck(
        same=len(known) - len(changed) - len(missing),
        changed=tuple(changed),
        missing=tuple(missing),
        versions=tuple(versions),
    )


def _sha256_of(file: Path) -> str | None:
    """SHA-256 of a file; None if it is not there or cannot be read."""
    try:
        return file_sha256(file) if file.is_file() else None
    except OSError:
        return None


def reproduce(dossier: Path, output: Path, *, workers: int | None = None) -> list[str]:
    """Run the campaign of a dossier again, with its edits; returns the differences of tables, if there are any."""
    content = read_dossier(dossier)
    campaign = replace(Campaign.load(dossier / content["campaign_file"]), output=output)
    run_campaign(campaign, workers=workers)
    edits = dossier / "run" / EDITS_FILE
    if edits.is_file():
        shutil.copyfile(edits, output / EDITS_FILE)
        run_campaign(campaign, workers=workers)
    different = []
    for name in _TABLES:
        before, now = (_rows(folder / name) for folder in (dossier / "run", output))
        different += [f"{name}: {key}" for key in dict.fromkeys([*before, *now]) if before.get(key) != now.get(key)]
    return different


def read_dossier(dossier: Path) -> dict[str, Any]:
    """Content of ``dossier.json``."""
    path = dossier / DOSSIER_FILE
    try:
        text = path.read_text(encoding="utf-8")
        _Dossier.model_validate_json(text)
        content = json.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(path, "is missing or damaged: this is no dossier; giantlike dossier RUN writes one") from error
    return dict(content)


def _rows(path: Path) -> dict[str, dict[str, str]]:
    """Rows of a table by image, target and estimator, without the time that they took."""
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream, restkey="", restval=""))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(path, f"cannot be read: {error}") from error
    keys = ("file", "target", "estimator")
    return {" ".join(row[key] for key in keys if key in row): row | {_TIME_COLUMN: ""} for row in rows}
