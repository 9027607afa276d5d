"""Reflectance laws against closed forms, against other ways to compute them, and against renders."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.special import gammaln

from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.ray_tracing import (
    REFLECTANCES,
    Akimov,
    Body,
    Hapke,
    Lambert,
    LommelSeeliger,
    LunarLambert,
    McEwen,
    Minnaert,
    OrenNayar,
    Reflectance,
    TabulatedReflectance,
    Template,
    UserReflectance,
    disk_integrated,
    reflectance_from_mapping,
    render,
)
from giantlike.ray_tracing.disk import disk_photocenter
from giantlike.shapes import sphere
from tests.tolerances import FLOAT32_SUM, FLOAT64, FLOAT64_ROOT, FLOAT64_SUM, SAMPLED, SETTLED

QUADRATURE = 1e-9  # relative, as disk_integrated promises; 1e-6 for Oren-Nayar
RENDERED_FLUX = 5e-3  # relative: 256 rays across the disk, crescents of 120 degrees have a quarter of them
RENDERED_PHOTOCENTER_RADII = 2e-3  # same reason

BRIGHT = Hapke(w=0.6, b0=0.8, h=0.06, theta_bar_deg=25.0, hg1=-0.35, hg2=0.2)
RECIPROCAL: dict[str, Reflectance] = {
    "lambert": Lambert(),
    "lommel_seeliger": LommelSeeliger(),
    "mcewen": McEwen(),
    "lunar_lambert": LunarLambert(),
    "minnaert": Minnaert(k=0.6, k_per_deg=0.002),
    "akimov": Akimov(),
    "akimov_eta": Akimov(eta=0.4),
    "oren_nayar": OrenNayar(sigma_deg=25.0),
    "hapke_smooth": Hapke(w=0.1, b0=1.0, h=0.05, hg1=-0.3),
    "hapke_rough": BRIGHT,
}
TABLE = TabulatedReflectance(
    incidence_deg=(0.0, 45.0, 90.0),
    emission_deg=(0.0, 90.0),
    phase_deg=(0.0, 60.0, 120.0),
    values=tuple(tuple(tuple(c * (p + 1.0) for p in (2.0, 1.0, 0.0)) for _ in range(2)) for c in (1.0, 0.7, 0.0)),
)
USER = UserReflectance(function=lambda mu0, mu, phase_rad: 3.0 * mu0**2 * mu * np.exp(-phase_rad), name="mine")
LAWS = RECIPROCAL | {"table": TABLE, "user": USER}

cosines = st.floats(0.02, 1.0)
azimuths = st.floats(0.0, math.pi)
every_law = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS.keys())
every_reciprocal_law = pytest.mark.parametrize("law", RECIPROCAL.values(), ids=RECIPROCAL.keys())


def _phase(mu0: Float, mu: Float, azimuth_rad: Float) -> Float:
    sines = np.sqrt((1.0 - mu0**2) * (1.0 - mu**2))
    return np.asarray(np.arccos(np.clip(mu0 * mu + sines * np.cos(azimuth_rad), -1.0, 1.0)))


def _geometries(count: int, seed: int) -> tuple[Float, Float, Float, Float]:
    """Cosines of incidence and emission, azimuth and phase of random pairs of directions above a surface."""
    random = np.random.default_rng(seed)
    mu0, mu = random.uniform(0.02, 1.0, size=(2, count))
    azimuth = random.uniform(0.0, np.pi, size=count)
    return mu0, mu, azimuth, _phase(mu0, mu, azimuth)


# --- what holds for every law ---------------------------------------------------------------------------------------


@every_law
def test_every_law_is_one_at_normal_incidence_and_dark_below_either_horizon(law: Reflectance) -> None:
    assert law(1.0, 1.0, 0.0) == pytest.approx(1.0, rel=FLOAT64)
    assert law([-0.1, 0.5, 0.0, np.nan, 1e-3], [0.5, -0.1, 0.0, 0.5, -1e-9], 1.0).tolist() == [0.0] * 5


@every_law
def test_every_law_is_finite_and_not_negative_at_the_corners_of_its_range(law: Reflectance) -> None:
    small = np.array([5e-324, 1e-300, 1e-17, 1e-12, 1e-8, 1e-4])
    values = np.concatenate([small, [0.3, 0.7, 1.0 - 1e-12, 1.0, 1.0 + 1e-15]])
    phases = np.concatenate([[0.0, 1e-300], small[2:], [1.0, 0.5 * np.pi, 3.0], np.pi - small[2:], [np.pi]])
    mu0, mu, phase = np.meshgrid(values, values, phases, indexing="ij")
    brightness = law(mu0, mu, phase)
    assert np.isfinite(brightness).all()
    assert brightness.min() >= 0.0


@every_law
def test_every_law_takes_arrays_and_numbers_and_leaves_them_as_they_are(law: Reflectance) -> None:
    mu0, mu, _, phase = _geometries(6, seed=1)
    arrays = [mu0.reshape(2, 3), mu.reshape(2, 3), phase.reshape(2, 3)]
    kept = [array.copy() for array in arrays]
    whole = law(*arrays)
    assert whole.shape == (2, 3)
    one_by_one = [float(law(*values)) for values in zip(mu0, mu, phase, strict=True)]
    assert_allclose(whole.ravel(), one_by_one, rtol=FLOAT64, atol=0)
    assert law(0.5, 0.6, phase).shape == law(mu0, 0.6, 0.7).shape == law(-0.5, 0.6, phase).shape == (6,)
    whole += 1.0
    assert all(np.array_equal(array, copy) for array, copy in zip(arrays, kept, strict=True))


@every_reciprocal_law
@settings(max_examples=30, deadline=None)
@given(mu0=cosines, mu=cosines, azimuth_rad=azimuths)
def test_sun_and_camera_can_change_places(law: Reflectance, mu0: float, mu: float, azimuth_rad: float) -> None:
    phase = _phase(np.asarray(mu0), np.asarray(mu), np.asarray(azimuth_rad))
    there, back = mu * law(mu0, mu, phase), mu0 * law(mu, mu0, phase)
    assert_allclose(
        there, back, rtol=FLOAT64_SUM, atol=FLOAT64 / 10
    )  # Akimov's cosine at the terminator loses five digits


# --- law by law -----------------------------------------------------------------------------------------------------


def test_mcewen_follows_the_formula_of_the_campaign_contract_to_the_last_bit() -> None:
    mu0, mu, _, phase = _geometries(50, seed=4)
    share = np.exp(phase * (-1.0 / math.radians(60.0)))
    assert np.array_equal(McEwen()(mu0, mu, phase), mu0 * (1.0 + share * (2.0 / (mu0 + mu) - 1.0)))
    share = np.exp(-np.degrees(phase) / 60.0)
    assert_allclose(McEwen()(mu0, mu, phase), share * 2 * mu0 / (mu0 + mu) + (1 - share) * mu0, rtol=FLOAT64, atol=0)
    assert np.array_equal(LommelSeeliger()(mu0, mu, phase), 2.0 * mu0 / (mu0 + mu))
    assert np.array_equal(Lambert()(mu0, mu, phase), mu0)


def test_lunar_lambert_mixes_by_its_polynomial_between_zero_and_one() -> None:
    mu0, mu, _, _ = _geometries(50, seed=5)
    for phase_deg, share in ((0.0, 1.0), (30.0, 0.60838), (60.0, 0.41584), (104.0, 0.0), (150.0, 0.0)):
        mixed = share * 2.0 * mu0 / (mu0 + mu) + (1.0 - share) * mu0
        assert_allclose(LunarLambert()(mu0, mu, math.radians(phase_deg)), mixed, rtol=FLOAT64, atol=0)
    half = 0.5 * (LommelSeeliger()(mu0, mu, 1.0) + Lambert()(mu0, mu, 1.0))
    assert_allclose(LunarLambert(weight=(0.5,))(mu0, mu, 1.0), half, rtol=FLOAT64, atol=0)


def test_minnaert_is_lambert_at_one_and_flat_at_full_phase_at_a_half() -> None:
    mu0, mu, _, phase = _geometries(50, seed=6)
    assert_allclose(Minnaert(k=1.0)(mu0, mu, phase), mu0, rtol=FLOAT64, atol=0)
    assert_allclose(Minnaert(k=0.5)(mu0, mu0, 0.0), 1.0, rtol=FLOAT64, atol=0)
    growing = Minnaert(k=0.5, k_per_deg=0.005)(mu0, mu, math.radians(60.0))
    assert_allclose(growing, mu0**0.8 * mu**-0.2, rtol=FLOAT64, atol=0)
    for k in (0.3, 0.5, 0.8, 1.5):
        assert disk_integrated(Minnaert(k=k), 0.0) == pytest.approx(2.0 / (2.0 * k + 1.0), rel=SETTLED)


@pytest.mark.parametrize("eta", [0.0, 0.4, 1.0])
def test_akimov_is_flat_at_full_phase_and_dark_at_the_terminator(eta: float) -> None:
    law = Akimov(eta=eta)
    mu = np.linspace(0.01, 1.0, 40)
    assert_allclose(law(mu, mu, 0.0), 1.0, rtol=FLOAT64_SUM, atol=0)
    phase = math.radians(70.0)
    longitude = np.linspace(phase - 0.5 * np.pi, 0.5 * np.pi, 42)[1:-1]
    equator = law(np.cos(longitude - phase), np.cos(longitude), phase)
    stretch = np.pi / (np.pi - phase)
    expected = np.cos(0.5 * phase) * np.cos(stretch * (longitude - 0.5 * phase)) / np.cos(longitude)
    assert_allclose(equator, expected, rtol=FLOAT64_SUM, atol=0)


@pytest.mark.parametrize("eta", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("phase_deg", [0.0, 1e-6, 20.0, 90.0, 160.0])
def test_the_disk_of_akimov_has_the_brightness_of_its_closed_form(phase_deg: float, eta: float) -> None:
    # mu D = cos(b)^(1 + n) cos(a/2) cos(c (l - a/2)) with n = eta a / (pi - a): the integral over l and b separates.
    phase = math.radians(phase_deg)
    power = 2.0 + eta * phase / (math.pi - phase)
    over_latitude = math.sqrt(math.pi) * math.exp(gammaln(0.5 * power + 0.5) - gammaln(0.5 * power + 1.0))
    expected = math.cos(0.5 * phase) * 2.0 * (math.pi - phase) / math.pi * over_latitude / math.pi
    assert disk_integrated(Akimov(eta=eta), phase) == pytest.approx(expected, rel=QUADRATURE)


def test_oren_nayar_equals_its_form_in_angles_and_without_roughness_lambert() -> None:
    mu0, mu, azimuth, phase = _geometries(500, seed=7)
    assert_allclose(OrenNayar(sigma_deg=0.0)(mu0, mu, phase), mu0, rtol=FLOAT64, atol=0)
    variance = math.radians(30.0) ** 2
    level, groove = 1.0 - 0.5 * variance / (variance + 0.33), 0.45 * variance / (variance + 0.09)
    angles = np.arccos(mu0), np.arccos(mu)
    slope = np.sin(np.maximum(*angles)) * np.tan(np.minimum(*angles))
    expected = mu0 * (level + groove * np.maximum(np.cos(azimuth), 0.0) * slope) / level
    assert_allclose(OrenNayar(sigma_deg=30.0)(mu0, mu, phase), expected, rtol=FLOAT64_SUM, atol=FLOAT64)


def _chandrasekhar(w: float, at: Float) -> Float:
    """Chandrasekhar's H function of isotropic scatterers, from its integral equation, to 1e-6."""
    nodes, weights = np.polynomial.legendre.leggauss(60)
    nodes, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    h = np.ones(60)
    for _ in range(200):  # 1 / H(x) = sqrt(1 - w) + w / 2 * integral of y H(y) / (x + y)
        h = 1.0 / (math.sqrt(1.0 - w) + 0.5 * w * ((nodes * weights * h) / (nodes[:, None] + nodes)).sum(axis=1))
    return np.asarray(
        1.0 / (math.sqrt(1.0 - w) + 0.5 * w * ((nodes * weights * h) / (at[:, None] + nodes)).sum(axis=1))
    )


