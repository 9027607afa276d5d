"""Outcome classes, and the rule by which the generator declares, before any estimator runs, that an image is solvable.

The rule uses the plan and the signal without noise, never a result. Its limits are round numbers within the documented
limits of each estimator, fixed before the first image was solved and the same for all kinds. A kind adds only ``hard``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Reason
from giantlike.gauntlet.plan import READ_NOISE_DN, Plan
from giantlike.shapes import Ellipsoid

STARS = "stars"  # name of the star chain among the estimators


class Verdict(StrEnum):
    """Outcome class of one estimator and one image; the values appear in JSON and tables."""

    RIGHT = "right"  # ``ok``, within 4 sigma, and that sigma is at most 3 times the nominal one
    VAGUE = "vague"  # ``ok``, within 4 sigma, but of a larger sigma
    HONEST = "honest"  # suspect or failed, where no answer can be demanded, and the reason fits
    DOUBTFUL = "doubtful"  # ``ok`` and beyond 4 sigma, but not an undetected failure
    SILENT_WRONG = "silent_wrong"  # ``ok``, beyond 5 sigma, and beyond 0.5 px or 0.5 % of range
    NEEDLESS_REFUSAL = "needless_refusal"
    """Suspect or failed, although the rule said beforehand that the image can be solved."""
    MISLEADING = "misleading"  # suspect or failed, where no answer can be demanded, for a reason that is not true


LEAST_SNR, LARGEST_PHASE_DEG = 15.0, 110.0
"""Signal to noise ratio of the brightest pixel, and phase angle, within which an answer is demanded."""
LARGEST_OFFSET_PX, LARGEST_RANGE_ERROR = 30.0, 0.02
"""Error of the prediction within which an answer is demanded: inside the 40 px and 3 % of the narrowest search."""
POINT_PX, TEMPLATE_PX, LIMB_PX, ELLIPSE_PX = 3.0, 15.0, 40.0, 60.0
"""Maximum diameter of a point source; minimum diameters for templates and moments, limbs, and limbs without a
prediction."""
LEAST_LIMB_PX, LEAST_STARS = 60.0, 15
"""Minimum length of illuminated limb, px, and number of catalog stars in the frame for which an answer is required."""
MARGIN_PX = 10.0  # sky around a body that is wholly in the frame, px
_OUTLINE_POINTS = 360  # points of the outline of a sphere, every degree
_NEARLY_FULL = 0.95  # share of the largest value above which noise takes some pixels to it
_DIM_STAR_DN = 400.0  # signal of stars that count, DN over all pixels: signal to noise ratios from 15 up


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Properties of an image that the generator knows before it is solved."""

    hard: bool  # the kind allows a refusal
    undisturbed: bool = False  # the image has no disturbance
    absent: bool = False  # the target is not in the image
    damaged: bool = False  # values were damaged after the detector
    diameter_px: float = 0.0  # diameter_px, told_diameter_px: of a sphere of the same volume: true, assumed
    told_diameter_px: float = 0.0
    phase_deg: float = 0.0
    told_phase_deg: float = 0.0
    snr: float = 0.0  # of the brightest pixel of the body
    whole: bool = False  # the whole body is in the frame, with :data:`MARGIN_PX` around it
    limb_px: float = 0.0  # length of illuminated limb in the frame
    told_ellipsoid: bool = False
    offset_px: float = 0.0  # error of the predicted center, error of the attitude included
    range_error: float = 0.0  # relative error of the predicted range
    saturated: bool = False  # some signal exceeds the largest value
    stars: int = 0  # stars of the catalog in the frame


def facts_of(plan: Plan, signal_dn: Float, *, undisturbed: bool) -> Facts:
    """Collect the known properties of an image before it is solved."""
    world, told = plan.world, plan.told
    room = world.recorder.saturation_dn - world.recorder.bias_dn
    facts = Facts(
        hard=plan.hard,
        undisturbed=undisturbed,
        damaged=bool(world.readouts),
        saturated=bool((signal_dn > _NEARLY_FULL * room).any()),
        stars=_stars_in_frame(plan),
    )
    if told.shape is None:
        return facts
    predicted = rotate(told.attitude_error, told.position_camera_km)
    told_range = float(np.linalg.norm(predicted))
    told_cosine = float(np.clip(-(told.sun @ told.position_camera_km) / told_range, -1.0, 1.0))
    # True, not assumed.
    radius = told.shape.mean_radius_km if world.body is None else _mean_radius_km(world.body, told.shape.mean_radius_km)
    diameter = 2.0 * radius / world.range_km * world.view.focal_px
    background = float(np.median(signal_dn))
    peak = float(signal_dn.max()) - background
    return replace(
        facts,
        absent=world.body is None,
        diameter_px=diameter,
        told_diameter_px=2.0 * told.shape.mean_radius_km / told_range * world.view.focal_px,
        phase_deg=math.degrees(world.phase_rad),
        told_phase_deg=math.degrees(math.acos(told_cosine)),
        snr=peak / math.sqrt(max(peak + background, 0.0) + READ_NOISE_DN**2),
        whole=_whole(plan, diameter),
        limb_px=_lit_limb_px(plan, diameter),
        told_ellipsoid=isinstance(told.shape, Ellipsoid),
        offset_px=float(np.linalg.norm(world.view.project(predicted) - world.center_px)),
        range_error=abs(told_range / world.range_km - 1.0),
    )


