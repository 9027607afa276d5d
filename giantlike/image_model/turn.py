"""Another orientation as an effect: an undeclared rotation of the body about the camera axes."""

from __future__ import annotations

import math

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.findings import Turn
from giantlike.image_model.columns import Block, Prior, Use

TURN_SIGMA_RAD = math.radians(2.0)  # least a priori standard deviation about each camera axis: a guess


def turn_block(matrix: Float, turn: Turn | None, sigma_rad: float) -> Block:
    """Return the further rotation of a body that is rendered with one; ``matrix`` (3, h, w), data per rad."""
    mean = np.zeros(3) if turn is None else -turn.rotation.as_rotvec()
    prior = Prior.of_sigmas(3 * [sigma_rad], mean)
    return Block(effect="turn", cause=Cause.SPIN, matrix=matrix, prior=prior, use=Use.WHEN_SEEN)