@pytest.mark.parametrize(("w", "tolerance"), [(0.1, 0.004), (0.5, 0.021), (0.95, 0.041)])
def test_smooth_isotropic_hapke_is_lommel_seeliger_times_the_h_functions(w: float, tolerance: float) -> None:
    mu0, mu, _, phase = _geometries(200, seed=8)
    expected = LommelSeeliger()(mu0, mu, phase)
    approximate, exact = (
        [h(cosine) for cosine in (mu0, mu, np.ones(1))]
        for h in (
            lambda x: (1.0 + 2.0 * x) / (1.0 + 2.0 * x * math.sqrt(1.0 - w)),
            lambda x: _chandrasekhar(w, x),
        )
    )
    found = Hapke(w=w)(mu0, mu, phase)
    assert_allclose(found, expected * approximate[0] * approximate[1] / approximate[2] ** 2, rtol=FLOAT64, atol=0)
    for cosine, rough, true in zip(("mu0", "mu", "1"), approximate, exact, strict=True):
        assert_allclose(rough, true, rtol=tolerance, atol=0, err_msg=cosine)


def test_the_surge_of_hapke_halves_where_the_tangent_of_half_the_phase_is_its_width() -> None:
    dark = {b0: Hapke(w=1e-9, b0=b0, h=0.05) for b0 in (0.0, 1.0)}  # single scattering only
    phases = 2.0 * np.arctan([0.0, 0.05, 0.15])
    surge = 2.0 * dark[1.0](1.0, 0.5, phases) / dark[0.0](1.0, 0.5, phases) - 1.0
    assert_allclose(surge, [1.0, 0.5, 0.25], rtol=SETTLED, atol=0)


