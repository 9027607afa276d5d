"""Attitude from stars: identification with and without an a priori attitude, and the weighted fit."""

from giantlike.core.deprecation import forward_names
from giantlike.stars.navigation import StarNavigation
from giantlike.stars.options import StarOptions
from giantlike.stars.transfer import TransferOptions, carry_attitude

__all__ = ["StarNavigation", "StarOptions", "TransferOptions", "carry_attitude"]

__getattr__ = forward_names(
    __name__,
    {
        "giantlike.stars.apriori": "Identification identify_apriori",
        "giantlike.stars.attitude": "AttitudeMethod AttitudeSolution Scale fit_attitude",
        "giantlike.stars.field": "EPOCH_WHEN_UNKNOWN Sky StarField",
        "giantlike.stars.lost_in_space": "identify_lost_in_space",
        "giantlike.stars.options": "bright_enough",
        "giantlike.stars.refine": "RefinedAttitude refine_attitude",
        "giantlike.stars.transfer": "TransferMethod",
    },
    until="0.4",
)
