"""The checks behind every estimate: numbers of a fix that follow from a coarse render at the place found."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, TypedDict, TypeVar, cast, runtime_checkable

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float
from giantlike.core.causes import IN_IMAGE, Cause, summed
from giantlike.core.outcomes import CenterFix, Failure, PositionFix
from giantlike.core.values import Value
from giantlike.ray_tracing import Body, Template, Trace
from giantlike.relative.budget import camera_response, with_error, with_larger_errors
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.quality import LEAST_CHANCE, LEAST_PREDICTION_CHANCE, UNLIKELY, QualityChecks
from giantlike.relative.verification.cells import CELLS_PER_RADIUS, Cells, cells_around
from giantlike.relative.verification.coarse_fit import CoarseFit, fit_cells
from giantlike.relative.verification.haze import HAZE_CELLS_PER_RADIUS, hint_of_haze, in_haze, may_be_hazy, veils
from giantlike.relative.verification.light_side import light_side
from giantlike.relative.verification.proportion import in_proportion, looks_bent
from giantlike.relative.verification.rival import rival_log_odds
from giantlike.relative.verification.turn import fit_turned
from giantlike.rings import Rings
from giantlike.shapes import Ellipsoid

AnyFix = TypeVar("AnyFix", bound=CenterFix)

_LINEAR = 0.01
"""Motion over the radius, and change of the range, up to which derivatives of the coarse render tell the residuals: a
fifth of a cell."""
_SHARP_PX = 0.4
"""The same of a limb, px, where the range is not of the fix but told: up to there the square of a motion, which looks
like a blur, is within half of the standard deviation that known optics leave to one (0.3 px^2). A range 1 % off moves
the limb of a body of 300 px by 1.5 px."""
_BELIEVED = 0.5
"""Motion over the radius, and change of the range, beyond which the coarse fit has not found the body."""
_TURN_MISFIT = 0.2
"""Residuals, as in ``QualityChecks.misfit``, from which on it is asked whether the face is turned: smaller ones leave
no turn of more than a degree, and are those of most right fixes, which should not pay for four more renders."""
_SMEAR = np.array([[1.0, 0.0, -1.0], [0.0, 2.0, 0.0]])
"""What of a blur (xx, xy, yy) is more along one direction than across it."""
_NOT_BY_CHANCE = 1e-3
"""Probability below which errors of a fix are not those of all axes alike: the rate of false alarms of the prediction.

