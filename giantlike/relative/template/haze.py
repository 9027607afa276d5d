"""Undeclared haze in a template fit: haze templates, and the limb altitude that they imply.

Haze attenuates the ground toward the limb and the terminator, adds scattered light there, and is seen beyond the limb.
No mixture of reflectance laws does all three.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.image_model.columns import Block, Prior, Use
from giantlike.ray_tracing import LommelSeeliger, Reflectance
from giantlike.ray_tracing.reflectance.law import SurfaceLaw

VEIL_DEPTH = 0.05  # vertical optical depth of the haze template; other depths are scaled from it
_LEAST_COSINE = 0.03
"""Minimum cosine of incidence and emission. Its inverse, 33, is the maximum air mass; 38 for a scale height of 1e-3
radii."""
_RING = 0.01
"""A priori standard deviation of the height of light beyond the limb, radii. The amplitudes of attenuation and
scattering are 1 +- 1 times those of :data:`VEIL_DEPTH`."""
_OF_BLUR = 0.5
"""Ratio of the standard deviation of the altitude to the blur by haze. With 1, squared errors of 24 views in six kinds
of haze (scale heights of 0.1 to 0.6 px, optical depths of 0.02 to 0.3) are 0.1 to 0.3 of the covariance, with 0 3 to 40
times it."""


@dataclass(frozen=True, slots=True)
class _Veil(SurfaceLaw):
    """Light lost from the ground in haze of a small depth or, without a ground, light scattered by the haze."""

    type_name: ClassVar[str] = "veil"

    ground: Reflectance | None = None

    def above_horizon(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        """Return the light (n,) lost or scattered; arguments as for all laws."""
        down, up = np.hypot(mu0, _LEAST_COSINE), np.hypot(mu, _LEAST_COSINE)
        own = down / (down + up) if self.ground is None else self.ground(mu0, mu, phase_rad)
        return np.asarray(-own * np.expm1(-VEIL_DEPTH * (1.0 / down + 1.0 / up)))


def haze_laws(ground: Reflectance) -> tuple[Reflectance, ...]:
    """Return laws whose images are haze templates: attenuation, scattered light, and a uniformly bright body."""
    return _Veil(ground), _Veil(None), LommelSeeliger()


def haze_block(images: Float) -> Block:
    """Return the unknowns of haze.

    ``images`` (3, h, w) DN: attenuation, scattered light, and the derivative of a uniformly bright body by the
    logarithm of its range.
    """
    prior = Prior(np.array([-1.0, 1.0, 0.0]), np.array([1.0, 1.0, _RING**-2]))
    return Block(effect="haze", cause=Cause.ALTITUDE, matrix=images, prior=prior, use=Use.WHEN_SEEN)


def haze_altitude(step: Float, altitude: Float, *, blur: float) -> float:
    """Return the standard deviation of the altitude of the limb by haze, relative to the radius.

    ``step`` (3,); ``altitude`` (3, 3), covariance of center and range by an altitude whose standard deviation is the
    radius; ``blur``: blur of the image beyond the camera's, in radii: about the scale height of the haze.
    """
    unit = np.sqrt(np.diag(altitude))
    values, vectors = np.linalg.eigh(altitude / unit / unit[:, None])
    along = vectors[:, 1:].T @ (step / unit)
    return float(np.hypot(_OF_BLUR * blur, np.sqrt(np.sum(along**2 / values[1:]))))
