"""A phase of the mission as a campaign of the package: images, campaign file and run, and its residuals."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from scipy.spatial.transform import Rotation

from giantlike._system.atomic import make_folder, write_text_atomic
from giantlike.camera import Camera
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.store.records import AttitudeRecord
from giantlike.campaign.store.results import RunResult
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.catalogs import StarCatalog, load_catalog
from giantlike.core.arrays import Float
from giantlike.core.frames import rotate, rotation_from_xyzw
from giantlike.core.values import Value
from giantlike.io import write_fits, write_geometry
from giantlike.io.csv_rows import write_csv_rows
from giantlike.missions.osiris_rex.images import BEYOND_LIMIT, TARGET, Planner, detector_model, sky_for
from giantlike.missions.osiris_rex.setup import CampaignSetup
from giantlike.missions.osiris_rex.trajectory import BennuVisit
from giantlike.shapes import TriangleMesh
from giantlike.shapes.files.exchange import write_obj
from giantlike.simulation import Sources, simulate_image
from giantlike.simulation.approach import ApproachFrame
from giantlike.simulation.compare import ObservationError, compare_run
from giantlike.simulation.detector import DetectorModel
from giantlike.simulation.incident import SimulationOptions
from giantlike.simulation.write import (
    CAMPAIGN_FILE,
    TRUTH_COLUMNS,
    TRUTH_FILE,
    TruthRow,
    frame_header,
    geometry_row,
    truth_row,
)

_RAYS_ACROSS = 1500
"""Rays across Bennu in its images: three to a pixel side at 500 px, and six times fewer than a facet of the truth."""
_LEAST_RAYS, _MOST_RAYS = 2, 5
"""Rays along a pixel's side."""
_STARS_SHARE = 0.9
"""Exposures of at least this fraction of the long one are star images."""
_MODEL_FILE, _SKY_FILE = "model.obj", "sky.csv"
_OPTIONS = {"unresolved": {"correction": "kaasalainen_tanga"}, "moment": {"correction": "kaasalainen_tanga"}}
"""Options of estimators that are the paper's and not the default: the correction of its eq. 3."""


