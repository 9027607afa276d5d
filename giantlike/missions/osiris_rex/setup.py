"""The mission as data: ``mission.toml`` as frozen values, and the kernels and shape of a user."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.errors import DataError
from giantlike.core.values import Value
from giantlike.independent import PinholeView
from giantlike.io.mission_frame import from_mission_frame
from giantlike.missions.osiris_rex.trajectory import Orbit, Waypoint

_BELOW_THRESHOLD = 0.3
"""Magnitudes from the limit of detection to the end of the catalog: noise lifts fainter stars above it too."""
_SHAPE_PATTERNS = ("*ennu*.obj", "*ennu*.ply", "*ennu*.bds")  # names of shape files of Bennu, in km


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSetup:
    """A camera of Table 1."""

    key: str
    label: str
    model: BrownModel  # Table 1 in our axes: rows run down, so that f_y is positive and p_1 has the other sign
    table: Mapping[str, float]  # Table 1 as printed, but for a misprint
    estimated: tuple[str, ...]  # parameters that the paper's calibration estimates
    columns: int
    rows: int
    zero_point_e_s: float  # in electron/s; signal of a star of magnitude 0
    long_exposure_s: float
    longest_short_s: float
    calibration_images: int
    temperatures_c: tuple[float, float]  # coldest and warmest calibration image
    printed_fy_px: float | None = None  # the paper's own f_y where it was treated as a misprint

    def view(self, temperature_c: float = 0.0) -> PinholeView:
        """Return the camera as the independent renderer has it: Table 1 with y turned to rows that run down."""
        table = self.table
        return PinholeView(
            focal_px=table["fx_px"] * (1.0 + table.get("a1_per_c", 0.0) * temperature_c),
            aspect=-table["fy_px"] / table["fx_px"],
            center_px=(table["cx_px"], table["cy_px"]),
            columns=self.columns,
            rows=self.rows,
            **{name: table.get(name, 0.0) for name in ("k1", "k2", "k3", "p2")},
            p1=-table["p1"],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelSetup:
    """Shape model of a phase: size of its mesh, rms error of its heights, of its scale and of the prime meridian."""

    facets: int
    error_m: float
    scale: float
    meridian_deg: float


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignSetup:
    """Images of one camera in one phase, by UTC, and the number of them in a small replay."""

    camera: str
    estimators: tuple[str, ...]
    images: tuple[str, ...]
    small: int


@dataclass(frozen=True, slots=True, kw_only=True)
class PhaseSetup:
    """A phase of the mission; errors of the predicted trajectory in px across and relative along the line of sight.

    waypoints: places that maneuvers aim at, or, with ``orbit``, times of trims by ``trim_mm_s`` along the velocity.
    """

    key: str
    title: str
    model: ModelSetup
    position_error_px: float
    range_error: float
    campaigns: tuple[CampaignSetup, ...]
    waypoints: tuple[Waypoint, ...]
    orbit: bool = False
    trim_mm_s: float = 0.0

    def with_poor_shape(self) -> PhaseSetup:
        """Return the phase with a shape model whose heights and scale err by twenty times as much."""
        poor = replace(self.model, error_m=20.0 * self.model.error_m, scale=20.0 * self.model.scale)
        return replace(self, model=poor)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MissionSetup(Value):
    """All of ``mission.toml``; ``flight``, ``body``, ``detector`` and ``pointing`` as it has them, with its units."""

    orbit: Orbit
    flight: SimpleNamespace
    body: SimpleNamespace
    cameras: Mapping[str, CameraSetup]
    detector: SimpleNamespace
    pointing: SimpleNamespace
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

    def half_diagonal_rad(self, key: str) -> float:
        """Half the diagonal of the field of a camera, rad."""
        setup = self.cameras[key]
        return math.atan(0.5 * math.hypot(setup.columns, setup.rows) / setup.model.fx_px)

    def exact_camera(self, key: str) -> Camera:
        """Return a camera with Table 1, and the width of the point spread function that is declared."""
        setup, detector = self.cameras[key], self.detector
        return Camera(
            name=setup.label,
            columns=setup.columns,
            rows=setup.rows,
            model=setup.model,
            psf=GaussianPsf(sigma_px=detector.told_psf_sigma_px),
            detector=Detector(
                gain_e_per_dn=detector.gain_e_per_dn,
                read_noise_e=detector.read_noise_e,
                bias_dn=detector.bias_dn,
                saturation_dn=detector.saturation_dn,
            ),
        )

    def declared_camera(self, key: str) -> Camera:
        """Return a camera as assumed before any calibration: nominal focal length, no distortion."""
        camera = self.exact_camera(key)
        focal_px = float(f"{self.cameras[key].model.fx_px:.2g}")  # as a manufacturer states it: 3500 for 3473.3
        middle = (camera.columns - 1) / 2, (camera.rows - 1) / 2
        return replace(camera, model=BrownModel(fx_px=focal_px, fy_px=focal_px, cx_px=middle[0], cy_px=middle[1]))


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
    return MissionSetup(
        orbit=Orbit(**table["orbit"]),
        flight=SimpleNamespace(**table["flight"]),
        body=SimpleNamespace(**table["body"]),
        cameras=MappingProxyType(cameras),
        detector=SimpleNamespace(**table["detector"]),
        pointing=SimpleNamespace(**table["pointing"]),
        threshold_sigma=table["stars"]["threshold_sigma"],
        phases=tuple(_phase(each) for each in table["phases"]),
    )


def _camera_setup(key: str, table: dict[str, Any]) -> CameraSetup:
    printed = table.pop("table1")
    model = from_mission_frame(BrownModel, dict(printed)).model
    assert isinstance(model, BrownModel)
    table["estimated"], table["temperatures_c"] = tuple(table["estimated"]), tuple(table["temperatures_c"])
    return CameraSetup(key=key, model=model, table=MappingProxyType(printed), **table)


def _phase(table: dict[str, Any]) -> PhaseSetup:
    campaigns = tuple(
        CampaignSetup(**{**each, "estimators": tuple(each["estimators"]), "images": tuple(each["images"])})
        for each in table["campaigns"]
    )
    waypoints = tuple(Waypoint(**each) for each in table["waypoints"])
    return PhaseSetup(
        **{**table, "model": ModelSetup(**table["model"]), "campaigns": campaigns, "waypoints": waypoints}
    )
