"""Numbers of Thrasher et al., and the cameras that follow from them."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel, CameraModel, ScaramuzzaModel
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.independent import PinholeView

READ_NOISE_E = 2.4  # Sony's IMX264 and IMX265, as camera makers state them
FULL_WELL_E = 10_500.0  # the same
PSF_SIGMA_PX = 0.7  # assumed: a sharp lens on 3.45 um pixels
NARROW_BITS, WIDE_BITS = 16, 12


@cache
def paper() -> dict[str, Any]:
    """Numbers of the paper by section."""
    return tomllib.loads(files(__package__).joinpath("odin.toml").read_text(encoding="utf-8"))


def narrow_focal_px() -> float:
    """Focal length of the calibrated narrow camera, px (Table 3)."""
    return float(paper()["calibration"]["focal_mm"]) * 1e3 / float(paper()["narrow"]["pixel_um"])


def narrow_camera(name: str = "narrow") -> Camera:
    """Narrow camera with the lens of Table 3."""
    size, lens, focal = paper()["narrow"], paper()["calibration"], narrow_focal_px()
    model = BrownModel(
        fx_px=focal,
        fy_px=focal,
        cx_px=(size["columns"] - 1) / 2.0,
        cy_px=(size["rows"] - 1) / 2.0,
        k1=lens["k1"],
        p1=lens["p1"],
        p2=lens["p2"],
    )
    return _camera(name, size, model, NARROW_BITS)


def rough_narrow_camera(name: str = "narrow") -> Camera:
    """Narrow camera as it is known before calibration: its size and the field of view of Table 1."""
    size = paper()["narrow"]
    rough = Camera.from_fov(size["fov_deg"], size["columns"], size["rows"], type_name="brown")
    return replace(narrow_camera(name), model=rough.model)


def narrow_view() -> PinholeView:
    """The same lens for the independent renderer."""
    size, lens = paper()["narrow"], paper()["calibration"]
    return PinholeView(
        focal_px=narrow_focal_px(),
        center_px=((size["columns"] - 1) / 2.0, (size["rows"] - 1) / 2.0),
        columns=size["columns"],
        rows=size["rows"],
        k1=lens["k1"],
        p1=lens["p1"],
        p2=lens["p2"],
    )


def wide_camera(name: str = "wide") -> Camera:
    """Wide camera with the lens of Table 2."""
    size, lens = paper()["wide"], paper()["fisheye"]
    model = ScaramuzzaModel.from_polynomial(
        a0_px=lens["a0"],
        a2=lens["a2"],
        a3=lens["a3"],
        a4=lens["a4"],
        cx_px=(size["columns"] - 1) / 2.0,
        cy_px=(size["rows"] - 1) / 2.0,
    )
    return _camera(name, size, model, WIDE_BITS)


def _camera(name: str, size: dict[str, Any], model: CameraModel, bits: int) -> Camera:
    return Camera(
        name=name,
        columns=size["columns"],
        rows=size["rows"],
        model=model,
        psf=GaussianPsf(sigma_px=PSF_SIGMA_PX),
        detector=detector(bits),
    )


def read_out(electrons: NDArray[np.float32], detector: Detector, rng: np.random.Generator) -> NDArray[np.float32]:
    """Pixels as read: noise, converter, saturation."""
    noise = rng.standard_normal(electrons.shape, dtype=np.float32)
    read = electrons + np.sqrt(electrons + np.float32(detector.read_noise_e**2)) * noise
    return np.asarray(np.minimum(np.round(read / detector.gain_e_per_dn), detector.saturation_dn), dtype=np.float32)


def detector(bits: int) -> Detector:
    """Detector whose full well fills the converter."""
    most = float(2**bits - 1)
    return Detector(gain_e_per_dn=FULL_WELL_E / most, read_noise_e=READ_NOISE_E, saturation_dn=most)