def test_the_lobes_of_hapke_follow_henyey_and_greenstein() -> None:
    dark = Hapke(w=1e-9, hg1=-0.4, hg2=0.25)
    phase = np.linspace(0.0, 3.0, 7)
    lobes = [(1.0 - 0.16) / (1.0 + sign * 0.8 * np.cos(phase) + 0.16) ** 1.5 for sign in (-1.0, 1.0)]
    expected = 0.75 * lobes[0] + 0.25 * lobes[1]
    assert_allclose(dark(0.7, 0.7, phase) / dark(0.7, 0.7, 0.0), expected / expected[0], rtol=SETTLED, atol=0)


def _hapke_in_angles(law: Hapke, incidence: float, emission: float, azimuth: float) -> float:
    """Hapke's law with roughness from angles, one number at a time, as the references write it down."""
    slope = math.tan(math.radians(law.theta_bar_deg))
    xi = 1.0 / math.sqrt(1.0 + math.pi * slope**2)

    def e1(angle: float) -> float:
        return math.exp(-2.0 / (math.pi * slope * math.tan(angle))) if angle > 0.0 else 0.0

    def e2(angle: float) -> float:
        return math.exp(-1.0 / (math.pi * (slope * math.tan(angle)) ** 2)) if angle > 0.0 else 0.0

    def alone(angle: float) -> float:
        return xi * (math.cos(angle) + math.sin(angle) * slope * e2(angle) / (2.0 - e1(angle)))

    def effective(angle: float, numerator: float) -> float:
        return xi * (math.cos(angle) + math.sin(angle) * slope * numerator / denominator)

    low, high = max(incidence, emission), min(incidence, emission)
    denominator = 2.0 - e1(low) - azimuth / math.pi * e1(high)
    versine = math.sin(0.5 * azimuth) ** 2
    of_low = effective(low, e2(low) - versine * e2(high))
    of_high = effective(high, math.cos(azimuth) * e2(low) + versine * e2(high))
    mu0, mu = (of_high, of_low) if incidence <= emission else (of_low, of_high)
    shadow = math.exp(-2.0 * math.tan(0.5 * azimuth))
    s = math.cos(incidence) / alone(incidence) * mu / alone(emission) * xi
    s /= 1.0 - shadow + shadow * xi * math.cos(high) / alone(high)
    cos_phase = math.cos(incidence) * math.cos(emission) + math.sin(incidence) * math.sin(emission) * math.cos(azimuth)
    surge = law.b0 / (1.0 + math.tan(0.5 * math.acos(min(cos_phase, 1.0))) / law.h)
    lobes = [
        share * (1.0 - law.hg1**2) / (1.0 + sign * 2.0 * law.hg1 * cos_phase + law.hg1**2) ** 1.5
        for share, sign in ((1.0 - law.hg2, 1.0), (law.hg2, -1.0))
    ]
    h0, h = ((1.0 + 2.0 * x) / (1.0 + 2.0 * x * math.sqrt(1.0 - law.w)) for x in (mu0, mu))
    return float(law.w / 4.0 * mu0 / (mu0 + mu) * ((1.0 + surge) * sum(lobes) - 1.0 + h0 * h) * s)


