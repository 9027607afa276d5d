"""Rows and columns of a frame, summed while its bias is taken off: as numpy finds them, one after the other."""

from __future__ import annotations

import numpy as np
import pytest

from giantlike.processing.detection.frame_lines import FrameLines

ROUNDING_DN = 1e-9  # of means of values of some 300 DN


@pytest.mark.parametrize("kind", [np.uint16, np.float32, np.float64])
@pytest.mark.parametrize("shape", [(9, 13), (2, 2), (40, 3001)])
def test_lines_of_a_frame_are_those_of_numpy(shape: tuple[int, int], kind: type[np.generic]) -> None:
    pixels = np.random.default_rng(1).normal(300.0, 50.0, shape).astype(kind)
    found, light = FrameLines.from_frame(pixels, 10.5), pixels.astype(np.float64) - 10.5
    np.testing.assert_array_equal(found.light_dn, light)
    for frame, image in ((found, light), (found.transpose(), light.T)):
        middle = image.shape[1] // 2
        means = [image[:, :middle].mean(axis=1), image[:, middle:].mean(axis=1)]
        np.testing.assert_array_equal(frame.light_dn, image)
        np.testing.assert_array_equal(frame.largest_dn, image.max(axis=1))
        np.testing.assert_allclose(frame.means_dn, means, rtol=0, atol=ROUNDING_DN)
