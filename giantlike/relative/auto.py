"""Auto: chooses an estimator by apparent size, shape and limb in view, and checks it by an independent one."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar

import numpy as np

from giantlike._system.threads import at_once
from giantlike.atmosphere import Atmosphere
from giantlike.camera_models import CameraModel
from giantlike.core.arrays import require
from giantlike.core.findings import Corrections
from giantlike.core.outcomes import CenterFix, Failure, PositionFix, Quality, Reason
from giantlike.ray_tracing import trace_silhouette
from giantlike.relative.consensus import agreement_of, confirm, find_confirming, fuse
from giantlike.relative.estimator import BodyEstimator, Estimator
from giantlike.relative.horizon.ellipsoid_cra import EllipsoidCRA, EllipsoidCRAOptions
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.landmarks.surface_features import SurfaceFeatures, SurfaceFeaturesOptions
from giantlike.relative.light.moment import Moment, MomentOptions
from giantlike.relative.light.unresolved import Unresolved, UnresolvedOptions
from giantlike.relative.limb.limb_matching import LimbMatching, LimbMatchingOptions
from giantlike.relative.place import limb_in_frame
from giantlike.relative.template.cross_correlation import CrossCorrelation, CrossCorrelationOptions
from giantlike.scene import Scene
from giantlike.shapes import Ellipsoid

_LOG = logging.getLogger("giantlike.relative")

_OUTLINE_RAD = np.arange(360) * (2.0 * np.pi / 360)  # rad, directions in which the limb in view is measured
_LIGHT, _LIMB, _LANDMARKS = "light", "limb", "landmarks"
_CHOICES: Mapping[str, tuple[Callable[..., Estimator], str]] = {
    Unresolved.name: (Unresolved, _LIGHT),
    Moment.name: (Moment, _LIGHT),
    CrossCorrelation.name: (CrossCorrelation, _LIGHT),
    LimbMatching.name: (LimbMatching, _LIMB),
    EllipsoidCRA.name: (EllipsoidCRA, _LIMB),
    SurfaceFeatures.name: (SurfaceFeatures, _LANDMARKS),
}
"""Estimators to choose from by name, and the part of the image that each uses."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AutoOptions:
    """Limits of the choice of :class:`Auto`, and the options of each estimator.

    Parameters
    ----------
    unresolved_px : float, px; largest diameter of a body that is treated as a point source by ``unresolved``
    limb_px : float, px; minimum diameter of a body whose limb is used
    min_limb_px : float, px; minimum length of lit limb within the frame that is used
    false_alarm : float; rate of false alarms of each test of a fix
    unresolved : UnresolvedOptions
    moment : MomentOptions
    cross_correlation : CrossCorrelationOptions
    limb_matching : LimbMatchingOptions
    ellipsoid_cra : EllipsoidCRAOptions
    surface_features : SurfaceFeaturesOptions

    Raises
    ------
    InputError
        A value is out of its range.
    """

    unresolved_px: float = 4.0
    limb_px: float = 40.0
    min_limb_px: float = 60.0
    false_alarm: float = 1e-3
    unresolved: UnresolvedOptions = field(default_factory=UnresolvedOptions)
    moment: MomentOptions = field(default_factory=MomentOptions)
    cross_correlation: CrossCorrelationOptions = field(default_factory=CrossCorrelationOptions)
    limb_matching: LimbMatchingOptions = field(default_factory=LimbMatchingOptions)
    ellipsoid_cra: EllipsoidCRAOptions = field(default_factory=EllipsoidCRAOptions)
    surface_features: SurfaceFeaturesOptions = field(default_factory=SurfaceFeaturesOptions)

    def __post_init__(self) -> None:
        require(
            0 < self.unresolved_px <= self.limb_px < math.inf,
            f"unresolved_px and limb_px must be > 0, in this order, got {self.unresolved_px} and {self.limb_px}",
        )
        require(self.min_limb_px > 0, f"min_limb_px must be > 0, got {self.min_limb_px}")
        require(0 < self.false_alarm < 0.1, f"false_alarm must be in (0, 0.1), got {self.false_alarm}")


