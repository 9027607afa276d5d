"""Bodies whose declared orientation is wrong: a template estimates the rotation, or the covariance holds it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from giantlike import independent
from giantlike.core.causes import sum_parts
from giantlike.core.outcomes import CenterFix
from giantlike.ephemeris import ApparentGeometry
from giantlike.independent import PinholeView, Psf, ReliefBody
from giantlike.relative import CrossCorrelation
from giantlike.scene import Scene, TargetUncertainty
from giantlike.shapes import TriangleMesh
from tests.relative.light.test_light_truth import FOCAL_PX, RADII_KM, SIZE, Shot, light, shot
from tests.sphere_fields import bumps

DIAMETER_PX, PHASE_DEG, OFF_DEG = 70.0, 60.0, 3.0
SPIN = Rotation.from_rotvec([0.0, 0.0, math.radians(OFF_DEG)])


def rock_shot(spin_rad: float = 0.0) -> tuple[Shot, Rotation]:
    """A rock that has rotated further than its scene says, and its true orientation in camera axes."""
    body = ReliefBody(RADII_KM, bumps(11, rms=0.04, widths_deg=(10.0, 40.0)))
    one = shot(2, phase_deg=PHASE_DEG, diameter_px=DIAMETER_PX)
    pose = light(2, "mcewen", PHASE_DEG, DIAMETER_PX, False, 0.0)[1]
    middle = 0.5 * (SIZE - 1)
    view = PinholeView(focal_px=FOCAL_PX, center_px=(middle, middle), columns=SIZE, rows=SIZE)
    signal_dn = independent.render_body(body, view, pose, law="mcewen", psf=Psf(0.8), peak_dn=3000.0)
    shown = independent.record(signal_dn, np.random.default_rng(1)).pixels.astype(np.int32)
    target = one.scene.targets[0]
    known = target.ephemeris
    assert isinstance(known, ApparentGeometry)
    believed = replace(known, inertial_from_body=known.inertial_from_body * SPIN)
    mesh = TriangleMesh(*body.mesh(140), "rock")
    target = replace(target, shape=mesh, ephemeris=believed, uncertainty=TargetUncertainty(spin_rad=spin_rad))
    rock = replace(one, image=replace(one.image, pixels=shown), scene=Scene(targets=(target,)))
    return rock, known.inertial_from_body


def distance(fix: CenterFix, one: Shot) -> float:
    """Mahalanobis distance of a center from the truth."""
    error = fix.center_px - one.center_px
    return math.sqrt(error @ np.linalg.solve(fix.covariance_px2, error))


def test_the_rotation_of_a_rock_that_nobody_declared_is_estimated() -> None:
    one, camera_from_body = rock_shot()
    fix = one.fix(CrossCorrelation())
    assert not fix.flags.suspect
    assert float(np.hypot(*(fix.center_px - one.center_px))) < 0.1  # 0.3 px with the declared orientation
    assert distance(fix, one) < 3.7  # 1 of 1,000 right ones
    turn = fix.corrections.turn
    assert turn is not None
    left = turn.rotation * camera_from_body * SPIN * camera_from_body.inv()
    assert math.degrees(left.magnitude()) < 0.5
    assert "turn" in fix.provenance
    np.testing.assert_allclose(sum_parts(fix.parts)[:2, :2], fix.covariance_px2, rtol=1e-9)


@pytest.mark.slow
def test_a_rotation_that_the_image_shows_needs_no_declared_error() -> None:
    undeclared = rock_shot()[0].fix(CrossCorrelation())
    one, _ = rock_shot(math.radians(OFF_DEG))
    declared = one.fix(CrossCorrelation())
    assert distance(declared, one) < 3.7
    first, second = (np.sqrt(np.diag(fix.covariance_px2)) for fix in (declared, undeclared))
    assert (first < 2.0 * second).all()  # the declared rotation moves the center by 0.3 px
    np.testing.assert_allclose(sum_parts(declared.parts)[:2, :2], declared.covariance_px2, rtol=1e-9)
