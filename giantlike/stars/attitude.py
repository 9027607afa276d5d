"""Attitude (and scale) from identified stars: weighted least squares in pixel space."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum, StrEnum
from functools import partial
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import gammainc

from giantlike._system.processes import one_thread
from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask, require
from giantlike.core.frames import rotate, turned_about
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.statistics import error_floor, error_terms, squared_residuals, whiten
from giantlike.core.values import Value, select_rows
from giantlike.processing.geometry.wahba import WahbaMethod, solve_wahba
from giantlike.stars.smooth_errors import MOST_WEIGHED, AttitudeResiduals, unmodeled_errors

_MAX_STEPS = 20  # of Gauss-Newton, which converges quadratically: more mean that it does not converge
_STEP_RAD = 1e-6
"""Last step: 0.2 arcsec. The next one is this times the residuals: below 1e-6 standard deviations of the attitude times
the root of the number of stars."""
_MAX_ROUNDS = 10  # of fit and rejection
_MOST_WEIGHT = 0.5  # of a star over the sum of others: residuals do not show the error of a dominant one
_NOISE_EXPLAINS = 0.977
"""Chi-square probability up to which residuals are explained by the noise: the two-sigma quantile of a normal
distribution, one-sided."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AttitudeSolution(Value):
    """Weighted attitude of one image."""

    camera_from_inertial: Rotation
    covariance_rad2: Float  # (3, 3), rad^2; small rotation about camera axes, an estimated scale marginalized
    model: CameraModel  # camera model, with the estimated scale if there is one
    used: Mask  # (n,); False for outliers
    predicted_px: Float  # (n, 2), px; stars projected by the solution
    sigma_px: Float  # (n,), px; standard deviation per axis by which each star was weighted
    error_floor_px: float  # per axis, added in quadrature to explain the residuals; else 0
    error_factor: float  # factor on the standard deviations of the stars themselves, at least 1
    reduced_chi2: float  # chi-square over degrees of freedom without the floor
    # px; the floor that is likely where the noise explains the residuals: in the covariance, not in the weights. It
    # matters where one star is far better than the others, so that the fit follows its unmodeled error
    hidden_floor_px: float
    # px; standard deviation per axis of the errors that neighboring stars share, times the root of their probability; 0
    # where no error is likely. The covariance is the mean over all kinds, sizes and lengths of errors, each with its
    # probability
    shared_error_px: float
    unmodeled_likely: bool  # whether errors beyond those of the stars and the floor are likely
    by_pixels: Float  # (3, k, 2), rad/px; derivative of the small rotation by the image positions of the k stars used


class AttitudeMethod(StrEnum):
    """Solver of the attitude from identified stars."""

    WEIGHTED = "weighted"
    """Gauss-Newton on the pixels, started by the q-method: every star weighted with its full covariance."""
    Q_METHOD = "q_method"  # Davenport's q-method: one sigma per star
    SVD = "svd"  # singular value decomposition: one sigma per star
    ESOQ2 = "esoq2"  # axis and angle in closed form: one sigma per star


class Scale(IntEnum):
    """Parameters of the camera model estimated with the attitude; the value is their number."""

    FIXED = 0
    FOCAL_LENGTH = 1  # one factor on fx and fy
    RADIAL = 2  # the factor and the radial distortion k1


