"""Camera models of missions with other axes, converted to ours; the mission's own frame is kept as a rotation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera_models import CameraModel
from giantlike.camera_models.affine import AffineModel
from giantlike.core.arrays import require

Boresight = Literal["+z", "-z"]  # direction of the z axis of a mission's camera frame: to the scene, or into the camera

_LETTERS_X = ("fx_px", "p2", "s1", "s2", "e6")
_LETTERS_Y = ("fy_px", "skew_px", "p1", "s3", "s4", "e5")
_LETTERS_XY = ("e1", "e3")


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportedCamera:
    """A camera model from a file of another program, in our axes and pixels."""

    name: str  # name in the file
    model: CameraModel
    columns: int | None = None  # columns, rows: size of the detector, where the file states it
    rows: int | None = None
    camera_from_mission: Rotation  # from the mission's camera frame (of its pointing kernels) to ours
    rows_reversed: bool = False  # the model counts rows from the last one, mirrored: read ``image[::-1]``
    ignored: tuple[str, ...] = ()  # names of the parameters in the file that the model does not have


def from_mission_frame(
    kind: type[AffineModel],
    parameters: Mapping[str, float],
    *,
    name: str = "camera",
    columns: int | None = None,
    rows: int | None = None,
    boresight: Boresight | None = None,
) -> ImportedCamera:
    """Convert a model whose focal lengths may be negative to one with +x along columns, +y along rows, +z forward.

    ``parameters``: by the names of the class, with signs as in the mission's model, the principal point in our pixels.
    Where the image is mirrored, rows are counted from the last one: see :class:`ImportedCamera`.

    Source: Liounis et al., Independent Optical Navigation Processing for the OSIRIS-REx Mission, Table 1 (f_y < 0).
    """
    values = dict(parameters)
    for key in ("fx_px", "fy_px"):
        require(values[key] != 0, f"camera model: {key} must not be zero")
    forward = 0.0 if boresight is None else (1.0 if boresight == "+z" else -1.0)
    reverse = forward * values["fx_px"] * values["fy_px"] < 0
    if reverse:
        require(
            rows is not None,
            f"with its z axis {boresight} this camera takes mirrored images: give rows, to count them from the last "
            "stored one, or the other boresight",
        )
        values["fy_px"] = -values["fy_px"]
        values["cy_px"] = (rows or 0) - 1 - values["cy_px"]
    x, y = np.sign(values["fx_px"]), np.sign(values["fy_px"])
    for letters, sign in ((_LETTERS_X, x), (_LETTERS_Y, y), (_LETTERS_XY, x * y)):
        values |= {key: float(sign * values[key]) for key in letters if key in values}
    turn = Rotation.from_matrix(np.diag([y, x, x * y]))  # z forward: the sign of x y
    return ImportedCamera(
        name=name, model=kind(**values), columns=columns, rows=rows, camera_from_mission=turn, rows_reversed=reverse
    )
