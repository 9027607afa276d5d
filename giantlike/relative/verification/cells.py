"""The image around a body in cells, and the body rendered into them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from giantlike.camera import Camera
from giantlike.core.arrays import Float, Mask, Scalar
from giantlike.core.blocks import block_sums
from giantlike.core.outcomes import Failure
from giantlike.core.pixel_box import PixelBox
from giantlike.core.values import Value
from giantlike.ray_tracing import Body, RenderOptions, Template
from giantlike.ray_tracing.cached_trace import Trace, trace_body
from giantlike.shapes import Ellipsoid

CELLS_PER_RADIUS = 20
"""Cells to a radius of the body, as far as pixels are not larger: two exposures 5 px apart on a body of 140 px show as
a blur, with 12 cells they do not."""
MARGIN = 1.6  # half width of the region, largest radii: margin for a second body or a halo next to the first
BLOCK = 0.25
"""Size, radii, of the parts of a disk with correlated departures from a model: markings, errors of the law, as in
``relative/light/moment.py``. Their number, not that of pixels, sets the significance of a better match."""
LEAST_RADIUS_PX = 5.0  # radius, px, below which the point spread function hides the disk interior
_PSF_REACH = 3.0  # standard deviations of the point spread function that the region has around a body
_RAYS_PER_CELL = 3
"""Rays along the side of a cell: a body at 125 deg of phase is then placed right to 0.2 % of the radius; with two rays
to a cell of 8 % of the radius it was off by 1.4 %."""
_ACROSS = 1.6
"""Rays across the narrow side of a body, at least, over those across a radius of the usual number of cells."""
_RAYS_ACROSS_POINT = 32
"""Rays across a body without a face, which is only looked for elsewhere: its light is then right to 1 %."""
_MOST_CELLS = 240
"""Most cells along the side of the region: a body much larger than its mean radius says gets larger cells."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cells(Value):
    """The image around a body in cells, with room for shifts of the body."""

    values: Float  # (n, n) DN; means over the good pixels of each cell, bias subtracted
    variance: Float  # (n, n) DN^2; of their noise
    good: Mask  # (n, n); at least half of the pixels are good
    fresh: Mask  # (n, n); good, and no pixel is saturated
    camera: Camera  # of an image whose pixels are the cells
    box: PixelBox  # of the cells, in the pixels of that image
    room: int  # cells around :attr:`inner` that are there for shifts
    radius: float  # mean radius of the body, cells
    size: int  # in px; pixels along the side of a cell
    center_px: Float  # center of the body in the image

    @property
    def has_face(self) -> bool:
        """True if the body is large enough to show its disk interior."""
        return self.radius * self.size >= LEAST_RADIUS_PX

    @property
    def blur(self) -> float:
        """Standard deviation of the point spread function, cells."""
        return 0.0 if self.camera.psf is None else self.camera.psf.sigma_px

    @property
    def inner(self) -> PixelBox:
        """The box without the room for shifts."""
        side = self.box.width - 2 * self.room
        return PixelBox(x=self.box.x + self.room, y=self.box.y + self.room, width=side, height=side)

    def sights(self) -> Float:
        """Lines of sight (n, n, 3) through the middles of the cells, camera axes."""
        rows, columns = np.mgrid[: self.box.height, : self.box.width]
        middles = np.stack([columns + self.box.x, rows + self.box.y], axis=-1).astype(np.float64)
        return self.camera.model.unproject(middles)

    def crop(self, values: NDArray[Scalar]) -> NDArray[Scalar]:
        """Return the part in :attr:`inner` of an array (n, n) of the whole region."""
        within = slice(self.room, self.box.width - self.room)
        return values[within, within]

    def trace(self, body: Body, sun_direction_camera: Float) -> Trace | None:
        """Trace a body for renders into the cells.

        Rays to the Sun start where one ray in the middle of each cell around meets a shadow; where none does, lone
        shadows less than a cell wide are lost.

        Returns None where nothing of it is seen.
        """
        camera = self.camera
        shadows_later = self.has_face and not isinstance(body.shape, Ellipsoid)
        across = math.ceil(_ACROSS * _RAYS_PER_CELL * CELLS_PER_RADIUS) if self.has_face else _RAYS_ACROSS_POINT
        traced = trace_body(
            body,
            camera.model,
            sun_direction_camera=sun_direction_camera,
            psf=camera.psf,
            columns=camera.columns,
            rows=camera.rows,
            options=RenderOptions(
                rays_per_pixel_side=_RAYS_PER_CELL,
                min_rays_across=across,
                margin_px=self.box.width,
                shadows=not shadows_later,
            ),
        )
        if isinstance(traced, Failure):
            return None
        if not shadows_later:
            return traced
        return traced.with_shadows(traced.one_to_a_pixel().with_shadows().daylight())

    def render(self, trace: Trace) -> Template | None:
        """Shade a trace; None where nothing that is seen is lit."""
        template = trace.template()
        return template if isinstance(template, Template) else None

    def place(self, values: Float, template: Template) -> Float:
        """Cut :attr:`inner` out of an array of a template."""
        x, y = template.corner_px.tolist()
        return self.inner.cut(values, (x, y))

    def light(self, trace: Trace) -> Float:
        """Brightness in :attr:`inner` of a trace, as that of its template and without what else is in one."""
        across, down = trace.footprint.spread
        columns = across.apply(trace.cell_brightness(trace.body.reflectance))
        x, y = trace.footprint.corner_px.tolist()
        return self.inner.cut(down.apply(columns.T), (x, y))


