"""Undeclared effects: their probabilities from the residuals of a template, and their effect on the position."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.values import Value
from giantlike.image_model.columns import UNDECLARED, Block, Score, Solution

PART_RADII = 0.25
"""Side of a part of a body, radii, with independent model errors: the shortest correlation length of markings."""
_WIDTH = math.sqrt(8.0 * math.log(2.0))  # full width of an edge at half maximum over the standard deviation of its blur


@dataclass(frozen=True, slots=True, eq=False)
class Undeclared(Value):
    """An effect that a model leaves out."""

    block: Block
    chance: float  # probability of the effect, against the model without and against all other effects left out
    score: Score

    @property
    def covariance(self) -> Float:
        """Covariance (k, k) of the unknowns of the model by the omission of the effect."""
        return self.score.omission_covariance(self.chance)


def undeclared_effects(fit: Solution, blocks: Mapping[Block, float]) -> dict[str, Undeclared]:
    """Return the probabilities of mutually exclusive effects."""
    columns = fit.columns
    log_odds = [
        np.log(UNDECLARED / (1.0 - UNDECLARED)) + columns.odds_of([block], parts) for block, parts in blocks.items()
    ]
    chances = np.exp(np.array(log_odds) - np.logaddexp.reduce([0.0, *log_odds]))
    return {
        block.effect: Undeclared(block, float(chance), fit.score_omitted(block))
        for block, chance in zip(blocks, chances, strict=True)
    }


@dataclass(frozen=True, slots=True)
class IndependentParts:
    """Number of independent values in pixels."""

    of_surface: float  # where errors of the model are alike over a part of the surface
    of_edges: float  # where they are alike along a part of an edge, but not beside it

    @classmethod
    def from_size(cls, n_used: int, radius_px: float, blur_px: float) -> IndependentParts:
        """Return them for a number of pixels, a body of a radius and a blur of a standard deviation."""
        side_px = max(PART_RADII * radius_px, 1.0) if np.isfinite(radius_px) else 1.0
        return cls(n_used / side_px**2, n_used / (side_px * min(max(_WIDTH * blur_px, 1.0), side_px)))