@one_thread()
def fit_attitude(
    directions_inertial: Float,
    points_px: Float,
    covariance_px2: Float,
    model: CameraModel,
    *,
    scale: Scale = Scale.FIXED,
    outlier_sigma: float = 4.0,
    method: AttitudeMethod = AttitudeMethod.WEIGHTED,
    uncertain: Sequence[str] = (),
) -> AttitudeSolution | Failure:
    """Fit an attitude to identified stars by weighted least squares.

    Every star is weighted with its full covariance (n, 2, 2) of centroid and catalog or, by the methods that solve
    Wahba's problem, with the mean of its variances along both axes. Stars with residuals beyond ``outlier_sigma`` are
    rejected in rounds, with the scatter estimated by its median. If the remaining residuals exceed their covariances,
    these are scaled by a factor and a common error floor is added (:func:`~giantlike.core.statistics.error_terms`). No
    star weighs more than half of all others together, whose residuals could not show its unmodeled error.

    Source: Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, Attitude Estimation.
    """
    weighted = method is AttitudeMethod.WEIGHTED
    require(weighted or scale is Scale.FIXED, f"method {method} cannot estimate the scale; use 'weighted'")
    fit: Fitter = _gauss_newton if weighted else partial(_wahba, WahbaMethod(method))
    vectors = model.unproject(points_px)
    seen: Mask = np.all(np.isfinite(vectors), axis=1)
    sigma = np.sqrt(np.trace(covariance_px2[seen], axis1=1, axis2=2) / 2.0)
    start = solve_wahba(
        directions_inertial[seen],
        vectors[seen],
        np.hypot(sigma, np.median(sigma) if sigma.size else 0.0) / model.focal_length_px,
    )
    if isinstance(start, Failure):
        return start
    stars = _Stars(directions_inertial, points_px, covariance_px2)
    kept = _without_outliers(_AttitudeState(start[0], model), stars, seen, scale, outlier_sigma, fit)
    if isinstance(kept, Failure):
        return kept
    state, used = kept
    return _solution(state, stars, used, scale, fit, uncertain)


@dataclass(frozen=True, slots=True, eq=False)
class _Stars(Value):
    """Directions (n, 3), centroids (n, 2) px, covariances (n, 2, 2) px^2."""

    directions: Float
    points_px: Float
    covariance_px2: Float

    def select(self, which: Mask) -> _Stars:
        return select_rows(self, which)

    def inflate(self, floor_px: float, factor: float = 1.0) -> _Stars:
        """Stars with their standard deviations scaled and an error floor added to every covariance."""
        return replace(self, covariance_px2=factor**2 * self.covariance_px2 + floor_px**2 * np.eye(2))

    @property
    def sigma_px(self) -> Float:
        """Standard deviations (n,) per axis, px."""
        return np.asarray(np.sqrt(np.trace(self.covariance_px2, axis1=1, axis2=2) / 2.0))

    def limit_weights(self) -> _Stars:
        """Stars with weights limited, so that the error of one is not the error of the whole attitude."""
        weights = self.sigma_px**-2
        best = int(np.argmax(weights))
        others = float(weights.sum() - weights[best])
        if weights[best] <= _MOST_WEIGHT * others:
            return self
        covariance = self.covariance_px2.copy()
        covariance[best] *= weights[best] / (_MOST_WEIGHT * others)
        return replace(self, covariance_px2=covariance)

    def residuals(self, state: _AttitudeState) -> Float:
        return self.points_px - state.predict(self.directions)


@dataclass(frozen=True, slots=True)
class _AttitudeState:
    rotation: Rotation
    model: CameraModel

    def predict(self, directions_inertial: Float) -> Float:
        return self.model.project(rotate(self.rotation, directions_inertial))

    def jacobian(self, directions_inertial: Float, scale: Scale, uncertain: Sequence[str] = ()) -> Float:
        """Derivatives (n, 2, 3 + scale + m) of pixels by rotation, log focal length, k1, uncertain parameters."""
        vectors = rotate(self.rotation, directions_inertial)
        columns = [turned_about(vectors, self.model.project_jacobian(vectors))]
        if scale:
            names = self.model.parameter_names
            by_parameter = self.model.parameter_jacobian(vectors)
            fx, fy = names.index("fx_px"), names.index("fy_px")
            values = self.model.parameters
            columns.append((by_parameter[..., fx] * values[fx] + by_parameter[..., fy] * values[fy])[..., None])
            if scale == Scale.RADIAL:
                columns.append(by_parameter[..., names.index("k1"), None])
        if uncertain:
            chosen = [self.model.parameter_names.index(name) for name in uncertain]
            columns.append(self.model.parameter_jacobian(vectors)[..., chosen])
        return np.concatenate(columns, axis=-1)

    def apply_step(self, step: Float) -> _AttitudeState:
        model = self.model
        if step.size > 3:
            values = dict(zip(model.parameter_names, model.parameters.tolist(), strict=True))
            factor = float(np.exp(step[3]))
            values["fx_px"] *= factor
            values["fy_px"] *= factor
            if step.size > 4:
                values["k1"] += float(step[4])
            model = model.with_parameters(list(values.values()))
        return _AttitudeState(Rotation.from_rotvec(step[:3]) * self.rotation, model)


