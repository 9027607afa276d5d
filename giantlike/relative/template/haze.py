"""Haze that nobody told of, as a template shows it: what it does to the light of a body, and the altitude to expect.

Haze darkens the ground where light passes through much of it, toward the limb and the terminator, scatters light of its
own there, and shows beyond the limb. No mixture of reflectance laws does all three.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from giantlike.core.arrays import Float
from giantlike.ray_tracing import LommelSeeliger, Reflectance
from giantlike.ray_tracing.reflectance.law import SurfaceLaw
from giantlike.relative.template.covariance import LinearFit

HAZE = "altitude_sigma_km"
"""Key of the provenance of fixes whose covariance has an altitude of the limb: its standard deviation, km."""
_DEPTH = 0.05
"""Vertical optical depth of the haze that is looked for; others are shares of it."""
_LEAST_COSINE = 0.03
"""Cosine whose inverse is the most air that a ray meets, in vertical depths: 33; 38 at a thousandth of the radius."""
_RING = 0.01
"""A priori standard deviation of the height of light beyond the limb, of the radius; those of the shares are 1."""
_DIMMED_SIGMAS, _SQUARES = 5.0, 30.0
"""Darkening over its standard deviation, and squared shares over their covariance, from which on there is haze.

Of 8 views each of 15 cases of wrong laws, point spread functions, poles and sizes (120 px but for three,
benchmarks/stress.md) one comes to both, of a pole 2 degrees off; Minnaert's law told as McEwen's comes to squares of 58
to 350 and is darkened by up to 5.2 sigma, at edges that are too good to look for haze. Four of 7 bodies with relief of
1 % that no shape holds come to both, whose sigmas were too small by a fifth. Hazy ones (0.3 px of scale height, optical
depth of 0.05) come to 600 to 1,600 and 8 to 33 sigma.
"""


@dataclass(frozen=True, slots=True)
class _Veil(SurfaceLaw):
    """What haze of a small depth takes from the light of the ground, or, without a ground, its own light."""

    type_name: ClassVar[str] = "veil"

    ground: Reflectance | None = None

    def above_horizon(self, mu0: Float, mu: Float, phase_rad: Float) -> Float:
        """Return the light (n,) that is taken or sent; arguments as for all laws."""
        down, up = np.hypot(mu0, _LEAST_COSINE), np.hypot(mu, _LEAST_COSINE)
        own = down / (down + up) if self.ground is None else self.ground(mu0, mu, phase_rad)
        return np.asarray(-own * np.expm1(-_DEPTH * (1.0 / down + 1.0 / up)))


def haze_laws(ground: Reflectance) -> tuple[Reflectance, ...]:
    """Return the laws whose images show haze: what it takes, what it sends, and a body as bright at its limb as inside.

    Parameters
    ----------
    ground : Reflectance

    Returns
    -------
    tuple of Reflectance
    """
    return _Veil(ground), _Veil(), LommelSeeliger()


def haze_altitude(fit: LinearFit, residuals: Float, images: Float, gain_dn: float, altitude: Float) -> float:
    """Return how uncertain the altitude of the limb is by haze that the residuals show.

    Parameters
    ----------
    fit : LinearFit
        Whose first three parameters are the center and the logarithm of the range.
    residuals : (h, w) float64, DN
    images : (3, h, w) float64
        What haze takes, what it sends, and the change of a body of even brightness with the logarithm of its range.
    gain_dn : float, DN
        Signal of brightness 1.
    altitude : (3, 3) float64
        Covariance of center and range by an altitude whose standard deviation is the radius.

    Returns
    -------
    float
        Standard deviation over the radius: with it, center and range are one standard deviation, of both errors of the
        altitude together, from where they come to when the haze is put into the model. 0 where the residuals show none.
    """
    shares, sigmas, step, squares = fit.omitted(residuals, gain_dn * images, np.array([1.0, 1.0, _RING]))
    if squares < _SQUARES or shares[0] > -_DIMMED_SIGMAS * sigmas[0]:
        return 0.0
    unit = np.sqrt(np.diag(altitude))
    values, vectors = np.linalg.eigh(altitude / unit / unit[:, None])
    along = vectors[:, 1:].T @ (step[:3] / unit)
    return float(np.sqrt(np.sum(along**2 / values[1:])))