@dataclass(frozen=True, slots=True, eq=False)
class StarResiduals(Value):
    """Residuals of all stars that attitudes rest on.

    points_px, residuals_px: (n, 2); observed, and observed minus predicted with the estimated attitude.
    magnitudes, sigma_px: (n,); of the catalog; standard deviation per axis, px.
    solved, images: star images with an attitude, and all.
    """

    points_px: Float
    residuals_px: Float
    magnitudes: Float
    sigma_px: Float
    solved: int
    images: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CampaignResult(Value):
    """Residuals of one camera in one phase.

    phase, camera: keys.
    label: of the camera.
    diameter_km: of the sphere of Bennu's volume.
    diameters_px: (v,); apparent diameter of that sphere, by visit.
    observations: centers and ranges against the true trajectory: a center minus the position where the estimated
        attitude and the calibrated camera predict it, as in the paper. ``error_px`` is None without an attitude from
        stars.
    days: days since the first visit, by image file.
    columns, rows: size of the detector.
    """

    phase: str
    camera: str
    label: str
    visits: tuple[BennuVisit, ...]
    diameter_km: float
    diameters_px: Float
    stars: StarResiduals
    observations: tuple[ObservationError, ...]
    days: dict[str, float]
    columns: int
    rows: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CampaignJob(Value):
    """Inputs of a campaign.

    planner: mission, camera, phase and true body.
    declared: the camera as it was calibrated.
    model: shape model of the phase.
    folder: for images, campaign and run.
    """

    planner: Planner
    setup: CampaignSetup
    visits: tuple[BennuVisit, ...]
    declared: Camera
    model: TriangleMesh
    folder: Path
    workers: int

    def run(self, progress: Callable[[str, int, int], None]) -> CampaignResult:
        """Take the images, run the campaign, and compare it with the truth."""
        title = f"{self.planner.phase.title}, {self.planner.setup.label}"
        campaign = self._write(lambda done, total: progress(f"{title}: images", done, total))
        result = run_campaign(
            Campaign.load(campaign),
            workers=self.workers,
            progress=lambda step, done, total: progress(f"{title}: {step}", done, total),
        )
        planner, start = self.planner, self.visits[0].et
        days = {record.file: (record.et - start) / 86400.0 for record in result.attitudes if record.et is not None}
        focal_px, radius_km = planner.camera.model.focal_length_px, planner.truth.mean_radius_km
        return CampaignResult(
            phase=planner.phase.key,
            camera=planner.setup.key,
            label=planner.setup.label,
            visits=self.visits,
            diameter_km=2.0 * radius_km,
            diameters_px=np.array([2.0 * radius_km * focal_px / visit.range_km for visit in self.visits]),
            stars=_star_residuals(result.folder),
            observations=tuple(self._residuals(result)),
            days=days,
            columns=self.declared.columns,
            rows=self.declared.rows,
        )

    def _residuals(self, result: RunResult) -> Iterator[ObservationError]:
        """Observations against the position of the true body predicted by attitude and camera of the run."""
        compared = compare_run(result.folder, self.folder / TRUTH_FILE, self.declared)
        found = {
            record.file: record.attitude.rotation
            for record in result.attitudes
            if record.attitude is not None and record.status != "failed"
        }
        moved = {
            row.file: _moved_px(row, found[row.file], self.declared) for row in compared.truth if row.file in found
        }
        for error in compared.observations:
            if error.error_px is None or error.file not in moved:
                yield replace(error, error_px=None, sigma_px=None)
            else:
                yield replace(error, error_px=error.error_px - moved[error.file])

    def _write(self, progress: Callable[[int, int], None]) -> Path:
        """Take the images and write the campaign; return its file."""
        shutil.rmtree(self.folder, ignore_errors=True)
        make_folder(self.folder / "images")
        frames = tuple(self.planner.frames(self.visits))
        catalog, detector = (
            self._catalog(frames),
            detector_model(self.planner.mission, self.planner.setup, seed=self.planner.seed),
        )
        truth = []
        with ThreadPoolExecutor(self.workers) as pool:
            for row in pool.map(lambda frame: self._take(frame, catalog, detector), frames):
                truth.append(row)
                progress(len(truth), len(frames))
        self.declared.save(self.folder / "camera.toml")
        write_geometry(self.folder / "geometry.csv", [geometry_row(frame) for frame in frames])
        write_csv_rows(self.folder / TRUTH_FILE, TRUTH_COLUMNS, map(astuple, truth))
        write_obj(self.folder / _MODEL_FILE, self.model)
        write_text_atomic(self.folder / CAMPAIGN_FILE, tomli_w.dumps(self._table()))
        return self.folder / CAMPAIGN_FILE

    def _catalog(self, frames: Sequence[ApproachFrame]) -> StarCatalog:
        """Stars of the images; a made-up sky is written for the campaign, and read back so that both have the same."""
        planner = self.planner
        attitudes = [frame.shot.camera_from_inertial for frame in frames if frame.star_image]
        sky = sky_for(planner.mission, planner.setup.key, attitudes, seed=planner.seed)
        if sky is None:
            return load_catalog("default")
        stars = sky.stars
        rows = zip(stars.ra_deg.tolist(), stars.dec_deg.tolist(), stars.magnitude.tolist(), strict=True)
        write_csv_rows(self.folder / _SKY_FILE, ("ra_deg", "dec_deg", "magnitude"), rows)
        return load_catalog(self.folder / _SKY_FILE)

    def _take(self, frame: ApproachFrame, catalog: StarCatalog, detector: DetectorModel) -> TruthRow:
        planner = self.planner
        taken = simulate_image(
            frame.shot,
            planner.camera,
            Sources(scene=frame.scene, catalog=catalog, photometry=planner.photometry),
            seed=frame.seed,
            detector=detector,
            options=self._options(frame),
        )
        write_fits(self.folder / "images" / frame.shot.name, taken.image.pixels, header=frame_header(frame))
        return truth_row(frame, taken, planner.camera)

    def _options(self, frame: ApproachFrame) -> SimulationOptions:
        planner = self.planner
        limit = planner.mission.max_magnitude(planner.setup.key) + BEYOND_LIMIT
        if frame.star_image:
            return SimulationOptions(rays_per_pixel_side=1, min_rays_across=64, max_magnitude=limit)
        reach_px = float(
            2.0
            * planner.truth.mean_radius_km
            * planner.camera.model.focal_length_px
            / np.linalg.norm(frame.apriori_geometry.position_inertial_km)
        )
        rays = min(max(round(_RAYS_ACROSS / max(reach_px, 1.0)), _LEAST_RAYS), _MOST_RAYS)
        return SimulationOptions(rays_per_pixel_side=rays, max_magnitude=limit)

    def _table(self) -> dict[str, Any]:
        """The campaign file."""
        planner = self.planner
        mission, phase, camera = planner.mission, planner.phase, planner.setup
        sky = self.folder / _SKY_FILE
        return {
            "campaign": {"name": f"OSIRIS-REx {phase.title}, {camera.label}", "output": "run"},
            "images": {"files": ["images/*.fits"], "geometry": "geometry.csv"},
            "camera": {"file": "camera.toml"},
            "stars": {
                "catalog": _SKY_FILE if sky.exists() else "default",
                "max_magnitude": mission.max_magnitude(camera.key),
                "long_exposure_s": _STARS_SHARE * camera.long_exposure_s,
                "transfer": "propagate",
                "drift_arcsec_per_sqrt_s": mission.pointing.jitter_arcsec_per_sqrt_s,
                "max_gap_s": 2.0 * mission.pointing.pair_gap_s,
                "options": {"all_stars": True, "attitude_method": "q_method"},
                "detection": {"threshold_sigma": mission.threshold_sigma},
            },
            "targets": [
                {
                    "name": TARGET,
                    "shape": _MODEL_FILE,
                    "units": "km",
                    "estimators": list(self.setup.estimators),
                    "options": {name: _OPTIONS[name] for name in self.setup.estimators if name in _OPTIONS},
                    "uncertainty": {"scale": phase.model.scale, "spin_deg": phase.model.meridian_deg},
                }
            ],
        }


