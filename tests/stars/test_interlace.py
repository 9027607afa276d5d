"""Odd and even rows that are shifted against each other make an attitude suspect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from giantlike.core.outcomes import AttitudeFix, Quality
from giantlike.gauntlet import stage_of
from giantlike.stars import StarNavigation

SEED, IMAGES = 11, (11, 33)  # images of stars alone, as they should be


@pytest.mark.parametrize("index", IMAGES)
def test_shifted_odd_rows_make_an_attitude_suspect_and_others_do_not(index: int) -> None:
    stage = stage_of(SEED, index)
    assert stage.catalog is not None
    navigation = StarNavigation(stage.camera, stage.catalog)
    for shift in (0, 1, 2):
        pixels = np.array(stage.image.pixels)
        pixels[1::2] = np.roll(pixels[1::2], shift, axis=1)
        fix = navigation.solve(replace(stage.image, pixels=pixels))
        assert isinstance(fix, AttitudeFix)
        assert (Quality.BLURRED in fix.flags) == (shift > 0), (shift, fix)
