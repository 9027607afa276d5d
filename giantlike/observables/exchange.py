"""Observables in the terms of other programs: tracking data messages, picture sequences, SUMFILEs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import PurePath

import numpy as np
import spiceypy
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.core.arrays import Float, require
from giantlike.core.frames import radec_from_direction, rotate
from giantlike.core.light import aberrate
from giantlike.core.time import time_from_et, utc_text
from giantlike.core.version import VERSION
from giantlike.ephemeris import BARYCENTER
from giantlike.io.ades import AdesObservation, is_designation
from giantlike.io.ccsds_tdm import ABERRATION_REMOVED, TdmPoint, TdmSegment
from giantlike.io.observables_file import ObservableBlock, ObservableRow
from giantlike.io.picture_sequence import PictureObject, PsfCamera, PsfImage, PsfPicture
from giantlike.io.spc_lmk import Lmk
from giantlike.io.spc_sumfile import Sumfile
from giantlike.io.spice import load_kernels, spk_state
from giantlike.shapes.landmarks import Landmark

_PIXELS_PER_MM = 100.0  # of a file: cameras here have no pitch in mm, and only focal length times pitch matters
_LONGEST_LINE = 200  # characters of a remark: with an epoch before it, it fits the 254 of a line of CCSDS messages
_LARGEST_DN = 65535  # of a SUMFILE, for a detector without saturation: 16 bits


class Angles(StrEnum):
    """What is removed of the angles of a tracking data message."""

    ASTROMETRIC = "astrometric"  # stellar aberration: the readers of such messages model light time
    APPARENT = "apparent"  # nothing


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracked:
    """Segments of a tracking data message."""

    segments: tuple[TdmSegment, ...]  # one for each target
    left_out: dict[str, int]  # number of preferred fixes left out, by reason


def tracking_segments(
    rows: Iterable[ObservableRow], *, angles: Angles, spacecraft: str, frame: str = "ICRF"
) -> Tracked:
    """Segments of a tracking data message from the preferred fixes of bodies."""
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
                TdmPoint(
                    epoch_utc=row.epoch_utc,
                    ra_deg=ra,
                    dec_deg=dec,
                    range_km=range_km,
                    errors=_errors(row),
                    remarks=_acceptance(row),
                )
            )
    removed = {
        Angles.ASTROMETRIC: f"angles: {ABERRATION_REMOVED}, light time is not",
        Angles.APPARENT: "angles: neither stellar aberration nor light time is removed",
    }[angles]
    comments = (removed, "range: light time by the speed of light", "covariances by cause: see the observables file")
    segments = tuple(
        TdmSegment(
            spacecraft=spacecraft,
            target=target,
            points=sorted(found, key=lambda point: point.epoch_utc),
            comments=comments,
            frame=frame,
        )
        for target, found in points.items()
    )
    return Tracked(segments=segments, left_out=dict(left_out))


def _errors(row: ObservableRow) -> str:
    """Standard deviations of right ascension times cos(declination), declination and range, and their correlation."""
    east, north, both = row.sigma_ra_cos_dec_arcsec, row.sigma_dec_arcsec, row.correlation_ra_dec
    if east is None or north is None or both is None:
        return ""
    text = f"sigma RA*cos(Dec) {east:.6g} arcsec, Dec {north:.6g} arcsec, correlation {both:.4f}"
    return text if row.sigma_range_km is None else f"{text}, range {row.sigma_range_km:.6g} km"


def _acceptance(row: ObservableRow) -> str:
    """Who accepted a suspect observation, and why, in plain characters; empty for one that is not suspect."""
    if row.accepted_by is None:
        return ""
    return plain_line(f"suspect ({row.flags}), accepted by {row.accepted_by}: {row.accepted_why}")


def plain_line(text: str) -> str:
    """Return the text in ASCII without bars, cut where it is too long for a line of a message."""
    plain = text.encode("ascii", "replace").decode().replace("|", ", ")
    return plain if len(plain) <= _LONGEST_LINE else plain[: _LONGEST_LINE - 3].rstrip() + "..."


@dataclass(frozen=True, slots=True, kw_only=True)
class AdesSource:
    """Inputs of an ADES file besides the rows."""

    earth_kernel: str  # SPK of the Earth
    objects: Mapping[str, str] = field(default_factory=dict)  # designations by target
    n_stars: Mapping[str, int] = field(default_factory=dict)  # stars of the attitudes, by image
    # sigma_position_km, sigma_time_s: of the spacecraft along each axis, and of the epochs
    sigma_position_km: float | None = None
    sigma_time_s: float | None = None


def astrometry_of(
    rows: Iterable[ObservableRow], source: AdesSource
) -> tuple[tuple[AdesObservation, ...], dict[str, int]]:
    """Astrometric observations from the preferred fixes of bodies, and the number of fixes left out by reason."""
    made, left_out = list[AdesObservation](), Counter[str]()
    with load_kernels([source.earth_kernel], "."):
        for row in rows:
            if row.kind != "body" or not row.preferred or row.target is None:
                continue
            designation = designation_of(source.objects.get(row.target, row.target))
            if designation is None:
                left_out[f"{row.target} has no designation of the Minor Planet Center"] += 1
            elif row.epoch_et_s is None or row.astrometric_ra_deg is None or row.astrometric_dec_deg is None:
                left_out["no epoch, or velocity of the spacecraft unknown"] += 1
            elif row.sigma_ra_cos_dec_arcsec is None or row.states_origin != BARYCENTER:
                left_out["no covariance, or no position of the spacecraft from the barycenter"] += 1
            else:
                made.append(_astrometry(row, designation, source))
    return tuple(made), dict(left_out)


def _astrometry(row: ObservableRow, designation: tuple[str, str], source: AdesSource) -> AdesObservation:
    """Observation of a row that has what is needed."""
    assert row.epoch_et_s is not None
    earth_km, earth_km_s = spk_state("EARTH", row.epoch_et_s, observer=BARYCENTER)
    sigma_km = source.sigma_position_km
    return AdesObservation(
        identification=designation,
        epoch_utc=utc_text(time_from_et(row.epoch_et_s)),
        ra_deg=float(row.astrometric_ra_deg or 0.0),
        dec_deg=float(row.astrometric_dec_deg or 0.0),
        sigma_ra_arcsec=float(row.sigma_ra_cos_dec_arcsec or 0.0),
        sigma_dec_arcsec=float(row.sigma_dec_arcsec or 0.0),
        correlation=float(np.clip(row.correlation_ra_dec or 0.0, -0.999999, 0.999999)),
        position_km=_vector(row.observer_position_icrf_km) - earth_km,
        velocity_km_s=_vector(row.observer_velocity_icrf_km_s) - earth_km_s,
        position_covariance_km2=None if sigma_km is None else sigma_km**2 * np.eye(3),
        sigma_time_s=source.sigma_time_s,
        exposure_s=row.exposure_s or None,
        n_stars=source.n_stars.get(row.file) or None,
        remarks="; ".join(
            [f"ICRF; center of the shape of the object by giantlike {VERSION}", *filter(None, [_acceptance(row)])]
        ),
    )


def designation_of(name: str) -> tuple[str, str] | None:
    """Element of ADES and text for a designation, or for the name of a moon or a numbered asteroid in SPICE."""
    for kind in ("permID", "provID"):
        if is_designation(kind, name):
            return kind, name
    try:
        code = spiceypy.bodn2c(name)
    except spiceypy.exceptions.NotFoundError:
        return ("trkSub", name) if is_designation("trkSub", name) else None
    planet, moon = divmod(code, 100)
    if 4 <= planet <= 8 and 0 < moon < 99:
        return "permID", f"{('Mars', 'Jupiter', 'Saturn', 'Uranus', 'Neptune')[planet - 4]} {moon}"
    return ("permID", str(code - 2_000_000)) if 2_000_000 < code < 3_000_000 else None


def sumfile_of(camera: Camera, body: ObservableRow, landmarks: Sequence[ObservableRow]) -> Sumfile:
    """SUMFILE of a body in an image."""
    known = (body.apparent_position_icrf_km, body.camera_from_icrf_xyzw, body.icrf_from_body_xyzw, body.epoch_et_s)
    require(None not in known, f"{body.file}: a SUMFILE needs position, attitude, orientation and epoch")
    camera_from_inertial = Rotation.from_quat(_vector(body.camera_from_icrf_xyzw))
    inertial_from_body = Rotation.from_quat(_vector(body.icrf_from_body_xyzw))
    body_from_inertial, plane = inertial_from_body.inv(), psf_camera(camera)
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
        focal_length_mm=plane.focal_length_mm,
        center_px=plane.center_px,
        pixels_per_mm=np.hstack([plane.pixels_per_mm, np.zeros((2, 1))]),
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


def lmk_of(row: ObservableRow, maps: Mapping[str, Landmark], picture: str, known: Lmk | None) -> Lmk:
    """LMK file of a landmark with one more picture; the place of the landmark counts as exact."""
    name = row.feature or ""
    require(name in maps, f"there is no landmark {name!r}, which the run has: give the landmarks that it used")
    pixel = {picture: np.array([row.observed_pixel_px, row.observed_line_px])}
    if known is not None:
        return replace(known, pictures_px={**known.pictures_px, **pixel})
    here = maps[name].map
    return Lmk(
        name=name,
        half_size=max(here.heights_km.shape) // 2,
        scale_km=here.spacing_km,
        position_body_km=_vector(row.feature_position_body_km),
        body_from_local=here.body_from_map,
        sigma_body_km=np.zeros(3),
        pictures_px=pixel,
    )


def psf_camera(camera: Camera) -> PsfCamera:
    """Return the camera of a picture sequence file: focal length and principal point, without distortion."""
    named = dict(zip(camera.model.parameter_names, camera.model.parameters.tolist(), strict=True))
    focal_length_mm = named["fx_px"] / _PIXELS_PER_MM
    return PsfCamera(
        columns=camera.columns,
        rows=camera.rows,
        focal_length_mm=focal_length_mm,
        center_px=np.array([named["cx_px"], named["cy_px"]]),
        pixels_per_mm=np.array([[named["fx_px"], named["skew_px"]], [0.0, named["fy_px"]]]) / focal_length_mm,
    )


def picture_of(camera: Camera, rows: Sequence[ObservableRow | ObservableBlock]) -> PsfPicture | str:
    """Picture of a picture sequence file: preferred fixes of bodies, and the stars of the image."""
    bodies = [row for row in rows if isinstance(row, ObservableRow) and row.kind == "body" and row.preferred]
    stars = [star for block in rows if isinstance(block, ObservableBlock) for star in block.rows()]
    used = [
        row
        for row in (*bodies, *stars)
        if row.sigma_pixel_px is not None and (row.kind == "body" or row.observer_velocity_icrf_km_s is not None)
    ]
    if not used:
        return "no body or star with a sigma, and for stars the velocity of the spacecraft"
    first = used[0]
    if first.epoch_et_s is None:
        return "no epoch"
    if first.camera_from_icrf_xyzw is None:
        return "no attitude"
    attitude = Rotation.from_quat(_vector(first.camera_from_icrf_xyzw))
    return PsfPicture(
        name=PurePath(first.file).stem,
        et=first.epoch_et_s,
        exposure_s=first.exposure_s or 0.0,
        camera_from_inertial=attitude,
        images=_psf_images(camera, attitude, used),
    )


def _psf_images(camera: Camera, attitude: Rotation, rows: Sequence[ObservableRow]) -> tuple[PsfImage, ...]:
    """Bodies and stars of a picture; places of stars in the catalog are those that the attitude was solved with."""
    model, plane = camera.model, psf_camera(camera)
    observed = _vector([[row.observed_pixel_px, row.observed_line_px] for row in rows])
    in_camera = model.unproject(observed)
    in_plane = plane.focal_length_mm * in_camera[:, :2] / in_camera[:, 2:]
    corrections = observed - plane.center_px - in_plane @ plane.pixels_per_mm.T
    images = []
    places = _star_places(camera, attitude, [row for row in rows if row.kind == "star"])
    for row, place, correction in zip(rows, observed, corrections, strict=True):
        star = row.kind == "star"
        name = (row.feature if star else row.target) or ""
        kind, number = (PictureObject.STAR, int(name) if name.isdecimal() else 0) if star else _psf_body(name)
        images.append(
            PsfImage(
                kind=kind,
                name=name,
                number=number,
                observed_px=place,
                correction_px=correction,
                sigma_px=_vector([row.sigma_pixel_px, row.sigma_line_px]),
                radec_deg=next(places) if star else None,
            )
        )
    return tuple(images)


def _star_places(camera: Camera, attitude: Rotation, stars: Sequence[ObservableRow]) -> Iterator[tuple[float, float]]:
    """Right ascension and declination of catalog stars, deg, without aberration."""
    if stars:
        computed = _vector([[star.computed_pixel_px, star.computed_line_px] for star in stars])
        apparent = rotate(attitude.inv(), camera.model.unproject(computed))
        ra, dec = radec_from_direction(aberrate(apparent, -_vector(stars[0].observer_velocity_icrf_km_s)))
        yield from zip(ra.tolist(), dec.tolist(), strict=True)


def _psf_body(target: str) -> tuple[PictureObject, int]:
    """Kind and NAIF code of a body, 0 of one that SPICE does not know."""
    try:
        code = int(spiceypy.bodn2c(target))
    except spiceypy.utils.exceptions.NotFoundError:
        return PictureObject.SMALL_BODY, 0
    if not 100 < code < 1000:
        return PictureObject.SMALL_BODY, code
    return (PictureObject.PLANET if code % 100 == 99 else PictureObject.SATELLITE), code


def _vector(values: object) -> Float:
    return np.asarray(values, dtype=np.float64)
