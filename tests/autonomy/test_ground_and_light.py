"""Refraction, the light of bodies, and bodies found in wide images, against physics that shares no formula."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import dblquad
from scipy.spatial.transform import Rotation

import giantlike as gl
from giantlike.autonomy import expected_dn, find_patches, identify_body
from giantlike.autonomy.body_photometry import BodyLight, PatchOfLight, chandrasekhar_sphere
from giantlike.autonomy.refraction import SiteAtmosphere, apply_refraction, remove_refraction
from giantlike.core.arrays import Float, unit
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Reason
from giantlike.core.photometry import Photometry
from giantlike.core.units import ARCSEC_PER_RAD
from giantlike.independent import EllipsoidBody, PinholeView, Pose, Psf, render_body
from giantlike.missions.odin.ground import shell_refraction

AIR = SiteAtmosphere(pressure_hpa=1010.0, temperature_c=15.0)
SHELLS_ARCSEC = 2.0  # one exponential of the density instead of the air's own, at 11 degrees; 0.2 above 20
CLOSED_FORM_OF_H = 0.05  # Hapke's H, 4 % off for the brightest media


def test_refraction_agrees_with_snells_law_through_shells_of_air() -> None:
    zenith = np.array([0.0, 0.0, 1.0])
    for degrees, limit in ((20.0, 0.2), (60.0, 0.2), (70.0, 0.5), (79.0, SHELLS_ARCSEC)):
        observed = np.radians(degrees)
        seen = np.array([np.sin(observed), 0.0, np.cos(observed)])
        true = remove_refraction(seen, zenith, AIR)
        lowered = float(np.arctan2(true[0], true[2])) - observed
        by_shells = float(np.interp(observed, *shell_refraction()))
        assert abs(lowered - by_shells) * ARCSEC_PER_RAD < limit


def test_refraction_raises_toward_the_zenith_and_is_undone() -> None:
    rng = np.random.default_rng(3)
    zenith = np.array([0.3, -0.4, 0.87])
    directions = unit(rng.normal(size=(200, 3)) * 0.5 + 2.0 * unit(zenith))
    seen = apply_refraction(directions, zenith, AIR)
    assert (unit(seen) @ unit(zenith) >= directions @ unit(zenith)).all()
    assert_allclose(remove_refraction(seen, zenith, AIR), directions, atol=1e-12)
    assert_allclose(apply_refraction(directions, zenith, SiteAtmosphere(pressure_hpa=0.0)), directions, atol=1e-15)
    with pytest.raises(InputError, match="elevations of 10 degrees"):
        apply_refraction([1.0, 0.0, 0.05], [0.0, 0.0, 1.0], AIR)


def test_the_sum_of_pixels_is_photons_times_efficiency() -> None:
    """One watt at 0.6 um is 3.02e18 photons a second; over a narrow band the formula says just that."""
    camera = Photometry.from_aperture(2e-4, shortest_um=0.599, longest_um=0.601, quantum_efficiency=0.4)
    watts = 1e-3 * 0.002 * 2e-4  # W m^-2 um^-1, um, m^2
    assert_allclose(float(expected_dn(1e-3, camera, 0.5)), watts * 3.0206e18 * 0.4 * 0.5, rtol=1e-4)
    tilted = float(expected_dn(1e-3, camera, 0.5, np.radians(60.0)))
    assert_allclose(tilted, watts * 3.0206e18 * 0.4 * 0.5 / 2.0, rtol=1e-4)
    assert_allclose(float(expected_dn(3e-3, camera, 0.5)), 3.0 * float(expected_dn(1e-3, camera, 0.5)), rtol=1e-12)


def _h_function(w: float) -> tuple[Float, Float]:
    """Chandrasekhar's H for isotropic scattering by iteration of his integral equation, at Gauss nodes."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    mu, weights = (nodes + 1.0) / 2.0, weights / 2.0
    h = np.ones_like(mu)
    for _ in range(400):
        h = 1.0 / (np.sqrt(1.0 - w) + w / 2.0 * np.sum(weights * h * mu / (mu[:, None] + mu), axis=1))
    return mu, h


