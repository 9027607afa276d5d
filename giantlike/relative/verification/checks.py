"""Checks of every fix by a coarse render at the estimated position."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, TypeVar, runtime_checkable

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float, unit
from giantlike.core.causes import IN_IMAGE, Cause, sum_parts
from giantlike.core.findings import Smear
from giantlike.core.outcomes import CenterFix, Failure, PositionFix
from giantlike.core.values import Value
from giantlike.ray_tracing import Body, Template
from giantlike.ray_tracing.cached_trace import Trace
from giantlike.relative.budget import DECLARED, camera_response, with_error, with_larger_errors
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.judge import FALSE_ALARM, Alternative, Judgement, explaining_inflation, inflation
from giantlike.relative.verification.cells import CELLS_PER_RADIUS, Cells, cells_around
from giantlike.relative.verification.coarse_fit import CoarseFit, fit_cells, motion_log_evidence
from giantlike.relative.verification.haze import in_haze, may_be_hazy, veils
from giantlike.relative.verification.light_side import light_side
from giantlike.relative.verification.lines import restore_lines
from giantlike.relative.verification.proportion import in_proportion, looks_bent
from giantlike.relative.verification.rival import find_other_size, rival_log_odds
from giantlike.rings import Rings
from giantlike.shapes import Ellipsoid

AnyFix = TypeVar("AnyFix", bound=CenterFix)

_LINEAR = 0.01
"""Motion in radii, and relative change of the range, up to which the coarse render is linear: a fifth of a cell."""
_SHARP_PX = 0.4
"""As above, for the limb, px, where the range is declared, not estimated. The square of a motion looks like a blur;
this one is within half of the standard deviation for known optics (0.3 px^2). A range in error by 1 % moves the limb of
a body of 300 px by 1.5 px."""
_BELIEVED = 0.5  # motion in radii, and relative change of the range, beyond which the coarse fit has not found the body
_SMEAR = np.array([[1.0, 0.0, -1.0], [0.0, 2.0, 0.0]])  # anisotropic part of a blur (xx, xy, yy)
_NOTHING_THERE = 0.0  # log odds of no body where the image fits a dark one better than any bright one
_SECOND_SHARES = (0.25, 0.5, 0.75)  # fractions of the light in the second of two exposures
_FINE_CELLS_PER_RADIUS = 60  # cells are not smaller than pixels
_SHARP_CELLS = 4.0
"""Length of a motion, cells, from which it is distinguished from two exposures: these are at least two cells apart."""
_OF_ITS_OWN = tuple(cause for cause in IN_IMAGE if cause not in (Cause.SHAPE_SCALE, *DECLARED))
"""Causes of errors that a fix does not share with the coarse fit of the same shape."""


def verify(
    fix: AnyFix,
    inputs: EstimatorInputs,
    search_px: float,
    *,
    by_light: bool = False,
    again: Callable[[EstimatorInputs], AnyFix | Failure] | None = None,
    false_alarm: float = FALSE_ALARM,
) -> AnyFix:
    """Return a fix with the flags and numbers of its checks; unchanged where it has them already."""
    if "tension" in fix.findings.checks:
        return fix
    coarse = _coarse(fix, inputs, search_px)
    if again is not None and coarse is not None and looks_bent(coarse):
        straight = in_proportion(fix, coarse, inputs, again, lambda one, its: _coarse(one, its, search_px))
        if straight is not None:
            fix, coarse, inputs = straight
    if again is not None and coarse is not None:
        hazy = in_haze(fix, coarse, inputs, again, lambda one, its: _coarse(one, its, search_px))
        if hazy is not None:
            fix, coarse, inputs = hazy
    fit = None if coarse is None else coarse.fit
    off = _off_prediction(fix, fit, inputs)
    alternatives, other_place = ({}, -math.inf) if coarse is None else _odds(coarse, inputs, search_px)
    if coarse is not None and fix.corrections.smear is not None:
        alternatives[Alternative.SECOND_EXPOSURE] = _second_exposure_log_odds(
            fix, fix.corrections.smear, coarse, inputs
        )
    judgement = Judgement(
        alternatives=alternatives,
        other_place=other_place,
        prediction_chance=1.0 if off is None else chance_of(*off),
        false_alarm=false_alarm,
    )
    tension = 1.0 if fit is None else tension_of(fix, fit, psf_known=inputs.psf_sigma_px is not None)
    findings = replace(fix.findings, checks={**fix.findings.checks, **judgement.numbers, "tension": tension})
    fix = replace(fix, flags=fix.flags | judgement.flags, findings=findings)
    if tension > 1.0:
        fix = with_larger_errors(fix, inputs.camera.model, tension, _OF_ITS_OWN)
    if not by_light or fit is None:
        return fix
    return with_error(fix, inputs.camera.model, Cause.RELIEF, fit.figure_px2)


def tension_of(fix: CenterFix, fit: CoarseFit, *, psf_known: bool) -> float:
    """Factor by which the variances of a fix are too small for the corrections estimated by a coarse fit.

    The largest factor by motion, strain and, where the point spread function is declared, smear, and at least 1.
    """
    own = _own(fix)
    size = len(own)
    moved, coarse = fit.place.values[:size], fit.place.covariance[:size, :size]
    place = max(_inflation(moved, coarse + own), explaining_inflation(moved, own, coarse))
    figure = _inflation(fit.strain.values, fit.strain.covariance)
    # A fix that is less precise than the coarse one has errors of the figure in its covariance already.
    room = min(float(np.trace(coarse[:2, :2]) / max(np.trace(own[:2, :2]), 1e-300)), 1.0)
    smear = _inflation(_SMEAR @ fit.blur.values, _SMEAR @ fit.blur.covariance @ _SMEAR.T) if psf_known else 1.0
    return max(place, 1.0 + room * (max(figure, smear) - 1.0))


def _inflation(difference: Float, covariance: Float) -> float:
    """Factor by which a covariance (k, k) is too small for a difference (k,)."""
    return inflation(_squared_distance(difference, covariance), len(difference))


def _own(fix: CenterFix) -> Float:
    """Covariance of center and logarithm of the range of a fix, without errors shared with the coarse fit."""
    return sum_parts(fix.parts, _OF_ITS_OWN) if fix.parts else fix.covariance_px2


def chance_of(difference: Float, covariance: Float) -> float:
    """p-value of a difference under a covariance. ``difference`` (k,); ``covariance`` (k, k)."""
    return _chance(_squared_distance(difference, covariance), len(difference))


def _chance(squared: float, freedom: int) -> float:
    """p-value of a squared Mahalanobis distance."""
    from scipy.special import chdtrc

    return float(chdtrc(freedom, max(squared, 0.0)))


def _squared_distance(difference: Float, covariance: Float) -> float:
    """Squared Mahalanobis distance of a difference (k,) under its covariance (k, k)."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    whitened = np.linalg.lstsq(covariance / np.outer(scale, scale), difference / scale, rcond=None)[0]
    return float(whitened @ (difference / scale))


