"""The horizon of an ellipsoid and the Christian-Robinson algorithm: exactness, bias, covariance."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.camera_models import BrownModel, CameraModel, PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure, Reason
from giantlike.ray_tracing import Body, Silhouette, trace_silhouette
from giantlike.relative.horizon.geometry import (
    Altitude,
    CraMethod,
    Figure,
    altitude_design,
    christian_robinson,
    horizon_residuals,
)
from giantlike.shapes import Ellipsoid
from tests.bands import mean_square_band
from tests.limb_images import horizon_covariance
from tests.numerical import numerical_jacobian
from tests.tolerances import FIVE_DIGITS

EXACT_RELATIVE = 1e-6  # of the range: silhouettes are traced to 1e-6 px of a radius of some hundred
TRACED_PX = 2e-6
JACOBIAN_PX_KM = 1e-7  # central differences of a horizon of order 0.1 px/km
STANDARD_ERRORS = 5.0

DISTORTED = BrownModel(fx_px=2500.0, fy_px=2490.0, cx_px=510.0, cy_px=500.0, k1=-0.3, p1=2e-4)
MOON = Figure(radii_km=np.array([1737.4, 1737.4, 1737.4]), camera_from_axes=Rotation.identity())
ORION = PinholeModel(fx_px=7291.7, fy_px=7291.7, cx_px=1295.5, cy_px=971.5)  # the Orion camera of Holt et al. (2018)
METHODS = pytest.mark.parametrize("method", list(CraMethod))


def horizon(model: CameraModel, figure: Figure, position: Float, angles: Float) -> Float:
    """Points on the horizon by ray tracing, which knows nothing of cones and conics."""
    body = Body(
        shape=Ellipsoid(radii_km=figure.radii_km),
        camera_from_body=figure.camera_from_axes,
        position_camera_km=position,
    )
    found = trace_silhouette(body, model, angles, sun_direction_camera=np.array([1.0, 0.0, 0.0]))
    assert isinstance(found, Silhouette)
    assert found.valid.all()
    return found.points_px


TRIAXIAL = Figure(radii_km=np.array([310.0, 280.0, 230.0]), camera_from_axes=Rotation.from_rotvec([0.4, -0.9, 1.7]))
PLACE = np.array([150.0, -90.0, 4500.0])


@METHODS
def test_any_ellipsoid_is_recovered_exactly_from_its_true_horizon(method: CraMethod) -> None:
    points = horizon(DISTORTED, TRIAXIAL, PLACE, np.linspace(-1.0, 2.0, 200))
    found = christian_robinson(points, DISTORTED, TRIAXIAL, method=method)
    assert not isinstance(found, Failure)
    assert_allclose(found, PLACE, rtol=0, atol=EXACT_RELATIVE * 4500.0)


def test_points_off_the_horizon_are_off_by_their_distance() -> None:
    points = horizon(DISTORTED, TRIAXIAL, PLACE, np.linspace(0, 6.2, 50))
    residuals, _, normals = horizon_residuals(points, DISTORTED, TRIAXIAL, PLACE)
    assert_allclose(residuals, 0.0, rtol=0, atol=TRACED_PX)
    moved, _, _ = horizon_residuals(points + 0.5 * normals, DISTORTED, TRIAXIAL, PLACE)
    assert_allclose(moved, 0.5, rtol=0, atol=TRACED_PX)


def test_the_motion_of_the_horizon_is_the_derivative_of_the_residuals() -> None:
    points = horizon(DISTORTED, TRIAXIAL, PLACE, np.linspace(0, 6.2, 25))

    def outward(position: Float) -> Float:
        return -horizon_residuals(points, DISTORTED, TRIAXIAL, position)[0]

    _, jacobian, _ = horizon_residuals(points, DISTORTED, TRIAXIAL, PLACE)
    assert_allclose(jacobian, numerical_jacobian(outward, PLACE, 0.05), rtol=0, atol=JACOBIAN_PX_KM)


@pytest.mark.slow
def test_plain_least_squares_is_biased_at_the_distance_of_the_moon_and_the_others_are_not() -> None:
    """Short arcs at 252,400 km with 0.1 px of noise: the range of least squares comes out too long."""
    truth = np.array([0.0, 0.0, 252_400.0])
    points = horizon(ORION, MOON, truth, np.linspace(-0.6, 0.6, 120))
    rng = np.random.default_rng(17)
    ranges: dict[CraMethod, list[float]] = {method: [] for method in CraMethod}
    draws = 1500
    for _ in range(draws):
        noisy = points + 0.1 * rng.normal(size=points.shape)
        for method, found in ranges.items():
            position = christian_robinson(noisy, ORION, MOON, method=method, sigma_px=0.1)
            assert not isinstance(position, Failure)
            found.append(float(np.linalg.norm(position)) - 252_400.0)
    bias = {method: float(np.mean(found)) for method, found in ranges.items()}
    error = {method: float(np.std(found)) / draws**0.5 for method, found in ranges.items()}
    assert bias[CraMethod.LEAST_SQUARES] > 5.0 * error[CraMethod.LEAST_SQUARES]
    for method in (CraMethod.TOTAL_LEAST_SQUARES, CraMethod.MAXIMUM_LIKELIHOOD):
        assert abs(bias[method]) < STANDARD_ERRORS * error[method]
        assert abs(bias[method]) < 0.3 * bias[CraMethod.LEAST_SQUARES]


@METHODS
@pytest.mark.monte_carlo(few=60, full=1000)
def test_the_covariance_is_what_repeated_noise_shows(method: CraMethod, draws: int) -> None:
    points = horizon(DISTORTED, TRIAXIAL, PLACE, np.linspace(-1.4, 1.4, 100))
    rng = np.random.default_rng(23)
    errors = []
    for _ in range(draws):
        noisy = points + 0.1 * rng.normal(size=points.shape)
        found = christian_robinson(noisy, DISTORTED, TRIAXIAL, method=method, sigma_px=0.1)
        assert not isinstance(found, Failure)
        errors.append(found - PLACE)
    stated = horizon_covariance(points, DISTORTED, TRIAXIAL, PLACE, sigma_px=0.1, method=method)
    scatter = np.cov(np.array(errors).T)
    ratios = np.linalg.eigvals(np.linalg.solve(stated, scatter)).real
    low, high = mean_square_band(3 * (draws - 1))
    assert low < ratios.mean() < high


def test_too_few_points_or_points_of_no_ellipse_are_refused() -> None:
    points = horizon(DISTORTED, TRIAXIAL, PLACE, np.linspace(-1, 1, 30))
    few = christian_robinson(points[:3], DISTORTED, TRIAXIAL)
    assert isinstance(few, Failure)
    assert few.reason is Reason.TOO_FEW_DETECTIONS
    same = christian_robinson(np.tile(points[:1], (10, 1)), DISTORTED, TRIAXIAL)
    assert isinstance(same, Failure)
    assert same.reason is Reason.DEGENERATE_GEOMETRY


def test_the_motion_of_the_horizon_with_the_altitude_is_its_derivative() -> None:
    low = horizon(DISTORTED, TRIAXIAL, PLACE, np.linspace(0, 6.2, 25))
    step_km = 0.5
    high = Altitude(step_km).above(TRIAXIAL)
    raised = horizon_residuals(low, DISTORTED, high, PLACE)[0] / -step_km
    assert_allclose(altitude_design(low, DISTORTED, TRIAXIAL, PLACE), raised, rtol=0, atol=FIVE_DIGITS)


def test_a_sphere_higher_by_its_altitude_and_farther_in_proportion_looks_the_same() -> None:
    """So what is not known of the altitude of a limb goes into the range, one to one in proportion."""
    truth = np.array([0.0, 0.0, 252_400.0])
    points = horizon(ORION, MOON, truth, np.linspace(0, 6.2, 40))
    radial = horizon_residuals(points, ORION, MOON, truth)[1] @ (truth / 252_400.0)
    lift = altitude_design(points, ORION, MOON, truth)
    assert_allclose(lift * 1737.4, -radial * 252_400.0, rtol=FIVE_DIGITS, atol=0)


@pytest.mark.monte_carlo(few=60, full=300)
def test_ranges_from_a_limb_of_uncertain_altitude_scatter_as_stated(draws: int) -> None:
    """The Earth's limb, 25 +- 5 km high and another height in every draw, seen as 25 km by the algorithm."""
    earth = Figure(radii_km=np.array([6378.1, 6378.1, 6356.8]), camera_from_axes=Rotation.from_rotvec([1.2, 0.4, 0.2]))
    truth = 300_000.0 * ORION.unproject(np.array([1310.0, 960.0]))
    seen, sigma_km, noise_px = Altitude(25.0, 5.0).above(earth), 5.0, 0.05
    angles = np.linspace(-1.3, 1.3, 60)
    rng = np.random.default_rng(31)
    points = horizon(ORION, seen, truth, angles)
    _, design, normals = horizon_residuals(points, ORION, seen, truth)
    lift = altitude_design(points, ORION, seen, truth)
    gain = np.linalg.pinv(design)
    stated = gain @ (noise_px**2 * np.eye(60) + sigma_km**2 * np.outer(lift, lift)) @ gain.T
    squares = []
    for _ in range(draws):
        shift = sigma_km * rng.normal() * lift + noise_px * rng.normal(size=60)
        found = christian_robinson(points + shift[:, None] * normals, ORION, seen, sigma_px=noise_px)
        assert not isinstance(found, Failure)
        squares.append(float((found - truth) @ np.linalg.solve(stated, found - truth)))
    low, high = mean_square_band(3 * draws, 1e-5)
    assert low < np.mean(squares) / 3.0 < high
    sight = truth / 300_000.0
    known = noise_px**2 * np.linalg.inv(design.T @ design)
    assert np.sqrt(sight @ (stated - known) @ sight) / 300_000.0 == pytest.approx(5.0 / 6396.0, rel=0.02)


@pytest.mark.parametrize(("altitude", "sigma"), [(np.nan, 0.0), (1.0, -1.0), (1.0, np.inf)])
def test_altitudes_that_make_no_sense_are_refused(altitude: float, sigma: float) -> None:
    with pytest.raises(InputError, match="altitude"):
        Altitude(altitude, sigma)