def test_rough_hapke_equals_its_form_in_angles() -> None:
    mu0, mu, azimuth, phase = _geometries(300, seed=9)
    angles = zip(np.arccos(mu0), np.arccos(mu), azimuth, strict=True)
    expected = np.array([_hapke_in_angles(BRIGHT, *(float(angle) for angle in three)) for three in angles])
    assert_allclose(
        BRIGHT(mu0, mu, phase), expected / _hapke_in_angles(BRIGHT, 0.0, 0.0, 0.0), rtol=FLOAT64_SUM, atol=0
    )


@pytest.mark.parametrize(
    ("law", "slanted", "normal"),
    [
        (Hapke(w=0.5), 0.0832883, 0.0965097),
        (Hapke(w=0.52, theta_bar_deg=30.0, hg1=0.213, hg2=1.0), 0.0911799, 0.158749),
        (Hapke(w=0.52, b0=1.0, h=1.0, theta_bar_deg=30.0), 0.111525, 0.16145),
        (Hapke(w=0.52, b0=1.0, h=1.0, theta_bar_deg=30.0, hg1=0.213, hg2=1.0), 0.1342, 0.286048),
        (LunarLambert(), 1.0 / 1.14863, 1.0 / 0.903853),
    ],
)
def test_hapke_and_lunar_lambert_give_the_numbers_of_isis(law: Reflectance, slanted: float, normal: float) -> None:
    # The expected output of the unit tests of Hapke, HapkeHen and LunarLambertMcEwen in USGS ISIS3: incidence 45,
    # emission 30 and phase 60 degrees, and all three 0; six digits are printed.
    found = law(np.cos(np.radians(45.0)), np.cos(np.radians(30.0)), np.radians(60.0))
    assert found == pytest.approx(slanted / normal, rel=FLOAT32_SUM / 2)


