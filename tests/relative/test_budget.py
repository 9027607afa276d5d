"""The error budget of fixes holds for images of an independent renderer: camera, attitude, scale and orientation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike import (
    ApparentGeometry,
    Auto,
    Camera,
    Detector,
    GaussianPsf,
    Image,
    LimbMatching,
    Moment,
    Scene,
    Target,
)
from giantlike.camera import ModelUncertainty
from giantlike.camera_models import BrownModel
from giantlike.core.arrays import Float
from giantlike.core.causes import IN_IMAGE, IN_POSITION, Cause, sum_parts
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import AttitudeErrors, PositionFix
from giantlike.image import AttitudeSource
from giantlike.independent import EllipsoidBody, PinholeView, Pose, Psf, render_body
from giantlike.ray_tracing import Lambert
from giantlike.relative import ESTIMATORS, Estimator
from giantlike.relative.budget import _icosahedron
from giantlike.relative.place import place_covariance, place_jacobian
from giantlike.scene import TargetGeometry, TargetUncertainty
from giantlike.shapes import Ellipsoid
from tests.sizes import slow

VIEW = PinholeView(900.0, (127.5, 127.5), 256, 256, k1=-0.05)
SUN = np.array([0.5, -0.3, -0.8]) / np.linalg.norm([0.5, -0.3, -0.8])
RANGE_KM = 1000.0
TRUTH = {"fx_px": 900.0, "fy_px": 900.0, "cx_px": 127.5, "cy_px": 127.5, "k1": -0.05, "k2": 0.0, "p1": 0.0, "p2": 0.0}
STEPS = {name: 1e-2 if name.endswith("px") else 1e-5 for name in TRUTH}
N_STARS, STAR_SIGMA_PX = 150, 0.2
TURNED = np.array(
    [0.06, 0.06, 2e-3]
)  # px, px, ln: of shifts of 0.6 px; 1.7 deg of another view, by the whole pixels of lines
FALSE_ALARM = 1e-4  # of each test of squared errors


def camera(**values: float) -> Camera:
    model = BrownModel(**TRUTH | values)
    detector = Detector(gain_e_per_dn=1.0, read_noise_e=5.0)
    return Camera(name="test", columns=256, rows=256, model=model, psf=GaussianPsf(sigma_px=0.7), detector=detector)


def noisy(light: Float, rng: np.random.Generator) -> Float:
    return np.rint(rng.poisson(light) + rng.normal(0.0, 5.0, light.shape))


def scene(position_km: Float, radii_km: Float, attitude: Rotation, uncertainty: TargetUncertainty) -> Scene:
    """Scene with the body where it is predicted, 0.2 % too far and 1.2 px off."""
    predicted = ApparentGeometry(
        position_inertial_km=position_km * 1.002 + np.array([1.0, -0.6, 0.0]),
        inertial_from_body=attitude,
        sun_direction_inertial=SUN,
    )
    shape = Ellipsoid(radii_km=radii_km)
    body = Target(name="b", shape=shape, reflectance=Lambert(), ephemeris=predicted, uncertainty=uncertainty)
    return Scene(targets=(body,))


def in_the_corner() -> Float:
    axis = VIEW.directions([215.0, 45.0])
    return RANGE_KM * axis / np.linalg.norm(axis)


def drawn_camera(known: ModelUncertainty, rng: np.random.Generator) -> tuple[Camera, Float]:
    """Camera as a calibration leaves it, and the error of each of ``TRUTH``: true less drawn."""
    values = dict(TRUTH)
    errors = rng.multivariate_normal(np.zeros(len(known.estimated)), known.covariance)
    for name, error in zip(known.estimated, errors, strict=True):
        values[name] -= float(error)
    return replace(camera(**values), uncertainty=known), np.array([TRUTH[name] - values[name] for name in TRUTH])


def place_error(camera: Camera, fix: PositionFix, truth_km: Float) -> Float:
    return place_jacobian(camera.model, fix.position_camera_km) @ (fix.position_camera_km - truth_km)


def star_design(rng: np.random.Generator) -> Float:
    """Derivative of the pixels of stars all over the frame by turns of the camera and parameters, by differences."""
    rays = VIEW.directions(rng.uniform(0.0, 255.0, (N_STARS, 2)))
    steps = np.array([1e-5] * 3 + [STEPS[name] for name in TRUTH])

    def pixels(state: Float) -> Float:
        fx, fy, cx, cy, k1, k2, p1, p2 = state[3:] + np.array(list(TRUTH.values()))
        plane = replace(VIEW, focal_px=1.0, center_px=(0.0, 0.0), k1=k1, k2=k2, p1=p1, p2=p2)
        turned = plane.project(rays + np.cross(state[:3], rays))
        return np.ravel(turned * [fx, fy] + [cx, cy])

    return np.array([(pixels(step) - pixels(-step)) / (2.0 * step.sum()) for step in np.diag(steps)]).T


def calibrated(design: Float, estimated: tuple[str, ...]) -> ModelUncertainty:
    """Covariance of parameters by a calibration in which the attitude is free."""
    chosen = design[:, [0, 1, 2, *(3 + list(TRUTH).index(name) for name in estimated)]]
    covariance = STAR_SIGMA_PX**2 * np.linalg.inv(chosen.T @ chosen)[3:, 3:]
    return ModelUncertainty(
        estimated=estimated,
        covariance=(covariance + covariance.T) / 2.0,
        residual_sigma_px=STAR_SIGMA_PX,
        n_observations=N_STARS,
        n_images=1,
    )


@pytest.mark.monte_carlo(few=4, full=10)
def test_the_direction_of_a_body_in_a_corner_has_the_error_of_the_calibrated_camera(draws: int) -> None:
    rng = np.random.default_rng(5)
    known = calibrated(star_design(rng), ("fx_px", "fy_px", "k1", "k2", "p1", "p2"))
    position = in_the_corner()
    light = render_body(EllipsoidBody([30.0] * 3), VIEW, Pose(position, Rotation.identity(), SUN), law="lambert")
    here = scene(position, np.full(3, 30.0), Rotation.identity(), TargetUncertainty())
    image_alone, with_camera = 0.0, 0.0
    for _ in range(draws):
        drawn = drawn_camera(known, rng)[0]
        image = Image(pixels=noisy(light, rng), camera_from_inertial=Rotation.identity())
        fix = LimbMatching().estimate(image, drawn, here).unwrap()
        assert not fix.flags.suspect
        error = place_error(drawn, fix, position)
        image_alone += float(error @ np.linalg.solve(sum_parts(fix.parts, IN_IMAGE), error))
        with_camera += float(error @ np.linalg.solve(sum_parts(fix.parts, IN_POSITION), error))
        np.testing.assert_allclose(fix.covariance_px2, sum_parts(fix.parts)[:2, :2], rtol=1e-9)
    low, high = (float(chi2.ppf(tail, 3 * draws)) for tail in (FALSE_ALARM, 1.0 - FALSE_ALARM))
    assert low < with_camera < high
    assert image_alone > high  # without the part of the camera the test fails


@pytest.mark.monte_carlo(few=3, full=8)
def test_errors_of_the_camera_that_the_attitude_from_its_stars_follows_cancel_in_inertial_axes(draws: int) -> None:
    rng = np.random.default_rng(8)
    design = star_design(rng)
    known = calibrated(design, ("fx_px", "fy_px", "cx_px", "cy_px", "k1"))
    position = in_the_corner()
    light = render_body(EllipsoidBody([30.0] * 3), VIEW, Pose(position, Rotation.identity(), SUN), law="lambert")
    follows = -np.linalg.lstsq(design[:, :3], design[:, 3:], rcond=None)[0]
    here = scene(position, np.full(3, 30.0), Rotation.identity(), TargetUncertainty())
    squared = 0.0
    for _ in range(draws):
        drawn, error = drawn_camera(known, rng)
        names = drawn.model.parameter_names
        by_camera = np.zeros((3, len(names)))
        by_camera[:, [names.index(name) for name in TRUTH]] = follows
        turn = Rotation.from_rotvec(follows @ error)  # takes the attitude that the stars gave to the true one
        sensed = Image(pixels=noisy(light, rng)).with_attitude(
            turn.inv(),
            source=AttitudeSource.STARS,
            covariance_rad2=1e-16 * np.eye(3),
            errors=AttitudeErrors(by_camera=by_camera),
        )
        fix = LimbMatching().estimate(sensed, drawn, here).unwrap()
        seen = rotate(turn, fix.position_camera_km)  # by the attitude that the stars gave, in inertial axes
        off = place_error(drawn, fix, fix.position_camera_km + position - seen)
        total = sum_parts(fix.parts, [cause for cause in Cause if cause is not Cause.EPHEMERIS])
        squared += float(off @ np.linalg.solve(total, off))
        in_camera_axes = place_covariance(drawn.model, fix.position_camera_km, fix.covariance_camera_km2)
        assert np.sqrt(in_camera_axes[0, 0] / total[0, 0]) > 5.0
    low, high = chi2.ppf(FALSE_ALARM, 3 * draws), chi2.ppf(1.0 - FALSE_ALARM, 3 * draws)
    assert low < squared < high


@pytest.mark.monte_carlo(few=3, full=4)
def test_scale_and_orientation_of_a_body_are_in_its_covariance(draws: int) -> None:
    rng = np.random.default_rng(6)
    known = TargetUncertainty(scale=2e-3, pole_rad=0.03, spin_rad=0.04)
    position, radii = np.array([5.0, -8.0, RANGE_KM]), np.array([40.0, 33.0, 29.0])
    attitude = Rotation.from_euler("xyz", [0.4, 1.1, -0.3])
    here = scene(position, radii, attitude, known)
    exact, with_body = 0.0, 0.0
    for _ in range(draws):
        turn = attitude * Rotation.from_rotvec(rng.normal(size=3) * [known.pole_rad, known.pole_rad, known.spin_rad])
        body = EllipsoidBody(radii * (1.0 + known.scale * rng.normal()))
        light = render_body(body, VIEW, Pose(position, turn, SUN), law="lambert", psf=Psf(0.7))
        image = Image(pixels=noisy(light, rng), camera_from_inertial=Rotation.identity())
        fix = LimbMatching().estimate(image, camera(), here).unwrap()
        assert not fix.flags.suspect
        error = place_error(camera(), fix, position)
        added = sum_parts(fix.parts, (Cause.SHAPE_SCALE, Cause.POLE, Cause.SPIN))
        with_body += float(error @ np.linalg.solve(sum_parts(fix.parts), error))
        exact += float(error @ np.linalg.solve(sum_parts(fix.parts) - added, error))
    low, high = (float(chi2.ppf(tail, 3 * draws)) for tail in (FALSE_ALARM, 1.0 - FALSE_ALARM))
    assert low < with_body < high
    assert exact > high  # without the parts of the body the test fails


def square_by_pole(draw: int, *, is_unknown: bool) -> float:
    """Squared error of a body with a random pole, while the predicted one is up in the image."""
    position, radii = np.array([5.0, -8.0, RANGE_KM]), np.array([40.0, 40.0, 39.8])
    up = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    pose = Pose(position, Rotation.random(random_state=draw), SUN)
    light = render_body(EllipsoidBody(radii), VIEW, pose, law="lambert", psf=Psf(0.7))
    pixels = noisy(light, np.random.default_rng(draw))
    image = Image(pixels=pixels, camera_from_inertial=Rotation.identity())
    here = scene(position, radii, up, TargetUncertainty(pole_unknown=is_unknown))
    fix = ESTIMATORS["cross_correlation"]().estimate(image, camera(), here).unwrap()
    assert isinstance(fix, PositionFix)
    assert not fix.flags.suspect
    assert (Cause.POLE in fix.parts) == is_unknown
    error = place_error(camera(), fix, position)
    return float(error @ np.linalg.solve(sum_parts(fix.parts), error))


def test_a_pole_that_is_unknown_makes_a_fix_less_certain() -> None:
    unknown, exact = (square_by_pole(1, is_unknown=is_unknown) for is_unknown in (True, False))
    assert unknown < chi2.ppf(1.0 - FALSE_ALARM, 3)
    assert unknown < exact


@pytest.mark.slow
@pytest.mark.parametrize("draws", [5, 12])
def test_a_body_of_unknown_pole_is_found_within_its_covariance(draws: int) -> None:
    """Taken as exact, the predicted pole makes sigmas too small."""
    squares = {
        is_unknown: sum(square_by_pole(draw, is_unknown=is_unknown) for draw in range(draws))
        for is_unknown in (True, False)
    }
    low, high = (float(chi2.ppf(tail, 3 * draws)) for tail in (FALSE_ALARM, 1.0 - FALSE_ALARM))
    assert low < squares[True] < high
    assert squares[False] > high  # without the part of the pole the test fails


def test_the_six_poles_stand_for_all_directions() -> None:
    """Means of products of four components, on which squares of quadrupoles depend, are those of random directions."""
    axes = np.array([turn.as_matrix()[:, 2] for turn in _icosahedron()])
    means = np.einsum("ni,nj,nk,nl->ijkl", axes, axes, axes, axes) / len(axes)
    one = np.eye(3)
    pairs = (np.einsum(text, one, one) for text in ("ij,kl->ijkl", "ik,jl->ijkl", "il,jk->ijkl"))
    np.testing.assert_allclose(means, sum(pairs) / 15.0, rtol=0, atol=1e-12)


def test_a_pole_is_unknown_for_bodies_that_are_nearly_spheres_only() -> None:
    unknown = TargetUncertainty(pole_unknown=True)
    scene(np.array([0.0, 0.0, RANGE_KM]), np.array([60268.0, 60268.0, 54364.0]), Rotation.identity(), unknown)
    with pytest.raises(InputError, match="whose radii differ by at most 12%, got 48%"):
        scene(np.array([0.0, 0.0, RANGE_KM]), np.array([33.0, 20.0, 17.0]), Rotation.identity(), unknown)
    with pytest.raises(InputError, match="no pole_rad and no spin_rad"):
        TargetUncertainty(pole_unknown=True, spin_rad=0.1)


@pytest.mark.monte_carlo(few=2, full=4)
def test_a_body_turned_with_an_uncertain_attitude_is_found_elsewhere_and_says_so(draws: int) -> None:
    rng, sigma_rad = np.random.default_rng(7), 0.012
    position, radii = np.array([5.0, -8.0, RANGE_KM]), np.array([60.0, 42.0, 29.0])
    orientation = Rotation.from_euler("xyz", [0.4, 1.1, -0.3])
    here = scene(position, radii, orientation, TargetUncertainty())
    pose = Pose(position, orientation, SUN)
    light = render_body(EllipsoidBody(radii), VIEW, pose, law="lambert", psf=Psf(0.7))
    exact, turned = 0.0, 0.0
    image = Image(pixels=noisy(light, rng), camera_from_inertial=Rotation.identity())
    upright = LimbMatching().estimate(image, camera(), here).unwrap()
    for _ in range(draws):
        told = Rotation.from_rotvec(sigma_rad * rng.normal(size=3))
        image = Image(
            pixels=noisy(light, rng), camera_from_inertial=told, attitude_covariance_rad2=sigma_rad**2 * np.eye(3)
        )
        fix = LimbMatching().estimate(image, camera(), here).unwrap()
        error = place_error(camera(), fix, position)
        turned += float(error @ np.linalg.solve(sum_parts(fix.parts), error))
        exact += float(error @ np.linalg.solve(sum_parts(upright.parts), error))
    low, high = (float(chi2.ppf(tail, 3 * draws)) for tail in (FALSE_ALARM, 1.0 - FALSE_ALARM))
    assert low < turned < high
    assert exact > high


def test_an_attitude_from_stars_turns_no_body() -> None:
    position = np.array([5.0, -8.0, RANGE_KM])
    light = render_body(EllipsoidBody(np.full(3, 40.0)), VIEW, Pose(position, Rotation.identity(), SUN), law="lambert")
    image = Image(pixels=light, camera_from_inertial=Rotation.identity(), attitude_covariance_rad2=1e-10 * np.eye(3))
    here = scene(position, np.full(3, 40.0), Rotation.identity(), TargetUncertainty())
    assert not LimbMatching().estimate(image, camera(), here).unwrap().parts[Cause.ORIENTATION].any()


@pytest.mark.slow
def test_a_fix_moves_with_the_true_body_as_its_partials_say() -> None:
    """The true body, of another renderer, is larger or turned; what the estimator is told of it stays."""
    known = TargetUncertainty(scale=2e-3, pole_rad=0.03, spin_rad=0.04)
    position, radii = np.array([5.0, -8.0, RANGE_KM]), np.array([60.0, 42.0, 29.0])
    attitude = Rotation.from_euler("xyz", [0.4, 1.1, -0.3])
    here = scene(position, radii, attitude, known)

    def fix(scale: float = 1.0, turn: Rotation | None = None) -> PositionFix:
        pose = Pose(position, attitude if turn is None else attitude * turn, SUN)
        light = render_body(EllipsoidBody(radii * scale), VIEW, pose, law="lambert", psf=Psf(0.7))
        image = Image(pixels=light, camera_from_inertial=Rotation.identity())
        return LimbMatching().estimate(image, camera(), here).unwrap()

    def place(one: PositionFix) -> Float:
        return np.append(one.center_px, np.log(one.range_km))

    before = fix()
    scaled = (place(fix(1.02)) - place(before)) / 0.02  # two renders differ by 0.01 px
    np.testing.assert_allclose(before.partials[Cause.SHAPE_SCALE][:, 0], scaled, rtol=0.02, atol=1.0)
    largest = 0.0
    for cause, axes, sigma in (
        (Cause.POLE, np.eye(3)[:2], known.pole_rad),
        (Cause.SPIN, np.eye(3)[2:], known.spin_rad),
    ):
        # A body told with an error of one sigma is one whose truth is off by minus one sigma.
        moved = np.array([place(before) - place(fix(turn=Rotation.from_rotvec(-sigma * axis))) for axis in axes])
        off = np.abs(sigma * before.partials[cause] - moved.T).max(axis=1)
        assert (off < TURNED).all(), (cause, off)
        largest = max(largest, float(np.abs(moved[:, 0]).max()))
    assert largest > 5.0 * TURNED[0]


@pytest.mark.parametrize("estimator", [LimbMatching(), Moment(), slow(Auto())])
def test_the_attitude_and_the_ephemeris_shift_the_direction_as_a_turned_camera_and_a_moved_body_do(
    estimator: Estimator,
) -> None:
    position = np.array([60.0, -90.0, RANGE_KM])
    sigma_rad = np.array([4e-5, 3e-5, 1e-3])
    light = render_body(EllipsoidBody([30.0] * 3), VIEW, Pose(position, Rotation.identity(), SUN), law="lambert")
    image = Image(
        pixels=noisy(light, np.random.default_rng(7)),
        camera_from_inertial=Rotation.identity(),
        attitude_covariance_rad2=np.diag(sigma_rad**2),
    )
    sigma_km = np.array([0.2, 0.1, 0.4])
    known = TargetUncertainty(ephemeris_icrf_km2=np.diag(sigma_km**2), scale=1e-3)
    assert known.ephemeris_km == pytest.approx(0.4)
    here = scene(position, np.full(3, 30.0), Rotation.identity(), known)
    fix = estimator.estimate(image, camera(), here).unwrap()
    size = len(fix.parts[Cause.ATTITUDE])
    where = fix.position_camera_km if isinstance(fix, PositionFix) else position

    def place(vector: Float, size: int = size) -> Float:
        return np.append(VIEW.project(vector), np.log(np.linalg.norm(vector)))[:size]

    turned = [place(rotate(Rotation.from_rotvec(turn), where)) - place(where) for turn in np.diag(sigma_rad)]
    moved = [place(where + step) - place(where) for step in np.diag(sigma_km)]
    for cause, shifts in ((Cause.ATTITUDE, turned), (Cause.EPHEMERIS, moved)):
        expected = np.array(shifts).T @ np.array(shifts)
        sigma = np.sqrt(np.diag(expected)) + 1e-12
        difference = np.abs(fix.parts[cause] - expected) / np.outer(sigma, sigma)
        assert difference.max() < 0.02, cause
    assert set(fix.parts) - {Cause.ATTITUDE, Cause.EPHEMERIS} <= set(IN_IMAGE)
    turned_image = image.with_attitude(Rotation.from_rotvec([0.0, 0.0, np.pi / 2.0]))
    geometry = here.geometry(turned_image)
    assert isinstance(geometry, TargetGeometry)
    np.testing.assert_allclose(geometry.covariance_ephemeris_km2, np.diag([0.01, 0.04, 0.16]), rtol=0, atol=1e-15)
    with pytest.raises(ValueError, match="ephemeris_icrf_km2"):
        TargetUncertainty(ephemeris_icrf_km2=np.diag([1.0, -1.0, 1.0]))


@pytest.mark.parametrize("value", [-1e-3, 0.5, np.nan])
def test_a_scale_that_is_no_small_sigma_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match="scale"):
        TargetUncertainty(scale=value)
