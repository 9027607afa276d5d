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
    from giantlike._system.threads import threads as threads
    from giantlike.calibration import CalibrationOptions as CalibrationOptions
    from giantlike.camera import Camera as Camera
    from giantlike.core.causes import Cause as Cause
    from giantlike.core.detector import Detector as Detector
    from giantlike.core.detector import GaussianPsf as GaussianPsf
    from giantlike.core.errors import DataError as DataError
    from giantlike.core.errors import EstimationError as EstimationError
    from giantlike.core.errors import FrameMismatchError as FrameMismatchError
    from giantlike.core.errors import InputError as InputError
    from giantlike.core.errors import OpNavError as OpNavError
    from giantlike.core.outcomes import AttitudeFix as AttitudeFix
    from giantlike.core.outcomes import CenterFix as CenterFix
    from giantlike.core.outcomes import Failure as Failure
    from giantlike.core.outcomes import PositionFix as PositionFix
    from giantlike.core.outcomes import Quality as Quality
    from giantlike.core.outcomes import Reason as Reason
    from giantlike.ephemeris import ApparentGeometry as ApparentGeometry
    from giantlike.ephemeris import DistantLight as DistantLight
    from giantlike.ephemeris import FixedEphemeris as FixedEphemeris
    from giantlike.ephemeris import SpiceEphemeris as SpiceEphemeris
    from giantlike.ephemeris import TableEphemeris as TableEphemeris
    from giantlike.image import Image as Image
    from giantlike.processing import DetectionOptions as DetectionOptions
    from giantlike.relative import Auto as Auto
    from giantlike.relative import AutoOptions as AutoOptions
    from giantlike.relative import CrossCorrelation as CrossCorrelation
    from giantlike.relative import CrossCorrelationOptions as CrossCorrelationOptions
    from giantlike.relative import EllipseFit as EllipseFit
    from giantlike.relative import EllipseFitOptions as EllipseFitOptions
    from giantlike.relative import EllipsoidCRA as EllipsoidCRA
    from giantlike.relative import EllipsoidCRAOptions as EllipsoidCRAOptions
    from giantlike.relative import LimbMatching as LimbMatching
    from giantlike.relative import LimbMatchingOptions as LimbMatchingOptions
    from giantlike.relative import Moment as Moment
    from giantlike.relative import MomentOptions as MomentOptions
    from giantlike.relative import SigmoidLimb as SigmoidLimb
    from giantlike.relative import SigmoidLimbOptions as SigmoidLimbOptions
    from giantlike.relative import SurfaceFeatures as SurfaceFeatures
    from giantlike.relative import SurfaceFeaturesOptions as SurfaceFeaturesOptions
    from giantlike.relative import Unresolved as Unresolved
    from giantlike.relative import UnresolvedOptions as UnresolvedOptions
    from giantlike.scene import Scene as Scene
    from giantlike.scene import Target as Target
    from giantlike.stars import StarNavigation as StarNavigation
    from giantlike.stars import StarOptions as StarOptions
    from giantlike.stars import TransferOptions as TransferOptions
    from giantlike.stars import carry_attitude as carry_attitude

__version__ = VERSION

logging.getLogger("giantlike").addHandler(logging.NullHandler())  # silent unless the user asks: docs/logging.md

provide("giantlike.plotting.notebook")
provide("giantlike.campaign.report.notebook")

_ESTIMATORS = (
    "Auto", "CrossCorrelation", "EllipseFit", "EllipsoidCRA", "LimbMatching", "Moment", "SigmoidLimb",
    "SurfaceFeatures", "Unresolved",
)  # fmt: skip
_HOMES = {
    "giantlike.camera": ("Camera",),
    "giantlike.core.causes": ("Cause",),
    "giantlike.core.detector": ("Detector", "GaussianPsf"),
    "giantlike.core.errors": ("DataError", "EstimationError", "FrameMismatchError", "InputError", "OpNavError"),
    "giantlike.core.outcomes": ("AttitudeFix", "CenterFix", "Failure", "PositionFix", "Quality", "Reason"),
    "giantlike._system.threads": ("threads",),
    "giantlike.ephemeris": ("ApparentGeometry", "DistantLight", "FixedEphemeris", "SpiceEphemeris", "TableEphemeris"),
    "giantlike.image": ("Image",),
    "giantlike.relative": tuple(name + part for name in _ESTIMATORS for part in ("", "Options")),
    "giantlike.processing": ("DetectionOptions",),
    "giantlike.calibration": ("CalibrationOptions",),
    "giantlike.scene": ("Scene", "Target"),
    "giantlike.stars": ("StarNavigation", "StarOptions", "TransferOptions", "carry_attitude"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'giantlike' has no attribute {name!r}")
    value = getattr(import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*_HOME_OF, "__version__"])


if not TYPE_CHECKING:  # type checkers take what is imported above for them
    __all__ = __dir__()
