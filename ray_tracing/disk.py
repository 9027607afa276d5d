"""Light of a whole sphere under a reflectance law: its mean brightness and its photocenter."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_floats, require
from giantlike.ray_tracing.reflectance import Reflectance

_NODES = 96  # of the quadrature along either side of the mirror meridian: accurate to 1e-9 for smooth laws


def disk_integrated(law: Reflectance, phase_rad: ArrayLike) -> Float:
    """Mean brightness of the disk of a far sphere, over the whole disk, lit or not.

    Parameters
    ----------
    law : Reflectance
    phase_rad : (...), rad; phase angles, in [0, pi]

    Returns
    -------
    (...) float64
        Relative to a surface lit and seen along its normal. Times the normal albedo, the value at zero phase is the
        geometric albedo (2/3 for Lambert), and over that value it is the disk-integrated phase function.

    Raises
    ------
    InputError
        A phase angle is not in [0, pi].

    Notes
    -----
    ``1/pi`` times the integral of ``law mu`` over the lit and visible lune of the unit sphere, in photometric longitude
    and latitude, by Gauss-Legendre on either side of the mirror meridian, where some laws have a kink. Right to 1e-9,
    to 1e-6 for Oren-Nayar; tables are limited by their kinks.

    Examples
    --------
    >>> from giantlike.ray_tracing import Lambert
    >>> round(float(disk_integrated(Lambert(), 0.0)), 9)
    0.666666667
    """
    return _moments(law, phase_rad)[0]


def disk_photocenter(law: Reflectance, phase_rad: ArrayLike) -> Float:
    """Photocenter (...) of a far sphere towards the Sun, radii; 0 at zero phase, in the limit 1 at pi."""
    light, offset = _moments(law, phase_rad)
    return np.where(light > 0.0, offset / np.where(light > 0.0, light, 1.0), 1.0)


def _moments(law: Reflectance, phase_rad: ArrayLike) -> tuple[Float, Float]:
    """Mean over the disk of brightness, and of brightness times the distance towards the Sun in radii."""
    phases = as_floats(phase_rad, (), "phase_rad")
    require(bool(np.all((phases >= 0.0) & (phases <= np.pi))), "phase_rad must be in [0, pi], radians")
    moments = np.array([_moments_at(law, float(phase)) for phase in phases.ravel()]).reshape(-1, 2)
    return moments[:, 0].reshape(phases.shape), moments[:, 1].reshape(phases.shape)


def _moments_at(law: Reflectance, phase_rad: float) -> tuple[float, float]:
    unit, weight = _quadrature()
    latitude = 0.5 * np.pi * unit
    # Longitude from the terminator to the mirror meridian and from there to the limb; the camera is at 0, the Sun at
    # the phase angle.
    quarter = 0.5 * (np.pi - phase_rad)
    from_mirror = np.concatenate([-quarter * unit[::-1], quarter * unit])
    longitude = from_mirror + 0.5 * phase_rad
    cos_latitude = np.cos(latitude)[:, None]
    mu0, mu = cos_latitude * np.cos(longitude - phase_rad), cos_latitude * np.cos(longitude)
    area = np.outer(0.5 * np.pi * weight, quarter * np.concatenate([weight[::-1], weight])) * cos_latitude
    light = (2.0 / np.pi) * law(mu0, mu, phase_rad) * mu * area  # both hemispheres
    return float(light.sum()), float((light * cos_latitude * np.sin(longitude)).sum())


@lru_cache(maxsize=1)
def _quadrature() -> tuple[Float, Float]:
    """Nodes and weights on [0, 1], denser at 1, where laws go to 0 as a root."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    nodes, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    return nodes * (2.0 - nodes), weights * 2.0 * (1.0 - nodes)
