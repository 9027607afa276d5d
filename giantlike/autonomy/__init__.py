"""Instruments that find and identify bodies by themselves: sources of images, photometry, modes, two cameras."""

from giantlike.autonomy.body_photometry import expected_dn, identify_body
from giantlike.autonomy.body_search import find_patches
from giantlike.autonomy.mode_machine import ModeMachine
from giantlike.autonomy.two_camera_pose import pose_of_pair

__all__ = ["ModeMachine", "expected_dn", "find_patches", "identify_body", "pose_of_pair"]
