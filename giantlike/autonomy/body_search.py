"""Bodies in wide images: patches of light with direction, size and brightness, and their identification."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.core.arrays import Float, Mask, require, require_number, unit
from giantlike.core.outcomes import Failure, Reason
from giantlike.core.statistics import MAD_TO_SIGMA
from giantlike.core.values import Value
from giantlike.image import Image

_AREA_OF_SECOND_MOMENT = 4.5  # squared radius over second moment along the cusps: disk 4 to 5 by law, at any phase
SIZE_SIGMA = 0.06  # relative error of a radius from that: half the difference of the two laws, one sigma
_PIXEL_MOMENT = 1.0 / 12.0  # px^2: second moment of a pixel


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchOptions:
    """Options of :func:`find_patches`."""

    threshold_sigma: float = 10.0  # level over the background, in sigmas of its noise
    min_area_px: int = 5  # least number of pixels: a planet or a star in a wide camera covers fewer
    margin_px: int = 4  # pixels around a patch that belong to its sum: the wings of the optics

    def __post_init__(self) -> None:
        require_number(self.threshold_sigma, "threshold_sigma", least=3.0)
        require(self.min_area_px >= 1, f"min_area_px must be >= 1, got {self.min_area_px}")
        require(self.margin_px >= 0, f"margin_px must be >= 0, got {self.margin_px}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenPatch(Value):
    """A patch of light in a wide image."""

    center_px: Float  # center of light
    direction_camera: Float
    dn: float  # sum minus background
    sigma_dn: float  # its noise
    saturated: bool
    second_moment_rad2: Float  # (2, 2); of its light, along ``axes_camera``, pixel and optics taken out
    axes_camera: Float  # (2, 3); two axes across the direction
    on_edge: bool = False  # it touches the edge of the frame: part of the body may lie outside

    def half_angle_rad(self, sun_direction_camera: Float) -> float:
        """Angular radius of the sphere that this is, from its light along the cusps; Sun as a unit vector."""
        along = self.axes_camera @ sun_direction_camera
        length = float(np.linalg.norm(along))
        across = np.array([-along[1], along[0]]) / length if length > 0.0 else np.array([1.0, 0.0])
        moment = float(across @ self.second_moment_rad2 @ across)
        return float(np.sqrt(max(moment, 0.0) * _AREA_OF_SECOND_MOMENT))


def find_patches(image: Image, camera: Camera, options: SearchOptions | None = None) -> tuple[SeenPatch, ...] | Failure:
    """Find bright bodies in a wide image.

    Parameters
    ----------
    image : Image
    camera : Camera; of any lens: directions come from its model, so that a fisheye is searched as it is
    options : SearchOptions, optional

    Returns
    -------
    tuple of SeenPatch or Failure
        Brightest first. Reasons: no_signal.
    """
    options = SearchOptions() if options is None else options
    pixels = np.asarray(image.pixels, dtype=np.float32)
    good: Mask = ~image.mask
    sample = pixels[::7, ::7][good[::7, ::7]]
    level = float(np.median(sample))
    noise = max(MAD_TO_SIGMA * float(np.median(np.abs(sample - level))), 0.5)
    bright = ((pixels > level + options.threshold_sigma * noise) & good).astype(np.uint8)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(bright, connectivity=8)
    patches = []
    for label in range(1, count):
        left, top, width, height, area = (int(value) for value in boxes[label])
        if area < options.min_area_px:
            continue
        grow = options.margin_px
        window = (
            slice(max(top - grow, 0), min(top + height + grow, image.rows)),
            slice(max(left - grow, 0), min(left + width + grow, image.columns)),
        )
        others = (labels[window] != label) & (labels[window] != 0)
        light = np.where(others | ~good[window], 0.0, pixels[window] - level).astype(np.float64)
        on_edge = left == 0 or top == 0 or left + width == image.columns or top + height == image.rows
        patch = _patch(light, window, labels[window] == label, camera, noise)
        if patch is not None:
            patches.append(replace(patch, on_edge=on_edge))
    if not patches:
        return Failure(
            Reason.NO_SIGNAL,
            f"{image.name}: no patch of {options.min_area_px} pixels is {options.threshold_sigma:g} sigmas above"
            f" the background ({level:.1f} DN, noise {noise:.1f})",
        )
    return tuple(sorted(patches, key=lambda each: -each.dn))


def _patch(light: Float, window: tuple[slice, slice], core: Mask, camera: Camera, noise: float) -> SeenPatch | None:
    """Measure one patch; None where the camera sees nothing there, or it has no light."""
    rows, columns = np.mgrid[window]
    total = float(light.sum())
    around = cv2.dilate(core.astype(np.uint8), np.ones((3, 3), dtype=np.uint8), iterations=2) > 0
    weights = np.where(around, light, 0.0)  # with the faint rim that the threshold cut: the size hangs on it
    if total <= 0.0 or weights.sum() <= 0.0:
        return None
    center = np.array([np.sum(weights * columns), np.sum(weights * rows)]) / weights.sum()
    direction = camera.model.unproject(center)
    if not np.isfinite(direction).all():
        return None
    direction = unit(direction)
    by_pixel = camera.model.unproject_jacobian(center) / float(np.linalg.norm(camera.model.unproject(center)))
    first = by_pixel[:, 0] - direction * float(direction @ by_pixel[:, 0])
    axes = np.stack([unit(first), np.cross(direction, unit(first))])
    plane = axes @ by_pixel  # (2, 2): rad per px
    offsets = np.stack([columns - center[0], rows - center[1]], axis=-1).reshape(-1, 2)
    moment_px2 = np.einsum("n,ni,nj->ij", weights.ravel(), offsets, offsets) / weights.sum()
    psf = 0.0 if camera.psf is None else camera.psf.sigma_px**2
    moment_px2 = moment_px2 - np.eye(2) * (_PIXEL_MOMENT + psf)
    saturated = bool(np.max(light + 0.0) >= 0.98 * (camera.detector.saturation_dn - camera.detector.bias_dn))
    shot = max(total, 0.0) / camera.detector.gain_e_per_dn
    return SeenPatch(
        center_px=center,
        direction_camera=direction,
        dn=total,
        sigma_dn=float(np.sqrt(light.size * noise**2 + shot)),
        saturated=saturated,
        second_moment_rad2=plane @ moment_px2 @ plane.T,
        axes_camera=axes,
    )


def pointing_slew(direction_instrument: Float, boresight_instrument: Float) -> Rotation:
    """Smallest rotation of an instrument that puts a direction onto a boresight, both in its axes."""
    start, goal = unit(np.asarray(direction_instrument)), unit(np.asarray(boresight_instrument))
    axis = np.cross(start, goal)
    sine, cosine = float(np.linalg.norm(axis)), float(start @ goal)
    if sine < 1e-12:  # the same or the opposite direction: any axis across will do
        axis = np.cross(start, np.eye(3)[int(np.argmin(np.abs(start)))])
    return Rotation.from_rotvec(unit(axis) * float(np.arctan2(sine, cosine)))
