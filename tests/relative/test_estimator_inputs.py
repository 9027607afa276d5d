"""What estimators take of an image: made once for all of them, and never that of another image or detector."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_info, threadpool_limits

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float, Mask
from giantlike.core.detector import Detector
from giantlike.core.outcomes import Failure, Reason
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.relative import ESTIMATORS, estimator
from giantlike.relative.inputs import EstimatorInputs, gather
from giantlike.scene import Scene, Target
from giantlike.shapes import Ellipsoid

SIZE = 64
SCENE = Scene(
    targets=(
        Target(
            name="BODY",
            shape=Ellipsoid(radii_km=np.ones(3)),
            ephemeris=ApparentGeometry(
                position_inertial_km=np.array([0.0, 0.0, 100.0]),
                inertial_from_body=Rotation.identity(),
                sun_direction_inertial=np.array([1.0, 0.0, 0.0]),
            ),
        ),
    )
)


def camera(bias_dn: float, saturation_dn: float = 900.0) -> Camera:
    middle = (SIZE - 1) / 2
    return Camera(
        name="camera",
        columns=SIZE,
        rows=SIZE,
        model=PinholeModel(fx_px=800.0, fy_px=800.0, cx_px=middle, cy_px=middle),
        detector=Detector(gain_e_per_dn=2.0, bias_dn=bias_dn, saturation_dn=saturation_dn),
    )


def image(seed: int) -> Image:
    rng = np.random.default_rng(seed)
    mask = rng.random((SIZE, SIZE)) < 0.01
    pixels = rng.integers(0, 1000, (SIZE, SIZE)).astype(np.uint16)
    return Image(pixels=pixels, mask=mask, camera_from_inertial=Rotation.identity())


def inputs(of: Image, by: Camera, name: str) -> EstimatorInputs:
    found = gather(of, by, SCENE, None, estimator=name, options=None)
    assert not isinstance(found, Failure)
    return found


def require_those_of(found: EstimatorInputs, of: Image, by: Camera) -> None:
    saturated = of.pixels >= by.detector.saturation_dn
    assert_array_equal(found.pixels_dn, of.pixels - by.detector.bias_dn)
    assert_array_equal(found.masked, of.mask)
    assert_array_equal(found.saturated, saturated & ~of.mask)
    assert_array_equal(found.usable, ~saturated & ~of.mask)


def test_inputs_are_those_of_the_image_and_the_detector_whatever_was_asked_before() -> None:
    images = [image(seed) for seed in range(2)]
    cameras = [camera(10.0), camera(100.0), camera(10.0, saturation_dn=700.0)]
    for number in (0, 0, 1, 0, 1, 1):
        for by in cameras:
            require_those_of(inputs(images[number], by, "test"), images[number], by)
    first, second = (inputs(images[0], cameras[0], name) for name in ("one", "two"))
    assert (first.estimator, second.estimator) == ("one", "two")
    assert np.shares_memory(first.pixels_dn, second.pixels_dn)


@pytest.mark.parametrize("masked", [True, False])
def test_the_level_at_which_an_image_was_clipped_is_found_where_nobody_told_of_it(masked: bool) -> None:
    rng = np.random.default_rng(3)
    disk = 1000.0 * (np.hypot(*(np.indices((SIZE, SIZE)) - 31.5)) < 20.0)
    light = np.rint(disk + rng.normal(100.0, 20.0, (SIZE, SIZE)))
    mask = image(3).mask if masked else np.zeros((SIZE, SIZE), dtype=bool)

    def saturated(pixels: Float) -> Mask:
        whole = Image(pixels=pixels.astype(np.uint16), mask=mask, camera_from_inertial=Rotation.identity())
        return inputs(whole, camera(100.0, saturation_dn=np.inf), "test").saturated

    assert_array_equal(saturated(np.minimum(light, 800.0)), (light >= 800.0) & ~mask)
    assert not saturated(light).any()


def test_an_image_that_is_no_longer_used_is_not_kept() -> None:
    used = image(5)
    inputs(used, camera(10.0), "test")
    known = weakref.ref(used)
    del used
    gc.collect()
    assert known() is None


@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_linear_algebra_of_an_estimate_takes_one_thread(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []

    def look(*_: object, **__: object) -> Failure:
        seen.extend(library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas")
        return Failure(Reason.NO_SIGNAL, "not looked for")

    monkeypatch.setattr(estimator, "gather", look)
    with threadpool_limits(2):
        assert isinstance(ESTIMATORS[name]().estimate(image(1), camera(100.0), SCENE), Failure)
    assert set(seen) == {1}


def test_the_noise_of_an_undeclared_detector_is_in_the_record_and_that_of_a_declared_one_is_not() -> None:
    undeclared = Camera.from_fov(5.0, SIZE, SIZE)
    noise = undeclared.detector.of_image(image(0).pixels, image(0).mask).noise_of_image
    assert inputs(image(0), undeclared, "test").provenance["estimated_noise"] == str(noise)
    assert "estimated_noise" not in inputs(image(0), camera(10.0), "test").provenance


def test_the_step_of_a_luminance_is_that_of_its_three_channels(tmp_path: Path) -> None:
    channels = np.random.default_rng(1).integers(0, 200, (SIZE, SIZE, 3)).astype(np.uint8)
    path = tmp_path / "color.png"
    cv2.imwrite(str(path), channels)
    luminance = Image.open(path).with_attitude(Rotation.identity())
    found = inputs(luminance, Camera.from_fov(5.0, SIZE, SIZE), "test").camera.detector
    assert found.step_dn == pytest.approx(np.linalg.norm([0.114, 0.587, 0.299]))