@dataclass(frozen=True, slots=True)
class Choice:
    """Estimators for a body."""

    estimators: tuple[str, ...]  # names of the estimators to try, in order
    checks: tuple[str, ...]  # names of the estimators to check with, in order
    because: str  # reason of the choice, for the provenance

    def checks_of(self, taken: str) -> list[str]:
        """Names of the estimators that check the chosen one, in order.

        Those that use another part of the image come first, then other uses of the same light.
        """
        order = sorted(self.checks, key=lambda name: _CHOICES[name][1] == _CHOICES[taken][1])
        return [name for name in order if name != taken]

    def checks_by_other_part(self, taken: str, second: str) -> list[str]:
        """Names of the estimators that check the second of two fixes by another part of the image, in order."""
        names = dict.fromkeys((*self.checks, *self.estimators))
        return [name for name in names if name != taken and _CHOICES[name][1] != _CHOICES[second][1]]

    @property
    def sure(self) -> list[str]:
        """Names of the first estimator and of its first check; both are run, unless none finds the body."""
        return [name for first in self.estimators[:1] for name in (first, *self.checks_of(first)[:1])]


def choose(
    *, diameter_px: float, is_ellipsoid: bool, in_frame: float, limb_px: float, options: AutoOptions = AutoOptions()
) -> Choice:
    """Choose estimators by the appearance of a body.

    >>> choose(diameter_px=2.0, is_ellipsoid=False, in_frame=1.0, limb_px=3.0).estimators[0]
    'unresolved'
    >>> choose(diameter_px=3000.0, is_ellipsoid=False, in_frame=0.0, limb_px=0.0).estimators[0]
    'surface_features'
    """
    size = f"{diameter_px:.3g} px wide"
    light, template, limb = Moment.name, CrossCorrelation.name, LimbMatching.name
    if diameter_px <= options.unresolved_px:
        because = f"{size}, up to {options.unresolved_px:g} px: a point of light"
        return Choice((Unresolved.name, template), (light,), because)
    if diameter_px < options.limb_px:
        because = f"{size}, below {options.limb_px:g} px: too small for its limb"
        return Choice((template, light), (light,), because)
    if limb_px < options.min_limb_px:
        because = f"{size}, {limb_px:.3g} px of lit limb in the frame, below {options.min_limb_px:g}: no limb to use"
        return (
            Choice((), (), because) if is_ellipsoid else Choice((SurfaceFeatures.name, template), (template,), because)
        )
    seen = f"{size}, {in_frame:.0%} of the lit limb in the frame"
    if is_ellipsoid:
        because = f"{seen}, an ellipsoid: its horizon, whatever its face looks like"
        return Choice((EllipsoidCRA.name, limb, template), (template, light, EllipsoidCRA.name), because)
    if in_frame < 1.0:
        because = f"{seen}, cut by it: its limb"
        return Choice((limb, template, SurfaceFeatures.name), (template, limb), because)
    because = f"{seen}, of irregular shape: all of its light"
    return Choice((template, limb, light), (limb, light, template), because)


