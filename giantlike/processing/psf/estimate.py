r"""Point spread function of an image estimated from its stars, constant or varying over the field.

All selected stars are fitted at once: position, flux and background (a plane) of each, and the shape of
:mod:`giantlike.processing.psf.profile`, whose parameters are polynomials of the position in the image. Gauss-Newton
with noise weights; the stars are eliminated from the normal equations one by one (Schur complement), so that the cost
grows linearly with their number. Stars that fit far worse than the others (blends, particle hits) are rejected and the
rest is fitted again. With a known shape, :func:`remeasure` fits positions, fluxes and backgrounds only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from giantlike.core.arrays import Float, require
from giantlike.core.detector import Detector
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.statistics import robust_sigma
from giantlike.core.values import Value
from giantlike.processing.detection.detections import NOT_A_STAR, DetectionFlag, Detections
from giantlike.processing.detection.matched_filter import recorded_width_px
from giantlike.processing.detection.patches import Patches, chi2_inflation, cut_patches
from giantlike.processing.psf.profile import N_SHAPE, SHAPE_NAMES, PsfKind, shape_shares

_N_LOCAL = 6  # unknowns of each star: x, y, flux, level and slopes of the background
_MOST_STARS = 200  # brightest stars fitted: bounds the time
_LEAST_SNR = 15.0  # of a star: its width is then known to about 10 %
_STEPS = 25  # bound for fits that do not converge
_SETTLED = 1e-3  # last step in standard deviations
_GAINED = 1e-6  # last relative decrease of chi-square
_DIFFERENCE = 1e-4  # step of the central differences, px or unitless: truncation 1e-8, rounding 1e-12
_LONGEST_STEP = 0.3  # largest change of a shape coefficient in one step: keeps the shape positive
_MOST_ELONGATED, _MOST_WINGED = 0.9, 0.9  # bounds of the ellipticity and of 1/beta: at 1 the shape is degenerate
_OUTLIER = 4.0  # robust sigmas of the reduced chi-square of a star
_PATCH_WIDTHS = 4.0  # half side of a patch in recorded star widths: 99.99 % of a Gaussian
_REMEASURE_STEPS = 6  # of Gauss-Newton from fitted centroids
UNUSABLE = (
    NOT_A_STAR
    | DetectionFlag.SATURATED
    | DetectionFlag.MASKED
    | DetectionFlag.CUT_BY_FRAME
    | DetectionFlag.BLENDED
    | DetectionFlag.STREAK
)
"""Flags of detections that cannot be used to estimate the point spread function."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PsfEstimate(Value):
    """Point spread function estimated from stars."""

    kind: PsfKind
    # (k, t); coefficients of each free parameter of the shape (ln sigma, e1, e2, 1/beta) in the terms 1, x, y, x^2, x
    # y, y^2, ... of ``degree``, where x and y go from -1 to 1 over the image
    coefficients: Float
    covariance: Float  # (k t, k t); of these, parameter by parameter; times a reduced chi-square above 1
    degree: int  # degree of the polynomials
    columns: int  # columns, rows: size of the image
    rows: int
    reduced_chi2: float
    residual_power: float  # squared residuals / squared signal, median, without noise: 0 if perfect
    n_used: int  # n_used, n_rejected: numbers of stars
    n_rejected: int

    def to_mapping(self) -> dict[str, Any]:
        """Return the estimate as a mapping for JSON."""
        errors = np.sqrt(np.diag(self.covariance)).reshape(self.coefficients.shape)
        return {
            "kind": str(self.kind),
            "degree": self.degree,
            "sigma_px": self.sigma_px,
            "sigma_error_px": self.sigma_error_px,
            "coefficients": dict(zip(SHAPE_NAMES, self.coefficients.tolist(), strict=False)),
            "standard_errors": dict(zip(SHAPE_NAMES, errors.tolist(), strict=False)),
            "reduced_chi2": self.reduced_chi2,
            "residual_power": self.residual_power,
            "n_used": self.n_used,
            "n_rejected": self.n_rejected,
        }

    def shapes_at(self, points_px: ArrayLike) -> Float:
        """Evaluate the shape at pixels. ``points_px`` (n, 2); returns (n, 4), ln sigma (of px), e1, e2, 1/beta."""
        points = np.atleast_2d(np.asarray(points_px, dtype=np.float64))
        free = field_terms(points, self.columns, self.rows, self.degree) @ self.coefficients.T
        return np.pad(free, ((0, 0), (0, N_SHAPE - free.shape[1])))

    @property
    def sigma_px(self) -> float:
        """Geometric mean width in the middle of the image, px: the half width at half maximum over 1.1774."""
        middle = [(self.columns - 1) / 2.0, (self.rows - 1) / 2.0]
        shape = self.shapes_at([middle])[0]
        return float(np.exp(shape[0]) * (1.0 - shape[1] ** 2 - shape[2] ** 2) ** 0.25)

    @property
    def sigma_error_px(self) -> float:
        """Standard error of the width in the middle of the image, px."""
        return float(self.sigma_px * math.sqrt(self.covariance[0, 0]))


