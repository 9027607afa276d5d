"""From a limb to a position: the iteration and the judgement that all estimators on limbs share."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

import numpy as np

from giantlike.core.arrays import Float, Mask, require
from giantlike.core.outcomes import Failure, PositionFix, Quality, Reason
from giantlike.core.values import Value
from giantlike.processing.correlated_fit import generalized_solution, robust_solution
from giantlike.ray_tracing import Body
from giantlike.relative.estimator import EstimatorInputs, center_of_position
from giantlike.relative.limb.observation import LimbObservation, LimbScanOptions, locate_limb, observe_limb
from giantlike.relative.quality import QualityChecks

_LOG = logging.getLogger("giantlike.relative")

_FIRST_SEARCH_PX = 3.0
_FIRST_LINES, _FIRST_RAYS = 100, 2  # the rough place needs no more
_PATIENCE = 3
"""Iterations after which steps are halved, and one that noise explains ends the fit: the lines used can alternate."""
_RELIEF_TOLERANCE = 0.1
_MAX_RANGE_STEP = 0.1
_MAX_RANGE_SIGMA = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class LimbSearch:
    """How far, how long and how strictly a limb is searched.

    Parameters
    ----------
    search_px : float, px
        Largest error of the predicted center, in both coordinates.
    search_range : float
        Largest relative error of the predicted range.
    max_iterations : int
        Times that the template is rendered and the limb measured.
    tolerance_px : float, px
        The fit has settled when the limb would move less than this in another iteration.
    outlier_mad : float
        Limb points beyond so many robust sigmas are left out.
    max_rms_px : float, px
        Larger residuals are a failure.
    large_rms_px : float, px
        Larger residuals get a flag.
    relief_px : float, px
        How much the true outline departs from that of the body that is matched, root mean square.
    """

    search_px: float
    search_range: float
    max_iterations: int
    tolerance_px: float
    outlier_mad: float
    max_rms_px: float
    large_rms_px: float
    relief_px: float = 0.0

    def __post_init__(self) -> None:
        for name in ("search_px", "tolerance_px", "outlier_mad", "max_rms_px", "large_rms_px"):
            value = getattr(self, name)
            require(math.isfinite(value) and value > 0, f"{name} must be > 0, got {value}")
        require(self.search_px <= 500, f"search_px must be <= 500, got {self.search_px}")
        require(0.0 <= self.search_range <= 0.3, f"search_range must be in [0, 0.3], got {self.search_range}")
        whole = isinstance(self.max_iterations, int) and 1 <= self.max_iterations <= 50
        require(whole, f"max_iterations must be a whole number in [1, 50], got {self.max_iterations}")

    @property
    def allowed_rms_px(self) -> float:
        """Largest residuals of a position that is believed, px."""
        return self.max_rms_px + 2.0 * self.relief_px


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SettledLimb(Value):
    """A limb measured across a prediction that no longer moves.

    Parameters
    ----------
    observation : LimbObservation
    design : (n, 3) float64, px/km
        Outward motion of its points with the position of the body.
    keep : (n,) bool
        Points that agree with one position.
    """

    observation: LimbObservation
    design: Float
    keep: Mask


def limb_design(normals_px: Float, projection_jacobian: Float) -> Float:
    """Outward motion of limb points in the image (n, 3), px/km, with the position of the body.

    Parameters
    ----------
    normals_px : (n, 2) float64, unitless
        Outward normals of the limb.
    projection_jacobian : (n, 2, 3) float64, px/km
        Of the camera model at the limb points in space.

    Notes
    -----
    A limb point that slides along the surface as the view changes slides along the limb too, so to first order only
    its own motion counts across the limb.
    """
    design: Float = np.einsum("ni,nij->nj", normals_px, projection_jacobian)
    return design


def settle_limb(
    inputs: EstimatorInputs, body: Body, *, search: LimbSearch, scan: LimbScanOptions
) -> SettledLimb | Failure:
    """Find the limb as a whole, then measure it and move the body until it stands still.

    Parameters
    ----------
    inputs : EstimatorInputs
    body : Body
        At the predicted position.
    search : LimbSearch
    scan : LimbScanOptions

    Returns
    -------
    SettledLimb or Failure
        ``NO_LIMB``, ``NOT_LIT``, ``OUT_OF_FRAME``, ``SATURATED``, ``NOT_CONVERGED`` or ``LARGE_RESIDUALS``.
    """
    located = locate_limb(inputs, body, search_px=search.search_px, search_range=search.search_range, options=scan)
    if isinstance(located, Failure):
        return located
    position = located.position_camera_km
    moved_px = math.inf
    for iteration in range(search.max_iterations):
        first = iteration == 0
        extra_px = 3.0 * search.relief_px + (_FIRST_SEARCH_PX if first else 0.0)
        observation = observe_limb(
            inputs,
            body.at(position),
            replace(scan, rays_per_pixel_side=_FIRST_RAYS) if first else scan,
            lines=located.lines.thinned(_FIRST_LINES) if first else located.lines,
            extra_px=extra_px,
            relief=search.relief_px > 0.0,
        )
        if isinstance(observation, Failure):
            return observation
        design = limb_design(observation.normals_px, inputs.camera.model.project_jacobian(observation.limb_camera_km))
        step, keep = robust_solution(observation.shift_px, design, observation.sigma_px, outlier_mad=search.outlier_mad)
        step = _limited(step, position) * (1.0 if iteration <= _PATIENCE else 0.5)
        before_px, moved_px = moved_px, float(np.max(np.abs(design[keep] @ step)))
        _LOG.debug("%s: limb moved by %.3g px in iteration %d", inputs.image.name, moved_px, iteration + 1)
        position = position + step
        settled = next_motion_px(before_px, moved_px) < search.tolerance_px + _RELIEF_TOLERANCE * search.relief_px
        if settled or (iteration >= _PATIENCE and moved_px < _motion_sigma_px(observation, design, keep)):
            return _agreed(inputs, SettledLimb(observation=observation, design=design, keep=keep), scan)
        if not float(np.linalg.norm(position)) > body.shape.circumscribing_radius_km:
            break
    return inputs.fail(
        Reason.NOT_CONVERGED,
        f"the limb still moved by {moved_px:.2g} px after {iteration + 1} iterations, "
        f"needed {search.tolerance_px:g} px",
    )


def next_motion_px(before_px: float, moved_px: float) -> float:
    """How far the limb would move in one more iteration after moving ``before_px`` and then ``moved_px``.

    The iteration converges by about the same factor each time; after the first step nothing is known of it.

    >>> round(next_motion_px(1.0, 0.05), 6)
    0.0025
    """
    return moved_px * min(moved_px / before_px, 1.0) if math.isfinite(before_px) else moved_px


def brightness_covariance(inputs: EstimatorInputs, limb: SettledLimb) -> Float:
    """Covariance (3, 3), km^2, of a position by what a wrong reflectance law does to the whole limb.

    Such an error changes slowly along the limb, over about a radian, and leaves hardly any residuals. Its size comes
    from the profiles: see ``LimbObservation.brightness_error_px``.
    """
    points = limb.observation.predicted_px[limb.keep]
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    shared = limb.observation.brightness_error_px**2 * np.exp(-apart / inputs.radius_px)
    return generalized_solution(np.zeros(len(points)), limb.design[limb.keep], shared, weights=np.ones(len(points)))[1]


def position_fix(
    inputs: EstimatorInputs,
    limb: SettledLimb,
    *,
    position_camera_km: Float,
    covariance_camera_km2: Float,
    residuals_px: Float,
    search: LimbSearch,
    flags: Quality = Quality.NONE,
) -> PositionFix | Failure:
    """Put a position from a limb into a :class:`PositionFix`, or tell why it is none.

    Parameters
    ----------
    inputs : EstimatorInputs
    limb : SettledLimb
    position_camera_km : (3,) float64, km, camera axes
        Of the origin of the shape.
    covariance_camera_km2 : (3, 3) float64, km^2
        By the scatter of the points; that of :func:`brightness_covariance` is added.
    residuals_px : (n,) float64, px
        Of the points kept, positive outward.
    search : LimbSearch
    flags : Quality
        Those that the estimator adds.

    Returns
    -------
    PositionFix or Failure
        ``LARGE_RESIDUALS`` or ``DEGENERATE_GEOMETRY``.
    """
    observation, n_used = limb.observation, int(limb.keep.sum())
    covariance_camera_km2 = covariance_camera_km2 + brightness_covariance(inputs, limb)
    range_km = float(np.linalg.norm(position_camera_km))
    direction = position_camera_km / range_km
    sigma_range = float(np.sqrt(direction @ covariance_camera_km2 @ direction)) / range_km
    rms_px = float(np.sqrt(np.mean(residuals_px**2)))
    if rms_px > search.allowed_rms_px:
        return inputs.fail(
            Reason.LARGE_RESIDUALS,
            f"residuals of {n_used} limb points are {rms_px:.2f} px rms, allowed {search.allowed_rms_px:.3g}: wrong "
            "shape, orientation or Sun direction, or not this body",
        )
    center_px, covariance_px2 = center_of_position(inputs.camera.model, position_camera_km, covariance_camera_km2)
    sigma_px = float(np.sqrt(np.linalg.eigvalsh(covariance_px2)[-1]))
    if not (sigma_range < _MAX_RANGE_SIGMA and sigma_px < inputs.radius_px):
        return inputs.fail(
            Reason.DEGENERATE_GEOMETRY,
            f"{n_used} limb points on {observation.limb_share:.0%} of the outline do not fix the position: sigma "
            f"{sigma_px:.1f} px across and {sigma_range:.1%} of range",
        )
    return PositionFix(
        estimator=inputs.estimator,
        target=inputs.target_name,
        center_px=center_px,
        covariance_px2=covariance_px2,
        predicted_px=inputs.predicted_px,
        residuals=residuals_px,
        n_used=n_used,
        n_rejected=observation.n_lines - n_used,
        score=rms_px,
        flags=flags | _flags(inputs, limb, center_px, range_km, rms_px, search),
        provenance=inputs.provenance,
        position_camera_km=position_camera_km,
        covariance_camera_km2=covariance_camera_km2,
        limb_px=observation.observed_px[limb.keep],
    )


def _agreed(inputs: EstimatorInputs, limb: SettledLimb, scan: LimbScanOptions) -> SettledLimb | Failure:
    n_kept = int(limb.keep.sum())
    if n_kept >= scan.min_lines:
        return limb
    return inputs.fail(
        Reason.LARGE_RESIDUALS,
        f"only {n_kept} of {limb.keep.size} limb points agree with one position, needed {scan.min_lines}",
    )


def _motion_sigma_px(observation: LimbObservation, design: Float, keep: Mask) -> float:
    """How uncertain the limb is where it is fixed worst, px, by the scatter of the points alone."""
    scatter = np.sqrt(np.mean(observation.sigma_px[keep] ** 2) + np.var(observation.shift_px[keep]))
    leverage = np.linalg.qr(design[keep])[0]
    return float(scatter * np.max(np.linalg.norm(leverage, axis=1)))


def _limited(step_km: Float, position_km: Float) -> Float:
    """A step (3,) of a position (3,) cut to a tenth of the range."""
    most = _MAX_RANGE_STEP * float(np.linalg.norm(position_km))
    return step_km * min(1.0, most / max(float(np.linalg.norm(step_km)), 1e-300))


def _flags(
    inputs: EstimatorInputs,
    limb: SettledLimb,
    center_px: Float,
    range_km: float,
    rms_px: float,
    search: LimbSearch,
) -> Quality:
    observation, keep = limb.observation, limb.keep
    flags = inputs.flags_at(observation.area)
    checks = QualityChecks(
        off_px=center_px - inputs.predicted_px,
        search_px=search.search_px,
        range_ratio=inputs.geometry.range_km / range_km,
        search_range=search.search_range,
        n_used=int(keep.sum()),
        n_offered=observation.n_lines,
        residuals=rms_px / (search.large_rms_px + 1.5 * search.relief_px),
        outline_share=observation.limb_share * float(keep.mean()),
        cut_by_frame=observation.lines.cut_by_frame,
    )
    return flags | checks.flags
