"""Light on the wrong side of a body makes a fix suspect; truth by the independent renderer."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.outcomes import CenterFix, PositionFix, Quality
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.independent import EllipsoidBody, PinholeView, Pose, Psf, SphereField, record, render_body
from giantlike.independent.record import Recorder
from giantlike.ray_tracing import Body
from giantlike.relative import CrossCorrelation, EllipsoidCRA, LimbMatching
from giantlike.relative.judge import FALSE_ALARM, Alternative
from giantlike.relative.verification.cells import cells_around
from giantlike.relative.verification.light_side import light_side
from giantlike.scene import Scene, Target
from giantlike.shapes import Ellipsoid
from tests.sizes import slow
from tests.sphere_fields import bumps

LIGHT_LOG_ODDS = math.log(len(Alternative) / FALSE_ALARM)
"""Log odds from which on another Sun alone makes a fix suspect."""
RADII_KM = np.array([1.1, 1.0, 0.95])
SIZE, FOCAL_PX, RANGE_KM = 200, 4000.0, 100.0  # a radius of 40 px
CENTER_PX = (103.0, 97.0)
CAMERA = Camera(
    name="square",
    columns=SIZE,
    rows=SIZE,
    model=PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=99.5, cy_px=99.5),
    psf=GaussianPsf(sigma_px=0.8),
    detector=Detector(gain_e_per_dn=5.0, read_noise_e=10.0),
)


def position(center_px: tuple[float, float] = CENTER_PX) -> Float:
    return RANGE_KM * CAMERA.model.unproject(np.array(center_px))


def sun_at(phase_deg: float, azimuth_deg: float = 20.0) -> Float:
    phase, azimuth = math.radians(phase_deg), math.radians(azimuth_deg)
    return np.array([math.sin(phase) * math.cos(azimuth), math.sin(phase) * math.sin(azimuth), -math.cos(phase)])


@cache
def picture(phase_deg: float, *, spots: float = 0.0) -> NDArray[np.uint16]:
    """A body under Lommel-Seeliger light, which nobody is told; ``spots`` is the contrast of markings."""
    view = PinholeView(FOCAL_PX, (99.5, 99.5), SIZE, SIZE)
    albedo: SphereField | None = bumps(3, rms=spots) if spots else None
    pose = Pose(position(), Rotation.identity(), sun_at(phase_deg))
    light = render_body(
        EllipsoidBody(RADII_KM, albedo), view, pose, law="lommel_seeliger", peak_dn=2000.0, psf=Psf(0.8)
    )
    taken = record(light, np.random.default_rng(5), Recorder(gain_e_per_dn=5.0, read_noise_e=10.0))
    return np.asarray(taken.pixels)


def scene(sun: Float, center_px: tuple[float, float] = (108.0, 93.0)) -> Scene:
    apparent = ApparentGeometry(position_inertial_km=position(center_px), sun_direction_inertial=sun)
    return Scene(targets=(Target(name="BODY", shape=Ellipsoid(radii_km=RADII_KM), ephemeris=apparent),))


def odds(pixels: NDArray[np.uint16], sun: Float, center_px: tuple[float, float] = CENTER_PX) -> float:
    body = Body(
        shape=Ellipsoid(radii_km=RADII_KM),
        camera_from_body=Rotation.identity(),
        position_camera_km=position(center_px),
    )
    good = np.ones(pixels.shape, dtype=bool)
    cells = cells_around(pixels.astype(np.float64), good, np.zeros_like(good), CAMERA, body)
    assert cells is not None
    trace = cells.trace(body, sun)
    assert trace is not None
    own = cells.render(trace)
    assert own is not None
    found = light_side(cells, trace, own, sun)
    assert found is not None
    return found.log_odds


@pytest.mark.parametrize("phase_deg", [20.0, 60.0, 130.0])
def test_the_side_of_the_sun_is_told_whatever_the_law(phase_deg: float) -> None:
    sun = sun_at(phase_deg)
    assert odds(picture(phase_deg), sun) < 0.0
    for angle_deg in (90.0, 180.0, 270.0):
        assert odds(picture(phase_deg), sun_at(phase_deg, 20.0 + angle_deg)) > LIGHT_LOG_ODDS


def test_a_wrong_place_and_markings_do_not_look_like_a_wrong_side() -> None:
    for center_px in ((103.0, 97.0), (108.0, 93.0), (97.0, 99.0)):
        assert odds(picture(30.0, spots=0.2), sun_at(30.0), center_px) < 0.0


def test_a_center_that_light_of_the_wrong_side_pulled_away_is_seen_too() -> None:
    away = (CENTER_PX[0] - 28.0, CENTER_PX[1] - 10.0)  # 0.74 radii
    assert odds(picture(60.0), sun_at(60.0, 200.0), away) > LIGHT_LOG_ODDS
    assert odds(picture(60.0), sun_at(60.0), away) < 0.0


def test_at_full_phase_there_is_no_side() -> None:
    assert abs(odds(picture(20.0), sun_at(0.0))) < LIGHT_LOG_ODDS


@pytest.mark.parametrize("estimator", [slow(CrossCorrelation()), slow(LimbMatching()), EllipsoidCRA()])
def test_an_image_read_upside_down_gives_no_fix_that_is_ok(
    estimator: CrossCorrelation | LimbMatching | EllipsoidCRA,
) -> None:
    upright = Image(pixels=picture(20.0), camera_from_inertial=Rotation.identity())
    right = estimator.estimate(upright, CAMERA, scene(sun_at(20.0)))
    assert isinstance(right, PositionFix), right
    assert not right.flags.suspect
    assert right.findings.checks["other_sun_log_odds"] < 0.0
    turned = Image(pixels=np.rot90(picture(20.0), 2), camera_from_inertial=Rotation.identity())
    center = (SIZE - 1.0 - 108.0, SIZE - 1.0 - 93.0)
    wrong = estimator.estimate(turned, CAMERA, scene(sun_at(20.0), center))
    if isinstance(wrong, CenterFix):
        assert Quality.WRONG_LIGHT in wrong.flags
        assert wrong.flags.suspect
