"""Comparison of a run with another team's attitudes or observables in CSV, angles in a TDM, C-kernel or trajectory."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike._system.reading import check, reads
from giantlike.camera import Camera
from giantlike.campaign.compare.differences import Difference, ResultComparison, differences_of
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord
from giantlike.campaign.store.results import RunResult, camera_of_run, load_result
from giantlike.core.arrays import Float, require
from giantlike.core.errors import DataError, InputError
from giantlike.core.frames import direction_from_radec, rotate, rotation_between, rotation_from_xyzw
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.core.units import ARCSEC_PER_RAD, RAD_PER_DEG
from giantlike.io.attitude_series import read_attitude_table
from giantlike.io.ccsds_tdm import ABERRATION_REMOVED
from giantlike.io.csv_rows import CsvRow, read_csv_rows
from giantlike.io.spice import attitude as spice_attitude
from giantlike.io.spice import load_kernels

_SAME_TIME_S = 0.05  # epochs at most so far apart are the same; chosen without a study: files round to milliseconds
_OBSERVABLES = (
    *("file", "epoch_utc", "et", "target", "x_px", "y_px", "sigma_x_px", "sigma_y_px"),
    *("ra_deg", "dec_deg", "sigma_arcsec", "range_km", "sigma_range_km"),
)
"""Columns of a table of observables; ``x_px, y_px`` or ``ra_deg, dec_deg`` (apparent, ICRF), the rest where known."""


_SPACES = r"[^\S\n]*+"
_META_START = re.compile(rf"^{_SPACES}META_START{_SPACES}$", re.MULTILINE)
_TDM_ITEM = re.compile(rf"^{_SPACES}([A-Z_0-9]++){_SPACES}={_SPACES}(.*+)$", re.MULTILINE)
_TDM_ANGLE = re.compile(rf"^{_SPACES}(ANGLE_[12]){_SPACES}={_SPACES}(\S++){_SPACES}(\S++)", re.MULTILINE)
"""Lines of a TDM: each is looked at once."""
_FULL_TURN_DEG = 360.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ExternalOptions:
    """Options that SPICE files do not contain."""

    kernels: tuple[str, ...] = ()  # paths or patterns, beside the file: leap seconds, clock, frames, planets
    frame: str | None = None  # C-kernel: frame of the camera in them
    camera_from_frame_xyzw: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)  # from that frame to the camera axes, scalar last
    spacecraft: str | None = None  # spacecraft, body: trajectory: NAIF names or codes; body if not the target
    body: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Seen:
    """A direction or position of the other side; None for values that it does not give."""

    file: str | None
    et: float | None
    target: str | None
    pixel: Float | None = None
    sigma_px: Float | None = None
    direction_inertial: Float | None = None
    sigma_rad: float | None = None
    range_km: float | None = None
    sigma_range_km: float | None = None


@dataclass(frozen=True, slots=True)
class _Run:
    """A run and its camera."""

    result: RunResult
    camera: Camera

    @property
    def fixes(self) -> list[ObservationRecord]:
        """Observations that have a center."""
        return [record for record in self.result.observations if record.center_px is not None]

    @property
    def et(self) -> dict[str, float]:
        """Epochs by image."""
        return {record.file: record.et for record in self.result.attitudes if record.et is not None}


def compare_external(folder: Path, other: Path, options: ExternalOptions = ExternalOptions()) -> ResultComparison:
    """Compare a run with a file of another team."""
    result = load_result(folder)
    run = _Run(result, camera_of_run(folder))
    suffix = other.suffix.lower()
    if suffix == ".csv":
        differences, count = _csv(run, other)
    elif suffix in (".tdm", ".kvn", ".txt"):
        differences, count = _observables(run, _tdm(other))
    elif suffix == ".bc":
        differences, count = _c_kernel(run, other, options)
    elif suffix == ".bsp":
        differences, count = _trajectory(run, other, options)
    else:
        raise InputError(f"{other}: give another run folder, or a .csv, .tdm, .bc or .bsp file")
    if not differences:
        raise InputError(
            f"{folder} and {other}: nothing to compare: no result of the run has a counterpart of the same image, or "
            f"within {_SAME_TIME_S} s of its epoch"
        )
    return ResultComparison(
        first=str(folder),
        second=str(other),
        differences=tuple(differences),
        shared=tuple(_maybe_shared(suffix)),
        only_first=len({one.file for one in differences} ^ set(run.et)) if suffix == ".bc" else 0,
        only_second=count,
        notes=tuple(_notes(suffix)),
    )


def _maybe_shared(suffix: str) -> Iterator[str]:
    if suffix == ".bsp":
        yield "the run's own observables, if the trajectory was fitted to them: it does not say"
        yield "shape and pole, where the trajectory was fitted to images of the body"
        return
    yield "noise of the pixels, if both used the same images: the sigma of a difference is then too large"
    yield "catalog and camera model, if both used the same"


def _notes(suffix: str) -> Iterator[str]:
    if suffix != ".csv":
        yield "the other file states no covariance: sigmas are those of the run alone"
    if suffix not in (".csv", ".bc", ".bsp"):
        yield "angles are taken as apparent: light time and stellar aberration in"


# --- attitudes -------------------------------------------------------------------------------------------------------


def _csv(run: _Run, path: Path) -> tuple[list[Difference], int]:
    """Attitudes or observables, by the columns of the table."""
    try:
        header = path.read_text(encoding="utf-8-sig").partition("\n")[0]
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(path, f"cannot be read: {error}") from error
    if "qx" not in {name.strip() for name in header.split(",")}:
        return _observables(run, _rows(path))
    series, untimed = read_attitude_table(path)
    known = (
        [] if series is None else zip(series.names, series.camera_from_inertial, series.covariance_rad2, strict=True)
    )
    theirs = [*known, *((one.name, one.camera_from_inertial, one.covariance_rad2) for one in untimed)]
    names = {name: k for k, (name, _, _) in enumerate(theirs)}
    differences: list[Difference] = []
    matched = set()
    for record in run.result.attitudes:
        k = names.get(record.file, None if series is None else _nearest(record.et, series.et))
        if k is None or record.attitude is None:
            continue
        matched.add(k)
        differences += _attitude(record, *theirs[k][1:])
    return differences, len(theirs) - len(matched)


def _c_kernel(run: _Run, path: Path, options: ExternalOptions) -> tuple[list[Difference], int]:
    frame = options.frame
    if frame is None:
        raise InputError(f"{path}: give --frame, the name of the camera's frame in the kernels")
    turn = rotation_from_xyzw(list(options.camera_from_frame_xyzw), "--camera-from-frame")
    differences: list[Difference] = []
    uncovered = 0
    with load_kernels([*options.kernels, str(path.absolute())], "."):
        for record in run.result.attitudes:
            if record.et is None or record.attitude is None:
                continue
            try:
                pointing = turn * spice_attitude(frame, record.et)
            except DataError:
                uncovered += 1
                continue
            differences += _attitude(record, pointing, np.zeros((3, 3)))
    if not differences and uncovered:
        raise InputError(
            f"{path}: has no attitude of {frame} at the epochs of the run; are clock and frame kernels given?"
        )
    return differences, 0


def _attitude(record: AttitudeRecord, other: Rotation, covariance_rad2: Float) -> Iterable[Difference]:
    assert record.attitude is not None
    own = record.attitude.covariance_rad2
    covariance = None
    if own is not None and np.isfinite(covariance_rad2).all():
        covariance = (np.array(own) + covariance_rad2) * ARCSEC_PER_RAD**2
    turn = rotation_between(other, record.attitude.rotation) * ARCSEC_PER_RAD
    return differences_of(record.file, "attitude", ("x", "y", "z"), turn, covariance, "arcsec")


# --- observables -----------------------------------------------------------------------------------------------------


def _rows(path: Path) -> list[_Seen]:
    """Observables of a table."""
    return [_row(row) for row in read_csv_rows(path, _OBSERVABLES, ())]


def _row(row: CsvRow) -> _Seen:
    known = row.text("epoch_utc") is not None or row.text("et") is not None
    if row.text("file") is None and not known:
        raise row.error("file", "file or epoch_utc is needed to find the image")
    pixel, angles = row.vector(("x_px", "y_px")), row.vector(("ra_deg", "dec_deg"))
    sigma = row.number("sigma_arcsec")
    return _Seen(
        file=row.text("file"),
        et=row.et() if known else None,
        target=row.text("target"),
        pixel=pixel,
        sigma_px=row.vector(("sigma_x_px", "sigma_y_px")),
        direction_inertial=None if angles is None else direction_from_radec(*angles.tolist()),
        sigma_rad=None if sigma is None else sigma / ARCSEC_PER_RAD,
        range_km=row.number("range_km"),
        sigma_range_km=row.number("sigma_range_km"),
    )


def _tdm(path: Path) -> list[_Seen]:
    """Pairs of right ascension and declination of a CCSDS TDM in its keyword form."""
    seen, is_apparent = _read_tdm(path)
    require(
        is_apparent,
        f"{path}: a comment says that {ABERRATION_REMOVED} from its angles, but apparent ones are compared: write "
        "it with giantlike export --format tdm --angles apparent",
    )
    return seen


@reads("a CCSDS TDM")
def _read_tdm(path: Path) -> tuple[list[_Seen], bool]:
    """Pairs of right ascension and declination of a CCSDS TDM, and True where they are apparent."""
    text = path.read_text(encoding="utf-8")
    if "CCSDS_TDM_VERS" not in text:
        raise DataError(path, "is no CCSDS TDM in keyword form: it has no CCSDS_TDM_VERS")
    seen = list[_Seen]()
    for segment in _META_START.split(text)[1:]:
        meta = {key: value.strip() for key, value in _TDM_ITEM.findall(segment.partition("DATA_START")[0])}
        if meta.get("ANGLE_TYPE") != "RADEC":
            continue
        if meta.get("REFERENCE_FRAME", "ICRF") not in ("ICRF", "GCRF", "EME2000"):
            raise DataError(path, f"REFERENCE_FRAME {meta['REFERENCE_FRAME']}: angles are in ICRF, GCRF or EME2000")
        angles: dict[str, dict[str, float]] = {}
        for name, epoch, value in _TDM_ANGLE.findall(segment):
            check(abs(float(value)) <= _FULL_TURN_DEG, f"{name} is an angle in degrees, found {value}")
            angles.setdefault(epoch, {})[name] = float(value)
        seen += [
            _Seen(
                file=None,
                et=et_from_time(time_from_utc(epoch)),
                target=meta.get("PARTICIPANT_2"),
                direction_inertial=direction_from_radec(pair["ANGLE_1"], pair["ANGLE_2"]),
            )
            for epoch, pair in angles.items()
            if len(pair) == 2
        ]
    return seen, ABERRATION_REMOVED not in text


def _observables(run: _Run, seen: Sequence[_Seen]) -> tuple[list[Difference], int]:
    """Differences of all fixes to their counterparts."""
    by_name = {(one.file, one.target): k for k, one in enumerate(seen) if one.file is not None}
    times = np.array([math.nan if one.et is None else one.et for one in seen])
    differences: list[Difference] = []
    matched = set()
    for record in run.fixes:
        k = by_name.get((record.file, record.target), by_name.get((record.file, None)))
        if k is None:
            same = np.array([one.target in (None, record.target) for one in seen], dtype=bool)
            k = _nearest(run.et.get(record.file), np.where(same, times, math.nan))
        if k is not None:
            matched.add(k)
            differences += _fix(run, record, seen[k])
    return differences, len(seen) - len(matched)


def _fix(run: _Run, record: ObservationRecord, other: _Seen) -> Iterator[Difference]:
    what, center = f"{record.target}: {record.estimator}", np.array(record.center_px)
    with_attitude = record.covariance_with_attitude_px2 or record.covariance_px2
    if other.pixel is not None:
        own = None if record.covariance_px2 is None else np.array(record.covariance_px2)
        both = None if own is None or other.sigma_px is None else own + np.diag(other.sigma_px**2)
        yield from differences_of(record.file, what, ("x", "y"), center - other.pixel, both, "px")
    elif other.direction_inertial is not None and record.attitude is not None:
        place = run.camera.model.project(rotate(record.attitude.rotation, other.direction_inertial))
        own = None if with_attitude is None else np.array(with_attitude)
        spread = np.zeros((2, 2))
        if other.sigma_rad is not None:
            spread = (other.sigma_rad * (run.camera.columns / (run.camera.fov_deg * RAD_PER_DEG))) ** 2 * np.eye(2)
        yield from differences_of(
            record.file, what, ("x", "y"), center - place, None if own is None else own + spread, "px"
        )
    if other.range_km is not None and record.range_km is not None:
        sigmas = (record.sigma_range_km, other.sigma_range_km)
        known = [sigma for sigma in sigmas if sigma is not None]
        covariance = np.array([[sum(sigma**2 for sigma in known)]]) if record.sigma_range_km is not None else None
        values = np.array([record.range_km - other.range_km])
        yield from differences_of(record.file, what, ("range",), values, covariance, "km")


def _trajectory(run: _Run, path: Path, options: ExternalOptions) -> tuple[list[Difference], int]:
    """Fixes compared with the positions from a trajectory, with light time and stellar aberration."""
    import spiceypy
    from spiceypy.utils.exceptions import SpiceyError

    require(options.spacecraft is not None, f"{path}: give --spacecraft, its NAIF name or code")
    et, seen = run.et, list[_Seen]()
    with load_kernels([*options.kernels, str(path.absolute())], "."):
        for file, target in dict.fromkeys((record.file, record.target) for record in run.fixes):
            if file not in et:
                continue
            try:
                position, _ = spiceypy.spkpos(options.body or target, et[file], "J2000", "CN+S", options.spacecraft)
            except SpiceyError as error:
                raise InputError(
                    f"{path}: no apparent place of {options.body or target} seen from {options.spacecraft} at {file}: "
                    f"{' '.join(str(error.short).split())}; give the kernels between them, such as planets, by "
                    "--kernel, and --body"
                ) from error
            range_km = float(np.linalg.norm(position))
            seen.append(
                _Seen(file=file, et=et[file], target=target, direction_inertial=position / range_km, range_km=range_km)
            )
    return _observables(run, seen)


def _nearest(et: float | None, times: NDArray[np.float64]) -> int | None:
    """Index of the nearest of some times; None if it is too far off, or there is none."""
    if et is None or not np.isfinite(times).any():
        return None
    k = int(np.nanargmin(np.abs(times - et)))
    return k if abs(times[k] - et) <= _SAME_TIME_S else None