def test_hapke_becomes_smooth_as_its_slopes_vanish_and_darker_at_large_phase_as_they_grow() -> None:
    mu0, mu, _, phase = _geometries(300, seed=10)
    smooth = Hapke(w=0.3, b0=1.0, h=0.05, hg1=-0.3)
    nearly = Hapke(w=0.3, b0=1.0, h=0.05, hg1=-0.3, theta_bar_deg=0.01)
    assert_allclose(nearly(mu0, mu, phase), smooth(mu0, mu, phase), rtol=SETTLED, atol=0)
    disks = [
        disk_integrated(Hapke(w=0.3, theta_bar_deg=slope), math.radians(100.0)) for slope in (0.0, 10.0, 20.0, 30.0)
    ]
    assert np.all(np.diff(disks) < 0.0)


# --- whole disks ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase_deg", [0.0, 1e-3, 30.0, 90.0, 150.0, 179.0])
def test_the_disks_of_lambert_and_lommel_seeliger_follow_their_closed_forms(phase_deg: float) -> None:
    a = math.radians(phase_deg)
    lambert = 2.0 / 3.0 * (math.sin(a) + (math.pi - a) * math.cos(a)) / math.pi
    assert disk_integrated(Lambert(), a) == pytest.approx(
        lambert, rel=FLOAT64_ROOT
    )  # the form itself cancels at 179 degrees
    offset = math.pi / 8.0 * math.sin(a) * (1.0 + math.cos(a)) / (math.pi * lambert)
    assert disk_photocenter(Lambert(), a) == pytest.approx(offset, rel=FLOAT64_ROOT / 10, abs=FLOAT64)
    seeliger = 1.0 - (math.sin(a / 2) * math.tan(a / 2) * math.log(1.0 / math.tan(a / 4)) if a > 0 else 0.0)
    assert disk_integrated(LommelSeeliger(), a) == pytest.approx(seeliger, rel=QUADRATURE)


