"""Real cameras that ship with the package, beside the fields of view that their instruments are known for."""

from __future__ import annotations

import numpy as np
import pytest

from giantlike.core.errors import InputError
from giantlike.presets import camera_preset, preset_names

FIELDS_DEG = {
    "cassini_nac": 0.35,  # PDS instrument descriptions
    "cassini_wac": 3.5,
    "dawn_fc2": 5.5,
    "galileo_ssi": 0.46,
    "hayabusa2_onc_w2": 69.0,
    "near_msi": 2.93,
    "osirisrex_mapcam": 4.0,
    "osirisrex_polycam": 0.8,
    "new_horizons_lorri": 0.2912,
    "voyager1_nac": 0.424,
    "voyager1_wac": 3.17,
    "voyager2_nac": 0.424,
    "voyager2_wac": 3.17,
    "voyager1_nac_geomed": 0.424 / 0.8 * 0.85,  # 1000 pixels, of which raw frames fill 800 / 0.85
    "voyager1_wac_geomed": 3.17 / 0.8 * 0.85,
    "voyager2_nac_geomed": 0.424 / 0.8 * 0.85,
    "voyager2_wac_geomed": 3.17 / 0.8 * 0.85,
    "dscovr_epic": 0.61,
    "vex_vmc": 17.5 / 413 * 516,  # 413 pixels of 0.74 mrad fill the field of the lens
    "goes_abi_full_disk": 17.4,
    "himawari_ahi_full_disk": 17.6,
}
ROUNDED = 0.02  # fields of view are quoted with two digits


@pytest.mark.parametrize("name", preset_names())
def test_a_preset_has_the_field_of_view_of_its_instrument_and_says_where_it_comes_from(name: str) -> None:
    preset = camera_preset(name)
    camera = preset.camera
    ends = camera.model.unproject([[-0.5, camera.center_px[1]], [camera.columns - 0.5, camera.center_px[1]]])
    field_deg = float(np.degrees(np.arccos(ends[0] @ ends[1])))
    assert field_deg == pytest.approx(FIELDS_DEG[name], rel=ROUNDED)
    assert preset.sources
    assert preset.about.endswith(".")


def test_the_kernel_of_the_wide_camera_gives_its_polynomial_to_a_fifth_of_a_pixel() -> None:
    camera = camera_preset("hayabusa2_onc_w2").camera
    radius_px = np.linspace(1.0, 720.0, 50)
    ideal = radius_px * (1.014 + 2.933e-7 * radius_px**2 - 1.384e-13 * radius_px**4) * 0.013 / 10.44
    rays = np.stack([0.6 * ideal, -0.8 * ideal, np.ones(50)], axis=-1)
    found = camera.model.project(rays) - 511.5
    np.testing.assert_allclose(found, np.stack([0.6 * radius_px, -0.8 * radius_px], axis=-1), rtol=0, atol=0.2)


def test_an_unknown_preset_is_refused_with_the_names_of_all() -> None:
    with pytest.raises(InputError, match=r"no camera preset 'hubble'.*galileo_ssi"):
        camera_preset("hubble")
