"""Calibration within a campaign: records to star images, the calibrated camera, and its files."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.atomic import write_text_atomic
from giantlike._system.reading import file_sha256
from giantlike.calibration import calibrate_stars
from giantlike.calibration.alignment import AlignmentResult, align
from giantlike.calibration.result import CalibrationResult
from giantlike.calibration.star_images import StarCalibration, StarImage
from giantlike.calibration.statistics import residual_statistics
from giantlike.camera import Camera
from giantlike.camera_models import model_to_mapping
from giantlike.campaign.file.config import Campaign, ImageEntry
from giantlike.campaign.file.schema import CalibrationSection
from giantlike.campaign.store.records import CalibrationRecord
from giantlike.campaign.store.run_folder import CALIBRATION_FILE, CALIBRATION_PAGE, CAMERA_FILE, RESIDUALS_FILE
from giantlike.catalogs import StarCatalog
from giantlike.core.arrays import finite_or_none
from giantlike.core.errors import DataError
from giantlike.core.frames import quaternion_xyzw
from giantlike.core.outcomes import Failure
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.core.values import Value
from giantlike.image import Image
from giantlike.io.csv_rows import write_csv_rows
from giantlike.stars import StarOptions
from giantlike.stars.field import Sky

NO_STAR_IMAGE = "is not a star image: its exposure is shorter than stars.long_exposure_s"
"""Detail of the problem of an image that takes no part because it is not meant to."""
_COLUMNS = (
    "file", "star", "x_px", "y_px", "predicted_x_px", "predicted_y_px", "sigma_px", "magnitude", "temperature_c",
    "used",
)  # fmt: skip
_ARRAYS = CalibrationRecord.points_of  # arrays of a star image that its record holds as lists, by the same names
_FEWEST_FOR_DRIFT = 4  # images for a drift of the alignment: its 6 unknowns take two, twice as many leave a check


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CampaignCalibration(Value):
    """Result of the calibration of a campaign."""

    outcome: StarCalibration | Failure
    camera: Camera | None  # the calibrated camera; None if calibration failed or was not accepted
    alignment: AlignmentResult | None  # of the camera with respect to a priori attitudes, if any
    lost: tuple[tuple[str, str], ...]  # images that did not take part, and the reasons
    targets: str = "stars"  # word for the observed points: stars, or corners of a board

    @classmethod
    def from_outcome(
        cls,
        outcome: StarCalibration | Failure,
        camera: Camera,
        lost: Iterable[tuple[str, Failure]],
        *,
        alignment: AlignmentResult | None = None,
        targets: str = "stars",
    ) -> CampaignCalibration:
        """Result with the camera that a calibration gives, if it was accepted."""
        calibrated = None
        if isinstance(outcome, StarCalibration) and outcome.result.accepted:
            calibrated = outcome.result.camera_from(camera)
        reasons = tuple((name, f"{failure.reason}: {failure.detail}") for name, failure in lost)
        return cls(outcome=outcome, camera=calibrated, alignment=alignment, lost=reasons, targets=targets)

    @property
    def problem(self) -> str | None:
        """Reason why the campaign keeps the camera it had; None if it has a calibrated one."""
        if isinstance(self.outcome, Failure):
            return f"calibration failed: {self.outcome.reason}: {self.outcome.detail}"
        if self.camera is None:
            return f"calibration not accepted: {'; '.join(self.outcome.result.problems)}"
        return None


def temperature_of(image: Image, keyword: str | None) -> float:
    """Temperature in the header of an image. Returned in Celsius, 0 without a keyword."""
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
    """Star image as plain values."""
    position, velocity = stars.sky.observer_position_km, stars.sky.observer_velocity_km_s
    return CalibrationRecord(
        index=entry.index,
        file=entry.key,
        et=stars.sky.et,
        observer_position_km=None if position is None else position.tolist(),
        observer_velocity_km_s=None if velocity is None else velocity.tolist(),
        temperature_c=stars.temperature_c,
        apriori_xyzw=None if apriori is None else quaternion_xyzw(apriori).tolist(),
        quaternion_xyzw=quaternion_xyzw(stars.camera_from_inertial).tolist(),
        focal_length_px=stars.focal_length_px,
        **{name: getattr(stars, name).tolist() for name in _ARRAYS},
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
        camera_from_inertial=Rotation.from_quat(record.quaternion_xyzw),
        focal_length_px=record.focal_length_px,
        temperature_c=record.temperature_c,
        **{name: np.array(getattr(record, name)) for name in _ARRAYS},
    )


def calibrate_campaign(
    campaign: Campaign, setup: CalibrationSection, records: Sequence[CalibrationRecord], catalog: StarCatalog
) -> CampaignCalibration:
    """Calibrate the camera of a campaign from the first identification of its star images."""
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
        (record.file, Failure(record.problem.reason, record.problem.detail))
        for record in records
        if record.problem is not None and record.problem.detail != NO_STAR_IMAGE
    ]
    if isinstance(outcome, Failure):
        return CampaignCalibration.from_outcome(outcome, campaign.camera, lost)
    alignment = _alignment(outcome.result, records)
    return CampaignCalibration.from_outcome(outcome, campaign.camera, [*lost, *outcome.failed], alignment=alignment)


def _alignment(solution: CalibrationResult, records: Sequence[CalibrationRecord]) -> AlignmentResult | None:
    """Camera with respect to the a priori attitudes, with a drift if temperatures differ."""
    apriori = {record.file: record.apriori_xyzw for record in records if record.apriori_xyzw is not None}
    images = [image for image in solution.images if image.n_used > 0 and image.name in apriori]
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


def write_calibration(folder: Path, result: CampaignCalibration, inputs: str = "") -> None:
    """Write ``camera.toml`` (if accepted), ``calibration.json`` and the table of residuals."""
    for name in (CALIBRATION_FILE, CALIBRATION_PAGE, CAMERA_FILE, RESIDUALS_FILE):
        (folder / name).unlink(missing_ok=True)
    if result.camera is not None:
        result.camera.save(folder / CAMERA_FILE)
    if isinstance(result.outcome, StarCalibration):
        write_csv_rows(folder / RESIDUALS_FILE, _COLUMNS, _residual_rows(result.outcome.result))
    content = calibration_summary(result) | {"made_from": {"inputs": inputs, "camera": _camera_hash(folder)}}
    write_text_atomic(folder / CALIBRATION_FILE, json.dumps(content, indent=1, default=str) + "\n")


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptCalibration:
    """A calibration as the run folder holds it."""

    camera: Camera | None  # None if it was not accepted
    summary: dict[str, Any]  # content of ``calibration.json``

    @property
    def problem(self) -> str | None:
        """Reason why the campaign keeps the camera it had; None if it has a calibrated one."""
        return None if self.summary["problem"] is None else str(self.summary["problem"])


def kept_calibration(folder: Path, inputs: str) -> KeptCalibration | None:
    """Read the calibration of a run folder; None without one, of other inputs, or with a file changed since."""
    try:
        summary = json.loads((folder / CALIBRATION_FILE).read_text(encoding="utf-8"))
        if summary["made_from"] != {"inputs": inputs, "camera": _camera_hash(folder)}:
            return None
        camera = Camera.load(folder / CAMERA_FILE) if summary["problem"] is None else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError, DataError):
        return None
    return KeptCalibration(camera=camera, summary=summary)


def _camera_hash(folder: Path) -> str:
    path = folder / CAMERA_FILE
    return file_sha256(path) if path.is_file() else ""


def calibration_summary(result: CampaignCalibration) -> dict[str, Any]:
    """Results of a calibration except its single observations, as in JSON. Unknown values are None."""
    content: dict[str, Any] = {
        "status": "failed" if isinstance(result.outcome, Failure) else "ok" if result.camera else "not_accepted",
        "problem": result.problem,
        "targets": result.targets,
        "images_lost": [{"file": name, "problem": problem} for name, problem in result.lost],
    }
    if isinstance(result.outcome, Failure):
        return content
    solution, everything = result.outcome.result, result.outcome.all_stars
    return content | {
        "model": model_to_mapping(solution.model),
        "estimated": list(solution.estimated),
        "covariance": solution.covariance.tolist(),
        "covariance_scale": solution.covariance_scale,
        "parameters": [dataclasses.asdict(one) for one in solution.support],
        **_pick(solution, "rms_px residual_sigma_px reduced_chi2 condition_number"),
        "map_sigma_max_px": float(solution.map_sigma_px.max()),
        **_pick(solution, "n_used n_rejected"),
        "all_stars": None if everything is None else dataclasses.asdict(everything),
        **_pick(result.outcome, "rounds settled"),
        "problems": list(solution.problems),
        "images": [
            {"file": image.name} | _pick(image, "temperature_c n_used n_rejected rms_px influence_px influence")
            for image in solution.images
        ],
        "rejected": [_pick(one, " ".join(dataclasses.asdict(one))) for one in solution.rejected],
        "residuals": [dataclasses.asdict(group) for group in residual_statistics(solution)],
        "alignment": None if result.alignment is None else _alignment_summary(result.alignment),
    }


def _pick(value: object, names: str) -> dict[str, Any]:
    """Attributes by name; None for a number that is not finite."""
    return {name: _finite(getattr(value, name)) for name in names.split()}


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


def _finite(value: Any) -> Any:
    """Return the value, with None for a number that is not finite; a tuple becomes a list."""
    if isinstance(value, tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _residual_rows(solution: CalibrationResult) -> Iterator[list[str | float | None]]:
    names = ("image_index", "labels", "observed_px", "predicted_px", "sigma_px", "magnitudes", "used")
    columns = zip(*(getattr(solution, name).tolist() for name in names), strict=True)
    for number, label, seen, predicted, sigma, magnitude, used in columns:
        image = solution.images[number]
        cells = [*seen, *predicted, sigma, magnitude, image.temperature_c]
        yield [image.name, label, *map(finite_or_none, cells), int(used)]
