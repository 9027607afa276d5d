"""Normal equations of the fit of a patch: compiled."""

from __future__ import annotations

import numpy as np

from giantlike._system.compiled import compiled
from giantlike.core.arrays import Float, Mask

SHARED = 4
"""Images of the model beside that under another law: the light, the same with slopes along x and y, and a constant."""


@compiled
def pixels_of(image: Float, used: Mask, light: Float, other: Float) -> Float:
    """Values of some pixels that their model needs, side by side.

    ``image`` (h, w) DN; ``used``, ``light``, ``other`` (h, w); returns (n, 11).
    """
    count, middle_x, middle_y = 0, 0.0, 0.0
    rows, columns = used.shape
    for row in range(2, rows - 2):
        for column in range(2, columns - 2):
            if used[row, column]:
                count += 1
                middle_x += column
                middle_y += row
    result = np.empty((count, 11))
    middle_x, middle_y, number = middle_x / count, middle_y / count, 0
    for row in range(2, rows - 2):
        for column in range(2, columns - 2):
            if not used[row, column]:
                continue
            near = light[row, column - 1], light[row, column + 1], light[row - 1, column], light[row + 1, column]
            far = light[row, column - 2], light[row, column + 2], light[row - 2, column], light[row + 2, column]
            one = result[number]
            number += 1
            one[0], one[1], one[2] = image[row, column], column - middle_x, row - middle_y
            one[3] = light[row, column]
            one[4] = (8.0 * (near[1] - near[0]) - (far[1] - far[0])) / 12.0
            one[5] = (8.0 * (near[3] - near[2]) - (far[3] - far[2])) / 12.0
            one[6] = (8.0 * (near[1] + near[0]) - 2.0 * (far[1] + far[0])) / 12.0
            one[7] = (8.0 * (near[3] + near[2]) - 2.0 * (far[3] + far[2])) / 12.0
            one[8] = other[row, column]
            step, wide = (
                other[row, column + 1] - other[row, column - 1],
                other[row, column + 2] - other[row, column - 2],
            )
            one[9] = (8.0 * step - wide) / 12.0
            step, wide = (
                other[row + 1, column] - other[row - 1, column],
                other[row + 2, column] - other[row - 2, column],
            )
            one[10] = (8.0 * step - wide) / 12.0
    return result


@compiled
def normal_equations(pixels: Float, gains: Float, noise: Float) -> tuple[Float, Float]:
    """Sums of the linear fit of a patch, moved by a little, to pixels.

    ``pixels`` (n, 11), from :func:`pixels_of`; ``gains`` (k,); ``noise`` (n,); returns ``matrix`` (2 + k, 2 + k) and
    ``right`` (2 + k,).
    """
    count = 2 + gains.size
    matrix, right, terms = np.zeros((count, count)), np.zeros(count), np.empty(count)
    for number in range(len(pixels)):
        one = pixels[number]
        gain = gains[0] + gains[1] * one[1] + gains[2] * one[2]
        terms[0], terms[1] = -gain * one[4] - gains[1] * one[6], -gain * one[5] - gains[2] * one[7]
        terms[2], terms[3], terms[4], terms[5] = one[3], one[1] * one[3], one[2] * one[3], 1.0
        if count > 6:
            terms[0] -= gains[4] * one[9]
            terms[1] -= gains[4] * one[10]
            terms[6] = one[8]
        for i in range(count):
            weighted = terms[i] / noise[number]
            right[i] += weighted * one[0]
            for j in range(i + 1):
                matrix[i, j] += weighted * terms[j]
    for i in range(count):
        for j in range(i):
            matrix[j, i] = matrix[i, j]
    return matrix, right


@compiled
def compute_light(pixels: Float, gains: Float) -> Float:
    """Light (n,) of a patch by its gains; see :func:`normal_equations`."""
    result = np.empty(len(pixels))
    for number in range(len(pixels)):
        one = pixels[number]
        result[number] = (gains[0] + gains[1] * one[1] + gains[2] * one[2]) * one[3] + gains[3]
        if gains.size > SHARED:
            result[number] += gains[4] * one[8]
    return result
