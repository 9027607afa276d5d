"""Contrast across an outline by loops beside sums over its points in numpy."""

from __future__ import annotations

import numpy as np

from giantlike.processing.limb.search import contrasts

ROUNDING = 1e-6  # values of the image are single precision


def test_contrasts_are_weighted_means_over_the_points_that_count() -> None:
    random = np.random.default_rng(7)
    image = random.uniform(10.0, 1000.0, (60, 70)).astype(np.float32)
    image[20:24, 30] = np.nan
    angles = np.linspace(0.0, 2.0 * np.pi, 50, endpoint=False)
    arms = 18.0 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    offsets, weights = arms / 9.0, random.uniform(0.1, 1.0, 50)
    middle, shifts, scales, floor_dn = np.array([33.3, 14.8]), np.array([-3.0, 0.0, 3.0]), np.array([0.9, 1.1]), 5.0
    for steepest in (False, True):
        found = contrasts(image, middle, arms, offsets, weights, shifts, scales, floor_dn, steepest)
        expected, counted = np.zeros((2, 3, 3)), np.zeros((2, 3, 3))
        for m, scale in enumerate(scales):
            for j, down in enumerate(shifts):
                for i, across in enumerate(shifts):
                    at = middle + scale * arms + np.array([across, down])
                    inner, outer = np.rint(at - offsets).astype(int), np.rint(at + offsets).astype(int)
                    both = np.concatenate([inner, outer], axis=1)
                    inside = np.all((both >= 0) & (both < [70, 60, 70, 60]), axis=1)
                    light = image[inner[inside, 1], inner[inside, 0]]
                    dark = image[outer[inside, 1], outer[inside, 0]]
                    good = np.isfinite(light - dark)
                    share = (light - dark)[good] / (1.0 if steepest else light[good] + dark[good] + floor_dn)
                    expected[m, j, i] = weights[inside][good] @ share
                    counted[m, j, i] = weights[inside][good].sum()
            expected[m] /= np.maximum(counted[m], 0.5 * counted[m].max())
        assert counted.min() < 0.9 * weights.sum()  # some lie outside the image
        assert np.abs(found - expected).max() < ROUNDING * np.abs(expected).max()
