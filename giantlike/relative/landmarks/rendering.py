"""Landmarks rendered for one pose of the body: a template with the pixels of the ground that belongs to each."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace
from typing import Protocol, Self, runtime_checkable

import cv2
import numpy as np

from giantlike.camera_models import CameraModel
from giantlike.core.arrays import Float, Mask, require
from giantlike.core.detector import GaussianPsf
from giantlike.core.outcomes import Failure
from giantlike.core.values import Value
from giantlike.ray_tracing import Body, Lambert, LommelSeeliger, RenderOptions, Trace, trace_body
from giantlike.relative.landmarks.visibility import SeenLandmarks
from giantlike.relative.template.rendering import FitBox
from giantlike.shapes.landmarks import Landmark, LandmarkCatalog

BORDER_PX = 3
"""Pixels of a patch around those that are matched: derivatives take them, and the point spread function."""

_TOGETHER = 3.0  # one render for all, as long as it has no more pixels than this times those of the patches
_LEAST_PIXELS = 40


@runtime_checkable
class Windowing(Protocol):
    """A camera model that can be cut to a part of its image, as all of ours can."""

    def windowed(self, x0_px: float, y0_px: float) -> Self:
        """Return the model of a window whose first pixel is (``x0_px``, ``y0_px``) here."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patch(Value):
    """A landmark as it should look.

    Parameters
    ----------
    number : int
        Its place in the catalog.
    box : FitBox
        Where in the image.
    light : (h, w) float64
        Brightness under the law of the target.
    other : (h, w) float64, optional
        Brightness under another law.
    mask : (h, w) bool
        The ground of the landmark; False in a border of :data:`BORDER_PX`.
    whole : bool
        Whether the ground around it is rendered too.
    """

    number: int
    box: FitBox
    light: Float
    other: Float | None
    mask: Mask
    whole: bool

    @property
    def core(self) -> tuple[slice, slice]:
        """The part within the border."""
        inner = slice(BORDER_PX, -BORDER_PX)
        return inner, inner


