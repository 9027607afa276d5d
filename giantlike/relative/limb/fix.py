"""Position from a limb: options, iteration and fix shared by all limb estimators."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol, TypeVar

import numpy as np

from giantlike.core.arrays import Float, Mask, require, require_number
from giantlike.core.causes import Cause, sum_parts
from giantlike.core.findings import Corrections, Findings
from giantlike.core.outcomes import BodyTurn, Failure, PositionFix, Quality, Reason
from giantlike.core.values import Value
from giantlike.processing.correlated_fit import robust_solution
from giantlike.processing.limb.measurement import LimbMeasurement
from giantlike.processing.limb.view import LimbView
from giantlike.ray_tracing import FocalPlane
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.judge import LEAST_USED_SHARE, Alternative, Facts, Judgement
from giantlike.relative.place import center_of_position, place_covariance

_LOG = logging.getLogger("giantlike.relative")

Measured = TypeVar("Measured", bound=LimbMeasurement)

PATIENCE = 3  # iterations with full steps; later ones are halved, because the points used can alternate
_MAX_RANGE_STEP = 0.1
"""Maximum step relative to the range, over which the outline is linear in the position to a few percent."""
_SURE = 3.0
"""Standard deviations of the range of an approximating ellipsoid that must lie within the search: of 28 correct fixes
of rocks by ellipsoids that exceeded it, 11 were classified as suspect."""
_MAX_RANGE_SIGMA = 0.25  # maximum relative standard deviation of the range of a position, up to which errors are linear
LEAST_PSF_PX2 = 0.01  # minimum variance of an estimated point spread function, px^2: about a tenth of that of a pixel
_RELIEF_RMS = 2.0  # maximum residuals in units of the relief; not yet studied on bodies with relief


class EdgeModel(StrEnum):
    """Expected brightness across a limb."""

    TEMPLATE = "template"  # the rendered body with its reflectance law and the point spread function
    STEP = "step"  # A blurred step: no photometric model is needed


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanOptions:
    """Options of all ways to measure the points of a limb.

    min_contrast: mean of (inside - outside) / (inside + outside) across the limb below which no limb was located.
    """

    edges: EdgeModel = EdgeModel.TEMPLATE
    window_px: float = 5.0  # largest distance of pixels used, to both sides of the limb
    min_contrast: float = 0.35
    psf_error: float = 0.05  # relative standard deviation of the width of the camera's point spread function

    def __post_init__(self) -> None:
        require(self.edges in list(EdgeModel), f"edges must be one of {', '.join(EdgeModel)}, got {self.edges!r}")
        object.__setattr__(self, "edges", EdgeModel(self.edges))
        require_number(self.window_px, "window_px", above=0.0, most=50.0)
        require_number(self.min_contrast, "min_contrast", above=0.0, most=1.0)
        require_number(self.psf_error, "psf_error", above=0.0, most=1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LimbSearch:
    """Options of all limb estimators: search region, and limits of accepted points and fixes.

    Parameters
    ----------
    search_px : float, px; largest error of the predicted center, in both coordinates
    search_range : float; largest relative error of the predicted range
    outlier_mad : float; limb points beyond so many robust sigmas are left out
    large_rms_px : float, px; kept for files of earlier versions: residuals raise no flag
    """

    search_px: float = 40.0
    search_range: float = 0.03
    outlier_mad: float = 4.0
    large_rms_px: float = 1.0

    def __post_init__(self) -> None:
        require_number(self.search_px, "search_px", above=0.0, most=500.0)
        require_number(self.search_range, "search_range", least=0.0, most=0.3)
        require_number(self.outlier_mad, "outlier_mad", above=0.0)
        require_number(self.large_rms_px, "large_rms_px", above=0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class IteratedSearch(LimbSearch):
    """Options of the estimators that iterate the measurement of a limb to convergence.

    Parameters
    ----------
    max_iterations : int; maximum number of measurements
    tolerance_px : float, px; the fit has converged when the limb would move less than this in another iteration
    max_rms_px : float, px; larger residuals, beyond what relief explains, are a failure
    """

    max_iterations: int = 8
    tolerance_px: float = 0.01
    max_rms_px: float = 5.0

    def __post_init__(self) -> None:
        LimbSearch.__post_init__(self)
        require_number(self.tolerance_px, "tolerance_px", above=0.0)
        require_number(self.max_rms_px, "max_rms_px", above=0.0)
        whole = isinstance(self.max_iterations, int) and 1 <= self.max_iterations <= 50
        require(whole, f"max_iterations must be a whole number in [1, 50], got {self.max_iterations}")

    def allowed_rms_px(self, measured: LimbMeasurement) -> float:
        """Return the residuals, px, beyond which a position is a failure; the relief of a limb raises them."""
        return self.max_rms_px + _RELIEF_RMS * measured.relief_px


def limb_view(inputs: EstimatorInputs, altitude_sigma_km: float) -> LimbView:
    """Take the inputs of a limb measurement, at an uncertain altitude, from the inputs of an estimator."""
    camera = inputs.camera
    return LimbView(
        pixels_dn=inputs.pixels_dn,
        usable=inputs.usable,
        saturated=inputs.saturated,
        detector=camera.detector,
        plane=FocalPlane(model=camera.model, columns=camera.columns, rows=camera.rows, psf=camera.psf),
        sun_direction_camera=inputs.geometry.sun_direction_camera,
        radius_px=inputs.radius_px,
        in_air=altitude_sigma_km > 0.0,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimbState(Value):
    """State of the iteration."""

    position_camera_km: Float  # position of the body
    psf_px2: float = LEAST_PSF_PX2  # variance of the point spread function, for scans that estimate it
    iteration: int = 0  # number of measurements made before
    moved_px: float = math.inf  # largest motion of the limb in the step before; infinite at the start


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimbStep(Value):
    """Step of the iteration."""

    position_km: Float  # in camera axes
    keep: Mask  # (n,); points consistent with the position
    psf_px2: float = 0.0  # change of the variance of the point spread function


class LimbScan(Protocol[Measured]):
    """Method to measure the limb of a body at an assumed position."""

    def measure(self, state: LimbState) -> Measured | Failure:
        """Measure the limb across the body in a state; all of its points are kept."""
        ...

    def step(self, measured: Measured, state: LimbState) -> LimbStep:
        """Compute the step of the body from the points."""
        ...

    def has_converged(self, measured: Measured, step: LimbStep, moved_px: float, state: LimbState) -> bool:
        """Return True if another measurement is not needed, the limb moving by ``moved_px`` in the shortened step."""
        ...

    def finish(self, measured: Measured, step: LimbStep) -> Measured:
        """Return the measurement for the final solution; the last step is not taken."""
        ...


def settle_limb(
    scan: LimbScan[Measured], start: LimbState, search: IteratedSearch, *, min_points: int, closest_km: float
) -> Measured | Failure:
    """Measure a limb and move the body until convergence."""
    state = start
    for _ in range(search.max_iterations):
        measured = scan.measure(state)
        if isinstance(measured, Failure):
            return measured
        step = scan.step(measured, state)
        share = _share(step, state)
        moved_px = share * float(np.max(np.abs(measured.design[step.keep] @ step.position_km)))
        _LOG.debug("limb moved by %.3g px in iteration %d", moved_px, state.iteration + 1)
        if scan.has_converged(measured, step, moved_px, state):
            if step.keep.sum() >= min_points:
                return scan.finish(measured, step)
            text = (
                f"only {step.keep.sum()} of {step.keep.size} limb points agree with one position, needed {min_points}"
            )
            return Failure(Reason.LARGE_RESIDUALS, text)
        state = LimbState(
            position_camera_km=state.position_camera_km + share * step.position_km,
            psf_px2=max(state.psf_px2 + share * step.psf_px2, LEAST_PSF_PX2) if step.psf_px2 else state.psf_px2,
            iteration=state.iteration + 1,
            moved_px=moved_px,
        )
        if not float(np.linalg.norm(state.position_camera_km)) > closest_km:
            break
    return Failure(
        Reason.NOT_CONVERGED,
        f"the limb still moved by {moved_px:.2g} px after {state.iteration} iterations, tolerance_px is "
        f"{search.tolerance_px:g}",
    )


def agreeing_step(measured: LimbMeasurement, outlier_mad: float) -> LimbStep:
    """Take a robust least-squares step of the position."""
    step, keep = robust_solution(measured.shift_px, measured.design, measured.sigma_px, outlier_mad=outlier_mad)
    return LimbStep(position_km=step, keep=keep)


def next_motion_px(before_px: float, moved_px: float) -> float:
    """Predict the motion of the limb in one more iteration after moving ``before_px`` and then ``moved_px``.

    The iteration converges by about the same factor each time; the factor is unknown after the first step.

    ``before_px``: infinite where there was no step before.

    >>> round(next_motion_px(1.0, 0.05), 6)
    0.0025
    """
    return moved_px * min(moved_px / before_px, 1.0) if math.isfinite(before_px) else moved_px


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimbSolution(Value):
    """Position of a body from its limb.

    covariances_km2: mapping of Cause to (3, 3), camera axes; covariance by each cause; they add up.
    """

    position_camera_km: Float  # of the origin of the shape
    covariances_km2: Mapping[Cause, Float]
    residuals_px: Float  # (m,); residuals of the points used, positive outward
    limb_px: Float  # (m, 2); those points in the image
    corrections: Corrections = field(default_factory=Corrections)  # for the altitude of the limb
    turn: BodyTurn | None = None  # where it was measured

    @property
    def covariance_camera_km2(self) -> Float:
        """Covariance (3, 3) of the position by all causes, km^2, camera axes."""
        return sum_parts(self.covariances_km2)


def limb_fix(
    inputs: EstimatorInputs,
    measured: LimbMeasurement,
    solution: LimbSolution,
    search: LimbSearch,
    *,
    allowed_rms_px: float = math.inf,
) -> PositionFix | Failure:
    """Classify a position from a limb and put it into a :class:`PositionFix`."""
    place = _Place.from_solution(inputs, solution)
    refused = _check_solution(place, inputs, measured, search, allowed_rms_px)
    if refused is not None:
        return refused
    facts = _facts(place, inputs, measured, search)
    if facts.far_from_prediction and measured.n_used < LEAST_USED_SHARE * measured.n_offered:
        return Failure(
            Reason.NO_LIMB,
            f"the outline was found {np.max(np.abs(facts.off_px)):.0f} px and {facts.range_ratio - 1.0:+.1%} of size "
            f"from the predicted one, beyond the search of {search.search_px:g} px and {search.search_range:.1%}, and "
            f"{measured.n_used} of {measured.n_offered} points there are like a limb: a terminator, or another edge",
        )
    replaced = Quality.SHAPE_APPROXIMATED if measured.relief_px > 0.0 else Quality.NONE
    identity = inputs.identity
    identity["corrections"] |= solution.corrections | Corrections(limb_blur_px2=measured.wider_px2)
    terrain, findings, judgement = measured.terrain, Findings(), Judgement()
    if terrain is not None:
        identity["provenance"] = {**inputs.provenance, "terrain": terrain.name, "terrain_sha256": terrain.sha256}
        findings = Findings(
            terrain_mean_km=terrain.mean_km, terrain_log_odds=-terrain.log_odds, terrain_misfit=terrain.misfit
        )
        judgement = Judgement(alternatives={Alternative.SMOOTH_LIMB: terrain.log_odds})
    model, position_km = inputs.camera.model, solution.position_camera_km
    return PositionFix(
        **identity,
        center_px=place.center_px,
        covariance_px2=place.covariance_px2,
        residuals=solution.residuals_px,
        n_used=measured.n_used,
        n_rejected=measured.n_offered + measured.n_elsewhere - measured.n_used,
        score=place.rms_px,
        flags=inputs.flags_at(measured.area) | facts.flags | judgement.flags | replaced,
        parts={cause: place_covariance(model, position_km, part) for cause, part in solution.covariances_km2.items()},
        position_camera_km=position_km,
        covariance_camera_km2=solution.covariance_camera_km2,
        limb_px=solution.limb_px,
        limb_rejected_px=measured.rejected_px,
        residuals_at_px=solution.limb_px,
        turn=solution.turn,
        findings=findings,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Place(Value):
    """A solution in image terms: center (2,) and its covariance, range and its relative sigma, residuals."""

    center_px: Float
    covariance_px2: Float
    range_km: float
    sigma_range: float
    rms_px: float

    @classmethod
    def from_solution(cls, inputs: EstimatorInputs, solution: LimbSolution) -> _Place:
        position_km, covariance_km2 = solution.position_camera_km, solution.covariance_camera_km2
        center_px, covariance_px2 = center_of_position(inputs.camera.model, position_km, covariance_km2)
        range_km = float(np.linalg.norm(position_km))
        return cls(
            center_px=center_px,
            covariance_px2=covariance_px2,
            range_km=range_km,
            sigma_range=float(np.sqrt(position_km @ covariance_km2 @ position_km)) / range_km**2,
            rms_px=float(np.sqrt(np.mean(solution.residuals_px**2))),
        )

    @property
    def sigma_px(self) -> float:
        """Standard deviation of the center where it is largest, px."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance_px2)[-1]))