def test_a_lambert_sphere_has_the_geometric_albedo_of_two_thirds_and_a_bond_albedo_of_one() -> None:
    assert disk_integrated(Lambert(), 0.0) == pytest.approx(2.0 / 3.0, rel=QUADRATURE)
    nodes, weights = np.polynomial.legendre.leggauss(60)
    phases = 0.5 * np.pi * (nodes + 1.0)
    bond = 2.0 * np.sum(0.5 * np.pi * weights * disk_integrated(Lambert(), phases) * np.sin(phases))
    assert bond == pytest.approx(1.0, rel=QUADRATURE)


def test_disks_vanish_at_the_phase_of_half_a_turn_and_refuse_angles_beyond() -> None:
    assert disk_integrated(McEwen(), [[0.0, np.pi]]).shape == (1, 2)
    assert_allclose(disk_integrated(McEwen(), [0.0, np.pi]), [1.0, 0.0], rtol=0, atol=QUADRATURE)
    assert_allclose(disk_photocenter(McEwen(), [0.0, np.pi]), [0.0, 1.0], rtol=0, atol=QUADRATURE)
    for phase in (-0.1, 180.0, np.nan):
        with pytest.raises(InputError, match="radians"):
            disk_integrated(McEwen(), phase)


@every_law
@pytest.mark.parametrize("phase_deg", [0.0, 60.0, 120.0])
def test_a_rendered_sphere_has_the_light_of_its_law(law: Reflectance, phase_deg: float) -> None:
    model = PinholeModel(fx_px=1e5, fy_px=1e5, cx_px=32.0, cy_px=32.0)
    body = Body(
        shape=sphere(1.0),
        camera_from_body=Rotation.from_euler("xyz", [80.0, 20.0, 30.0], degrees=True),
        position_camera_km=np.array([0.0, 0.0, 1e5 / 15.0]),
        reflectance=law,
    )
    phase = math.radians(phase_deg)
    sun = [math.sin(phase), 0.0, -math.cos(phase)]
    template = render(body, model, sun_direction_camera=sun, columns=65, rows=65)
    assert isinstance(template, Template)
    light, offset = disk_integrated(law, phase), disk_photocenter(law, phase)
    assert template.brightness.sum() / (math.pi * 15.0**2) == pytest.approx(light, rel=RENDERED_FLUX)
    expected = [32.0 + 15.0 * float(offset), 32.0]
    assert_allclose(template.photocenter_px, expected, rtol=0, atol=RENDERED_PHOTOCENTER_RADII * 15.0)


def test_the_law_alone_moves_the_photocenter_of_a_disk_of_300_px_by_pixels() -> None:
    phases = np.radians([60.0, 90.0])
    offsets = np.array([150.0 * disk_photocenter(law, phases) for law in (Lambert(), LommelSeeliger())])
    assert_allclose(offsets[0] - offsets[1], [3.3, 3.9], rtol=0, atol=0.05)


