"""``report.html``: page of a finished run, in one self-contained file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from giantlike._system.atomic import write_text_atomic
from giantlike.campaign.report.templates import render_page
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord
from giantlike.campaign.store.results import RunResult, StatusCounts, group_by
from giantlike.campaign.store.run_folder import REPORT_PAGE
from giantlike.core.outcomes import Outcome, Quality, Reason
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.core.version import VERSION

_MAX_FAILURES = 300  # failures listed one by one; all are counted by reason, and the tables hold the rest
_MAX_FIXES = 4000  # most lines of the table of fixes, 300 bytes each; other good fixes are only in the tables
_FOUND = "a fix in an image that images.expect says to be empty"
_RANK = {"failed": 0, "suspect": 1, "accepted": 1, "ok": 2, "rejected": 3, "not_applicable": 3, "not_in_field": 3}


def write_report(result: RunResult) -> Path:
    """Write ``report.html`` into the run folder.

    Returns
    -------
    Path
        Of the page.

    Raises
    ------
    DataError
        The file cannot be written.
    """
    # Imported when a page is made: workers, which draw nothing, start in half the time without matplotlib.
    from giantlike.campaign.report.cards import card, center_colors, fix_line
    from giantlike.campaign.report.figures import attitude_figures, body_figures
    from giantlike.plotting.overlays import MARKS

    failures = _failures(result)
    shown, colors = _images_to_show(result), center_colors(result)
    bodies = sorted(result.observations, key=lambda one: _RANK[one.outcome])[:_MAX_FIXES]
    page = render_page(
        "report.html.j2",
        name=result.name,
        version=VERSION,
        n_images=len(result.attitudes),
        failed_images=result.failed_images,
        attitudes=_attitude_summary(result.attitudes),
        observations=[
            _estimator_summary(target, estimator, records)
            for (target, estimator), records in result.by_estimator.items()
        ],
        reasons=Counter((failure["stage"], failure["reason"]) for failure in failures).most_common(),
        untried=_no_failures(result).most_common(),
        failures=failures[:_MAX_FAILURES],
        n_failures=len(failures),
        warnings=[*result.warnings, *_notes(result)],
        attitude_figures=attitude_figures(result),
        body_figures=body_figures(result),
        fixes=[fix_line(record) for record in sorted(bodies, key=lambda one: one.index)],
        n_fixes=len(result.observations),
        cards=[card(result, record, colors) for record in shown],
        shown={record.file for record in shown},
        marks=MARKS,
        centers=colors,
        n_readable=sum(record.readable for record in result.attitudes),
        time_s=result.time_s,
        calibration=result.calibration,
        network=result.network,
    )
    path = result.folder / REPORT_PAGE
    write_text_atomic(path, page)
    return path


def _failures(result: RunResult) -> list[dict[str, str]]:
    """Failures, and good fixes of bodies in images that are expected to hold nothing."""
    failed = [
        {"file": record.file, "stage": stage, "reason": str(record.problem.reason), "detail": record.problem.detail}
        for stage, record in _steps(result)
        if record.problem is not None and record.outcome is Outcome.FAILED and not _is_expected(result, record)
    ]
    return failed + [
        {"file": record.file, "stage": f"{record.target}: {record.estimator}", "reason": "unexpected", "detail": _FOUND}
        for record in result.observations
        if record.file in result.empty_images and record.outcome is Outcome.OK
    ]


def _no_failures(result: RunResult) -> Counter[tuple[str, str, str]]:
    """Number of results by step, outcome and reason that are neither fixes nor failures."""
    return Counter(
        (stage, "nothing found, as expected" if _is_expected(result, record) else record.outcome.words, str(reason))
        for stage, record in _steps(result)
        if record.problem is not None and (reason := record.problem.reason)
        if not record.outcome.is_attempt or _is_expected(result, record)
    )


def _is_expected(result: RunResult, record: AttitudeRecord | ObservationRecord) -> bool:
    """Whether a step failed on an image that is expected to hold nothing, other than by an internal error."""
    return (
        record.outcome is Outcome.FAILED
        and record.file in result.empty_images
        and record.problem is not None
        and record.problem.reason not in {Reason.INTERNAL_ERROR, Reason.UNREADABLE_IMAGE}
    )


def _steps(result: RunResult) -> list[tuple[str, AttitudeRecord | ObservationRecord]]:
    """Results of all steps, with their names; of unreadable images the attitude alone."""
    unreadable = {record.file for record in result.attitudes if not record.readable}
    steps: list[tuple[str, AttitudeRecord | ObservationRecord]] = [("attitude", one) for one in result.attitudes]
    return steps + [
        (f"{one.target}: {one.estimator}", one) for one in result.observations if one.file not in unreadable
    ]


def _notes(result: RunResult) -> list[str]:
    moving = sum(str(Quality.OBSERVER_UNKNOWN.name).lower() in record.flags for record in result.attitudes)
    notes = [
        f"{moving} attitude{'s' * (moving > 1)} from stars without the spacecraft's velocity: stellar aberration, some "
        "20 arcsec at 1 au, is still in (give observer columns in the geometry table, header keywords or [spice])"
    ] * (moving > 0)
    notes += [f"{record.file}: {note}" for record in result.attitudes for note in record.notes]
    return notes + [f"{image.file}: {note}" for image in result.bodies for note in image.notes]


def _attitude_summary(records: Sequence[AttitudeRecord]) -> list[dict[str, Any]]:
    """Counts of the attitudes wanted from each source, and medians of the good ones."""
    table = []
    for source, members in group_by(records, lambda record: record.wanted_source or "unreadable image").items():
        attitudes = [record.attitude for record in members if record.attitude is not None]
        sigmas = [ARCSEC_PER_RAD * each.sigma_rad for each in attitudes if each.covariance_rad2 is not None]
        table.append(
            {
                "source": source,
                "counts": StatusCounts.from_records(members),
                "n_matched": _median([record.n_matched for record in members]),
                "rms_px": _median([record.rms_px for record in members]),
                "sigma_across_arcsec": _median([float(max(sigma[0], sigma[1])) for sigma in sigmas]),
                "sigma_roll_arcsec": _median([float(sigma[2]) for sigma in sigmas]),
            }
        )
    return table


def _estimator_summary(target: str, estimator: str, records: Sequence[ObservationRecord]) -> dict[str, Any]:
    """Counts of the observations of one estimator of one target, and medians of the good ones."""
    offsets, sigmas, range_errors, range_sigmas = [], [], [], []
    for record in records:
        if record.center_px is None or record.predicted_px is None or record.covariance_px2 is None:
            continue
        offsets.append(float(np.hypot(*np.subtract(record.center_px, record.predicted_px))))
        sigmas.append(float(np.sqrt(np.trace(record.covariance_px2) / 2)))
        if record.range_km is not None and record.sigma_range_km is not None and record.predicted_camera_km:
            range_errors.append(abs(record.range_km / float(np.linalg.norm(record.predicted_camera_km)) - 1) * 100)
            range_sigmas.append(record.sigma_range_km / record.range_km * 100)
    return {
        "target": target,
        "estimator": estimator,
        "counts": StatusCounts.from_records(records),
        "offset_px": _median(offsets),
        "sigma_px": _median(sigmas),
        "range_offset_percent": _median(range_errors),
        "sigma_range_percent": _median(range_sigmas),
        "time_s": _median([record.time_s for record in records if record.status != "failed"]),
    }


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