def _off_prediction(fix: CenterFix, fit: CoarseFit | None, inputs: EstimatorInputs) -> tuple[Float, Float] | None:
    """Difference (k,) of fix and prediction, and its covariance; None where no errors of the prediction are declared.

    Center and logarithm of the range; a fix without a range takes it from the apparent size in the image. Without a
    covariance of the attitude of the prediction, the range alone is compared.
    """
    if Cause.EPHEMERIS not in fix.parts:
        return None
    difference, covariance = fix.center_px - inputs.predicted_px, fix.covariance_total
    if isinstance(fix, PositionFix):
        difference = np.append(difference, math.log(fix.range_km / inputs.geometry.range_km))
    elif fit is not None and not any(inputs.geometry.limb_altitude_km):  # haze looks larger than the body in it
        difference = np.append(difference, fit.place.values[2])
        size = fit.place.covariance[2, 2] + _size_variance(fix, inputs)
        covariance = np.block([[covariance, np.zeros((2, 1))], [np.zeros((1, 2)), np.full((1, 1), size)]])
    compared = slice(0 if inputs.image.attitude_covariance_rad2 is not None else 2, len(difference))
    return (difference[compared], covariance[compared, compared]) if difference[compared].size else None


def _size_variance(fix: CenterFix, inputs: EstimatorInputs) -> float:
    """Relative variance of the predicted size of a body in the image, as far as its errors are declared."""
    geometry, camera = inputs.geometry, inputs.camera
    known = geometry.target.uncertainty
    along = unit(geometry.position_camera_km) / geometry.range_km
    declared = float(along @ geometry.covariance_ephemeris_km2 @ along) + known.scale**2
    if camera.uncertainty is None or not camera.uncertainty.estimated:
        return declared
    position_km = geometry.range_km * camera.model.unproject(fix.center_px)
    radius_km, sun = geometry.target.shape.mean_radius_km, geometry.sun_direction_camera
    by_camera = camera_response(camera, position_km, radius_km, sun, size=3)[2]
    return declared + float(by_camera @ camera.uncertainty.covariance @ by_camera)