Of 2,324 ``ok`` fixes of the gauntlet (seed 9500) 27 are so off in place or figure, none of which had to be ``ok``."""
_OF_ITS_OWN = tuple(cause for cause in IN_IMAGE if cause is not Cause.SHAPE_SCALE)
"""Causes of errors that a fix and the coarse fit of the same shape do not have in common."""


class _Numbers(TypedDict, total=False):
    """Numbers of a fix that its flags follow from: keywords of :class:`~giantlike.relative.quality.QualityChecks`."""

    light_log_odds: float
    rival_log_odds: float
    misfit: float
    unexplained: float
    unevenness: float
    step: float
    place_chance: float
    figure_chance: float
    blur_chance: float
    turn_chance: float
    turn_share: float
    prediction_chance: float
    growth: float


def verified(
    fix: AnyFix,
    inputs: EstimatorInputs,
    search_px: float,
    *,
    by_light: bool = False,
    again: Callable[[EstimatorInputs], AnyFix | Failure] | None = None,
) -> AnyFix:
    """Return a fix with the flags and numbers of its checks; unchanged where it has them already.

    Parameters
    ----------
    fix : CenterFix or PositionFix
        With its error budget.
    inputs : EstimatorInputs
    search_px : float, px
        Declared search: largest error of the prediction, in both coordinates.
    by_light : bool
        The fix is that of all light, which moves with whatever is wrong with the figure; estimators on limbs and
        templates know errors of relief themselves.
    again : callable, optional
        Runs the estimator on other inputs: a fix that takes values for light is made again where the coarse render
        shows that they are not in proportion to it, and one of a limb where it shows haze that nobody told.

    Returns
    -------
    CenterFix or PositionFix
    """
    if fix.findings.checks:
        return fix
    coarse = _coarse(fix, inputs, search_px)
    if again is not None and coarse is not None and looks_bent(coarse):
        straight = in_proportion(fix, coarse, inputs, again, lambda one, its: _coarse(one, its, search_px))
        if straight is not None:
            fix, coarse, inputs = straight
    if again is not None and coarse is not None and hint_of_haze(fix, coarse.fit, inputs):
        fine = _at(coarse.trace.body, inputs, None, fix)
        hazy = in_haze(fix, fine, inputs, again, lambda one, its: _coarse(one, its, search_px))
        if hazy is not None:
            fix, coarse, inputs = hazy
    numbers = _Numbers() if coarse is None else _image_numbers(fix, coarse, inputs, search_px)
    known, fit = inputs.psf_sigma_px is not None, None if coarse is None else coarse.fit
    off = _off_prediction(fix, fit, inputs)
    if off is not None:
        numbers["prediction_chance"] = chance_of(*off)
    if by_light and fit is not None:
        numbers["growth"] = _growth(fix, fit.figure_px2)
    if not numbers:
        return fix
    checks = QualityChecks(off_px=np.zeros(2), search_px=math.inf, **numbers)
    tension = 1.0 if fit is None else tension_of(fix, fit, psf_known=known)
    if off is not None and LEAST_PREDICTION_CHANCE <= numbers["prediction_chance"] < UNLIKELY:
        tension = max(tension, _ratio(*off))
    findings = replace(fix.findings, checks={**cast("dict[str, float]", numbers), "tension": tension})
    fix = replace(fix, flags=fix.flags | checks.flags, findings=findings)
    if tension > 1.0:
        fix = with_larger_errors(fix, inputs.camera.model, tension, _OF_ITS_OWN)
    if not by_light or fit is None:
        return fix
    return with_error(fix, inputs.camera.model, Cause.RELIEF, fit.figure_px2)


def tension_of(fix: CenterFix, fit: CoarseFit, *, psf_known: bool) -> float:
    """Factor by which the variances of a fix are too small for what a coarse fit asks for beyond it.

    What contradicts a fix makes it suspect; what is merely unlikely makes it less certain. The factor is the ratio by
    which Birge makes measurements consistent: the largest of squared motion, strain and, where the point spread
    function was told, blur beyond it, per degree of freedom, and at least 1. Of right fixes on right models none has
    more. A blur that contradicts the fix says nothing of its errors: it may be rings, or another exposure.

    Per degree of freedom, a difference that lies along one axis stays larger than its sigma. Where it is too large for
    chance, it is not one of all axes alike, and counts whole.

    Parameters
    ----------
    fix : CenterFix or PositionFix
    fit : CoarseFit
        At the place of the fix.
    psf_known : bool
        True where the camera tells its point spread function.

    Returns
    -------
    float

    References
    ----------
    .. [1] Birge (1932), The calculation of errors by the method of least squares, Phys. Rev. 40, 207: the ratio of
       external to internal consistency.
    """
    own = _own(fix)
    size = len(own)
    place = _ratio(fit.moved[:size], fit.covariance[:size, :size] + own)
    figure = _ratio(fit.strain, fit.strain_covariance)
    # A fix that is less certain than the coarse one has errors of the figure in its covariance already.
    room = min(float(np.trace(fit.covariance[:2, :2]) / max(np.trace(own[:2, :2]), 1e-300)), 1.0)
    blurred = psf_known and chance_of(fit.blur, fit.blur_covariance) > LEAST_CHANCE  # beyond, the fix is refused
    smear = _ratio(_SMEAR @ fit.blur, _SMEAR @ fit.blur_covariance @ _SMEAR.T) if blurred else 0.0
    return max(1.0, place, 1.0 + room * (figure - 1.0), 1.0 + room * (smear - 1.0))


def _ratio(difference: Float, covariance: Float) -> float:
    """Squared length of a difference (k,) over its covariance (k, k): per axis, but whole where it is not by chance."""
    squared, size = _squared(difference, covariance), len(difference)
    return squared / (1 if _chance(squared, size) < _NOT_BY_CHANCE else size)


def _growth(fix: CenterFix, figure_px2: Float) -> float:
    """Factor by which errors of the figure (2, 2) make the sigma of a center larger than those of its own."""
    own_px2 = float(np.trace(_own(fix)[:2, :2]))
    return math.sqrt(1.0 + float(np.trace(figure_px2)) / max(own_px2, 1e-300))


def _own(fix: CenterFix) -> Float:
    """Covariance of a fix, of center and logarithm of the range, without what the coarse fit has in common with it."""
    return summed(fix.parts, _OF_ITS_OWN) if fix.parts else fix.covariance_px2


def chance_of(difference: Float, covariance: Float) -> float:
    """Probability that errors of a covariance come to as much.

    Parameters
    ----------
    difference : (k,) float64
    covariance : (k, k) float64

    Returns
    -------
    float
    """
    return _chance(_squared(difference, covariance), len(difference))


def _chance(squared: float, freedom: int) -> float:
    """Probability that a squared length over its covariance is as large, of some degrees of freedom."""
    from scipy.special import chdtrc

    return float(chdtrc(freedom, max(squared, 0.0)))


def _squared(difference: Float, covariance: Float) -> float:
    """Squared length of a difference (k,) over its covariance (k, k)."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    whitened = np.linalg.lstsq(covariance / np.outer(scale, scale), difference / scale, rcond=None)[0]
    return float(whitened @ (difference / scale))


