"""A phase of the mission as a campaign of the package: images, campaign file and run, and what its observables say."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from giantlike._system.atomic import make_folder, write_text_atomic
from giantlike._system.processes import worker_context
from giantlike.camera import Camera
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.run.runner import run_campaign
from giantlike.campaign.store.observables import OBSERVABLES_FILE
from giantlike.campaign.store.records import AttitudeRecord
from giantlike.campaign.store.run_folder import RunFolder
from giantlike.core.arrays import Float
from giantlike.core.frames import quaternion_xyzw
from giantlike.core.values import Value
from giantlike.independent import ReliefBody
from giantlike.independent.orbit import Observation, RefusedError, read
from giantlike.io import write_fits, write_geometry
from giantlike.io.csv_rows import write_csv_rows
from giantlike.io.decoded import HeaderValue
from giantlike.missions.osiris_rex.images import DEEPEST_DEFAULT, TARGET, Exposure, Planner, Taker, sky_for
from giantlike.missions.osiris_rex.setup import CampaignSetup
from giantlike.missions.osiris_rex.trajectory import Flight
from giantlike.shapes import TriangleMesh
from giantlike.shapes.files.exchange import write_obj

_STARS_SHARE = 0.9  # exposures of at least this fraction of the long one are star images
_MODEL_FILE, _SKY_FILE = "model.obj", "sky.csv"
_TRUTH = ("file", "et_s", "x_km", "y_km", "z_km", "vx_km_s", "vy_km_s", "vz_km_s", "qx", "qy", "qz", "qw")
"""Columns of ``truth.csv``: state of the spacecraft from Bennu, ICRF axes, and camera_from_inertial."""
_OPTIONS = {"unresolved": {"correction": "kaasalainen_tanga"}, "moment": {"correction": "kaasalainen_tanga"}}
"""Options of estimators that are the paper's and not the default: the correction of its eq. 3."""


@dataclass(frozen=True, slots=True, eq=False)
class StarResiduals(Value):
    """Residuals of all stars that attitudes rest on.

    points_px, residuals_px: (n, 2); observed, and observed minus predicted with the estimated attitude.
    """

    points_px: Float
    residuals_px: Float
    magnitudes: Float  # magnitudes, sigma_px: (n,); of the catalog; standard deviation per axis, px
    sigma_px: Float
    solved: int  # solved, images: star images with an attitude, and all
    images: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CampaignResult(Value):
    """What a campaign of one camera in one phase found.

    preferred, every: fixes of images with an attitude from stars, from the observables file alone.
    """

    camera: str  # camera, label: key and name of the camera
    label: str
    folder: Path  # of the run
    diameters_px: dict[str, float]  # apparent diameter of the sphere of Bennu's volume, by image file
    stars: StarResiduals
    preferred: tuple[Observation, ...]
    every: tuple[Observation, ...]
    columns: int  # columns, rows: size of the detector
    rows: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CampaignJob(Value):
    """Inputs of a campaign."""

    planner: Planner
    setup: CampaignSetup
    ets: tuple[float, ...]
    flight: Flight
    truth: ReliefBody
    declared: Camera  # the camera as it was calibrated
    model: TriangleMesh  # shape model of the phase
    folder: Path  # for images, campaign and run
    workers: int

    def run(self, progress: Callable[[str, int, int], None]) -> CampaignResult:
        """Take the images, run the campaign, and read its observables."""
        planner, setup = self.planner, self.planner.setup
        title = f"{planner.phase.title}, {setup.label}"
        campaign = self._write(lambda done, total: progress(f"{title}: images", done, total))
        result = run_campaign(
            Campaign.load(campaign),
            workers=self.workers,
            progress=lambda step, done, total: progress(f"{title}: {step}", done, total),
        )
        across = 2.0 * planner.mission.body.mean_radius_km * setup.model.focal_length_px
        pairs = [planner.exposures(et, self.flight) for et in self.ets]
        return CampaignResult(
            camera=setup.key,
            label=setup.label,
            folder=result.folder,
            diameters_px={each.name: across / float(np.linalg.norm(each.state_km[:3])) for _, each in pairs},
            stars=_star_residuals(result.folder),
            preferred=_observations(result.folder),
            every=_observations(result.folder, every=True),
            columns=setup.columns,
            rows=setup.rows,
        )

    def _write(self, progress: Callable[[int, int], None]) -> Path:
        """Take the images and write the campaign; return its file."""
        shutil.rmtree(self.folder, ignore_errors=True)
        make_folder(self.folder / "images")
        planner = self.planner
        pairs = [planner.exposures(et, self.flight) for et in self.ets]
        attitudes = [long.camera_from_inertial for long, _ in pairs]
        sky = sky_for(planner.mission, planner.setup.key, attitudes, seed=planner.seed)
        if planner.mission.max_magnitude(planner.setup.key) > DEEPEST_DEFAULT:
            rows = zip(*(getattr(sky.stars, name).tolist() for name in ("ra_deg", "dec_deg", "magnitude")), strict=True)
            write_csv_rows(self.folder / _SKY_FILE, ("ra_deg", "dec_deg", "magnitude"), rows)
        taker = Taker(key=planner.setup.key, catalog=sky, body=self.truth, seed=planner.seed)
        predicted = [each for pair in pairs for each in planner.predict(pair)]
        exposures = [each for pair in pairs for each in pair]
        take = partial(_take, taker, self.folder / "images")
        headers = [header for _, header in predicted]
        alone, context = self.workers < 2, worker_context(Taker.__module__)
        with ThreadPoolExecutor(1) if alone else ProcessPoolExecutor(self.workers, mp_context=context) as pool:
            for done, _ in enumerate(pool.map(take, exposures, headers), 1):
                progress(done, len(exposures))
        self.declared.save(self.folder / "camera.toml")
        write_geometry(self.folder / "geometry.csv", [row for row, _ in predicted])
        write_csv_rows(self.folder / "truth.csv", _TRUTH, map(_true_row, exposures))
        write_obj(self.folder / _MODEL_FILE, self.model)
        write_text_atomic(self.folder / "campaign.toml", tomli_w.dumps(self._table()))
        return self.folder / "campaign.toml"

    def _table(self) -> dict[str, Any]:
        """The campaign file."""
        planner = self.planner
        mission, phase, camera = planner.mission, planner.phase, planner.setup
        return {
            "campaign": {"name": f"OSIRIS-REx {phase.title}, {camera.label}", "output": "run"},
            "images": {"files": ["images/*.fits"], "geometry": "geometry.csv"},
            "camera": {"file": "camera.toml"},
            "stars": {
                "catalog": _SKY_FILE if (self.folder / _SKY_FILE).exists() else "default",
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


def _take(taker: Taker, folder: Path, each: Exposure, header: dict[str, HeaderValue]) -> None:
    """Take an image and write it."""
    pixels, seconds = taker.take(each, (taker.seed, 13, taker.setup.columns, int(each.et)))
    write_fits(folder / each.name, pixels, header=header | {"EXPTIME": seconds})


def _true_row(each: Exposure) -> tuple[str | float, ...]:
    return each.name, each.et, *each.state_km.tolist(), *quaternion_xyzw(each.camera_from_inertial).tolist()


def _observations(folder: Path, *, every: bool = False) -> tuple[Observation, ...]:
    """Fixes of a run with attitudes from stars; none where it has none."""
    try:
        found = read(str(folder / OBSERVABLES_FILE), every=every)
    except RefusedError:
        return ()
    return tuple(each for each in found if each.attitude_source != "a_priori")


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
