"""A wide body on means over blocks of pixels: as much of its light, at a cost that does not grow with its area."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from giantlike.core.arrays import Float, Mask
from giantlike.core.blocks import block_sums, whole_blocks
from giantlike.core.detector import UNKNOWN_PSF_SIGMA_PX, GaussianPsf
from giantlike.core.outcomes import CenterFix
from giantlike.relative.inputs import EstimatorInputs

_LEAST_GOOD = 0.5  # share of the pixels of a block that are not bad, of which its mean is taken; with fewer it is bad


def average_blocks(inputs: EstimatorInputs, size: int) -> EstimatorInputs:
    """Return the inputs on means over blocks of pixels."""
    camera, psf = inputs.camera, inputs.camera.psf
    width_px = UNKNOWN_PSF_SIGMA_PX if psf is None else psf.sigma_px
    values, masked = _means(inputs.pixels_dn, inputs.masked, size)
    saturated = whole_blocks(inputs.saturated | inputs.masked, size) & ~masked
    return replace(
        inputs,
        camera=replace(
            camera.binned(size, detector=camera.detector.averaged(size)), psf=GaussianPsf(sigma_px=width_px / size)
        ),
        predicted_px=(inputs.predicted_px - 0.5 * (size - 1)) / size,
        pixels_dn=values,
        usable=~(masked | saturated),
        saturated=saturated,
        masked=masked,
    )


def on_pixels(fix: CenterFix, inputs: EstimatorInputs, size: int) -> CenterFix:
    """Return a fix to means over blocks in pixels."""
    half = 0.5 * (size - 1)
    used = np.zeros([-(-length // size) for length in inputs.masked.shape], bool)
    columns, rows = fix.residuals_at_px.astype(np.int64).T
    used[rows, columns] = True
    whole = used.repeat(size, axis=0).repeat(size, axis=1)[: inputs.masked.shape[0], : inputs.masked.shape[1]]
    return replace(
        fix,
        center_px=size * fix.center_px + half,
        predicted_px=inputs.predicted_px,
        covariance_px2=size**2 * fix.covariance_px2,
        parts={cause: size**2 * part for cause, part in fix.parts.items()},
        residuals_at_px=size * fix.residuals_at_px + half,
        flags=fix.flags | inputs.flags_at(whole),
    )


def _means(values_dn: Float, masked: Mask, size: int) -> tuple[Float, Mask]:
    """Means of the good pixels of blocks, and the blocks that are bad."""
    if not masked.any():
        sums = block_sums(values_dn, size)
        return sums / size**2, np.zeros(sums.shape, bool)
    good = block_sums(~masked, size)
    return block_sums(np.where(masked, 0.0, values_dn), size) / np.maximum(good, 1.0), good < _LEAST_GOOD * size**2
