"""Light time and stellar aberration out of measured vectors, and in derivatives by positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.light import boost_jacobian, boosted
from giantlike.core.units import SPEED_OF_LIGHT_KM_S
from giantlike.core.values import Value
from giantlike.scene import Circumstances


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Removed(Value):
    """A measured vector from the spacecraft to a target, with light time and stellar aberration taken out."""

    # in ICRF axes; from the spacecraft at the epoch to the target when the light left it: aberration taken out
    astrometric_km: Float
    # in ICRF axes; from the spacecraft to the target, both at the epoch; None where the motion of the target is not
    # known
    geometric_km: Float | None
    light_time_s: float


def removed(apparent_km: Float, circumstances: Circumstances) -> Removed:
    """Take stellar aberration and light time out of an apparent vector, ICRF axes.

    Where the light time is not the predicted one, the target has moved meanwhile by its velocity.
    """
    astrometric_km = boosted(apparent_km, -circumstances.observer_velocity_km_s)
    light_time_s = float(np.linalg.norm(astrometric_km)) / SPEED_OF_LIGHT_KM_S
    geometric_km = None
    if circumstances.target_motion_km is not None and circumstances.target_velocity_km_s is not None:
        longer_s = light_time_s - circumstances.light_time_s
        geometric_km = astrometric_km + circumstances.target_motion_km + longer_s * circumstances.target_velocity_km_s
    return Removed(astrometric_km=astrometric_km, geometric_km=geometric_km, light_time_s=light_time_s)


def apparent_by_position(astrometric_km: Float, circumstances: Circumstances) -> Float:
    r"""Derivative (3, 3) of the apparent vector by the position of the target, ICRF; the negative by the spacecraft's.

    The vector ``v = t(et - |v|/c) - s`` from the spacecraft ``s`` to the target ``t`` changes by
    ``(I + w n^T / c)^-1 (dt - ds)`` with the velocity ``w`` of the target (if unknown, of the spacecraft: in error by
    1e-4) and the unit direction ``n``, and the boost by its own derivative.
    """
    velocity = circumstances.target_velocity_km_s
    if velocity is None:
        velocity = circumstances.observer_velocity_km_s
    direction = astrometric_km / np.linalg.norm(astrometric_km)
    longer = np.eye(3) + np.outer(velocity, direction) / SPEED_OF_LIGHT_KM_S
    return boost_jacobian(astrometric_km, circumstances.observer_velocity_km_s) @ np.linalg.inv(longer)
