"""Fixes recomputed with linearized values where the coarse render shows a nonlinear response."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np

from giantlike.core.causes import Cause
from giantlike.core.findings import Response
from giantlike.core.outcomes import CenterFix, Failure
from giantlike.image_model.columns import UNDECLARED
from giantlike.relative.budget import place_difference, with_error
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.response import LEAST_BEND, find_response
from giantlike.relative.verification.coarse_fit import CoarseFit


class Looked(Protocol):
    """Result of a coarse render of a fix."""

    @property
    def fit(self) -> CoarseFit | None:
        """The render fitted to the image; None where too few cells hold the disk of the body."""


AnyFix = TypeVar("AnyFix", bound=CenterFix)
Coarse = TypeVar("Coarse", bound=Looked)


def looks_bent(coarse: Looked | None) -> bool:
    """Return True where a coarse render favors a nonlinear response."""
    fit = None if coarse is None else coarse.fit
    return fit is not None and fit.response.bend > LEAST_BEND and fit.bend_log_odds > 0.0


def in_proportion(
    fix: AnyFix,
    coarse: Coarse,
    inputs: EstimatorInputs,
    again: Callable[[EstimatorInputs], AnyFix | Failure],
    look: Callable[[AnyFix, EstimatorInputs], Coarse | None],
) -> tuple[AnyFix, Coarse, EstimatorInputs] | None:
    """Recompute a fix with linearized values until the response converges.

    Returns None where linearized values fit little better: the cause is another one.
    """

    def try_response(response: Response) -> tuple[AnyFix, Coarse, EstimatorInputs] | None:
        straight = inputs.linearize(response)
        found = again(straight)
        seen = None if isinstance(found, Failure) else look(found, straight)
        return None if isinstance(found, Failure) or seen is None or seen.fit is None else (found, seen, straight)

    def fit_of(trial: tuple[AnyFix, Coarse, EstimatorInputs]) -> CoarseFit:
        assert trial[1].fit is not None
        return trial[1].fit

    before = coarse.fit

    def estimate_response(trial: tuple[AnyFix, Coarse, EstimatorInputs]) -> tuple[Response, float]:
        return fit_of(trial).response, fit_of(trial).bend_sigma

    trial = None if before is None else find_response(before.response, try_response, estimate_response)
    if before is None or trial is None:
        return None
    if fit_of(trial).log_evidence < before.log_evidence + math.log(1.0 / UNDECLARED - 1.0):
        return None
    found, seen, straight = trial
    per_bend = place_difference(found, fix) / fit_of(trial).response.bend
    by_bend = fit_of(trial).bend_sigma * per_bend
    error = np.outer(by_bend, by_bend)
    return with_error(found, inputs.camera.model, Cause.REFLECTANCE, error), seen, straight
