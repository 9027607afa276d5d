"""``report.html``: a finished run for people, in one file that needs nothing else."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from giantlike.campaign.report.figures import attitude_figures, body_figures, center_colors, overlay
from giantlike.campaign.report.templates import render_page
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord
from giantlike.campaign.store.results import RunResult
from giantlike.core.atomic import write_text_atomic
from giantlike.core.outcomes import Quality
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.core.version import VERSION
from giantlike.plotting import MARKS

_MAX_FAILURES = 300


def write_report(result: RunResult) -> Path:
    """Write ``report.html`` into the run folder and return its path.

    Raises
    ------
    DataError
        The file cannot be written.
    """
    failures = _failures(result)
    shown = _images_to_show(result)
    page = render_page(
        "report.html.j2",
        name=result.name,
        version=VERSION,
        n_images=len(result.attitudes),
        failed_images=result.failed_images,
        attitudes=_attitude_summary(result.attitudes),
        observations=_observation_summary(result.observations),
        reasons=Counter((failure.stage, failure.reason) for failure in failures).most_common(),
        failures=failures[:_MAX_FAILURES],
        n_failures=len(failures),
        warnings=[*result.warnings, *_notes(result)],
        attitude_figures=attitude_figures(result),
        body_figures=body_figures(result),
        overlays=[overlay(result, record) for record in shown],
        marks=MARKS,
        centers=center_colors(result),
        n_readable=sum(record.readable for record in result.attitudes),
        time_s=result.time_s,
        calibration=result.calibration,
    )
    path = result.folder / "report.html"
    write_text_atomic(path, page)
    return path


@dataclass(frozen=True, slots=True)
class _Failure:
    file: str
    stage: str
    reason: str
    detail: str


def _failures(result: RunResult) -> list[_Failure]:
    found = [
        _Failure(record.file, "attitude", str(record.problem.reason), record.problem.detail)
        for record in result.attitudes
        if record.problem is not None
    ]
    unreadable = {record.file for record in result.attitudes if not record.readable}
    found += [
        _Failure(record.file, f"{record.target}: {record.estimator}", str(record.problem.reason), record.problem.detail)
        for record in result.observations
        if record.problem is not None and record.file not in unreadable
    ]
    return found


def _notes(result: RunResult) -> list[str]:
    moving = sum(str(Quality.OBSERVER_UNKNOWN.name).lower() in record.flags for record in result.attitudes)
    notes = [
        f"{moving} attitude{'s' * (moving > 1)} from stars without the spacecraft's velocity: stellar aberration, some "
        "20 arcsec at 1 au, is still in (give observer columns in the geometry table, header keywords or [spice])"
    ] * (moving > 0)
    notes += [f"{record.file}: {note}" for record in result.attitudes for note in record.notes]
    return notes + [f"{image.file}: {note}" for image in result.bodies for note in image.notes]


def _attitude_summary(records: Sequence[AttitudeRecord]) -> list[dict[str, Any]]:
    """One row per source: counts, and medians of what the good ones say."""
    groups: dict[str, list[AttitudeRecord]] = {}
    for record in records:
        wanted = "stars" if record.star_image else "interpolated" if record.transferred else "a_priori"
        groups.setdefault(wanted if record.readable else "unreadable image", []).append(record)
    table = []
    for source, members in groups.items():
        sigmas = [
            ARCSEC_PER_RAD * np.sqrt(np.diag(record.attitude.covariance_rad2))
            for record in members
            if record.attitude is not None and record.attitude.covariance_rad2 is not None
        ]
        table.append(
            {"source": source}
            | _status_counts(members)
            | {
                "n_matched": _median([record.n_matched for record in members]),
                "rms_px": _median([record.rms_px for record in members]),
                "sigma_across_arcsec": _median([float(max(sigma[0], sigma[1])) for sigma in sigmas]),
                "sigma_roll_arcsec": _median([float(sigma[2]) for sigma in sigmas]),
            }
        )
    return table


def _observation_summary(records: Sequence[ObservationRecord]) -> list[dict[str, Any]]:
    """One row per target and estimator: counts, and medians of what the good ones say."""
    groups: dict[tuple[str, str], list[ObservationRecord]] = {}
    for record in records:
        groups.setdefault((record.target, record.estimator), []).append(record)
    table = []
    for (target, estimator), members in groups.items():
        offsets, sigmas, range_errors, range_sigmas = [], [], [], []
        for record in members:
            if record.center_px is None or record.predicted_px is None or record.covariance_px2 is None:
                continue
            offsets.append(float(np.hypot(*np.subtract(record.center_px, record.predicted_px))))
            sigmas.append(float(np.sqrt(np.trace(record.covariance_px2) / 2)))
            if record.range_km is not None and record.sigma_range_km is not None and record.predicted_camera_km:
                range_errors.append(abs(record.range_km / float(np.linalg.norm(record.predicted_camera_km)) - 1) * 100)
                range_sigmas.append(record.sigma_range_km / record.range_km * 100)
        table.append(
            {"target": target, "estimator": estimator}
            | _status_counts(members)
            | {
                "offset_px": _median(offsets),
                "sigma_px": _median(sigmas),
                "range_offset_percent": _median(range_errors),
                "sigma_range_percent": _median(range_sigmas),
                "time_s": _median([record.time_s for record in members if record.status != "failed"]),
            }
        )
    return table


def _status_counts(records: Sequence[AttitudeRecord | ObservationRecord]) -> dict[str, int]:
    counts = Counter(record.status for record in records)
    return {status: counts.get(status, 0) for status in ("ok", "suspect", "failed")}


def _median(values: Sequence[float | int | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def _images_to_show(result: RunResult) -> list[AttitudeRecord]:
    """Readable images for overlays: failed ones first, then suspect ones, then others evenly over the campaign."""
    failed = set(result.failed_images)
    suspect = {record.file for record in result.attitudes if record.status == "suspect"}
    suspect |= {record.file for record in result.observations if record.status == "suspect"}
    readable = [record for record in result.attitudes if record.readable]
    first = [record for record in readable if record.file in failed][: result.max_overlays]
    second = [record for record in readable if record.file in suspect - failed][: result.max_overlays - len(first)]
    others = [record for record in readable if record.file not in failed | suspect]
    left = min(result.max_overlays - len(first) - len(second), len(others))
    spread = np.linspace(0, len(others) - 1, max(left, 0)).round().astype(int)
    return first + second + [others[k] for k in np.unique(spread)]
