"""Estimators with a lens that a user wrote on the documented protocol, which says nothing of blocks and windows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from giantlike.camera_models import CameraModel
from giantlike.core.outcomes import CenterFix, PositionFix
from giantlike.relative import ESTIMATORS
from giantlike.shapes import Ellipsoid
from tests.fixed_grid import FixedGrid
from tests.limb_images import CAMERA, NEES_LIMIT, BodyImage, body_image
from tests.sizes import slow

LENS = FixedGrid(cx_px=199.5, cy_px=199.5)
RADIUS_PX = 110.0  # as rendered at 2,500 px of focal length; 148 px here: averaged over blocks by templates and checks
NAMES = ("moment", "cross_correlation", "limb_matching", "ellipsoid_cra", "sigmoid_limb", "ellipse_fit", "auto")


@pytest.fixture(scope="module")
def case() -> BodyImage:
    camera = replace(CAMERA, model=LENS)
    return body_image(
        Ellipsoid(radii_km=np.array([1.0, 0.97, 0.9])), 7, phase_deg=50.0, radius_px=RADIUS_PX, camera=camera
    )


def test_the_lens_has_no_more_than_the_protocol() -> None:
    assert isinstance(LENS, CameraModel)
    assert not hasattr(LENS, "binned")
    assert not hasattr(LENS, "windowed")


@pytest.mark.parametrize("name", [slow(name) if name in ("auto", "sigmoid_limb") else name for name in NAMES])
def test_every_estimator_of_ellipsoids_runs_on_it_and_is_within_its_sigma(case: BodyImage, name: str) -> None:
    fix = ESTIMATORS[name]().estimate(case.image, case.camera, case.scene)
    assert isinstance(fix, CenterFix), fix
    error_px = fix.center_px - case.center_px
    assert error_px @ np.linalg.solve(fix.covariance_px2, error_px) < NEES_LIMIT
    if isinstance(fix, PositionFix):
        assert case.nees(fix) < NEES_LIMIT
    assert not fix.flags.suspect, fix.flags


def test_an_unresolved_body_is_found_with_it() -> None:
    camera = replace(CAMERA, model=LENS)
    small = body_image(Ellipsoid(radii_km=np.ones(3)), 8, phase_deg=30.0, radius_px=2.0, camera=camera)
    fix = ESTIMATORS["unresolved"]().estimate(small.image, small.camera, small.scene)
    assert isinstance(fix, CenterFix), fix
    error_px = fix.center_px - small.center_px
    assert error_px @ np.linalg.solve(fix.covariance_px2, error_px) < NEES_LIMIT
