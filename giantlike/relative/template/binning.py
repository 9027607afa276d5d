"""Pixels of an image averaged over blocks: a wide body is found and fitted in fewer of them, at the same accuracy."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from giantlike.core.arrays import Mask
from giantlike.core.blocks import block_sums, whole_blocks
from giantlike.core.pixel_box import BoxPixels
from giantlike.core.values import Value
from giantlike.ray_tracing import FocalPlane
from giantlike.relative.inputs import EstimatorInputs
from giantlike.relative.template.fit import TemplateFit

_DIAMETER_PX = 62.5
"""Diameter over the square of the size of a block, px: the work so grows with the limb and not with the area. Blocks of
2 px for a body of 300 px and of 4 px for one of 1,000 px leave the errors of rocks as they are; twice these sizes widen
them by a fifth. What noise alone allows on a body without any error of its model is wider by a tenth with blocks of 2
px where the point spread function is 0.7 px wide, and by a third with 4 px."""
_MOST_LOST = 0.2
"""Share of the good pixels that may fall into blocks with bad ones; smaller blocks are taken where it would be more."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Blocks(Value):
    """An image averaged over blocks of pixels."""

    size: int  # in px; pixels along the side of a block
    pixels: BoxPixels  # blocks are usable where all of their pixels are, and lower limits where one is and none is bad
    good: Mask  # blocks without bad pixels
    plane: FocalPlane  # of the blocks

    def unbin(self, fit: TemplateFit) -> TemplateFit:
        """Return a fit to blocks with its state and covariance in pixels; its images stay as they are."""
        state, scale = fit.state, np.diag([self.size, self.size, 1.0])
        native = replace(
            state,
            center_px=self.size * state.center_px + 0.5 * (self.size - 1),
            psf_variance_px2=self.size**2 * state.psf_variance_px2,
        )
        parts = {cause: scale @ part @ scale for cause, part in fit.parts.items()}
        return replace(fit, state=native, parts=parts)

    def area(self, blocks: Mask, shape: tuple[int, ...]) -> Mask:
        """Return the pixels, in an image of a shape, of the True ones of all blocks (rows, columns)."""
        result = np.zeros(shape, bool)
        whole = blocks.repeat(self.size, axis=0).repeat(self.size, axis=1)
        result[: whole.shape[0], : whole.shape[1]] = whole
        return result


def make_blocks(inputs: EstimatorInputs) -> Blocks:
    """Average the image of an estimator over blocks as large as the body allows."""
    wanted = max(round(math.sqrt(2.0 * inputs.radius_px / _DIAMETER_PX)), 1)
    sound = float(np.count_nonzero(inputs.usable))
    for size in range(min(wanted, *inputs.usable.shape), 1, -1):
        usable = whole_blocks(inputs.usable, size)
        if size**2 * np.count_nonzero(usable) >= (1.0 - _MOST_LOST) * sound:
            return _blocks(inputs, size, usable)
    return Blocks(size=1, pixels=inputs.pixels, good=~inputs.masked, plane=inputs.focal_plane())


def _blocks(inputs: EstimatorInputs, size: int, usable: Mask) -> Blocks:
    whole, good = inputs.pixels, whole_blocks(~inputs.masked, size)
    camera = inputs.camera.binned(size, detector=inputs.camera.detector)
    noise = whole.noise_variance_dn2
    limits = None if whole.censored is None else good & ~usable
    psf = inputs.focal_plane().psf
    return Blocks(
        size=size,
        pixels=BoxPixels(
            values_dn=block_sums(whole.values_dn, size) / size**2,
            usable=usable,
            censored=limits,
            noise_variance_dn2=lambda signal: noise(signal) / size**2,
        ),
        good=good,
        plane=FocalPlane(
            model=camera.model,
            columns=camera.columns,
            rows=camera.rows,
            psf=None if psf is None else replace(psf, sigma_px=psf.sigma_px / size),
        ),
    )
