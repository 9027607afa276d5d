"""The zero point of a camera: one value and one Sun for stars, surfaces and whole bodies, from every file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import giantlike as gl
from giantlike.autonomy import expected_dn
from giantlike.autonomy.body_photometry import BodyLight, Identified, PatchOfLight, PhotometricCamera, identify_body
from giantlike.campaign.render.plan import RenderPlan
from giantlike.core.photometry import SUN_W_M2_UM, Photometry
from giantlike.ephemeris import FixedEphemeris
from giantlike.ray_tracing import Lambert, disk_integrated
from giantlike.shapes import Ellipsoid
from giantlike.simulation import Sources

SAME = 1e-9
TABLE: dict[str, Any] = {
    "zero_point_e_s": 3.0e5,
    "band": "V",
    "color_term": 0.1,
    "field_term_mag": -0.4,
    "field_angle_deg": 10.0,
    "covariance_mag2": np.diag([1e-4, 4e-4, 9e-4]).tolist(),
    "scatter_mag": 0.02,
    "epoch": "2019-07-29T20:40:00",
}


def test_every_caller_expects_the_same_light_of_a_body() -> None:
    """A Lambert sphere at 40 degrees of phase, by simulation, autonomy, scene file and the formula of the Sun."""
    photometry = Photometry(zero_point_e_s=3e5)
    camera = gl.Camera.from_fov(5.0, 100, 100)
    albedo, half_angle, far_au, phase, exposure_s, gain = 0.1, 0.002, 2.5, math.radians(40.0), 0.3, 4.0
    mean = albedo * float(disk_integrated(Lambert(), phase))
    phi = 2.0 / 3.0 * (math.sin(phase) + (math.pi - phase) * math.cos(phase)) / math.pi
    sun_e_s = 3e5 * 10.0 ** (0.4 * 26.90) / far_au**2
    by_hand = sun_e_s * albedo * phi * math.sin(half_angle) ** 2 * exposure_s / gain

    total = float(photometry.disk_rate_e_s(mean, half_angle, sun_distance_au=far_au)) * exposure_s / gain
    irradiance = SUN_W_M2_UM / far_au**2 * mean * math.sin(half_angle) ** 2
    flown = float(expected_dn(irradiance, photometry, exposure_s, gain_e_per_dn=gain))
    target = gl.Target(
        name="BALL",
        shape=Ellipsoid(radii_km=np.ones(3)),
        ephemeris=FixedEphemeris(position_km=np.array([0.0, 0.0, 500.0])),
        normal_albedo=albedo,
    )
    sources = Sources(photometry=photometry, sun_distance_au=far_au)
    pixels = math.pi * math.sin(half_angle) ** 2 / float(camera.ifov_rad()) ** 2
    drawn = sources.surface_rate_e_s(camera, target) * pixels * mean / albedo * exposure_s / gain
    assert_allclose([total, flown, drawn], by_hand, rtol=SAME)

    patch = PatchOfLight(
        dn=by_hand,
        relative_sigma=1e-3,
        half_angle_rad=half_angle,
        half_angle_sigma_rad=0.0,
        phase_rad=phase,
        angle_rad=0.0,
        exposure_s=exposure_s,
        sun_distance_au=far_au,
    )
    body = BodyLight(name="BALL", brightness=lambda angle: albedo * disk_integrated(Lambert(), angle), relative_sigma=0)
    answer = identify_body(patch, [body], photometry, gain_e_per_dn=gain)
    assert isinstance(answer, Identified)
    assert abs(answer.deviations["BALL"]) * 1e-3 < SAME


def test_camera_and_scene_files_hold_the_same_table(tmp_path: Path) -> None:
    camera = gl.Camera.from_mapping({"columns": 64, "rows": 64, "fov_deg": 5.0, "psf": {}, "photometry": TABLE})
    camera.save(tmp_path / "camera.toml")
    read = gl.Camera.load(tmp_path / "camera.toml").photometry
    scene = tmp_path / "scene.toml"
    text = (
        '[camera]\nfile = "camera.toml"\n{}[[targets]]\nname = "BALL"\nshape = {{ radii_km = [1.0, 1.0, 1.0] }}\n'
        "position_km = [0.0, 0.0, 100.0]\nsun_direction = [1.0, 0.0, -1.0]\n"
        '[[images]]\nfile = "a.fits"\nepoch_utc = "2020-01-01"\nexposure_s = 1.0\n'
    )
    scene.write_text(text.format(""))
    assert read is not None
    assert read.to_mapping() == RenderPlan.load(scene).photometry.to_mapping() == TABLE
    for keys, electrons in (
        ("zero_point_e_s = 5e5", 5e5),
        ("zero_point_mag = 15.0", 1e6),
        ("aperture_m2 = 1e-4\nquantum_efficiency = 0.4", Photometry.from_aperture(1e-4, quantum_efficiency=0.4)),
    ):
        scene.write_text(text.format(f"[photometry]\n{keys}\nsigma_mag = 0.1\n"))
        found = RenderPlan.load(scene).photometry
        wanted = electrons.zero_point_e_s if isinstance(electrons, Photometry) else electrons
        assert_allclose(found.zero_point_e_s, wanted, rtol=SAME)
        assert_allclose(found.sigma_mag(), 0.1)
    scene.write_text(text.format("[photometry]\nzero_point_e_s = -1.0\n"))
    with pytest.raises(gl.DataError, match=r"scene.toml.*zero_point_e_s must be > 0"):
        RenderPlan.load(scene)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"zero_point": 1.0}, "unknown key 'zero_point'"),
        ({"zero_point_e_s": 1e5, "zero_point_mag": 12.0}, "zero_point_e_s or zero_point_mag, not both"),
        ({"zero_point_e_s": math.nan}, "zero_point_e_s must be > 0 and finite, got nan"),
        ({"zero_point_e_s": "bright"}, "zero_point_e_s must be a number, got 'bright'"),
        ({"quantum_efficiency": 0.5}, "aperture_m2 is missing"),
        ({"aperture_m2": 1.0, "quantum_efficiency": 1.5}, "quantum_efficiency must be > 0 and <= 1"),
        ({"aperture_m2": 1.0, "band": "Z"}, "band 'Z' is not known"),
        ({"sigma_mag": 0.1, "covariance_mag2": np.eye(3).tolist()}, "not both"),
        ({"covariance_mag2": [[1.0]]}, "covariance_mag2"),
        ({"band": 3}, "band must be a text"),
        ("G", "must be a table"),
    ],
)
def test_a_wrong_table_is_refused_by_name(table: object, message: str) -> None:
    with pytest.raises(gl.InputError, match=message):
        Photometry.from_mapping(table)


def test_magnitudes_of_stars_and_bodies_come_back_with_color_and_field() -> None:
    photometry = Photometry.from_mapping(TABLE)
    angle = math.radians(5.0)
    rate = photometry.star_rate_e_s([8.0, 9.0], color_bp_rp=[1.5, np.nan], angle_rad=angle)
    by_hand = 3e5 * 10.0 ** (-0.4 * np.array([8.0 - 0.1 * 0.5 + 0.4 / 4.0, 9.0 + 0.4 / 4.0]))
    assert_allclose(rate, by_hand, rtol=SAME)
    assert_allclose(photometry.magnitude(rate, color_bp_rp=[1.5, 1.0], angle_rad=angle), [8.0, 9.0], rtol=SAME)
    sigma = photometry.sigma_mag(color_bp_rp=1.5, angle_rad=angle)
    assert_allclose(sigma**2, 1e-4 + 0.25 * 4e-4 + 9e-4 / 16.0, rtol=SAME)
    assert_allclose(photometry.magnitude(photometry.sun_e_s), -26.76, rtol=SAME)


def test_the_old_name_of_an_aperture_gives_the_same_numbers() -> None:
    with pytest.warns(DeprecationWarning, match="from_aperture"):
        old = PhotometricCamera(aperture_m2=1e-4, quantum_efficiency=0.4, dn_per_electron=0.25)
    new = Photometry.from_aperture(1e-4, quantum_efficiency=0.4)
    assert_allclose(expected_dn(1e-3, old, 0.5), expected_dn(1e-3, new, 0.5, gain_e_per_dn=4.0), rtol=SAME)
