"""Expected signal of a sunlit body in a camera, and which body a patch of light is."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_floats, require, require_number
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.photometry import SUN_W_M2_UM, Photometry
from giantlike.ray_tracing import Hapke, disk_integrated


def PhotometricCamera(aperture_m2: float, *, dn_per_electron: float = 1.0, **lens: float) -> Photometry:
    """Return the :class:`~giantlike.core.photometry.Photometry` of an aperture, in numbers: its name until 0.4."""
    warnings.warn("PhotometricCamera is now Photometry.from_aperture", DeprecationWarning, stacklevel=2)
    electrons = Photometry.from_aperture(aperture_m2, **lens)
    return replace(electrons, zero_point_e_s=electrons.zero_point_e_s * dn_per_electron)


def expected_dn(
    irradiance_w_m2_um: ArrayLike,
    camera: Photometry,
    exposure_s: float,
    angle_rad: ArrayLike = 0.0,
    *,
    gain_e_per_dn: float = 1.0,
) -> Float:
    """Sum of the pixels of a body from its mean spectral irradiance at the camera.

    Parameters
    ----------
    irradiance_w_m2_um : (...), W m^-2 um^-1
    camera : Photometry; zero point of the camera
    exposure_s : float, s
    angle_rad : (...), rad; angle of the body from the boresight: the aperture is foreshortened by its cosine
    gain_e_per_dn : float, electron/DN

    Returns
    -------
    (...) float64, DN

    Notes
    -----
    :meth:`giantlike.core.photometry.Photometry.body_rate_e_s`, times the cosine of the angle and the exposure.
    """
    require_number(exposure_s, "exposure_s", least=0.0)
    light = as_floats(irradiance_w_m2_um, (), "irradiance_w_m2_um") / SUN_W_M2_UM
    foreshortened = np.cos(as_floats(angle_rad, (), "angle_rad"))
    return np.asarray(camera.body_rate_e_s(light) * foreshortened * exposure_s / gain_e_per_dn)


def chandrasekhar_sphere(single_scattering_albedo: float, phase_rad: ArrayLike) -> Float:
    """Brightness (...) of a sphere that scatters isotropically, relative to a white Lambert disk facing the Sun.

    After Chandrasekhar, ``w / 4 mu0 / (mu + mu0) H(mu) H(mu0)``, with Hapke's H, good to 4 %: no lobe and no surge.
    """
    w = single_scattering_albedo
    require(0.0 < w < 1.0, f"single_scattering_albedo must be in (0, 1), got {w}")
    normal = w / 8.0 * (3.0 / (1.0 + 2.0 * np.sqrt(1.0 - w))) ** 2
    law = Hapke(w=w)
    return np.asarray(normal * disk_integrated(law, phase_rad))


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyLight:
    """A body that may be a patch of light."""

    name: str
    brightness: Callable[[Float], Float]  # phase angle, rad, to brightness over a white Lambert disk facing the Sun
    relative_sigma: float  # relative error of that brightness: albedo variations, clouds, the law


@dataclass(frozen=True, slots=True, kw_only=True)
class PatchOfLight:
    """Measurement of a body that is not known."""

    dn: float  # sum of its pixels minus background
    relative_sigma: float  # relative error of the sum, photometric calibration included
    half_angle_rad: float  # angular radius of the disk
    half_angle_sigma_rad: float
    phase_rad: float
    angle_rad: float  # from the boresight
    exposure_s: float
    sun_distance_au: float = 1.0  # au


@dataclass(frozen=True, slots=True, kw_only=True)
class Identified:
    """The body that a patch of light is."""

    name: str
    deviations: Mapping[str, float]  # measured minus expected logarithm of the signal, in sigmas, by body


def identify_body(
    patch: PatchOfLight,
    bodies: Sequence[BodyLight],
    camera: Photometry,
    *,
    max_sigmas: float = 3.0,
    gain_e_per_dn: float = 1.0,
) -> Identified | Failure:
    """Tell which body a patch of light is by its brightness for its size and phase.

    Parameters
    ----------
    patch : PatchOfLight
    bodies : sequence of BodyLight
    camera : Photometry; zero point of the camera
    max_sigmas : float; largest deviation of the body it is, and least deviation of every other
    gain_e_per_dn : float, electron/DN

    Returns
    -------
    Identified or Failure
        Reasons: no_signal, ambiguous (several bodies are as bright), rejected (none is).

    Raises
    ------
    InputError
        There is no body, or its brightness is not positive at this phase.
    """
    require(len(bodies) > 0, "identification needs at least one body")
    if patch.dn <= 0.0:
        return Failure(Reason.NO_SIGNAL, f"the patch of light has {patch.dn:.3g} DN above background")
    deviations = {}
    for body in bodies:
        brightness = float(body.brightness(np.asarray(patch.phase_rad)))
        require(brightness > 0.0, f"{body.name}: brightness must be positive, got {brightness:g}")
        electrons = camera.disk_rate_e_s(brightness, patch.half_angle_rad, sun_distance_au=patch.sun_distance_au)
        expected = float(electrons) * patch.exposure_s * math.cos(patch.angle_rad) / gain_e_per_dn
        size = 2.0 * patch.half_angle_sigma_rad / patch.half_angle_rad
        sigma = float(np.hypot(np.hypot(patch.relative_sigma, body.relative_sigma), size))
        deviations[body.name] = float(np.log(patch.dn / expected)) / sigma
    told = ", ".join(f"{name} {value:+.1f}" for name, value in deviations.items())
    near = [name for name, value in deviations.items() if abs(value) <= max_sigmas]
    if len(near) == 1:
        return Identified(name=near[0], deviations=deviations)
    if near:
        best = sorted(near, key=lambda name: abs(deviations[name]))
        return Failure(Reason.AMBIGUOUS, f"the light is that of {' or '.join(best)} (sigmas: {told})")
    return Failure(Reason.REJECTED, f"no body is as bright as this light (sigmas: {told})")
