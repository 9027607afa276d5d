"""Records of a run to the rows of its observables file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.campaign.store.packing import points_of
from giantlike.campaign.store.record_values import SightingRecord, TurnRecord
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord, ObservationsRecord
from giantlike.campaign.store.results import RunResult, camera_of_run
from giantlike.campaign.store.run_folder import RESULTS_FILE, RunFolder
from giantlike.core.arrays import Float
from giantlike.core.findings import Findings
from giantlike.core.observer import ObserverState
from giantlike.core.outcomes import BodyTurn, CenterFix, PositionFix, Quality
from giantlike.core.version import VERSION
from giantlike.io.observables_file import (
    ROWS_OF_A_GROUP,
    ObservableBlock,
    ObservableRow,
    observables_table,
    write_observable_tables,
    write_observables,
)
from giantlike.observables import (
    ImageContext,
    LandmarkSeen,
    Sighting,
    StarsSeen,
    preferred,
    row_of_body,
    row_of_landmark,
    rows_of_stars,
)
from giantlike.scene import Circumstances, TargetUncertainty

OBSERVABLES_FILE = "observables.parquet"  # name of the observables file in the run folder
_IMAGES_OF_A_GROUP = 256  # most images of a group: about 40 MB with a few hundred landmarks each


def write_run_observables(result: RunResult, path: Path | None = None, *, tables: Iterable[Any] | None = None) -> int:
    """Write the observables of a run."""
    camera, folder = camera_of_run(result.folder), RunFolder.open(result.folder)
    path, metadata = path or result.folder / OBSERVABLES_FILE, observables_metadata(result.name, camera)
    if path.suffix != ".parquet":
        return write_observables(path, run_observables(result, camera), metadata)
    with folder.reading():
        made = map(table_of, ObservableGroups(folder, result, camera)) if tables is None else tables
        return write_observable_tables(path, made, metadata)


def run_observables(result: RunResult, camera: Camera) -> Iterator[ObservableRow | ObservableBlock]:
    """Rows of all images of a run; lists of stars and landmarks are read some images at a time."""
    folder = RunFolder.open(result.folder)
    with folder.reading():
        for group in ObservableGroups(folder, result, camera):
            for image in group:
                yield from image.rows()


def table_of(images: Iterable[ImageRecords]) -> Any:
    """Table of the observables of some images."""
    return observables_table([row for image in images for row in image.rows()])


class ObservableGroups:
    """The images of a run in groups: each becomes a table, and a group of the rows of the file, made by any process."""

    def __init__(self, folder: RunFolder, result: RunResult, camera: Camera) -> None:
        self._folder = folder
        self._camera, self._shared_camera = camera, f"{camera.name} {_digest(camera)}"
        self._bodies = {record.file: record for record in result.bodies}
        self._rates = _rates_of(result.attitudes)
        self._groups: list[list[AttitudeRecord]] = []
        rows, last = 0, list[AttitudeRecord]()
        for attitude in result.attitudes:
            last.append(attitude)
            rows += (attitude.n_matched or 0) + len(self._fixes(attitude.file))
            if rows >= ROWS_OF_A_GROUP or len(last) >= _IMAGES_OF_A_GROUP:
                self._groups.append(last)
                rows, last = 0, []
        self._groups += [last] if last else []

    def __len__(self) -> int:
        return len(self._groups)

    def __getitem__(self, number: int) -> list[ImageRecords]:
        return [self._records(attitude) for attitude in self._groups[number]]

    def __iter__(self) -> Iterator[list[ImageRecords]]:
        return (self[number] for number in range(len(self)))

    def _fixes(self, file: str) -> list[ObservationRecord]:
        bodies = self._bodies.get(file)
        return [] if bodies is None else [record for record in bodies.observations if _is_fix(record)]

    def _records(self, attitude: AttitudeRecord) -> ImageRecords:
        return ImageRecords(
            results=self._folder.path / RESULTS_FILE,
            camera=self._camera,
            shared_camera=self._shared_camera,
            attitude=attitude,
            rate_rad_s=self._rates.get(attitude.file),
            bodies=self._bodies.get(attitude.file),
            stars=None if attitude.attitude is None else self._folder.packed_points(attitude),
            fixes={record.subject: self._folder.packed_points(record) for record in self._fixes(attitude.file)},
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageRecords:
    """All that the observables of an image are made of."""

    results: Path  # file that the records are from, for errors
    camera: Camera
    shared_camera: str  # key of camera and calibration
    attitude: AttitudeRecord
    rate_rad_s: list[float] | None  # rotation rate of the camera, by a CK or by the images before and after
    bodies: ObservationsRecord | None
    stars: bytes | None  # points of the attitude, packed
    fixes: dict[tuple[str, str], bytes | None]  # points of fixes by target and estimator, packed

    def rows(self) -> Iterator[ObservableRow | ObservableBlock]:
        """Yield the observables of the image."""
        if self.bodies is not None:
            for sighting in {record.target: record for record in self.bodies.sightings}.values():
                yield from self._body_rows(self.bodies, sighting)
        stars = points_of(self.attitude, self.stars, self.results).get("stars")
        if stars is not None:
            yield self._star_rows(stars)

    def _star_rows(self, stars: Mapping[str, Any]) -> ObservableBlock:
        attitude, observer = self.attitude, None
        if attitude.observer_position_km is not None and attitude.observer_velocity_km_s is not None:
            observer = ObserverState(
                position_km=np.array(attitude.observer_position_km),
                velocity_km_s=np.array(attitude.observer_velocity_km_s),
            )
        seen = StarsSeen(
            numbers=np.array(stars["star_ids"], dtype=np.int64),
            magnitudes=np.array(stars["magnitudes"]),
            observed_px=np.array(stars["observed_px"]).reshape(-1, 2),
            predicted_px=np.array(stars["predicted_px"]).reshape(-1, 2),
            sigma_px=np.array(stars["sigma_px"]),
        )
        return rows_of_stars(self._context(attitude), seen, observer, status=attitude.status)

    def _body_rows(self, bodies: ObservationsRecord, known: SightingRecord) -> Iterator[ObservableRow]:
        records = [record for record in bodies.observations if record.target == known.target and _is_fix(record)]
        fixes = [_fix(record) for record in records]
        choice = preferred(fixes, accepted={k for k, record in enumerate(records) if record.accepted is not None})
        for index, (record, fix) in enumerate(zip(records, fixes, strict=True)):
            context, sighting = self._context(record), _sighting(known, record)
            yield row_of_body(
                context,
                sighting,
                fix,
                is_preferred=index == choice.index,
                reason=_reason(choice.index, index, choice.reason, fixes),
            )
            landmarks = points_of(record, self.fixes[record.subject], self.results).get("landmarks")
            if landmarks is None or not isinstance(fix, PositionFix):
                continue
            for k, name in enumerate(landmarks["names"]):
                landmark = LandmarkSeen(
                    name=name,
                    body_km=np.array(landmarks["body_km"][k]),
                    observed_px=np.array(landmarks["observed_px"][k]),
                    covariance_px2=np.array(landmarks["covariance_px2"][k]),
                )
                yield row_of_landmark(context, sighting, fix, landmark)

    def _context(self, record: AttitudeRecord | ObservationRecord) -> ImageContext:
        """Context of rows of a result, with the attitude that its estimator used or, for stars, found."""
        image, used, accepted = self.attitude, record.attitude, record.accepted
        assert used is not None
        return ImageContext(
            file=image.file,
            camera=self.camera,
            shared_camera=self.shared_camera,
            camera_from_inertial=used.rotation,
            attitude_source=used.source,
            attitude_covariance_rad2=_array(used.covariance_rad2),
            attitude_errors=used.errors,
            attitude_shares=image.attitude_shares,
            epoch_utc=image.epoch_utc,
            et=image.et,
            exposure_s=image.exposure_s,
            accepted_by=None if accepted is None else accepted.who,
            accepted_why=None if accepted is None else accepted.why,
            camera_rate_rad_s=_array(self.rate_rad_s),
        )


def observables_metadata(name: str, camera: Camera) -> dict[str, str]:
    """Metadata of the observables file of a run."""
    known = camera.uncertainty
    parameters = {
        "names": [] if known is None else list(known.estimated),
        "covariance": [] if known is None else known.covariance.tolist(),
    }
    return {
        "software": f"giantlike {VERSION}",
        "campaign": name,
        "inertial_frame": "ICRF (axes of SPICE's J2000)",
        "camera_frame": "+x along increasing columns (pixel), +y along increasing rows (line), +z boresight",
        "pixel_convention": "pixel 0, line 0 is the center of the first stored pixel",
        "time": "epoch_et_s: TDB seconds past J2000 (JD 2451545.0 TDB)",
        "quaternions": "scalar last",
        "matrices": "by rows",
        "camera": json.dumps(camera.to_mapping()),
        "camera_parameters": json.dumps(parameters),
    }


def _rates_of(records: Sequence[AttitudeRecord]) -> dict[str, list[float]]:
    """Rotation rates of the camera by image, where a CK or steady attitudes before and after an image tell them."""
    by_et = {record.et: record for record in records if record.et is not None and record.attitude is not None}
    timed = [by_et[et] for et in sorted(by_et)]
    known = [attitude for record in timed if (attitude := record.attitude) is not None]
    if not known:
        return {}
    sigmas = [float(np.sqrt(np.trace(one.covariance_rad2 or np.zeros((3, 3))))) for one in known]
    attitudes = Rotation.concatenate([one.rotation for one in known])
    rates = camera_rates(np.array([record.et for record in timed], dtype=np.float64), attitudes, np.array(sigmas))
    found = {record.file: rate.tolist() for record, rate in zip(timed, rates, strict=True) if np.isfinite(rate).all()}
    return found | {record.file: record.rate_rad_s for record in records if record.rate_rad_s is not None}


def _is_fix(record: ObservationRecord) -> bool:
    return bool(record.center_px and record.attitude)


def _reason(chosen: int | None, index: int, reason: str, fixes: list[CenterFix]) -> str:
    if chosen is None or chosen == index:
        return reason
    return f"{fixes[chosen].estimator} is preferred: {reason}"


def _sighting(known: SightingRecord, record: ObservationRecord) -> Sighting:
    circumstances = None
    if known.observer_position_km is not None and known.origin is not None:
        circumstances = Circumstances(
            origin=known.origin,
            observer_position_km=np.array(known.observer_position_km),
            observer_velocity_km_s=np.array(known.observer_velocity_km_s),
            target_velocity_km_s=_array(known.target_velocity_km_s),
            target_motion_km=_array(known.target_motion_km),
            light_time_s=known.light_time_s or 0.0,
        )
    return Sighting(
        predicted_camera_km=np.array(record.predicted_camera_km),
        camera_from_body=Rotation.from_quat(known.camera_from_body_xyzw),
        sun_direction_camera=np.array(known.sun_direction_camera),
        uncertainty=TargetUncertainty(
            scale=known.scale_sigma,
            pole_rad=known.pole_sigma_rad,
            spin_rad=known.spin_sigma_rad,
            ephemeris_km=known.ephemeris_sigma_km,
            ephemeris_icrf_km2=known.ephemeris_icrf_km2,
            sun_rad=known.sun_sigma_rad,
        ),
        circumstances=circumstances,
    )


def _fix(record: ObservationRecord) -> CenterFix:
    """Fix of a record."""
    flags = Quality.NONE
    for name in record.flags:
        flags |= Quality[name.upper()]
    common: dict[str, Any] = {
        "estimator": record.estimator,
        "target": record.target,
        "center_px": np.array(record.center_px),
        "covariance_px2": np.array(record.covariance_px2),
        "predicted_px": np.array(record.predicted_px),
        "residuals": np.zeros(0),
        "n_used": record.n_used or 0,
        "n_rejected": record.n_rejected or 0,
        "score": np.nan if record.score is None else record.score,
        "flags": flags,
        "provenance": record.provenance,
        "findings": Findings(checked_by=record.provenance.get("checked_by", "")),
        "parts": {cause: np.array(part) for cause, part in record.parts.items()},
        "partials": {cause: np.array(partial) for cause, partial in record.partials.items()},
    }
    if record.position_camera_km is None:
        return CenterFix(**common)
    return PositionFix(
        **common,
        position_camera_km=np.array(record.position_camera_km),
        covariance_camera_km2=np.array(record.covariance_camera_km2),
        limb_px=np.zeros((0, 2)),
        turn=_turn(record.turn),
    )


def _turn(record: TurnRecord | None) -> BodyTurn | None:
    if record is None:
        return None
    return BodyTurn(
        turn_rad=record.turn_rad,
        center_px=np.array(record.center_px),
        covariance=np.array(record.covariance),
        by_rotation=np.array(record.by_rotation),
    )


def _array(values: object) -> Float | None:
    return None if values is None else np.asarray(values, dtype=np.float64)


def _digest(camera: Camera) -> str:
    """Short hash of a camera."""
    optics = replace(camera, photometry=None).to_mapping()
    return hashlib.sha256(json.dumps(optics, sort_keys=True).encode()).hexdigest()[:16]


_MAX_GAP_S = 600.0  # longest time to a neighbor: a prior
_SAME_RATE = 0.1  # largest difference of the rates before and after an image relative to the larger one: a prior
_SIGMAS = 3.0


def camera_rates(et: Float, attitudes: Rotation, sigmas_rad: Float) -> Float:
    """Rates (n, 3), rad/s, camera axes, of a camera that rotates steadily from the image before to the image after.

    ``et`` (n,), increasing; ``sigmas_rad`` (n,), 0 where unknown. NaN where a neighbor is missing or farther than 600
    s, and where both rates differ by more than 10 % and three sigmas, as by a slew.
    """
    rates = np.full((et.size, 3), np.nan)
    if et.size < 3:
        return rates
    steps_s = np.diff(et)
    between = -(attitudes[1:] * attitudes[:-1].inv()).as_rotvec() / steps_s[:, None]
    sigmas = np.hypot(sigmas_rad[1:], sigmas_rad[:-1]) / steps_s
    differ = np.linalg.norm(between[1:] - between[:-1], axis=1)
    size = np.linalg.norm(between, axis=1)
    allowed = np.maximum(_SAME_RATE * np.maximum(size[1:], size[:-1]), _SIGMAS * np.hypot(sigmas[1:], sigmas[:-1]))
    steady = (differ <= allowed) & (np.maximum(steps_s[1:], steps_s[:-1]) <= _MAX_GAP_S)
    over = -(attitudes[2:] * attitudes[:-2].inv()).as_rotvec() / (et[2:] - et[:-2])[:, None]
    rates[1:-1][steady] = over[steady]
    return rates
