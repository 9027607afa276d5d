"""The examples of CONTRIBUTING.md do what it says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike import ApparentGeometry, Camera, CenterFix, DataError, Failure, Image, Reason, Scene, Target
from giantlike.camera_models import CameraModel
from giantlike.relative import Estimator
from giantlike.shapes import Ellipsoid
from tests.documentation.pages import ROOT, run_page
from tests.tolerances import FLOAT64_SUM


@pytest.fixture(scope="module")
def examples() -> dict[str, Any]:
    """Names that the Python examples define."""
    return run_page(ROOT / "CONTRIBUTING.md", slow=False)


def test_the_estimator_finds_its_pixel_and_fails_as_a_value(examples: dict[str, Any]) -> None:
    camera = Camera.from_fov(5.0, 64, 48)
    place = ApparentGeometry(
        position_inertial_km=np.array([0.0, 0.0, 1000.0]),
        inertial_from_body=Rotation.identity(),
        sun_direction_inertial=np.array([1.0, 0.0, 0.0]),
    )
    scene = Scene(targets=(Target(name="ROCK", shape=Ellipsoid(radii_km=np.ones(3)), ephemeris=place),))
    pixels = np.zeros((48, 64), dtype=np.uint16)
    image = Image(pixels=pixels, camera_from_inertial=Rotation.identity())
    estimator = examples["BrightestPixel"]()
    assert isinstance(estimator, Estimator)
    failure = estimator.estimate(image, camera, scene)
    assert isinstance(failure, Failure)
    assert failure.reason is Reason.NO_SIGNAL
    pixels = pixels.copy()
    pixels[20, 30] = 500
    fix = estimator.estimate(Image(pixels=pixels, camera_from_inertial=Rotation.identity()), camera, scene)
    assert isinstance(fix, CenterFix)
    assert fix.center_px.tolist() == [30.0, 20.0]


def test_the_camera_model_maps_there_and_back(examples: dict[str, Any]) -> None:
    model = examples["StereographicModel"](fx_px=300.0, fy_px=300.0, cx_px=500.0, cy_px=400.0, k1=0.01)
    assert isinstance(model, CameraModel)
    points = np.array([[500.0, 400.0], [100.0, 700.0], [900.0, 50.0]])
    assert_allclose(model.project(model.unproject(points)), points, rtol=0, atol=FLOAT64_SUM)


def test_the_reader_reads_and_refuses_a_file_cut_short(examples: dict[str, Any]) -> None:
    data = b"P5\n3 2\n65535\n" + np.arange(6, dtype=">u2").tobytes()
    assert examples["decode_pgm"](Path("a.pgm"), data).pixels.tolist() == [[0, 1, 2], [3, 4, 5]]
    with pytest.raises(DataError, match="needs 12 bytes of pixels, got 11"):
        examples["decode_pgm"](Path("a.pgm"), data[:-1])