def _off_prediction(fix: CenterFix, fit: CoarseFit | None, inputs: EstimatorInputs) -> tuple[Float, Float] | None:
    """Difference (k,) of fix and prediction, and its covariance; None where no errors of the prediction are declared.

    Center and logarithm of the range; a fix without one has that by which the body looks as large as in the image.
    Without a covariance of the attitude that the center was predicted with, the range alone is compared.
    """
    if Cause.EPHEMERIS not in fix.parts:
        return None
    difference, covariance = fix.center_px - inputs.predicted_px, fix.covariance_total
    if isinstance(fix, PositionFix):
        difference = np.append(difference, math.log(fix.range_km / inputs.geometry.range_km))
    elif fit is not None and not any(inputs.geometry.limb_altitude_km):  # haze looks larger than the body in it
        difference = np.append(difference, fit.moved[2])
        size = fit.covariance[2, 2] + _size_variance(fix, inputs)
        covariance = np.block([[covariance, np.zeros((2, 1))], [np.zeros((1, 2)), np.full((1, 1), size)]])
    compared = slice(0 if inputs.image.attitude_covariance_rad2 is not None else 2, len(difference))
    return (difference[compared], covariance[compared, compared]) if difference[compared].size else None


def _size_variance(fix: CenterFix, inputs: EstimatorInputs) -> float:
    """Relative variance of the predicted size of a body in the image, as far as its errors are declared."""
    geometry, camera = inputs.geometry, inputs.camera
    known = geometry.target.uncertainty
    declared = (known.ephemeris_km / geometry.range_km) ** 2 + known.scale**2
    if camera.uncertainty is None or not camera.uncertainty.estimated:
        return declared
    position_km = geometry.range_km * camera.model.unproject(fix.center_px)
    radius_km, sun = geometry.target.shape.mean_radius_km, geometry.sun_direction_camera
    by_camera = camera_response(camera, position_km, radius_km, sun, size=3)[2]
    return declared + float(by_camera @ camera.uncertainty.covariance @ by_camera)


def _image_numbers(fix: CenterFix, coarse: _Coarse, inputs: EstimatorInputs, search_px: float) -> _Numbers:
    """Numbers of the coarse render at the place found; none where the body has no face."""
    cells, trace, own = coarse.cells, coarse.trace, coarse.own
    numbers = _Numbers()
    side = light_side(cells, trace, own, inputs.geometry.sun_direction_camera) if cells.has_face else None
    if side is not None:
        numbers["light_log_odds"] = side.log_odds
    if side is not None or not cells.has_face:
        numbers["rival_log_odds"] = rival_log_odds(
            cells, own, inputs.predicted_px, search_px, inputs.geometry.target.uncertainty.albedo
        )
    if coarse.fit is not None:
        numbers.update(_fit_numbers(fix, coarse.fit, psf_known=inputs.psf_sigma_px is not None))
        numbers.update(_turn_numbers(coarse, coarse.fit, inputs))
    return numbers


def _fit_numbers(fix: CenterFix, fit: CoarseFit, *, psf_known: bool) -> _Numbers:
    """Residuals of a coarse fit, and chances that what it asks for beyond the fix are errors of its own."""
    own = _own(fix)
    size = len(own)
    return _Numbers(
        misfit=fit.misfit,
        unexplained=fit.unexplained,
        unevenness=fit.unevenness,
        step=fit.step,
        place_chance=chance_of(fit.moved[:size], fit.covariance[:size, :size] + own),
        figure_chance=chance_of(fit.strain, fit.strain_covariance),
        blur_chance=chance_of(fit.blur, fit.blur_covariance) if psf_known else 1.0,
    )


def _turn_numbers(coarse: _Coarse, fit: CoarseFit, inputs: EstimatorInputs) -> _Numbers:
    """What a turn of the face explains of the residuals, and its chance; none where there is little to explain."""
    if isinstance(inputs.geometry.target.shape, Ellipsoid) or not _TURN_MISFIT < fit.misfit < math.inf:
        return _Numbers()
    sun, turn_rad = inputs.geometry.sun_direction_camera, inputs.turn_rad
    albedo = inputs.geometry.target.uncertainty.albedo
    turned = fit_turned(coarse.cells, coarse.trace, coarse.own, sun, albedo=albedo, turn_rad=turn_rad)
    if turned is None or not len(turned.further):
        return _Numbers()
    covariance = turned.further_covariance + turn_rad**2 * np.eye(len(turned.further))
    share = 1.0 - (turned.misfit / fit.misfit) ** 2
    return _Numbers(turn_chance=chance_of(turned.further, covariance), turn_share=share)


