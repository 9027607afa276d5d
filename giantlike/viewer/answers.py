"""Answers to the page of the viewer: a run, an image, pictures, charts, edits, as plain values and bytes."""

from __future__ import annotations

import getpass
import math
import threading
from collections.abc import Callable, Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.store.edits import add_edits, new_edit, read_edits
from giantlike.campaign.store.fix_differences import difference_of
from giantlike.campaign.store.records import ObservationRecord
from giantlike.campaign.store.results import group_by
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.core.arrays import Float, require
from giantlike.core.errors import InputError, OpNavError
from giantlike.core.frames import radec_from_direction, rotate
from giantlike.plotting.overlays import stretch_image
from giantlike.plotting.style import dark_svg
from giantlike.ray_tracing import Backplanes
from giantlike.viewer.charts import correlation_chart, limb_chart, profile_chart, residual_chart, star_chart
from giantlike.viewer.comparison import match_of
from giantlike.viewer.explain import explain
from giantlike.viewer.layers import MarkLayer, layers_of
from giantlike.viewer.planes import backplanes_of, values_at, with_terminators
from giantlike.viewer.points import largest_residuals
from giantlike.viewer.session import SeenImage, Session, review_of, verdict_of

COLOR_MAPS: Mapping[str, int | None] = {
    "gray": None,
    "inverted": None,
    "viridis": cv2.COLORMAP_VIRIDIS,
    "inferno": cv2.COLORMAP_INFERNO,
    "turbo": cv2.COLORMAP_TURBO,
}
STRETCHES = ("auto", "linear", "sqrt", "log")
_THUMBNAIL_PX = 96
_LONGEST_PX = 2048  # pictures of longer images are reduced to this, px: as much as a screen shows
_KEPT_IMAGES = 4  # number of images whose backplanes and templates are cached, for a user who switches between them
_DIFFERENCE_PERCENT = 99.5
"""Percentile of the differences at which their gray scale ends: the noise of a bright body stays gray."""