class Auto(BodyEstimator[AutoOptions, CenterFix]):
    """Chooses an estimator by apparent size, shape and limb in view, and checks it by an independent one.

    The estimators of the choice are tried in order; the first fix that is not suspect is taken, else the first fix
    (``moment`` does not replace a suspect fix: the center of light cannot see what another model explains better). The
    first of other fixes that is not suspect and precise enough confirms it: estimators of another part of the image
    (the limb instead of the light) come before others of the same light. Where the two differ by more than their
    covariances explain, these grow. An unconfirmed fix is flagged ``UNCHECKED``. Where the confirming fix is so
    precise that it has more than half of the weight, a third one of another part of the image than its own confirms it;
    without one, the first fix is kept.

    The result is the fix of the chosen estimator, a :class:`~giantlike.core.outcomes.PositionFix` if it estimates the
    range, under the name ``auto``, fused with the confirming fix (:func:`~giantlike.relative.consensus.fuse`). Its
    ``findings`` are the estimator (``chosen``), the reason (``because``), the confirming estimators (``checked_by``),
    the p-value of the difference (``agreement``) and the weight of the chosen estimator in the position (``weight``).
    ``score``, residuals and counts are from the chosen estimator. A failure is that of the first choice; its text names
    the others that were tried. Where ``cross_correlation`` detects a nonlinear response, the others are run on a
    linearized image; where it or a limb detects haze, the others are run with the uncertain limb altitude that it
    implies.

    Within :func:`giantlike.threads` the first choice and its first check run at once.

    Parameters
    ----------
    options : AutoOptions
    """

    name: ClassVar[str] = "auto"
    options_type = AutoOptions
    of_fixes: ClassVar[bool] = True

    def _estimate(self, inputs: EstimatorInputs) -> CenterFix | Failure:
        """Choose, estimate and check."""
        choice = self._choice(inputs)
        _LOG.debug("%s: %s: %s, because %s", inputs.image.name, self.name, ", ".join(choice.estimators), choice.because)
        outcomes = dict[str, CenterFix | Failure]()
        fix = self._consensus(inputs, choice, outcomes)
        template = outcomes.get(CrossCorrelation.name)
        if not isinstance(template, CenterFix):
            return fix
        # Only the template detects a nonlinear response; limbs detect undeclared haze too.
        response, haze_km = template.corrections.response, None
        if inputs.geometry.target.atmosphere is None and inputs.geometry.target.terrain is None:
            fixes = [template, *(one for one in outcomes.values() if isinstance(one, CenterFix))]
            sigmas_km = (one.corrections.altitude_sigma_km for one in fixes)
            haze_km = next((sigma_km for sigma_km in sigmas_km if sigma_km is not None), None)
        if response is None and haze_km is None:
            return fix
        known = inputs
        if response is not None:
            known = replace(known, image=inputs.straight_image(response))
        if haze_km is not None:
            known = replace(known, scene=_in_haze(inputs.scene, inputs.target_name, haze_km))
        knows = haze_km is None or template.corrections.altitude_sigma_km is not None
        fix = self._consensus(known, choice, {CrossCorrelation.name: template} if knows else {})
        found = Corrections(response=response, altitude_sigma_km=haze_km)
        return fix if isinstance(fix, Failure) else replace(fix, corrections=fix.corrections | found)

    def _consensus(
        self, inputs: EstimatorInputs, choice: Choice, outcomes: dict[str, CenterFix | Failure]
    ) -> CenterFix | Failure:
        """Take the first fix without objection, and check it; ``outcomes`` caches the results of estimators."""

        def estimate(name: str) -> CenterFix | Failure:
            return self._estimator(name).estimate(inputs.image, inputs.camera, inputs.scene, inputs.target_name)

        sure = [name for name in choice.sure if name not in outcomes]
        with at_once({name: partial(estimate, name) for name in sure}) as begun:

            def outcome(name: str) -> CenterFix | Failure:
                if name not in outcomes:
                    outcomes[name] = begun(name) if name in sure else estimate(name)
                return outcomes[name]

            taken = _choose_fix(choice, outcome)
            if taken is None:
                return _join_failures(choice, outcomes)
            fix = outcome(taken)
            assert isinstance(fix, CenterFix)
            fix = replace(
                fix, estimator=self.name, findings=replace(fix.findings, chosen=taken, because=choice.because)
            )

            def check(fix: CenterFix, names: Sequence[str]) -> tuple[str, CenterFix] | None:
                seconds = ((name, outcome(name)) for name in names)
                return None if fix.flags.suspect else find_confirming(fix, seconds)

            confirmed = check(fix, choice.checks_of(taken))
            if confirmed is None:
                return replace(fix, flags=fix.flags | Quality.UNCHECKED)
            name, second = confirmed
            fused = _fuse_confirmed(fix, name, second, inputs.camera.model)
            if _second_decides(fused):
                third = check(fused, choice.checks_by_other_part(taken, name))
                if third is not None:
                    fused = _fuse_confirmed(fused, *third, inputs.camera.model)
                else:
                    kept = replace(fused.findings, weight=None)
                    fused = replace(confirm(fix, second, inputs.camera.model), findings=kept)
        return _with_turn(fused, second)

    def _choice(self, inputs: EstimatorInputs) -> Choice:
        diameter_px = 2.0 * inputs.radius_px
        in_frame, limb_px = 1.0, 0.0
        if diameter_px >= self.options.limb_px:
            plane = inputs.focal_plane()
            sun = inputs.geometry.sun_direction_camera
            outline = trace_silhouette(inputs.geometry.body(), plane.model, _OUTLINE_RAD, sun_direction_camera=sun)
            in_frame, limb_px = limb_in_frame(outline, plane)
        return choose(
            diameter_px=diameter_px,
            is_ellipsoid=isinstance(inputs.geometry.target.shape, Ellipsoid),
            in_frame=in_frame,
            limb_px=limb_px,
            options=self.options,
        )

    def _estimator(self, name: str) -> Estimator:
        """Return an estimator with its options, which have its name."""
        return _CHOICES[name][0](getattr(self.options, name), false_alarm=self.options.false_alarm)