@runtime_checkable
class _Oriented(Protocol):
    """A fix with the orientation of the body as it was estimated."""

    @property
    def camera_from_body(self) -> Rotation: ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Coarse(Value):
    """A body rendered where it was found and fitted to the image; ``fit`` is None where too few cells hold its face."""

    cells: Cells
    trace: Trace
    own: Template
    fit: CoarseFit | None


def _coarse(fix: CenterFix, inputs: EstimatorInputs, search_px: float) -> _Coarse | None:
    """Render and fit a body where it was found, and again where the image would have it if that is not near by.

    A body that is seen larger than its shape, by haze around it, or as a fix without a range measured its size, is
    rendered nearer: the two look the same.
    """
    geometry, model = inputs.geometry, inputs.camera.model
    range_km = fix.range_km if isinstance(fix, PositionFix) else geometry.range_km
    range_km /= 1.0 + (fix.corrections.limb_altitude_km or 0.0) / geometry.target.shape.mean_radius_km
    nearer = np.array([0.0, 0.0, -math.log(fix.corrections.seen_size or 1.0)])
    known = geometry.body(range_km * math.exp(nearer[2]) * model.unproject(fix.center_px))
    body = replace(known, camera_from_body=fix.camera_from_body) if isinstance(fix, _Oriented) else known
    first = _at(body, inputs, search_px, fix)
    if first is None or first.fit is None:
        return first
    moved = first.fit.moved
    found = nearer + moved
    coarse = replace(first, fit=replace(first.fit, moved=found))
    radius_px = first.cells.size * first.cells.radius
    step = max(float(np.hypot(*moved[:2])) / radius_px, abs(float(moved[2])))
    linear = _LINEAR if isinstance(fix, PositionFix) else min(_LINEAR, _SHARP_PX / radius_px)
    if step < linear or step > _BELIEVED:
        return coarse
    position_km = range_km * math.exp(found[2]) * model.unproject(fix.center_px + found[:2])
    again = _at(replace(body, position_camera_km=position_km), inputs, search_px, fix)
    if again is None or again.fit is None or not again.fit.misfit < first.fit.misfit:
        return coarse
    return replace(again, fit=replace(again.fit, moved=found + again.fit.moved))


def _at(body: Body, inputs: EstimatorInputs, search_px: float | None, fix: CenterFix) -> _Coarse | None:
    """Render a body coarsely and fit it; None where it is too small or not seen.

    Without a search, in cells as fine as haze takes, which the residuals are then asked about.

    The response and the smear that the fix has found are none of its errors.
    """
    room_px = None
    if search_px is not None:
        room_px = search_px + float(np.max(np.abs(body.center_px(inputs.camera.model) - inputs.predicted_px)))
    cells = cells_around(
        inputs.pixels_dn,
        ~inputs.masked,
        inputs.saturated,
        inputs.camera,
        body,
        room_px=room_px,
        per_radius=CELLS_PER_RADIUS if search_px is not None else HAZE_CELLS_PER_RADIUS,
    )
    if cells is not None and inputs.geometry.target.rings is not None:
        cells = _without_rings(cells, inputs.geometry.target.rings, body, inputs.geometry.sun_direction_camera)
    trace = None if cells is None else cells.trace(body, inputs.geometry.sun_direction_camera)
    own = None if cells is None or trace is None else cells.render(trace)
    if cells is None or trace is None or own is None:
        return None
    albedo = inputs.geometry.target.uncertainty.albedo
    fit = None
    if cells.has_face:
        fit = fit_cells(
            cells,
            trace,
            own,
            albedo=albedo,
            turn_rad=inputs.turn_rad,
            response=fix.corrections.response,
            smear=fix.corrections.smear,
            asked=veils(cells, trace) if may_be_hazy(fix, inputs) else None,
        )
    return _Coarse(cells=cells, trace=trace, own=own, fit=fit)


def _without_rings(cells: Cells, rings: Rings, body: Body, sun_direction_camera: Float) -> Cells:
    """Cells without those on which rings of an ellipsoid lie, or their shadow, and without the cells beside these."""
    assert isinstance(body.shape, Ellipsoid)
    covered = rings.seen_or_shading(
        cells.sights(),
        body.shape.radii_km,
        body.position_camera_km,
        body.camera_from_body,
        sun_direction_camera=sun_direction_camera,
    )
    free = ~cv2.dilate(covered.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    return replace(cells, good=cells.good & free, fresh=cells.fresh & free)