# --- laws from files and from users ---------------------------------------------------------------------------------


def test_laws_come_from_campaign_files_by_name() -> None:
    assert set(REFLECTANCES) == {type(law).type_name for law in LAWS.values()} - {"user"}
    for text, law in {
        'model = "mcewen"': McEwen(),
        'model = "mcewen"\nphase_scale_deg = 50': McEwen(phase_scale_deg=50.0),
        'model = "lambert"': Lambert(),
        'model = "lommel_seeliger"': LommelSeeliger(),
        'model = "lunar_lambert"\nweight = [1, -0.01]': LunarLambert(weight=(1.0, -0.01)),
        'model = "minnaert"\nk = 0.6\nk_per_deg = 0.002': LAWS["minnaert"],
        'model = "akimov"\neta = 0.4': LAWS["akimov_eta"],
        'model = "oren_nayar"\nsigma_deg = 25': LAWS["oren_nayar"],
        'model = "hapke"\nw = 0.6\nb0 = 0.8\nh = 0.06\ntheta_bar_deg = 25.0\nhg1 = -0.35\nhg2 = 0.2': BRIGHT,
        'model = "table"\nincidence_deg = [0, 90]\nemission_deg = [0, 90]\nphase_deg = [0, 180]\n'
        "values = [[[2, 1], [2, 1]], [[0, 0], [0, 0]]]": TabulatedReflectance(
            incidence_deg=(0.0, 90.0),
            emission_deg=(0.0, 90.0),
            phase_deg=(0.0, 180.0),
            values=(((2.0, 1.0), (2.0, 1.0)), ((0.0, 0.0), (0.0, 0.0))),
        ),
    }.items():
        found = reflectance_from_mapping(tomllib.loads(text))
        assert found == law
        assert hash(found) == hash(law)
        assert repr(found) == repr(law)


AXES = {"model": "table", "incidence_deg": [0, 90], "emission_deg": [0, 90], "phase_deg": [0, 180]}


@pytest.mark.parametrize(
    ("table", "needle"),
    [
        ({"model": "phong"}, "lambert, lommel_seeliger, lunar_lambert, mcewen, minnaert"),
        ({}, "None"),
        ({"model": "lambert", "albedo": 1.0}, "lambert: unknown key 'albedo'"),
        ({"model": "mcewen", "phase_scale_deg": "60"}, "mcewen: phase_scale_deg must be a number, got '60'"),
        ({"model": "mcewen", "phase_scale_deg": True}, "must be a number, got True"),
        ({"model": "mcewen", "phase_scale_deg": 0.0}, r"must be in \(0, inf\), got 0"),
        ({"model": "mcewen", "phase_scale_deg": math.nan}, "must be a number, got nan"),
        ({"model": "hapke"}, "hapke: key 'w' is missing"),
        ({"model": "hapke", "w": 1.1}, r"hapke: w must be in \(0, 1\], got 1.1"),
        ({"model": "hapke", "w": 0.1, "b0": 1.0}, "b0 = 1 needs h > 0"),
        ({"model": "hapke", "w": 0.1, "hg1": -1.0}, r"hg1 must be in \(-1, 1\)"),
        ({"model": "hapke", "w": 0.1, "theta_bar_deg": 61}, r"theta_bar_deg must be in \[0, 60\]"),
        ({"model": "oren_nayar", "sigma_deg": -1.0}, r"sigma_deg must be in \[0, 90\]"),
        ({"model": "minnaert", "k": 3}, r"k must be in \[0, 2\]"),
        ({"model": "akimov", "eta": -0.1}, r"eta must be in \[0, inf\)"),
        ({"model": "lunar_lambert", "weight": 1.0}, "weight must be a list of numbers"),
        ({"model": "lunar_lambert", "weight": [1.0, "2"]}, r"weight\[1\] must be a number"),
        (AXES, "key 'values' is missing"),
        (AXES | {"values": [[[1.0, 1.0]]]}, r"values must have shape \(2, 2, 2\), got \(1, 1, 2\)"),
        (AXES | {"values": [[[1, 1], [1]], [[1, 1], [1, 1]]]}, "values must be numeric"),
        (AXES | {"values": [[[0, 1], [1, 1]], [[1, 1], [1, 1]]]}, "the first one > 0"),
        (AXES | {"phase_deg": [0, 0], "values": []}, "phase_deg must increase from 0"),
        (AXES | {"phase_deg": [10, 20], "values": []}, "phase_deg must increase from 0"),
    ],
)
def test_a_wrong_table_is_refused_by_name_and_value(table: dict[str, object], needle: str) -> None:
    with pytest.raises(InputError, match=f"^reflectance.*{needle}"):
        reflectance_from_mapping(table)


