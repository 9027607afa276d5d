"""Export of the attitudes and observables of a finished run in the formats of other programs."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import groupby
from pathlib import Path
from types import MappingProxyType

import numpy as np

from giantlike._system.atomic import make_folder, name_of_file
from giantlike.camera import Camera
from giantlike.campaign.file.schema import AdesFile
from giantlike.campaign.file.toml_file import prefix_errors, read_toml
from giantlike.campaign.store.observables import run_observables, write_run_observables
from giantlike.campaign.store.records import Attitude, AttitudeRecord
from giantlike.campaign.store.results import RunResult, attitude_series, camera_of_run, load_result
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.core.arrays import require
from giantlike.core.errors import InputError
from giantlike.core.frames import quaternion_xyzw, require_same_frame
from giantlike.core.outcomes import Failure, Outcome
from giantlike.io.ades import AdesContext, write_ades
from giantlike.io.attitude_series import AttitudeSeries, UntimedAttitude, write_attitude_csv
from giantlike.io.camera_sip import PosedModel
from giantlike.io.ccsds_aem import AemNames, write_aem
from giantlike.io.ccsds_tdm import write_tdm
from giantlike.io.csv_rows import write_csv_rows
from giantlike.io.observables_file import ObservableBlock, ObservableRow
from giantlike.io.orbit_covariance import COLUMNS
from giantlike.io.picture_sequence import PsfPicture, write_psf
from giantlike.io.spc_lmk import Lmk, write_lmk
from giantlike.io.spc_sumfile import write_sumfile
from giantlike.io.spice import body_id
from giantlike.io.spice_ck import CkTarget, SpkArc, write_ck, write_spk
from giantlike.io.wcs_header import write_wcs
from giantlike.observables.exchange import (
    AdesSource,
    Angles,
    astrometry_of,
    lmk_of,
    picture_of,
    plain_line,
    psf_camera,
    sumfile_of,
    tracking_segments,
)
from giantlike.observables.pointing import pointing_from_bodies
from giantlike.observables.trajectory import relative_arcs
from giantlike.shapes.landmarks import load_landmarks


class ExportFormat(StrEnum):
    """Formats of ``giantlike export``."""

    CSV = "csv"  # quaternions and covariances
    CK = "ck"  # SPICE C-kernel of type 3 or 1
    AEM = "aem"  # CCSDS Attitude Ephemeris Message
    WCS = "wcs"  # A FITS header with TAN-SIP world coordinates for each image, in a folder
    OBSERVABLES = "observables"
    """Observables of bodies, landmarks and stars: JSON lines or, by the name of the output, Parquet."""
    TDM = "tdm"  # CCSDS Tracking Data Message: right ascension, declination and range of the preferred fixes
    PSF = "psf"  # JPL picture sequence file: pointing, bodies and stars of each picture
    SUMFILE = "sumfile"  # SUMFILEs of stereophotoclinometry, one for each target in an image, in a folder
    SPK = "spk"
    """SPICE SPK of the spacecraft relative to each target from the preferred positions, and covariances as CSV."""
    ADES = "ades"  # astrometry for the Minor Planet Center, XML or, by the name of the output, PSV: the preferred fixes


class InertialFrame(StrEnum):
    """Names of the inertial axes in CCSDS messages."""

    ICRF = "ICRF"  # axes of SPICE's J2000
    GCRF = "GCRF"  # the same axes by the name that programs read without an ephemeris of the barycenter, such as Orekit


class PointingSource(StrEnum):
    """Source of exported attitudes."""

    STARS = "stars"  # the attitudes of the run: stars, or transferred from them
    BODIES = "bodies"
    """The ephemeris: the camera is rotated to fit bodies and landmarks to their measured positions, with the attitude
    of the run and its covariance as a priori."""


EXPORT_NAMES: Mapping[ExportFormat, str] = MappingProxyType(
    {
        ExportFormat.CSV: "attitudes_export.csv",
        ExportFormat.CK: "attitudes_export.bc",
        ExportFormat.AEM: "attitudes_export.aem",
        ExportFormat.WCS: "attitudes_export.wcs",
        ExportFormat.OBSERVABLES: "observables.jsonl",
        ExportFormat.TDM: "observables.tdm",
        ExportFormat.PSF: "pictures.psf",
        ExportFormat.ADES: "astrometry.xml",
        ExportFormat.SUMFILE: "sumfiles",
        ExportFormat.SPK: "trajectory.bsp",
    }
)
"""Names of the files in the run folder that an export writes where no other is given."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """Options of an export."""

    pointing: PointingSource = PointingSource.STARS
    suspect: bool = False  # write suspect attitudes as well
    stars_only: bool = False  # leave out attitudes that were transferred from other images
    max_gap_s: float = 600.0  # CK, AEM and SPK: longest gap to interpolate over. The default is not from a study.
    instrument_id: int | None = None  # CK: NAIF code of the camera frame
    frame_name: str | None = None  # CK and AEM: of the camera frame; default: the mission's, or the camera's name
    sclk: Path | None = None  # CK: clock kernel of the spacecraft; without it, one is made
    ck_type: int = 3  # CK: 3, continuous, or 1, discrete
    # object_name, object_id, originator: AEM: see ``giantlike.io.ccsds_aem.write_aem``. TDM, PSF: the spacecraft, and
    # who writes the message
    object_name: str = "UNKNOWN"
    object_id: str = "UNKNOWN"
    originator: str = "UNKNOWN"
    angles: Angles = Angles.ASTROMETRIC  # TDM: corrections removed from the angles
    inertial: InertialFrame = InertialFrame.ICRF  # AEM, TDM: name of the inertial axes
    sip_order: int = 5  # WCS: order of the polynomials, 2 to 9
    ades: Path | None = None  # ADES: TOML file with a table ``[ades]``, such as the campaign file
    spacecraft_id: int | None = None  # spacecraft_id, target_id: SPK: NAIF codes; default: by the name of one target
    target_id: int | None = None
    landmarks: Path | None = None  # SUMFILE: catalog of landmarks or folder of maps, for LMK files

    def __post_init__(self) -> None:
        require(self.ck_type in (1, 3), f"C-kernels are written of type 1 or 3, got {self.ck_type}")
        require(self.max_gap_s >= 0, f"max_gap_s must be >= 0, got {self.max_gap_s}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """Result of an export."""

    files: tuple[Path, ...]
    n_attitudes: int = 0
    left_out: Mapping[str, int] = field(default_factory=dict)  # number of attitudes left out, by reason
    n_observations: int = 0


def export_run(
    folder: Path, output: Path, format_name: ExportFormat, options: ExportOptions = ExportOptions()
) -> Exported:
    """Write the attitudes or observables of a finished run."""
    result = load_result(folder)
    if format_name is ExportFormat.OBSERVABLES:
        make_folder(output.parent)
        return Exported(files=(output,), n_observations=write_run_observables(result, output))
    camera = camera_of_run(folder)
    if format_name is ExportFormat.TDM:
        return _tdm(output, _single_rows(result, camera), options)
    if format_name is ExportFormat.ADES:
        return _astrometry(output, result, camera, options)
    if format_name is ExportFormat.PSF:
        return _pictures(output, result, camera, options)
    if format_name is ExportFormat.SUMFILE:
        return _sumfiles(output, _single_rows(result, camera), camera, options.landmarks)
    if format_name is ExportFormat.SPK:
        return _spk(output, result, camera, options)
    needs_epoch = format_name not in (ExportFormat.WCS, ExportFormat.CSV)
    if options.pointing is PointingSource.BODIES:
        chosen, left_out = _by_bodies(result, camera, needs_epoch=needs_epoch)
    else:
        chosen, left_out = _chosen(result, options, needs_epoch=needs_epoch)
    require(bool(chosen), f"{folder}: no attitude to write ({_said(left_out)})")
    make_folder(output if format_name is ExportFormat.WCS else output.parent)
    job = _Job(output=output, camera=camera, records=chosen, options=options, bottom_up=result.bottom_up)
    files = _WRITERS[format_name](job)
    return Exported(files=files, n_attitudes=len(chosen), left_out=left_out)


def _chosen(
    result: RunResult, options: ExportOptions, *, needs_epoch: bool
) -> tuple[list[AttitudeRecord], dict[str, int]]:
    chosen, left_out = list[AttitudeRecord](), dict[str, int]()
    for record in result.attitudes:
        reason = None
        if record.attitude is None:
            reason = "no attitude"
        elif record.attitude.source == "a_priori":
            reason = "a priori only"
        elif record.outcome is Outcome.SUSPECT and not options.suspect:
            reason = "suspect"
        elif options.stars_only and record.attitude.source != "stars":
            reason = "not from own stars"
        elif needs_epoch and record.et is None:
            reason = "no epoch"
        if reason is None:
            chosen.append(record)
        else:
            left_out[reason] = left_out.get(reason, 0) + 1
    return chosen, left_out


def _by_bodies(result: RunResult, camera: Camera, *, needs_epoch: bool) -> tuple[list[AttitudeRecord], dict[str, int]]:
    """Records of the images whose attitude follows from bodies, with that attitude."""
    records = {record.file: record for record in result.attitudes}
    chosen, left_out = list[AttitudeRecord](), dict[str, int]()
    for file, group in groupby(_single_rows(result, camera), key=lambda row: row.file):
        found, record = pointing_from_bodies(camera, list(group)), records.pop(file)
        if isinstance(found, Failure):
            left_out[str(found.reason)] = left_out.get(str(found.reason), 0) + 1
        elif needs_epoch and record.et is None:
            left_out["no epoch"] = left_out.get("no epoch", 0) + 1
        else:
            attitude = Attitude(
                source=str(PointingSource.BODIES),
                quaternion_xyzw=quaternion_xyzw(found.camera_from_inertial).tolist(),
                covariance_rad2=found.covariance_rad2.tolist(),
            )
            chosen.append(record.replace(attitude=attitude))
    if records:
        left_out["no body"] = len(records)
    return chosen, left_out


def _said(left_out: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in left_out.items()) or "it holds no images"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """Everything that one format is written from."""

    output: Path
    camera: Camera
    records: list[AttitudeRecord]
    options: ExportOptions
    bottom_up: bool


def _csv(job: _Job) -> tuple[Path, ...]:
    timed = [record for record in job.records if record.et is not None]
    unknown = np.full((3, 3), np.nan)
    untimed = [
        UntimedAttitude(
            name=record.file,
            camera_from_inertial=attitude.rotation,
            covariance_rad2=unknown if attitude.covariance_rad2 is None else np.array(attitude.covariance_rad2),
        )
        for record in job.records
        if record.et is None and (attitude := record.attitude) is not None
    ]
    write_attitude_csv(job.output, attitude_series(timed, job.camera) if timed else None, untimed)
    return (job.output,)


def _ck(job: _Job) -> tuple[Path, ...]:
    code = job.options.instrument_id
    if code is None:
        raise InputError("a C-kernel needs --instrument, the NAIF code of the camera frame")
    series, frame = attitude_series(job.records, job.camera), job.camera.mission_frame
    if frame is not None:
        series = series.rotate(frame.mission_from_camera(job.camera))
    target = CkTarget(instrument_id=code, frame_name=_frame_name(job.camera, job.options))
    _require_label(series, target.frame_name, job.camera)
    comments = [
        f"{job.camera.name}, {len(job.records)} attitudes from {job.options.pointing}",
        "axes: " + target.frame_name,
        *_acceptances(job),
    ]
    max_gap_s = job.options.max_gap_s if job.options.ck_type == 3 else None
    return write_ck(job.output, series, target, sclk=job.options.sclk, max_gap_s=max_gap_s, comments=comments)


def _acceptances(job: _Job) -> list[str]:
    """Who accepted which suspect attitude, and why."""
    return [plain_line(f"{one.file}: suspect, {one.accepted}") for one in job.records if one.accepted is not None]


def _aem(job: _Job) -> tuple[Path, ...]:
    series, label = attitude_series(job.records, job.camera), job.options.frame_name or "INSTRUMENT_1"
    _require_label(series, label, job.camera)
    write_aem(
        job.output,
        series,
        AemNames(
            object_name=job.options.object_name,
            object_id=job.options.object_id,
            originator=job.options.originator,
            frame=label,
            inertial=job.options.inertial,
        ),
        max_gap_s=job.options.max_gap_s,
        comments=(f"camera {job.camera.name}: +x along columns, +y along rows, +z boresight", *_acceptances(job)),
    )
    return (job.output,)


def _wcs(job: _Job) -> tuple[Path, ...]:
    files = []
    for record in job.records:
        assert record.attitude is not None
        path = job.output / (name_of_file("_".join(Path(record.file).parts)) + ".wcs.fits")
        write_wcs(
            path,
            PosedModel(
                model=job.camera.model,
                columns=job.camera.columns,
                rows=job.camera.rows,
                camera_from_inertial=record.attitude.rotation,
            ),
            et=record.et,
            name=record.file,
            order=job.options.sip_order,
            bottom_up=job.bottom_up,
        )
        files.append(path)
    return tuple(files)


def _single_rows(result: RunResult, camera: Camera) -> Iterator[ObservableRow]:
    """Rows of bodies and landmarks."""
    return (row for row in run_observables(result, camera) if isinstance(row, ObservableRow))


def _tdm(output: Path, rows: Iterable[ObservableRow], options: ExportOptions) -> Exported:
    tracked = tracking_segments(rows, angles=options.angles, spacecraft=options.object_name, frame=options.inertial)
    require(bool(tracked.segments), f"{output}: no observation to write ({_said(tracked.left_out)})")
    make_folder(output.parent)
    write_tdm(output, tracked.segments, originator=options.originator)
    count = sum(len(segment.points) for segment in tracked.segments)
    return Exported(files=(output,), n_observations=count, left_out=tracked.left_out)


def _astrometry(output: Path, result: RunResult, camera: Camera, options: ExportOptions) -> Exported:
    """Write the preferred fixes of bodies for the Minor Planet Center."""
    if options.ades is None:
        raise InputError("ADES needs --ades FILE.toml with a table [ades]: station, submitter, measurers, telescope")
    content, _ = read_toml(
        options.ades, AdesFile, "file", complete=lambda _, table: {"ades": table["ades"]} if "ades" in table else {}
    )
    section = content.ades
    source = AdesSource(
        objects=section.objects,
        n_stars={record.file: record.n_matched or 0 for record in result.attitudes},
        earth_kernel=str(options.ades.parent / section.earth_kernel),
        sigma_position_km=section.sigma_position_km,
        sigma_time_s=section.sigma_time_s,
    )
    context = AdesContext(
        station=section.station,
        submitter=section.submitter,
        measurers=tuple(section.measurers),
        design=section.design,
        aperture_m=section.aperture_m,
        detector=section.detector,
        star_catalog=section.star_catalog,
    )
    found, left_out = astrometry_of(_single_rows(result, camera), source)
    require(bool(found), f"{output}: no observation to write ({_said(left_out)})")
    make_folder(output.parent)
    write_ades(output, context, found)
    return Exported(files=(output,), n_observations=len(found), left_out=left_out)


def _pictures(output: Path, result: RunResult, camera: Camera, options: ExportOptions) -> Exported:
    """Write the pictures with bodies or stars."""
    pictures, left_out = list[PsfPicture](), Counter[str]()
    for _, group in groupby(run_observables(result, camera), key=_file_of):
        picture = picture_of(camera, list(group))
        if isinstance(picture, str):
            left_out[picture] += 1
        else:
            pictures.append(picture)
    require(bool(pictures), f"{output}: no picture to write ({_said(left_out)})")
    make_folder(output.parent)
    count = write_psf(
        output,
        psf_camera(camera),
        pictures,
        spacecraft=options.object_name,
        name=result.name,
        comments=(
            "pixel, line: 0, 0 is the center of the first",
            "ZC: distortion, so that Z - ZC is linear",
            "SIG: all causes for bodies, noise for stars",
        ),
    )
    return Exported(files=(output,), n_observations=count, left_out=left_out)


def _file_of(rows: ObservableRow | ObservableBlock) -> str:
    return str(rows.shared["file"]) if isinstance(rows, ObservableBlock) else rows.file


def _spk(output: Path, result: RunResult, camera: Camera, options: ExportOptions) -> Exported:
    """Write the spacecraft relative to the targets, and beside it the covariances of the positions."""
    spacecraft = options.spacecraft_id
    if spacecraft is None:
        raise InputError("an SPK needs --spacecraft, the NAIF code of the spacecraft")
    arcs, left_out = relative_arcs(_single_rows(result, camera), max_gap_s=options.max_gap_s)
    require(bool(arcs), f"{output}: no arc to write ({_said(left_out)}): is --max-gap shorter than their steps?")
    targets = list(dict.fromkeys(arc.target for arc in arcs))
    require(options.target_id is None or len(targets) == 1, f"--body is for one target, the run has {len(targets)}")
    codes = {target: options.target_id or body_id(target) for target in targets}
    for target, code in codes.items():
        require(code is not None, f"SPICE does not know {target}: give --body, its NAIF code")
    run = hashlib.sha256(json.dumps(RunFolder.open(result.folder).provenance(), sort_keys=True).encode()).hexdigest()
    make_folder(output.parent)
    segments = [
        SpkArc(
            body=spacecraft,
            center=codes[arc.target] or 0,
            et=arc.et,
            states=arc.states,
            name=f"{'+'.join(arc.estimators)[:29]} {run[:10]}",
        )
        for arc in arcs
    ]
    write_spk(output, segments, [f"{result.name}: measured positions, geometric; run {run}"])
    files, lower = [output], np.tril_indices(3)
    for target in targets:
        files.append(output.with_name(f"{output.stem}_{name_of_file(target)}.csv"))
        known = [
            [et, *covariance[lower].tolist()]
            for arc in arcs
            for et, covariance in zip(arc.et.tolist(), arc.covariances_km2, strict=True)
            if arc.target == target and np.isfinite(covariance).all()
        ]
        write_csv_rows(files[-1], ("et", *COLUMNS[: lower[0].size]), known)
    return Exported(files=tuple(files), n_observations=sum(arc.et.size for arc in arcs), left_out=left_out)


def _sumfiles(output: Path, rows: Iterable[ObservableRow], camera: Camera, landmarks: Path | None) -> Exported:
    """Write a SUMFILE for each preferred position, with the landmarks of any fix, and LMK files of known maps."""
    maps = {} if landmarks is None else {one.name: one for one in load_landmarks(landmarks).landmarks}
    lmks = dict[str, Lmk]()
    make_folder(output)
    files, left_out = list[Path](), 0
    for (file, target), group in groupby(rows, key=lambda row: (row.file, row.target)):
        members = list(group)
        body = next((row for row in members if row.kind == "body" and row.preferred), None)
        if target is None:
            continue
        if body is None or body.apparent_position_icrf_km is None or body.epoch_et_s is None:
            left_out += 1
            continue
        path = output / (name_of_file(f"{'_'.join(Path(file).with_suffix('').parts)}_{target}") + ".SUM")
        require(path not in files, f"{path.name}: two images or targets would have this file: export them one by one")
        marks = [row for row in members if row.kind == "landmark"]
        content = sumfile_of(camera, body, marks)
        write_sumfile(path, content)
        files.append(path)
        if landmarks is not None:
            for row in marks:
                with prefix_errors(f"{landmarks}: "):
                    lmk = lmk_of(row, maps, content.name, lmks.get(row.feature or ""))
                lmks[lmk.name] = lmk
    for name, lmk in lmks.items():
        make_folder(output / "LMKFILES")
        files.append(output / "LMKFILES" / f"{name_of_file(name)}.LMK")
        write_lmk(files[-1], lmk)
    require(bool(files), f"{output}: no position to write ({left_out} targets in images without one that is preferred)")
    return Exported(
        files=tuple(files),
        n_observations=len(files) - len(lmks),
        left_out={"no preferred position": left_out} if left_out else {},
    )


def _require_label(series: AttitudeSeries, label: str, camera: Camera) -> None:
    """Refuse to write attitudes under a name that is known to denote the other of the camera's two frames."""
    mission = "" if camera.mission_frame is None else camera.mission_frame.name
    if label in (camera.frame_name, mission):
        require_same_frame(series.frame, label)


def _frame_name(camera: Camera, options: ExportOptions) -> str:
    """A name that SPICE takes: given, of the mission's frame, or made of the camera's."""
    if options.frame_name is not None:
        return options.frame_name
    if camera.mission_frame is not None:
        return camera.mission_frame.name
    letters = "".join(c if c.isascii() and c.isalnum() else "_" for c in camera.name.upper())
    return f"GL_{letters}"[:26]


_WRITERS: Mapping[ExportFormat, Callable[[_Job], tuple[Path, ...]]] = MappingProxyType(
    {ExportFormat.CSV: _csv, ExportFormat.CK: _ck, ExportFormat.AEM: _aem, ExportFormat.WCS: _wcs}
)
