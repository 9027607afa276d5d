"""A run with its inputs: records, images and, where the campaign file is available, scenes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.bodies import with_attitude_used
from giantlike.campaign.run.image_loading import mask_areas, open_image, scene_of
from giantlike.campaign.run.worker_context import Workbench
from giantlike.campaign.store.edits import Edit, Edited, Measuring, read_edits
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord, TargetRecord
from giantlike.campaign.store.results import RunResult, camera_of_run, load_result
from giantlike.campaign.store.run_folder import RunFolder, find_image
from giantlike.core.arrays import Float, unit
from giantlike.core.errors import DataError, InputError
from giantlike.core.outcomes import Failure, Outcome
from giantlike.image import Image
from giantlike.scene import Scene, TargetGeometry


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenImage:
    """Results of a run for one image, after edits."""

    record: AttitudeRecord
    observations: tuple[ObservationRecord, ...]
    # lists of points as ``giantlike.campaign.store.run_folder.RunFolder.points`` returns them, by target and estimator
    # of an observation; the lists of the image itself by two empty names
    points: Mapping[tuple[str, str], Mapping[str, Any]]
    targets: tuple[TargetRecord, ...]  # a priori geometry and outlines
    edits: tuple[Edit, ...]  # decisions in effect
    rejected_fixes: tuple[ObservationRecord, ...] = ()  # fixes that were rejected, as they were before
    # mapping of str to tuple of (n, 2) px; by target, where ``giantlike.viewer.planes.with_terminators`` traced them
    terminators: Mapping[str, tuple[Float, ...]] = field(default_factory=dict)

    @property
    def names_accepted(self) -> set[str]:
        """Names of the things whose acceptance is in effect, as edits have them."""
        names = {f"{one.target} by {one.estimator}" for one in self.observations if one.accepted is not None}
        return names if self.record.accepted is None else names | {"the attitude"}

    @property
    def image_edit(self) -> Edit | None:
        """The rejection of the image itself."""
        return next((edit for edit in self.edits if edit.what is Edited.IMAGE), None)

    @property
    def star_edits(self) -> dict[int, Edit]:
        """Rejections of stars, by number."""
        return {edit.star: edit for edit in self.edits if edit.star is not None}

    def edit_of(self, fix: ObservationRecord) -> Edit | None:
        """The rejection of a fix, or that of the image."""
        of = (fix.target, fix.estimator)
        return next((edit for edit in self.edits if (edit.target, edit.estimator) == of), self.image_edit)


def verdict_of(record: AttitudeRecord, observations: Iterable[ObservationRecord]) -> str:
    """Return the verdict on an image, the worst of its attitude and the best fix of each target.

    ``ok``, ``accepted``, ``suspect``, ``failed`` or ``rejected``; fixes rejected or of no suitable body do not count.
    """
    if record.outcome is Outcome.REJECTED:
        return str(Outcome.REJECTED)
    order = (Outcome.OK, Outcome.ACCEPTED, Outcome.SUSPECT, Outcome.FAILED)
    best: dict[str, Outcome] = {}
    for one in observations:
        if one.outcome.is_attempt:
            best[one.target] = min(best.get(one.target, Outcome.FAILED), one.outcome, key=order.index)
    return str(max([record.outcome, *best.values()], key=order.index))


def review_of(verdict: str, edits: Sequence[Edit]) -> str:
    """Return the state of review of an image: ``unseen``, ``accepted``, ``rejected`` or ``to discuss``.

    It is unseen while nobody accepted or rejected it or one of its results, or something suspect is left.
    """
    if any(edit.action == "discuss" for edit in edits):
        return "to discuss"
    decided = [edit for edit in edits if edit.what in (Edited.IMAGE, Edited.ATTITUDE, Edited.FIX)]
    if not decided or verdict == Outcome.SUSPECT:
        return "unseen"
    return "accepted" if decided[-1].action == "accept" else "rejected"


class Session:
    """A finished run, opened for inspection.

    Parameters
    ----------
    folder : Path; the run folder
    campaign : Path, optional
        Its campaign file; by default the one of the run, if it still exists. It is needed for data that the run does
        not keep (shapes, backplanes, templates) and to solve again.

    Raises
    ------
    DataError
        It is not a run folder, or the run is not finished.
    """

    def __init__(self, folder: Path, campaign: Path | None = None) -> None:
        self.folder = folder
        self.result: RunResult = load_result(folder)
        self._campaign_file = campaign
        self._store = RunFolder.open(folder)

    def reload(self) -> None:
        """Read records and edits again, after a run or an edit."""
        self.result = load_result(self.folder)

    def reopen(self) -> None:
        """Read the campaign file again too, after a run: it may have been edited."""
        bench = self.__dict__.pop("workbench", None)
        if bench is not None:
            bench.close()
        self.__dict__.pop("camera", None)
        self.reload()

    @property
    def campaign_file(self) -> Path:
        """The campaign file of the run; InputError where it is not where it was, and was not given."""
        named = self._store.provenance().get("environment", {}).get("campaign_file")
        path = self._campaign_file or (None if named is None else (self.folder / named).resolve())
        if path is None or not path.is_file():
            raise InputError(f"{self.folder}: its campaign file is not at {path}: give it with --campaign FILE")
        return path

    @cached_property
    def camera(self) -> Camera:
        """Camera of the run: the calibrated one if the run calibrated."""
        return camera_of_run(self.folder)

    @cached_property
    def workbench(self) -> Workbench:
        """Catalog, shapes and kernels of the campaign, loaded once; InputError or DataError where one is wrong."""
        campaign = Campaign.load(self.campaign_file)
        return Workbench.load(replace(campaign, camera=self.camera))

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the images, in input order."""
        return tuple(record.file for record in self.result.attitudes)

    def find(self, name: str) -> str:
        """Name of an image in the tables, by name, the end of its path or its start; InputError for none or several."""
        return find_image(name, self.files, self.folder)

    def seen(self, file: str) -> SeenImage:
        """Return the results of the run for an image, one of :attr:`files`."""
        record = next(each for each in self.result.attitudes if each.file == file)
        observations = [one for image in self.result.bodies if image.file == file for one in image.observations]
        names = dict.fromkeys(one.target for one in observations)
        with self._store.reading():
            targets = [self._store.load(TargetRecord, file, (name, "")) for name in names]
            edits = tuple(edit for edit in read_edits(self.folder).standing if edit.file == file)
            hidden = [self._store.load(ObservationRecord, file, one.subject, light=True) for one in observations
                      if one.outcome is Outcome.REJECTED]  # fmt: skip
            rejected = tuple(one for one in hidden if one is not None and one.center_px is not None)
            found = {one.subject: one for one in (record, *observations)} | {one.subject: one for one in rejected}
            if record.outcome is Outcome.REJECTED:
                found[record.subject] = self._store.load(AttitudeRecord, file, light=True) or record
            points = {of: self._store.points(one) for of, one in found.items()}
        return SeenImage(
            record=record,
            observations=tuple(observations),
            points=points,
            targets=tuple(target for target in targets if target is not None),
            edits=edits,
            rejected_fixes=rejected,
        )

    def pixels(self, file: str) -> Image:
        """The image as it is stored; DataError where the file is gone or damaged."""
        record = next(each for each in self.result.attitudes if each.file == file)
        return Image.open(self.folder / record.path, hdu=self.result.hdu, bottom_up=self.result.bottom_up)

    def image(self, file: str) -> Image:
        """The image as estimators saw it, with the attitude used; InputError or DataError where it cannot be read."""
        bench = self.workbench
        entry = next((each for each in bench.campaign.images if each.key == file), None)
        if entry is None:
            raise InputError(f"{bench.campaign.path}: there is no image {file!r} in it any more")
        areas = read_edits(self.folder).measuring().get(file, Measuring()).areas.get(("", ""), ())
        image = mask_areas(open_image(bench.campaign, entry, bench.frames).image, areas)
        record = next(each for each in self.result.attitudes if each.file == file)
        return with_attitude_used(image, record.attitude)

    def geometry(self, file: str, *, image: Image | None = None) -> dict[str, TargetGeometry]:
        """Geometry of the targets that have one, by target, with the attitude used; ``image`` as of :meth:`image`."""
        image = self.image(file) if image is None else image
        bench, known = self.workbench, {}
        wanted = {one.target for bodies in self.result.bodies if bodies.file == file for one in bodies.observations}
        for target in bench.campaign.targets:
            if target.name not in wanted:
                continue
            scene = scene_of(bench.campaign, image, target, bench.shapes[target.name])
            geometry = scene.geometry(image, target.name) if isinstance(scene, Scene) else scene
            if not isinstance(geometry, Failure):
                known[target.name] = geometry
        return known

    def position_camera_km(self, geometry: TargetGeometry, fix: ObservationRecord | None) -> Float:
        """Position (3,), km, camera axes, by a fix (its range as predicted where it has none), else as predicted."""
        if fix is None or fix.center_px is None:
            return geometry.position_camera_km
        if fix.position_camera_km is not None:
            return np.array(fix.position_camera_km)
        return geometry.range_km * unit(self.camera.model.unproject(np.array(fix.center_px)))

    def require_attitude(self, file: str) -> Rotation:
        """``camera_from_inertial`` of an image; DataError where it has none."""
        attitude = next(each for each in self.result.attitudes if each.file == file).attitude
        if attitude is None:
            raise DataError(self.folder, f"{file} has no attitude in this run")
        return attitude.rotation


def chosen_fix(seen: SeenImage, target: str, estimator: str | None = None) -> ObservationRecord | None:
    """The fix of a target to show: of an estimator, or the best one; None where there is none."""
    there = [one for one in seen.observations if one.target == target]
    if estimator is not None and estimator not in {one.estimator for one in there}:
        names = ", ".join(one.estimator for one in there)
        raise InputError(f"{seen.record.file}: {target} has no observation by {estimator!r}; there are {names}")
    fixes = [one for one in there if one.center_px is not None and estimator in (None, one.estimator)]
    return min(fixes, key=_rank, default=None)


def _rank(fix: ObservationRecord) -> tuple[bool, bool, float]:
    size = np.inf if fix.covariance_px2 is None else float(np.trace(np.array(fix.covariance_px2)))
    return not fix.outcome.is_usable, fix.estimator != "auto", size
