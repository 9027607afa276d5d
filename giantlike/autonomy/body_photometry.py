"""Expected signal of a sunlit body in a camera, and which body a patch of light is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_floats, require, require_number
from giantlike.core.outcomes import Failure, Reason
from giantlike.ray_tracing import Hapke, disk_integrated

PLANCK_J_S = 6.62607015e-34
"""Exact by the definition of the kilogram."""
LIGHT_M_S = 299_792_458.0
"""Exact by the definition of the meter."""
SUN_W_M2_UM = 1_500.0
"""Mean spectral irradiance of the Sun at 1 au between 0.4 and 0.9 um, W m^-2 um^-1, to 5 %: a blackbody of 5,772 K of
half angle 0.2666 degrees has 1,466 there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotometricCamera:
    """Photometric constants of a camera, which turn the light of a body into numbers: Thrasher et al., eq. 23.

    aperture_m2: m^2; area of the aperture.
    shortest_um, longest_um: pass band.
    quantum_efficiency: mean over the pass band, with the transmission of the optics.
    dn_per_electron: analog gain.
    """

    aperture_m2: float
    shortest_um: float = 0.4
    longest_um: float = 0.9
    quantum_efficiency: float = 0.5
    dn_per_electron: float = 1.0

    def __post_init__(self) -> None:
        require_number(self.aperture_m2, "aperture_m2", above=0.0)
        require_number(self.shortest_um, "shortest_um", above=0.0)
        require_number(self.longest_um, "longest_um", above=self.shortest_um)
        require_number(self.quantum_efficiency, "quantum_efficiency", above=0.0, most=1.0)
        require_number(self.dn_per_electron, "dn_per_electron", above=0.0)


def expected_dn(
    irradiance_w_m2_um: ArrayLike, camera: PhotometricCamera, exposure_s: float, angle_rad: ArrayLike = 0.0
) -> Float:
    r"""Sum of the pixels of a body from its mean spectral irradiance at the camera.

    Parameters
    ----------
    irradiance_w_m2_um : (...), W m^-2 um^-1
    camera : PhotometricCamera
    exposure_s : float, s
    angle_rad : (...), rad
        Angle of the body from the boresight: the aperture is foreshortened by its cosine.

    Returns
    -------
    (...) float64, DN

    Notes
    -----
    :math:`J = \alpha \bar Q \bar E (\lambda_2^2 - \lambda_1^2) / (2 h c) A \cos\phi \tau`. Two slips of the paper are
    left out: its eq. 23 has the mean irradiance twice, and its eq. 21 multiplies by the aperture that eqs. 22 and 23
    multiply by again; irradiance is intensity over the square of the distance.

    References
    ----------
    .. [1] Thrasher et al., Development of the Optical Deep-Space Instrument for Navigation (ODIN), eqs. 21-23.
    """
    require_number(exposure_s, "exposure_s", least=0.0)
    meters = 1e-6
    per_watt = (camera.longest_um**2 - camera.shortest_um**2) * meters**2 / (2.0 * PLANCK_J_S * LIGHT_M_S)
    electrons = (
        camera.quantum_efficiency
        * (as_floats(irradiance_w_m2_um, (), "irradiance_w_m2_um") / meters)
        * per_watt
        * camera.aperture_m2
        * np.cos(as_floats(angle_rad, (), "angle_rad"))
        * exposure_s
    )
    return np.asarray(camera.dn_per_electron * electrons)


def chandrasekhar_sphere(single_scattering_albedo: float, phase_rad: ArrayLike) -> Float:
    """Brightness of a sphere that scatters isotropically, relative to a white Lambert disk of its size facing the Sun.

    ``phase_rad`` (...); returns (...).

    A deep medium of isotropic scatterers reflects ``w / 4 mu0 / (mu + mu0) H(mu) H(mu0)`` after Chandrasekhar; with
    Hapke's closed form of H, good to 4 %, that is his law without lobe and opposition surge.
    """
    w = single_scattering_albedo
    require(0.0 < w < 1.0, f"single_scattering_albedo must be in (0, 1), got {w}")
    normal = w / 8.0 * (3.0 / (1.0 + 2.0 * np.sqrt(1.0 - w))) ** 2
    law = Hapke(w=w)
    return np.asarray(normal * disk_integrated(law, phase_rad))


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyLight:
    """A body that may be a patch of light.

    brightness: phase angle (rad) to the brightness relative to a white Lambert disk facing the Sun, such as
        :func:`chandrasekhar_sphere`.
    relative_sigma: relative error of that brightness: albedo variations, clouds, the law.
    """

    name: str
    brightness: Callable[[Float], Float]
    relative_sigma: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PatchOfLight:
    """Measurement of a body that is not known.

    dn: sum of its pixels minus background.
    relative_sigma: relative error of the sum, photometric calibration included.
    half_angle_rad: angular radius of the disk.
    angle_rad: from the boresight.
    sun_distance_au: au.
    """

    dn: float
    relative_sigma: float
    half_angle_rad: float
    half_angle_sigma_rad: float
    phase_rad: float
    angle_rad: float
    exposure_s: float
    sun_distance_au: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Identified:
    """The body that a patch of light is.

    deviations: measured minus expected logarithm of the signal, in sigmas, by body.
    """

    name: str
    deviations: Mapping[str, float]


def identify_body(
    patch: PatchOfLight, bodies: Sequence[BodyLight], camera: PhotometricCamera, *, max_sigmas: float = 3.0
) -> Identified | Failure:
    """Tell which body a patch of light is by its brightness for its size and phase.

    Parameters
    ----------
    patch : PatchOfLight
    bodies : sequence of BodyLight
    camera : PhotometricCamera
    max_sigmas : float
        Largest deviation of the body it is, and least deviation of every other.

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
        irradiance = SUN_W_M2_UM / patch.sun_distance_au**2 * brightness * np.sin(patch.half_angle_rad) ** 2
        expected = float(expected_dn(irradiance, camera, patch.exposure_s, patch.angle_rad))
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
