"""Check of a campaign file and of the files that it names: all errors at once, before a run."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from giantlike._system.reading import toml_table
from giantlike.calibration.star_images import start_model
from giantlike.campaign.file.config import Campaign, images_of, stars_of
from giantlike.campaign.file.frame_files import frames_of
from giantlike.campaign.file.hints import nearest
from giantlike.campaign.file.inputs import camera_of, geometry_of, spice_of, targets_of
from giantlike.campaign.file.mission_defaults import with_mission
from giantlike.campaign.file.schema import CampaignFile, TargetSection
from giantlike.campaign.file.toml_file import checked_table, problems_of
from giantlike.campaign.file.toml_lines import line_of, lines_of_keys
from giantlike.campaign.run.image_loading import open_image, scene_of, targets_in
from giantlike.campaign.store.odd_epochs import odd_epochs
from giantlike.catalogs import load_catalog
from giantlike.core.errors import DataError, InputError, OpNavError
from giantlike.core.outcomes import Failure
from giantlike.core.time import et_from_time
from giantlike.image import Image
from giantlike.io.geometry_table import GeometryTable
from giantlike.io.spice import ellipsoid_from_pck, load_kernels
from giantlike.presets import preset_names
from giantlike.relative import ESTIMATORS
from giantlike.shapes import Shape
from giantlike.stars.matching import predicted_in_frame
from giantlike.stars.navigation import sky_of

_SECTIONS = "campaign|mission|images|camera|spice|stars|calibration|calibration_frames|geometry|targets|report"
_KEY = re.compile(rf"\[?((?:{_SECTIONS})\b(?:[\w.]|\[\d+\])*)\]?:? ")
_ALONE: dict[str, Any] = {
    "shape": (1.0, 1.0, 1.0),
    "reflectance": None,
    "estimators": ["moment"],
    "options": {},
    "terrain": None,
    "terrain_sigma_km": None,
    "atmosphere": None,
    "air": None,
    "rings": None,
}
"""Placeholder keys of a target while one of them is checked."""
_OTHER_UNIT = 100.0
"""Ratio of two radii between a wrong unit, a factor of 1000, and different shapes of a body, logarithmically nearer to
these."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mistake:
    """Something that is wrong, or probably not meant.

    line: line of the campaign file; None where the problem concerns another file, or the whole file.
    key: of the campaign file; may be empty.
    text: the finding, the expectation, the remedy.
    fatal: False where a run would continue.
    """

    file: Path
    line: int | None
    key: str
    text: str
    fatal: bool = True

    def __str__(self) -> str:
        place = str(self.file) if self.line is None else f"{self.file}:{self.line}"
        return f"{place}: {'' if self.fatal else 'warning: '}{self.text}"


def check_campaign(path: Path, *, all_images: bool = False) -> list[Mistake]:
    """Find errors in a campaign file and the files that it names. The result is empty if there are none."""
    check = _Check(path)
    try:
        table = toml_table(path, "campaign file")
        check.lines = lines_of_keys(path.read_text(encoding="utf-8"))
    except DataError as error:
        line = re.search(r"at line (\d+)", str(error))
        check.add("", error, line=None if line is None else int(line.group(1)))
        return check.found
    completed = check.attempt("mission", with_mission, path, table)
    if completed is None:
        table.setdefault("camera", {"preset": preset_names()[0]})  # a mission with a valid name provides it
    else:
        table = completed
    broken = _keys_and_values(check, table)
    _named_files(check, table, broken)
    if not any(mistake.fatal for mistake in check.found):
        try:
            campaign = Campaign.load(path)
        except OpNavError as error:
            check.add("", error)
        else:
            with nullcontext() if campaign.spice is None else load_kernels(campaign.spice.kernels, "."):
                _what_is_meant(check, campaign, all_images=all_images)
    return sorted(check.found, key=lambda mistake: (not mistake.fatal, mistake.line or 0))