class Answers:
    """Answers to the requests of the page; from several threads, one at a time."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._lock = threading.RLock()
        self._planes: dict[int, Backplanes] = {}
        self._solving: dict[str, Any] = {"state": "idle"}

    def run(self) -> dict[str, Any]:
        """The run: its images with verdicts, and all fixes."""
        with self._lock:
            result = self._session.result
            statuses = group_by(result.observations, lambda one: one.file)
            edits, images = group_by(read_edits(result.folder).standing, lambda edit: edit.file), []
            for number, record in enumerate(result.attitudes):
                verdict = verdict_of(record, statuses.get(record.file, ()))
                review = review_of(verdict, edits.get(record.file, ()))
                image = {"index": number, "file": record.file, "epoch": record.epoch_utc, "attitude": record.outcome}
                images.append(image | {"verdict": verdict, "review": review})
            places = {record.file: number for number, record in enumerate(result.attitudes)}
            return {
                "name": result.name,
                "folder": str(result.folder),
                "images": images,
                "fixes": [_fix_row(one, places[one.file]) for one in result.observations],
                "color_maps": list(COLOR_MAPS),
                "stretches": list(STRETCHES),
                "who": getpass.getuser(),
            }

    def places(self) -> dict[str, Any]:
        """The name of the run, and the numbers of its images by file."""
        with self._lock:
            result = self._session.result
            return {"name": result.name, "images": {one.file: number for number, one in enumerate(result.attitudes)}}

    def image(self, index: int) -> dict[str, Any]:
        """One image: layers, words, fixes and edits."""
        with self._lock:
            file = self._file(index)
            seen = self._session.seen(file)
            return {
                "index": index,
                "file": file,
                "columns": seen.record.columns,
                "rows": seen.record.rows,
                "verdict": verdict_of(seen.record, seen.observations),
                "layers": [_layer(each) for each in layers_of(seen)],
                "words": explain(seen),
                "fixes": [_fix_row(one, index) for one in seen.observations],
                "targets": list(dict.fromkeys(one.target for one in seen.observations)),
                "outlines": [
                    {"target": each.target, "center": each.view.predicted_px, "outline": each.view.outline_px}
                    for each in seen.targets
                    if each.view is not None
                ],
                "edits": [edit.model_dump(mode="json", exclude_none=True) | {"name": edit.name} for edit in seen.edits],
                "charts": _charts(seen),
            }

    def terminator(self, index: int) -> list[dict[str, Any]]:
        """Layers of the terminators of an image; they are traced on request."""
        with self._lock:
            file = self._file(index)
            planes = self._backplanes(index, file)
            seen = with_terminators(self._session, self._session.seen(file), planes)
            return [_layer(each) for each in layers_of(seen, ["terminator"])]

    def compare(self) -> list[dict[str, Any]]:
        """Fixes of each body in each image minus that with the smallest error ellipse."""
        with self._lock:
            rows = []
            places = {file: number for number, file in enumerate(self._session.files)}
            for image in self._session.result.bodies:
                located = (one for one in image.observations if one.center_px and one.covariance_px2)
                for fixes in group_by(located, lambda one: one.target).values():
                    best = min(fixes, key=lambda one: float(np.trace(np.array(one.covariance_px2))))
                    rows += [_difference(one, best, places[image.file]) for one in fixes if one is not best]
            return rows

    def points(self) -> dict[str, Any]:
        """The points of all images with the largest residuals."""
        with self._lock:
            return largest_residuals(self._session)

    def picture(
        self,
        index: int,
        kind: str = "image",
        stretch: str = "auto",
        colors: str = "gray",
        target: str = "",
        estimator: str = "",
    ) -> bytes:
        """The image, the template at a fix, or their difference, as PNG."""
        require(stretch in STRETCHES, f"there is no stretch {stretch!r}; there are {', '.join(STRETCHES)}")
        require(colors in COLOR_MAPS, f"there is no color map {colors!r}; there are {', '.join(COLOR_MAPS)}")
        with self._lock:
            file = self._file(index)
            if kind == "image":
                values: NDArray[Any] = self._session.pixels(file).pixels
            else:
                match = match_of(self._session, file, target, estimator or None)
                values = match.model_dn if kind == "template" else match.difference_dn
        if kind == "difference":
            full = float(np.percentile(np.abs(values[values != 0]), _DIFFERENCE_PERCENT)) if np.any(values) else 1.0
            gray = np.clip(127.5 + 127.5 * values / max(full, 1e-9), 0, 255).astype(np.uint8)
        else:
            gray = _stretch_values(values, stretch)
        return _encode(_apply_colors(gray, colors), ".png")

    def thumbnail(self, index: int) -> bytes:
        """The image, small, as JPEG."""
        with self._lock:
            pixels = self._session.pixels(self._file(index)).pixels
        return _encode(stretch_image(pixels, longest_px=_THUMBNAIL_PX), ".jpg")

    def chart(
        self, index: int, which: str, target: str = "", estimator: str = "", theme: str = "light", line: str = ""
    ) -> bytes:
        """Residuals of stars, along the limb or of a template, the correlation surface, or values on a line, as SVG."""
        charts: Mapping[str, Callable[[str], str]] = {
            "stars": lambda file: star_chart(self._session, file),
            "limb": lambda file: limb_chart(self._session, file, target),
            "map": lambda file: residual_chart(self._session, file, target, estimator),
            "profile": lambda file: profile_chart(
                self._session, file, [_number("line", each) for each in line.split(",")]
            ),
            "correlation": lambda file: correlation_chart(self._session, file, target, estimator or None),
        }
        require(which in charts, f"there is no chart {which!r}; there are {', '.join(charts)}")
        require(theme in ("light", "dark"), f"there is no theme {theme!r}; there are light and dark")
        with self._lock:
            text = charts[which](self._file(index))
        return (dark_svg(text) if theme == "dark" else text).encode()

    def pixel(self, index: int, x: str, y: str) -> dict[str, Any]:
        """Value of a pixel, its direction in the sky, and the backplanes of a body there."""
        with self._lock:
            file = self._file(index)
            pixels = self._session.pixels(file).pixels
            column, row = round(_number("x", x)), round(_number("y", y))
            if not (0 <= column < pixels.shape[1] and 0 <= row < pixels.shape[0]):
                return {}
            values = {"dn": float(pixels[row, column])} | self._sky(file, np.array([float(x), float(y)]))
            try:
                planes = self._backplanes(index, file)
            except OpNavError:
                return values
            seen = {name: float(value) for name, value in values_at(planes, (row, column)).items()}
            return values | {name: value for name, value in seen.items() if np.isfinite(value) and seen["body"] >= 0}

    def _sky(self, file: str, point_px: Float) -> dict[str, float]:
        """Right ascension and declination of a point (2,) of an image, deg; nothing where they are not known."""
        attitude = next(each for each in self._session.result.attitudes if each.file == file).attitude
        direction = self._session.camera.model.unproject(point_px)
        if attitude is None or not np.isfinite(direction).all():
            return {}
        ra_deg, dec_deg = radec_from_direction(rotate(attitude.rotation.inv(), direction))
        return {"ra": float(ra_deg), "dec": float(dec_deg)}

    def edit(self, wanted: dict[str, Any]) -> list[dict[str, Any]]:
        """Append edits of one user for one reason to the edit list of the run, all of ``things`` or none."""
        common = {"who": getpass.getuser()} | wanted
        things = common.pop("things", [{}])
        if not (isinstance(things, list) and all(isinstance(one, dict) for one in things)):
            raise InputError("things must be a list of JSON objects")
        with self._lock:
            run = RunFolder.open(self._session.folder)
            edits = [new_edit(run, common | one) for one in things]
            add_edits(self._session.folder, edits)
            self._session.reload()
        return [edit.model_dump(mode="json", exclude_none=True) for edit in edits]

    def solve(self, wanted: dict[str, Any]) -> dict[str, Any]:
        """Rerun the campaign: results changed by edits are recomputed, all others are kept."""
        with self._lock:
            if self._solving["state"] == "at work":
                return self._solving
            campaign = Campaign.load(self._session.campaign_file)
            self._solving = {"state": "at work", "text": "starting"}
        threading.Thread(target=self._solve, args=(campaign,), daemon=True).start()
        return self._solving

    def solving(self) -> dict[str, Any]:
        """State of the run that :meth:`solve` started."""
        return self._solving

    def _solve(self, campaign: Campaign) -> None:
        def progress(step: str, done: int, total: int) -> None:
            self._solving = {"state": "at work", "text": f"{step}: {done} of {total}"}

        try:
            result = run_campaign(campaign, workers=1, progress=progress)
            made = {name: count.redone for name, count in result.steps.items() if count.redone}
            text = (
                ", ".join(f"{name}: {number} made" for name, number in made.items())
                or "nothing to compute; tables and report are up to date"
            )
            with self._lock:
                self._session.reopen()
                self._planes.clear()
            self._solving = {"state": "done", "text": text}
        except OpNavError as error:
            self._solving = {"state": "failed", "text": str(error)}

    def _file(self, index: int) -> str:
        names = self._session.files
        require(0 <= index < len(names), f"there is no image {index}; there are {len(names)}")
        return names[index]

    def _backplanes(self, index: int, file: str) -> Backplanes:
        """Backplanes of an image, cached for a few images."""
        if index not in self._planes:
            planes = backplanes_of(self._session, file)
            while len(self._planes) >= _KEPT_IMAGES:
                self._planes.pop(next(iter(self._planes)))
            self._planes[index] = planes
        return self._planes[index]


def _number(name: str, text: str) -> float:
    """A finite number of a request."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    require(math.isfinite(value), f"{name} must be a number, got {text[:40]!r}")
    return value


