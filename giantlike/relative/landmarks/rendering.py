"""Landmarks rendered for one pose of the body: a template of each, with the pixels of its ground."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from giantlike.camera_models.part import divisible
from giantlike.core.arrays import Float, Mask, frozen
from giantlike.core.outcomes import Failure
from giantlike.core.pixel_box import PixelBox
from giantlike.core.values import Value
from giantlike.ray_tracing import Body, FocalPlane, RenderOptions, Template
from giantlike.ray_tracing.cached_trace import Trace, trace_body
from giantlike.ray_tracing.daylight import Daylight
from giantlike.relative.landmarks.visibility import SeenLandmarks
from giantlike.relative.template.moved_body import MovedBody, ShadedRays
from giantlike.relative.template.rendering import contrasting_laws
from giantlike.relative.template.state import TemplateState
from giantlike.shapes.landmarks import Landmark, LandmarkCatalog

BORDER_PX = 3  # border of a patch around the matched pixels, px, for derivatives and the point spread function

_TOGETHER = 3.0  # one render for all, as long as it has no more pixels than this times those of the patches
_LEAST_PIXELS = 40  # px of its own ground: a landmark of less has hardly any texture: see benchmarks/sensitivity.md
_COVERED = 1.0 - 1e-9  # of a pixel: wholly covered, to rounding
_ERODED = np.ones((5, 5), np.uint8)  # px: the point spread function carries in light from outside a map
_OUTLINE_POINTS = 9  # along each side of a landmark; their hull is its outline
_OUTLINE_BITS = 4  # fractional bits of outlines drawn: a sixteenth of a pixel
_MOVED_PX = 1
"""Maximum motion, px, of the body up to which the rays of a pose are reused; as much more ground is traced."""
_REACH_PX, _REACH_SIGMA = 2, 2.5
"""Ground traced around the matched pixels, px (for derivatives) and widths of the point spread function (99 % of its
light at the edge). With 3 px and 3.5 widths eight rocks of 300 px have the same errors and sigmas."""
_TURNED_PX = 0.01
"""Maximum motion, px, of the surface by a change of perspective up to which rays are reused: half of the sigma of a
body of 300 px, with opposite signs on its two sides."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patch(Value):
    """A landmark as rendered."""

    number: int  # number in the catalog
    box: PixelBox  # its pixels in the image
    light: Float  # (h, w); brightness under the law of the target
    other: Float | None  # (h, w); brightness under another law
    mask: Mask  # (h, w); the ground of the landmark; False in a border of :data:`BORDER_PX`
    whole: bool  # True if the ground around it is rendered too

    @property
    def core(self) -> tuple[slice, slice]:
        """Rows and columns within the border."""
        inner = slice(BORDER_PX, -BORDER_PX)
        return inner, inner


@dataclass(frozen=True, slots=True, eq=False)
class _Images(Value):
    """Renders (h, w) of a part of the image: under the law of the body and another one, and pixels wholly covered."""

    light: Float
    other: Float | None
    covered: Mask

    def part(self, slices: tuple[slice, slice]) -> _Images:
        """Return some rows and columns."""
        return _Images(self.light[slices], None if self.other is None else self.other[slices], self.covered[slices])


