"""Boxes of whole pixels in an image, which may reach over its edges, and the pixels in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from giantlike.core.arrays import Float, Mask, Scalar
from giantlike.core.values import Value


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelBox:
    """A box of pixels; it may reach over the edges of the image."""

    x: int  # x, y: in px; column and row of its first pixel
    y: int
    width: int
    height: int

    @classmethod
    def spanning(cls, low_px: Float, high_px: Float, margin_px: int = 0) -> PixelBox:
        """Return the box from a first pixel (2,) to the one after the last, rounded outward, and a margin around it."""
        low = np.floor(low_px).astype(np.int64) - margin_px
        (x, y), (width, height) = low.tolist(), (np.ceil(high_px).astype(np.int64) + margin_px - low).tolist()
        return cls(x=x, y=y, width=width, height=height)

    def clip(self, columns: int, rows: int, border_px: int = 0) -> PixelBox:
        """Return the part of the box within a frame."""
        end = np.array([columns, rows]) + border_px
        corner = np.array([self.x, self.y])
        low = np.clip(corner, -border_px, end - 1)
        high = np.clip(corner + np.array([self.width, self.height]), low + 1, end)
        return PixelBox.spanning(low, high)

    @property
    def corner_px(self) -> tuple[int, int]:
        """Column and row of the first pixel."""
        return self.x, self.y

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of the image, for a box that lies in it."""
        return slice(self.y, self.y + self.height), slice(self.x, self.x + self.width)

    def cut(self, image: NDArray[Scalar], corner_px: tuple[int, int] = (0, 0), outside: Any = 0) -> NDArray[Scalar]:
        """Cut the box (height, width) out of an image (h, w) whose first element is at column, row ``corner_px``."""
        part = np.full((self.height, self.width), outside, dtype=image.dtype)
        x, y = self.x - int(corner_px[0]), self.y - int(corner_px[1])
        y0, y1 = max(y, 0), min(y + self.height, image.shape[0])
        x0, x1 = max(x, 0), min(x + self.width, image.shape[1])
        if x0 < x1 and y0 < y1:
            part[y0 - y : y1 - y, x0 - x : x1 - x] = image[y0:y1, x0:x1]
        return part


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoxPixels(Value):
    """Pixels of an image or a box of it, and their noise."""

    values_dn: Float  # (h, w); bias subtracted
    usable: Mask  # (h, w); neither bad nor saturated
    censored: Mask | None = None  # (h, w); saturated and not bad: at least as bright as the value. None without any
    corner_px: tuple[int, int] = (0, 0)  # column and row of the first element in the image
    noise_variance_dn2: Callable[[Float], Float]  # DN^2, by the signal of the body, DN

    def cut(self, box: PixelBox) -> BoxPixels:
        """Return the pixels in a box; those outside are not usable."""
        return replace(
            self,
            values_dn=box.cut(self.values_dn, self.corner_px),
            usable=box.cut(self.usable, self.corner_px),
            censored=None if self.censored is None else box.cut(self.censored, self.corner_px),
            corner_px=box.corner_px,
        )
