"""Check of a dossier: its inputs are unchanged, and a rerun reproduces its results."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.provenance import file_sha256, package_versions
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.store.edits import EDITS_FILE
from giantlike.core.errors import DataError
from giantlike.core.version import VERSION
from giantlike.viewer.dossier import DOSSIER_FILE

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
    known += [(f"{path} in the dossier", path, digest) for path, digest in content["files"].items()]
    changed, missing = [], []
    for name, path, digest in known:
        file = dossier / path
        found = _digest_of(file)
        if found is None:
            missing.append(name)
        elif found != digest:
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


def _digest_of(file: Path) -> str | None:
    """SHA-256 of a file; None if it is not there or cannot be read."""
    try:
        return file_sha256(file) if file.is_file() else None
    except OSError:
        return None


def reproduce(dossier: Path, output: Path, *, workers: int | None = None) -> list[str]:
    """Run the campaign of a dossier again, with its edits, and compare the tables.

    The result is empty if the run came out the same.
    """
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