def field_terms(points_px: Float, columns: int, rows: int, degree: int) -> Float:
    """Terms (n, t), constant first, of a polynomial of the position (n, 2), which is from -1 to 1 over the image."""
    half = np.array([columns - 1, rows - 1]) / 2.0
    x, y = ((points_px - half) / np.maximum(half, 1.0)).T
    return np.stack([x ** (total - k) * y**k for total in range(degree + 1) for k in range(total + 1)], axis=1)


def estimate_psf(
    pixels: ArrayLike,
    detections: Detections,
    *,
    detector: Detector,
    kind: PsfKind = PsfKind.GAUSSIAN,
    degree: int = 0,
    mask: ArrayLike | None = None,
) -> PsfEstimate | Failure:
    """Estimate the point spread function from isolated, unsaturated stars of an image."""
    array = np.asarray(pixels)
    require(0 <= degree <= 3, f"degree must be 0 to 3, got {degree}")
    require(array.ndim == 2, f"pixels must be a 2-D array, got shape {array.shape}")
    usable = ((detections.flags & np.uint16(UNUSABLE)) == 0) & (detections.snr >= _LEAST_SNR)
    stars = detections.select(np.flatnonzero(usable)[:_MOST_STARS])
    patches = star_patches(array, stars, detector=detector, mask=mask)
    n_terms = (degree + 1) * (degree + 2) // 2
    if len(stars) < 3 * n_terms:
        return Failure(
            Reason.TOO_FEW_DETECTIONS,
            f"{len(stars)} isolated stars have a signal to noise ratio of {_LEAST_SNR:g}, {3 * n_terms} are needed",
        )
    terms = field_terms(stars.points_px, array.shape[1], array.shape[0], degree)
    problem = _PsfFitProblem(patches, terms, kind.n_free)
    local = _local_start(stars)
    start = np.zeros((kind.n_free, n_terms))
    start[0, 0] = math.log(stars.psf_sigma_px)
    if kind is PsfKind.MOFFAT:
        start[3, 0] = 0.2
    solution = problem.solve(local, start)
    quality = problem.star_chi2(solution.local, solution.shared)
    spread = robust_sigma(quality)
    kept = np.flatnonzero(quality <= np.median(quality) + _OUTLIER * max(spread, 0.1))
    if len(kept) < len(stars) and len(kept) >= 3 * n_terms:
        problem = problem.select(kept)
        solution = problem.solve(solution.local[kept], solution.shared)
    if not solution.settled:
        return Failure(Reason.NOT_CONVERGED, f"the fit of a {kind} function to {len(kept)} stars did not converge")
    return problem.estimate(solution, kind, degree, array.shape, len(stars))


def remeasure(
    pixels: ArrayLike, detections: Detections, psf: PsfEstimate, *, detector: Detector, mask: ArrayLike | None = None
) -> Detections:
    """Fit isolated detections that may be stars again with an estimated PSF, unless they move by over 1 px."""
    chosen = np.flatnonzero((detections.flags & np.uint16(UNUSABLE)) == 0)
    if not chosen.size:
        return detections
    stars = detections.select(chosen)
    terms = field_terms(stars.points_px, psf.columns, psf.rows, psf.degree)
    patches = star_patches(pixels, stars, detector=detector, mask=mask)
    problem = _PsfFitProblem(patches, terms, psf.kind.n_free)
    local = _local_start(stars)
    for _ in range(_REMEASURE_STEPS):
        _, _, _, step = problem.normal(local, psf.coefficients)
        local = local + np.concatenate([np.clip(step[:, :2], -0.5, 0.5), step[:, 2:]], axis=1)
    left, weight, _ = problem.residuals(local, psf.coefficients)
    rows, _ = problem.jacobians(local, psf.coefficients)
    covariance = np.linalg.pinv((rows * weight[:, None, :]) @ rows.swapaxes(1, 2), hermitian=True)
    freedom = np.maximum(np.count_nonzero(weight, axis=1) - _N_LOCAL, 1)
    covariance = (covariance + covariance.swapaxes(1, 2)) / 2.0
    covariance *= chi2_inflation(np.sum(weight * left**2, axis=1), freedom)[:, None, None]
    under = patches.level_dn(local[:, 3:], local[:, :2])
    good = (np.hypot(*(local[:, :2] - stars.points_px).T) < 1.0) & (local[:, 2] > 0)
    points, flux, level = detections.points_px.copy(), detections.flux_dn.copy(), detections.background_dn.copy()
    errors = detections.covariance_px2.copy()
    points[chosen[good]], flux[chosen[good]], level[chosen[good]] = local[good, :2], local[good, 2], under[good]
    errors[chosen[good]] = covariance[good, :2, :2]
    return replace(detections, points_px=points, flux_dn=flux, background_dn=level, covariance_px2=errors)