@pytest.mark.parametrize("phase_deg", [0.0, 60.0])
def test_a_sphere_of_isotropic_scatterers_is_as_bright_as_chandrasekhars_function_makes_it(phase_deg: float) -> None:
    w, phase = 0.6, np.radians(phase_deg)
    mu, h = _h_function(w)

    def brightness(longitude: float, latitude: float) -> float:
        emission = np.cos(latitude) * np.cos(longitude)
        incidence = np.cos(latitude) * np.cos(longitude - phase)
        if incidence <= 0.0 or emission <= 0.0:
            return 0.0
        scattered = w / 4.0 / (incidence + emission) * np.interp(incidence, mu, h) * np.interp(emission, mu, h)
        return float(scattered * incidence * emission * np.cos(latitude) / np.pi)

    total, _ = dblquad(brightness, -np.pi / 2, np.pi / 2, phase - np.pi / 2, np.pi / 2, epsabs=1e-4)
    assert_allclose(float(chandrasekhar_sphere(w, phase)), total, rtol=CLOSED_FORM_OF_H)


EARTH = BodyLight(name="EARTH", brightness=lambda phase: 0.43 * np.cos(phase / 2.0) ** 4, relative_sigma=0.2)
MOON = BodyLight(name="MOON", brightness=lambda phase: 0.12 * np.cos(phase / 2.0) ** 4, relative_sigma=0.2)
LIGHT = Photometry.from_aperture(1e-6)


def _patch(albedo: float, *, size_sigma: float = 0.05) -> PatchOfLight:
    irradiance = 1500.0 * albedo * np.cos(np.radians(20.0)) ** 4 * np.sin(0.01) ** 2
    return PatchOfLight(
        dn=float(expected_dn(irradiance, LIGHT, 1e-4)),
        relative_sigma=0.05,
        half_angle_rad=0.01,
        half_angle_sigma_rad=0.01 * size_sigma,
        phase_rad=np.radians(40.0),
        angle_rad=0.0,
        exposure_s=1e-4,
    )


def test_a_body_is_named_by_its_brightness_or_not_at_all() -> None:
    for albedo, name in ((0.43, "EARTH"), (0.12, "MOON"), (0.14, "MOON")):
        answer = identify_body(_patch(albedo), (EARTH, MOON), LIGHT)
        assert not isinstance(answer, gl.Failure)
        assert answer.name == name
    for patch, reason in (
        (_patch(3.0), Reason.REJECTED),
        (_patch(0.23, size_sigma=0.3), Reason.AMBIGUOUS),
        (_patch(-1.0), Reason.NO_SIGNAL),
    ):
        answer = identify_body(patch, (EARTH, MOON), LIGHT)
        assert isinstance(answer, gl.Failure)
        assert answer.reason is reason


@pytest.mark.parametrize("phase_deg", [20.0, 90.0, 130.0])
def test_a_wide_search_measures_place_light_and_size_of_a_sphere(phase_deg: float) -> None:
    """Truth by the independent renderer; the size along the cusps is right at every phase."""
    camera = gl.Camera(
        name="wide",
        columns=200,
        rows=160,
        model=gl.Camera.from_fov(30.0, 200, 160).model,
        psf=gl.GaussianPsf(sigma_px=0.7),
        detector=gl.Detector(read_noise_e=3.0, saturation_dn=6e4),
    )
    focal = camera.model.focal_length_px
    view = PinholeView(focal_px=focal, center_px=(99.5, 79.5), columns=200, rows=160)
    place = np.array([20.0, -12.0, 300.0])
    phase = np.radians(phase_deg)
    toward = unit(place)
    side = unit(np.cross(toward, [0.2, 1.0, 0.1]))
    sun = -np.cos(phase) * toward + np.sin(phase) * side
    radius = 8.0
    light = render_body(
        EllipsoidBody(radius),
        view,
        Pose(place, Rotation.identity(), sun),
        law="lommel_seeliger",
        peak_dn=5000.0,
        psf=Psf(sigma_px=0.7),
    )
    rng = np.random.default_rng(4)
    pixels = rng.poisson(light + 20.0) + rng.normal(0.0, 3.0, light.shape)
    patches = find_patches(gl.Image(pixels=pixels), camera)
    assert not isinstance(patches, gl.Failure)
    assert len(patches) == 1
    found = patches[0]
    assert abs(found.dn / light.sum() - 1.0) < 0.02
    assert not found.saturated
    half_angle = float(np.arcsin(radius / np.linalg.norm(place)))
    assert abs(found.half_angle_rad(sun) / half_angle - 1.0) < 0.12
    off = float(np.arccos(np.clip(found.direction_camera @ toward, -1.0, 1.0)))
    assert off < half_angle


def test_a_dark_image_has_no_body() -> None:
    rng = np.random.default_rng(1)
    answer = find_patches(gl.Image(pixels=rng.normal(100.0, 3.0, (80, 90))), gl.Camera.from_fov(30.0, 90, 80))
    assert isinstance(answer, gl.Failure)
    assert answer.reason is Reason.NO_SIGNAL