Fitter: TypeAlias = Callable[[_AttitudeState, _Stars, Scale], tuple[_AttitudeState, Float] | Failure]


def _wahba(
    method: WahbaMethod, state: _AttitudeState, stars: _Stars, _: Scale
) -> tuple[_AttitudeState, Float] | Failure:
    """Solution of Wahba's problem: the state and the covariance (3, 3) of its rotation."""
    jacobian = state.model.unproject_jacobian(stars.points_px)
    variances = np.einsum("nij,njk,nik->n", jacobian, stars.covariance_px2, jacobian) / 2.0
    solved = solve_wahba(stars.directions, state.model.unproject(stars.points_px), np.sqrt(variances), method=method)
    return solved if isinstance(solved, Failure) else (_AttitudeState(solved[0], state.model), solved[1])


def _gauss_newton(state: _AttitudeState, stars: _Stars, scale: Scale) -> tuple[_AttitudeState, Float] | Failure:
    """Weighted least squares: the state and the covariance (3 + scale, 3 + scale) of its parameters."""
    for _ in range(_MAX_STEPS):
        residuals = stars.residuals(state)
        if not np.isfinite(residuals).all():
            return Failure(Reason.NOT_CONVERGED, "a star left the region that the camera model can project")
        table = np.concatenate([state.jacobian(stars.directions, scale), residuals[..., None]], axis=-1)
        table = whiten(table, stars.covariance_px2).reshape(2 * len(residuals), -1)
        products = table.T @ table
        normal, gradient = products[:-1, :-1], products[:-1, -1]
        units = 1.0 / np.sqrt(np.diag(normal))
        scaled = normal * np.outer(units, units)
        if not np.linalg.cond(scaled) < 1e12:
            return Failure(Reason.DEGENERATE_GEOMETRY, f"{len(residuals)} stars do not fix all parameters of the fit")
        step = np.linalg.solve(scaled, gradient * units) * units
        state = state.apply_step(step)
        if np.abs(step).max() < _STEP_RAD:
            return state, np.linalg.inv(scaled) * np.outer(units, units)
    return Failure(Reason.NOT_CONVERGED, f"the fit of {len(residuals)} stars did not converge in {_MAX_STEPS} steps")


def _without_outliers(
    state: _AttitudeState, stars: _Stars, used: Mask, scale: Scale, outlier_sigma: float, fit: Fitter
) -> tuple[_AttitudeState, Mask] | Failure:
    """Fit and reject outliers in rounds, until the selection no longer changes."""
    for _ in range(_MAX_ROUNDS):
        chosen = stars.select(used)
        floor = error_floor(chosen.residuals(state), chosen.covariance_px2)
        fitted = fit(state, chosen.inflate(floor), scale)
        if isinstance(fitted, Failure):
            return fitted
        state, _ = fitted
        allowed = stars.inflate(error_floor(chosen.residuals(state), chosen.covariance_px2))
        keep = np.asarray(squared_residuals(allowed.residuals(state), allowed.covariance_px2) <= outlier_sigma**2)
        if 2 * int(keep.sum()) < 4 + scale:
            return Failure(Reason.NOT_CONVERGED, f"only {int(keep.sum())} of {len(keep)} stars agree with one attitude")
        if np.array_equal(keep, used):
            break
        used = keep
    return state, used


