"""The mission as data: ``mission.toml`` as frozen values, and the kernels and shape of a user."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel
from giantlike.core.arrays import Float, require
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.errors import DataError
from giantlike.core.values import Value
from giantlike.io.mission_frame import from_mission_frame
from giantlike.missions.osiris_rex.trajectory import Orbit, PlannedVisit

_BELOW_THRESHOLD = 0.3
"""Magnitudes from the limit of detection to the end of the catalog: noise lifts fainter stars above it too."""
_SHAPE_PATTERNS = ("*ennu*.obj", "*ennu*.ply", "*ennu*.bds")
"""Names of shape files of Bennu, in km."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSetup:
    """A camera of Table 1.

    model: Table 1 in our axes: rows run down, so that f_y is positive and p_1 has the other sign.
    estimated: parameters that the paper's calibration estimates.
    zero_point_e_s: in electron/s; signal of a star of magnitude 0.
    temperatures_c: coldest and warmest calibration image.
    printed_fy_px: the paper's own f_y where it was treated as a misprint.
    """

    key: str
    label: str
    model: BrownModel
    estimated: tuple[str, ...]
    columns: int
    rows: int
    zero_point_e_s: float
    long_exposure_s: float
    longest_short_s: float
    calibration_images: int
    temperatures_c: tuple[float, float]
    printed_fy_px: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorSetup:
    """Detector and optics of all cameras, and their declared values; units as in ``mission.toml``."""

    gain_e_per_dn: float
    read_noise_e: float
    bias_dn: float
    saturation_dn: float
    psf_sigma_px: float
    told_psf_sigma_px: float
    response_rms: float
    hot_pixels: int
    hot_pixel_e_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PointingSetup:
    """Errors and motion of the pointing; units as in ``mission.toml``."""

    attitude_error_deg: float
    jitter_arcsec_per_sqrt_s: float
    rate_arcsec_s: float
    pair_gap_s: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BodySetup(Value):
    """The truth of Bennu; units as in ``mission.toml``."""

    mean_radius_km: float
    axes_km: Float
    exponent: float
    facets: int
    small_facets: int
    lumps: float
    roughness: float
    albedo_rms: float
    radiance_factor: float
    law: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelSetup:
    """Shape model of a phase: size of its mesh, rms error of its heights, of its scale and of the prime meridian."""

    facets: int
    error_m: float
    scale: float
    meridian_deg: float


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignSetup:
    """Images of one camera in one phase."""

    camera: str
    estimators: tuple[str, ...]
    visits: tuple[PlannedVisit, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class PhaseSetup:
    """A phase of the mission; errors of the predicted trajectory in px across and relative along the line of sight."""

    key: str
    title: str
    model: ModelSetup
    position_error_px: float
    range_error: float
    campaigns: tuple[CampaignSetup, ...]

    def with_poor_shape(self) -> PhaseSetup:
        """Return the phase with a shape model whose heights and scale err by twenty times as much."""
        poor = replace(self.model, error_m=20.0 * self.model.error_m, scale=20.0 * self.model.scale)
        return replace(self, model=poor)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MissionSetup(Value):
    """All of ``mission.toml``."""

    orbit: Orbit
    body: BodySetup
    cameras: Mapping[str, CameraSetup]
    detector: DetectorSetup
    pointing: PointingSetup
    threshold_sigma: float
    phases: tuple[PhaseSetup, ...]

    def max_magnitude(self, key: str) -> float:
        """Faintest star of the catalog that a camera uses: a little fainter than its long exposures show.

        The paper's catalog is deeper than its images, so that the signal to noise of detections decides which stars
        there are, and not the end of the catalog.
        """
        setup, detector = self.cameras[key], self.detector
        area_px = 4.0 * math.pi * (detector.psf_sigma_px**2 + 1.0 / 12.0)  # of equal noise; the pixel widens the star
        half = 0.5 * self.threshold_sigma**2
        faintest_e = half + math.sqrt(half**2 + area_px * (self.threshold_sigma * detector.read_noise_e) ** 2)
        limit = 2.5 * math.log10(setup.zero_point_e_s * setup.long_exposure_s / faintest_e)
        return round(limit + _BELOW_THRESHOLD, 2)

    def true_camera(self, key: str) -> Camera:
        """Return a camera as it is: Table 1, and the true point spread function."""
        return self._camera(key, self.detector.psf_sigma_px)

    def declared_camera(self, key: str) -> Camera:
        """Return a camera as assumed before any calibration: nominal focal length, no distortion."""
        camera = self._camera(key, self.detector.told_psf_sigma_px)
        focal_px = float(f"{self.cameras[key].model.fx_px:.2g}")  # as a manufacturer states it: 3500 for 3473.3
        middle = (camera.columns - 1) / 2, (camera.rows - 1) / 2
        return replace(camera, model=BrownModel(fx_px=focal_px, fy_px=focal_px, cx_px=middle[0], cy_px=middle[1]))

    def _camera(self, key: str, psf_sigma_px: float) -> Camera:
        setup, detector = self.cameras[key], self.detector
        return Camera(
            name=setup.label,
            columns=setup.columns,
            rows=setup.rows,
            model=setup.model,
            psf=GaussianPsf(sigma_px=psf_sigma_px),
            detector=Detector(
                gain_e_per_dn=detector.gain_e_per_dn,
                read_noise_e=detector.read_noise_e,
                bias_dn=detector.bias_dn,
                saturation_dn=detector.saturation_dn,
            ),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class UserInputs:
    """Inputs of a user: a folder of kernels and a shape of Bennu; None where there is none."""

    kernels: Path | None = None
    shape: Path | None = None


def user_inputs(folder: Path | None) -> UserInputs:
    """Find kernels and shape in the folder of a user."""
    if folder is None:
        return UserInputs()
    if not folder.is_dir():
        raise DataError(folder, "needs a folder of kernels and a shape of Bennu, this is none")
    shapes = [path for pattern in _SHAPE_PATTERNS for path in sorted(folder.rglob(pattern))]
    kernels = folder if any(folder.rglob("orx_*ALT*.bsp")) else None
    if kernels is None and not shapes:
        expected = f"orx_*ALT*.bsp or {', '.join(_SHAPE_PATTERNS)}"
        raise DataError(folder, f"the folder and those below hold no {expected}")
    return UserInputs(kernels=kernels, shape=shapes[0] if shapes else None)


@lru_cache(maxsize=1)
def mission() -> MissionSetup:
    """Read ``mission.toml``."""
    text = (files("giantlike.missions.osiris_rex") / "mission.toml").read_text(encoding="utf-8")
    table = tomllib.loads(text)
    cameras = {key: _camera_setup(key, each) for key, each in table["cameras"].items()}
    body = table["body"]
    diameter_km = 2.0 * body["mean_radius_km"]
    return MissionSetup(
        orbit=Orbit(**table["orbit"]),
        body=BodySetup(**{**body, "axes_km": np.array(body["axes_km"]), "law": MappingProxyType(body["law"])}),
        cameras=MappingProxyType(cameras),
        detector=DetectorSetup(**table["detector"]),
        pointing=PointingSetup(**table["pointing"]),
        threshold_sigma=table["stars"]["threshold_sigma"],
        phases=tuple(_phase(each, cameras, diameter_km) for each in table["phases"]),
    )


def _camera_setup(key: str, table: dict[str, Any]) -> CameraSetup:
    model = from_mission_frame(BrownModel, table.pop("table1")).model
    assert isinstance(model, BrownModel)
    table["estimated"], table["temperatures_c"] = tuple(table["estimated"]), tuple(table["temperatures_c"])
    return CameraSetup(key=key, model=model, **table)


def _phase(table: dict[str, Any], cameras: Mapping[str, CameraSetup], diameter_km: float) -> PhaseSetup:
    campaigns = tuple(
        CampaignSetup(
            camera=each["camera"],
            estimators=tuple(each["estimators"]),
            visits=tuple(
                _visit(visit, cameras[each["camera"]].model.focal_length_px * diameter_km) for visit in each["visits"]
            ),
        )
        for each in table["campaigns"]
    )
    return PhaseSetup(**{**table, "model": ModelSetup(**table["model"]), "campaigns": campaigns})


def _visit(table: dict[str, Any], pixels_km: float) -> PlannedVisit:
    """Plan of a visit at a range, or at an apparent diameter, whose product with the range is ``pixels_km``."""
    require(("range_km" in table) != ("diameter_px" in table), f"visit {table['utc']}: range_km or diameter_px")
    range_km = table["range_km"] if "range_km" in table else pixels_km / table["diameter_px"]
    return PlannedVisit(utc=table["utc"], range_km=range_km, phase_deg=table["phase_deg"], turn_deg=table["turn_deg"])
