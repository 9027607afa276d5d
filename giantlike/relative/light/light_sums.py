"""Sums over the light of a body: compiled."""

from __future__ import annotations

import numpy as np

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float


@compiled
def kept_center(signal_dn: Float, threshold_dn: float, width: float) -> tuple[float, float, float]:
    """Center of the light that counts, as by ``separation.kept_light``.

    ``signal_dn`` (h, w); returns ``x``, ``y`` in px, not finite where no light counts; ``total_dn``.
    """
    lowest, scale = (1.0 - 0.5 * width) * threshold_dn, 1.0 / (width * threshold_dn)
    total, along, down = 0.0, 0.0, 0.0
    for row in range(signal_dn.shape[0]):
        by_row, by_column = 0.0, 0.0
        for column in range(signal_dn.shape[1]):
            signal = signal_dn[row, column]
            if signal > lowest:
                light = signal * min((signal - lowest) * scale, 1.0)
                by_row += light
                by_column += light * column
        total += by_row
        along += by_column
        down += by_row * row
    return along / total, down / total, total


@compiled
def mix_laws(own: Float, changes: Float, shares: Float) -> Float:
    """Light (h, w) of one law (h, w) and shares (k,) of changes (k, h, w), none below 0."""
    rows, columns = own.shape
    result = np.empty((rows, columns))
    for row in range(rows):
        line = result[row]
        for column in range(columns):
            line[column] = own[row, column]
        for number in range(len(shares)):
            share, change = shares[number], changes[number, row]
            for column in range(columns):
                line[column] += share * change[column]
        for column in range(columns):
            line[column] = max(line[column], 0.0)
    return result