def _moved_px(row: TruthRow, found: Rotation, camera: Camera) -> Float:
    """Position (2,) of the true body by an attitude and a camera, minus its true position, px."""
    true = rotation_from_xyzw(np.array([row.qx, row.qy, row.qz, row.qw]))
    position_km = np.array([row.x_camera_km, row.y_camera_km, row.z_camera_km], dtype=np.float64)
    moved: Float = camera.model.project(rotate(found * true.inv(), position_km)) - np.array([row.x_px, row.y_px])
    return moved


def _star_residuals(folder: Path) -> StarResiduals:
    """Residuals of the stars of a run."""
    run = RunFolder.open(folder)
    records = [each for each in run.load_all(AttitudeRecord) if each.star_image]
    solved = [record for record in records if record.status != "failed"]
    parts = []
    with run.reading():
        for record in solved:
            stars = run.points(record)["stars"]
            observed, predicted = (np.reshape(stars[name], (-1, 2)) for name in ("observed_px", "predicted_px"))
            parts.append((observed, observed - predicted, np.array(stars["magnitudes"]), np.array(stars["sigma_px"])))
    empty = (np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    points, residuals, magnitudes, sigma = (np.concatenate(each) for each in zip(*(parts or [empty]), strict=True))
    return StarResiduals(points, residuals, magnitudes, sigma, solved=len(solved), images=len(records))
