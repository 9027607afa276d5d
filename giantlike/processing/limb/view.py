"""Pixels, camera and light of an image in which a limb is measured, and the limb predicted in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask
from giantlike.core.detector import Detector
from giantlike.core.values import Value
from giantlike.ray_tracing import FocalPlane

_PATCH_PX = 3  # side, px, of the smallest square of saturated pixels that is treated as part of a body


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LimbView(Value):
    """Pixels of a body, their detector and the illumination: the inputs of measurements of a limb."""

    pixels_dn: Float  # (rows, columns); bias taken off
    usable: Mask  # neither bad nor saturated
    saturated: Mask
    detector: Detector  # noise model
    plane: FocalPlane  # camera model and point spread function, None where unknown
    sun_direction_camera: Float  # unit vector from body to Sun
    radius_px: float  # predicted apparent radius of the body
    in_air: bool = False  # air of uncertain altitude blurs the limb more in some directions than in others

    @property
    def model(self) -> CameraModel:
        """Camera model."""
        return self.plane.model

    @property
    def psf_sigma_px(self) -> float | None:
        """Standard deviation of the point spread function, px; None when unknown."""
        return None if self.plane.psf is None else self.plane.psf.sigma_px

    @property
    def clipped_pixels(self) -> Mask:
        """Saturated pixels (rows, columns) where some lie in a patch, of a bright body; single ones are defects."""
        if not self.saturated.any():
            return self.saturated
        patch = np.ones((_PATCH_PX, _PATCH_PX), np.uint8)
        in_patches = cv2.erode(self.saturated.astype(np.uint8), patch, borderValue=0).any()
        return self.saturated if in_patches else np.zeros_like(self.saturated)

    @property
    def with_clipped(self) -> Mask:
        """Pixels (rows, columns) that are usable or clipped: a clipped one is bright, whatever its value."""
        clipped = self.clipped_pixels
        return np.asarray(self.usable | clipped) if clipped.any() else self.usable

    @property
    def sky_noise_dn(self) -> float:
        """Standard deviation of a dark pixel, DN."""
        return math.sqrt(float(self.detector.variance_dn2(np.zeros(1))[0]))

    def contains(self, points_px: Float, *, margin_px: float = 0.0) -> Mask:
        """Find the points (..., 2) on the detector, ``margin_px`` from its edge (negative for points outside)."""
        return in_frame(points_px, self.usable.shape, margin_px=margin_px)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictedLimb(Value):
    """Points of a predicted limb that are illuminated and in the frame."""

    points_px: Float  # (n, 2)
    points_camera_km: Float  # (n, 3); the same points in space
    normals_px: Float  # (n, 2); outward unit normals of the outline in the image
    brightness: Float  # (n,); just inside the outline, in any unit


def in_frame(points_px: Float, shape: tuple[int, ...], *, margin_px: float = 0.0) -> Mask:
    """Find the points (..., 2) on the pixels of an image, ``margin_px`` from its edge; NaN is not."""
    low, high = margin_px - 0.5, np.array(shape[1::-1]) - 0.5 - margin_px
    result: Mask = np.all((points_px >= low) & (points_px <= high), axis=-1)
    return result
