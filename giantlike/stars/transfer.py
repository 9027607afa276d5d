"""Attitude transfer: the attitude of an image from star images close in time.

Exposures short enough for a bright body show no stars, so navigation images come in pairs: a long exposure for the
attitude, a short one for the body. The method is the model of the rotation of the camera between them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike._system.processes import one_thread
from giantlike.core.arrays import Float, as_finite, require, require_number
from giantlike.core.causes import Cause, sum_parts
from giantlike.core.errors import InputError
from giantlike.core.frames import skew
from giantlike.core.outcomes import AttitudeErrors, Failure, Quality, Reason
from giantlike.core.units import RAD_PER_ARCSEC, RAD_PER_DEG
from giantlike.core.values import Value
from giantlike.image import AttitudeSource, Image
from giantlike.stars.rates import AngularRates


class TransferMethod(StrEnum):
    """Model of the rotation of the camera between two images."""

    REPLACE = "replace"  # no rotation: the nearest star solution is used as it is
    PROPAGATE = "propagate"
    """Rotation by angular rates (of a gyro) or by the a priori attitudes (of a CK), from the nearest star solution."""
    INTERPOLATE = "interpolate"
    """Constant rate between the star solutions before and after; the nearest one if one side is missing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TransferOptions:
    """Options of the transfer of attitudes from star images to other images.

    Parameters
    ----------
    method : TransferMethod; default ``interpolate``: it needs neither rates nor a priori attitudes
    max_gap_s : float, s; largest distance in time of star images used; default: no limit, as the drift grows
    drift_arcsec_per_sqrt_s : float, arcsec/s^0.5
        Random walk per axis of the rotation that the method does not model. It is zero at every star solution used,
        so between two of them it grows and shrinks again. Default 0.1: a quiet platform, 1 arcsec in 100 s; set it to
        the value of the spacecraft.
    max_disagreement_deg : float, deg
        Where a priori attitudes exist, the largest angle between the rotation by them and the rotation assumed by the
        method: it detects slews between two images. Default 1: above the error of most a priori attitudes; 180 turns
        the check off.
    """

    method: TransferMethod = TransferMethod.INTERPOLATE
    max_gap_s: float = math.inf
    drift_arcsec_per_sqrt_s: float = 0.1
    max_disagreement_deg: float = 1.0

    def __post_init__(self) -> None:
        require(self.max_gap_s >= 0, f"max_gap_s must be >= 0, got {self.max_gap_s}")
        require_number(self.drift_arcsec_per_sqrt_s, "drift_arcsec_per_sqrt_s", least=0.0)
        require_number(self.max_disagreement_deg, "max_disagreement_deg", above=0.0, most=180.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StarAttitude(Value):
    """A star solution and its time."""

    et: float
    camera_from_inertial: Rotation
    covariance_rad2: Float  # of the small rotation about the camera axes, as in ``giantlike.core.outcomes.AttitudeFix``
    apriori: Rotation | None = None  # a priori ``camera_from_inertial``
    errors: AttitudeErrors = field(default_factory=AttitudeErrors)  # by cause, and those shared by one camera

    def __post_init__(self) -> None:
        require(math.isfinite(self.et), f"et must be finite, got {self.et}")
        self._keep(covariance_rad2=as_finite(self.covariance_rad2, (3, 3), "covariance_rad2"))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TransferredAttitude(Value):
    """An attitude transferred from star images."""

    camera_from_inertial: Rotation
    covariance_rad2: Float  # of the small rotation: errors of the star solutions, and the drift
    used: tuple[int, ...]  # indices of the star solutions used, one or two
    weights: tuple[float, ...]  # fraction of each of them in the attitude; they sum to 1
    gap_s: float  # time to the nearest of them
    errors: AttitudeErrors  # those of the star solutions carried along; the drift is noise


def transfer_attitude(
    et: float,
    stars: Sequence[StarAttitude],
    *,
    apriori: Rotation | None = None,
    rates: AngularRates | None = None,
    options: TransferOptions = TransferOptions(),
) -> TransferredAttitude | Failure:
    """Attitude at a time from star solutions at other times.

    ``replace`` and ``propagate`` use the solution nearest in time: with the assumed rotation ``D``, ``C = D C_s`` and
    ``P = D P_s D^T``. ``interpolate`` turns at a constant rate: ``C = Exp(w phi) C_1`` with ``phi = Log(C_2 C_1^-1)``.
    To first order the errors ``e_1, e_2`` of the two solutions give ``e = (Exp(w phi) - w J(w phi) J(-phi)^-1) e_1 + w
    J(w phi) J(phi)^-1 e_2``, J the left Jacobian of SO(3). The random walk of the options adds ``q gap``, between two
    solutions ``q gap_1 gap_2 / (gap_1 + gap_2)``.
    """
    propagate = options.method is TransferMethod.PROPAGATE and rates is None
    if propagate and apriori is None:
        return Failure(Reason.NO_ATTITUDE, "method 'propagate' needs rates or an a priori attitude of this image")
    usable = [
        index
        for index, star in enumerate(stars)
        if abs(star.et - et) <= options.max_gap_s and not (propagate and star.apriori is None)
    ]
    if not usable:
        return Failure(Reason.NO_ATTITUDE, _nothing_near(et, stars, options, needs_apriori=propagate))
    before = max((i for i in usable if stars[i].et <= et), key=lambda i: stars[i].et, default=None)
    after = min((i for i in usable if stars[i].et > et), key=lambda i: stars[i].et, default=None)
    if options.method is TransferMethod.INTERPOLATE and before is not None and after is not None:
        result = _between(et, stars, before, after, options)
    else:
        nearest = min(usable, key=lambda i: (round(abs(stars[i].et - et), 6), stars[i].et))  # epochs are good to 1 us
        relative = _relative(et, stars[nearest], apriori, rates, options)
        if isinstance(relative, Failure):
            return relative
        result = _from_one(et, stars, nearest, relative, options)
    refusal = _disagreement(result, stars, apriori, options)
    return result if refusal is None else refusal


@one_thread()
def carry_attitude(
    image: Image,
    solved: Sequence[Image],
    *,
    rates: AngularRates | None = None,
    options: TransferOptions = TransferOptions(),
) -> Image | Failure:
    """Carry attitudes of images of stars to an image between them, as campaigns do.

    Parameters
    ----------
    image : Image; the exposure without stars; an attitude that it has is replaced
    solved : sequence of Image; of the same camera, with star attitudes (``long.with_attitude(fix)``)
    rates : AngularRates, optional; used by ``propagate``
    options : TransferOptions; default: constant rate between images, and the drift of a quiet platform

    Returns
    -------
    Image or Failure
        The image with the attitude, its covariance and errors by cause, source ``interpolated``; ``NO_EPOCH`` if the
        image has none, else as :func:`transfer_attitude`.

    Raises
    ------
    InputError
        A solved image lacks epoch, attitude or the covariance of it, or is of another camera.
    """
    if image.et is None:
        return Failure(Reason.NO_EPOCH, f"{image.name} has no epoch, so it has no neighbors in time")
    outcome = transfer_attitude(image.et, [_solution(image, each) for each in solved], rates=rates, options=options)
    if isinstance(outcome, Failure):
        return Failure(outcome.reason, f"{image.name}: {outcome.detail}")
    return image.with_attitude(
        outcome.camera_from_inertial,
        source=AttitudeSource.INTERPOLATED,
        covariance_rad2=outcome.covariance_rad2,
        errors=outcome.errors,
    )


def _solution(image: Image, solved: Image) -> StarAttitude:
    """Attitude of a solved image, as the transfer takes it."""
    et, rotation, covariance = solved.et, solved.camera_from_inertial, solved.attitude_covariance_rad2
    if et is None or rotation is None or covariance is None:
        lacks = "epoch" if et is None else "attitude" if rotation is None else "covariance of its attitude"
        raise InputError(f"{solved.name} has no {lacks}: solve its stars and give image.with_attitude(fix)")
    same = not (image.camera_name and solved.camera_name) or image.camera_name == solved.camera_name
    require(same, f"{solved.name} is of camera {solved.camera_name!r}, {image.name} of {image.camera_name!r}")
    return StarAttitude(et=et, camera_from_inertial=rotation, covariance_rad2=covariance, errors=solved.attitude_errors)


def _relative(
    et: float, star: StarAttitude, apriori: Rotation | None, rates: AngularRates | None, options: TransferOptions
) -> Rotation | Failure:
    """Rotation of the camera since a star solution, according to the transfer method."""
    if options.method is TransferMethod.PROPAGATE:
        if rates is not None:
            return rates.turn(star.et, et)
        if apriori is not None and star.apriori is not None:
            return apriori * star.apriori.inv()
    return Rotation.identity()


def _from_one(
    et: float, stars: Sequence[StarAttitude], index: int, relative: Rotation, options: TransferOptions
) -> TransferredAttitude:
    star = stars[index]
    gap = abs(star.et - et)
    covariance, errors = _propagate([star], [relative.as_matrix()], _walk(gap, options))
    return TransferredAttitude(
        camera_from_inertial=relative * star.camera_from_inertial,
        covariance_rad2=covariance,
        used=(index,),
        weights=(1.0,),
        gap_s=gap,
        errors=errors,
    )


def _between(
    et: float, stars: Sequence[StarAttitude], before: int, after: int, options: TransferOptions
) -> TransferredAttitude:
    first, second = stars[before], stars[after]
    span = second.et - first.et
    weight = (et - first.et) / span
    turn = (second.camera_from_inertial * first.camera_from_inertial.inv()).as_rotvec()
    part = Rotation.from_rotvec(weight * turn)
    rate = weight * _left_jacobian(weight * turn)
    by_second = rate @ np.linalg.inv(_left_jacobian(turn))
    by_first = part.as_matrix() - rate @ np.linalg.inv(_left_jacobian(-turn))
    drift = _walk(weight * (1 - weight) * span, options)
    covariance, errors = _propagate([first, second], [by_first, by_second], drift)
    return TransferredAttitude(
        camera_from_inertial=part * first.camera_from_inertial,
        covariance_rad2=covariance,
        used=(before, after),
        weights=(1.0 - weight, weight),
        gap_s=min(weight, 1 - weight) * span,
        errors=errors,
    )


def _propagate(stars: Sequence[StarAttitude], by_stars: Sequence[Float], drift: Float) -> tuple[Float, AttitudeErrors]:
    """Covariance (3, 3) and errors of ``sum(B e) + drift`` of star solutions with errors ``e``.

    Noise is new in each solution; other causes, of root ``S``, are common to all and add up to ``sum(B S)``.
    """
    parts = [star.errors.parts or {Cause.NOISE: star.covariance_rad2} for star in stars]
    total = {Cause.NOISE: drift}
    for cause in {cause for each in parts for cause in each}:
        roots = [by @ _root(each[cause]) for by, each in zip(by_stars, parts, strict=True) if cause in each]
        if cause is Cause.NOISE:
            total[cause] = drift + sum((root @ root.T for root in roots), np.zeros((3, 3)))
        else:
            root = sum(roots, np.zeros((3, 3)))
            total[cause] = root @ root.T
    flags, known = Quality.NONE, [star.errors.by_camera for star in stars if star.errors.by_camera is not None]
    for star in stars:
        flags |= star.errors.flags
    turned = [by @ each for by, each in zip(by_stars, known, strict=True)] if len(known) == len(stars) else []
    by_camera = sum(turned[1:], turned[0]) if turned else None
    return sum_parts(total, tuple(Cause)), AttitudeErrors(parts=total, by_camera=by_camera, flags=flags)


def _root(matrix: Float) -> Float:
    """Symmetric root of a covariance (3, 3)."""
    values, axes = np.linalg.eigh(matrix)
    root: Float = (axes * np.sqrt(np.maximum(values, 0.0))) @ axes.T
    return root


def _walk(duration_s: float, options: TransferOptions) -> Float:
    sigma = options.drift_arcsec_per_sqrt_s * RAD_PER_ARCSEC
    return np.eye(3) * (sigma**2 * duration_s)


def _left_jacobian(rotvec: Float) -> Float:
    """Left Jacobian (3, 3) of SO(3): ``Exp(v + d) = Exp(J(v) d) Exp(v)`` to first order."""
    angle = float(np.linalg.norm(rotvec))
    cross = skew(rotvec)
    if angle < 1e-4:  # below, the closed form loses more digits than the series leaves out
        second, third = 1 / 2, 1 / 6
    else:
        second, third = (1 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3
    return np.eye(3) + second * cross + third * (cross @ cross)


def _disagreement(
    result: TransferredAttitude, stars: Sequence[StarAttitude], apriori: Rotation | None, options: TransferOptions
) -> Failure | None:
    for star in (stars[index] for index in result.used):
        if apriori is None or star.apriori is None:
            continue
        expected = apriori * star.apriori.inv()
        assumed = result.camera_from_inertial * star.camera_from_inertial.inv()
        angle_deg = float((expected * assumed.inv()).magnitude()) / RAD_PER_DEG
        if angle_deg > options.max_disagreement_deg:
            return Failure(
                Reason.NO_ATTITUDE,
                f"the rotation by the a priori attitudes differs by {angle_deg:.3g} deg from that of transfer method "
                f"'{options.method}' (limit {options.max_disagreement_deg:g}): use 'propagate', or raise "
                "max_disagreement_deg if the a priori attitudes have such errors",
            )
    return None


def _nothing_near(et: float, stars: Sequence[StarAttitude], options: TransferOptions, *, needs_apriori: bool) -> str:
    if not stars:
        return "no star image of this run has an attitude solution"
    gaps = [abs(star.et - et) for star in stars if not (needs_apriori and star.apriori is None)]
    if not gaps:
        return "method 'propagate' needs rates or a priori attitudes of the star images"
    nearest = min(gaps)
    return f"the nearest star solution is {nearest:.6g} s away, max_gap_s allows {options.max_gap_s:g} s"
