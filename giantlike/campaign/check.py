"""Check of a campaign file and of the files that it names: all errors at once, before a run."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from giantlike._system.reading import toml_table
from giantlike.calibration.star_images import start_model
from giantlike.camera_models import ifov_rad
from giantlike.campaign.file.config import Campaign, images_of, stars_of
from giantlike.campaign.file.frame_files import frames_of
from giantlike.campaign.file.inputs import SpiceSetup, TargetSetup, camera_of, geometry_of, spice_of, targets_of
from giantlike.campaign.file.mission_defaults import with_mission
from giantlike.campaign.file.schema import CampaignFile, TargetSection
from giantlike.campaign.file.toml_file import checked_table, line_of, lines_of_keys, nearest, problems_of
from giantlike.campaign.run.bodies import outside_px
from giantlike.campaign.run.image_loading import open_image, scene_of, targets_in
from giantlike.campaign.run.worker_context import Workbench
from giantlike.campaign.store.odd_epochs import odd_epochs
from giantlike.catalogs import load_catalog
from giantlike.core.errors import DataError, InputError, OpNavError
from giantlike.core.frames import INERTIAL_FROM_ECLIPTIC, rotate
from giantlike.core.outcomes import Failure
from giantlike.core.time import et_from_time, time_from_et, utc_text
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.image import Image
from giantlike.io.geometry_table import GeometryTable
from giantlike.io.spice import (
    body_id,
    body_name,
    ellipsoid_from_pck,
    frame_center,
    frame_names,
    has_leap_seconds,
    load_kernels,
    spk_center,
    spk_coverage,
    spk_state,
)
from giantlike.planning import expect_stars
from giantlike.presets import preset_names
from giantlike.relative import ESTIMATORS
from giantlike.scene import Scene
from giantlike.shapes import Shape

_SECTIONS = (
    "campaign|mission|images|camera|spice|stars|calibration|calibration_frames|geometry|targets|network|photometry|"
    "report"
)
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
_OTHER_BODY = 1.1  # ratio of radii beyond which bodies differ: mesh and ellipsoid of one agree to a few percent
_NARROW_DEG, _MANY_COLUMNS = 0.1, 256  # below, with so many columns, a pixel is finer than any navigation camera's
_FASTEST_KM_S = 1000.0  # in the Solar System, five times the fastest spacecraft at its perihelion
_BEST_ARCSEC = 2.0  # smallest sigma of attitudes in headers: star trackers on board reach a few arcsec
_OTHER_UNIT = 100.0  # ratio of two radii: above, a wrong unit (factor 1000); below, different shapes


@dataclass(frozen=True, slots=True, kw_only=True)
class Mistake:
    """Something that is wrong, or probably not meant."""

    file: Path
    line: int | None  # line of the campaign file; None where the problem concerns another file, or the whole file
    key: str  # of the campaign file; may be empty
    text: str  # the finding, the expectation, the remedy
    fatal: bool = True  # False where a run would continue
    image: str | None = None  # the image whose error it is; None for one that reaches every image

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
        self.epochs_et: dict[str, float | None] = {}
        self.damaged: set[str | None] = set()

    def add(
        self, key: str, problem: object, *, line: int | None = None, fatal: bool = True, image: str | None = None
    ) -> None:
        """Add an error; a key at the beginning of the text is more specific than ``key``."""
        text = " ".join(str(problem).split()).removeprefix(f"{self.path}: ")
        named = _KEY.match(text)
        if named is not None:
            key = named.group(1)
        place = line or line_of(key, self.lines)
        if not any(mistake.text == text for mistake in self.found):
            self.found.append(Mistake(file=self.path, line=place, key=key, text=text, fatal=fatal, image=image))

    def attempt(self, key: str, function: Callable[..., Any], *args: Any, image: str | None = None) -> Any:
        """Result of a function; None, with an error added, if it rejects its arguments."""
        try:
            return function(*args)
        except (OpNavError, ValidationError) as error:
            self.add(key, error, image=image)
            if image is not None and isinstance(error, DataError):
                self.damaged.add(image)
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
    rows = (row.target for row in geometry.rows if row.target is not None)
    known = list(dict.fromkeys([*rows, *(name for image in geometry.images.values() for name in image.seen)]))
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
    kept: dict[str, Any] = {"options": {}, "estimators": ["moment"], "reflectance": None}
    untimed = target.uncertainty.model_copy(update={"ephemeris_table": None})
    yield "shape", target.model_copy(update=kept | {"uncertainty": untimed})
    if target.uncertainty.ephemeris_table is not None:
        yield "uncertainty.ephemeris_table", target.model_copy(update=_ALONE)
        target = target.model_copy(update={"uncertainty": untimed})
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
    if campaign.frames is not None:
        load = partial(campaign.frames.load, rows=campaign.camera.rows, columns=campaign.camera.columns)
        check.attempt("calibration_frames", load)
    _evaluate(check, campaign, shapes, until_good=not all_images)
    epochs = {key: known.epoch and et_from_time(known.epoch) for key, known in campaign.geometry.items()}
    for key, years in odd_epochs(epochs | check.epochs_et).items():
        text = f"{key}: its epoch is {years:+g} years from those of the other images: is the clock of its header right?"
        check.add("images.files", text, fatal=False)


def check_run(bench: Workbench) -> list[str]:
    """Warn of failures of a run before its first image; images are opened until one has no error."""
    campaign, check = bench.campaign, _Check(bench.campaign.path)
    check.lines = lines_of_keys(campaign.path.read_text(encoding="utf-8")) if campaign.path.is_file() else {}
    _evaluate(check, campaign, bench.shapes, until_good=True)
    fatal = [mistake for mistake in check.found if mistake.fatal]
    failing = {mistake.image for mistake in fatal}
    if None in failing or (len(failing) == len(campaign.images) and failing - check.damaged):
        first = next(mistake for mistake in fatal if mistake.image is None or None not in failing)
        more = f" (and {len(fatal) - 1} more: giantlike check lists them)" if len(fatal) > 1 else ""
        raise InputError(f"{first}; this error reaches every image, so none is worked on{more}")
    return [mistake.text for mistake in check.found if not mistake.fatal]


def _evaluate(check: _Check, campaign: Campaign, shapes: Mapping[str, Shape], *, until_good: bool) -> None:
    """Camera, bodies and kernels, and each image as a run evaluates it; ``until_good``: until one has no error."""
    for number, target in enumerate(campaign.targets):
        if target.name in shapes:
            _size_in_kernels(check, campaign, number, shapes[target.name])
    camera = campaign.camera
    if camera.fov_deg < _NARROW_DEG and camera.columns >= _MANY_COLUMNS:
        text = f"a field of view of {camera.fov_deg:.3g} deg on {camera.columns} px: is it in rad?"
        check.add("camera", text, fatal=False)
    unknown = frozenset[str]() if campaign.spice is None else _find_unknown_names(check, campaign, campaign.spice)
    seen, unpointed = dict[str, _Seen](), list[str]()
    for entry in campaign.images:
        before = len(check.found)
        prepared = check.attempt("images.files", open_image, campaign, entry, image=entry.key)
        if prepared is not None:
            image: Image = prepared.image
            check.epochs_et.setdefault(image.name, image.et)
            if image.camera_from_inertial is None:
                unpointed.append(entry.key)
            for number, target in enumerate(campaign.targets):
                if target in targets_in(campaign, image.name) and target.name in shapes.keys() - unknown:
                    _evaluate_target(check, campaign, image, number, shapes[target.name], seen)
            _count_stars(check, campaign, image)
            _check_sigma(check, campaign, image)
        failed = any(mistake.fatal for mistake in check.found[before:])
        good = not failed and not any(one.fits_other_frame for one in seen.values())
        if until_good and good and (_finds_attitudes(campaign) or entry.key not in unpointed):
            break
    for number, target in enumerate(campaign.targets):
        if target.name in shapes:
            _units(check, campaign, number, shapes[target.name], seen.get(target.name))
        if target.name in seen:
            _wrong_frame(check, campaign, number, seen[target.name])
    if unpointed and len(unpointed) == len(campaign.images) and not _finds_attitudes(campaign):
        text = (
            "no image has an a priori attitude (header, label, geometry table or C-kernel): give one, or set "
            "stars.lost_in_space = true"
        )
        check.add("stars", text)


@dataclass(slots=True)
class _Seen:
    """Predictions of a target in the images opened so far."""

    # by image; outside_px: distance from the image by image; other_px: the same with states in ECLIPJ2000
    ranges_km: dict[str, float] = field(default_factory=dict)
    outside_px: list[float] = field(default_factory=list)
    other_px: list[float] = field(default_factory=list)

    @property
    def fits_other_frame(self) -> bool:
        """True if it is predicted outside of all images, and inside with states in ECLIPJ2000."""
        known = 0 < len(self.outside_px) == len(self.other_px)
        return known and min(self.outside_px) > 0.0 and max(self.other_px) < 0.0


def _finds_attitudes(campaign: Campaign) -> bool:
    """True if stars give attitudes to images that have none."""
    stars = campaign.stars
    return campaign.calibration is not None or (stars is not None and stars.options.lost_in_space)


def _find_unknown_names(check: _Check, campaign: Campaign, spice: SpiceSetup) -> frozenset[str]:
    """Names and codes that the loaded kernels do not know; the targets whose geometry is unknown for that."""
    if not has_leap_seconds():
        text = "no leapseconds kernel among spice.kernels: the leap seconds are those of astropy"
        check.add("spice.kernels", text, fatal=False)
    unknown: set[str] = set()
    if campaign.geometry or campaign.label_geometry:
        return frozenset()  # kernels complete the table or the labels, where they can
    covered = spk_coverage()
    names = [name for name, _ in covered.values()]
    have = f"the kernels have ephemerides of {', '.join(names)}" if names else "no SPK is among spice.kernels"

    def is_known(key: str, name: str) -> bool:
        code = body_id(name)
        if code in covered or code == 0:
            return True
        why = f"SPICE does not know this name{nearest(name, names)}" if code is None else f"no ephemeris of {code}"
        check.add(key, f"{key}: {name!r}: {why}; {have}")
        return False

    if not is_known("spice.spacecraft", spice.spacecraft):
        unknown |= {target.name for target in campaign.targets}
    for number, target in enumerate(campaign.targets):
        key = f"targets[{number}].{'name' if target.spice_body == target.name else 'spice_body'}"
        if not is_known(key, target.spice_body):
            unknown.add(target.name)
        if target.frame == target.spice_body:
            continue
        key, center = f"targets[{number}].frame", frame_center(target.frame)
        if center is None and body_id(target.frame) is None:
            hint = nearest(target.frame, frame_names())
            check.add(
                key, f"{key}: SPICE does not know the frame {target.frame!r}{hint}: load the kernel that defines it"
            )
            unknown.add(target.name)
        elif center is not None and center != body_id(target.spice_body):
            text = f"{key}: {target.frame} is the frame of {body_name(center)}, not of {target.spice_body}"
            check.add(key, text, fatal=False)
    return frozenset(unknown)


def _evaluate_target(
    check: _Check, campaign: Campaign, image: Image, number: int, shape: Shape, seen: dict[str, _Seen]
) -> None:
    """Position, orientation and Sun of a target in an image, as the run finds them, and whether they are plausible."""
    target, key = campaign.targets[number], f"targets[{number}].name"
    try:
        scene = scene_of(campaign, image, target, shape)
        found = scene if isinstance(scene, Failure) else scene.apparent(image, scene.target())
    except OpNavError as error:
        coverage = (
            "" if campaign.spice is None else _coverage_text(campaign.spice.spacecraft, target.spice_body, image.et)
        )
        check.add(key, f"{image.name}: {target.name}: {error}{coverage}", image=image.name)
        return
    if isinstance(found, Failure):
        check.add(key, found.detail, image=image.name)
        return
    here = seen.setdefault(target.name, _Seen())
    range_km = here.ranges_km[image.name] = float(np.linalg.norm(found.position_inertial_km))
    speed = 0.0 if image.observer is None else float(np.linalg.norm(image.observer.velocity_km_s))
    if speed > _FASTEST_KM_S:
        text = f"{image.name}: the spacecraft moves at {speed:.3g} km/s, {range_km:.3g} km from {target.name}"
        check.add("spice.kernels", f"{text}: is its SPK or the observer of the header in m?", image=image.name)
    if isinstance(scene, Scene):
        _note_prediction(campaign, image, target, scene, here)
    wide_km = range_km * math.radians(campaign.camera.fov_deg)
    if target.uncertainty.ephemeris_km > wide_km and image.name == next(iter(here.ranges_km)):
        text = (
            f"{image.name}: {target.uncertainty.ephemeris_km:g} km at a range of {range_km:.4g} km is wider than the "
            "field of view: is it in m?"
        )
        check.add(f"targets[{number}].uncertainty.ephemeris_km", text, fatal=False)


def _note_prediction(campaign: Campaign, image: Image, target: TargetSetup, scene: Scene, here: _Seen) -> None:
    """Add the distance of a target from the image, also with the states of its spacecraft taken as ECLIPJ2000."""
    geometry = scene.geometry(image)
    if isinstance(geometry, Failure) or image.camera_from_inertial is None:
        return
    camera, spice, et = campaign.camera, campaign.spice, image.et
    pixel_rad = float(ifov_rad(camera.model, camera.center_px))
    here.outside_px.append(outside_px(camera, geometry, pixel_rad))
    code = None if spice is None else body_id(spice.spacecraft)
    center = None if code is None or et is None else spk_center(code, et)
    if spice is None or et is None or center is None:
        return
    from_center = spk_state(spice.spacecraft, et, observer=center)[0]
    away = rotate(image.camera_from_inertial, from_center - rotate(INERTIAL_FROM_ECLIPTIC, from_center))
    moved = replace(geometry, position_camera_km=geometry.position_camera_km + away)
    here.other_px.append(outside_px(camera, moved, pixel_rad))


def _wrong_frame(check: _Check, campaign: Campaign, number: int, seen: _Seen) -> None:
    """A target that is predicted outside of all images, and inside with the other inertial frame of SPICE."""
    if seen.fits_other_frame:
        spacecraft = campaign.table["spice"]["spacecraft"]
        text = (
            f"{campaign.targets[number].name} is predicted outside of all images, by {min(seen.outside_px):.0f} px or "
            f"more, and inside with the SPK of {spacecraft} taken as ECLIPJ2000: is its frame labeled wrong?"
        )
        check.add("spice.kernels", text, fatal=False)


def _coverage_text(spacecraft: str, body: str, et: float | None) -> str:
    """Epochs that the loaded kernels cover, for those of spacecraft and body that they do not cover at a time."""
    covered = spk_coverage()
    texts = [
        f"; the kernels cover {covered[code][0]} from {utc_text(time_from_et(start), 0)} to "
        f"{utc_text(time_from_et(end), 0)}"
        for code in map(body_id, (spacecraft, body))
        if code in covered and et is not None
        for start, end in [covered[code][1]]
        if not start <= et <= end
    ]
    return "".join(dict.fromkeys(texts))


def _check_sigma(check: _Check, campaign: Campaign, image: Image) -> None:
    """Declared errors of a priori attitudes that no header attitude reaches, or that are wider than the image."""
    sigma, known = campaign.apriori_sigma_rad, campaign.geometry.get(image.name)
    if sigma is None or image.camera_from_inertial is None:
        return
    reconstructed = (known is not None and known.camera_from_inertial is not None) or (
        campaign.spice is not None and campaign.spice.camera_from_frame is not None
    )
    arcsec = sigma * ARCSEC_PER_RAD
    if arcsec < _BEST_ARCSEC and not reconstructed:
        text = f"{arcsec:.2g} arcsec is less than the error of attitudes in headers: is it in rad?"
    elif sigma > math.radians(campaign.camera.fov_deg):
        text = f"{arcsec / 3600.0:.3g} deg is wider than the field of view: is it in another unit?"
    else:
        return
    check.add("images.attitude_sigma_deg", f"images.attitude_sigma_deg: {text}", fatal=False)


def _count_stars(check: _Check, campaign: Campaign, image: Image) -> None:
    """Fields with fewer catalog stars than an attitude needs."""
    pointing = image.camera_from_inertial
    if campaign.stars is None or pointing is None or not campaign.is_star_image(image.exposure_s):
        return
    stars = expect_stars(image, campaign.camera, load_catalog(campaign.stars.catalog), options=campaign.stars.options)
    if stars.failure is not None:
        check.add("stars.max_magnitude", stars.failure.detail, fatal=False)


def _units(check: _Check, campaign: Campaign, number: int, shape: Shape, seen: _Seen | None) -> None:
    """A camera inside a body, or a body of no size, indicates a wrong unit."""
    name = campaign.targets[number].name
    ranges = ({} if seen is None else seen.ranges_km) | {
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
    text = f"{target.name} has {ratio:.3g} times the mean radius in the loaded PCK ({known_km:.4g} km)"
    if not 1.0 / _OTHER_UNIT < ratio < _OTHER_UNIT:
        check.add(f"targets[{number}].shape", f"{text}: is the shape in another unit?")
    elif not 1.0 / _OTHER_BODY < ratio < _OTHER_BODY:
        check.add(f"targets[{number}].shape", f"{text}: is it the shape of another body?", fatal=False)


def _nearest_inside(ranges: dict[str, float], radius_km: float) -> Sequence[str]:
    """Images whose range is below the radius, nearest first."""
    return sorted((key for key, range_km in ranges.items() if range_km < radius_km), key=lambda key: ranges[key])
