"""Layers over an image: marks of one meaning, with labels and the numbers by which they are edited."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from giantlike.campaign.store.edits import Edit, Edited
from giantlike.campaign.store.records import ObservationRecord
from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.plotting.layers import Layer, MarkShape
from giantlike.plotting.overlays import CENTERS, MARKS, three_sigma_ellipse
from giantlike.viewer.session import SeenImage

_LONGEST_NUMBER = 9  # maximum digits of a catalog number next to a mark: enough for Hipparcos, Tycho-2 and UCAC4
TERMINATOR = "#ff7ad9"
"""Color of the line where the Sun is at the horizon of the surface."""
START = "#ffd84d"
"""Color of the outline from which a user lets estimators start."""
REJECTED = "#aab4be"
"""Color of everything that a user rejected."""
LANDMARK, LANDMARK_REJECTED = "#22d3ff", MARKS["limb points rejected"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MarkLayer(Value):
    """Marks of one meaning."""

    name: str  # one of ``LAYERS``
    title: str  # content, with target and estimator
    layer: Layer  # points, shape and color
    labels: Sequence[str] = ()  # description of each point; empty where there is none
    names: Sequence[str] = ()  # next to each point, or empty. The most important points come first
    star_ids: Sequence[int] = field(default=())  # number of each point in the catalog; empty where points are not stars
    rejected: bool = False  # True for what a user rejected
    subject: tuple[str, str] = ("", "")  # target and estimator of limb points
    sigmas: Sequence[float] = ()  # of each residual, of limb points in the RMS of all; empty without


def layers_of(seen: SeenImage, names: Sequence[str] | None = None) -> list[MarkLayer]:
    """Layers of an image, all or those named, that have something to show."""
    made = [layer for name in (LAYERS if names is None else names) for layer in _layers_named(seen, name)]
    return [each for each in made if len(each.layer.points)]


def _layers_named(seen: SeenImage, name: str) -> list[MarkLayer]:
    """Layers of one name; those of what was rejected are gray."""
    made = _MAKERS[name](seen)
    if name in _OF_STARS and seen.image_edit is not None:
        made = [_as_rejected(each, seen.image_edit) for each in made]
    if name in _OF_FIXES:
        for fix in seen.rejected_fixes:
            edit = seen.edit_of(fix)
            alone = _MAKERS[name](replace(seen, observations=(fix,)))
            made += [each if edit is None else _as_rejected(each, edit) for each in alone]
    return made


def _as_rejected(layer: MarkLayer, edit: Edit) -> MarkLayer:
    """The layer as that of something rejected."""
    why = f"rejected by {edit.who}: {edit.why}"
    return replace(
        layer,
        title=f"{layer.title}, {why}",
        layer=replace(layer.layer, color=REJECTED),
        labels=[f"{label}, {why}" for label in layer.labels],
        rejected=True,
    )


def center_colors(seen: SeenImage) -> dict[str, str]:
    """Color of each estimator of an image, by name."""
    names = dict.fromkeys(one.estimator for one in seen.observations)
    return {name: CENTERS[number % len(CENTERS)] for number, name in enumerate(names)}


def _detections(seen: SeenImage) -> list[MarkLayer]:
    layer = Layer(
        points=_points(_stars_of(seen).get("detected_px", [])),
        shape=MarkShape.RING, color=MARKS["detected, not used"], size=5.0, width=0.8,
    )  # fmt: skip
    return [MarkLayer(name="detections", title="detections", layer=layer)]


def _catalog(seen: SeenImage) -> list[MarkLayer]:
    stars = _stars_of(seen).get("stars")
    if stars is None:
        return []
    order = np.argsort(stars["magnitudes"], kind="stable")
    names = np.array(_names_of(stars))[order].tolist()
    ids, magnitudes = (np.asarray(stars[name])[order].tolist() for name in ("star_ids", "magnitudes"))
    layer = Layer(
        points=_points(stars["predicted_px"])[order],
        shape=MarkShape.PLUS, color=MARKS["where the solution puts catalog stars"], size=6.0, width=0.8,
    )  # fmt: skip
    known = list(zip(names, ids, magnitudes, strict=True))
    return [
        MarkLayer(
            name="catalog",
            title="catalog stars",
            layer=layer,
            labels=[f"{_star_label(name, number)} ({magnitude:.1f})" for name, number, magnitude in known],
            names=[f"{name or _short(number)} ({magnitude:.1f})".lstrip() for name, number, magnitude in known],
            star_ids=ids,
        )
    ]


def _matches(seen: SeenImage) -> list[MarkLayer]:
    stars = _stars_of(seen).get("stars")
    if stars is None:
        return []
    layer = Layer(
        points=_points(stars["observed_px"]), shape=MarkShape.RING, color=MARKS["matched star"], size=8.0, width=0.9
    )
    residuals = np.linalg.norm(_points(stars["observed_px"]) - _points(stars["predicted_px"]), axis=1)
    rows = zip(_names_of(stars), _list(stars["star_ids"]), residuals.tolist(), _list(stars["sigma_px"]), strict=True)
    labels = [f"{_star_label(name, number)}: {off:.3f} px off, sigma {sigma:.3f}" for name, number, off, sigma in rows]
    numbers = _list(stars["star_ids"])
    kept = [place for place, number in enumerate(numbers) if number not in seen.star_edits]
    return [
        MarkLayer(
            name="matches",
            title="matched stars",
            layer=replace(layer, points=layer.points[kept]),
            labels=[labels[place] for place in kept],
            star_ids=[numbers[place] for place in kept],
            sigmas=[(residuals / np.asarray(stars["sigma_px"], dtype=float)).tolist()[place] for place in kept],
        )
    ]


def _rejected_stars(seen: SeenImage) -> list[MarkLayer]:
    """Stars that a user rejected, where they were observed."""
    stars = _stars_of(seen).get("stars")
    places = {} if stars is None else dict(zip(_list(stars["star_ids"]), _list(stars["observed_px"]), strict=True))
    there = [(edit, places.get(number, edit.at_px)) for number, edit in seen.star_edits.items()]
    known = [(edit, place) for edit, place in there if place is not None]
    return [
        MarkLayer(
            name="rejected-stars",
            title="stars rejected by a user",
            layer=Layer(
                points=_points([place for _, place in known]),
                shape=MarkShape.CROSS,
                color=REJECTED,
                size=9.0,
                width=1.4,
            ),
            labels=[f"star {edit.star}, rejected by {edit.who}: {edit.why}" for edit, _ in known],
            star_ids=[edit.star for edit, _ in known if edit.star is not None],
            rejected=True,
        )
    ]


def _rejected_matches(seen: SeenImage) -> list[MarkLayer]:
    stars = _stars_of(seen).get("stars")
    points = [] if stars is None else stars["rejected_px"]
    layer = Layer(points=_points(points), shape=MarkShape.CROSS, color=MARKS["match thrown out"], size=7.0, width=1.1)
    return [MarkLayer(name="rejected", title="rejected matches", layer=layer)]


def _predicted_outlines(seen: SeenImage) -> list[MarkLayer]:
    made = []
    color = MARKS["a priori outline and center"]
    for target in seen.targets:
        view = target.view
        if view is None:
            continue
        outline = _points(view.outline_px)
        shape = MarkShape.DASHES
        if not len(outline):
            outline, shape = np.array([view.predicted_px]), MarkShape.PLUS
        layer = Layer(points=_close_outline(outline), shape=shape, color=color, size=9.0, width=0.9)
        made.append(MarkLayer(name="predicted", title=f"{target.target}: predicted outline", layer=layer))
    return made


def _starts(seen: SeenImage) -> list[MarkLayer]:
    """The predicted outline moved to where a user lets estimators start."""
    made, views = [], {target.target: target.view for target in seen.targets if target.view is not None}
    for edit in seen.edits:
        if edit.what is Edited.START and edit.at_px is not None:
            view, center = views.get(edit.target or ""), np.array(edit.at_px)
            outline = np.zeros((0, 2)) if view is None else _points(view.outline_px) + center - view.predicted_px
            shape = MarkShape.DASHES if len(outline) else MarkShape.PLUS
            points = _close_outline(outline) if len(outline) else center[None]
            layer = Layer(points=points, shape=shape, color=START, size=9.0, width=1.2)
            made.append(MarkLayer(name="start", title=f"{edit.target}: start by {edit.who}: {edit.why}", layer=layer))
    return made


def _masks(seen: SeenImage) -> list[MarkLayer]:
    """Areas that users masked."""
    return [
        MarkLayer(
            name="mask",
            title=f"{edit.name}, masked by {edit.who}: {edit.why}",
            layer=Layer(points=_close_outline(np.array(edit.area)), shape=MarkShape.LINE, color=REJECTED, width=1.0),
        )
        for edit in seen.edits
        if edit.what is Edited.MASK
    ]


def _fitted_outlines(seen: SeenImage) -> list[MarkLayer]:
    """The outline at each fix: the outline of a template, else the predicted one moved and scaled."""
    made, colors = [], center_colors(seen)
    views = {target.target: target.view for target in seen.targets if target.view is not None}
    for fix in _fixes(seen):
        view = views.get(fix.target)
        outline = _points(seen.points.get(fix.subject, {}).get("outline_px", []))
        if len(outline):
            points = outline
        elif view is not None and view.outline_px:
            scale = 1.0
            if fix.range_km is not None and fix.predicted_camera_km is not None:
                scale = float(np.linalg.norm(fix.predicted_camera_km)) / fix.range_km
            moved = np.array(fix.center_px) + scale * (_points(view.outline_px) - np.array(view.predicted_px))
            points = _close_outline(moved)
        else:
            continue
        layer = Layer(points=points, shape=MarkShape.LINE, color=colors[fix.estimator], width=0.9)
        made.append(MarkLayer(name="fitted", title=f"{fix.target}: outline by {fix.estimator}", layer=layer))
    return made


def _centers(seen: SeenImage) -> list[MarkLayer]:
    made, colors = [], center_colors(seen)
    for fix in _fixes(seen):
        center, color = np.array(fix.center_px), colors[fix.estimator]
        title = f"{fix.target}: {fix.estimator} ({fix.status})"
        cross = Layer(points=center[None], shape=MarkShape.CROSS, color=color, size=9.0, width=1.6)
        made.append(MarkLayer(name="centers", title=title, layer=cross, labels=[title]))
        if fix.covariance_px2 is not None and np.isfinite(fix.covariance_px2).all():
            ellipse = three_sigma_ellipse(center, np.array(fix.covariance_px2))
            line = Layer(points=ellipse, shape=MarkShape.LINE, color=color, width=1.0)
            made.append(MarkLayer(name="centers", title=f"{title}, 3 sigma", layer=line))
    return made


def _limb_points(seen: SeenImage, *, name: str, kept_as: str, meaning: str) -> list[MarkLayer]:
    return [
        MarkLayer(
            name=name,
            title=f"{fix.target}: {meaning} by {fix.estimator}",
            subject=fix.subject,
            sigmas=_limb_sigmas(seen, fix) if kept_as == "limb_px" else (),
            layer=Layer(
                points=_points(seen.points.get(fix.subject, {}).get(kept_as, [])),
                shape=MarkShape.DOT,
                color=MARKS[meaning],
                size=2.6,
                width=1.0,
            ),
        )
        for fix in _fixes(seen)
    ]


def _limb_sigmas(seen: SeenImage, fix: ObservationRecord) -> list[float]:
    residuals = seen.points.get(fix.subject, {}).get("residuals")
    if residuals is None or residuals["cell_px"]:
        return []
    values = np.asarray(residuals["values"], dtype=float)
    sigmas: list[float] = (np.abs(values) / max(float(np.sqrt(np.mean(values**2))), 1e-12)).tolist()
    return sigmas


def _terminator(seen: SeenImage) -> list[MarkLayer]:
    return [
        MarkLayer(
            name="terminator",
            title=f"{target}: terminator",
            layer=Layer(points=line, shape=MarkShape.LINE, color=TERMINATOR, width=0.9),
        )
        for target, lines in seen.terminators.items()
        for line in lines
    ]


def _landmarks(seen: SeenImage) -> list[MarkLayer]:
    made = []
    for fix, marks in _landmarks_of(seen):
        observed, names = _points(marks["observed_px"]), _list(marks["names"])
        off_px = np.linalg.norm(observed - _points(marks["predicted_px"]), axis=1).tolist()
        made.append(
            MarkLayer(
                name="landmarks",
                title=f"{fix.target}: landmarks of {fix.estimator}",
                layer=Layer(points=observed, shape=MarkShape.RING, color=LANDMARK, size=7.0, width=1.0),
                labels=[
                    f"{name}: {off:.3f} px off its place by the fix" for name, off in zip(names, off_px, strict=True)
                ],
                names=names,
                sigmas=(off_px / np.sqrt(np.trace(_covariances(marks), axis1=1, axis2=2) / 2)).tolist(),
            )
        )
    return made


def _covariances(marks: Mapping[str, Any]) -> Float:
    return np.asarray(marks["covariance_px2"], dtype=float).reshape(-1, 2, 2)


def _landmarks_rejected(seen: SeenImage) -> list[MarkLayer]:
    made = []
    for fix, marks in _landmarks_of(seen):
        names, because, points = (marks.get(f"rejected_{what}", []) for what in ("names", "because", "px"))
        made.append(
            MarkLayer(
                name="landmarks-rejected",
                title=f"{fix.target}: landmarks not used by {fix.estimator}, where its fix puts them",
                layer=Layer(
                    points=_points(points), shape=MarkShape.CROSS, color=LANDMARK_REJECTED, size=6.0, width=1.0
                ),
                labels=[f"{name}: {why}" for name, why in zip(_list(names), _list(because), strict=True)],
                names=_list(names),
            )
        )
    return made


def _landmarks_of(seen: SeenImage) -> list[tuple[ObservationRecord, Mapping[str, Any]]]:
    """Fixes that were made of landmarks, and those."""
    found = [(fix, seen.points.get(fix.subject, {}).get("landmarks")) for fix in _fixes(seen)]
    return [(fix, marks) for fix, marks in found if marks is not None]


_MAKERS: Mapping[str, Callable[[SeenImage], list[MarkLayer]]] = MappingProxyType(
    {
        "detections": _detections,
        "catalog": _catalog,
        "matches": _matches,
        "rejected": _rejected_matches,
        "rejected-stars": _rejected_stars,
        "predicted": _predicted_outlines,
        "start": _starts,
        "mask": _masks,
        "fitted": _fitted_outlines,
        "centers": _centers,
        "limb": partial(_limb_points, name="limb", kept_as="limb_px", meaning="limb points used"),
        "limb-rejected": partial(
            _limb_points, name="limb-rejected", kept_as="limb_rejected_px", meaning="limb points rejected"
        ),
        "terminator": _terminator,
        "landmarks": _landmarks,
        "landmarks-rejected": _landmarks_rejected,
    }
)
_OF_STARS = ("detections", "catalog", "matches", "rejected")
_OF_FIXES = ("fitted", "centers", "limb", "limb-rejected", "landmarks", "landmarks-rejected")
LAYERS: tuple[str, ...] = tuple(_MAKERS)  # names of the layers, in the order in which they are drawn


def _fixes(seen: SeenImage) -> list[ObservationRecord]:
    return [one for one in seen.observations if one.center_px is not None]


def _stars_of(seen: SeenImage) -> Mapping[str, Any]:
    return seen.points.get(seen.record.subject, {})


def _names_of(stars: Mapping[str, Any]) -> list[str]:
    """Proper names of the stars of a solution; runs of before there were names have none."""
    return _list(stars.get("star_names", ())) or [""] * len(stars["star_ids"])


def _short(number: int) -> str:
    """Catalog number to write next to a star; empty for long ones (Gaia), which would cover its neighbors."""
    return str(number) if len(str(number)) <= _LONGEST_NUMBER else ""


def _star_label(name: str, number: int) -> str:
    return f"{name}, {number}" if name else str(number)


def _points(values: ArrayLike) -> Float:
    return np.asarray(values, dtype=np.float64).reshape(-1, 2)


def _list(values: Any) -> list[Any]:
    """Values of a list or an array as plain ones."""
    plain: list[Any] = np.asarray(values).tolist()
    return plain


def _close_outline(points: Float) -> Float:
    """Points of an outline, and the first of them once more."""
    return np.concatenate([points, points[:1]])