class _Check:
    """Mistakes found so far."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lines: dict[str, int] = {}
        self.found: list[Mistake] = []

    def add(self, key: str, problem: object, *, line: int | None = None, fatal: bool = True) -> None:
        """Add an error; a key at the beginning of the text is more specific than ``key``."""
        text = " ".join(str(problem).split()).removeprefix(f"{self.path}: ")
        named = _KEY.match(text)
        if named is not None:
            key = named.group(1)
        place = line or line_of(key, self.lines)
        if not any(mistake.text == text for mistake in self.found):
            self.found.append(Mistake(file=self.path, line=place, key=key, text=text, fatal=fatal))

    def attempt(self, key: str, function: Callable[..., Any], *args: Any) -> Any:
        """Result of a function; None, with an error added, if it rejects its arguments."""
        try:
            return function(*args)
        except (OpNavError, ValidationError) as error:
            self.add(key, error)
            return None


def _keys_and_values(check: _Check, table: dict[str, Any]) -> set[str]:
    """Every wrong key and value; the sections that have one."""
    try:
        checked_table(table, CampaignFile)
    except ValidationError as error:
        problems = problems_of(error, CampaignFile)
        for key, text in problems:
            name = key.rpartition(".")[2]
            advice = f"; options of an estimator go into [targets.options.{name}]" if name in ESTIMATORS else ""
            check.add(key, text + advice)
        return {key.partition(".")[0].partition("[")[0] for key, _ in problems}
    except InputError as error:
        check.add("", error)
        return set(table)
    return set()


def _named_files(check: _Check, table: dict[str, Any], broken: set[str]) -> None:
    """Files, names and options of every section that has no wrong key."""

    def section(name: str) -> Any:
        if name in broken or name not in table:
            return None
        field = CampaignFile.model_fields[name]
        annotation: Any = field.annotation
        return TypeAdapter(annotation).validate_json(json.dumps(table[name]))

    path, images = check.path, section("images")
    check.attempt("calibration_frames", partial(frames_of, path, section("calibration_frames"), bottom_up=False))
    targets = [(number, target) for number, target in _targets(table) if target is not None]
    for pattern in images.files if images is not None else ():
        check.attempt("images.files", images_of, path, [pattern])
    camera = check.attempt("camera", camera_of, path, table["camera"]) if section("camera") is not None else None
    spice = check.attempt("spice", spice_of, path, section("spice"))
    if images is not None and images.geometry is not None:
        bodies = [target for _, target in targets]
        found = check.attempt("images.files", images_of, path, images.files) or ()
        known = path, "images.geometry", images.geometry, bodies, [image.path for image in found]
        rows = check.attempt("images.geometry", geometry_of, *known)
        if rows is not None and not {"spice", "geometry"} & set(table):
            _targets_nowhere(check, table, rows)
    stars, calibration = section("stars"), section("calibration")
    if stars is not None:
        check.attempt("stars", stars_of, path, stars)
    if calibration is not None and camera is not None:
        model = camera[0].model
        check.attempt("calibration.estimate", start_model, model, calibration.estimate, calibration.model, 1.0)
    for number, target in targets:
        for key, alone in _pieces(target):
            padding = [target.model_copy(update=_ALONE | {"name": f"\0{place}"}) for place in range(number)]
            check.attempt(f"targets[{number}].{key}", targets_of, path, [*padding, alone], spice)
    names: set[str] = set()
    for number, name in ((number, target.name) for number, target in targets):
        if name in names:
            check.add(f"targets[{number}].name", f"targets[{number}].name: {name!r} is the name of another target too")
        names.add(name)


def _targets_nowhere(check: _Check, table: dict[str, Any], geometry: GeometryTable) -> None:
    """Targets without a row in the geometry table, which are never searched for: usually a misspelled name."""
    known = list(dict.fromkeys(row.target for row in geometry.rows if row.target is not None))
    for number, target in enumerate(table.get("targets", [])):
        name = target.get("name") if isinstance(target, dict) else None
        if isinstance(name, str) and name not in known:
            names = ", ".join(known) or "none"
            text = (
                f"target {name!r}{nearest(name, known)}: no row in {geometry.path} and no [spice], so its position is "
                f"unknown: it is looked for in no image; targets in the table: {names}"
            )
            check.add(f"targets[{number}].name", text, fatal=False)


def _targets(table: dict[str, Any]) -> Iterator[tuple[int, TargetSection | None]]:
    """Yield the targets one by one; None for one with a wrong key or value, so that the others are still checked."""
    tables = table.get("targets")
    for number, target in enumerate(tables if isinstance(tables, list) else []):
        try:
            yield number, TargetSection.model_validate_json(json.dumps(target, default=str))
        except (ValidationError, InputError):
            yield number, None


def _pieces(target: TargetSection) -> Iterator[tuple[str, TargetSection]]:
    """Yield a target once for each of its keys that may be wrong, the others replaced by valid values."""
    kept = {"options": {}, "estimators": ["moment"]}
    yield "shape", target.model_copy(update=kept | {"reflectance": None})
    yield "reflectance", target.model_copy(update=_ALONE | {"reflectance": target.reflectance})
    yield "estimators", target.model_copy(update=_ALONE | {"estimators": target.estimators})
    for name, options in target.options.items():
        yield f"options.{name}", target.model_copy(update=_ALONE | {"options": {name: options}})


def _what_is_meant(check: _Check, campaign: Campaign, *, all_images: bool) -> None:
    """Warnings of settings that are allowed but probably not intended."""
    told = {mistake.key for mistake in check.found}
    for warning in campaign.warnings:
        named = re.match(r"target '(.*?)'", warning)
        number = next((k for k, one in enumerate(campaign.targets) if named and one.name == named.group(1)), None)
        key = "images.geometry" if number is None else f"targets[{number}].name"
        if number is None or key not in told:
            check.add(key, warning, fatal=False)
    for number, section in enumerate(campaign.table.get("targets", [])):
        for name in section.get("options", {}):
            if name not in section["estimators"]:
                text = f"options of {name}, which is not in estimators and does not run: add it there, or delete them"
                check.add(f"targets[{number}].options.{name}", text, fatal=False)
    shapes = dict[str, Shape]()
    for number, target in enumerate(campaign.targets):
        shape = check.attempt(f"targets[{number}].shape", target.load_shape)
        if shape is not None:
            shapes[target.name] = shape
            _units(check, campaign, number, shape)
            _size_in_kernels(check, campaign, number, shape)
    if campaign.frames is not None:
        load = partial(campaign.frames.load, rows=campaign.camera.rows, columns=campaign.camera.columns)
        check.attempt("calibration_frames", load)
    opened = campaign.images if all_images else campaign.images[:1]
    epochs = {key: known.epoch and et_from_time(known.epoch) for key, known in campaign.geometry.items()}
    prepared = {entry.key: check.attempt("images.files", open_image, campaign, entry) for entry in opened}
    images = [one.image for one in prepared.values() if one is not None]
    for image in images:
        if epochs.get(image.name) is None:
            epochs[image.name] = image.et
        _geometry_of_image(check, campaign, image, shapes)
    for key, years in odd_epochs(epochs).items():
        text = f"{key}: its epoch is {years:+g} years from those of the other images: is the clock of its header right?"
        check.add("images.files", text, fatal=False)
    if all_images and images:
        _attitudes(check, campaign, images)


def _geometry_of_image(check: _Check, campaign: Campaign, image: Image, shapes: Mapping[str, Shape]) -> None:
    """Targets whose position, orientation or Sun in an image is not known, as the run finds out for each of them."""
    for number, target in enumerate(campaign.targets):
        if target not in targets_in(campaign, image.name) or target.name not in shapes:
            continue
        key = f"targets[{number}].name"
        try:
            scene = scene_of(campaign, image, target, shapes[target.name])
            found = scene if isinstance(scene, Failure) else scene.apparent(image, scene.target())
        except OpNavError as error:
            check.add(key, f"{image.name}: {target.name}: {error}")
            continue
        if isinstance(found, Failure):
            check.add(key, found.detail)


def _attitudes(check: _Check, campaign: Campaign, images: Sequence[Image]) -> None:
    """A run without any attitude, and fields with fewer catalog stars than an attitude needs."""
    lost = campaign.stars is not None and campaign.stars.options.lost_in_space
    if not lost and all(image.camera_from_inertial is None for image in images):
        text = (
            "no image has an a priori attitude (header, label, geometry table or C-kernel): give one, or set "
            "stars.lost_in_space = true"
        )
        check.add("stars", text)
    if campaign.stars is None:
        return
    options, catalog = campaign.stars.options, load_catalog(campaign.stars.catalog)
    for image in images:
        pointing, shortest_s = image.camera_from_inertial, campaign.stars.long_exposure_s
        if pointing is None or (shortest_s is not None and (image.exposure_s or 0.0) < shortest_s):
            continue
        field = sky_of(image, catalog, options).field(campaign.camera, pointing)
        places = predicted_in_frame(field.directions_inertial, campaign.camera, pointing, margin_px=0.0)
        count = int(np.isfinite(places).all(axis=1).sum())
        if count < options.min_matches:
            text = (
                f"{image.name}: {count} stars of the catalog lie in the predicted field, and an attitude needs "
                f"{options.min_matches}: raise stars.max_magnitude, or take a deeper catalog"
            )
            check.add("stars.max_magnitude", text, fatal=False)


def _units(check: _Check, campaign: Campaign, number: int, shape: Shape) -> None:
    """A camera inside a body indicates a wrong unit."""
    name = campaign.targets[number].name
    ranges = {
        key: float(np.linalg.norm(row.target_position_inertial_km))
        for key, known in campaign.geometry.items()
        if (row := known.targets.get(name)) is not None and row.target_position_inertial_km is not None
    }
    inside = _nearest_inside(ranges, shape.circumscribing_radius_km)
    if inside:
        check.add(
            f"targets[{number}].units",
            f"{name} has a radius of {shape.circumscribing_radius_km:.4g} km, and the camera is within it in "
            f'{len(inside)} images ({inside[0]!r}: range {ranges[inside[0]]:.4g} km): is the shape in m (units = "m")?',
        )


def _size_in_kernels(check: _Check, campaign: Campaign, number: int, shape: Shape) -> None:
    """A shape of another unit than the radii in the loaded PCK."""
    target = campaign.targets[number]
    if campaign.spice is None:
        return
    try:
        known_km = ellipsoid_from_pck(target.spice_body).mean_radius_km
    except DataError:
        return  # a body without radii in the kernels
    ratio = shape.mean_radius_km / known_km
    if not 1.0 / _OTHER_UNIT < ratio < _OTHER_UNIT:
        text = f"{target.name} has {ratio:.3g} times the mean radius in the loaded PCK ({known_km:.4g} km)"
        check.add(f"targets[{number}].shape", f"{text}: is the shape in another unit?")


def _nearest_inside(ranges: dict[str, float], radius_km: float) -> Sequence[str]:
    """Images whose range is below the radius, nearest first."""
    return sorted((key for key, range_km in ranges.items() if range_km < radius_km), key=lambda key: ranges[key])
