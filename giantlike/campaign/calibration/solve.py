"""Calibration within a campaign: records to star images, the camera that comes out, and its files."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.calibration import AlignmentResult, align, calibrate_stars
from giantlike.calibration.result import CalibrationResult
from giantlike.calibration.star_images import StarCalibration, StarImage
from giantlike.calibration.statistics import residual_statistics
from giantlike.camera import Camera, ModelUncertainty
from giantlike.camera_models import model_to_mapping
from giantlike.campaign.file.config import Campaign, ImageEntry
from giantlike.campaign.file.schema import CalibrationSection
from giantlike.campaign.store.records import CalibrationRecord
from giantlike.campaign.store.run_folder import CALIBRATION_FILE, CALIBRATION_PAGE, CAMERA_FILE, RESIDUALS_FILE
from giantlike.catalogs import StarCatalog
from giantlike.core.atomic import write_text_atomic
from giantlike.core.errors import DataError
from giantlike.core.frames import quaternion_xyzw
from giantlike.core.outcomes import Failure
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.core.values import Value
from giantlike.image import Image
from giantlike.stars import Sky, StarOptions

NO_STAR_IMAGE = "is no star image: its exposure is shorter than stars.long_exposure_s"
_COLUMNS = (
    "file", "star", "x_px", "y_px", "predicted_x_px", "predicted_y_px", "sigma_px", "magnitude", "temperature_c",
    "used",
)  # fmt: skip
_FEWEST_FOR_DRIFT = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CampaignCalibration(Value):
    """What calibration made of a campaign.

    Parameters
    ----------
    outcome : StarCalibration or Failure
    camera : Camera or None
        The calibrated camera; None where there is none, or where it was not accepted.
    alignment : AlignmentResult or None
        Of the camera with respect to the a priori attitudes, where images have them.
    lost : tuple of (str, str)
        Images that did not take part, and why.
    targets : str
        What was observed, in a word for people: stars, or corners of a board.
    """

    outcome: StarCalibration | Failure
    camera: Camera | None
    alignment: AlignmentResult | None
    lost: tuple[tuple[str, str], ...]
    targets: str = "stars"

    @property
    def problem(self) -> str | None:
        """Why the campaign goes on with the camera it had; None when it has a calibrated one."""
        if isinstance(self.outcome, Failure):
            return f"calibration failed: {self.outcome.reason}: {self.outcome.detail}"
        if self.camera is None:
            return f"calibration not accepted: {'; '.join(self.outcome.result.problems)}"
        return None


def temperature_of(image: Image, keyword: str | None) -> float:
    """Temperature, Celsius, in the header of an image; 0 where no keyword is asked for.

    Raises
    ------
    DataError
        The header has no such number.
    """
    if keyword is None:
        return 0.0
    value = image.metadata.get(keyword)
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise DataError(
            image.path or image.name, f"header keyword {keyword!r} is needed as a temperature, got {value!r}"
        )
    return number


def record_of_stars(entry: ImageEntry, stars: StarImage, apriori: Rotation | None) -> CalibrationRecord:
    """Plain values of a star image."""
    sky = stars.sky
    return CalibrationRecord(
        index=entry.index,
        file=entry.key,
        et=sky.et,
        observer_position_km=None if sky.observer_position_km is None else sky.observer_position_km.tolist(),
        observer_velocity_km_s=None if sky.observer_velocity_km_s is None else sky.observer_velocity_km_s.tolist(),
        temperature_c=stars.temperature_c,
        apriori_xyzw=None if apriori is None else quaternion_xyzw(apriori).tolist(),
        quaternion_xyzw=quaternion_xyzw(stars.camera_from_inertial).tolist(),
        focal_length_px=stars.focal_length_px,
        points_px=stars.points_px.tolist(),
        covariance_px2=stars.covariance_px2.tolist(),
        snr=stars.snr.tolist(),
        star_ids=stars.star_ids.tolist(),
        source_indices=stars.source_indices.tolist(),
        sigma_px=stars.sigma_px.tolist(),
    )


def _stars_of(record: CalibrationRecord, catalog: StarCatalog, options: StarOptions) -> StarImage:
    position, velocity = record.observer_position_km, record.observer_velocity_km_s
    return StarImage(
        name=record.file,
        sky=Sky(
            catalog=catalog,
            et=record.et,
            observer_position_km=None if position is None else np.array(position),
            observer_velocity_km_s=None if velocity is None else np.array(velocity),
            max_magnitude=options.max_magnitude,
        ),
        points_px=np.array(record.points_px),
        covariance_px2=np.array(record.covariance_px2),
        snr=np.array(record.snr),
        camera_from_inertial=Rotation.from_quat(record.quaternion_xyzw),
        focal_length_px=record.focal_length_px,
        star_ids=np.array(record.star_ids, dtype=np.int64),
        source_indices=np.array(record.source_indices, dtype=np.int64),
        sigma_px=np.array(record.sigma_px),
        temperature_c=record.temperature_c,
    )


def calibrate_campaign(
    campaign: Campaign, setup: CalibrationSection, records: Sequence[CalibrationRecord], catalog: StarCatalog
) -> CampaignCalibration:
    """Calibrate the camera of a campaign from the first identification of its star images.

    Parameters
    ----------
    campaign : Campaign
    setup : CalibrationSection
    records : sequence of CalibrationRecord
    catalog : StarCatalog
    """
    assert campaign.stars is not None
    options = campaign.stars.options
    outcome = calibrate_stars(
        [_stars_of(record, catalog, options) for record in records if record.problem is None],
        campaign.camera,
        estimate=setup.estimate,
        model_type=setup.model,
        min_snr=setup.min_snr,
        stars=options,
        options=setup.options,
        criteria=setup.criteria,
    )
    lost = [
        (record.file, f"{record.problem.reason}: {record.problem.detail}")
        for record in records
        if record.problem is not None and record.problem.detail != NO_STAR_IMAGE
    ]
    if isinstance(outcome, Failure):
        return CampaignCalibration(outcome=outcome, camera=None, alignment=None, lost=tuple(lost))
    lost += [(name, f"{failure.reason}: {failure.detail}") for name, failure in outcome.failed]
    camera = calibrated_camera(campaign.camera, outcome.result) if outcome.result.accepted else None
    return CampaignCalibration(
        outcome=outcome, camera=camera, alignment=_alignment(outcome.result, records), lost=tuple(lost)
    )


def calibrated_camera(camera: Camera, fix: CalibrationResult) -> Camera:
    """Camera with the model of a calibration and its covariance."""
    uncertainty = ModelUncertainty(
        estimated=fix.estimated,
        covariance=fix.covariance,
        residual_sigma_px=fix.residual_sigma_px,
        n_observations=fix.n_used,
        n_images=sum(image.n_used > 0 for image in fix.images),
    )
    return dataclasses.replace(camera, model=fix.model, uncertainty=uncertainty)


def _alignment(fix: CalibrationResult, records: Sequence[CalibrationRecord]) -> AlignmentResult | None:
    """Camera with respect to the a priori attitudes; with a drift where temperatures differ."""
    apriori = {record.file: record.apriori_xyzw for record in records if record.apriori_xyzw is not None}
    images = [image for image in fix.images if image.n_used > 0 and image.name in apriori]
    if not images:
        return None
    before = Rotation.from_quat([apriori[image.name] for image in images])
    after = Rotation.concatenate([image.camera_from_reference for image in images])
    temperatures = np.array([image.temperature_c for image in images])
    drifts = len(images) >= _FEWEST_FOR_DRIFT and np.ptp(temperatures) > 0
    found = align(
        after * before.inv(),
        np.array([image.covariance_rad2 for image in images]),
        temperatures_c=temperatures if drifts else None,
    )
    return None if isinstance(found, Failure) else found


def write_calibration(folder: Path, result: CampaignCalibration) -> bool:
    """Write ``camera.toml`` (when accepted), ``calibration.json`` and the table of residuals.

    Returns
    -------
    bool
        Whether this changed what an earlier run left there, so that the report must be written again.

    Raises
    ------
    DataError
        A file cannot be written.
    """
    if result.camera is not None:
        result.camera.save(folder / CAMERA_FILE)
    else:
        (folder / CAMERA_FILE).unlink(missing_ok=True)
    content = json.dumps(calibration_summary(result), indent=1, default=str) + "\n"
    path = folder / CALIBRATION_FILE
    if (folder / CALIBRATION_PAGE).exists() and path.exists() and path.read_text(encoding="utf-8") == content:
        return False
    (folder / CALIBRATION_PAGE).unlink(missing_ok=True)
    write_text_atomic(path, content)
    if isinstance(result.outcome, StarCalibration):
        write_text_atomic(folder / RESIDUALS_FILE, _residual_table(result.outcome.result))
    return True


def calibration_summary(result: CampaignCalibration) -> dict[str, Any]:
    """Return everything about a calibration but its single observations, as JSON has it; what is unknown is None."""
    content: dict[str, Any] = {
        "status": "failed" if isinstance(result.outcome, Failure) else "ok" if result.camera else "not_accepted",
        "problem": result.problem,
        "targets": result.targets,
        "images_lost": [{"file": name, "problem": problem} for name, problem in result.lost],
    }
    if isinstance(result.outcome, Failure):
        return content
    fix, everything = result.outcome.result, result.outcome.all_stars
    return content | {
        "model": model_to_mapping(fix.model),
        "estimated": list(fix.estimated),
        "covariance": fix.covariance.tolist(),
        "covariance_scale": fix.covariance_scale,
        "parameters": [dataclasses.asdict(one) for one in fix.support],
        "rms_px": fix.rms_px,
        "residual_sigma_px": fix.residual_sigma_px,
        "reduced_chi2": fix.reduced_chi2,
        "condition_number": fix.condition_number,
        "map_sigma_max_px": float(fix.map_sigma_px.max()),
        "n_used": fix.n_used,
        "n_rejected": fix.n_rejected,
        "all_stars": None if everything is None else dataclasses.asdict(everything),
        "rounds": result.outcome.rounds,
        "settled": result.outcome.settled,
        "problems": list(fix.problems),
        "images": [
            {
                "file": image.name,
                "temperature_c": image.temperature_c,
                "n_used": image.n_used,
                "n_rejected": image.n_rejected,
                "rms_px": _number(image.rms_px),
                "influence_px": _number(image.influence_px),
                "influence": _number(image.influence),
            }
            for image in fix.images
        ],
        "rejected": [{name: _number(value) for name, value in dataclasses.asdict(one).items()} for one in fix.rejected],
        "residuals": [dataclasses.asdict(group) for group in residual_statistics(fix)],
        "alignment": None if result.alignment is None else _alignment_summary(result.alignment),
    }


def _alignment_summary(alignment: AlignmentResult) -> dict[str, Any]:
    return {
        "camera_from_apriori_xyzw": quaternion_xyzw(alignment.rotation).tolist(),
        "rotation_arcsec": (ARCSEC_PER_RAD * alignment.rotation.as_rotvec()).tolist(),
        "sigma_arcsec": (ARCSEC_PER_RAD * np.sqrt(np.diag(alignment.covariance_rad2))).tolist(),
        "rate_arcsec_per_c": (ARCSEC_PER_RAD * alignment.rate_rad_per_c).tolist(),
        "sigma_rate_arcsec_per_c": (ARCSEC_PER_RAD * np.sqrt(np.diag(alignment.rate_covariance))).tolist(),
        "reference_c": alignment.reference_c,
        "n_used": int(alignment.used.sum()),
        "n_rejected": int((~alignment.used).sum()),
        "reduced_chi2": alignment.reduced_chi2,
    }


def _number(value: Any) -> Any:
    """The value; None for a number that is not finite, also within a tuple."""
    if isinstance(value, tuple):
        return [_number(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _residual_table(fix: CalibrationResult) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    columns = zip(
        fix.image_index, fix.labels, fix.observed_px, fix.predicted_px, fix.sigma_px, fix.magnitudes, fix.used,
        strict=True,
    )  # fmt: skip
    for number, label, seen, predicted, sigma, magnitude, used in columns:
        image = fix.images[int(number)]
        cells = [*seen.tolist(), *predicted.tolist(), float(sigma), float(magnitude), image.temperature_c]
        texts = [repr(cell) if math.isfinite(cell) else "" for cell in cells]
        writer.writerow([image.name, int(label), *texts, int(used)])
    return text.getvalue()
