"""Motion of what a track shows: a line on the sky, and an orbit about the body, with covariances by cause."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.special import expit
from scipy.stats import chi2

from giantlike.core.arrays import Float, require, require_number, unit
from giantlike.core.errors import InputError
from giantlike.core.frames import radec_from_direction
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.units import SPEED_OF_LIGHT_KM_S
from giantlike.core.values import Estimate
from giantlike.dynamics import PointMasses, fly_through
from giantlike.search.compare import FLOOR_PX
from giantlike.search.link import Track

LEAST_CHANCE = 1e-3  # of the squares that a right model leaves: it is refused once in a thousand tracks
_KNOWN_RANGE = 0.3  # error of the range over the distance from the body, beyond which it is not observed
_STARTS = np.stack(np.meshgrid([-2.0, -0.7, 0.0, 0.7, 2.0], [-1.0, 0.0, 1.0]), axis=-1).reshape(-1, 2)
"""Distances behind the body, in those from it on the sky, and speeds along the ray, in those of a circular orbit, from
which orbits are fitted."""
_AS_GOOD = 13.8  # squares beyond those of the best orbit, with which another one is as likely as one in a thousand
_STEPS = 25
_SETTLED = 1e-3  # change of chi-square of the last step
_RANGES = np.linspace(-30.0, 30.0, 601)  # in distances from the body on the sky, in which bound ranges are sought


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionOptions:
    """Options of :func:`fit_motion`.

    Parameters
    ----------
    models : tuple of {"sky_line", "orbit", "orbit_sunlight"}; models to fit, the simplest first
    gravity : PointMasses, optional; of the body, and others; orbits need it
    gm_sigma_km3_s2 : float, km^3/s^2; standard deviation of that of the body

    Raises
    ------
    InputError
        A model is unknown or there is none, or the standard deviation is negative.
    """

    models: tuple[str, ...] = ("sky_line", "orbit")
    gravity: PointMasses | None = None
    gm_sigma_km3_s2: float = 0.0

    def __post_init__(self) -> None:
        known = ("sky_line", "orbit", "orbit_sunlight")
        require(bool(self.models) and set(self.models) <= set(known), f"models must be of {known}, got {self.models}")
        require_number(self.gm_sigma_km3_s2, "gm_sigma_km3_s2", least=0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Orbit(Estimate):
    """State relative to a body.

    Parameters
    ----------
    et : float, TDB seconds past J2000; when the light left
    state : (6,) float64, km and km/s, ICRF axes; from the center of the body
    covariance : (6, 6) float64; of the state
    parts : mapping of str to (6, 6) float64; terms of it: ``noise``, ``attitude``, ``spacecraft``, ``gravity``
    sunlight_km_s2 : float, km/s^2; acceleration away from the Sun; 0 where it was not fitted
    bound : float; specific energy, km^2/s^2: negative for an orbit that stays
    """

    et: float
    state: Float
    covariance: Float
    parts: Mapping[str, Float]
    sunlight_km_s2: float
    bound: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionFix(Estimate):
    """Motion of a track.

    Parameters
    ----------
    model : str; the simplest that fits
    chi2, freedom : mapping of str to float, int; of each model that was fitted
    et : float, TDB seconds past J2000; epoch of the line
    direction_inertial : (3,) float64, unitless, ICRF axes; apparent
    rate_px_s : (2,) float64; on the plane of the track
    covariance_line : (4, 4) float64, px^2, px^2/s, px^2/s^2; of place and rate on the plane
    orbit : Orbit or Failure, optional
        None where no orbit was asked for, or gravity or the place of the body is unknown.
    """

    model: str
    chi2: Mapping[str, float]
    freedom: Mapping[str, int]
    et: float
    direction_inertial: Float
    rate_px_s: Float
    covariance_line: Float
    orbit: Orbit | Failure | None = None


def fit_motion(track: Track, options: MotionOptions = MotionOptions()) -> MotionFix | Failure:
    """Fit the motion of a track: lines on the sky and orbits about the body.

    Parameters
    ----------
    track : Track
    options : MotionOptions

    Returns
    -------
    MotionFix or Failure
        The simplest model that fits, and figures of all. ``degenerate_geometry``: the images do not determine the range
        and no line was asked for, or none fits; the line of sight and the ranges of bound orbits are in the detail.
        ``large_residuals``: no model fits. ``no_geometry``: an orbit alone was asked for, without gravity or without
        the place of the body.
    """
    line = _Line.from_track(track)
    squares: dict[str, float] = {}
    freedom: dict[str, int] = {}
    if "sky_line" in options.models:
        squares["sky_line"], freedom["sky_line"] = line.chi2, 2 * len(track) - 4
    wanted = [name for name in options.models if name != "sky_line"]
    ready = options.gravity is not None and all(one.body_position_km is not None for one in track.residuals)
    if wanted and not ready and "sky_line" not in options.models:
        return Failure(Reason.NO_GEOMETRY, "an orbit needs the gravity of the body and its place in every image")
    orbit: Orbit | Failure | None = None
    for name in wanted if ready else []:
        parameters = 7 if name == "orbit_sunlight" else 6
        if 2 * len(track) <= parameters or (isinstance(orbit, Orbit) and _fits(squares, freedom)):
            continue
        orbit, squares[name] = _fit_orbit(track, line, options, sunlight=parameters == 7)
        freedom[name] = 2 * len(track) - parameters
    model = _fits(squares, freedom)
    if not model:
        detail = ", ".join(f"{name} {squares[name]:.1f} of {freedom[name]}" for name in squares) or "too few sources"
        return Failure(Reason.LARGE_RESIDUALS, f"no model fits the track: squares over freedom are {detail}")
    if model != "sky_line" and isinstance(orbit, Failure):
        return orbit
    return MotionFix(
        model=model,
        chi2=squares,
        freedom=freedom,
        et=track.et,
        direction_inertial=track.plane.unproject(line.solution[:2]),
        rate_px_s=line.solution[2:],
        covariance_line=line.covariance,
        orbit=orbit,
    )


def _fits(squares: Mapping[str, float], freedom: Mapping[str, int]) -> str:
    """The first model that fits; empty where none does."""
    return next((name for name in squares if chi2.sf(squares[name], freedom[name]) > LEAST_CHANCE), "")


@dataclass(frozen=True, slots=True)
class _Line:
    """A straight line through the places of a track on its plane: place and rate (4,)."""

    solution: Float
    covariance: Float
    chi2: float

    @classmethod
    def from_track(cls, track: Track) -> _Line:
        rows = np.concatenate([np.kron([1.0, after], np.eye(2)) for after in track.ets - track.et])
        weight = block_diag(*np.linalg.inv(track.covariance_places_px2))
        covariance = np.linalg.inv(rows.T @ weight @ rows)
        solution = covariance @ rows.T @ weight @ track.places_px.ravel()
        off = track.places_px.ravel() - rows @ solution
        return cls(solution, 0.5 * (covariance + covariance.T), float(off @ weight @ off))

    def places(self, after_s: Float) -> Float:
        """Places (n, 2), px, some seconds (n,) after the middle of the track."""
        return np.asarray(self.solution[:2] + after_s[:, None] * self.solution[2:])


@dataclass(frozen=True, slots=True)
class _OrbitProblem:
    """Least squares of orbits.

    bodies: (n, 3), km, places of the body from the camera. emitted: (n,), times at which the light left. spread,
        weight: (2 n, 2 n), covariance of the places without errors in common, and inverse with those that count.
    sun: (3,), from the body to the Sun; zero where its light is not fitted.
    """

    track: Track
    gravity: PointMasses
    bodies: Float
    emitted: Float
    et: float
    spread: Float
    weight: Float
    sun: Float
    unknowns: int = field(default=6)

    def predict(self, values: Float, gravity: PointMasses | None = None) -> tuple[Float, Float, Float]:
        """Places (m, 2 n), their derivatives (m, 2 n, p), and those by the place of the body (m, 2 n, 3)."""
        push = values[:, 6:7] * -self.sun if self.unknowns == 7 else np.zeros((len(values), 3))
        flight = fly_through(gravity or self.gravity, self.et, values[:, :6], self.emitted, acceleration_km_s2=push)
        seen = np.swapaxes(flight.state[..., :3], 0, 1) + self.bodies
        slope = self.track.plane.jacobian(seen)
        by = np.swapaxes(flight.by_state[..., :3, :], 0, 1)
        if self.unknowns == 7:
            by_push = np.swapaxes(flight.by_acceleration[..., :3, :], 0, 1) @ -self.sun[:, None]
            by = np.concatenate([by, by_push], axis=-1)
        m = len(values)
        places = self.track.plane.project(seen).reshape(m, -1)
        return places, (slope @ by).reshape(m, -1, self.unknowns), slope.reshape(m, -1, 3)

    def solve(self, values: Float) -> tuple[Float, Float]:
        """Values (p,) of the best of the fits from several starts (m, p), and its squares."""
        measured, damping = self.track.places_px.ravel(), np.full(len(values), 1e-3)
        places, rows, _ = self.predict(values)
        squares = self._squares(measured - places)
        for _ in range(_STEPS):
            right = np.einsum("mkp,kl,ml->mp", rows, self.weight, measured - places)
            matrix = np.swapaxes(rows, 1, 2) @ self.weight @ rows
            scale = np.einsum("mpp->mp", matrix)
            step = np.linalg.solve(
                matrix + np.eye(self.unknowns) * (damping[:, None] * scale)[:, None], right[..., None]
            )
            trial = values + step[..., 0]
            wild = np.linalg.norm(trial[:, :3], axis=1) > 100.0 * np.linalg.norm(values[:, :3], axis=1)
            trial[wild] = values[wild]
            new_places, new_rows, _ = self.predict(trial)
            new = self._squares(measured - new_places)
            better = new < squares
            gain = float(np.max(np.where(better, squares - new, 0.0)))
            values, places = np.where(better[:, None], trial, values), np.where(better[:, None], new_places, places)
            rows, squares = np.where(better[:, None, None], new_rows, rows), np.where(better, new, squares)
            damping = np.clip(damping * np.where(better, 0.1, 10.0), 1e-12, 1e8)
            if gain < _SETTLED and (better | (damping >= 1e3)).all():
                break
        best = int(squares.argmin())
        return values[best], squares[best]

    def respond(self, values: Float) -> tuple[Float, Float]:
        """Derivatives of the places by the place of the body (2 n, 3) and by its gravity (2 n,), for values (p,)."""
        gm = self.gravity.gm_km3_s2
        here, _, by_body = self.predict(values[None])
        there, _, _ = self.predict(values[None], replace(self.gravity, gm_km3_s2=gm * 1.001))
        return by_body[0], (there[0] - here[0]) / (0.001 * gm)

    def with_errors(self, values: Float, body_km: float, gm_km3_s2: float) -> _OrbitProblem:
        """The problem with places that the body and its gravity, in common, make worse by these standard deviations."""
        by_body, by_gm = self.respond(values)
        more = body_km**2 * by_body @ by_body.T + gm_km3_s2**2 * np.outer(by_gm, by_gm)
        return replace(self, weight=np.asarray(np.linalg.inv(self.spread + more), dtype=np.float64))

    def _squares(self, off: Float) -> Float:
        return np.asarray(np.einsum("mk,kl,ml->m", off, self.weight, off))


def _fit_orbit(track: Track, line: _Line, options: MotionOptions, *, sunlight: bool) -> tuple[Orbit | Failure, float]:
    """Orbit of a track or why there is none, and the squares that it leaves."""
    assert options.gravity is not None
    places = [one.body_position_km for one in track.residuals]
    bodies = np.array([place for place in places if place is not None])
    light_s = np.linalg.norm(bodies, axis=1) / SPEED_OF_LIGHT_KM_S
    parts = [track.plane.covariances(one, FLOOR_PX) for one in track.residuals]
    own, common = (block_diag(*[part[k][i] for part, i in zip(parts, track.sources, strict=True)]) for k in (0, 1))
    sun = track.residuals[0].sun_direction_inertial if sunlight else None
    if sunlight and sun is None:
        return Failure(Reason.NO_GEOMETRY, "an acceleration by sunlight needs the direction of the Sun"), math.inf
    problem = _OrbitProblem(
        track=track,
        gravity=options.gravity,
        bodies=bodies,
        emitted=track.ets - light_s,
        et=track.et - float(light_s.mean()),
        spread=own + common,
        weight=np.linalg.inv(own + common),
        sun=np.zeros(3) if sun is None else sun,
        unknowns=7 if sunlight else 6,
    )
    rays, offset = track.plane.unproject(line.places(track.ets - track.et)), _offset_km(track, bodies)
    starts = np.zeros((len(_STARTS), problem.unknowns))
    after = problem.emitted - problem.et
    circular = math.sqrt(options.gravity.gm_km3_s2 / offset)
    for start, (share, speed) in zip(starts, _STARTS, strict=True):
        there = _ranges(bodies, share * offset)[:, None] * rays - bodies
        slope, level = np.polyfit(after, there, 1)
        start[:6] = np.concatenate([level, slope + speed * circular * track.direction_inertial])
    errors = (max(one.body_sigma_km for one in track.residuals), options.gm_sigma_km3_s2)
    try:
        first, _ = problem.solve(starts)
        mirrored = first.copy()
        for part in (mirrored[:3], mirrored[3:6]):
            part -= 2.0 * (part @ track.direction_inertial) * track.direction_inertial
        solutions = [problem.with_errors(one, *errors).solve(one[None]) for one in (first, mirrored)]
        (values, squares), (second, other_squares) = sorted(solutions, key=lambda one: float(one[1]))
        by_body, by_gm = problem.respond(values)
        problem = problem.with_errors(values, *errors)
        rows = problem.predict(values[None])[1][0]
    except InputError as error:  # the flight meets a center of gravity
        return Failure(Reason.NOT_CONVERGED, str(error)), math.inf
    matrix = rows.T @ problem.weight @ rows
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    gain = np.linalg.pinv(matrix / np.outer(scale, scale), rcond=1e-14, hermitian=True) / np.outer(scale, scale)
    gain = (gain @ rows.T @ problem.weight)[:6]
    causes = {
        "noise": gain @ own @ gain.T,
        "attitude": gain @ common @ gain.T,
        "spacecraft": errors[0] ** 2 * gain @ by_body @ by_body.T @ gain.T,
        "gravity": errors[1] ** 2 * np.outer(gain @ by_gm, gain @ by_gm),
    }
    covariance = np.sum([*causes.values()], axis=0)
    position = values[:3]
    ray = unit(position + bodies.mean(axis=0))
    sigma_km, distance = math.sqrt(float(ray @ covariance[:3, :3] @ ray)), float(np.linalg.norm(position))
    apart = abs(float(ray @ (second - values)[:3]))
    if other_squares < squares + _AS_GOOD and apart > 3.0 * sigma_km and sigma_km < _KNOWN_RANGE * distance:
        near, far = sorted(float(np.linalg.norm(one[:3] + bodies.mean(axis=0))) for one in (values, second))
        detail = f"two orbits fit, mirror images across the sky: at ranges of {near:.6g} and {far:.6g} km"
        return Failure(Reason.DEGENERATE_GEOMETRY, detail), float(squares)
    # nearer ones are two ends of one valley: the variance of their mixture about the better one
    away = second[:6] - values[:6]
    valley = expit(0.5 * float(squares - other_squares)) * np.outer(away, away)
    causes["noise"], covariance = causes["noise"] + valley, covariance + valley
    sigma_km = math.sqrt(float(ray @ covariance[:3, :3] @ ray))
    if not sigma_km < _KNOWN_RANGE * distance:
        return Failure(Reason.DEGENERATE_GEOMETRY, _tell_ranges(problem, line, offset, sigma_km)), float(squares)
    return Orbit(
        et=problem.et,
        state=values[:6],
        covariance=0.5 * (covariance + covariance.T),
        parts=causes,
        sunlight_km_s2=float(values[6]) if sunlight else 0.0,
        bound=float(values[3:6] @ values[3:6]) / 2.0 - options.gravity.gm_km3_s2 / distance,
    ), float(squares)


def _offset_km(track: Track, bodies: Float) -> float:
    """Distance of a track from the center of the body across the line of sight."""
    ray, body = track.direction_inertial, bodies.mean(axis=0)
    return float(np.linalg.norm(body - (body @ ray) * ray))


def _ranges(bodies: Float, behind_km: float) -> Float:
    """Ranges (n,), km, of an object so far behind the body, seen near it."""
    return np.asarray(np.linalg.norm(bodies, axis=1) + behind_km)


def _tell_ranges(problem: _OrbitProblem, line: _Line, offset_km: float, sigma_km: float) -> str:
    """What is known without the range: the line of sight, and the ranges at which the object may be bound."""
    track, bodies = problem.track, problem.bodies
    rays = track.plane.unproject(line.places(track.ets - track.et))
    after, ray, bound = problem.emitted - problem.et, track.direction_inertial, []
    for share in _RANGES:
        ranges = _ranges(bodies, share * offset_km)
        if ranges.min() <= 0.0:
            continue
        slope, level = np.polyfit(after, ranges[:, None] * rays - bodies, 1)
        across = slope - (slope @ ray) * ray  # the speed along the ray is not known: none is the least
        if across @ across / 2.0 < problem.gravity.gm_km3_s2 / float(np.linalg.norm(level)):
            bound.append(float(ranges.mean()))
    ra, dec = radec_from_direction(ray)
    interval = f"bound at ranges from {min(bound):.6g} to {max(bound):.6g} km" if bound else "not bound at any range"
    return (
        f"the images do not determine the range (sigma {sigma_km:.3g} km): seen at RA {ra:.6f}, Dec {dec:.6f} deg, "
        f"{offset_km:.4g} km from the center of the body across the line of sight; {interval}"
    )
