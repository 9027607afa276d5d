"""Rotation of a body as kernels declare it: pole, prime meridian and rate, with their polynomials in time."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, as_finite, require_number
from giantlike.core.units import SECONDS_PER_DAY
from giantlike.core.values import Value

_DAYS_PER_CENTURY = 36525.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rotating(Value):
    """Uniform rotation of a body about its pole, by the formulas of a text PCK without its trigonometric terms.

    Parameters
    ----------
    pole_ra_deg, pole_dec_deg : (3,) float64, deg, deg/century, deg/century^2; ``BODY..._POLE_RA``, ``_DEC``
    pm_deg : (3,) float64, deg, deg/day, deg/day^2; ``BODY..._PM``: angle W of the prime meridian, and rate
    covariance_j2000 : (4, 4) float64, deg^2 and deg^2/day, optional; of RA, Dec of the pole, W and rate

    Raises
    ------
    InputError
        A coefficient is not finite.
    """

    pole_ra_deg: Float
    pole_dec_deg: Float
    pm_deg: Float
    covariance_j2000: Float | None = None

    def __post_init__(self) -> None:
        for name in ("pole_ra_deg", "pole_dec_deg", "pm_deg"):
            given = np.atleast_1d(np.asarray(getattr(self, name), dtype=np.float64))
            object.__setattr__(self, name, as_finite(np.pad(given, (0, max(3 - len(given), 0))), (3,), name))
        Value.__post_init__(self)

    def angles_deg(self, et: float) -> Float:
        """Right ascension and declination of the pole and W at an epoch: (3,), deg."""
        days = et / SECONDS_PER_DAY
        times = (days / _DAYS_PER_CENTURY, days / _DAYS_PER_CENTURY, days)
        parts = zip((self.pole_ra_deg, self.pole_dec_deg, self.pm_deg), times, strict=True)
        return np.array([values[0] + values[1] * t + values[2] * t**2 for values, t in parts])

    def inertial_from_body(self, et: float) -> Rotation:
        """Orientation ``inertial_from_body`` at an epoch."""
        require_number(et, "et")
        ra, dec, w = self.angles_deg(et)
        return Rotation.from_euler("ZXZ", [ra + 90.0, 90.0 - dec, w], degrees=True)

    def correct(self, et: float, inertial: Rotation, rate_rad_s: float, covariance: Float) -> Rotating:
        """Rotation after a correction at an epoch, carried to J2000 with its covariance.

        The orientation at ``et`` becomes ``inertial * inertial_from_body(et)``; ``covariance`` (4, 4), rad^2 and
        rad^2/s, is of the pole toward the east and toward the north, of the angle about it, and of the rate. Further
        terms stay as declared.
        """
        before = self.angles_deg(et)
        x, z = (inertial * self.inertial_from_body(et)).as_matrix().T[[0, 2]]
        dec = math.asin(min(max(float(z[2]), -1.0), 1.0))
        ra = math.atan2(z[1], z[0]) if math.hypot(z[0], z[1]) > 0.0 else math.radians(before[0])
        node = np.array([-math.sin(ra), math.cos(ra), 0.0])
        w = math.atan2(float(x @ np.cross(z, node)), float(x @ node))
        moved = np.degrees([ra, dec, w]) - before
        moved[[0, 2]] = (moved[[0, 2]] + 180.0) % 360.0 - 180.0
        days, per_day = et / SECONDS_PER_DAY, math.degrees(rate_rad_s) * SECONDS_PER_DAY
        cosine = max(math.cos(dec), 1e-9)
        to_angles = np.array(
            [
                [1.0 / cosine, 0.0, 0.0, 0.0],
                [0.0, 1.0, 0.0, 0.0],
                [-math.tan(dec), 0.0, 1.0, -et],
                [0.0, 0.0, 0.0, SECONDS_PER_DAY],
            ]
        ) * np.degrees(1.0)
        total = to_angles @ covariance @ to_angles.T
        return replace(
            self,
            pole_ra_deg=self.pole_ra_deg + np.array([moved[0], 0.0, 0.0]),
            pole_dec_deg=self.pole_dec_deg + np.array([moved[1], 0.0, 0.0]),
            pm_deg=self.pm_deg + np.array([moved[2] - per_day * days, per_day, 0.0]),
            covariance_j2000=(total + total.T) / 2.0,
        )
