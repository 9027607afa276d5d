"""Star fields with known zero points, for ``zero_point.py`` and its test: truth by ``giantlike.independent``.

Not a benchmark itself. A field has 30 to 300 catalog stars, and fainter ones that the catalog does not have; blends,
sky, wings of the point spread function, vignetting, a color term, scatter of single stars, errors of predicted places.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

import giantlike as gl
from giantlike.camera_models import PinholeModel
from giantlike.catalogs.table import StarTable
from giantlike.independent.psf import Psf
from giantlike.independent.sky import StarField, random_stars, star_image
from giantlike.independent.views import PinholeView
from giantlike.photometry import FluxOptions, ZeroPoint, ZeroPointOptions, fit_zero_point, measure_fluxes

COLUMNS, ROWS, FOCAL_PX, GAIN, READ_NOISE_E = 700, 600, 3500.0, 3.0, 9.0
BEYOND_LIMIT_MAG = 1.5
"""Stars fainter than the catalog by up to this are in the images all the same."""


def star_table(magnitude: Any, color: Any) -> StarTable:
    """Stars without places: magnitudes and colors (n,)."""
    zero = np.zeros(len(magnitude))
    return StarTable(
        ids=np.arange(len(magnitude)), ra_deg=zero, dec_deg=zero, pm_ra_mas_yr=zero, pm_dec_mas_yr=zero,
        parallax_mas=zero, radial_velocity_km_s=zero, epoch_jyear=zero + 2016.0, magnitude=magnitude,
        color_bv=zero + np.nan, sigma_mas=zero, sigma_pm_mas_yr=zero, color_bp_rp=color,
    )  # fmt: skip


def field(seed: int, method: Literal["psf", "aperture"] = "psf") -> tuple[ZeroPoint | gl.Failure, np.ndarray]:
    """One field and its truth (zero point, color and field term)."""
    random = np.random.default_rng([38, seed])
    view = PinholeView(columns=COLUMNS, rows=ROWS, focal_px=FOCAL_PX, center_px=((COLUMNS - 1) / 2, (ROWS - 1) / 2))
    corner = math.atan(math.hypot(COLUMNS, ROWS) / 2.0 / FOCAL_PX)
    zero, color_term, field_term = random.uniform(14.0, 17.0), random.normal(0.0, 0.1), random.uniform(-0.5, 0.1)
    scatter, sky, limit = random.uniform(0.0, 0.05), random.uniform(5.0, 60.0), random.uniform(7.5, 9.5)
    count = int(random.integers(30, 301))
    deeper = round(count * 10.0 ** (0.51 * BEYOND_LIMIT_MAG))
    stars = random_stars(
        random, deeper, axis=[0.0, 0.0, 1.0], radius_rad=corner, magnitudes=(3.0, limit + BEYOND_LIMIT_MAG)
    )
    color = np.clip(random.normal(1.0, 0.45, deeper), -0.2, 3.0)
    cosine = stars.directions[:, 2]
    shift = color_term * (color - 1.0) + field_term * (np.arccos(cosine) / corner) ** 2
    shown = StarField(stars.directions, stars.magnitudes - shift + random.normal(0.0, scatter, deeper))
    exposure_s = 0.5
    light, places = star_image(
        shown, view, Rotation.identity(),
        psf=Psf(random.uniform(0.6, 1.1), wing_share=random.uniform(0.0, 0.1), wing_sigma_px=2.0),
        zero_point_dn=10.0 ** (0.4 * zero) * exposure_s / GAIN,
    )  # fmt: skip
    electrons = random.poisson((light + sky) * GAIN) + random.normal(0.0, READ_NOISE_E, light.shape)
    pixels = np.clip(np.rint(electrons / GAIN + 100.0), 0, 16383).astype(np.uint16)
    camera = gl.Camera(
        name="field", columns=COLUMNS, rows=ROWS,
        model=PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=(COLUMNS - 1) / 2, cy_px=(ROWS - 1) / 2),
        detector=gl.Detector(gain_e_per_dn=GAIN, read_noise_e=READ_NOISE_E, saturation_dn=16383.0, bias_dn=100.0),
        psf=gl.GaussianPsf(sigma_px=0.8),
    )  # fmt: skip
    listed = np.flatnonzero((stars.magnitudes < limit) & camera.contains(places))
    image = gl.Image(pixels=pixels, exposure_s=exposure_s, name=f"field {seed}")
    off = random.normal(0.0, 0.1, (len(listed), 2))  # of the predicted places
    points = places[listed] + off
    listed, points = listed[camera.contains(points)], points[camera.contains(points)]
    fluxes = measure_fluxes(image, camera, points, FluxOptions(method=method))
    if isinstance(fluxes, gl.Failure):
        return fluxes, np.zeros(3)
    answer = fit_zero_point([fluxes], star_table(stars.magnitudes[listed], color[listed]), ZeroPointOptions())
    return answer, np.array([zero, color_term, field_term])
