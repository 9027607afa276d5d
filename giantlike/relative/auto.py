"""The estimator that chooses: by apparent size, shape and limb in view, checked by an independent second one."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from giantlike.camera import Camera
from giantlike.core.arrays import Float, require
from giantlike.core.outcomes import CenterFix, Failure, PositionFix, Quality, Reason
from giantlike.image import Image
from giantlike.ray_tracing import trace_silhouette
from giantlike.relative.estimator import Estimator, EstimatorInputs, gather
from giantlike.relative.horizon.ellipsoid_cra import EllipsoidCRA, EllipsoidCRAOptions
from giantlike.relative.landmarks.surface_features import SurfaceFeatures, SurfaceFeaturesOptions
from giantlike.relative.light.moment import Moment, MomentOptions
from giantlike.relative.light.unresolved import Unresolved, UnresolvedOptions
from giantlike.relative.limb.limb_matching import LimbMatching, LimbMatchingOptions
from giantlike.relative.template.cross_correlation import CrossCorrelation, CrossCorrelationOptions
from giantlike.scene import Scene
from giantlike.shapes import Ellipsoid

_OUTLINE_RAD = np.arange(360) * (2.0 * np.pi / 360)
_WEAK_PX, _WEAK_SIGMAS = 1.0, 20.0  # a check less certain than both, in px and over the sigma of the fix, is none
_LIGHT, _LIMB, _LANDMARKS = "light", "limb", "landmarks"
_SEES: Mapping[str, str] = MappingProxyType(
    {
        Unresolved.name: _LIGHT,
        Moment.name: _LIGHT,
        CrossCorrelation.name: _LIGHT,
        LimbMatching.name: _LIMB,
        EllipsoidCRA.name: _LIMB,
        SurfaceFeatures.name: _LANDMARKS,
    }
)
"""What an estimator rests on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AutoOptions:
    """When which estimator is taken, and the options of each.

    Parameters
    ----------
    unresolved_px : float, px
        Up to this diameter a body is a point of light.
    limb_px : float, px
        From this diameter the limb is used.
    min_limb_px : float, px
        Length of lit limb within the frame below which there is no limb to use.
    false_alarm : float
        Probability that two right estimates are called a disagreement.
    unresolved, moment, cross_correlation, limb_matching, ellipsoid_cra, surface_features
        Options of the estimators.

    Raises
    ------
    InputError
        A value is out of its range.
    """

    unresolved_px: float = 4.0
    limb_px: float = 40.0
    min_limb_px: float = 60.0
    false_alarm: float = 1e-4
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """What to try, in order, what to check with, in order, and why.

    Parameters
    ----------
    estimators, checks : tuple of str
        Names.
    because : str
    """

    estimators: tuple[str, ...]
    checks: tuple[str, ...]
    because: str


def choose(
    *, diameter_px: float, is_ellipsoid: bool, in_frame: float, limb_px: float, options: AutoOptions = AutoOptions()
) -> Choice:
    """Choose estimators for what a body looks like.

    Parameters
    ----------
    diameter_px : float, px
        Apparent diameter of the body.
    is_ellipsoid : bool
        Whether its shape is an ellipsoid, for which the horizon has a closed form.
    in_frame : float
        Part of the lit outline that lies within the frame, 0 to 1.
    limb_px : float, px
        Length of that part.
    options : AutoOptions

    >>> choose(diameter_px=2.0, is_ellipsoid=False, in_frame=1.0, limb_px=3.0).estimators[0]
    'unresolved'
    >>> choose(diameter_px=3000.0, is_ellipsoid=False, in_frame=0.0, limb_px=0.0).estimators[0]
    'surface_features'
    """
    size = f"{diameter_px:.3g} px wide"
    if diameter_px <= options.unresolved_px:
        return Choice(
            estimators=(Unresolved.name, CrossCorrelation.name),
            checks=(Moment.name,),
            because=f"{size}, up to {options.unresolved_px:g} px: a point of light",
        )
    if diameter_px < options.limb_px:
        return Choice(
            estimators=(CrossCorrelation.name, Moment.name),
            checks=(Moment.name,),
            because=f"{size}, below {options.limb_px:g} px: too small for its limb",
        )
    if limb_px < options.min_limb_px:
        because = f"{size}, {limb_px:.3g} px of lit limb in the frame, below {options.min_limb_px:g}: no limb to use"
        if is_ellipsoid:
            return Choice(estimators=(), checks=(), because=because)
        return Choice(
            estimators=(SurfaceFeatures.name, CrossCorrelation.name),
            checks=(CrossCorrelation.name,),
            because=because,
        )
    seen = f"{size}, {in_frame:.0%} of the lit limb in the frame"
    if is_ellipsoid:
        return Choice(
            estimators=(EllipsoidCRA.name, LimbMatching.name, CrossCorrelation.name),
            checks=(CrossCorrelation.name, Moment.name, EllipsoidCRA.name),
            because=f"{seen}, an ellipsoid: its horizon, whatever its face looks like",
        )
    if in_frame < 1.0:
        return Choice(
            estimators=(LimbMatching.name, CrossCorrelation.name, SurfaceFeatures.name),
            checks=(CrossCorrelation.name, LimbMatching.name),
            because=f"{seen}, cut by it: its limb",
        )
    return Choice(
        estimators=(CrossCorrelation.name, LimbMatching.name, Moment.name),
        checks=(LimbMatching.name, Moment.name, CrossCorrelation.name),
        because=f"{seen}, of irregular shape: all of its light",
    )


