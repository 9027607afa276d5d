"""Errors that all images of a run have in common, which no single image shows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from giantlike.camera import Camera
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.store.records import AttitudeRecord, ObservationRecord
from giantlike.campaign.store.results import group_by
from giantlike.core.arrays import Float
from giantlike.core.frames import rotate
from giantlike.core.time import time_from_et

_SIGNIFICANT = 5.0  # number of standard deviations from which an error is named
_EXPLAINED = 0.25  # residual rms with a time offset over that without, below which it explains the residuals
_MIN_IMAGES = 3
_LIGHT_FACTOR = 3.0  # largest error of a declared zero point with the colors of the stars, 1.2 mag: a prior
_GPS_FROM_TAI_S = -19.0


def find_common_errors(
    campaign: Campaign, attitudes: Sequence[AttitudeRecord], observations: Sequence[ObservationRecord]
) -> list[str]:
    """Sentences on errors that the images of a run have in common."""
    return [
        *_overlapping_exposures(attitudes),
        *_exposure_units(campaign, attitudes),
        *_apriori_errors(campaign, attitudes),
        *_time_offsets(campaign, attitudes, observations),
    ]


def _overlapping_exposures(attitudes: Sequence[AttitudeRecord]) -> Iterator[str]:
    """Exposures that last into the next one, as if milliseconds were read as seconds."""
    spans = sorted(
        (record.et - record.exposure_s / 2.0, record.exposure_s, record.file)
        for record in attitudes
        if record.et is not None and record.exposure_s is not None
    )
    gaps = np.diff([start for start, _, _ in spans])
    lengths = np.array([length for _, length, _ in spans[:-1]])
    overlapping = np.flatnonzero((gaps < lengths) & (gaps > 0.0))
    if overlapping.size == 0:
        return
    first = int(overlapping[0])
    text = (
        f"{overlapping.size} exposures last into the next one ({spans[first][2]}: {lengths[first]:g} s, and the next "
        f"begins {gaps[first]:.4g} s later)"
    )
    if (gaps[overlapping] > lengths[overlapping] / 1000.0).all():
        text += "; with the exposures divided by 1000 they do not: are they in ms?"
    yield text


def _exposure_units(campaign: Campaign, attitudes: Sequence[AttitudeRecord]) -> Iterator[str]:
    """Exposures for which the stars are a thousand times too faint or too bright for the declared zero point."""
    found = [record.star_zero_point_e_s for record in attitudes if record.star_zero_point_e_s]
    if campaign.camera.photometry is None or not found:
        return
    ratio = float(np.median(found)) / campaign.camera.photometry.zero_point_e_s
    for change, factor in (("divided", 1e-3), ("multiplied", 1e3)):
        if 1.0 / _LIGHT_FACTOR < ratio / factor < _LIGHT_FACTOR:
            yield (
                f"the stars have {ratio:.2g} times the signal that the zero point and the exposures give; with the "
                f"exposures {change} by 1000 they have {ratio / factor:.2g} times: are they in ms?"
            )


def _apriori_errors(campaign: Campaign, attitudes: Sequence[AttitudeRecord]) -> Iterator[str]:
    """A priori attitudes that are much farther from those of the stars than their declared sigma."""
    sigma = campaign.apriori_sigma_rad
    errors = [
        (record.attitude.rotation * record.apriori.inv()).magnitude()
        for record in attitudes
        if record.attitude is not None and record.apriori is not None and record.attitude.source == "stars"
    ]
    if sigma is None or len(errors) < _MIN_IMAGES:
        return
    rms = math.sqrt(float(np.mean(np.square(errors))) / 3.0)
    if rms > _SIGNIFICANT * sigma:
        yield (
            f"the a priori attitudes differ from those of the stars by {math.degrees(rms):.2g} deg per axis, "
            f"{rms / sigma:.2g} times images.attitude_sigma_deg"
        )


def _time_offsets(
    campaign: Campaign, attitudes: Sequence[AttitudeRecord], observations: Sequence[ObservationRecord]
) -> Iterator[str]:
    """Offset of the epochs that explains the positions of a target in all images."""
    epochs = {record.file: record.et for record in attitudes}
    exposures = {record.exposure_s for record in attitudes}
    half_s = 0.5 * (exposures.pop() or 0.0) if len(exposures) == 1 else 0.0
    for target in campaign.targets:
        fixes = [
            min(ones, key=lambda one: float(np.trace(one.covariance_px2 or np.eye(2))))
            for ones in group_by(
                (one for one in observations if one.target == target.name and _is_usable(one)), lambda one: one.file
            ).values()
        ]
        fixes = sorted(
            (one for one in fixes if epochs.get(one.file) is not None), key=lambda one: epochs[one.file] or 0
        )
        et = np.array([epochs[one.file] for one in fixes], dtype=np.float64)
        if len(fixes) < _MIN_IMAGES or not (np.diff(et) > 0.0).all():
            continue
        found = _fit_offset(campaign.camera, fixes, et, target.uncertainty.ephemeris_km)
        if found is None:
            continue
        offset_s, sigma_s, without_px, with_px = found
        if abs(offset_s) > _SIGNIFICANT * sigma_s and with_px < _EXPLAINED * without_px:
            yield (
                f"{target.name}: a time offset of {offset_s:+.4g} +- {sigma_s:.1g} s common to all {len(fixes)} images "
                f"explains the positions (residual rms {with_px:.2g} px with it, {without_px:.2g} px without)"
                f"{_name_of_offset(offset_s, sigma_s, float(et[0]), half_s)}; or its ephemeris is off along the track"
            )


def _is_usable(record: ObservationRecord) -> bool:
    return not (record.center_px is None or record.predicted_px is None or record.attitude is None) and bool(
        record.covariance_px2
    )


def _fit_offset(
    camera: Camera, fixes: Sequence[ObservationRecord], et: Float, ephemeris_km: float
) -> tuple[float, float, float, float] | None:
    """Time offset, s, its sigma, and the residual rms, px, without and with it; the ephemeris is estimated too."""
    predicted = np.array([one.predicted_px for one in fixes])
    turns = [one.attitude.rotation for one in fixes if one.attitude is not None]
    rays = camera.model.unproject(predicted)
    inertial = np.array([rotate(turn.inv(), ray) for turn, ray in zip(turns, rays, strict=True)])
    if not np.isfinite(inertial).all():
        return None
    rates = np.gradient(inertial, et, axis=0)
    rows, data = list[Float](), list[Float]()
    for fix, turn, ray, rate, place in zip(fixes, turns, rays, rates, predicted, strict=True):
        by_ray = camera.model.project_jacobian(ray) @ turn.as_matrix()
        design = (by_ray @ rate)[:, None]
        if ephemeris_km > 0.0 and fix.range_km:
            design = np.hstack([design, by_ray * (ephemeris_km / fix.range_km)])
        whiten = np.linalg.inv(np.linalg.cholesky(np.array(fix.covariance_with_attitude_px2 or fix.covariance_px2)))
        rows.append(whiten @ design)
        data.append(whiten @ (np.array(fix.center_px) - place))
    if len({row.shape for row in rows}) != 1:
        return None
    matrix, measured = np.vstack(rows), np.concatenate(data)
    prior = np.eye(matrix.shape[1])[1:]  # of the displacement, in units of its sigma
    full, zeros = np.vstack([matrix, prior]), np.zeros(len(prior))
    values = np.linalg.lstsq(full, np.concatenate([measured, zeros]), rcond=None)[0]
    residuals = measured - matrix @ values
    inflation = max(1.0, float(residuals @ residuals) / (measured.size - 1))
    sigma_s = math.sqrt(float(np.linalg.pinv(full.T @ full)[0, 0]) * inflation)
    offsets = np.array([one.center_px for one in fixes]) - predicted
    moved = np.array(
        [
            camera.model.project_jacobian(ray) @ turn.as_matrix() @ rate
            for turn, ray, rate in zip(turns, rays, rates, strict=True)
        ]
    )
    rms = [float(np.sqrt(np.mean(np.sum(one**2, axis=1)))) for one in (offsets, offsets - moved * values[0])]
    return float(values[0]), sigma_s, rms[0], rms[1]


def _name_of_offset(offset_s: float, sigma_s: float, et: float, half_exposure_s: float) -> str:
    """Pair of time scales that differ by an offset, or half the exposure, in words; empty for none."""
    if half_exposure_s and abs(abs(offset_s) - half_exposure_s) < 3.0 * sigma_s:
        return ", half of the exposure: are the dates those of its start or of its middle?"
    epoch = time_from_et(et)
    utc, tai, tdb = (float(one.jd1 - epoch.jd1) + float(one.jd2) for one in (epoch.utc, epoch.tai, epoch.tdb))
    tai_s, tdb_s = (tai - utc) * 86400.0, (tdb - utc) * 86400.0
    for name, apart_s in (("TDB", tdb_s), ("TAI", tai_s), ("GPS time", tai_s + _GPS_FROM_TAI_S)):
        for words, sign in ((f"dates in {name} labeled UTC", -1.0), (f"dates in UTC labeled {name}", 1.0)):
            if abs(offset_s - sign * apart_s) < max(3.0 * sigma_s, 0.5):
                return f", as of {words} ({sign * apart_s:+.3f} s)"
    return ""