def _layer(each: MarkLayer) -> dict[str, Any]:
    """A layer as JSON has it."""
    return {
        "name": each.name,
        "title": each.title,
        "shape": str(each.layer.shape),
        "color": each.layer.color,
        "points": np.round(each.layer.points, 3).tolist(),
        "labels": list(each.labels),
        "names": list(each.names),
        "star_ids": [str(number) for number in each.star_ids],  # they exceed the integers of JavaScript
        "rejected": each.rejected,
        "subject": list(each.subject),
        "sigmas": np.round(each.sigmas, 3).tolist(),
    }


def _difference(one: ObservationRecord, best: ObservationRecord, index: int) -> dict[str, Any]:
    """A row of the table of estimators side by side."""
    apart = difference_of(one, best)
    assert apart is not None
    ranged = len(apart.offset) > 2
    row = {
        "index": index,
        "file": one.file,
        "target": one.target,
        "estimator": one.estimator,
        "minus": best.estimator,
        "dx": float(apart.offset[0]),
        "sigma_dx": float(apart.sigma[0]),
        "dy": float(apart.offset[1]),
        "sigma_dy": float(apart.sigma[1]),
        "d_range_percent": 100.0 * math.expm1(apart.offset[2]) if ranged else None,
        "sigma_d_range_percent": 100.0 * float(apart.sigma[2]) if ranged else None,
        "sigmas": apart.sigmas,
        "chance": apart.chance,
    }
    return _finite(row)


