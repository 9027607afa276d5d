"""Geometry in the labels of images, as a row of a geometry table would have it."""

from __future__ import annotations

from scipy.spatial.transform import Rotation

from giantlike.campaign.file.config import Campaign
from giantlike.campaign.file.inputs import TargetSetup
from giantlike.core.errors import DataError
from giantlike.core.frames import rotate
from giantlike.image import Image
from giantlike.io.geometry_table import GeometryRow
from giantlike.io.label_geometry import geometry_of_label


def attitude_of_label(campaign: Campaign, image: Image) -> Rotation | None:
    """Attitude from a label, given directly or by the orientation of its target.

    Returns None where the label has none, and its target is not in the campaign or has no orientation by SPICE.
    """
    label = geometry_of_label(image.metadata, campaign.camera.model)
    if label is None or label.camera_from_inertial is not None or label.camera_from_body is None:
        return None if label is None else label.camera_from_inertial
    target = next((one for one in campaign.targets if _is(one, label.target)), None)
    et = image.et
    if target is None or et is None or campaign.spice is None:
        return None
    try:
        # only the distance counts, for the light time
        inertial_from_body = target.inertial_from_body(label.position_camera_km, et)
    except DataError:
        return None
    return label.camera_from_body * inertial_from_body.inv()


def row_of_label(campaign: Campaign, image: Image, target: TargetSetup) -> GeometryRow | None:
    """Position of a target, its orientation and its Sun from the label of an image.

    Returns None where the label is of another target or has no geometry, or the attitude is unknown.
    """
    label = geometry_of_label(image.metadata, campaign.camera.model)
    attitude = image.camera_from_inertial
    if label is None or attitude is None or not _is(target, label.target):
        return None
    turn = label.camera_from_body
    return GeometryRow(
        file=image.name,
        target=target.name,
        target_position_inertial_km=rotate(attitude.inv(), label.position_camera_km),
        body_from_inertial=None if turn is None else turn.inv() * attitude,
        sun_direction_inertial=rotate(attitude.inv(), label.sun_direction_camera),
    )


def _is(target: TargetSetup, name: str) -> bool:
    return name.strip().upper() in {target.name.upper(), target.spice_body.upper()}