@dataclass(frozen=True, slots=True, eq=False)
class TracedGround(Value):
    """Part of a shape, traced in one pose; images in nearby poses reuse its rays."""

    body: Body  # as traced
    plane: FocalPlane
    box: PixelBox  # part of the image
    moved: MovedBody
    rays: ShadedRays  # under the law of the body, and another one or none
    lit: Mask  # (columns, rows); cells whose ray ends on a point in sunlight

    def serves(self, body: Body) -> bool:
        """Return True if the rays can be reused for another pose: the same surface in the same perspective."""
        turned = float((body.camera_from_body * self.body.camera_from_body.inv()).magnitude())
        first, second = self.body.position_camera_km, body.position_camera_km
        ranges = float(np.linalg.norm(first)), float(np.linalg.norm(second))
        turned += float(np.linalg.norm(second / ranges[1] - first / ranges[0]))
        radius_px = self.body.shape.circumscribing_radius_km / ranges[0] * self.plane.model.focal_length_px
        shift_px = np.abs(body.center_px(self.plane.model) - self.body.center_px(self.plane.model))
        moved_px = float(shift_px.max()) + abs(math.log(ranges[1] / ranges[0])) * radius_px
        return turned * radius_px < _TURNED_PX and moved_px < _MOVED_PX

    def daylight(self, body: Body, plane: FocalPlane, box: PixelBox) -> Daylight:
        """Lit ground for a finer trace, in a box of an image of another scale."""
        scales = [
            each.model.focal_length_px / float(np.linalg.norm(one.position_camera_km))
            for each, one in ((plane, body), (self.plane, self.body))
        ]
        return Daylight(
            cells=self.moved.trace.cells,
            lit=self.lit,
            center_px=body.center_px(plane.model) - box.corner_px,
            traced_center_px=self.moved.state.center_px,
            scale=scales[0] / scales[1],
            whole=False,
        )

    def images(self, body: Body, box: PixelBox) -> _Images:
        """Renders of a box for a pose that the rays serve for."""
        inside = replace(box, x=box.x - self.box.x, y=box.y - self.box.y)
        lights, _ = self.moved.lights(inside, _state(body, self.body, self.plane, self.box), self.rays)
        other = lights[1] if len(lights) > 1 else None
        return _Images(lights[0], other, np.ones(lights[0].shape, bool))


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkRenderer(Value):
    """Renders landmarks of a target.

    Landmarks taken from the shape of the target are cut from a render of that shape, with all shadows cast by other
    ground. Other landmarks are rendered from their own maps, one by one.
    """

    catalog: LandmarkCatalog
    plane: FocalPlane  # with a camera model that can be cut to a window of its image
    sun_direction_camera: Float  # unit vector from body to Sun
    max_size_px: float  # only the middle of larger landmarks is rendered
    rays_per_pixel_side: int
    other_law: bool  # True to render under another reflectance law as well
    surroundings: bool = False  # True to render the ground around landmarks too, where it belongs to the shape

    def roughly(self) -> LandmarkRenderer:
        """Return one with one ray to a pixel, one law and all of the ground around: enough to find landmarks."""
        return replace(self, rays_per_pixel_side=1, other_law=False, surroundings=True)

    def patches(
        self,
        body: Body,
        seen: SeenLandmarks,
        traced: TracedGround | None = None,
        rough: TracedGround | None = None,
    ) -> tuple[tuple[Patch, ...], TracedGround | None]:
        """Render the landmarks seen."""
        landmarks = [self.catalog.landmarks[number] for number in seen.numbers]
        outlines = [self._outline(body, landmark) for landmark in landmarks]
        boxes = [self._box(outline, center) for outline, center in zip(outlines, seen.predicted_px, strict=True)]
        masks = [_fill_outline(outline, box) for outline, box in zip(outlines, boxes, strict=True)]
        own_shape = self.catalog.shape_sha256 == body.shape.sha256
        rendered: list[_Images | None]
        if own_shape:
            grounds = [np.ones_like(mask) for mask in masks] if self.surroundings else masks
            rendered, traced = self._together(body, boxes, grounds, traced, rough)
        else:
            pairs = zip(landmarks, boxes, strict=True)
            rendered = [self._images(replace(body, shape=landmark.mesh), box) for landmark, box in pairs]
        patches = []
        for number, mask, box, images in zip(seen.numbers, masks, boxes, rendered, strict=True):
            if images is None:
                continue
            if not own_shape:
                mask &= cv2.erode(images.covered.astype(np.uint8), _ERODED) > 0
            if int(mask.sum()) >= _LEAST_PIXELS:
                patch = Patch(
                    number=int(number),
                    box=box,
                    light=images.light,
                    other=images.other,
                    mask=mask,
                    whole=own_shape and self.surroundings,
                )
                patches.append(patch)
        return tuple(patches), traced

    def _outline(self, body: Body, landmark: Landmark) -> Float:
        """Pixels (k, 2) whose hull is the ground of a landmark."""
        ground = _outline_body_km(landmark)
        pixels = self.plane.model.project(body.to_camera(ground) + body.position_camera_km)
        finite = pixels[np.isfinite(pixels).all(axis=1)].astype(np.float32)
        return cv2.convexHull(finite)[:, 0].astype(np.float64)

    def _box(self, outline: Float, center_px: Float) -> PixelBox:
        """Box around an outline, at most the largest size around its middle, plus a border."""
        half = 0.5 * self.max_size_px
        low, high = np.maximum(outline.min(axis=0), center_px - half), np.minimum(outline.max(axis=0), center_px + half)
        return PixelBox.spanning(low, high + 1.0, BORDER_PX)

    def _together(
        self,
        body: Body,
        boxes: list[PixelBox],
        grounds: list[Mask],
        traced: TracedGround | None,
        rough: TracedGround | None,
    ) -> tuple[list[_Images | None], TracedGround | None]:
        """Images of the shape on some ground in boxes: out of one render of all, where they lie close together."""
        if not boxes:
            return [], traced
        corners = np.array([box.corner_px for box in boxes])
        sizes = np.array([(box.width, box.height) for box in boxes])
        whole = PixelBox.spanning(corners.min(axis=0), (corners + sizes).max(axis=0))
        if whole.width * whole.height > _TOGETHER * sizes.prod(axis=1).sum():
            return [self._images(body, box) for box in boxes], None
        if traced is None or not traced.serves(body):
            traced = self._ground(body, whole, boxes, grounds, rough)
        if traced is None:
            return [None] * len(boxes), None
        images = traced.images(body, whole)
        return [images.part(replace(box, x=box.x - whole.x, y=box.y - whole.y).slices) for box in boxes], traced

    def _ground(
        self, body: Body, whole: PixelBox, boxes: list[PixelBox], grounds: list[Mask], rough: TracedGround | None
    ) -> TracedGround | None:
        """The body traced on some ground in boxes, and a little around it; None where nothing of it is lit."""
        reach = _REACH_PX + math.ceil(_REACH_SIGMA * self.plane.psf_sigma_px) + _MOVED_PX
        box = PixelBox(
            x=whole.x - reach, y=whole.y - reach, width=whole.width + 2 * reach, height=whole.height + 2 * reach
        )
        wanted = np.zeros((box.height, box.width), np.uint8)
        for each, ground in zip(boxes, grounds, strict=True):
            wanted[replace(each, x=each.x - box.x, y=each.y - box.y).slices] |= ground
        around = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
        daylight = None if rough is None else rough.daylight(body, self.plane, box)
        trace = self._trace(body, box, cv2.dilate(wanted, around) > 0, daylight)
        if isinstance(trace, Failure) or not trace.lit:
            return None
        moved = MovedBody(trace=trace, state=_state(body, body, self.plane, box))
        laws = (body.reflectance, *contrasting_laws(body.reflectance)[: int(self.other_law)])
        return TracedGround(body, self.plane, box, moved, moved.shade(laws), trace.lit_cells)

    def _trace(
        self, body: Body, box: PixelBox, wanted: Mask | None = None, daylight: Daylight | None = None
    ) -> Trace | Failure:
        """The body traced in a box, or in some of its pixels."""
        return trace_body(
            body,
            divisible(self.plane.model).windowed(box.x, box.y),
            sun_direction_camera=self.sun_direction_camera,
            psf=self.plane.psf,
            columns=box.width,
            rows=box.height,
            options=RenderOptions(rays_per_pixel_side=self.rays_per_pixel_side, min_rays_across=1),
            wanted=wanted,
            daylight=daylight,
        )

    def _images(self, body: Body, box: PixelBox) -> _Images | None:
        """Renders of a body in a box; None where nothing of it is lit."""
        trace = self._trace(body, box)
        template = trace if isinstance(trace, Failure) else trace.template()
        if isinstance(trace, Failure) or isinstance(template, Failure):
            return None
        coverage = replace(template, brightness=template.coverage).placed(box.width, box.height)
        other = trace.with_reflectance(contrasting_laws(body.reflectance)[0]).template() if self.other_law else None
        return _Images(
            light=template.placed(box.width, box.height),
            other=other.placed(box.width, box.height) if isinstance(other, Template) else None,
            covered=coverage > _COVERED,
        )


