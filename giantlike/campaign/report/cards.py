"""Cards of the report of a run: one image each, with its results in numbers, words and pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from giantlike.campaign.report.figures import points_of
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord, TargetRecord, TargetView
from giantlike.campaign.store.results import RunResult
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.core.attribute_docs import attribute_docs
from giantlike.core.errors import OpNavError
from giantlike.core.outcomes import Quality, Reason
from giantlike.image import Image
from giantlike.plotting import StarMarks, overlay_panels
from giantlike.plotting.charts import Axis, Chart, ChartSheet, charts_svg
from giantlike.plotting.layers import Layer, MarkShape
from giantlike.plotting.overlays import CENTERS, MARKS, BodyMarks, CenterMark
from giantlike.plotting.residual_map import residual_map_svg
from giantlike.plotting.style import BLUE, GRAY
from giantlike.plotting.svg_overlay import overlay_svg

_MAX_ARROWS = 150  # stars whose residuals a card shows, evenly chosen: more arrows than that cover each other
_ARROW_SHARE = 1 / 16  # length of the arrow of a typical residual / width of the field
_LEAST_SIGMA = 1e-9  # standard deviations below this one have as many digits as it has


@dataclass(frozen=True, slots=True, kw_only=True)
class FixLine:
    """One fix of a card or of the table of fixes, as text."""

    record: ObservationRecord
    center: tuple[str, ...]  # x and y with their sigma, px; empty without a fix
    offset: tuple[str, ...]  # observed minus computed x and y, px
    range_km: str  # range_km, range_offset: range with its sigma, km; observed minus computed, percent; or empty
    range_offset: str
    words: list[tuple[str, str]]  # status and sentence, for each reason, flag and remark


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageCard:
    """One image of the report, with its results."""

    record: AttitudeRecord
    words: list[tuple[str, str]]  # of the attitude
    fixes: list[FixLine]
    picture: str | None = None  # SVG; None if the image file is gone
    residuals: list[str]  # pictures of the residuals, SVG
    problem: str | None = None  # reason for a missing picture


def center_colors(result: RunResult) -> dict[str, str]:
    """Colors of the centers that estimators found."""
    names = dict.fromkeys(record.estimator for record in result.observations if record.center_px is not None)
    return {name: CENTERS[number % len(CENTERS)] for number, name in enumerate(names)}


def fix_line(record: ObservationRecord) -> FixLine:
    """One fix in text."""
    center: tuple[str, ...] = ()
    offset: tuple[str, ...] = ()
    range_km = range_offset = ""
    if record.center_px is not None and record.covariance_px2 is not None:
        sigma = [math.sqrt(max(record.covariance_px2[k][k], 0.0)) for k in range(2)]
        center = tuple(_with_sigma(record.center_px[k], sigma[k]) for k in range(2))
        if record.predicted_px is not None:
            offset = tuple(f"{record.center_px[k] - record.predicted_px[k]:+.{_digits(sigma[k])}f}" for k in range(2))
    if record.range_km is not None and record.sigma_range_km is not None:
        range_km = _with_sigma(record.range_km, record.sigma_range_km)
        if record.predicted_camera_km is not None:
            change = 100.0 * (record.range_km / math.hypot(*record.predicted_camera_km) - 1.0)
            range_offset = f"{change:+.{_digits(100.0 * record.sigma_range_km / record.range_km)}f}"
    return FixLine(
        record=record,
        center=center,
        offset=offset,
        range_km=range_km,
        range_offset=range_offset,
        words=list(_words(record)),
    )


def card(result: RunResult, record: AttitudeRecord, colors: Mapping[str, str]) -> ImageCard:
    """One image with its results."""
    folder = RunFolder(result.folder)
    observations = [one for image in result.bodies if image.file == record.file for one in image.observations]
    targets = dict.fromkeys(one.target for one in observations)
    with folder.reading():
        found = folder.points(record)
        points = {one.subject: folder.points(one) for one in observations}
        kept = [folder.load(TargetRecord, record.file, (target, "")) for target in targets]
    views = [one.view for one in kept if one is not None and one.view is not None]
    picture = problem = None
    try:
        pixels = Image.open(result.folder / record.path, hdu=result.hdu, bottom_up=result.bottom_up).pixels
    except OpNavError as error:
        problem = str(error)
    else:
        marks = [_body_marks(view, observations, points, colors) for view in views]
        panels = overlay_panels(pixels, record.file, stars=_star_marks(found), bodies=marks)
        picture = overlay_svg(panels, f"image-{record.index}")
    fixes = [fix_line(one) for one in observations]
    found_words = [fix.words for fix in fixes if fix.center]
    common = [each for each in found_words[0] if all(each in words for words in found_words)] if found_words else []
    return ImageCard(
        record=record,
        words=[*_words(record), *common],
        fixes=[replace(fix, words=[each for each in fix.words if each not in common]) for fix in fixes],
        picture=picture,
        residuals=[
            *_star_residuals(record, found),
            *(svg for one in observations for svg in _fix_residuals(record, one, points[one.subject])),
        ],
        problem=problem,
    )


def _words(record: AttitudeRecord | ObservationRecord) -> Iterator[tuple[str, str]]:
    """Status and sentence for a problem, for the acceptance, and for each flag."""
    problem = record.problem
    if record.accepted is not None:
        yield str(record.outcome), f"{record.accepted}"
    if problem is not None:
        meaning = attribute_docs(Reason)[Reason(problem.reason).name]
        yield str(problem.outcome), f"{_plain(problem.reason)}: {problem.detail.rstrip('.')}. {_sentence(meaning)}"
    for flag in record.flags:
        kind = "suspect" if Quality[flag.upper()].suspect else "soft"
        yield kind, f"{_plain(flag)}: {_sentence(attribute_docs(Quality)[flag.upper()])}"


def _sentence(text: str) -> str:
    return " ".join(text.replace("`", "").split())


def _plain(name: str) -> str:
    return str(name).replace("_", " ")


def _digits(sigma: float) -> int:
    """Decimals at which a standard deviation has two significant digits."""
    return min(max(1 - math.floor(math.log10(max(sigma, _LEAST_SIGMA))), 0), 9) if math.isfinite(sigma) else 3


def _with_sigma(value: float, sigma: float) -> str:
    digits = _digits(sigma)
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def _star_marks(points: Mapping[str, Any]) -> StarMarks | None:
    """Marks of the points of an attitude."""
    detected, stars = points_of(points.get("detected_px", [])), points.get("stars")
    if not len(detected):
        return None
    if stars is None:
        return StarMarks.of_detections(detected)
    return StarMarks(
        detected_px=detected,
        matched_px=points_of(stars["observed_px"]),
        predicted_px=points_of(stars["predicted_px"]),
        rejected_px=points_of(stars["rejected_px"]),
    )


def _body_marks(
    view: TargetView,
    observations: Sequence[ObservationRecord],
    points: Mapping[tuple[str, str], Mapping[str, Any]],
    colors: Mapping[str, str],
) -> BodyMarks:
    return BodyMarks(
        name=view.target,
        predicted_px=np.array(view.predicted_px),
        radius_px=view.radius_px,
        outline_px=points_of(view.outline_px),
        lit=np.array(view.outline_lit, dtype=bool),
        centers=[
            CenterMark(
                color=colors[record.estimator],
                center_px=np.array(record.center_px),
                covariance_px2=np.array(record.covariance_px2),
                limb_px=points_of(points[record.subject].get("limb_px", [])),
                limb_rejected_px=points_of(points[record.subject].get("limb_rejected_px", [])),
                outline_px=points_of(points[record.subject].get("outline_px", [])),
            )
            for record in observations
            if record.target == view.target and record.center_px is not None
        ],
    )


def _star_residuals(record: AttitudeRecord, points: Mapping[str, Any]) -> Iterator[str]:
    """Residuals of stars as arrows over the field."""
    stars = points.get("stars")
    if stars is None or not len(stars["observed_px"]):
        return
    observed = points_of(stars["observed_px"])
    off = observed - points_of(stars["predicted_px"])
    typical = max(float(np.median(np.linalg.norm(off, axis=1))), 1e-9)
    step = -(-len(observed) // _MAX_ARROWS)
    arrows = (off * (_ARROW_SHARE * record.columns / typical))[::step]
    ends = np.stack([observed[::step], observed[::step] + arrows], axis=1).reshape(-1, 2)
    chart = Chart(
        title=f"Stars off their places, median {typical:.2g} px",
        x=Axis(label="x, px", low=-0.5, high=record.columns - 0.5),
        y=Axis(label="y, px", low=record.rows - 0.5, high=-0.5),
        layers=[Layer(points=ends, shape=MarkShape.ARROWS, color=BLUE, width=0.8)],
        equal=True,
    )
    yield charts_svg(ChartSheet(charts=[chart], width_in=2.2, height_in=2.2), f"residuals-{record.index}")


def _fix_residuals(record: AttitudeRecord, one: ObservationRecord, points: Mapping[str, Any]) -> Iterator[str]:
    """Residuals of a fix: of limb points by angle, of a template as a map."""
    residuals, name = points.get("residuals"), f"{one.target}, {one.estimator}"
    if residuals is None or one.center_px is None:
        return
    at_px, values = points_of(residuals["at_px"]), np.asarray(residuals["values"], dtype=np.float64)
    if residuals["cell_px"]:
        yield residual_map_svg(
            at_px, 100.0 * values, residuals["cell_px"], f"{name}: image - template", unit="% of its peak"
        )
        return
    arms = at_px - np.array(one.center_px)
    angle = np.degrees(np.arctan2(arms[:, 1], arms[:, 0]))
    layers = [
        Layer(points=np.array([[-180.0, 0.0], [180.0, 0.0]]), shape=MarkShape.LINE, color=GRAY, width=0.9),
        Layer(points=np.column_stack([angle, values]), shape=MarkShape.DOT, color=BLUE, size=2.6),
    ]
    rejected = points_of(points.get("limb_rejected_px", []))
    if len(rejected):
        arms = rejected - np.array(one.center_px)
        ticks = np.column_stack([np.degrees(np.arctan2(arms[:, 1], arms[:, 0])), np.zeros(len(arms))])
        layers.append(
            Layer(points=ticks, shape=MarkShape.CROSS, color=MARKS["limb points rejected"], size=3.5, width=0.6)
        )
    chart = Chart(
        title=f"{name}: limb points, outward",
        x=Axis(label="angle from +x towards +y, deg", low=-180.0, high=180.0),
        y=Axis.around("px", np.append(values, 0.0)),
        layers=layers,
    )
    sheet = ChartSheet(charts=[chart], width_in=2.9, height_in=1.7)
    yield charts_svg(sheet, f"residuals-{record.index}-{one.target}-{one.estimator}")
