"""Kinds of images: the disturbance of each, drawn from random numbers, and whether an answer is still required.

A kind turns an undisturbed plan into a disturbed one, and sets ``hard`` where the drawn disturbance justifies a
refusal. Limits common to all kinds are in :mod:`giantlike.gauntlet.rule`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType

import numpy as np

from giantlike.gauntlet import damage, mistakes, scenery
from giantlike.gauntlet.plan import Base, Plan

Disturb = Callable[[Plan, np.random.Generator], Plan]


@dataclass(frozen=True)
class Kind:
    """A kind of image."""

    name: str
    summary: str  # the disturbance, in a line
    disturb: Disturb  # (plan, random numbers) to plan
    base: Base = field(default_factory=Base)  # limits of the undisturbed image of a body
    body: bool = True  # body, stars: True if there is a body for the estimators, or stars for the star chain
    stars: bool = False
    weight: int = 2  # number of occurrences in a deck of all kinds
    undisturbed: bool = False  # True for an image without a disturbance: its sigmas are the nominal ones


def _as_it_is(plan: Plan, rng: np.random.Generator) -> Plan:
    return plan


# Limits common to several kinds: large enough for features drawn on the disk; with point sources; of one shape.
_WIDE = Base(diameter_px=(60.0, 220.0))
_WITH_POINTS = Base(points=0.15)
_ROCK = Base(rocks=1.0, diameter_px=(40.0, 130.0))
_CRISP = Base(rocks=0.0, diameter_px=(40.0, 140.0))
_STATED = Base(declared=1.0)

_BODY_KINDS = (
    Kind("nominal", "nothing is wrong", _as_it_is, weight=12, undisturbed=True),
    Kind("point", "nothing is wrong; the body is 1 to 3 px wide", _as_it_is, base=Base(points=1.0), undisturbed=True),
    Kind(
        "large_rock",
        "nothing is wrong; a rock large enough for landmarks",
        _as_it_is,
        base=Base(rocks=1.0, diameter_px=(200.0, 240.0), phase_deg=(20.0, 80.0)),
        weight=1,
        undisturbed=True,
    ),
    Kind(
        "large_rock_turned",
        "declared rotation of a large rock 3 to 30 degrees off",
        mistakes.slight_rotation,
        base=Base(rocks=1.0, diameter_px=(200.0, 240.0), phase_deg=(20.0, 80.0)),
        weight=1,
    ),
    Kind(
        "crescent",
        "phase angles of 125 to 179 degrees",
        scenery.thin_crescent,
        base=Base(diameter_px=(40.0, 160.0), rocks=0.2),
        undisturbed=True,
    ),
    Kind(
        "fills_frame",
        "the body is 1 to 2.5 times as wide as the frame, its limb in view or not",
        scenery.filling,
        base=Base(diameter_px=(260.0, 640.0), rocks=0.0, phase_deg=(5.0, 90.0), largest_frame_px=256),
        undisturbed=True,
    ),
    Kind("partly_outside", "the frame cuts the body", scenery.partly_outside, base=_WIDE, undisturbed=True),
    Kind("outside", "the body is outside the frame, predicted so or not", scenery.outside),
    Kind("wrong_target", "another body where the target should be", scenery.wrong_target),
    Kind("two_bodies", "an undeclared second body", scenery.two_bodies),
    Kind(
        "twin",
        "the same body a second time, beside the target",
        scenery.twin,
        base=Base(points=0.15, declared=1.0, diameter_px=(20.0, 120.0)),
    ),
    Kind("moon_in_front", "an undeclared moon in front of the target", scenery.moon, base=_WIDE),
    Kind("rings", "undeclared rings", scenery.add_rings, base=Base(rocks=0.0, diameter_px=(40.0, 180.0))),
    Kind(
        "eclipse",
        "the shadow of another body on part of the disk",
        scenery.eclipse,
        base=Base(rocks=0.1, diameter_px=(60.0, 220.0), phase_deg=(5.0, 90.0)),
    ),
    Kind("comet", "a coma around the nucleus", scenery.comet, base=_WITH_POINTS),
    Kind("markings", "albedo that the shape does not hold", scenery.add_markings, base=_CRISP),
    Kind("dense_stars", "a dense field of stars", scenery.dense_stars, base=_WITH_POINTS),
    Kind("noise", "nothing but noise", scenery.noise, base=_WITH_POINTS),
    Kind("wrong_time", "geometry of another time", mistakes.wrong_time, base=_STATED),
    Kind("attitude", "attitude 0.1 to 3 degrees off", mistakes.wrong_attitude, base=_STATED),
    Kind("roll", "attitude rolled by 3 to 8 degrees", mistakes.wrong_roll, base=_STATED),
    Kind("scale_5", "declared size 5 % off", partial(mistakes.wrong_scale, share=0.05), base=_STATED),
    Kind("scale_20", "declared size 20 % off", partial(mistakes.wrong_scale, share=0.2), base=_STATED),
    Kind("focal", "declared focal length 2 % off", mistakes.focal, base=_STATED),
    Kind("pole", "declared pole 10 to 180 degrees off", mistakes.pole, base=Base(rocks=0.5)),
    Kind("rotation", "declared rotation 20 to 180 degrees off", mistakes.rotation, base=_ROCK),
    Kind("stale_shape", "a shape model with coarse errors", mistakes.stale_shape, base=_ROCK),
    Kind("foreign_shape", "the shape of another body", mistakes.foreign_shape, base=_ROCK),
    Kind("sphere_for_rock", "a sphere declared for a rock", mistakes.sphere_for_rock, base=_ROCK),
    Kind("wrong_axes", "declared semi-axes 5 to 20 % off", mistakes.wrong_axes, base=_CRISP),
    Kind("wrong_sun", "declared Sun 20 to 180 degrees off", mistakes.wrong_sun),
    Kind("wrong_psf", "declared optics 0.4 to 2 times as wide", mistakes.wrong_psf),
    Kind("wrong_law", "another reflectance law", mistakes.wrong_law),
)

_BODY_OR_STARS: tuple[tuple[str, str, Disturb, Base], ...] = (
    ("stray_light", "slopes and glows of light from outside", damage.stray_light, _WITH_POINTS),
    ("glare", "a bright glow close by", damage.glare, _WITH_POINTS),
    ("ghost", "a faint second image of everything", damage.ghost, _WITH_POINTS),
    ("double_exposure", "two exposures on one frame", damage.double_exposure, _WITH_POINTS),
    ("radiation", "a radiation storm", damage.radiation, _WITH_POINTS),
    ("hot_columns", "hot columns", damage.hot_columns, _WITH_POINTS),
    ("dead_rows", "dead rows and columns", damage.dead_rows, _WITH_POINTS),
    ("saturation", "saturated, declared or not", partial(damage.saturate, least_share=0.2, blooms=False), Base()),
    (
        "blooming",
        "saturated, and charge flows along columns",
        partial(damage.saturate, least_share=0.3, blooms=True),
        Base(),
    ),
    ("smear", "light from the transfer of the frame", damage.smear, _WITH_POINTS),
    ("motion", "motion during the exposure", damage.motion, _WITH_POINTS),
    ("defocus", "out of focus", damage.defocus, _WITH_POINTS),
    ("missing_lines", "lines missing", damage.missing_lines, Base()),
    ("missing_blocks", "blocks missing", damage.missing_blocks, Base()),
    ("bit_flips", "bits turned over", damage.bit_flips, _WITH_POINTS),
    ("trails", "trails of satellites", damage.satellites, _WITH_POINTS),
    ("mirrored", "columns in the wrong order", damage.reverse_columns, _STATED),
    ("inverted", "rows in the wrong order", damage.reverse_rows, _STATED),
    ("rows_shifted", "rows shifted against each other", damage.rows_shifted, Base()),
    ("eight_bit", "requantized to 8 bits", partial(damage.eight_bit, square_root=False), _WITH_POINTS),
    ("eight_bit_root", "8 bits by a table of square roots", partial(damage.eight_bit, square_root=True), _WITH_POINTS),
)
"""Kinds that spoil any image: each comes with a body, and with stars under the name ``stars_...``."""


def _of_stars(name: str, summary: str, disturb: Disturb) -> Kind:
    """Kind of images of stars alone, once in each deck."""
    return Kind(f"stars_{name}", summary, disturb, body=False, stars=True, weight=1)


_STAR_KINDS = (
    Kind("stars_nominal", "nothing is wrong", _as_it_is, body=False, stars=True, weight=3, undisturbed=True),
    _of_stars("dense", "stars far beyond the catalog", scenery.add_faint_stars),
    _of_stars("gaps", "stars missing in the catalog", mistakes.gaps),
    _of_stars("foreign", "catalog of another sky", mistakes.other_sky),
    _of_stars("observer", "velocity of the observer unknown or in m/s", mistakes.observer),
    _of_stars("attitude", "attitude 0.1 to 3 degrees off", mistakes.wrong_attitude),
    _of_stars("roll", "attitude rolled", mistakes.wrong_roll),
    _of_stars("focal", "focal length 2 % off", mistakes.focal),
    _of_stars("noise", "nothing but noise", scenery.noise),
    Kind(
        "stars_and_body",
        "a body among stars: attitude by the stars, body by the estimators",
        scenery.with_sky,
        base=Base(rocks=0.0, diameter_px=(40.0, 140.0)),
        stars=True,
        undisturbed=True,
    ),
)


def _all_kinds() -> dict[str, Kind]:
    spoiled = [Kind(name, summary, disturb, base=base) for name, summary, disturb, base in _BODY_OR_STARS]
    stars = [_of_stars(name, summary, disturb) for name, summary, disturb, _ in _BODY_OR_STARS]
    return {kind.name: kind for kind in (*_BODY_KINDS, *spoiled, *_STAR_KINDS, *stars)}


KINDS: Mapping[str, Kind] = MappingProxyType(_all_kinds())  # kinds by name
