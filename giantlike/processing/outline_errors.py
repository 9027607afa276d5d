"""Errors of points along the outline of a body, estimated from their residuals: noise, and relief by its spectrum.

Relief missing from a shape is an error of the outline that is correlated between neighbors. A fit of the position
absorbs its long waves, so that residuals understate them. They are predicted from the shorter waves by a random field
on the sphere whose power per degree decreases as on real bodies. Degrees 0 and 1 are excluded: they are size and
position of the body, which relief does not change.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from giantlike.core.arrays import Float, require
from giantlike.core.statistics import nearest_covariance
from giantlike.core.values import Value

_MOST_BINS = 24  # maximum number of bins along an outline, in which residuals are averaged before spectra are compared
_GAP = 3.0  # maximum distance between neighbors, in medians of all: longer gaps are not counted as limb
_RATIOS = np.concatenate([[0.0], np.geomspace(0.1, 1e8, 25)])
"""Variance of relief / mean variance of the noise: up to 1e4 sigmas, as for limbs accurate to 0.003 px."""
_LENGTH_STEP = 3.0  # ratio of neighboring lengths; averages over them need no finer grid
_SMOOTH_DEGREES = (3.0, 6.0, 12.0)  # of the end of smooth relief: bumps, old craters of 20, 10, 5 deg (sigma)
_SMOOTH = len(_SMOOTH_DEGREES)
_ROUGH_SHARE = 0.02  # fraction of rough relief in the variance of smooth relief
_LEAST_WAVES = 0.9  # minimum number of waves, of the degree about which smooth relief ends, in the visible outline
_LEAST_LENGTH = 1.0 / 12.0  # correlation length / radius below which the body is flat: errors of pixels and albedo
_MOST_DEGREE, _ANGLES = 400, 1501  # of spectra; angles of tabulated covariances: both below 0.5 deg
_LEAST_NOISE2 = 0.5  # least variance of the noise over the predicted: common pixels only increase it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OutlineErrors(Value):
    """Errors of points along an outline, averaged over spectra by their likelihoods."""

    noise_scale2: Float  # (g,); independent variance / given, with each of g correlated errors: kinds, variances
    shared_variance: Float  # (g,); variance of the part correlated between neighbors, unit of the residuals squared
    log_likelihood: Float  # (g,)
    lengths: Float  # (s,); correlation lengths of the first s kinds, unit of the points; the others are kinds of relief
    radius: float  # of the outline, unit of the points

    @property
    def chance(self) -> Float:
        """Chances (g,); their sum is 1."""
        chance = np.exp(self.log_likelihood - self.log_likelihood.max())
        result: Float = chance / chance.sum()
        return result

    @property
    def relief_sigma(self) -> float:
        """Standard deviation of the relief, unit of the residuals."""
        first = self.lengths.size * _RATIOS.size
        return float(np.sqrt(self.chance[first:] @ self.shared_variance[first:]))

    def covariances(self, sigma: Float, points: Float) -> PointCovariances:
        """Covariances of points (n, 2) of noise ``sigma`` (n,).

        Weights by smooth relief would rely on the exact correlation of neighbors: on bodies with relief of 1 % such
        positions scatter by 0.6 px, without them by 0.3 px.
        """
        smooth = np.arange(self.log_likelihood.size) >= self.log_likelihood.size - _SMOOTH * _RATIOS.size
        rough = replace(self, log_likelihood=np.where(smooth, -np.inf, self.log_likelihood))
        x, y = points.T
        apart = np.hypot(x[:, None] - x, y[:, None] - y)
        shared = [(each._shared_variances[: self.lengths.size], each._relief_table) for each in (self, rough)]
        relief, rough_relief = _looked_up(np.stack([table for _, table in shared]), apart / self.radius)
        noise, rough_noise = (float(each.chance @ each.noise_scale2) * np.diag(sigma**2) for each in (self, rough))
        for number, length in enumerate(self.lengths):
            near = np.exp(apart / -length)
            noise += shared[0][0][number] * near
            rough_noise += shared[1][0][number] * near
        # The table of relief is for the circular outline of a sphere: along other outlines it may give negative
        # variances.
        relief = nearest_covariance(relief)
        return PointCovariances(noise=noise, relief=relief, for_weights=rough_noise + rough_relief)

    @property
    def _shared_variances(self) -> Float:
        """Variance of each kind of shared error."""
        result: Float = (self.chance * self.shared_variance).reshape(-1, _RATIOS.size).sum(axis=1)
        return result

    @property
    def _relief_table(self) -> Float:
        """Covariance by relief, by the angle."""
        return self._shared_variances[self.lengths.size :] @ _relief_tables()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointCovariances(Value):
    """Covariances (n, n) of points along an outline, unit of the residuals squared."""

    noise: Float  # (n, n); without relief: independent noise, and noise common to near neighbors
    relief: Float  # (n, n)
    for_weights: Float  # (n, n); from which weights are made: without smooth relief


def outline_errors(
    residuals: Float, design: Float, sigma: Float, points: Float, *, radius: float, least_length: float
) -> OutlineErrors:
    r"""Find the errors of points along an outline from the residuals of a linear model.

    ``residuals`` (n,); ``design`` (n, k); ``sigma`` (n,); ``points`` (n, 2); ``radius``: mean radius of the whole
    outline, unit of the points; ``least_length``: shortest correlation length that is considered, unit of the points.

    Covariances are ``s^2 (diag(sigma^2) + q m K)``, m the mean of ``sigma^2``. K is either ``exp(-distance / length)``,
    the errors of pixels and albedo, or the covariance of a random field on the sphere, ``sum V_n P_n(cos angle)`` over
    degrees n from 2 on: ``V_n = (2 n + 1) (n (n + 1))^(-3/2)`` for rough relief, which is Kaula's rule that power is
    proportional to degree^-2, followed by planets and asteroids, and ``(2 n + 1) exp(-n (n + 1) / m^2)`` for smooth
    one. For each K and q, s^2 is found by restricted maximum likelihood, which accounts for the long waves absorbed by
    the fit, and covariances are averaged with the likelihoods as weights. Many neighbors are averaged first.
    """
    require(len(residuals) > design.shape[1] + 1, f"needed over {design.shape[1] + 1} residuals, got {len(residuals)}")
    means = averages(points, sigma)
    residuals, design, points = means @ residuals, means @ design, means @ points
    sigma = np.sqrt(means**2 @ sigma**2)
    freedom = len(residuals) - design.shape[1]
    require(freedom > 1, f"needed residuals in more than {design.shape[1] + 1} places")
    white = design / sigma[:, None]
    white /= np.linalg.norm(white, axis=0)
    values = np.concatenate([(residuals / sigma)[:, None], white], axis=1)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    longest = max(_LEAST_LENGTH * radius, 2.0 * least_length)
    lengths = np.exp(np.arange(np.log(least_length), np.log(longest), np.log(_LENGTH_STEP)))
    kinds = [np.exp(-apart / length) for length in lengths]
    kinds += list(_looked_up(_relief_tables(), apart / radius))
    typical2 = float(np.mean(sigma**2))
    kernels = np.stack(kinds) * (typical2 / np.outer(sigma, sigma))
    likelihood, scale2 = _restricted_likelihoods(values, kernels)
    waves = np.array(_SMOOTH_DEGREES) * _length(points) / (2.0 * np.pi * radius)
    likelihood[len(kinds) - _SMOOTH :][waves < _LEAST_WAVES] = -np.inf
    return OutlineErrors(
        noise_scale2=scale2.ravel(),
        shared_variance=typical2 * scale2.ravel() * np.tile(_RATIOS, len(kinds)),
        log_likelihood=likelihood.ravel(),
        lengths=lengths,
        radius=radius,
    )


def averages(points: Float, sigma: Float) -> Float:
    """Matrix (b, n) that averages points (n, 2) along an outline in bins, weighted by noise; few points are kept."""
    if len(points) <= _MOST_BINS:
        return np.eye(len(points))
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    width = _length(points) / _MOST_BINS
    along = np.concatenate([[0.0], np.cumsum(np.where(steps > _GAP * np.median(steps), steps + width, steps))])
    _, bins = np.unique((along / width).astype(np.int64), return_inverse=True)
    weights = np.zeros((int(bins.max()) + 1, len(points)))
    weights[bins, np.arange(len(points))] = sigma**-2.0
    result: Float = weights / weights.sum(axis=1, keepdims=True)
    return result


def _length(points: Float) -> float:
    """Length of the outline that points (n, 2) represent, without gaps."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    typical = float(np.median(steps))
    return float(np.minimum(steps, _GAP * typical).sum()) + typical


