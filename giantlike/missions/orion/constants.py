"""Numbers of the paper and of the flight that stands for it, from files next to this module; limits of agreement."""

from __future__ import annotations

import tomllib
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from giantlike.cislunar import BodyErrorModel
from giantlike.core.arrays import Float

FOOT_KM = 3.048e-4
MOON_KM, EARTH_KM = 1737.4, 6378.137  # radii: mean of the Moon, equatorial of the Earth


@cache
def table(name: str) -> dict[str, Any]:
    """Numbers of ``paper`` or ``return_leg``."""
    text = files("giantlike.missions.orion").joinpath(f"{name}.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def focal_px() -> float:
    """Focal length over pixel pitch: eq. 21."""
    camera = table("paper")["camera"]
    return float(camera["focal_mm"] / camera["pitch_um"] * 1e3)


def moon_errors() -> BodyErrorModel:
    """Eqs. 28 to 33."""
    paper = table("paper")
    relief = paper["camera"]["relief_focal_px"] * paper["terrain"]["relief_ft"] * FOOT_KM
    return _errors(paper["moon"], relief * np.array(paper["moon"]["relief_share"]))


def earth_errors(*, as_moon: bool) -> BodyErrorModel:
    """Eqs. 34 to 38; with the noise of the Moon as the paper's analysis has it."""
    earth = dict(table("paper")["earth"])
    if not as_moon:
        return _errors(earth, np.zeros(3))
    moon = moon_errors()
    return _errors(earth | {"noise_px": moon.noise_px}, moon.relief_px_km)


def _errors(numbers: dict[str, Any], relief_px_km: Float) -> BodyErrorModel:
    """Error model of a body."""
    return BodyErrorModel(
        noise_px=np.array(numbers["noise_px"]),
        relief_px_km=relief_px_km,
        bias_px=np.array(numbers["bias_px"]),
        bias_px_km=np.array(numbers["bias_px_ft"]) * FOOT_KM,
    )


ROUNDING = 0.005  # relative: numbers that the paper gives with three digits
ANALYSIS = 0.10  # required relative agreement of linear covariance and flown runs
MODEL = 0.5  # relative: an error model fitted to other images of another renderer
