"""Signal of a body in an image to be taken: its numbers, its signal to noise ratio, and the exposure that suits it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from giantlike.camera import Camera
from giantlike.core.arrays import Float
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure
from giantlike.core.units import AU_KM
from giantlike.core.values import Value
from giantlike.ephemeris import Ephemeris
from giantlike.image import Image
from giantlike.planning.drawn import TruthOptions
from giantlike.ray_tracing import Lambert, LommelSeeliger, Reflectance, RenderOptions, disk_integrated, render
from giantlike.scene import Scene, TargetGeometry
from giantlike.simulation import Sources

_SAMPLING = RenderOptions(rays_per_pixel_side=1, min_rays_across=96)
"""Of the render whose signal is predicted: to 1 % of the peak of bodies of 1 to 600 px."""
_LAWS, _PHASES_RAD = 200, np.linspace(0.0, np.pi, 61)
"""Drawn brightnesses, whose 5 % quantile is known to 0.15 sigma, and the phases at which their laws are integrated."""
_DARKEST_DISK = 1e-9  # mean brightness of a disk that no longer counts as light


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LightForecast(Value):
    """Signal of a body in an image.

    Parameters
    ----------
    peak_dn : float, DN; expected brightest pixel, above bias and not cut at saturation
    quantiles_dn : (3,) float64, DN; 5, 50 and 95 % of that value, by the errors of law, albedo and zero point
    saturated : float; expected fraction of the pixels of the body that are saturated
    snr_peak : float; signal to noise ratio of the brightest pixel
    snr : float; signal to noise ratio of the whole signal, each pixel weighted by its noise
    """

    peak_dn: float
    quantiles_dn: Float
    saturated: float
    snr_peak: float
    snr: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BrightnessDraws(Value):
    """Relative brightnesses that a body may have."""

    albedo: Float  # (n,); zero_point: (n,) standard deviations; laws: (n, phases), over that of the declared law
    zero_point: Float
    laws: Float

    @classmethod
    def of_law(cls, law: Reflectance, truth: TruthOptions, seed: int) -> BrightnessDraws:
        """Draw brightnesses of a body under a declared law."""
        random = np.random.default_rng([seed, 4])
        own, lambert, flat = (
            np.maximum(disk_integrated(each, _PHASES_RAD), _DARKEST_DISK) for each in (law, Lambert(), LommelSeeliger())
        )
        shares, slopes = truth.law * random.standard_normal(
            (2, _LAWS, 1)
        )  # as of draw_law, which is linear in the first
        disks = np.maximum(1.0 + shares * (lambert - flat) / own, _DARKEST_DISK) * np.exp(-slopes * _PHASES_RAD)
        errors = random.standard_normal((2, _LAWS))
        return cls(albedo=np.exp(truth.brightness * errors[0]), zero_point=errors[1], laws=disks)

    def quantiles(self, phase_rad: float, sigma_mag: float, levels: Sequence[float]) -> Float:
        """Quantiles of the relative brightness at a phase, with the error of a zero point."""
        law = np.array([np.interp(phase_rad, _PHASES_RAD, row) for row in self.laws])
        return np.asarray(np.quantile(law * self.albedo * 10.0 ** (0.4 * sigma_mag * self.zero_point), levels))


def sun_distance_au(image: Image, scene: Scene, geometry: TargetGeometry, otherwise_au: float) -> float:
    """Distance of a target from the Sun: by its ephemeris, else from the barycenter, else as given."""
    if image.observer is None or image.camera_from_inertial is None:
        return otherwise_au
    seen_km = rotate(image.camera_from_inertial.inv(), geometry.position_camera_km)
    sun_km = scene.light.state(image.et)[0] if isinstance(scene.light, Ephemeris) and image.et is not None else 0.0
    return float(np.linalg.norm(image.observer.position_km + seen_km - sun_km)) / AU_KM


def electrons_per_s(camera: Camera, geometry: TargetGeometry, sources: Sources) -> Float | Failure:
    """Render a body as it is declared. Returns electron/s (h, w) of the pixels that its light reaches."""
    template = render(
        geometry.body(),
        camera.model,
        sun_direction_camera=geometry.sun_direction_camera,
        psf=camera.psf,
        columns=camera.columns,
        rows=camera.rows,
        options=_SAMPLING,
    )
    if isinstance(template, Failure):
        return template
    return template.brightness * sources.surface_rate_e_s(camera, geometry.target)


def forecast_light(
    rate_e_s: Float, exposure_s: float, camera: Camera, brightness: BrightnessDraws, phase_rad: float, sigma_mag: float
) -> LightForecast:
    """Signal of a body whose rates (h, w), electron/s, are known, in an exposure."""
    detector = camera.detector
    signal_dn = rate_e_s * exposure_s / detector.gain_e_per_dn
    noise_dn = np.sqrt(detector.variance_dn2(signal_dn))
    seen = signal_dn > 0.0
    return LightForecast(
        peak_dn=float(signal_dn.max()),
        quantiles_dn=signal_dn.max() * brightness.quantiles(phase_rad, sigma_mag, (0.05, 0.5, 0.95)),
        saturated=float(np.mean(signal_dn[seen] + detector.bias_dn >= detector.saturation_dn)) if seen.any() else 0.0,
        snr_peak=float(np.max(signal_dn / noise_dn)),
        snr=float(np.sqrt(np.sum((signal_dn / noise_dn) ** 2))),
    )


def choose_exposure(
    exposures_s: Sequence[float],
    forecasts: Sequence[LightForecast],
    *,
    full_dn: float,
    well_fraction: tuple[float, float],
    min_snr: float,
    longest_s: float,
) -> int:
    """Index of the shortest exposure that fills the well to its lower limit with the signal to noise ratio needed.

    Where none does, of the longest whose 95 % quantile is below the upper limit and that motion allows, or the first.
    """
    good = [
        number
        for number, (exposure_s, light) in enumerate(zip(exposures_s, forecasts, strict=True))
        if light.quantiles_dn[2] <= well_fraction[1] * full_dn and exposure_s <= longest_s
    ]
    full = [k for k in good if forecasts[k].snr >= min_snr and forecasts[k].peak_dn >= well_fraction[0] * full_dn]
    return min(full, default=max(good, default=0))
