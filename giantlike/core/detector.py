"""Point spread function and detector of a camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, require, require_number
from giantlike.core.errors import InputError
from giantlike.core.gamma import Gamma, GammaCurve, checked_gamma
from giantlike.core.pixel_noise import UNKNOWN_READ_NOISE_E, EstimatedNoise, estimate_noise, value_step
from giantlike.core.tables import checked_table

UNKNOWN_PSF_SIGMA_PX = 0.7
"""Standard deviation, px, of the point spread function assumed for a camera that declares none.

Measured on ellipsoids 160 px wide, blurred by 0.4, 0.7 and 1.2 px: half or twice the default changes ``ellipsoid_cra``
and ``sigmoid_limb``, which estimate the width, by less than 0.2 sigma; ``cross_correlation`` by up to 0.02 px;
``moment`` by up to 0.6 px. ``ellipse_fit`` is in error by 0.2-0.3 px where the default is correct to 0.3 px, else by
0.3-2.6 px.
"""

_NOISE = ("gain_e_per_dn", "read_noise_e")
_OF_IMAGES = ("estimated", "frame_noise_dn", "relative_noise", "noise_of_image")
"""Fields that are not keys of a camera file: they follow from images and their calibration frames."""
_SPARSE = 101  # step, pixels, of the sample that is tested first


@dataclass(frozen=True, slots=True, kw_only=True)
class GaussianPsf:
    """A round Gaussian point spread function.

    Parameters
    ----------
    sigma_px : float, px; standard deviation, in [0, 20]; 0: no blur beyond the pixel; default 0.8, as in the demo
    """

    sigma_px: float = 0.8

    def __post_init__(self) -> None:
        require_number(self.sigma_px, "psf sigma_px", least=0.0, most=20.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Detector:
    """Gain, noise and limits of a detector.

    Parameters
    ----------
    gain_e_per_dn : float, electron/DN; electrons per number; 1 by default, so that numbers count electrons
    read_noise_e : float, electron; standard deviation; the default, 5, until the camera file has a measured one
    saturation_dn : float, DN; pixels at or above this value are saturated; infinite when unknown
    bias_dn : float, DN; value of a pixel without light
    step_dn : float, DN, optional
        Step of the converter; ``step_dn**2 / 12`` is the variance of quantization. Default: the step of the pixels of
        each image (:meth:`of_image`), and 1 without an image.
    estimated : bool
        True where gain and read noise are not declared and follow from each image (:meth:`of_image`); the values of
        the two fields then serve simulations only. The detector of a camera file that declares neither of the two;
        where one of them is declared, the other is the default.
    frame_noise_dn : float, DN; sigma that calibration frames and the dark current leave in calibrated pixels
    relative_noise : float; standard deviation of the response of a pixel that a flat leaves, relative to the signal
    gamma : float or 'srgb', optional
        Coding of the values: the exponent of the value that gives the signal, such as 2.2, or ``"srgb"``. Values are
        then linearized before they are used (:meth:`giantlike.image.Image.linearized`); gain, read noise and limits
        refer to the values as stored. None for values that are linear in the signal, or whose coding is unknown.
    noise_of_image : EstimatedNoise, optional; by :meth:`of_image`, where gain and read noise are not declared

    Raises
    ------
    InputError
        A value is out of range.
    """

    gain_e_per_dn: float = 1.0
    read_noise_e: float = UNKNOWN_READ_NOISE_E
    saturation_dn: float = math.inf
    bias_dn: float = 0.0
    step_dn: float | None = None
    estimated: bool = False
    frame_noise_dn: float = 0.0
    relative_noise: float = 0.0
    gamma: Gamma | None = None
    noise_of_image: EstimatedNoise | None = None

    def __post_init__(self) -> None:
        require_number(self.gain_e_per_dn, "gain_e_per_dn", above=0.0)
        require_number(self.read_noise_e, "read_noise_e", least=0.0)
        require_number(self.frame_noise_dn, "frame_noise_dn", least=0.0)
        require_number(self.relative_noise, "relative_noise", least=0.0)
        if self.step_dn is not None:
            require_number(self.step_dn, "step_dn", least=0.0)
        object.__setattr__(self, "gamma", checked_gamma(self.gamma))
        require(self.saturation_dn > 0, f"saturation_dn must be > 0, got {self.saturation_dn}")

    @classmethod
    def from_mapping(cls, table: object) -> Detector:
        """Build a detector from the ``[detector]`` table of a camera file.

        Its keys are the fields without those of images; ``estimated`` is True where neither gain nor read noise is
        given. Raises InputError where a key is unknown, or a value is not a number or out of range.
        """
        keys = [entry.name for entry in fields(cls) if entry.name not in _OF_IMAGES]
        checked = checked_table(table, "[detector]", keys, [])
        gamma = checked.get("gamma")
        checked = {key: value for key, value in checked.items() if key != "gamma"}
        for key, value in checked.items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise InputError(f"[detector]: {key} must be a number, got {value!r}")
        numbers: dict[str, Any] = {key: float(value) for key, value in checked.items()}
        return cls(**numbers, gamma=checked_gamma(gamma), estimated=not any(key in numbers for key in _NOISE))

    def to_mapping(self) -> dict[str, float | str]:
        """Return the ``[detector]`` table of a camera file, without fields that are estimated or infinite."""
        left_out = (*_OF_IMAGES, *_NOISE) if self.estimated else _OF_IMAGES
        values = {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name not in left_out}
        texts = {key: value for key, value in values.items() if isinstance(value, str)}
        numbers = {key: value for key, value in values.items() if value is not None and key not in texts}
        return {key: float(value) for key, value in numbers.items() if math.isfinite(value)} | texts

    def of_image(self, pixels: NDArray[Any], mask: Mask | None = None, *, step_dn: float | None = None) -> Detector:
        """Return the detector in the unit of the pixels of an image, with all of its noise known.

        ``pixels`` (rows, columns), DN, finite, as stored; ``mask`` (rows, columns), True where a pixel is bad;
        ``step_dn``: step of the numbers where the format of the file gives it, by default the step that the pixels
        show.

        In the result, ``step_dn`` is the step of the pixels: 0 for floating point numbers without a common one. Where
        gain and read noise are ``estimated``, they are those of :func:`~giantlike.core.pixel_noise.estimate_noise`,
        kept in ``noise_of_image``: reflectances (I/F) get a noise in their own unit. Floating point numbers that all
        lie within the declared read noise cannot be in its unit: they are treated likewise, and their bias is 0. A
        detector with a ``step_dn`` and a known noise belongs to an image already.
        """
        if self.step_dn is not None and not self.estimated:
            return self
        step = self.step_dn
        if step is None:
            step = value_step(pixels, mask) if step_dn is None else step_dn
        bias_dn = self.bias_dn
        if not self.estimated:
            stated_dn = self.read_noise_e / self.gain_e_per_dn
            good = pixels if mask is None or not mask.any() else pixels[~mask]
            reach = _reach(good, enough=stated_dn) if pixels.dtype.kind == "f" else math.inf
            if not 0.0 < reach < stated_dn:
                return replace(self, step_dn=step)
            bias_dn = 0.0
        noise = estimate_noise(pixels, mask, step_dn=step)
        return replace(
            self,
            gain_e_per_dn=noise.gain_e_per_dn,
            read_noise_e=noise.read_noise_dn * noise.gain_e_per_dn,
            bias_dn=bias_dn,
            step_dn=step,
            estimated=False,
            noise_of_image=noise,
        )

    def variance_dn2(self, signal_dn: Float) -> Float:
        """Return the noise variance (...), DN^2: shot noise, read noise, quantization and calibration frames.

        ``signal_dn`` (...), DN: signal above bias; negative signals count as zero.
        """
        light = np.maximum(signal_dn, 0.0)
        step_dn = 1.0 if self.step_dn is None else self.step_dn
        dark = (self.read_noise_e / self.gain_e_per_dn) ** 2 + step_dn**2 / 12.0 + self.frame_noise_dn**2
        variance = light / self.gain_e_per_dn + dark
        return variance + (self.relative_noise * light) ** 2 if self.relative_noise else variance

    def of_light(self, curve: GammaCurve) -> Detector:
        """Return the detector of linearized values, with the noise propagated through the curve.

        It has no ``gamma``; its read noise, gain and relative noise refer to the linear signal
        (:meth:`~giantlike.core.gamma.GammaCurve.noise_of_light`).
        """
        constant, linear, square = curve.noise_of_light(self.variance_dn2(curve.samples_dn()))
        gain_e_per_dn = 1.0 / max(linear, constant / curve.full_scale_dn)
        return replace(
            self,
            gamma=None,
            gain_e_per_dn=gain_e_per_dn,
            read_noise_e=math.sqrt(constant) * gain_e_per_dn,
            saturation_dn=self.bias_dn + float(curve.light_dn(self.saturation_dn - self.bias_dn)),
            step_dn=0.0,
            frame_noise_dn=0.0,
            relative_noise=math.sqrt(square),
        )

    def averaged(self, factor: int) -> Detector:
        """Return the detector of means over blocks of ``factor`` by ``factor`` pixels with independent noise."""
        return replace(
            self,
            gain_e_per_dn=factor**2 * self.gain_e_per_dn,
            read_noise_e=factor * self.read_noise_e,
            step_dn=(1.0 if self.step_dn is None else self.step_dn) / factor,
            frame_noise_dn=self.frame_noise_dn / factor,
            relative_noise=self.relative_noise / factor,
        )


def _reach(pixels: NDArray[Any], *, enough: float) -> float:
    """Largest minus smallest pixel, 0 without pixels; from a sample of the pixels where their range is large enough."""
    reach = 0.0
    for values in (pixels.reshape(-1)[::_SPARSE], pixels):
        reach = float(values.max()) - float(values.min()) if values.size else 0.0
        if reach >= enough:
            break
    return reach