class LandmarkRenderer:
    """Renders landmarks of a target.

    Parameters
    ----------
    catalog : LandmarkCatalog
    model : CameraModel
    sun_direction_camera : (3,) float64, unitless, camera axes
    psf : GaussianPsf
    max_size_px : float, px
        Of larger landmarks only the middle is rendered.
    rays_per_pixel_side : int
    other_law : bool
        Whether to render under another reflectance law as well.

    Notes
    -----
    Landmarks that were taken from the very shape of the target are cut from a render of that shape, with all the
    shadows that other ground casts. Those from elsewhere are rendered from their own maps, one by one.
    """

    def __init__(
        self,
        catalog: LandmarkCatalog,
        model: CameraModel,
        *,
        sun_direction_camera: Float,
        psf: GaussianPsf,
        max_size_px: float,
        rays_per_pixel_side: int,
        other_law: bool,
    ) -> None:
        require(isinstance(model, Windowing), f"{type(model).__name__} has no windowed(): landmarks are rendered alone")
        self._catalog, self._model, self._sun, self._psf = catalog, model, sun_direction_camera, psf
        self._max_size_px, self._rays, self._other_law = max_size_px, rays_per_pixel_side, other_law

    def roughly(self) -> LandmarkRenderer:
        """Return one with one ray to a pixel and one law: enough to find landmarks by."""
        rough = copy(self)
        rough._rays, rough._other_law = 1, False
        return rough

    def patches(self, body: Body, seen: SeenLandmarks) -> tuple[Patch, ...]:
        """Templates of the landmarks seen, without those of which too little can be rendered."""
        outlines = [self._outline(body, self._catalog.landmarks[number]) for number in seen.numbers]
        boxes = [self._box(outline, center) for outline, center in zip(outlines, seen.predicted_px, strict=True)]
        own_shape = self._catalog.shape_sha256 == body.shape.sha256
        if own_shape:
            images = self._cut(body, boxes)
        else:
            images = [
                self._images(replace(body, shape=self._catalog.landmarks[number].mesh), box)
                for number, box in zip(seen.numbers.tolist(), boxes, strict=True)
            ]
        patches = []
        for number, outline, box, image in zip(seen.numbers, outlines, boxes, images, strict=True):
            if image is None:
                continue
            light, other, covered = image
            mask = _filled(outline, box)
            if not own_shape:  # the point spread function carries in what lies beside the map
                mask &= cv2.erode(covered.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
            if int(mask.sum()) >= _LEAST_PIXELS:
                patches.append(Patch(number=int(number), box=box, light=light, other=other, mask=mask, whole=own_shape))
        return tuple(patches)

    def _outline(self, body: Body, landmark: Landmark) -> Float:
        """Pixels (k, 2) whose hull is the ground of a landmark."""
        ground = landmark.grid_body_km(9)
        pixels = self._model.project(body.to_camera(ground) + body.position_camera_km)
        finite = pixels[np.isfinite(pixels).all(axis=1)].astype(np.float32)
        return cv2.convexHull(finite)[:, 0].astype(np.float64)

    def _box(self, outline: Float, center_px: Float) -> FitBox:
        """The box around an outline, not more than the largest size around its middle, and a border."""
        half = 0.5 * self._max_size_px
        low = np.floor(np.maximum(outline.min(axis=0), center_px - half)).astype(np.int64) - BORDER_PX
        high = np.ceil(np.minimum(outline.max(axis=0), center_px + half)).astype(np.int64) + 1 + BORDER_PX
        (x, y), (width, height) = low.tolist(), (high - low).tolist()
        return FitBox(x=x, y=y, width=width, height=height)

    def _cut(self, body: Body, boxes: list[FitBox]) -> list[tuple[Float, Float | None, Mask] | None]:
        """Images of the shape in boxes: out of one render of all, where they lie close together."""
        if not boxes:
            return []
        x0, y0 = min(box.x for box in boxes), min(box.y for box in boxes)
        x1, y1 = max(box.x + box.width for box in boxes), max(box.y + box.height for box in boxes)
        whole = FitBox(x=x0, y=y0, width=x1 - x0, height=y1 - y0)
        if whole.width * whole.height > _TOGETHER * sum(box.width * box.height for box in boxes):
            return [self._images(body, box) for box in boxes]
        images = self._images(body, whole)
        if images is None:
            return [None] * len(boxes)
        light, other, covered = images
        parts: list[tuple[Float, Float | None, Mask] | None] = []
        for box in boxes:
            part = (slice(box.y - y0, box.y - y0 + box.height), slice(box.x - x0, box.x - x0 + box.width))
            parts.append((light[part], None if other is None else other[part], covered[part]))
        return parts

    def _images(self, body: Body, box: FitBox) -> tuple[Float, Float | None, Mask] | None:
        """Brightness under the law of the body, under another one, and what is covered wholly; None for nothing lit."""
        assert isinstance(self._model, Windowing)
        model = self._model.windowed(box.x, box.y)
        options = RenderOptions(rays_per_pixel_side=self._rays, min_rays_across=1)
        trace = trace_body(
            body,
            model,
            sun_direction_camera=self._sun,
            psf=self._psf,
            columns=box.width,
            rows=box.height,
            options=options,
        )
        if isinstance(trace, Failure):
            return None
        template = trace.template()
        if isinstance(template, Failure):
            return None
        light = template.placed(box.width, box.height)
        covered = replace(template, brightness=template.coverage).placed(box.width, box.height) > 1.0 - 1e-9
        return light, self._shaded_otherwise(trace, box), covered

    def _shaded_otherwise(self, trace: Trace, box: FitBox) -> Float | None:
        if not self._other_law:
            return None
        own = trace.body.reflectance
        template = trace.with_reflectance(LommelSeeliger() if isinstance(own, Lambert) else Lambert()).template()
        return None if isinstance(template, Failure) else template.placed(box.width, box.height)


def _filled(outline: Float, box: FitBox) -> Mask:
    """Pixels (h, w) of a box within an outline, none in the border."""
    image = np.zeros((box.height, box.width), np.uint8)
    shift = 4
    corners = np.rint((outline - [box.x, box.y]) * 2**shift).astype(np.int32)
    cv2.fillConvexPoly(image, corners, 1, lineType=cv2.LINE_8, shift=shift)
    mask: Mask = image > 0
    for edge in (slice(None, BORDER_PX), slice(-BORDER_PX, None)):
        mask[edge] = False
        mask[:, edge] = False
    return mask


def rays_for(psf_sigma_px: float) -> int:
    """Rays along each side of a pixel: more where the point spread function is too narrow to smooth their pattern."""
    return 3 if psf_sigma_px < 0.5 else math.ceil(1.4 / max(psf_sigma_px, 0.7))
