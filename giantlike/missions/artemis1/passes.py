"""Passes of Artemis I: Table 1 of the paper, and straight tracks rebuilt from it."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.atmosphere import Atmosphere
from giantlike.camera_models import PinholeModel
from giantlike.cislunar import BodyErrorModel
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.core.values import Value
from giantlike.relative.horizon.geometry import Figure

KM_PER_NMI = 1.852
KM_PER_KFT = 0.3048
DAY_S = 86400.0  # passes are "approximately once per day"
SUN_AZIMUTH_DEG = 180.0
"""Direction to the Sun in the image, from +x: "the illumination direction is approximately parallel" with it."""


_RELIEF_PX_KM = 7291.7 * 6562.0 * KM_PER_KFT / 1000.0
_PREFLIGHT = {
    "moon": BodyErrorModel(
        noise_px=np.array([0.15, 0.06, 0.12]), relief_px_km=_RELIEF_PX_KM * np.array([1.0, 0.5, 1.0])
    ),
    "earth": BodyErrorModel(noise_px=np.array([0.065, 0.025, 0.058])),
}
"""Errors expected before flight: Holt et al. (2018), eqs. 28 to 30 and 34 to 36, without their biases."""
_CHANGED = {
    "relief_tripled": ("moon", "relief_km", 3.0),
    "ultraviolet": ("earth", "wavelength_nm", 300.0 / 550.0),
    "quiet_stars": ("camera", "gain_e_per_dn", 100.0),
}
"""Number that a change of the replay multiplies, and its factor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pass:
    """One row of Table 1, and the assumptions about it."""

    number: int
    target: str  # ``earth`` or ``moon``
    range_km: float  # in the middle of the pass
    range_rate_km_s: float  # from the ranges of the same target a day before and after
    phase_deg: float
    certification: bool  # a pass of two hours


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Setting(Value):
    """All that is given: passes, camera, bodies, errors."""

    data: Mapping[str, Any]  # of ``artemis1.toml``
    passes: tuple[Pass, ...]  # the 23 that the paper uses
    model: PinholeModel
    detector: Detector
    psf: GaussianPsf

    def find_pass(self, number: int) -> Pass:
        """Pass by its number in Table 1."""
        return next(each for each in self.passes if each.number == number)

    def figure(self, target: str) -> Figure:
        """Ellipsoid of a target in the camera: its axis is tilted to the image for the Earth."""
        if target == "moon":
            return Figure(radii_km=np.full(3, self.data["moon"]["radius_km"]), camera_from_axes=Rotation.identity())
        earth = self.data["earth"]
        radii = np.array([earth["equatorial_km"], earth["equatorial_km"], earth["polar_km"]])
        return Figure(radii_km=radii, camera_from_axes=Rotation.from_euler("xz", [75.0, 20.0], degrees=True))

    @property
    def air(self) -> Atmosphere:
        """Air of the Earth in the band of the camera."""
        return Atmosphere.of("EARTH").seen_at(self.data["earth"]["wavelength_nm"])

    def knowledge(self, target: str) -> tuple[float, float]:
        """Errors of the best estimated trajectory: of the range, km, and of the pointing, px."""
        known = self.data["knowledge"][target]
        return known["range_kft"] * KM_PER_KFT, known["pointing_arcsec"] / ARCSEC_PER_RAD * self.model.fx_px


def load(change: str = "") -> Setting:
    """Read the published numbers, one of them changed."""
    data = tomllib.loads((files("giantlike.missions.artemis1") / "artemis1.toml").read_text(encoding="utf-8"))
    if change in _CHANGED:
        section, key, factor = _CHANGED[change]
        data[section][key] *= factor
    rows, camera = data["pass"], data["camera"]
    passes = []
    for row in rows:
        same = [each for each in rows if each["target"] == row["target"]]
        near = [each for each in same if 0 < abs(each["number"] - row["number"]) <= 2] or same
        days = np.array([each["number"] - row["number"] for each in near], dtype=np.float64)
        gone = np.array([each["range_nmi"] - row["range_nmi"] for each in near], dtype=np.float64) * KM_PER_NMI
        rate = float(gone @ days / (days @ days)) / DAY_S if days.any() else 0.0
        passes.append(
            Pass(
                number=row["number"],
                target=row["target"],
                range_km=row["range_nmi"] * KM_PER_NMI,
                range_rate_km_s=rate,
                phase_deg=row["phase_deg"],
                certification=row.get("certification", False),
            )
        )
    return Setting(
        data=data,
        passes=tuple(passes),
        model=PinholeModel(
            fx_px=camera["focal_px"],
            fy_px=camera["focal_px"],
            cx_px=(camera["columns"] - 1) / 2,
            cy_px=(camera["rows"] - 1) / 2,
        ),
        detector=Detector(
            gain_e_per_dn=camera["gain_e_per_dn"],
            read_noise_e=camera["read_noise_e"],
            saturation_dn=camera["saturation_dn"],
            step_dn=1.0,
        ),
        psf=GaussianPsf(sigma_px=camera["psf_sigma_px"]),
    )


def times_of(setting: Setting, one: Pass) -> Float:
    """Timetags (n,), s, about the middle of a pass."""
    images = setting.data["images"]
    length = float(images["certification_s"] if one.certification else images["gathering_s"])
    return np.arange(0.0, length + 1.0, float(images["spacing_s"])) - 0.5 * length


def sun_direction(phase_deg: float) -> Float:
    """Unit vector (3,) from a body on the boresight to the Sun, camera axes."""
    phase, azimuth = math.radians(phase_deg), math.radians(SUN_AZIMUTH_DEG)
    return np.array(
        [math.sin(phase) * math.cos(azimuth), math.sin(phase) * math.sin(azimuth), -math.cos(phase)], dtype=np.float64
    )


def preflight_sigmas_px(target: str, range_km: Float | float) -> Float:
    """Standard deviations (..., 3), px, of the models before flight: along the Sun, across it, radius.

    Source: Holt, D'Souza and Saley (2018), eqs. 28 to 30 for the Moon and 34 to 36 for the Earth.
    """
    return _PREFLIGHT[target].sigmas_px(range_km)
