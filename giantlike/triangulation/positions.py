"""Position of a spacecraft from lines of sight to two or more bodies or stars."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from giantlike.core.arrays import Float, as_finite, require, require_number, symmetric
from giantlike.core.causes import Cause
from giantlike.core.frames import skew
from giantlike.core.outcomes import Failure, Quality, Reason
from giantlike.core.units import SPEED_OF_LIGHT_KM_S
from giantlike.core.values import Value
from giantlike.ephemeris import Ephemeris
from giantlike.triangulation.sightlines import Sightline, without_aberration

CHANCE = 1e-4  # chance of a larger chi-square below which residuals are flagged: one in 10,000 sound positions
_LIGHT_TIME_STEPS = 8  # each gains a factor v/c; from the solar system barycenter at 50 au three suffice
_SETTLED = 1e-12  # step over the range at which the maximum likelihood stops: rounding of float64 leaves 1e-15


class TriangulationMethod(StrEnum):
    """Method of :func:`triangulate`; with the values used in tables and JSON."""

    LOST = "lost"
    """Linear optimal sine triangulation: weighted by ranges that follow from pairs of lines, without iteration."""
    MAXIMUM_LIKELIHOOD = "maximum_likelihood"  # Gauss-Newton steps from there, to the position of maximum likelihood


@dataclass(frozen=True, slots=True, kw_only=True)
class TriangulationOptions:
    """Options of :func:`triangulate`.

    Parameters
    ----------
    method : TriangulationMethod
    max_steps : int; Gauss-Newton steps of the maximum likelihood
    max_range_sigma : float
        Maximum ratio of the position's standard deviation to the distance to the nearest target: beyond 0.3 the ranges
        are not determined by the lines, and no covariance describes the position.

    Raises
    ------
    InputError
        A value is out of range.
    """

    method: TriangulationMethod = TriangulationMethod.MAXIMUM_LIKELIHOOD
    max_steps: int = 20
    max_range_sigma: float = 0.3

    def __post_init__(self) -> None:
        require(self.max_steps >= 1, f"max_steps must be >= 1, got {self.max_steps}")
        require_number(self.max_range_sigma, "max_range_sigma", above=0.0)
        object.__setattr__(self, "method", TriangulationMethod(self.method))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TriangulatedPosition(Value):
    """Position from lines of sight.

    Parameters
    ----------
    position_km : (3,) float64, km, ICRF axes; of the spacecraft, from the origin of the targets
    covariance_km2 : (3, 3) float64, km^2
    parts : mapping of Cause to (3, 3) float64, km^2; noise of the lines, attitude, ephemeris; terms of it
    residuals_rad : (n, 2) float64, rad; observed minus computed across each line, along two perpendicular axes
    chi_square : float; of the residuals by their full covariance
    degrees_of_freedom : int; 2 n - 3
    ranges_km : (n,) float64, km; to the targets
    et : float, TDB seconds past J2000, optional; epoch of the position, where :func:`locate` made it
    method : TriangulationMethod
    steps : int; Gauss-Newton steps taken; 0 by the linear method
    flags : Quality; ``LARGE_RESIDUALS`` where their p-value is below 1e-4
    """

    position_km: Float
    covariance_km2: Float
    parts: Mapping[Cause, Float]
    residuals_rad: Float
    chi_square: float
    degrees_of_freedom: int
    ranges_km: Float
    et: float | None = None
    method: TriangulationMethod
    steps: int
    flags: Quality = Quality.NONE


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _SightlineArrays:
    """Lines as arrays: positions and directions (n, 3), axes across (n, 3, 2), and the causes of their errors.

    Covariances (2n, 2n): ``by_range``, rad^2, of errors that grow with range; ``by_place``, km^2, of those that do not.
    """

    positions_km: Float
    directions: Float
    across: Float
    by_range: Mapping[Cause, Float]
    by_place: Mapping[Cause, Float]

    def parts(self, ranges_km: Float) -> dict[Cause, Float]:
        """Covariances (2n, 2n) of the residuals across the lines by cause, km^2, at given ranges (n,)."""
        scale = np.repeat(ranges_km, 2)
        return {cause: scale[:, None] * part * scale for cause, part in self.by_range.items()} | dict(self.by_place)


def triangulate(
    sightlines: Sequence[Sightline],
    positions_km: ArrayLike,
    *,
    ephemeris_covariances_km2: Mapping[str, ArrayLike] | None = None,
    options: TriangulationOptions | None = None,
) -> TriangulatedPosition | Failure:
    r"""Find where lines of sight to known positions meet.

    Parameters
    ----------
    sightlines : sequence of Sightline; at least two, without aberration (``without_aberration``)
    positions_km : (n, 3), km, ICRF axes; where the target of each line was when the light left it
    ephemeris_covariances_km2 : mapping of str to (3, 3), km^2, ICRF axes, optional
        By target; none by default. It is one error for all lines to that target.
    options : TriangulationOptions, optional

    Returns
    -------
    TriangulatedPosition or Failure
        Reasons: degenerate_geometry (lines are parallel within their errors, or meet behind the camera),
        not_converged.

    Raises
    ------
    InputError
        Fewer than two lines, shapes that disagree, a covariance for a target that no line goes to, or lines that have
        aberration in them or no noise.

    Notes
    -----
    A line of sight says that :math:`B^T (p - r)` is zero, with the target :math:`p`, the spacecraft :math:`r` and two
    axes :math:`B` across the direction. An angular error moves this by the range, so that equal weights are not
    optimal. LOST takes the ranges that pairs of lines give (the law of sines) and then solves one weighted linear
    system [1]_; each line is paired with the one that makes the largest angle with it. Here the weights come from
    the full covariance: noise of each line, the attitude error that all lines of an image share, and the ephemeris
    error that all lines to a target share. With three lines or more of one image the shared attitude error is thereby
    estimated as well.

    The covariance is to first order; it holds as long as standard deviations are small compared with the ranges.

    References
    ----------
    .. [1] S. Henry and J. A. Christian (2023), Absolute Triangulation Algorithms for Space Exploration, JGCD,
       doi:10.2514/1.G006989, as described in the source of SONIC (PositionEstimation.triangulate).
    """
    options = TriangulationOptions() if options is None else options
    places = as_finite(positions_km, (len(sightlines), 3), "positions_km")
    require(len(sightlines) >= 2, f"a position needs at least two lines of sight, got {len(sightlines)}")
    moving = sorted({line.target for line in sightlines if line.aberration})
    require(not moving, f"take stellar aberration out first, it is in the lines to {', '.join(moving)}")
    lines = _lines(sightlines, places, ephemeris_covariances_km2 or {})
    ranges = _ranges_of_pairs(lines)
    if isinstance(ranges, Failure):
        return ranges
    position = _solve_weighted(lines, ranges)[0]
    steps = 0
    if options.method is TriangulationMethod.MAXIMUM_LIKELIHOOD:
        refined = _likeliest(lines, position, options.max_steps)
        if isinstance(refined, Failure):
            return refined
        position, steps = refined
    return _assess_position(lines, position, steps, options)


def locate(
    sightlines: Sequence[Sightline],
    ephemerides: Mapping[str, Ephemeris],
    et: float,
    *,
    velocity_km_s: ArrayLike,
    ephemeris_covariances_km2: Mapping[str, ArrayLike] | None = None,
    options: TriangulationOptions | None = None,
) -> TriangulatedPosition | Failure:
    """Find the position of a spacecraft at an epoch from directions as its cameras saw them.

    The steps: 1. stellar aberration is removed by the velocity; 2. each target is taken where it was when the light
    left it, with light times of the position found so far, from the barycenter at first; 3. lines of other epochs are
    moved to this one by the velocity; 4. :func:`triangulate`; 2 to 4 are repeated until the position converges.

    Parameters
    ----------
    sightlines : sequence of Sightline; at least two
    ephemerides : mapping of str to Ephemeris
        By the names of the targets, all with one origin; a star is a
        :class:`~giantlike.triangulation.StarEphemeris`.
    et : float, TDB seconds past J2000; epoch of the position
    velocity_km_s : (3,), km/s, ICRF axes
        Of the spacecraft with respect to the solar system barycenter. An error of 1 m/s rotates every line alike by
        0.7 mas.
    ephemeris_covariances_km2 : mapping of str to (3, 3), km^2, ICRF axes, optional; by target; none by default
    options : TriangulationOptions, optional

    Returns
    -------
    TriangulatedPosition or Failure
        Reasons: as :func:`triangulate`.

    Raises
    ------
    InputError
        A target has no ephemeris, ephemerides have different origins, or as :func:`triangulate`.
    """
    missing = sorted({line.target for line in sightlines} - set(ephemerides))
    require(not missing, f"no ephemeris of {', '.join(missing)}; there are {', '.join(sorted(ephemerides))}")
    origins = {ephemerides[line.target].origin for line in sightlines}
    require(len(origins) <= 1, f"ephemerides must have one origin, got {', '.join(sorted(origins))}")
    require_number(et, "et")
    velocity = as_finite(velocity_km_s, (3,), "velocity_km_s")
    at_rest = without_aberration(sightlines, velocity)
    moved = np.array([velocity * (line.et - et) for line in at_rest])
    place = np.zeros(3)
    found: TriangulatedPosition | Failure = Failure(Reason.NOT_CONVERGED, "no step was taken")
    for _ in range(_LIGHT_TIME_STEPS):
        targets = np.array(
            [
                position_at_emission(ephemerides[line.target], line.et, place + shift)
                for line, shift in zip(at_rest, moved, strict=True)
            ]
        )
        found = triangulate(
            at_rest, targets - moved, ephemeris_covariances_km2=ephemeris_covariances_km2, options=options
        )
        if isinstance(found, Failure):
            return found
        step = float(np.linalg.norm(found.position_km - place))
        place = found.position_km
        if step <= _SETTLED * float(np.max(found.ranges_km)):
            return dataclasses.replace(found, et=et)
    return Failure(Reason.NOT_CONVERGED, f"light times did not settle in {_LIGHT_TIME_STEPS} steps, last {step:.3g} km")


def position_at_emission(ephemeris: Ephemeris, et: float, observer_km: ArrayLike) -> Float:
    """Position (3,), km, ICRF axes, of a target when the light left it that an observer receives."""
    observer = as_finite(observer_km, (3,), "observer_km")
    position = ephemeris.state(et)[0]
    for _ in range(_LIGHT_TIME_STEPS):
        before = position
        light_time_s = float(np.linalg.norm(position - observer)) / SPEED_OF_LIGHT_KM_S
        position = ephemeris.state(et - light_time_s)[0]
        if float(np.linalg.norm(position - before)) <= _SETTLED * float(np.linalg.norm(position - observer)):
            break
    return position


def _lines(sightlines: Sequence[Sightline], places: Float, ephemerides: Mapping[str, ArrayLike]) -> _SightlineArrays:
    """Arrays of lines, with the covariances (2n, 2n) of their errors by cause."""
    unknown = sorted(set(ephemerides) - {line.target for line in sightlines})
    require(not unknown, f"ephemeris covariances of targets that no line goes to: {', '.join(unknown)}")
    directions = np.array([line.direction_inertial for line in sightlines])
    across = _across(directions)
    n = len(sightlines)
    noise, attitude, ephemeris = (np.zeros((n, 2, n, 2)) for _ in range(3))
    turns = -np.einsum("nik,nij->nkj", across, skew(directions))  # rows: effect of a rotation across each line
    of_image = {line.image: line.covariance_attitude_rad2 for line in reversed(sightlines)}
    of_target = {name: as_finite(matrix, (3, 3), f"covariance of {name}") for name, matrix in ephemerides.items()}
    for i, first in enumerate(sightlines):
        noise[i, :, i] = across[i].T @ first.covariance_rad2 @ across[i]
        require(
            bool(np.linalg.eigvalsh(noise[i, :, i])[0] > 0.0),
            f"line of sight to {first.target} needs a covariance above zero across it",
        )
        for j, second in enumerate(sightlines):
            if first.image == second.image:
                attitude[i, :, j] = turns[i] @ of_image[first.image] @ turns[j].T
            if first.target == second.target and first.target in of_target:
                ephemeris[i, :, j] = across[i].T @ of_target[first.target] @ across[j]
    return _SightlineArrays(
        positions_km=places,
        directions=directions,
        across=across,
        by_range={Cause.NOISE: noise.reshape(2 * n, 2 * n), Cause.ATTITUDE: attitude.reshape(2 * n, 2 * n)},
        by_place={Cause.EPHEMERIS: ephemeris.reshape(2 * n, 2 * n)},
    )


def _across(directions: Float) -> Float:
    """Two unit vectors (n, 3, 2) perpendicular to each direction (n, 3) and to each other."""
    least = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    first = np.cross(directions, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=-1)


def _ranges_of_pairs(lines: _SightlineArrays) -> Float | Failure:
    """Ranges (n,) by the law of sines in the triangle with the line that makes the largest angle with each."""
    u = lines.directions
    sines = np.linalg.norm(np.cross(u[:, None], u[None, :]), axis=-1)
    partner = np.argmax(sines, axis=1)
    rows = np.arange(len(u))
    sine = sines[rows, partner]
    sigma = float(np.sqrt(np.max(np.diagonal(lines.by_range[Cause.NOISE]))))
    if float(np.min(sine)) <= sigma:
        return Failure(
            Reason.DEGENERATE_GEOMETRY,
            f"lines of sight are parallel within their errors ({float(np.min(sine)):.3g} rad apart, sigma"
            f" {sigma:.3g} rad): give a target in another direction",
        )
    apart = lines.positions_km[partner] - lines.positions_km
    ranges = np.linalg.norm(np.cross(apart, u[partner]), axis=-1) / sine
    longest = float(np.max(ranges))
    if longest == 0.0:
        return Failure(Reason.DEGENERATE_GEOMETRY, "all lines of sight go to one place: give a second target")
    # a line that ends where another passes has no range: a small one gives it its due weight.
    return np.asarray(np.maximum(ranges, 1e-9 * longest))


def _solve_weighted(lines: _SightlineArrays, ranges_km: Float) -> tuple[Float, Float]:
    """Position (3,) of the weighted linear system, and its gain (3, 2n)."""
    rows = np.swapaxes(lines.across, 1, 2).reshape(-1, 3)
    seen = np.einsum("nik,ni->nk", lines.across, lines.positions_km).ravel()
    gain = _gain(rows, sum(lines.parts(ranges_km).values()))
    return gain @ seen, gain


def _gain(rows: Float, covariance: Float | int) -> Float:
    """Gain (3, m) of weighted least squares with design matrix (m, 3), by a factor of the covariance (m, m)."""
    factor = np.linalg.cholesky(np.asarray(covariance, dtype=np.float64))
    white = np.linalg.solve(factor, rows)
    scale = np.linalg.norm(white, axis=0)
    return np.asarray(np.linalg.pinv(white / scale) @ np.linalg.inv(factor) / scale[:, None])


def _angles(lines: _SightlineArrays, position_km: Float) -> tuple[Float, Float, Float]:
    """Residuals (2n,) in rad, their derivative (2n, 3) by the position, and ranges (n,) along the lines."""
    vectors = lines.positions_km - position_km
    ranges = np.einsum("ni,ni->n", vectors, lines.directions)
    tangents = np.einsum("nik,ni->nk", lines.across, vectors) / ranges[:, None]
    by_vector = (np.swapaxes(lines.across, 1, 2) - tangents[..., None] * lines.directions[:, None]) / ranges[
        :, None, None
    ]
    return -tangents.ravel(), by_vector.reshape(-1, 3), ranges


def _likeliest(lines: _SightlineArrays, start_km: Float, max_steps: int) -> tuple[Float, int] | Failure:
    """Position (3,) of maximum likelihood by Gauss-Newton steps, and their number."""
    position = start_km
    for step in range(1, max_steps + 1):
        residuals, by_position, ranges = _angles(lines, position)
        if float(np.min(ranges)) <= 0.0:
            return _behind()
        scale = np.repeat(ranges, 2)
        gain = _gain(by_position, sum(lines.parts(ranges).values()) / (scale[:, None] * scale))
        change = -gain @ residuals
        position = position + change
        if float(np.linalg.norm(change)) <= _SETTLED * float(np.max(ranges)):
            return position, step
    return Failure(Reason.NOT_CONVERGED, f"the position did not settle in {max_steps} steps")


def _behind() -> Failure:
    return Failure(
        Reason.DEGENERATE_GEOMETRY,
        "lines of sight meet behind the camera: a target is taken for another, or lines are parallel within errors",
    )


def _assess_position(
    lines: _SightlineArrays, position: Float, steps: int, options: TriangulationOptions
) -> TriangulatedPosition | Failure:
    """Covariance, residuals and quality of a position."""
    from scipy.stats import chi2  # slow to import

    residuals, by_position, ranges = _angles(lines, position)
    if float(np.min(ranges)) <= 0.0:
        return _behind()
    scale = np.repeat(ranges, 2)
    angular = {cause: part / (scale[:, None] * scale) for cause, part in lines.parts(ranges).items()}
    total = np.asarray(sum(angular.values()))
    gain = _gain(by_position, total)
    parts = {cause: symmetric(gain @ part @ gain.T) for cause, part in angular.items()}
    covariance = symmetric(np.asarray(sum(parts.values())))
    sigma, nearest = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])), float(np.min(ranges))
    if not sigma <= options.max_range_sigma * nearest:
        return Failure(
            Reason.DEGENERATE_GEOMETRY,
            f"the position is known to {sigma:.3g} km along its worst axis, the nearest target is {nearest:.3g} km off:"
            " give targets in other directions, or better lines of sight",
        )
    chi_square = float(residuals @ np.linalg.solve(total, residuals))
    freedom = residuals.size - 3
    rare = float(chi2.sf(chi_square, freedom)) < CHANCE
    return TriangulatedPosition(
        position_km=position,
        covariance_km2=covariance,
        parts=parts,
        residuals_rad=residuals.reshape(-1, 2),
        chi_square=chi_square,
        degrees_of_freedom=freedom,
        ranges_km=ranges,
        method=options.method,
        steps=steps,
        flags=Quality.LARGE_RESIDUALS if rare else Quality.NONE,
    )