def _check_solution(
    place: _Place, inputs: EstimatorInputs, measured: LimbMeasurement, search: LimbSearch, allowed_rms_px: float
) -> Failure | None:
    """Failure of a solution with too large residuals or covariance; None otherwise."""
    if place.rms_px > allowed_rms_px:
        return Failure(
            Reason.LARGE_RESIDUALS,
            f"residuals of {measured.n_used} limb points are {place.rms_px:.2f} px rms, allowed {allowed_rms_px:.3g}: "
            "wrong shape, orientation or Sun direction, or not this body",
        )
    if not (place.sigma_range < _MAX_RANGE_SIGMA and place.sigma_px < inputs.radius_px):
        return Failure(
            Reason.DEGENERATE_GEOMETRY,
            f"{measured.n_used} limb points on {measured.outline_share:.0%} of the outline do not fix the position: "
            f"sigma {place.sigma_px:.1f} px across and {place.sigma_range:.1%} of range",
        )
    if measured.relief_px > 0.0 and _SURE * place.sigma_range > search.search_range > 0.0:
        return Failure(
            Reason.WRONG_SHAPE,
            f"an ellipsoid for the shape leaves {place.sigma_range:.1%} of range open, and {_SURE:g} sigma must lie in "
            f"the search of {search.search_range:.1%}: use limb_matching or raise search_range",
        )
    return None


def _facts(place: _Place, inputs: EstimatorInputs, measured: LimbMeasurement, search: LimbSearch) -> Facts:
    """Facts of a solution."""
    return Facts(
        off_px=place.center_px - inputs.predicted_px,
        search_px=search.search_px,
        range_ratio=inputs.geometry.range_km / place.range_km,
        search_range=search.search_range,
        n_used=measured.n_used,
        n_offered=measured.n_offered,
        outline_share=measured.outline_share,
        cut_by_frame=measured.cut_by_frame,
    )


def _share(step: LimbStep, state: LimbState) -> float:
    """Fraction of a step to take: half after some iterations, and at most a tenth of the range."""
    most = _MAX_RANGE_STEP * float(np.linalg.norm(state.position_camera_km))
    limit = most / max(float(np.linalg.norm(step.position_km)), 1e-300)
    return min(1.0, limit) * (1.0 if state.iteration <= PATIENCE else 0.5)
