"""Camera models: projection of directions in camera axes to pixels and back, with analytic Jacobians.

``CameraModel`` is the interface; a model is a frozen value and its type name is in ``MODELS``. ``convert``,
``resample`` and ``grid.fit_grid`` work on any of them.
"""

from giantlike.camera_models.base import CameraModel, ifov_rad
from giantlike.camera_models.fisheye import EquidistantModel, EquisolidModel
from giantlike.camera_models.grid import GridCorrectedModel
from giantlike.camera_models.owen import OwenModel
from giantlike.camera_models.pinhole import PinholeModel
from giantlike.camera_models.rational import BrownModel, OpenCVModel
from giantlike.camera_models.registry import MODELS, model_from_mapping, model_to_mapping
from giantlike.camera_models.scan import SweepXModel, SweepYModel
from giantlike.camera_models.scaramuzza import ScaramuzzaModel

__all__ = [
    "MODELS",
    "BrownModel",
    "CameraModel",
    "EquidistantModel",
    "EquisolidModel",
    "GridCorrectedModel",
    "OpenCVModel",
    "OwenModel",
    "PinholeModel",
    "ScaramuzzaModel",
    "SweepXModel",
    "SweepYModel",
    "ifov_rad",
    "model_from_mapping",
    "model_to_mapping",
]
