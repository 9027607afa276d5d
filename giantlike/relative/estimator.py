"""Interface and base of the estimators of a body."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Generic, Protocol, TypeVar, runtime_checkable

import cv2
import numpy as np

from giantlike._system.processes import one_thread
from giantlike.camera import Camera
from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.errors import BREAKDOWNS, breakdown_text
from giantlike.core.findings import Response
from giantlike.core.outcomes import CenterFix, Failure, PositionFix, Reason
from giantlike.image import Image
from giantlike.relative.budget import STRAIN_TENSION, place_difference, with_budget, with_error, with_larger_errors
from giantlike.relative.inputs import EstimatorInputs, gather
from giantlike.relative.judge import FALSE_ALARM
from giantlike.relative.response import BEND_STEP
from giantlike.relative.verification import verify
from giantlike.rings import Rings
from giantlike.scene import Scene, TargetGeometry

_LOG = logging.getLogger("giantlike.relative")

Options = TypeVar("Options")
Fix = TypeVar("Fix", bound=CenterFix, covariant=True)
AnyFix = TypeVar("AnyFix", bound=CenterFix)


@runtime_checkable
class Estimator(Protocol):
    """Estimator of the center or position of one body in one image; an object that holds options and nothing else."""

    name: ClassVar[str]
    """Name in campaign files and tables."""

    @property
    def options(self) -> Any:
        """The frozen options dataclass of the estimator."""
        ...

    def estimate(
        self, image: Image, camera: Camera, scene: Scene, target: str | None = None
    ) -> CenterFix | PositionFix | Failure:
        """Find a target of a scene in an image.

        Parameters
        ----------
        image : Image
        camera : Camera
        scene : Scene
        target : str, optional
            May be left out when the scene has only one.
        """
        ...


@dataclass(frozen=True, slots=True)
class Solved(Generic[Fix]):
    """A fix, and its first-order response to another geometry of the body.

    motion: returns the motion (k,) of the position with a geometry, in px and logarithm of the range; None where that
        is too far from the geometry of the fix. Without it, the estimator is run again.
    """

    fix: Fix
    motion: Callable[[TargetGeometry], Float | None] | None = None


class BodyEstimator(ABC, Generic[Options, Fix]):
    """Base of the estimators: gathers the inputs and names image, target and estimator in every failure.

    A subclass has a ``name``, an ``options_type`` and a method ``_estimate``.

    Parameters
    ----------
    options : object, optional; the frozen options dataclass of the estimator; its defaults if left out
    false_alarm : float; rate of false alarms of each test of a fix
    """

    name: ClassVar[str]
    options_type: ClassVar[type[Any]]
    of_fixes: ClassVar[bool] = False  # true for an estimator of fixes of others, which have been checked already
    by_light: ClassVar[bool] = False
    """True for an estimator of the center of all light, which moves with any error of the shape."""
    by_outline: ClassVar[bool] = False
    """True for an estimator of the lit outline alone, which does not move with the Sun."""
    finds_response: ClassVar[bool] = False  # true for an estimator that detects a nonlinear response by itself

    def __init__(self, options: Options | None = None, *, false_alarm: float = FALSE_ALARM) -> None:
        self._options: Options = options or self.options_type()
        self._false_alarm = false_alarm

    @property
    def options(self) -> Options:
        """Options of the estimator."""
        return self._options

    @one_thread()
    def estimate(self, image: Image, camera: Camera, scene: Scene, target: str | None = None) -> Fix | Failure:
        """Find a target of a scene in an image.

        Parameters
        ----------
        image : Image
        camera : Camera
            Without a psf, one of :data:`~giantlike.core.detector.UNKNOWN_PSF_SIGMA_PX` is assumed or its width
            estimated.
        scene : Scene
        target : str, optional
            May be left out when the scene has only one.

        Returns
        -------
        CenterFix, PositionFix or Failure
            The fix of the estimator, with the parts of its covariance by cause and the flags of the checks that are
            made of every fix (:mod:`giantlike.relative.verification`). Failures are those of its class, and those of
            an image without attitude, epoch, signal or good pixels, of a target without geometry, behind the camera
            or around it. A computation that breaks down is a failure with the reason ``internal_error``.

        Raises
        ------
        InputError
            The image has another size than the camera, or the scene has no such target.
        DataError
            A file of the options is missing or damaged, or SPICE kernels do not cover the epoch.
        """
        inputs = gather(image, camera, scene, target, estimator=self.name, options=self.options)
        if isinstance(inputs, Failure):
            return inputs
        try:
            return self._estimate_and_verify(inputs)
        except (*BREAKDOWNS, cv2.error) as error:
            _LOG.debug("%s: %s broke down", inputs.image.name, self.name, exc_info=True)
            return inputs.fail(Reason.INTERNAL_ERROR, f"the computation broke down: {breakdown_text(error)}")

    def _estimate_and_verify(self, inputs: EstimatorInputs) -> Fix | Failure:
        """Find the body, with the error budget of its position and the checks of a fix."""
        result = self._estimate_with_budget(inputs)
        if isinstance(result, Failure):
            return inputs.fail(result.reason, result.detail, not_applicable=result.not_applicable)
        if self.of_fixes:
            return result
        response = result.corrections.response
        seen = inputs if response is None else inputs.linearize(response)
        again = None if self.finds_response else self._estimate_with_budget
        search_px, scan = getattr(self.options, "search_px", 0.0), getattr(self.options, "scan", None)
        rings_km, geometry = getattr(scan, "rings_km", None), seen.geometry
        if rings_km is not None and geometry.target.rings is None:
            ringed = replace(geometry.target, rings=Rings(*rings_km))
            seen = replace(seen, geometry=replace(geometry, target=ringed))
        alarm = self._false_alarm
        return verify(result, seen, search_px, by_light=self.by_light, again=again, false_alarm=alarm)

    def _estimate_with_budget(self, inputs: EstimatorInputs) -> Fix | Failure:
        """Find the body, with the error budget of its position."""
        solved = self._solve(inputs)
        if isinstance(solved, Failure):
            return solved
        result, response = solved.fix, solved.motion
        again = replace(inputs, place_alone=True, corrections=result.corrections)

        def motion(moved: TargetGeometry) -> Float | Failure:
            known = None if response is None else response(moved)
            if known is not None:
                return known
            other = self._estimate(replace(again, geometry=moved))
            if isinstance(other, Failure):
                return other
            if isinstance(result, PositionFix) and not isinstance(other, PositionFix):
                return Failure(Reason.NOT_CONVERGED, "the range was not estimated")
            return place_difference(other, result)

        budgeted = with_budget(result, inputs.image, inputs.camera, inputs.geometry, motion, by_outline=self.by_outline)
        if self.of_fixes or isinstance(budgeted, Failure):
            return budgeted
        strain, model = budgeted.findings.checks.get(STRAIN_TENSION, 1.0), inputs.camera.model
        budgeted = with_larger_errors(budgeted, model, strain, (Cause.NOISE, Cause.RELIEF))
        return with_response(budgeted, again, self._estimate)

    def _solve(self, inputs: EstimatorInputs) -> Solved[Fix] | Failure:
        """Find the body of gathered inputs, with the response of its position if it has a closed form."""
        fix = self._estimate(inputs)
        return fix if isinstance(fix, Failure) else Solved(fix)

    @abstractmethod
    def _estimate(self, inputs: EstimatorInputs) -> Fix | Failure:
        """Find the body of gathered inputs."""


def with_response(
    fix: AnyFix, inputs: EstimatorInputs, estimate: Callable[[EstimatorInputs], CenterFix | Failure]
) -> AnyFix:
    """Return a fix with the error of an unknown response, as a part of ``reflectance``."""
    if inputs.bend_sigma == 0.0:
        return fix
    bent = Response(bend=BEND_STEP, dark_dn=0.0, bright_dn=float(inputs.pixels_dn[inputs.usable].max()))
    moved = estimate(replace(inputs, pixels_dn=bent.light_dn(inputs.pixels_dn)))
    if isinstance(moved, Failure):
        return fix
    by_bend = inputs.bend_sigma / BEND_STEP * place_difference(moved, fix)
    return with_error(fix, inputs.camera.model, Cause.REFLECTANCE, np.outer(by_bend, by_bend))
