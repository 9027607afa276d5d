"""Estimators of a body's center and position relative to the camera; ``ESTIMATORS`` has them by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from giantlike.relative.auto import Auto, AutoOptions
from giantlike.relative.estimator import Estimator
from giantlike.relative.horizon.ellipse_fit import EllipseFit, EllipseFitOptions
from giantlike.relative.horizon.ellipsoid_cra import EllipsoidCRA, EllipsoidCRAOptions
from giantlike.relative.horizon.sigmoid_limb import SigmoidLimb, SigmoidLimbOptions
from giantlike.relative.landmarks.surface_features import LandmarkFix, SurfaceFeatures, SurfaceFeaturesOptions
from giantlike.relative.light.moment import Moment, MomentOptions
from giantlike.relative.light.unresolved import Unresolved, UnresolvedOptions
from giantlike.relative.limb.limb_matching import LimbMatching, LimbMatchingOptions
from giantlike.relative.template.cross_correlation import CrossCorrelation, CrossCorrelationOptions

ESTIMATORS: Mapping[str, Callable[..., Estimator]] = MappingProxyType(
    {
        Unresolved.name: Unresolved,
        Moment.name: Moment,
        CrossCorrelation.name: CrossCorrelation,
        LimbMatching.name: LimbMatching,
        EllipsoidCRA.name: EllipsoidCRA,
        EllipseFit.name: EllipseFit,
        SigmoidLimb.name: SigmoidLimb,
        SurfaceFeatures.name: SurfaceFeatures,
        Auto.name: Auto,
    }
)
"""Estimator classes by the name that they have in campaign files and tables; each takes its options or nothing."""

__all__ = [
    "ESTIMATORS",
    "Auto",
    "AutoOptions",
    "CrossCorrelation",
    "CrossCorrelationOptions",
    "EllipseFit",
    "EllipseFitOptions",
    "EllipsoidCRA",
    "EllipsoidCRAOptions",
    "Estimator",
    "LandmarkFix",
    "LimbMatching",
    "LimbMatchingOptions",
    "SigmoidLimb",
    "SigmoidLimbOptions",
    "Moment",
    "MomentOptions",
    "SurfaceFeatures",
    "SurfaceFeaturesOptions",
    "Unresolved",
    "UnresolvedOptions",
]
