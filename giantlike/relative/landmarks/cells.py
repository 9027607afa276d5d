"""The inputs of an estimator in coarse cells of the image."""

from __future__ import annotations

from dataclasses import replace

from giantlike.core.blocks import block_sums, whole_blocks
from giantlike.relative.inputs import EstimatorInputs


def in_cells(inputs: EstimatorInputs, size_px: int) -> EstimatorInputs:
    """Average the image of an estimator over cells."""
    usable, good = (whole_blocks(mask, size_px) for mask in (inputs.usable, ~inputs.masked))
    return replace(
        inputs,
        camera=inputs.camera.binned(size_px, detector=inputs.camera.detector),
        predicted_px=(inputs.predicted_px - 0.5 * (size_px - 1)) / size_px,
        pixels_dn=block_sums(inputs.pixels_dn, size_px) / size_px**2,
        usable=usable,
        saturated=good & ~usable,
        masked=~good,
    )
