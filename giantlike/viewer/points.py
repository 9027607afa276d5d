"""Residuals of the points of a run: its stars, limb points and landmarks, the largest first."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from giantlike.campaign.store.edits import Edited, mask_of
from giantlike.core.arrays import Float
from giantlike.viewer.session import SeenImage, Session

MAX_POINTS = 2000  # points of a run that the page gets, the largest in sigmas


def largest_residuals(session: Session) -> dict[str, Any]:
    """Rows of the points with the largest residuals in sigmas, and the number of all points."""
    rows, count = list[dict[str, Any]](), 0
    for index, file in enumerate(session.files):
        found = [row | {"index": index, "file": file} for row in point_rows(session.seen(file))]
        count += len(found)
        rows = sorted(rows + found, key=lambda row: -row["sigmas"])[:MAX_POINTS]
    return {"points": rows, "count": count}


def point_rows(seen: SeenImage) -> Iterator[dict[str, Any]]:
    """Yield the points of an image.

    ``residual``: px from the solution, of limb points from the outline; ``sigma``: of limb points the RMS of their fix.
    """
    stars = seen.points.get(seen.record.subject, {}).get("stars")
    if stars is not None and seen.image_edit is None:
        observed, off = _offsets(stars["observed_px"], stars["predicted_px"])
        for k, number in enumerate(np.asarray(stars["star_ids"]).tolist()):
            row = _row("star", str(number), observed[k], off[k], float(stars["sigma_px"][k]))
            yield row | {"star": str(number), "rejected": number in seen.star_edits}
    for fix in seen.observations:
        points = seen.points.get(fix.subject, {})
        named = {"target": fix.target, "estimator": fix.estimator}
        marks, residuals = points.get("landmarks"), points.get("residuals")
        if marks is not None:
            gone = {edit.landmark for edit in seen.edits if (edit.target, edit.estimator) == fix.subject}
            observed, off = _offsets(marks["observed_px"], marks["predicted_px"])
            covariance = np.asarray(marks["covariance_px2"], dtype=float).reshape(-1, 2, 2)
            for k, name in enumerate(np.asarray(marks["names"]).tolist()):
                sigma = float(np.sqrt(np.trace(covariance[k]) / 2))
                yield _row("landmark", name, observed[k], off[k], sigma) | named | {"rejected": name in gone}
        elif residuals is not None and not residuals["cell_px"] and len(residuals["values"]):
            places = np.asarray(residuals["at_px"], dtype=float).reshape(-1, 2)
            values = np.asarray(residuals["values"], dtype=float)
            areas = [edit.area for edit in seen.edits if edit.what is Edited.MASK
                     and (edit.target, edit.estimator) in ((None, None), fix.subject)]  # fmt: skip
            masked = mask_of(areas, (seen.record.rows, seen.record.columns))
            rms = float(np.sqrt(np.mean(values**2)))
            for k, (x, y) in enumerate(np.rint(places).astype(int).tolist()):
                inside = 0 <= x < masked.shape[1] and 0 <= y < masked.shape[0]
                row = _row("limb", f"{k + 1} of {len(values)}", places[k], abs(float(values[k])), rms)
                yield row | named | {"rejected": bool(inside and masked[y, x])}


def _row(kind: str, name: str, place: Float, residual: float, sigma: float) -> dict[str, Any]:
    x, y = place.tolist()
    sigmas = residual / sigma if sigma > 0 else 0.0
    return {
        "kind": kind,
        "name": name,
        "x": x,
        "y": y,
        "residual": float(residual),
        "sigma": sigma,
        "sigmas": float(sigmas),
    }


def _offsets(observed: ArrayLike, predicted: ArrayLike) -> tuple[Float, Float]:
    """Observed positions (n, 2), px, and their distances (n,) from the predicted ones."""
    places = np.asarray(observed, dtype=float).reshape(-1, 2)
    return places, np.linalg.norm(places - np.asarray(predicted, dtype=float).reshape(-1, 2), axis=1)
