"""Haze that nobody told of, as a template shows it: what it does to the light of a body, and the altitude to expect.

Haze darkens the ground where light passes through much of it, toward the limb and the terminator, scatters light of its
own there, and shows beyond the limb. No mixture of reflectance laws does all three.
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

VEIL_DEPTH = 0.05
"""Vertical optical depth of the haze that is looked for; others are shares of it."""
_LEAST_COSINE = 0.03
"""Cosine whose inverse is the most air that a ray meets, in vertical depths: 33; 38 at a thousandth of the radius."""
_RING = 0.01
"""A priori standard deviation of the height of light beyond the limb, of the radius. Shares of light taken and sent are
1 +- 1 of those of :data:`VEIL_DEPTH`: haze takes light from the ground and sends its own."""
_OF_BLUR = 0.5
"""Standard deviation of the altitude over the blur by haze: with all of it, squared errors of 24 views in six kinds of
haze (scale heights of 0.1 to 0.6 px, optical depths of 0.02 to 0.3) come to 0.1 to 0.3 of the covariance, with none of
it to 3 to 40 times it."""


@dataclass(frozen=True, slots=True)
class _Veil(SurfaceLaw):
    """What haze of a small depth takes from the light of the ground, or, without a ground, its own light."""

    type_name: ClassVar[str] = "veil"

    ground: Reflectance | None = None
    depth: float = VEIL_DEPTH

    def above_horizon(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        """Return the light (n,) that is taken or sent; arguments as for all laws."""
        down, up = np.hypot(mu0, _LEAST_COSINE), np.hypot(mu, _LEAST_COSINE)
        own = down / (down + up) if self.ground is None else self.ground(mu0, mu, phase_rad)
        return np.asarray(-own * np.expm1(-self.depth * (1.0 / down + 1.0 / up)))


def haze_laws(ground: Reflectance, *, depth: float = VEIL_DEPTH) -> tuple[Reflectance, ...]:
    """Return laws whose images show haze: what it takes, what it sends, and a body as bright at its limb as inside."""
    return _Veil(ground, depth), _Veil(None, depth), LommelSeeliger()


def haze_block(images: Float) -> Block:
    """Return the unknowns of haze.

    ``images`` (3, h, w) DN, what haze takes, what it sends, and the change of a body of even brightness with the
    logarithm of its range.
    """
    prior = Prior(np.array([-1.0, 1.0, 0.0]), np.array([1.0, 1.0, _RING**-2]))
    return Block(effect="haze", cause=Cause.ALTITUDE, matrix=images, prior=prior, use=Use.WHEN_SEEN)


def haze_altitude(step: Float, altitude: Float, *, blur: float) -> float:
    """Return how uncertain the altitude of the limb is by haze.

    ``step`` (3,); ``altitude`` (3, 3), covariance of center and range by an altitude whose standard deviation is the
    radius; ``blur``: blur of the image beyond that of the camera, over the radius: about the scale height of the haze.
    """
    unit = np.sqrt(np.diag(altitude))
    values, vectors = np.linalg.eigh(altitude / unit / unit[:, None])
    along = vectors[:, 1:].T @ (step / unit)
    return float(np.hypot(_OF_BLUR * blur, np.sqrt(np.sum(along**2 / values[1:]))))