def _odds(coarse: _Coarse, inputs: EstimatorInputs, search_px: float) -> tuple[dict[Alternative, float], float]:
    """Logarithms of the odds of other models of the image, and of another position in the search region."""
    cells, own, geometry = coarse.cells, coarse.own, inputs.geometry
    alternatives: dict[Alternative, float] = {} if coarse.fit is None else dict(coarse.fit.alternatives)
    side = light_side(cells, coarse.trace, own, geometry.sun_direction_camera) if cells.has_face else None
    if side is not None:
        alternatives[Alternative.OTHER_SUN] = side.log_odds
    elif cells.has_face:
        return alternatives, _NOTHING_THERE if _fits_dark_body(coarse.fit) else -math.inf
    albedo = geometry.target.uncertainty.albedo
    if cells.has_face:
        alternatives[Alternative.OTHER_SIZE] = _other_size_log_odds(coarse, inputs, albedo)
        for axis, lines in enumerate((Alternative.SHIFTED_ROWS, Alternative.SHIFTED_COLUMNS)):
            far = _far_lines_log_odds(coarse, inputs, albedo, axis)
            alternatives[lines] = float(np.logaddexp(alternatives.get(lines, -math.inf), far)) - math.log(2.0)
    rival = rival_log_odds(cells, own, inputs.predicted_px, search_px, albedo)
    return alternatives, max(rival, _NOTHING_THERE) if _fits_dark_body(coarse.fit) else rival


def _far_lines_log_odds(coarse: _Coarse, inputs: EstimatorInputs, albedo: float, axis: int) -> float:
    """Logarithm of the odds that rows or columns on one side of a line are far from their place.

    The image with the best of these moved back is fitted as the image was, with markings and without; the odds are the
    least of these.
    """
    found = restore_lines(coarse.cells, coarse.own, albedo, axis)
    if found is None or coarse.fit is None:
        return -math.inf
    log_odds, log_tries, cells = found
    fit = fit_cells(cells, coarse.trace, coarse.own, albedo=albedo, turn_rad=inputs.turn_rad)
    if fit is None:
        return -math.inf
    plain, marked = fit.log_evidence - coarse.fit.log_evidence, fit.marked_log_evidence - coarse.fit.marked_log_evidence
    return min(log_odds, plain - log_tries, marked - log_tries)


def _other_size_log_odds(coarse: _Coarse, inputs: EstimatorInputs, albedo: float) -> float:
    """Logarithm of the odds that the image shows a body of another apparent size, not this one with large markings.

    The size that matches best is rendered and fitted as the body was; both count no better than without markings.
    """
    cells, body = coarse.cells, coarse.trace.body
    found = find_other_size(cells, coarse.trace, coarse.own, albedo)
    if found is None or coarse.fit is None:
        return -math.inf
    log_odds, size, offset_px = found
    range_km = float(np.linalg.norm(body.position_camera_km)) / size
    position_km = range_km * inputs.camera.model.unproject(cells.center_px + offset_px)
    trace = cells.trace(replace(body, position_camera_km=position_km), inputs.geometry.sun_direction_camera)
    other = None if trace is None else cells.render(trace)
    if trace is None or other is None:
        return -math.inf
    fit = fit_cells(cells, trace, other, albedo=albedo, turn_rad=inputs.turn_rad)
    return -math.inf if fit is None else min(log_odds, fit.log_evidence - coarse.fit.log_evidence)