def _solution(
    state: _AttitudeState, stars: _Stars, used: Mask, scale: Scale, fit: Fitter, uncertain: Sequence[str]
) -> AttitudeSolution | Failure:
    """Last fit, of the stars kept: with their own covariances if chi-square allows, else with larger ones."""
    chosen = stars.select(used)
    freedom = 2 * int(used.sum()) - 3 - scale
    fitted = fit(state, chosen, scale)
    if isinstance(fitted, Failure):
        return fitted
    plain = float(squared_residuals(chosen.residuals(fitted[0]), chosen.covariance_px2).sum())
    factor, floor = 1.0, 0.0
    if freedom > 0 and float(gammainc(freedom / 2.0, plain / 2.0)) > _NOISE_EXPLAINS:
        factor, floor = error_terms(chosen.residuals(state), chosen.covariance_px2, freedom=freedom)
    inflated = stars.inflate(floor, factor)
    weighted = inflated.select(used).limit_weights()
    if not np.array_equal(weighted.covariance_px2, chosen.covariance_px2):
        fitted = fit(state, weighted, scale)
        if isinstance(fitted, Failure):
            return fitted
    state = fitted[0]
    by_pixels = _by_pixels(state, weighted, scale)
    sigma_px = inflated.sigma_px
    sigma_px[used] = weighted.sigma_px
    covariance_rad2, hidden_px, shared_px = _propagate(by_pixels, inflated.select(used)), 0.0, 0.0
    likely = False
    few = int(used.sum()) <= MOST_WEIGHED
    own = chosen if few else chosen.inflate(0.0, factor)
    left = _residuals(state, own, by_pixels, scale, uncertain)
    if left.residuals_px.size > left.jacobian.shape[-1]:
        beyond = unmodeled_errors(left if few else left.average_cells(), own_included=not few)
        within_cells = not few and beyond.own_px > 0.0 and left.alike(inflated.sigma_px[used])
        likely = beyond.likely or within_cells
        if likely or (floor == 0.0 and factor == 1.0):
            covariance_rad2 = _propagate(by_pixels, own) + beyond.covariance_rad2
            hidden_px, shared_px = beyond.own_px if floor == 0.0 else 0.0, beyond.shared_px
    return AttitudeSolution(
        camera_from_inertial=state.rotation,
        covariance_rad2=0.5 * (covariance_rad2 + covariance_rad2.T),
        model=state.model,
        used=used,
        predicted_px=state.predict(stars.directions),
        sigma_px=sigma_px,
        error_floor_px=floor,
        error_factor=factor,
        reduced_chi2=plain / max(freedom, 1),
        hidden_floor_px=hidden_px,
        shared_error_px=shared_px,
        unmodeled_likely=likely,
        by_pixels=by_pixels,
    )


def _residuals(
    state: _AttitudeState, stars: _Stars, by_pixels: Float, scale: Scale, uncertain: Sequence[str]
) -> AttitudeResiduals:
    """Residuals of these stars, with their derivatives by the parameters and by the scale."""
    return AttitudeResiduals(
        points_px=stars.points_px,
        residuals_px=stars.residuals(state),
        covariance_px2=stars.covariance_px2,
        jacobian=state.jacobian(stars.directions, scale, uncertain),
        scaling_px=state.jacobian(stars.directions, Scale.FOCAL_LENGTH)[..., 3],
        by_pixels=by_pixels,
    )


def _propagate(by_pixels: Float, stars: _Stars) -> Float:
    """Covariance (3, 3) of the rotation, rad^2, by errors of the stars."""
    covariance: Float = np.einsum("ina,nab,jnb->ij", by_pixels, stars.covariance_px2, by_pixels, optimize=True)
    return covariance


def _by_pixels(state: _AttitudeState, stars: _Stars, scale: Scale) -> Float:
    """Derivative (3, n, 2) of the rotation by the centroids: ``(H^T W H)^-1 H^T W``, rad/px."""
    jacobian = state.jacobian(stars.directions, scale)
    (a, b), (_, d) = np.moveaxis(stars.covariance_px2, 0, -1)
    inverse = np.array([[d, -b], [-b, a]]) / (a * d - b * b)
    weighted = np.swapaxes(jacobian, 1, 2) @ np.moveaxis(inverse, -1, 0)
    normal = np.sum(weighted @ jacobian, axis=0)
    units = 1.0 / np.sqrt(np.diag(normal))
    covariance = np.linalg.inv(normal * np.outer(units, units)) * np.outer(units, units)
    return np.moveaxis(covariance[:3] @ weighted, 0, 1)
