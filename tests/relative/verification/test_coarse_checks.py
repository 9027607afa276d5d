"""Short cuts of the checks behind a fix: the side of the light in blocks, and a fit that ends early.

Truth is the independent renderer; what is left of an image at all shifts is counted anew, shift by shift.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float, Mask
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.gauntlet.bodies import rock
from giantlike.independent import EllipsoidBody, PinholeView, Pose, Psf, record, render_body
from giantlike.ray_tracing import Body, Template
from giantlike.ray_tracing.cached_trace import Trace
from giantlike.ray_tracing.embree import EmbreeSurface, Float32
from giantlike.relative.verification import coarse_fit, light_side
from giantlike.relative.verification.cells import Cells, cells_around
from giantlike.relative.verification.coarse_fit import CoarseFit, fit_cells
from giantlike.shapes import Ellipsoid
from tests.sizes import slow

RADII_KM = np.array([1.1, 1.0, 0.95])
SIZE, FOCAL_PX, MIDDLE = 300, 4000.0, 149.5
POSITION_KM = np.array([0.12, -0.07, 100.0])  # a radius of 40 px: cells of 2 px
CAMERA = Camera(
    name="square",
    columns=SIZE,
    rows=SIZE,
    model=PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=MIDDLE, cy_px=MIDDLE),
    psf=GaussianPsf(sigma_px=0.8),
    detector=Detector(gain_e_per_dn=1.0, read_noise_e=5.0),
)
ROCK_RANGE = 10.0
"""Range of the rock over that of the ellipsoid: it is as much larger."""
LOST = 0.002
"""Share of the light of a rock by which lone shadows less than a cell wide may change that of its cells."""
BLOCK_PX = 4
"""Pixels along a block of 2 x 2 cells."""
LEFT = 0.05
"""Share of the variance by which one ray to a cell of 2 px and a render of all light may differ: a quarter of what
decides between sides (0.2)."""


def sun_at(phase_deg: float, azimuth_deg: float = 20.0) -> Float:
    phase, azimuth = math.radians(phase_deg), math.radians(azimuth_deg)
    return np.array([math.sin(phase) * math.cos(azimuth), math.sin(phase) * math.sin(azimuth), -math.cos(phase)])


def light(sun: Float) -> Float:
    view = PinholeView(FOCAL_PX, (MIDDLE, MIDDLE), SIZE, SIZE)
    return render_body(EllipsoidBody(RADII_KM, None), view, Pose(POSITION_KM, Rotation.identity(), sun), psf=Psf(0.8))


def looked_at(
    pixels_dn: Float,
    sun: Float,
    good: Mask | None = None,
    off_px: tuple[float, float] = (0.0, 0.0),
    body: Body | None = None,
) -> tuple[Cells, Trace, Template]:
    """Cells of an image, and the body traced and rendered so far beside its place."""
    off_km = np.append(off_px, 0.0) * POSITION_KM[2] / FOCAL_PX
    body = body or Body(
        shape=Ellipsoid(radii_km=RADII_KM),
        camera_from_body=Rotation.identity(),
        position_camera_km=POSITION_KM + off_km,
    )
    good = np.ones(pixels_dn.shape, dtype=bool) if good is None else good
    cells = cells_around(pixels_dn, good, np.zeros_like(good), CAMERA, body)
    assert cells is not None
    trace = cells.trace(body, sun)
    assert trace is not None
    own = cells.render(trace)
    assert own is not None
    return cells, trace, own


def in_blocks(image: Float, x: int, y: int, count: int) -> Float:
    """Means of the known pixels of blocks, NaN where none is."""
    padded = np.pad(image, SIZE, constant_values=np.nan)
    part = padded[SIZE + y :, SIZE + x :][: count * BLOCK_PX, : count * BLOCK_PX]
    blocks = part.reshape(count, BLOCK_PX, count, BLOCK_PX)
    known = np.isfinite(blocks).sum(axis=(1, 3))
    means: Float = np.where(known > 0, np.nansum(blocks, axis=(1, 3)) / np.maximum(known, 1), np.nan)
    return means


def left_at_the_best_shift(image: Float, model: Float, room: int) -> float:
    """Least share of the variance that a model leaves, of all shifts by up to ``room`` blocks."""
    within = slice(room, len(model) - room)
    inner, left = model[within, within], 1.0
    for down in range(2 * room + 1):
        for across in range(2 * room + 1):
            window = image[down : down + len(inner), across : across + len(inner)]
            known = np.isfinite(window)
            correlation = np.corrcoef(window[known], inner[known])[0, 1]
            left = min(left, 1.0 - max(correlation, 0.0) ** 2)
    return left


@pytest.mark.parametrize("phase_deg", [30.0, slow(90.0), slow(130.0)])
@pytest.mark.parametrize("masked", [False, True])
def test_blocks_of_cells_say_of_each_side_what_all_light_says(phase_deg: float, masked: bool) -> None:
    sun = sun_at(phase_deg)
    image, good = light(sun), np.ones((SIZE, SIZE), dtype=bool)
    if masked:
        good[:, 140:160] = False
        image[~good] = 1e5
    cells, trace, _ = looked_at(image, sun, good)
    assert cells.size == 2
    assert cells.radius >= light_side._HALVED_RADIUS
    others = [sun_at(phase_deg, 20.0 + turn) for turn in (90.0, 180.0, 270.0)]  # about an axis 0.1 deg off
    rough = light_side._left_of_halved(cells, trace, others)
    room = min(math.ceil(0.5 * cells.radius), cells.room // 2)
    x, y = (corner + cells.room - 2 * room for corner in (cells.box.x, cells.box.y))
    count = cells.inner.width // 2 + 2 * room
    blocks = in_blocks(np.where(good, image, np.nan), 2 * x, 2 * y, count)
    left = [
        left_at_the_best_shift(blocks, np.nan_to_num(in_blocks(light(one), 2 * x, 2 * y, count)), room)
        for one in (sun, *others)
    ]
    assert abs(rough[0] - left[0]) < LEFT
    assert abs(rough[1] - min(left[1:])) < LEFT


@pytest.mark.parametrize("phase_deg", [slow(5.0), 40.0, slow(90.0), 130.0])
def test_a_side_that_blocks_tell_is_the_one_that_cells_tell(phase_deg: float, monkeypatch: pytest.MonkeyPatch) -> None:
    sides = {}
    for told_deg in (20.0, 110.0, 200.0):
        told = sun_at(phase_deg, told_deg)
        given = looked_at(light(sun_at(phase_deg)), told)
        for least in (light_side._HALVED_RADIUS, math.inf):
            monkeypatch.setattr(light_side, "_HALVED_RADIUS", least)
            found = light_side.light_side(*given, told)
            assert found is not None
            sides[told_deg, least] = found.log_odds
            monkeypatch.undo()
        rough, fine = sides[told_deg, light_side._HALVED_RADIUS], sides[told_deg, math.inf]
        assert rough == fine or (rough < 0.0 and fine < 0.0)  # blocks only ever say that the side is right


@pytest.mark.parametrize(("phase_deg", "share"), [(20.0, 0.5), (60.0, 0.7), (120.0, 1.2)])
def test_few_rays_to_the_sun_light_a_rock_as_all_do(
    phase_deg: float, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    (_, mesh), sun, place = rock(1), sun_at(phase_deg), ROCK_RANGE * POSITION_KM
    body = Body(shape=mesh, camera_from_body=Rotation.identity(), position_camera_km=place)
    sent, occluded = [], EmbreeSurface.is_occluded

    def counted(self: EmbreeSurface, origins: Float32, directions: Float32) -> Mask:
        sent.append(len(origins))
        return occluded(self, origins, directions)

    monkeypatch.setattr(EmbreeSurface, "is_occluded", counted)
    found = []
    for few in (True, False):
        if not few:
            monkeypatch.setattr(Trace, "daylight", lambda trace: None)
        sent.clear()
        cells, trace, _ = looked_at(np.zeros((SIZE, SIZE)), sun, body=body)
        found.append((cells.light(trace), sent[-1] if few else max(sent), sum(sent[:-1])))
    (light_by_few, rays, rough), (light_by_all, all_rays, _) = found
    assert rays + rough < share * all_rays
    assert float(np.abs(light_by_few - light_by_all).sum()) < LOST * float(light_by_all.sum())


def fitted(pixels_dn: Float, off_px: tuple[float, float] = (0.0, 0.0)) -> CoarseFit:
    cells, trace, own = looked_at(pixels_dn, sun_at(60.0), off_px=off_px)
    fit = fit_cells(cells, trace, own, albedo=0.15)
    assert fit is not None
    return fit


@pytest.mark.parametrize("off_px", [(0.0, 0.0), (0.5, -0.3), (-0.8, 0.6)])
def test_a_fit_that_ends_early_is_where_one_of_all_rounds_is_and_where_the_body_is(
    off_px: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    image = record(light(sun_at(60.0)), np.random.default_rng(3)).pixels - 0.0
    early = fitted(image, off_px)
    monkeypatch.setattr(coarse_fit, "_SETTLED", -1.0)
    late = fitted(image, off_px)
    sigma = np.sqrt(np.diag(early.place.covariance))
    assert np.all(np.abs(early.place.values - late.place.values) < 0.05 * sigma)
    assert early.log_evidence == pytest.approx(late.log_evidence, rel=0.02)
    assert np.all(np.abs(early.place.values[:2] + off_px) < 3.0 * sigma[:2])


def test_a_fit_does_not_end_before_cells_that_nothing_explains_are_left_out() -> None:
    image = record(light(sun_at(60.0)), np.random.default_rng(3)).pixels - 0.0
    clean = fitted(image)
    struck = image.copy()
    for x, y in ((110, 118), (190, 150), (150, 205), (128, 160)):  # about the limb and on the face
        struck[y, x] += 30000.0
    hit = fitted(struck)
    sigma = np.sqrt(np.diag(clean.place.covariance))
    assert np.all(np.abs(hit.place.values - clean.place.values) < sigma)
    assert hit.alternatives == pytest.approx(clean.alternatives, abs=1.0, rel=0.15)
    assert hit.log_evidence == pytest.approx(clean.log_evidence, abs=1.0)