def _second_exposure_log_odds(fix: CenterFix, smear: Smear, coarse: _Coarse, inputs: EstimatorInputs) -> float:
    """Logarithm of the odds, in fine cells, of two exposures instead of the motion that a fix estimated."""
    fine = _at(coarse.trace.body, inputs, None, fix)
    if fine is None or fine.fit is None or smear.length_px < _SHARP_CELLS * fine.cells.size:
        return -math.inf
    in_cells = smear.on_blocks(fine.cells.size)

    def evidence(motion: Callable[[Float], Float]) -> float:
        return motion_log_evidence(fine.cells, fine.trace, fine.own, motion)

    moved = evidence(in_cells.blur)
    twice = [evidence(partial(in_cells.blur_double_exposure, share=share)) for share in _SECOND_SHARES]
    return float(np.logaddexp.reduce(twice)) - math.log(len(twice)) - moved if moved > -math.inf else -math.inf


def _fits_dark_body(fit: CoarseFit | None) -> bool:
    """True where the image fits a dark body better than a bright one."""
    return fit is not None and not fit.gain_dn > 0.0


@runtime_checkable
class _Oriented(Protocol):
    """A fix with an estimated orientation of the body."""

    @property
    def camera_from_body(self) -> Rotation: ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Coarse(Value):
    """A body rendered at its estimate and fitted to the image; ``fit`` is None where too few cells hold its disk."""

    cells: Cells
    trace: Trace
    own: Template
    fit: CoarseFit | None


def _coarse(fix: CenterFix, inputs: EstimatorInputs, search_px: float) -> _Coarse | None:
    """Render and fit a body at its estimated position, and again at the fitted position if that is not nearby.

    A body that appears larger than its shape, by haze or by the measured size of a fix without a range, is rendered
    nearer, which looks the same.
    """
    geometry, model = replace(inputs, corrections=fix.corrections).seen_geometry, inputs.camera.model
    range_km = fix.range_km if isinstance(fix, PositionFix) else geometry.range_km
    if fix.corrections.limb_altitude_km:
        range_km /= 1.0 + fix.corrections.limb_altitude_km / geometry.target.shape.mean_radius_km
    nearer = np.array([0.0, 0.0, -math.log(fix.corrections.seen_size or 1.0)])
    known = geometry.body(range_km * math.exp(nearer[2]) * model.unproject(fix.center_px))
    body = replace(known, camera_from_body=fix.camera_from_body) if isinstance(fix, _Oriented) else known
    first = _at(body, inputs, search_px, fix)
    if first is None or first.fit is None:
        return first
    moved = first.fit.place.values
    found = nearer + moved
    coarse = replace(first, fit=first.fit.at(found))
    radius_px = first.cells.size * first.cells.radius
    step = max(float(np.hypot(*moved[:2])) / radius_px, abs(float(moved[2])))
    linear = _LINEAR if isinstance(fix, PositionFix) else min(_LINEAR, _SHARP_PX / radius_px)
    if step < linear or step > _BELIEVED:
        return coarse
    position_km = range_km * math.exp(found[2]) * model.unproject(fix.center_px + found[:2])
    again = _at(replace(body, position_camera_km=position_km), inputs, search_px, fix)
    if again is None or again.fit is None or not again.fit.log_evidence > first.fit.log_evidence:
        return coarse
    return replace(again, fit=again.fit.at(found + again.fit.place.values))


def _at(body: Body, inputs: EstimatorInputs, search_px: float | None, fix: CenterFix) -> _Coarse | None:
    """Render a body coarsely and fit it; None where it is too small or not seen.

    Without a search, in the fine cells of the test for a second exposure. The response and the smear that the fix
    estimated are part of the model.
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
        per_radius=CELLS_PER_RADIUS if search_px is not None else _FINE_CELLS_PER_RADIUS,
    )
    if cells is not None and inputs.geometry.target.rings is not None:
        cells = _without_rings(cells, inputs.geometry.target.rings, body, inputs.geometry.sun_direction_camera)
    trace = None if cells is None else cells.trace(body, inputs.geometry.sun_direction_camera)
    own = None if cells is None or trace is None else cells.render(trace)
    if cells is None or trace is None or own is None:
        return None
    fit = None
    if cells.has_face:
        fit = fit_cells(
            cells,
            trace,
            own,
            albedo=inputs.geometry.target.uncertainty.albedo,
            turn_rad=inputs.turn_rad,
            response=fix.corrections.response,
            motion=None if fix.corrections.smear is None else fix.corrections.smear.on_blocks(cells.size).blur,
            veils=veils(cells, trace) if search_px is not None and may_be_hazy(fix, inputs) else None,
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
