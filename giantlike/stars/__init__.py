"""Attitude from stars: identification with and without an a priori attitude, and the weighted fit."""

from __future__ import annotations

from giantlike.stars.apriori import Identification, identify_apriori
from giantlike.stars.attitude import AttitudeMethod, AttitudeSolution, Scale, fit_attitude
from giantlike.stars.field import EPOCH_WHEN_UNKNOWN, Sky, StarField
from giantlike.stars.lost_in_space import identify_lost_in_space
from giantlike.stars.navigation import StarNavigation
from giantlike.stars.options import StarOptions, bright_enough
from giantlike.stars.refine import RefinedAttitude, refine_attitude
from giantlike.stars.transfer import TransferMethod, TransferOptions, carry_attitude

__all__ = [
    "EPOCH_WHEN_UNKNOWN",
    "AttitudeMethod",
    "AttitudeSolution",
    "Identification",
    "RefinedAttitude",
    "Scale",
    "Sky",
    "StarField",
    "StarNavigation",
    "StarOptions",
    "TransferMethod",
    "TransferOptions",
    "bright_enough",
    "carry_attitude",
    "fit_attitude",
    "identify_apriori",
    "identify_lost_in_space",
    "refine_attitude",
]