def _in_haze(scene: Scene, name: str, sigma_km: float) -> Scene:
    """Scene with an uncertain limb altitude of a target."""
    haze = Atmosphere.at(0.0, sigma_km=sigma_km)
    return replace(
        scene, targets=tuple(replace(one, atmosphere=haze) if one.name == name else one for one in scene.targets)
    )


def _fuse_confirmed(fix: CenterFix, name: str, second: CenterFix, model: CameraModel) -> CenterFix:
    """Fuse a fix with another one that confirms it."""
    known = fix.findings
    names, agreement = filter(None, (known.checked_by, name)), agreement_of(fix, second)
    findings = replace(known, checked_by=", ".join(names), agreement=agreement, weight=None)
    fused = fuse(replace(fix, findings=findings), second, model)
    weights = [one for one in (known.weight, fused.findings.weight) if one is not None]
    return replace(fused, findings=replace(fused.findings, weight=math.prod(weights) if weights else None))


def _second_decides(fused: CenterFix) -> bool:
    """Return True if a fused fix is mostly its second one, which the first is too weak to check."""
    return fused.findings.weight is not None and fused.findings.weight < 0.5


def _with_turn(fix: CenterFix, second: CenterFix) -> CenterFix:
    """Fix with the turn that its second one measured, where it has none itself."""
    if isinstance(fix, PositionFix) and isinstance(second, PositionFix) and fix.turn is None:
        return replace(fix, turn=second.turn)
    return fix


def _choose_fix(choice: Choice, outcome: Callable[[str], CenterFix | Failure]) -> str | None:
    """Name of the first fix without objection, else of the first fix.

    An objection of an estimator that knows the shape stands against the light alone, which could not raise it.
    """
    suspect = None
    for name in choice.estimators:
        if suspect is not None and name == Moment.name:
            continue
        fix = outcome(name)
        if isinstance(fix, Failure):
            continue
        if not fix.flags.suspect:
            return name
        suspect = suspect or name
    return suspect


def _join_failures(choice: Choice, outcomes: Mapping[str, CenterFix | Failure]) -> Failure:
    """Return the failure of the first estimator tried, which names the others."""
    failures = [(name, one) for name, one in outcomes.items() if isinstance(one, Failure)]
    if not failures:
        return Failure(Reason.NO_LIMB, f"{choice.because}, and an ellipsoid has no landmarks")
    first, *others = failures
    also = "".join(f"; {name}: {one.reason}" for name, one in others)
    return Failure(first[1].reason, f"{choice.because}; {first[1].detail}{also}")