def test_a_tabulated_law_is_its_table_at_the_entries_linear_between_and_level_beyond() -> None:
    at = np.cos(np.radians([0.0, 45.0, 22.5]))
    assert_allclose(TABLE(at, 0.5, 0.0), [1.0, 0.7, 0.85], rtol=FLOAT64, atol=0)
    phases = np.radians([0.0, 30.0, 60.0, 120.0, 180.0])
    assert_allclose(TABLE(1.0, 0.3, phases), np.array([3.0, 2.5, 2.0, 1.0, 1.0]) / 3.0, rtol=FLOAT64, atol=0)
    other = replace(TABLE, phase_deg=(0.0, 60.0, 121.0))
    assert repr(TABLE).startswith("TabulatedReflectance(3 x 2 x 3, sha256=")
    assert repr(TABLE) == repr(replace(TABLE)) != repr(other)


def test_a_fine_table_of_a_law_renders_like_the_law() -> None:
    degrees = [np.linspace(0.0, end, count) for end, count in ((90.0, 61), (90.0, 61), (180.0, 37))]
    angles = np.meshgrid(*np.radians(degrees[0:1]), *np.radians(degrees[1:2]), np.radians(degrees[2]), indexing="ij")
    mu0, mu = np.maximum(np.cos(angles[0]), 1e-12), np.maximum(np.cos(angles[1]), 1e-12)
    incidence, emission, phase = (tuple(axis.tolist()) for axis in degrees)
    table = TabulatedReflectance(
        incidence_deg=incidence, emission_deg=emission, phase_deg=phase, values=McEwen()(mu0, mu, angles[2]).tolist()
    )
    phases = np.radians([0.0, 32.0, 77.0, 120.0])
    # steps of 1.5 degrees: second differences of a curve with unit curvature, 0.026^2 / 8, and the edge at the limb
    assert_allclose(disk_integrated(table, phases), disk_integrated(McEwen(), phases), rtol=SAMPLED, atol=0)


def test_a_law_of_the_user_is_scaled_and_checked() -> None:
    assert_allclose(USER([0.5, 0.5], [1.0, -1.0], 1.0), [0.25 * math.exp(-1.0), 0.0], rtol=FLOAT64, atol=0)
    assert repr(USER) == "UserReflectance(name='mine')"
    laws: list[tuple[Callable[[Float, Float, Float], Float], str]] = [
        (lambda mu0, mu, phase_rad: 0.0 * mu0, "> 0 at cosines 1"),
        (lambda mu0, mu, phase_rad: mu0[:0], "finite values"),
        (lambda mu0, mu, phase_rad: -mu0, "finite values"),
    ]
    for function, needle in laws:
        with pytest.raises(InputError, match=f"reflectance odd: .*{needle}"):
            UserReflectance(function=function, name="odd")
    late = UserReflectance(function=lambda mu0, mu, phase_rad: np.where(mu0 < 0.5, np.nan, 1.0), name="late")
    with pytest.raises(InputError, match="reflectance late: function must give finite values"):
        late(0.4, 0.4, 0.0)
