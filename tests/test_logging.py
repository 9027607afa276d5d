"""What loggers say when they are asked."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from giantlike.core.outcomes import PositionFix
from giantlike.relative import EllipsoidCRA, LimbMatching
from giantlike.shapes import Ellipsoid
from tests.limb_images import body_image
from tests.sizes import slow


@pytest.mark.parametrize("estimator", [slow(LimbMatching()), EllipsoidCRA()])
def test_estimators_on_limbs_say_how_they_settled(
    estimator: LimbMatching | EllipsoidCRA, caplog: pytest.LogCaptureFixture
) -> None:
    case = body_image(Ellipsoid(radii_km=np.array([0.3, 0.26, 0.22])), 1, phase_deg=45.0)
    with caplog.at_level(logging.DEBUG, "giantlike.relative"):
        fix = estimator.estimate(case.image, case.camera, case.scene)
    assert isinstance(fix, PositionFix)
    moves = [record.getMessage() for record in caplog.records if record.name == "giantlike.relative"]
    assert len(moves) >= 2
    assert moves[0].startswith("limb moved by ")