def _state(body: Body, reference: Body, plane: FocalPlane, box: PixelBox) -> TemplateState:
    """Geometry of a body in the pixels of a box, its range over that of a reference."""
    own_km, reference_km = (float(np.linalg.norm(each.position_camera_km)) for each in (body, reference))
    return TemplateState(
        center_px=body.center_px(plane.model) - box.corner_px,
        log_range=math.log(own_km / reference_km),
        psf_variance_px2=plane.psf_sigma_px**2,
    )


@lru_cache(maxsize=4096)
def _outline_body_km(landmark: Landmark) -> Float:
    """Points (k, 3) of a landmark whose hull is its outline, km, body axes."""
    return frozen(landmark.grid_body_km(_OUTLINE_POINTS))


def _fill_outline(outline: Float, box: PixelBox) -> Mask:
    """Pixels (h, w) of a box within an outline, none in the border."""
    image = np.zeros((box.height, box.width), np.uint8)
    corners = np.rint((outline - box.corner_px) * 2**_OUTLINE_BITS).astype(np.int32)
    cv2.fillConvexPoly(image, corners, 1, lineType=cv2.LINE_8, shift=_OUTLINE_BITS)
    mask = np.zeros(image.shape, dtype=bool)
    inner = slice(BORDER_PX, -BORDER_PX)
    mask[inner, inner] = image[inner, inner] > 0
    return mask


def rays_for(psf_sigma_px: float) -> int:
    """Rays along each side of a pixel: more where the point spread function is too narrow to smooth their pattern."""
    return 3 if psf_sigma_px < 0.5 else math.ceil(1.4 / max(psf_sigma_px, 0.7))
