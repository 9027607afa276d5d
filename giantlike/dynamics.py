"""Flight of a spacecraft under a central body, third bodies and a slowly varying acceleration, with its derivatives.

Point masses only: no oblateness, drag or solar radiation pressure; these go into the unmodeled acceleration of a
filter. The state transition is integrated along with the state (DOP853).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_floats, require
from giantlike.core.units import AU_KM, J2000_JD, SECONDS_PER_DAY
from giantlike.core.values import Value

__all__ = [
    "Flight",
    "PointMasses",
    "ThirdBody",
    "cislunar",
    "fly",
    "moon_position_km",
    "sun_position_km",
]

GM_EARTH_KM3_S2 = 398_600.435507  # km^3/s^2, of the ephemeris DE440
GM_MOON_KM3_S2 = 4_902.800118  # km^3/s^2, of the ephemeris DE440
GM_SUN_KM3_S2 = 132_712_440_041.279419  # km^3/s^2, of the ephemeris DE440
SPLINE_STEP_S = 3600.0  # the Moon turns by 0.01 rad: a cubic spline errs by a fourth power of it, a centimeter or two
RELATIVE_TOLERANCE = 1e-11
"""Of the integrator: 4 mm at the distance of the Moon, a hundred-thousandth of the best optical range."""
ABSOLUTE_TOLERANCE = 1e-9
"""Of the integrator, km and km/s: speeds near the apogee are 0.1 km/s and want the digits of the relative one."""


@dataclass(frozen=True, slots=True)
class ThirdBody:
    """A body that pulls on the spacecraft and on the central body.

    Parameters
    ----------
    gm_km3_s2 : float, km^3/s^2
    position_km : callable; position (3,), km, from the central body, inertial axes, at TDB s past J2000
    """

    gm_km3_s2: float
    position_km: Callable[[float], Float]


@dataclass(frozen=True, slots=True)
class PointMasses:
    """Gravity of a central body and of third bodies, in axes that do not turn, about the central body.

    Parameters
    ----------
    gm_km3_s2 : float, km^3/s^2; of the central body
    third_bodies : tuple of ThirdBody
    """

    gm_km3_s2: float
    third_bodies: tuple[ThirdBody, ...] = ()

    def pull(self, et: float, position_km: Float) -> tuple[Float, Float]:
        """Acceleration (..., 3), km/s^2, and gradient (..., 3, 3), 1/s^2, at positions from the central body."""
        acceleration, gradient = _attraction(self.gm_km3_s2, position_km)
        for body in self.third_bodies:
            place = body.position_km(et)
            direct, slope = _attraction(body.gm_km3_s2, position_km - place)
            acceleration = acceleration + direct - body.gm_km3_s2 * place / np.linalg.norm(place) ** 3
            gradient = gradient + slope
        return acceleration, gradient


def moon_position_km(et: float) -> Float:
    """Position of the Moon from the Earth by an analytic theory.

    Parameters
    ----------
    et : float, TDB seconds past J2000

    Returns
    -------
    (3,) float64, km, GCRS axes
        Within about 30 km of an integrated ephemeris; use the latter where images determine the Moon better.
    """
    import erfa

    return np.asarray(erfa.moon98(J2000_JD, et / SECONDS_PER_DAY)["p"]) * AU_KM


def sun_position_km(et: float) -> Float:
    """Position of the Sun from the Earth by an analytic theory.

    Parameters
    ----------
    et : float, TDB seconds past J2000

    Returns
    -------
    (3,) float64, km, axes of the ICRF
    """
    import erfa

    return -np.asarray(erfa.epv00(J2000_JD, et / SECONDS_PER_DAY)[0]["p"]) * AU_KM


def fit_spline(position_km: Callable[[float], Float], first: float, last: float) -> Callable[[float], Float]:
    """Positions by a cubic spline through hourly ones, in a tenth of the time; TDB seconds past J2000."""
    from scipy.interpolate import CubicSpline

    ets = np.arange(first - 3.0 * SPLINE_STEP_S, last + 4.0 * SPLINE_STEP_S, SPLINE_STEP_S)
    spline = CubicSpline(ets, [position_km(et) for et in ets.tolist()])
    return lambda et: np.asarray(spline(et))


def cislunar(first: float | None = None, last: float | None = None) -> PointMasses:
    """Gravity of the Earth, with the Moon and the Sun by analytic theories.

    Parameters
    ----------
    first, last : float, TDB seconds past J2000, optional; times of the flight: positions are splined, which is faster

    Returns
    -------
    PointMasses
        About the Earth.
    """
    places: tuple[Callable[[float], Float], ...] = (moon_position_km, sun_position_km)
    if first is not None and last is not None:
        places = tuple(fit_spline(place, first, last) for place in places)
    pulls = zip((GM_MOON_KM3_S2, GM_SUN_KM3_S2), places, strict=True)
    return PointMasses(GM_EARTH_KM3_S2, tuple(ThirdBody(gm, place) for gm, place in pulls))


@dataclass(frozen=True, slots=True, eq=False)
class Flight(Value):
    """A propagated state, with its derivatives by the initial state and the acceleration.

    Parameters
    ----------
    state : (..., 6) float64, km and km/s
    by_state : (..., 6, 6) float64; state transition matrix
    by_acceleration : (..., 6, 3) float64; derivative by the acceleration at the start, s^2 and s
    """

    state: Float
    by_state: Float
    by_acceleration: Float


def fly(
    dynamics: PointMasses,
    et: float,
    state: ArrayLike,
    until: float,
    *,
    acceleration_km_s2: ArrayLike = (0.0, 0.0, 0.0),
    time_constant_s: float = math.inf,
) -> Flight:
    """Integrate states and their derivatives.

    Parameters
    ----------
    dynamics : PointMasses
    et, until : float, TDB seconds past J2000; start and end; the end may be earlier
    state : (..., 6) array_like, km and km/s; relative to the central body; many fly with common steps
    acceleration_km_s2 : (..., 3) array_like, km/s^2; further acceleration at the start
    time_constant_s : float, s; it decays with this; infinite for a constant one

    Raises
    ------
    InputError
        The flight meets a center of gravity, or the integration fails.
    """
    flights = fly_through(
        dynamics, et, state, [until], acceleration_km_s2=acceleration_km_s2, time_constant_s=time_constant_s
    )
    return Flight(flights.state[0], flights.by_state[0], flights.by_acceleration[0])


def fly_through(
    dynamics: PointMasses,
    et: float,
    state: ArrayLike,
    times: ArrayLike,
    *,
    acceleration_km_s2: ArrayLike = (0.0, 0.0, 0.0),
    time_constant_s: float = math.inf,
) -> Flight:
    """Integrate as :func:`fly`, to several times (t,) at once, before and after ``et``: their axis is the first."""
    from scipy.integrate import solve_ivp

    start = as_floats(state, (6,), "state")
    push = np.broadcast_to(as_floats(acceleration_km_s2, (3,), "acceleration_km_s2"), (*start.shape[:-1], 3))
    table = np.zeros((*start.shape, 10))
    table[..., 0] = start
    table[..., 1:7] = np.eye(6)

    def rate(time: float, flat: Float) -> Float:
        now = flat.reshape(table.shape)
        decay = math.exp(-(time - et) / time_constant_s)
        pull, gradient = dynamics.pull(time, now[..., :3, 0])
        change = np.empty_like(now)
        change[..., :3, :] = now[..., 3:, :]
        change[..., 3:, 0] = pull + decay * push
        change[..., 3:, 1:] = gradient @ now[..., :3, 1:]
        change[..., 3:, 7:] += decay * np.eye(3)
        return change.ravel()

    scale = np.full(table.shape, ABSOLUTE_TOLERANCE)
    scale[..., 1:] = 1e-8  # of derivatives of order 1 and, by accelerations, of s and s^2
    wanted = as_floats(times, (), "times")
    ends = np.empty((len(wanted), *table.shape))
    for side in (np.flatnonzero(wanted >= et), np.flatnonzero(wanted < et)):
        if not side.size:
            continue
        order = side[np.argsort(np.abs(wanted[side] - et), kind="stable")]
        stops, which = np.unique(wanted[order], return_inverse=True)
        stops = stops if wanted[order[0]] >= et else stops[::-1]
        until = float(stops[-1])
        done = solve_ivp(
            rate, (et, until), table.ravel(), method="DOP853", rtol=RELATIVE_TOLERANCE, atol=scale.ravel(), t_eval=stops
        )
        require(done.success, f"the flight from {et} to {until} cannot be integrated: {done.message}")
        at = done.y.T.reshape(len(stops), *table.shape)
        ends[order] = at[which if wanted[order[0]] >= et else len(stops) - 1 - which]
    return Flight(ends[..., 0], ends[..., 1:7], ends[..., 7:])


def _attraction(gm_km3_s2: float, from_body_km: Float) -> tuple[Float, Float]:
    """Acceleration (..., 3) by a point mass and its gradient (..., 3, 3)."""
    squared = np.sum(from_body_km**2, axis=-1)
    strength = gm_km3_s2 / (squared * np.sqrt(squared))
    acceleration = -strength[..., None] * from_body_km
    outer = from_body_km[..., :, None] * from_body_km[..., None, :] * (3.0 / squared)[..., None, None]
    return acceleration, strength[..., None, None] * (outer - np.eye(3))
