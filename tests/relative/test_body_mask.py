"""The mask of the bodies of a scene: what it covers, and what it leaves to the stars."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, Reason
from giantlike.image import Image
from giantlike.processing import Detections, detect_sources
from giantlike.scene import body_mask
from tests.processing.test_detection import exposed, nearest, star_image
from tests.simulated import small_camera, sphere_scene

RADIUS_KM, RANGE_KM = 30.0, 1000.0
BORDER_PX = 1.0  # the outline is a polygon, drawn to a pixel
CLEAR_PX = 0.1


def image_of(pixels: NDArray[Any], turn_rad: tuple[float, float] = (0.0, 0.0)) -> Image:
    return Image(pixels=pixels, camera_from_inertial=Rotation.from_rotvec([*turn_rad, 0.0]))


def distance_px(turn_rad: tuple[float, float] = (0.0, 0.0)) -> Float:
    """How far each pixel's line of sight passes outside the sphere, in pixels at the image center."""
    camera = small_camera()
    x, y = np.meshgrid(np.arange(camera.columns), np.arange(camera.rows))
    sight = camera.model.unproject(np.stack([x, y], axis=-1).astype(np.float64))
    axis = rotate(Rotation.from_rotvec([*turn_rad, 0.0]), [0.0, 0.0, 1.0])
    return np.asarray((np.arccos(sight @ axis) - np.arcsin(RADIUS_KM / RANGE_KM)) * 1000.0)


@pytest.mark.parametrize("turn_rad", [(0.0, 0.0), (0.04, -0.03), (0.0, 0.115)])
@pytest.mark.parametrize("margin_px", [0.0, 6.0])
def test_a_sphere_is_covered_with_its_margin_and_nothing_else(margin_px: float, turn_rad: tuple[float, float]) -> None:
    camera = small_camera()
    mask = body_mask(
        sphere_scene(RANGE_KM, 60.0), image_of(np.zeros((200, 200)), turn_rad), camera, margin_px=margin_px
    )
    assert isinstance(mask, np.ndarray)
    away = distance_px(turn_rad)
    assert mask[away < margin_px - BORDER_PX].all()
    assert not mask[away > margin_px + BORDER_PX].any()


def test_stars_beside_a_textured_body_are_all_that_is_found() -> None:
    camera = small_camera()
    stars = np.array([[30.3, 40.1], [160.2, 30.4], [150.0, 170.7], [100.2, 147.0]])
    texture = np.where(distance_px() < 0.0, np.random.default_rng(1).uniform(0.0, 4000.0, (200, 200)), 0.0)
    pixels = exposed(star_image(stars, np.full(4, 4000.0), 0.8, (200, 200)) + texture, 3)
    mask = body_mask(sphere_scene(RANGE_KM, 20.0), image_of(pixels), camera)
    assert isinstance(mask, np.ndarray)
    found = detect_sources(pixels, detector=camera.detector, psf_sigma_px=0.8, mask=mask)
    assert isinstance(found, Detections)
    clean = found.select(found.clean & (found.snr > 10.0))
    assert len(clean) == len(stars)
    assert nearest(clean, stars)[0].max() < CLEAR_PX


def test_no_attitude_is_a_failure_and_a_negative_margin_a_mistake() -> None:
    camera, scene = small_camera(), sphere_scene(RANGE_KM, 60.0)
    blind = replace(image_of(np.zeros((200, 200))), camera_from_inertial=None)
    result = body_mask(scene, blind, camera)
    assert isinstance(result, Failure)
    assert result.reason is Reason.NO_ATTITUDE
    with pytest.raises(InputError, match="margin_px"):
        body_mask(scene, image_of(np.zeros((200, 200))), camera, margin_px=-1.0)