def star_patches(
    pixels: ArrayLike,
    stars: Detections,
    *,
    detector: Detector,
    mask: ArrayLike | None = None,
    half_px: int | None = None,
) -> Patches:
    """Cut-outs around stars, by default as large as the fit of their shape needs."""
    array, bad = np.asarray(pixels), None if mask is None else np.asarray(mask, dtype=bool)
    require(bad is None or bad.shape == array.shape, f"mask must have the shape of the pixels, {array.shape}")
    half = math.ceil(_PATCH_WIDTHS * recorded_width_px(stars.psf_sigma_px)) + 1 if half_px is None else half_px
    peaks = np.rint(stars.points_px).astype(np.int64)
    return cut_patches(array, bad, peaks, half, detector=detector.of_image(array, bad), noise_dn=stars.noise_dn)


def _local_start(stars: Detections) -> Float:
    """First local parameters (n, 6): a background without slopes."""
    flat = np.zeros((len(stars), 2))
    return np.column_stack([stars.points_px, stars.flux_dn, stars.background_dn, flat])


@dataclass(frozen=True, slots=True)
class _PsfFitSolution:
    local: Float
    shared: Float
    settled: bool


@dataclass(frozen=True, slots=True)
class _PsfFitProblem:
    """Stars (n): local parameters (n, 6) x, y, flux, level and slopes x, y of the background; shared ones (k, t)."""

    patches: Patches
    terms: Float
    n_free: int

    def select(self, which: NDArray[np.integer[Any]]) -> _PsfFitProblem:
        return _PsfFitProblem(self.patches.select(which), self.terms[which], self.n_free)

    def shapes(self, shared: Float) -> Float:
        free = self.terms @ shared.T
        shapes = np.pad(free, ((0, 0), (0, N_SHAPE - free.shape[1])))
        size = np.maximum(np.hypot(shapes[:, 1], shapes[:, 2]) / _MOST_ELONGATED, 1.0)
        shapes[:, 1:3] /= size[:, None]
        shapes[:, 3] = np.clip(shapes[:, 3], 0.0, _MOST_WINGED)
        return shapes

    def shares(self, points_px: Float, shapes: Float) -> Float:
        shares = shape_shares(self.patches.corner_px, self.patches.size_px, points_px, shapes)
        return shares.reshape(len(points_px), -1)

    def residuals(self, local: Float, shared: Float) -> tuple[Float, Float, Float]:
        """Residuals, weights and star light (n, pixels)."""
        light = local[:, 2, None] * self.shares(local[:, :2], self.shapes(shared))
        used = (self.patches.valid & ~self.patches.saturated).reshape(light.shape)
        variance = self.patches.variance_dn2(light[..., None])[..., 0]
        under = np.tensordot(local[:, 3:], self.patches.plane_terms(), axes=1).reshape(light.shape)
        left = self.patches.values_dn.reshape(light.shape) - under - light
        return np.where(used, left, 0.0), used / variance, light

    def star_chi2(self, local: Float, shared: Float) -> Float:
        left, weight, _ = self.residuals(local, shared)
        result: Float = np.sum(weight * left**2, axis=1) / np.maximum(np.count_nonzero(weight, axis=1) - _N_LOCAL, 1)
        return result

    def jacobians(self, local: Float, shared: Float) -> tuple[Float, Float]:
        """Derivatives by local (n, 6, pixels) and shared parameters (n, k t, pixels), by central differences."""
        points, flux, shapes = local[:, :2], local[:, 2, None], self.shapes(shared)
        by_local = [
            flux * (self.shares(points + step, shapes) - self.shares(points - step, shapes)) / (2.0 * _DIFFERENCE)
            for step in _DIFFERENCE * np.eye(2)
        ]
        star = self.shares(points, shapes)
        by_shape = []
        for k in range(self.n_free):
            step = _DIFFERENCE * np.eye(N_SHAPE)[k]
            low = shapes - step
            low[:, 3] = np.maximum(low[:, 3], 0.0)  # 1/beta; ln sigma and ellipticities may be negative
            apart = (shapes + step - low)[:, k, None]
            by_shape.append(flux * (self.shares(points, shapes + step) - self.shares(points, low)) / apart)
        shape_rows = np.stack(by_shape, axis=1)
        by_shared = shape_rows[:, :, None, :] * self.terms[:, None, :, None]
        n, n_pixels = len(local), by_shared.shape[-1]
        plane = np.broadcast_to(self.patches.plane_terms().reshape(3, -1), (n, 3, n_pixels))
        by_all = np.concatenate([np.stack([*by_local, star], axis=1), plane], axis=1)
        return by_all, by_shared.reshape(n, -1, n_pixels)

    def normal(self, local: Float, shared: Float) -> tuple[Float, Float, Float, Float]:
        """Reduced normal matrix and right side of the shared parameters, gain and offset of the local steps."""
        left, weight, _ = self.residuals(local, shared)
        rows_local, rows_shared = self.jacobians(local, shared)
        weighted = rows_local * weight[:, None, :]
        inner = weighted @ rows_local.swapaxes(1, 2)
        inner[:, range(_N_LOCAL), range(_N_LOCAL)] *= 1.0 + 1e-9
        cross = weighted @ rows_shared.swapaxes(1, 2)
        outer = (rows_shared * weight[:, None, :]) @ rows_shared.swapaxes(1, 2)
        right_local = (weighted @ left[:, :, None])[:, :, 0]
        right_shared = ((rows_shared * weight[:, None, :]) @ left[:, :, None])[:, :, 0]
        gain = np.linalg.solve(inner, np.concatenate([cross, right_local[:, :, None]], axis=2))
        matrix = np.sum(outer - cross.swapaxes(1, 2) @ gain[:, :, :-1], axis=0)
        side = np.sum(right_shared - np.einsum("nij,ni->nj", cross, gain[:, :, -1]), axis=0)
        return matrix, side, gain[:, :, :-1], gain[:, :, -1]

    def solve(self, local: Float, shared: Float) -> _PsfFitSolution:
        """Gauss-Newton with a line search on chi-square."""
        local, shared = local.copy(), shared.copy()
        cost = float(self.star_chi2(local, shared).sum())
        for _ in range(_STEPS):
            matrix, side, gain, alone = self.normal(local, shared)
            covariance = np.linalg.pinv(matrix, hermitian=True)
            step = covariance @ side
            step *= min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), 1e-300))
            pace = 1.0
            for _ in range(6):
                new_shared = shared + pace * step.reshape(shared.shape)
                new_local = local + pace * np.clip(
                    alone - gain @ step, -0.5 * np.abs(local) - 0.5, 0.5 * np.abs(local) + 0.5
                )
                new_cost = float(self.star_chi2(new_local, new_shared).sum())
                if new_cost <= cost * (1.0 + 1e-9):
                    break
                pace *= 0.4
            else:
                return _PsfFitSolution(local, shared, True)
            gained = cost - new_cost
            local, shared, cost = new_local, new_shared, new_cost
            small = np.abs(step) <= _SETTLED * np.sqrt(np.maximum(np.diag(covariance), 0.0)) + 1e-9
            if bool(small.all()) or gained < _GAINED * cost:
                return _PsfFitSolution(local, shared, True)
        return _PsfFitSolution(local, shared, False)

    def estimate(
        self, solution: _PsfFitSolution, kind: PsfKind, degree: int, shape: tuple[int, ...], offered: int
    ) -> PsfEstimate:
        matrix, _, _, _ = self.normal(solution.local, solution.shared)
        left, weight, light = self.residuals(solution.local, solution.shared)
        freedom = max(int(np.count_nonzero(weight)) - _N_LOCAL * len(left) - solution.shared.size, 1)
        reduced = float(np.sum(weight * left**2)) / freedom
        noise = self.patches.noise_dn**2 * np.count_nonzero(weight, axis=1)
        power = (np.sum(left**2, axis=1) - noise) / np.sum(light**2, axis=1)
        return PsfEstimate(
            kind=kind,
            coefficients=solution.shared,
            covariance=np.asarray(np.linalg.pinv(matrix, hermitian=True) * max(1.0, reduced), dtype=np.float64),
            degree=degree,
            columns=int(shape[1]),
            rows=int(shape[0]),
            reduced_chi2=reduced,
            residual_power=float(max(np.median(power), 0.0)),
            n_used=len(left),
            n_rejected=offered - len(left),
        )