def _fix_row(one: ObservationRecord, index: int) -> dict[str, Any]:
    """A row of the table of fixes; numbers that are not known are None."""
    row: dict[str, Any] = {
        "index": index,
        "file": one.file,
        "target": one.target,
        "estimator": one.estimator,
        "status": one.status,
        "outcome": one.outcome,
        "words": one.outcome.words,
        "reason": None if one.problem is None else str(one.problem.reason),
        "flags": list(one.flags),
        "accepted": None if one.accepted is None else str(one.accepted),
        **dict.fromkeys(["x", "y", "sigma_x", "sigma_y", "dx", "dy", "range_km", "sigma_range_km", "d_range_percent"]),
        "sigma_d_range_percent": None,
    }
    if one.center_px is None or one.covariance_px2 is None:
        return row
    sigma = np.sqrt(np.diag(np.array(one.covariance_px2)))
    row |= {"x": one.center_px[0], "y": one.center_px[1], "sigma_x": float(sigma[0]), "sigma_y": float(sigma[1])}
    if one.predicted_px is not None:
        row |= {"dx": one.center_px[0] - one.predicted_px[0], "dy": one.center_px[1] - one.predicted_px[1]}
    if one.range_km is not None:
        row |= {"range_km": one.range_km, "sigma_range_km": one.sigma_range_km}
        if one.predicted_camera_km is not None:
            predicted_km = float(np.linalg.norm(one.predicted_camera_km))
            row["d_range_percent"] = 100 * (one.range_km / predicted_km - 1)
            if one.sigma_range_km is not None:
                row["sigma_d_range_percent"] = 100 * one.sigma_range_km / predicted_km
    return _finite(row)


def _finite(row: dict[str, Any]) -> dict[str, Any]:
    """The row with None for numbers that JSON does not have."""
    return {key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in row.items()}


def _charts(seen: SeenImage) -> list[dict[str, str]]:
    """Charts that can be drawn of an image."""
    charts = [] if "stars" not in seen.points.get(seen.record.subject, {}) else [{"which": "stars", "title": "stars"}]
    for name in dict.fromkeys(one.target for one in seen.observations if one.center_px is not None):
        charts.append({"which": "correlation", "target": name, "title": f"{name}: correlation"})
        if any(len(points.get("limb_px", ())) for of, points in seen.points.items() if of[0] == name):
            charts.append({"which": "limb", "target": name, "title": f"{name}: along the limb"})
    for one in seen.observations:
        residuals = seen.points.get(one.subject, {}).get("residuals")
        if residuals is not None and residuals["cell_px"]:
            title = f"{one.target}: residual map of {one.estimator}"
            charts.append({"which": "map", "target": one.target, "estimator": one.estimator, "title": title})
    return charts


def _stretch_values(values: NDArray[Any], stretch: str) -> NDArray[np.uint8]:
    """Gray levels of an image; long ones are reduced."""
    if stretch == "auto":
        return stretch_image(values, longest_px=_LONGEST_PX)
    step = -(-max(values.shape) // _LONGEST_PX)
    part = values[::step, ::step].astype(np.float64)
    low, high = np.percentile(part, [0.5, 99.95])
    level = np.clip((part - low) / max(high - low, 1e-9), 0.0, 1.0)
    if stretch == "sqrt":
        level = np.sqrt(level)
    elif stretch == "log":
        level = np.log1p(1000.0 * level) / np.log1p(1000.0)
    gray: NDArray[np.uint8] = np.rint(255.0 * level).astype(np.uint8)
    return gray


def _apply_colors(gray: NDArray[np.uint8], colors: str) -> NDArray[np.uint8]:
    if colors == "inverted":
        return 255 - gray
    table = COLOR_MAPS[colors]
    return gray if table is None else np.asarray(cv2.applyColorMap(gray, table), dtype=np.uint8)


def _encode(picture: NDArray[np.uint8], ending: str) -> bytes:
    _, encoded = cv2.imencode(ending, picture)
    return encoded.tobytes()
