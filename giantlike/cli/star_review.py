"""``--review``: pictures of the detections in an image of stars, and their use."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from giantlike.core.errors import DataError
from giantlike.core.outcomes import AttitudeFix, Failure
from giantlike.image import Image
from giantlike.processing import Detections


def write_review(
    folder: Path, path: Path, image: Image, detections: Detections, outcome: AttitudeFix | Failure
) -> tuple[Path, ...]:
    """Write ``NAME.stars.png`` (detections, matches, rejects on the image), ``NAME.residuals.png`` where solved."""
    from giantlike.plotting import (
        StarMarks,
        charts_figure,
        overlay_figure,
        overlay_panels,
        star_residual_charts,
    )

    solved = outcome if isinstance(outcome, AttitudeFix) else None
    marks, said = StarMarks.of_detections(detections.points_px), "not solved"
    if solved is not None:
        said = f"{solved.n_used} matched, {solved.n_rejected} thrown out"
        marks = replace(
            marks, matched_px=solved.observed_px, predicted_px=solved.predicted_px, rejected_px=solved.rejected_px
        )
    panels = overlay_panels(image.pixels, f"{len(detections)} detected, {said}", stars=marks)
    figures = {"stars": overlay_figure(panels)}
    if solved is not None:
        charts = star_residual_charts(
            solved.observed_px, solved.residuals_px, solved.magnitudes, solved.sigma_px, image.columns, image.rows
        )
        figures["residuals"] = charts_figure(charts)
    files = tuple(folder / f"{path.name}.{name}.png" for name in figures)
    try:
        for file, figure in zip(files, figures.values(), strict=True):
            figure.savefig(file, dpi=130)
    except OSError as error:
        raise DataError(folder, f"cannot write the pictures: {error.strerror or error}") from error
    return files
