"""Records of a run to the rows of its observables file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.campaign.store.record_values import SightingRecord, TurnRecord
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord, ObservationsRecord
from giantlike.campaign.store.results import RunResult, camera_of_run
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.core.arrays import Float
from giantlike.core.observer import ObserverState
from giantlike.core.outcomes import BodyTurn, CenterFix, PositionFix, Quality
from giantlike.core.version import VERSION
from giantlike.io.observables_file import ObservableBlock, ObservableRow, write_observables
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

OBSERVABLES_FILE = "observables.parquet"
"""Name of the observables file in the run folder."""


def write_run_observables(result: RunResult, path: Path | None = None) -> int:
    """Write the observables of a run.

    Parameters
    ----------
    result : RunResult
    path : Path, optional
        New file, ``.parquet`` or ``.jsonl``; by default :data:`OBSERVABLES_FILE` in the run folder.

    Returns
    -------
    int
        Number of rows.

    Raises
    ------
    InputError
        The file name has another ending.
    DataError
        The run folder is damaged, or the file cannot be written.
    """
    camera = camera_of_run(result.folder)
    path = path or result.folder / OBSERVABLES_FILE
    return write_observables(path, run_observables(result, camera), observables_metadata(result.name, camera))


def run_observables(result: RunResult, camera: Camera) -> Iterator[ObservableRow | ObservableBlock]:
    """Rows of all images of a run; lists of stars and landmarks are read one image at a time.

    Parameters
    ----------
    result : RunResult
    camera : Camera
        Of the run.

    Yields
    ------
    ObservableRow or ObservableBlock
        A block for the stars of an image.
    """
    folder = RunFolder.open(result.folder)
    bodies = {record.file: record for record in result.bodies}
    with folder.reading():
        for attitude in result.attitudes:
            if attitude.file in bodies:
                yield from _body_rows(camera, attitude, bodies[attitude.file], folder)
            stars = folder.points(attitude).get("stars")
            if stars is not None and attitude.attitude is not None:
                yield _star_rows(camera, attitude, stars)


def observables_metadata(name: str, camera: Camera) -> dict[str, str]:
    """Metadata of the observables file of a run.

    Parameters
    ----------
    name : str
        Of the campaign.
    camera : Camera

    Returns
    -------
    dict of str to str
        Texts, and JSON for what has parts.
    """
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


def _star_rows(camera: Camera, attitude: AttitudeRecord, stars: Mapping[str, Any]) -> ObservableBlock:
    observer = None
    if attitude.observer_position_km is not None and attitude.observer_velocity_km_s is not None:
        observer = ObserverState(
            position_km=np.array(attitude.observer_position_km), velocity_km_s=np.array(attitude.observer_velocity_km_s)
        )
    seen = StarsSeen(
        numbers=np.array(stars["star_ids"], dtype=np.int64),
        magnitudes=np.array(stars["magnitudes"]),
        observed_px=np.array(stars["observed_px"]).reshape(-1, 2),
        predicted_px=np.array(stars["predicted_px"]).reshape(-1, 2),
        sigma_px=np.array(stars["sigma_px"]),
    )
    return rows_of_stars(_context(camera, attitude, None), seen, observer, status=attitude.status)


def _body_rows(
    camera: Camera, attitude: AttitudeRecord, bodies: ObservationsRecord, folder: RunFolder
) -> Iterator[ObservableRow]:
    sightings = {record.target: record for record in bodies.sightings}
    for target, known in sightings.items():
        records = [r for r in bodies.observations if r.target == target and r.center_px and r.attitude]
        fixes = [_fix(record) for record in records]
        choice = preferred(fixes)
        for index, (record, fix) in enumerate(zip(records, fixes, strict=True)):
            context, sighting = _context(camera, attitude, record), _sighting(known, record)
            yield row_of_body(
                context,
                sighting,
                fix,
                is_preferred=index == choice.index,
                reason=_reason(choice.index, index, choice.reason, fixes),
            )
            landmarks = folder.points(record).get("landmarks")
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


def _reason(chosen: int | None, index: int, reason: str, fixes: list[CenterFix]) -> str:
    if chosen is None or chosen == index:
        return reason
    return f"{fixes[chosen].estimator} is preferred: {reason}"


def _context(camera: Camera, image: AttitudeRecord, record: ObservationRecord | None) -> ImageContext:
    """Context of the rows of an image, with the attitude that its estimators used or, for stars, found."""
    used = image.attitude if record is None else record.attitude
    assert used is not None
    return ImageContext(
        file=image.file,
        camera=camera,
        shared_camera=f"{camera.name} {_digest(camera)}",
        camera_from_inertial=used.rotation,
        attitude_source=used.source,
        attitude_covariance_rad2=_array(used.covariance_rad2),
        attitude_errors=used.errors,
        attitude_shares=image.attitude_shares,
        epoch_utc=image.epoch_utc,
        et=image.et,
        exposure_s=image.exposure_s,
    )


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
    return hashlib.sha256(json.dumps(camera.to_mapping(), sort_keys=True).encode()).hexdigest()[:16]
