"""Errors that limbs share, as a few waves around the limb that all images of a pass have in common."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_floats, require_number

_GRID = 720
"""Angles at which the correlation of a smooth error is sampled: half a degree, a tenth of the shortest wave kept."""


def limb_waves(angles_rad: ArrayLike, amplitudes: ArrayLike) -> Float:
    """Waves around a limb, each by one standard deviation.

    ``angles_rad`` (n,); ``amplitudes`` (w + 1,); returns (n, 2 w + 1), in the unit of the amplitudes: 1, cos, sin, cos
    2, sin 2, .
    """
    angles = as_floats(angles_rad, (), "angles_rad")
    sigmas = as_floats(amplitudes, (), "amplitudes")
    columns = [np.full(angles.shape, sigmas[0])]
    for wave in range(1, sigmas.size):
        columns += [sigmas[wave] * np.cos(wave * angles), sigmas[wave] * np.sin(wave * angles)]
    return np.stack(columns, axis=-1)


def wave_amplitudes(sigma: float, length_rad: float, waves: int) -> Float:
    r"""Amplitudes of the waves of an error that is correlated along the limb by ``exp(-chord / length)``.

    ``length_rad``: correlation length over the radius of the limb; returns (waves + 1,), for :func:`limb_waves`, in the
    unit of ``sigma``.

    Examples
    --------
    >>> amplitudes = wave_amplitudes(1.0, 0.3, 200)
    >>> bool(abs(amplitudes[0] ** 2 + (amplitudes[1:] ** 2).sum() - 1.0) < 0.01)
    True
    """
    require_number(sigma, "sigma", least=0.0)
    require_number(length_rad, "length_rad", above=0.0)
    require_number(waves, "waves", least=0, most=_GRID // 2 - 1)
    angles = 2.0 * np.pi * np.arange(_GRID) / _GRID
    correlation = np.exp(-2.0 * np.abs(np.sin(angles / 2.0)) / length_rad)
    power = np.maximum(np.fft.rfft(correlation).real / _GRID, 0.0)[: waves + 1]
    power[1:] *= 2.0
    return sigma * np.sqrt(power)
