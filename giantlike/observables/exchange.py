"""Observables in the terms of other programs: tracking data messages, and SUMFILEs of stereophotoclinometry."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import PurePath

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.core.arrays import Float, require
from giantlike.core.frames import rotate
from giantlike.core.time import time_from_et
from giantlike.io.ccsds_tdm import TdmPoint, TdmSegment
from giantlike.io.observables_file import ObservableRow
from giantlike.io.spc_sumfile import Sumfile

_PIXELS_PER_MM = 100.0
"""Of the focal plane of a SUMFILE: a camera here has no pitch in mm, and only focal length times pitch matters."""
_LARGEST_DN = 65535  # of a SUMFILE, for a detector without saturation: 16 bits


class Angles(StrEnum):
    """What is removed of the angles of a tracking data message."""

    ASTROMETRIC = "astrometric"
    """Stellar aberration: the readers of such messages model light time."""
    APPARENT = "apparent"
    """Nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracked:
    """Segments of a tracking data message.

    Parameters
    ----------
    segments : tuple of TdmSegment
        One for each target.
    left_out : dict of str to int
        Number of preferred fixes left out, by reason.
    """

    segments: tuple[TdmSegment, ...]
    left_out: dict[str, int]


def tracking_segments(rows: Iterable[ObservableRow], *, angles: Angles, spacecraft: str) -> Tracked:
    """Segments of a tracking data message from the preferred fixes of bodies.

    Parameters
    ----------
    rows : iterable of ObservableRow
    angles : Angles
    spacecraft : str
        Name of the participant.

    Returns
    -------
    Tracked
    """
    points: dict[str, list[TdmPoint]] = {}
    left_out = Counter[str]()
    for row in rows:
        if row.kind != "body" or not row.preferred or row.target is None:
            continue
        ra, dec = getattr(row, f"{angles}_ra_deg"), getattr(row, f"{angles}_dec_deg")
        if row.epoch_utc is None:
            left_out["no epoch"] += 1
        elif ra is None or dec is None:
            left_out["velocity of the spacecraft unknown"] += 1
        else:
            position = row.astrometric_position_icrf_km
            range_km = None if position is None else float(np.linalg.norm(position))
            points.setdefault(row.target, []).append(
                TdmPoint(epoch_utc=row.epoch_utc, ra_deg=ra, dec_deg=dec, range_km=range_km)
            )
    removed = {
        Angles.ASTROMETRIC: "angles: stellar aberration is removed, light time is not",
        Angles.APPARENT: "angles: neither stellar aberration nor light time is removed",
    }[angles]
    comments = (removed, "range: light time by the speed of light", "covariances: see the observables file")
    segments = tuple(
        TdmSegment(
            spacecraft=spacecraft,
            target=target,
            points=sorted(found, key=lambda point: point.epoch_utc),
            comments=comments,
        )
        for target, found in points.items()
    )
    return Tracked(segments=segments, left_out=dict(left_out))


def sumfile_of(camera: Camera, body: ObservableRow, landmarks: Sequence[ObservableRow]) -> Sumfile:
    """SUMFILE of a body in an image.

    Parameters
    ----------
    camera : Camera
        Its focal length and principal point go into the file, its distortion does not.
    body : ObservableRow
        With a position and an epoch.
    landmarks : sequence of ObservableRow
        Of the same fix; where they were measured in the distorted image.

    Returns
    -------
    Sumfile
        The pose is the apparent one, which the image shows.

    Raises
    ------
    InputError
        The row has no position, epoch or orientation.
    """
    known = (body.apparent_position_icrf_km, body.camera_from_icrf_xyzw, body.icrf_from_body_xyzw, body.epoch_et_s)
    require(None not in known, f"{body.file}: a SUMFILE needs position, attitude, orientation and epoch")
    camera_from_inertial = Rotation.from_quat(_vector(body.camera_from_icrf_xyzw))
    inertial_from_body = Rotation.from_quat(_vector(body.icrf_from_body_xyzw))
    body_from_inertial, model = inertial_from_body.inv(), camera.model
    named = dict(zip(model.parameter_names, model.parameters.tolist(), strict=True))
    focal_length_mm = named["fx_px"] / _PIXELS_PER_MM
    k = np.array([[named["fx_px"], named["skew_px"], 0.0], [0.0, named["fy_px"], 0.0]]) / focal_length_mm
    sigma_km, sigma_rad = np.zeros(3), np.zeros(3)
    if body.covariance_position_icrf_km2 is not None:
        turn = body_from_inertial.as_matrix()
        sigma_km = np.sqrt(np.diag(turn @ _vector(body.covariance_position_icrf_km2).reshape(3, 3) @ turn.T))
    if body.attitude_covariance_rad2 is not None:
        sigma_rad = np.sqrt(np.diag(_vector(body.attitude_covariance_rad2).reshape(3, 3)))
    saturation = camera.detector.saturation_dn
    return Sumfile(
        name=PurePath(body.file).stem,
        epoch=time_from_et(float(_vector(body.epoch_et_s))),
        columns=camera.columns,
        rows=camera.rows,
        thresholds_dn=(0, _LARGEST_DN if not np.isfinite(saturation) else int(saturation)),
        focal_length_mm=focal_length_mm,
        center_px=np.array([named["cx_px"], named["cy_px"]]),
        pixels_per_mm=k,
        target_km=rotate(body_from_inertial, _vector(body.apparent_position_icrf_km)),
        camera_from_body=camera_from_inertial * inertial_from_body,
        sun_direction_body=rotate(body_from_inertial, _vector(body.sun_direction_icrf)),
        sigma_target_km=sigma_km,
        sigma_pointing_rad=sigma_rad,
        landmarks_px={
            row.feature or str(k): np.array([row.observed_pixel_px, row.observed_line_px])
            for k, row in enumerate(landmarks)
        },
    )


def _vector(values: object) -> Float:
    return np.asarray(values, dtype=np.float64)