def _restricted_likelihoods(values: Float, kernels: Float) -> tuple[Float, Float]:
    """Log likelihood and variance scale (g, r) of g kernels (g, n, n) in r ratios, for ``values`` (n, 1 + k)."""
    power, vectors = np.linalg.eigh(kernels)
    turned = np.swapaxes(vectors, 1, 2) @ values
    total = 1.0 + _RATIOS[:, None] * np.maximum(power, 0.0)[:, None]  # (g, r, n)
    weighted = turned[:, None] / total[..., None]
    normal = np.swapaxes(weighted, 2, 3) @ turned[:, None]  # (g, r, 1 + k, 1 + k)
    y2, right, across = normal[..., 0, 0], normal[..., 1:, 0], normal[..., 1:, 1:]
    explained = (right * np.linalg.solve(across, right[..., None])[..., 0]).sum(axis=-1)
    freedom = values.shape[0] - values.shape[1] + 1
    remains = np.maximum(y2 - explained, 0.0)
    scale2 = np.maximum(remains / freedom, _LEAST_NOISE2)
    determinants = np.log(total).sum(axis=2) + np.linalg.slogdet(across)[1]
    likelihood = -0.5 * (freedom * np.log(scale2) + remains / scale2 + determinants)
    likelihood[:, 0] += np.log(_RATIOS.size - 1.0)  # none at all is as likely before as any
    return likelihood, scale2