def _mean_radius_km(body: object, otherwise: float) -> float:
    """Mean radius of a body by its half axes."""
    radii = getattr(getattr(body, "body", body), "radii_km", None)
    return otherwise if radii is None else float(np.cbrt(np.prod(np.broadcast_to(np.asarray(radii, dtype=float), 3))))


def _stars_in_frame(plan: Plan) -> int:
    """Stars in the frame that are in the sky and in the assumed catalog, bright enough."""
    world, told = plan.world, plan.told
    if world.sky is None or told.catalog is None:
        return 0
    limit = -2.5 * math.log10(_DIM_STAR_DN / 1e6)
    bright = told.catalog.magnitudes < limit
    places = world.view.project(rotate(world.attitude, told.catalog.directions[bright]))
    inside = (places > 0.0) & (places < [world.view.columns - 1, world.view.rows - 1])
    return int(inside.all(axis=1).sum())


def _whole(plan: Plan, diameter_px: float) -> bool:
    view, center = plan.world.view, plan.world.center_px
    assert plan.world.body is None or plan.told.shape is not None
    # The longest half axis of the bodies of the gauntlet is at most 1.3 times the mean radius.
    reach = 0.65 * diameter_px + MARGIN_PX
    size = np.array([view.columns - 1, view.rows - 1])
    return bool((center - reach >= 0.0).all() and (center + reach <= size).all())


def _lit_limb_px(plan: Plan, diameter_px: float) -> float:
    """Length of the half of the outline that faces the Sun, where it is in the frame, of a sphere."""
    world = plan.world
    angles = np.arange(_OUTLINE_POINTS) * (2.0 * math.pi / _OUTLINE_POINTS)
    outward = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = world.center_px + 0.5 * diameter_px * outward
    inside = ((points >= 0.0) & (points <= [world.view.columns - 1, world.view.rows - 1])).all(axis=1)
    lit = outward @ world.sun[:2] > 0.0
    return float((inside & lit).sum() * math.pi * diameter_px / _OUTLINE_POINTS)


def solvable(estimator: str, facts: Facts) -> bool:
    """Tell whether an answer can be demanded of an estimator."""
    if facts.hard:
        return False
    if estimator == STARS:
        return facts.stars >= LEAST_STARS
    seen = (
        not facts.absent
        and facts.snr >= LEAST_SNR
        and facts.phase_deg <= LARGEST_PHASE_DEG
        and facts.offset_px <= LARGEST_OFFSET_PX
        and facts.range_error <= LARGEST_RANGE_ERROR
    )
    diameter = min(facts.diameter_px, facts.told_diameter_px)
    point = facts.whole and max(facts.diameter_px, facts.told_diameter_px) <= POINT_PX
    disk = facts.whole and diameter >= TEMPLATE_PX
    limb = diameter >= LIMB_PX and facts.limb_px >= LEAST_LIMB_PX
    demanded = {
        "unresolved": point,
        "moment": disk,
        "cross_correlation": disk,
        "limb_matching": limb,
        "ellipsoid_cra": limb and facts.told_ellipsoid,
        "sigmoid_limb": limb and facts.told_ellipsoid,
        "ellipse_fit": facts.whole and diameter >= ELLIPSE_PX and facts.told_ellipsoid,
        "auto": point or disk or (limb and facts.whole),
    }
    return seen and demanded.get(estimator, False)


_NEVER = (Reason.INTERNAL_ERROR, Reason.UNREADABLE_IMAGE, Reason.NO_ATTITUDE, Reason.NO_EPOCH, Reason.NO_GEOMETRY)
"""Reasons that are true of no image of the gauntlet."""


def fits(reason: str, facts: Facts) -> bool:
    """Tell whether a reason of a failure can be true; all those that judge a fit can be, of any image."""
    near_edge = facts.absent or not facts.whole or facts.offset_px > LARGEST_OFFSET_PX
    true_of = {
        Reason.SATURATED: facts.saturated or facts.damaged,
        Reason.OUT_OF_FRAME: near_edge,
        Reason.NOT_LIT: facts.told_phase_deg > 90.0,
        Reason.NO_SIGNAL: not facts.undisturbed or near_edge or facts.snr < LEAST_SNR or facts.phase_deg > 90.0,
        Reason.NOT_UNRESOLVED: facts.told_diameter_px > 2.0,
        Reason.WRONG_SHAPE: not facts.told_ellipsoid,
        Reason.MIRRORED_IMAGE: facts.damaged,
        Reason.NO_CATALOG_STARS: facts.stars < LEAST_STARS,
    }
    return reason not in _NEVER and true_of.get(Reason(reason), True)
