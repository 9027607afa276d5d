"""Star fields and their images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from giantlike.independent.laws import Float
from giantlike.independent.light import aberrated
from giantlike.independent.psf import Psf
from giantlike.independent.views import PinholeView

DECADE_PER_MAGNITUDE = 0.51
"""Growth of the number of stars with the magnitude, log10 a magnitude: 0.6 for stars spread evenly in space, about 0.5
down to 10 mag in the Galaxy, where dust and the disk end the growth."""


@dataclass(frozen=True, eq=False)
class StarField:
    """Catalog without motion and parallax."""

    directions: Float  # (n, 3), ICRF; unit vectors
    magnitudes: Float  # (n,) mag; brightness


def random_stars(
    rng: np.random.Generator,
    count: int,
    *,
    axis: ArrayLike,
    radius_rad: float,
    magnitudes: tuple[float, float] = (2.0, 9.0),
) -> StarField:
    """Scatter stars evenly over a cap of the sky. ``axis`` in ICRF; ``magnitudes`` in mag."""
    center = np.asarray(axis, dtype=float) / np.linalg.norm(np.asarray(axis, dtype=float))
    cosines = 1.0 - rng.uniform(size=count) * (1.0 - np.cos(radius_rad))
    angles = rng.uniform(0.0, 2.0 * np.pi, size=count)
    side = np.cross(center, np.eye(3)[np.argmin(np.abs(center))])
    side /= np.linalg.norm(side)
    up = np.cross(center, side)
    sines = np.sqrt(1.0 - cosines**2)
    directions = cosines[:, None] * center + sines[:, None] * (
        np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * up
    )
    low, high = (10.0 ** (DECADE_PER_MAGNITUDE * each) for each in magnitudes)
    drawn = np.log10(low + rng.uniform(size=count) * (high - low)) / DECADE_PER_MAGNITUDE
    return StarField(directions=directions, magnitudes=drawn)


def star_image(
    field: StarField,
    view: PinholeView,
    camera_from_inertial: Rotation,
    *,
    observer_velocity_km_s: ArrayLike = (0.0, 0.0, 0.0),
    psf: Psf | None = None,
    zero_point_dn: float = 1e6,
) -> tuple[Float, Float]:
    """Render stars.

    ``observer_velocity_km_s`` in ICRF; returns (rows, columns), noise-free signal, DN, and (n, 2), places of all stars,
    px, NaN behind the camera.
    """
    psf = psf or Psf()
    seen = aberrated(field.directions, observer_velocity_km_s) @ camera_from_inertial.as_matrix().T
    places = view.project(seen)
    image = np.zeros((view.rows, view.columns))
    reach = psf.reach_px
    low, high = -float(reach), np.array([view.columns, view.rows]) - 1.0 + reach
    inside = np.flatnonzero((places > low).all(axis=1) & (places < high).all(axis=1))
    for index in inside:
        x, y = np.round(places[index]).astype(int)
        columns = np.arange(max(x - reach, 0), min(x + reach + 1, view.columns))
        rows = np.arange(max(y - reach, 0), min(y + reach + 1, view.rows))
        if columns.size and rows.size:
            signal = zero_point_dn * 10.0 ** (-0.4 * field.magnitudes[index])
            image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += signal * psf.star(
                places[index], columns.astype(float), rows.astype(float)
            )
    return image, places