class Auto:
    """Chooses an estimator by apparent size, shape and limb in view, and checks it by an independent one.

    The estimators of the choice are tried in order; the first fix to which none of its own checks objects is taken,
    else the first fix. A second estimator that rests on something else (the limb instead of the light), or on the
    light in another way, checks it: where the two differ by more than their covariances explain, the fix is flagged
    ``DISAGREEMENT`` and so is suspect; where there is no second fix that is certain enough and not suspect itself, it
    is flagged ``UNCHECKED``.

    The fix is that of the estimator taken, under the name ``auto``; its ``provenance`` says which (``chosen``), why
    (``because``), what checked it (``checked_by``) and the probability that right estimates differ by as much
    (``agreement``). ``score`` is that of the estimator taken.

    Parameters
    ----------
    options : AutoOptions
    """

    name: ClassVar[str] = "auto"

    def __init__(self, options: AutoOptions | None = None) -> None:
        self.options = options or AutoOptions()

    def estimate(
        self, image: Image, camera: Camera, scene: Scene, target: str | None = None
    ) -> CenterFix | PositionFix | Failure:
        """Find a target of ``scene`` in ``image``.

        Parameters
        ----------
        image : Image
        camera : Camera
        scene : Scene
        target : str, optional
            May be left out when there is only one.

        Returns
        -------
        PositionFix, CenterFix or Failure
            The failure is that of the first choice; its text names what else was tried.

        Raises
        ------
        InputError
            The image has another size than the camera, or there is no such target.
        """
        inputs = gather(image, camera, scene, target, estimator=self.name, options=self.options)
        if isinstance(inputs, Failure):
            return inputs
        choice = self._choice(inputs)
        outcomes = dict[str, CenterFix | Failure]()

        def outcome(name: str) -> CenterFix | Failure:
            if name not in outcomes:
                outcomes[name] = self._estimator(name).estimate(image, camera, scene, inputs.target_name)
            return outcomes[name]

        taken = _taken(choice, outcome)
        if taken is None:
            return _nothing(inputs, choice, outcomes)
        return self._checked(inputs, choice, taken, outcome)

    def _choice(self, inputs: EstimatorInputs) -> Choice:
        diameter_px = 2.0 * inputs.radius_px
        in_frame, limb_px = (1.0, 0.0) if diameter_px < self.options.limb_px else _limb_in_frame(inputs)
        return choose(
            diameter_px=diameter_px,
            is_ellipsoid=isinstance(inputs.geometry.target.shape, Ellipsoid),
            in_frame=in_frame,
            limb_px=limb_px,
            options=self.options,
        )

    def _estimator(self, name: str) -> Estimator:
        known: Mapping[str, Callable[[], Estimator]] = {
            Unresolved.name: lambda: Unresolved(self.options.unresolved),
            Moment.name: lambda: Moment(self.options.moment),
            CrossCorrelation.name: lambda: CrossCorrelation(self.options.cross_correlation),
            LimbMatching.name: lambda: LimbMatching(self.options.limb_matching),
            EllipsoidCRA.name: lambda: EllipsoidCRA(self.options.ellipsoid_cra),
            SurfaceFeatures.name: lambda: SurfaceFeatures(self.options.surface_features),
        }
        return known[name]()

    def _checked(
        self, inputs: EstimatorInputs, choice: Choice, taken: str, outcome: Callable[[str], CenterFix | Failure]
    ) -> CenterFix:
        fix = outcome(taken)
        assert isinstance(fix, CenterFix)
        said = {"chosen": taken, "because": choice.because}
        # What rests on something else comes first; another way to look at the same light is better than nothing.
        for name in sorted(choice.checks, key=lambda name: _SEES[name] == _SEES[taken]):
            if name == taken:
                continue
            second = outcome(name)
            if isinstance(second, CenterFix) and not second.flags.suspect and _tells(second, fix):
                agreement = agreement_of(fix, second)
                flag = Quality.NONE if agreement >= self.options.false_alarm else Quality.DISAGREEMENT
                said |= {"checked_by": name, "agreement": f"{agreement:.3g}"}
                break
        else:
            flag = Quality.UNCHECKED
        return replace(fix, estimator=self.name, flags=fix.flags | flag, provenance={**fix.provenance, **said})