def cells_around(
    pixels_dn: Float,
    good: Mask,
    saturated: Mask,
    camera: Camera,
    body: Body,
    *,
    room_px: float | None = 0.0,
    per_radius: int = CELLS_PER_RADIUS,
) -> Cells | None:
    """Average blocks of pixels around a body.

    ``pixels_dn`` (rows, columns); returns None where the image is smaller than two cells, or the camera model images
    nothing there.
    """
    center_px = body.center_px(camera.model)
    if not np.isfinite(center_px).all():
        return None
    inside = np.clip(center_px, -0.5, [camera.columns - 0.5, camera.rows - 0.5])
    px_per_km = 1.0 / float(np.linalg.norm(body.position_camera_km)) / float(camera.ifov_rad(inside))
    radius_px = body.shape.mean_radius_km * px_per_km
    blur_px = 0.0 if camera.psf is None else camera.psf.sigma_px
    reach_px = MARGIN * body.shape.circumscribing_radius_km * px_per_km + _PSF_REACH * blur_px
    room_px = 0.0 if room_px is None else max(room_px, radius_px)
    size = max(1, round(radius_px / per_radius), math.ceil(2.0 * (reach_px + room_px) / _MOST_CELLS))
    if min(good.shape) < 2 * size:
        return None
    room = math.ceil(room_px / size)
    half = math.ceil(reach_px / size) + room
    binned = camera.binned(size, detector=camera.detector)
    x, y = np.rint(body.center_px(binned.model)).astype(int).tolist()
    box = PixelBox(x=x - half, y=y - half, width=2 * half + 1, height=2 * half + 1)
    pixels = PixelBox(x=box.x * size, y=box.y * size, width=box.width * size, height=box.height * size)
    counts, sums, clipped = _sums(pixels, pixels_dn, good, saturated, size)
    values = sums / np.maximum(counts, 1.0)
    enough = np.asarray(counts >= 0.5 * size**2)
    return Cells(
        values=values,
        variance=camera.detector.variance_dn2(values) / np.maximum(counts, 1.0),
        good=enough,
        fresh=enough & (clipped == 0.0),
        camera=binned,
        box=box,
        room=room,
        radius=radius_px / size,
        size=size,
        center_px=center_px,
    )


def _sums(pixels: PixelBox, pixels_dn: Float, good: Mask, saturated: Mask, size: int) -> tuple[Float, Float, Float]:
    """Number of good pixels, sum of their values and number of clipped pixels in the blocks of a box of whole blocks.

    Only the part of the box in the frame is read, and no mask beyond whether it masks anything.
    """
    rows, columns = good.shape
    x, y = max(pixels.x, 0), max(pixels.y, 0)
    width, height = min(pixels.x + pixels.width, columns) - x, min(pixels.y + pixels.height, rows) - y
    sums = np.zeros((3, pixels.height // size, pixels.width // size))
    if width <= 0 or height <= 0:
        return sums[0], sums[1], sums[2]
    read = PixelBox(x=x, y=y, width=-(-width // size) * size, height=-(-height // size) * size)
    whole = read.width == width and read.height == height
    values, usable, clipped = (
        pixels_dn[read.slices] if whole else read.cut(pixels_dn),
        good[read.slices] if whole else read.cut(good),
        saturated[read.slices] if whole else read.cut(saturated),
    )
    first, left = (y - pixels.y) // size, (x - pixels.x) // size
    part = sums[:, first : first + read.height // size, left : left + read.width // size]
    if usable.all():
        part[0], part[1] = size**2, block_sums(values, size)
    else:
        part[0], part[1] = block_sums(usable, size), block_sums(np.where(usable, values, 0.0), size)
    if clipped.any():
        part[2] = block_sums(clipped, size)
    return sums[0], sums[1], sums[2]