@cache
def _relief_tables() -> Float:
    """Covariances (kinds, angles) of relief of unit variance, rough ones first, in even steps of the angle to pi."""
    cosine = np.cos(np.linspace(0.0, np.pi, _ANGLES))
    degrees = np.arange(2.0, _MOST_DEGREE + 1.0)
    legendre = [np.ones_like(cosine), cosine]
    for n in range(1, _MOST_DEGREE):
        legendre.append(((2 * n + 1) * cosine * legendre[n] - n * legendre[n - 1]) / (n + 1))
    squared = degrees * (degrees + 1.0)
    powers = [(2 * degrees + 1) * squared**-1.5]
    powers += [(2 * degrees + 1) * np.exp(-squared / ended**2) for ended in _SMOOTH_DEGREES]
    shares = np.stack([power / power.sum() for power in powers])
    shares[-_SMOOTH:] += _ROUGH_SHARE * (shares[0] - shares[-_SMOOTH:])
    result: Float = shares @ np.stack(legendre[2:])
    return result


def _looked_up(tables: Float, chords: Float) -> Float:
    """Covariances (k, ...) at chords / radius (...), by tables (k, m) in even steps of the angle to pi."""
    place = np.arcsin(np.minimum(0.5 * chords, 1.0)) * (2.0 / np.pi * (_ANGLES - 1))
    index = np.minimum(place.astype(np.int64), _ANGLES - 2)
    share = place - index
    return (1.0 - share) * tables[:, index] + share * tables[:, index + 1]