def _tells(second: CenterFix, fix: CenterFix) -> bool:
    """Whether a second fix is certain enough to check the first."""
    sigmas = [math.sqrt(float(np.linalg.eigvalsh(one.covariance_px2)[-1])) for one in (second, fix)]
    return sigmas[0] <= max(_WEAK_PX, _WEAK_SIGMAS * sigmas[1])


def agreement_of(first: CenterFix, second: CenterFix) -> float:
    """Probability that two right and independent fixes of one body differ by as much: by position, else by center."""
    from scipy.stats import chi2

    if isinstance(first, PositionFix) and isinstance(second, PositionFix):
        difference = first.position_camera_km - second.position_camera_km
        covariance = first.covariance_camera_km2 + second.covariance_camera_km2
    else:
        difference = first.center_px - second.center_px
        covariance = first.covariance_px2 + second.covariance_px2
    scale = np.sqrt(np.diag(covariance))
    whitened = np.linalg.solve(covariance / np.outer(scale, scale), difference / scale)
    return float(chi2.sf(float(whitened @ (difference / scale)), len(difference)))


def _taken(choice: Choice, outcome: Callable[[str], CenterFix | Failure]) -> str | None:
    """Name of the first fix to which nothing objects, else of the first fix."""
    suspect = None
    for name in choice.estimators:
        fix = outcome(name)
        if isinstance(fix, Failure):
            continue
        if not fix.flags.suspect:
            return name
        suspect = suspect or name
    return suspect


def _nothing(inputs: EstimatorInputs, choice: Choice, outcomes: Mapping[str, CenterFix | Failure]) -> Failure:
    failures = [(name, one) for name, one in outcomes.items() if isinstance(one, Failure)]
    if not failures:
        return inputs.fail(Reason.NO_LIMB, f"{choice.because}, and an ellipsoid has no landmarks")
    first, *others = failures
    also = "".join(f"; {name}: {one.reason}" for name, one in others)
    return inputs.fail(first[1].reason, f"{choice.because}; {first[1].detail}{also}")


def _limb_in_frame(inputs: EstimatorInputs) -> tuple[float, float]:
    """Part of the lit outline that lies within the frame, and its length in px."""
    outline = trace_silhouette(
        inputs.geometry.body(),
        inputs.camera.model,
        _OUTLINE_RAD,
        sun_direction_camera=inputs.geometry.sun_direction_camera,
    )
    points: Float = outline.points_px
    lit = outline.lit
    if not lit.any():
        return 0.0, 0.0
    limits = np.array([inputs.camera.columns, inputs.camera.rows]) - 0.5
    inside = np.isfinite(points).all(axis=1) & np.all((points > -0.5) & (points < limits), axis=1)
    lengths = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    usable = inside & lit & np.roll(inside, -1) & np.isfinite(lengths)
    return float((inside & lit).sum() / lit.sum()), float(lengths[usable].sum())
