"""What a finished run says, as values and as counts."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from giantlike.campaign.calibration.solve import RESULT_FILE
from giantlike.campaign.store.parts import RunFolder
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord, ObservationsRecord
from giantlike.core.errors import DataError
from giantlike.core.values import Value


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunResult(Value):
    """A finished run.

    Parameters
    ----------
    folder : Path
        The run folder.
    name : str
        Of the campaign.
    attitudes : tuple of AttitudeRecord
        One per image, in input order; lists of stars stay in the run folder.
    bodies : tuple of ObservationsRecord
        One per image that shows a body; limb points and outlines stay in the run folder.
    hdu : int or str or None
        Which extension of FITS files was read.
    bottom_up : bool
        Whether rows were turned around.
    max_overlays : int
        How many images the report shows.
    warnings : tuple of str
    time_s : float
        Of the last part of the run.
    calibration : dict, optional
        What ``calibration.json`` holds, where the campaign calibrates.
    """

    folder: Path
    name: str
    attitudes: tuple[AttitudeRecord, ...]
    bodies: tuple[ObservationsRecord, ...]
    hdu: int | str | None
    bottom_up: bool
    max_overlays: int
    warnings: tuple[str, ...]
    time_s: float
    calibration: dict[str, Any] | None = None

    @property
    def observations(self) -> tuple[ObservationRecord, ...]:
        """One per image, target and estimator, in input order."""
        return tuple(record for image in self.bodies for record in image.observations)

    @property
    def failed_images(self) -> tuple[str, ...]:
        """Images without an attitude, and those with a body of which no estimator made a fix."""
        seen = {record.file for record in self.observations}
        fixed = {record.file for record in self.observations if record.status != "failed"}
        return tuple(
            record.file
            for record in self.attitudes
            if record.status == "failed" or (record.file in seen and record.file not in fixed)
        )

    def summary(self) -> dict[str, Any]:
        """Counts as JSON has them."""
        estimators = dict.fromkeys((record.target, record.estimator) for record in self.observations)
        return {
            "campaign": self.name,
            "output": str(self.folder),
            "images": len(self.attitudes),
            "failed_images": list(self.failed_images),
            "attitudes": _counts(self.attitudes),
            "observations": [
                {"target": target, "estimator": estimator}
                | _counts([r for r in self.observations if (r.target, r.estimator) == (target, estimator)])
                for target, estimator in estimators
            ],
            "calibration": self.calibration,
            "warnings": list(self.warnings),
            "time_s": round(self.time_s, 3),
        }


def load_result(path: Path) -> RunResult:
    """Read a finished run back from its folder.

    Raises
    ------
    DataError
        It is no run folder, or the run in it is not finished.
    """
    folder = RunFolder.open(path)
    run = folder.provenance().get("run")
    if not isinstance(run, dict):
        raise DataError(path, "the run in this folder is not finished: continue it with giantlike run --resume")
    return RunResult(
        folder=path,
        attitudes=tuple(folder.load_all(AttitudeRecord)),
        bodies=tuple(folder.load_all(ObservationsRecord)),
        name=run["name"],
        hdu=run["hdu"],
        bottom_up=run.get("bottom_up", False),
        max_overlays=run["max_overlays"],
        warnings=tuple(run["warnings"]),
        time_s=run["time_s"],
        calibration=_calibration(path / RESULT_FILE),
    )


def _calibration(path: Path) -> dict[str, Any] | None:
    """Content of ``calibration.json``; None where there is none."""
    if not path.exists():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(path, "is damaged: continue the run with giantlike run --resume") from error
    return dict(content)


def _counts(records: Sequence[AttitudeRecord | ObservationRecord]) -> dict[str, Any]:
    statuses = Counter(record.status for record in records)
    reasons = Counter(str(record.problem.reason) for record in records if record.problem is not None)
    return {status: statuses.get(status, 0) for status in ("ok", "suspect", "failed")} | {"reasons": dict(reasons)}
