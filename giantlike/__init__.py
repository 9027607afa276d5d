"""giantlike: a ground workbench for optical navigation.

The names that a session needs are here; everything else is in the subpackages. They are imported when first
used, so that ``import giantlike`` and the command line start fast.

>>> import giantlike as gl
>>> gl.Camera.from_fov(20.0, 1024, 1024).columns
1024
"""

from __future__ import annotations

import logging
from importlib import import_module
from typing import TYPE_CHECKING, Any

from giantlike.core.display import provide
from giantlike.core.version import VERSION

if TYPE_CHECKING:
    from giantlike.calibration import CalibrationOptions
    from giantlike.camera import Camera
    from giantlike.core.causes import Cause
    from giantlike.core.detector import Detector, GaussianPsf
    from giantlike.core.errors import DataError, EstimationError, FrameMismatchError, InputError, OpNavError
    from giantlike.core.outcomes import AttitudeFix, CenterFix, Failure, PositionFix, Quality, Reason
    from giantlike.ephemeris import (
        ApparentGeometry,
        DistantLight,
        FixedEphemeris,
        SpiceEphemeris,
        TableEphemeris,
    )
    from giantlike.image import Image
    from giantlike.processing import DetectionOptions
    from giantlike.relative import (
        Auto,
        AutoOptions,
        CrossCorrelation,
        CrossCorrelationOptions,
        EllipseFit,
        EllipseFitOptions,
        EllipsoidCRA,
        EllipsoidCRAOptions,
        LimbMatching,
        LimbMatchingOptions,
        Moment,
        MomentOptions,
        SigmoidLimb,
        SigmoidLimbOptions,
        SurfaceFeatures,
        SurfaceFeaturesOptions,
        Unresolved,
        UnresolvedOptions,
    )
    from giantlike.scene import Scene, Target
    from giantlike.stars import StarNavigation, StarOptions, TransferOptions, carry_attitude

__version__ = VERSION

logging.getLogger("giantlike").addHandler(logging.NullHandler())  # silent unless the user asks: docs/logging.md

provide("giantlike.plotting.notebook")
provide("giantlike.campaign.report.notebook")

_HOMES = {
    "giantlike.camera": ("Camera",),
    "giantlike.core.causes": ("Cause",),
    "giantlike.core.detector": ("Detector", "GaussianPsf"),
    "giantlike.core.errors": ("DataError", "EstimationError", "FrameMismatchError", "InputError", "OpNavError"),
    "giantlike.core.outcomes": ("AttitudeFix", "CenterFix", "Failure", "PositionFix", "Quality", "Reason"),
    "giantlike.ephemeris": ("ApparentGeometry", "DistantLight", "FixedEphemeris", "SpiceEphemeris", "TableEphemeris"),
    "giantlike.image": ("Image",),
    "giantlike.relative": (
        "Auto",
        "AutoOptions",
        "CrossCorrelation",
        "CrossCorrelationOptions",
        "EllipseFit",
        "EllipseFitOptions",
        "EllipsoidCRA",
        "EllipsoidCRAOptions",
        "LimbMatching",
        "LimbMatchingOptions",
        "Moment",
        "MomentOptions",
        "SigmoidLimb",
        "SigmoidLimbOptions",
        "SurfaceFeatures",
        "SurfaceFeaturesOptions",
        "Unresolved",
        "UnresolvedOptions",
    ),
    "giantlike.processing": ("DetectionOptions",),
    "giantlike.calibration": ("CalibrationOptions",),
    "giantlike.scene": ("Scene", "Target"),
    "giantlike.stars": ("StarNavigation", "StarOptions", "TransferOptions", "carry_attitude"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "ApparentGeometry",
    "AttitudeFix",
    "Auto",
    "AutoOptions",
    "CalibrationOptions",
    "Camera",
    "Cause",
    "CenterFix",
    "CrossCorrelation",
    "CrossCorrelationOptions",
    "DataError",
    "DetectionOptions",
    "Detector",
    "DistantLight",
    "EllipseFit",
    "EllipseFitOptions",
    "EllipsoidCRA",
    "EllipsoidCRAOptions",
    "EstimationError",
    "Failure",
    "FixedEphemeris",
    "FrameMismatchError",
    "GaussianPsf",
    "Image",
    "InputError",
    "LimbMatching",
    "LimbMatchingOptions",
    "Moment",
    "MomentOptions",
    "OpNavError",
    "PositionFix",
    "Quality",
    "Reason",
    "Scene",
    "SigmoidLimb",
    "SigmoidLimbOptions",
    "SpiceEphemeris",
    "StarNavigation",
    "StarOptions",
    "SurfaceFeatures",
    "SurfaceFeaturesOptions",
    "TableEphemeris",
    "Target",
    "TransferOptions",
    "Unresolved",
    "UnresolvedOptions",
    "__version__",
    "carry_attitude",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'giantlike' has no attribute {name!r}")
    value = getattr(import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
