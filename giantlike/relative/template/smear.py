"""Images smeared along one direction: a camera that turned, or a body that moved, while the shutter was open."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.outcomes import Failure
from giantlike.core.values import Value
from giantlike.relative.template.state import Synthesis, TemplateImages, TemplateState

SMEAR = "smear"
"""Key of the provenance of fixes by a template that was smeared."""
_STEP = 0.05
"""Relative step of numerical derivatives by the variances: beyond a tenth the fall of light along a line bends."""
_ROOM_PX = 4
"""Pixels around an image that a smear is applied to, beside its own length, so that its ends do not meet."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Smear(Value):
    """A motion of even speed during the exposure, by what it adds to the blur of an image.

    Parameters
    ----------
    straight_px2, oblique_px2 : float, px^2
        Half of the variance along x less that along y, and the covariance of x and y: with what is even in all
        directions they are the variance of a line.

    Examples
    --------
    By 3 px along x and 4 px along y:

    >>> smear = Smear(straight_px2=(3**2 - 4**2) / 24, oblique_px2=3 * 4 / 12)
    >>> round(smear.length_px, 12), [round(along, 12) for along in smear.direction]
    (5.0, [0.6, 0.8])
    """

    straight_px2: float = 0.0
    oblique_px2: float = 0.0

    @classmethod
    def from_text(cls, text: str) -> Smear:
        """Read what ``str`` writes, as the provenance of a fix holds it.

        Parameters
        ----------
        text : str

        Returns
        -------
        Smear
        """
        straight_px2, oblique_px2 = (float(part.partition("=")[2]) for part in text.split())
        return cls(straight_px2=straight_px2, oblique_px2=oblique_px2)

    def __str__(self) -> str:
        return f"straight_px2={self.straight_px2:.4g} oblique_px2={self.oblique_px2:.4g}"

    def on_blocks(self, size: float) -> Smear:
        """Return the same motion in an image of blocks of pixels.

        Parameters
        ----------
        size : float
            Pixels along the side of a block.

        Returns
        -------
        Smear
        """
        return Smear(straight_px2=self.straight_px2 / size**2, oblique_px2=self.oblique_px2 / size**2)

    def less(self, other: Smear) -> Smear:
        """Return the difference to another smear."""
        return Smear(
            straight_px2=self.straight_px2 - other.straight_px2, oblique_px2=self.oblique_px2 - other.oblique_px2
        )

    @property
    def size_px2(self) -> float:
        """Half of the variance along the motion, px^2."""
        return math.hypot(self.straight_px2, self.oblique_px2)

    @property
    def length_px(self) -> float:
        """Length of the motion, px."""
        return math.sqrt(24.0 * self.size_px2)

    @property
    def direction(self) -> tuple[float, float]:
        """Unit vector along the motion."""
        angle = 0.5 * math.atan2(self.oblique_px2, self.straight_px2)
        return math.cos(angle), math.sin(angle)

    @property
    def blur_px2(self) -> Float:
        """What it adds to the variance of the point spread function, (3,): xx, xy and yy, px^2."""
        even = self.size_px2
        return np.array([even + self.straight_px2, self.oblique_px2, even - self.straight_px2])

    def smeared(self, images: Float) -> Float:
        """Return images smeared by the motion; what lies beyond them is as bright as their edge.

        Parameters
        ----------
        images : (..., h, w) float64

        Returns
        -------
        (..., h, w) float64
        """
        from scipy.fft import irfft2, next_fast_len, rfft2

        room = _ROOM_PX + math.ceil(self.length_px)
        height, width = images.shape[-2:]
        size = [next_fast_len(each + 2 * room, real=True) for each in (height, width)]
        ends = [(room, total - each - room) for each, total in zip((height, width), size, strict=True)]
        padded = np.pad(images, [*[(0, 0)] * (images.ndim - 2), *ends], mode="edge")
        x, y = self.direction
        along = np.fft.rfftfreq(size[1]) * x + np.fft.fftfreq(size[0])[:, None] * y
        spread = irfft2(rfft2(padded) * np.sinc(self.length_px * along), s=size)
        return np.asarray(spread[..., room : room + height, room : room + width], dtype=np.float64)

    def _changes(self, image: Float) -> Float:
        """Derivatives (2, h, w) of an image (h, w), smeared, by both variances, from central differences."""
        step = _STEP * max(self.size_px2, _STEP)
        high_x, low_x, high_y, low_y = (
            replace(self, straight_px2=self.straight_px2 + x, oblique_px2=self.oblique_px2 + y).smeared(image)
            for x, y in ((step, 0.0), (-step, 0.0), (0.0, step), (0.0, -step))
        )
        return np.stack([high_x - low_x, high_y - low_y]) / (2.0 * step)

    def of_renders(self, synthesize: Synthesis) -> Synthesis:
        """Return a function that renders a body smeared.

        Parameters
        ----------
        synthesize : callable

        Returns
        -------
        callable
        """

        def images(state: TemplateState, fine: bool) -> TemplateImages | Failure:
            made = synthesize(state, fine)
            if isinstance(made, Failure):
                return made
            seen = [made.light, *made.others, *([] if made.untried is None else [made.untried])]
            light, *rest = self.smeared(np.stack(seen))
            others, last = rest[: len(made.others)], rest[len(made.others) :]
            sharp, veiled = made.derivatives, made.veiled
            return replace(
                made,
                light=light,
                others=others,
                untried=last[0] if last else None,
                veiled=None if veiled is None else lambda: self.smeared(veiled()),
                derivatives=None if sharp is None else lambda weights: self.smeared(sharp(weights)),
                by_smear=self._changes(made.light),
            )

        return images
