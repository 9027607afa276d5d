"""Covariances of attitudes by cause, against stars and a camera that share no code with the estimator."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike import ApparentGeometry
from giantlike.camera import Camera, ModelUncertainty
from giantlike.camera_models import BrownModel
from giantlike.catalogs import MemoryCatalog, StarTable
from giantlike.core.arrays import Float
from giantlike.core.causes import Cause
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.errors import InputError
from giantlike.core.observer import ObserverState
from giantlike.core.outcomes import AttitudeErrors, AttitudeFix, CenterFix, Quality
from giantlike.core.time import time_from_utc
from giantlike.image import AttitudeSource, Image
from giantlike.independent import (
    Defects,
    PinholeView,
    Psf,
    Recorder,
    StarField,
    aberrated,
    background,
    random_stars,
    record,
    star_image,
)
from giantlike.processing.detection.detections import Detections
from giantlike.relative.budget import with_budget
from giantlike.scene import Scene, Target, TargetGeometry
from giantlike.shapes import Ellipsoid
from giantlike.stars import StarNavigation, StarOptions
from giantlike.stars.transfer import StarAttitude, TransferOptions, TransferredAttitude, transfer_attitude
from tests.tolerances import FALSE_ALARM

SIZE, FOCAL_PX, SIGMA_PX = 1024, 4000.0, 0.1
EPOCH = time_from_utc("2016-01-01T12:00:00")
EARTH_KM_S = 29.8
NAMES = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "p1", "p2")
ESTIMATED = ("fx_px", "cx_px", "cy_px", "k1")
PARAMETER_SIGMAS = np.array([1.0, 3.0, 3.0, 0.02])
"""Such as some 100 stars of 0.1 px leave them: the center of the image is hardly known, and the attitude follows it."""
NEES = (0.5, 2.0)
STRESS_DRAWS = 6  # enough to see a NEES of 6; 25 draws of 512 px give 0.9-1.1 in each case


def _catalog(field: StarField, motion_mas_yr: Float) -> MemoryCatalog:
    n, (x, y, z) = len(field.magnitudes), field.directions.T
    zero = np.zeros(n)
    stars = StarTable(
        ids=np.arange(1, n + 1),
        ra_deg=np.degrees(np.arctan2(y, x)) % 360.0,
        dec_deg=np.degrees(np.arcsin(z)),
        pm_ra_mas_yr=motion_mas_yr[:, 0],
        pm_dec_mas_yr=motion_mas_yr[:, 1],
        parallax_mas=zero,
        radial_velocity_km_s=zero,
        epoch_jyear=np.full(n, 2016.0),
        magnitude=field.magnitudes,
        color_bv=np.full(n, np.nan),
        sigma_mas=zero + 0.01,
        sigma_pm_mas_yr=zero + 0.01,
    )
    return MemoryCatalog(stars, name="made up", band="V", version="1")


def _detections(points: Float) -> Detections:
    n = len(points)
    return replace(
        Detections.empty(psf_sigma_px=0.8, noise_dn=3.0),
        points_px=points,
        covariance_px2=np.tile(SIGMA_PX**2 * np.eye(2), (n, 1, 1)),
        flux_dn=np.linspace(2e4, 1e3, n),
        snr=np.linspace(300.0, 15.0, n),
        peak_dn=np.linspace(5e3, 2e2, n),
        area_px=np.full(n, 9),
        background_dn=np.zeros(n),
        width_px=np.full(n, 0.8),
        flags=np.zeros(n, dtype=np.uint16),
    )


def _camera(view: PinholeView, uncertainty: ModelUncertainty | None = None) -> Camera:
    values = {"fx_px": view.focal_px, "fy_px": view.focal_px, "cx_px": view.center_px[0], "cy_px": view.center_px[1]}
    return Camera(name="nav", columns=SIZE, rows=SIZE, model=BrownModel(**values, k1=view.k1), uncertainty=uncertainty)


def _solved(
    rng: np.random.Generator,
    *,
    camera: Camera,
    truth: PinholeView,
    velocity_km_s: Float,
    motion_mas_yr: float = 0.0,
    years: float = 0.0,
    **image: object,
) -> tuple[AttitudeFix, Rotation, Float]:
    """Attitude from 60 stars seen by the true camera, the true attitude, and the error of the estimate."""
    attitude = Rotation.random(rng=rng)
    field = random_stars(rng, 60, axis=attitude.inv().apply([0.0, 0.0, 1.0]), radius_rad=0.12)
    shared = motion_mas_yr * np.array([0.6, -0.8]) + 0.0 * field.directions[:, :2]
    east = np.cross([0.0, 0.0, 1.0], field.directions)
    east /= np.linalg.norm(east, axis=1, keepdims=True)
    along = shared[:, :1] * east + shared[:, 1:] * np.cross(field.directions, east)
    moved = field.directions + years * along * np.pi / 180.0 / 3600e3
    seen = aberrated(moved / np.linalg.norm(moved, axis=1, keepdims=True), velocity_km_s)
    places = truth.project(seen @ attitude.as_matrix().T)
    inside = ((places > 0.0) & (places < SIZE - 1.0)).all(axis=1)
    order = np.argsort(field.magnitudes[inside])
    points = places[inside][order] + SIGMA_PX * rng.normal(size=(inside.sum(), 2))
    apriori = Rotation.from_rotvec(1e-4 * rng.normal(size=3)) * attitude
    pixels = np.zeros((SIZE, SIZE), np.uint8)
    settings = {"epoch": EPOCH} | image
    made = Image(pixels=pixels, camera_from_inertial=apriori, **settings)
    fix = StarNavigation(camera, _catalog(field, shared)).solve_detections(made, _detections(points)).unwrap()
    return fix, attitude, (attitude * fix.camera_from_inertial.inv()).as_rotvec()


def _nees(errors: list[Float], covariances: list[Float]) -> float:
    squares = [
        error @ np.linalg.solve(covariance, error) for error, covariance in zip(errors, covariances, strict=True)
    ]
    return float(np.mean(squares)) / len(errors[0])


VIEW = PinholeView(FOCAL_PX, (511.5, 511.5), SIZE, SIZE)
MOVING = ObserverState(position_km=np.array([1.5e8, 0.0, 0.0]), velocity_km_s=np.array([0.0, EARTH_KM_S, 0.0]))


def _of_a_body(center_px: Float, position_inertial_km: Float, attitude: AttitudeFix, camera: Camera) -> CenterFix:
    """Fix without noise of its own at a pixel, with the errors that it has from its surroundings."""
    image = Image(pixels=np.zeros((SIZE, SIZE)), epoch=EPOCH).with_attitude(attitude)
    seen = ApparentGeometry(
        position_inertial_km=position_inertial_km,
        inertial_from_body=Rotation.identity(),
        sun_direction_inertial=np.array([0.0, 0.0, 1.0]),
    )
    scene = Scene(targets=(Target(name="b", shape=Ellipsoid(radii_km=np.full(3, 100.0)), ephemeris=seen),))
    geometry = scene.geometry(image)
    assert isinstance(geometry, TargetGeometry)
    fix = CenterFix(
        estimator="none",
        target="b",
        center_px=center_px,
        covariance_px2=1e-8 * np.eye(2),
        predicted_px=center_px,
        residuals=np.zeros(0),
        n_used=1,
        n_rejected=0,
        score=1.0,
    )
    return with_budget(fix, image, camera, geometry, lambda _: np.zeros(2)).unwrap()


def test_an_unknown_velocity_of_the_observer_is_in_the_covariance_and_flagged() -> None:
    rng, errors, all_, noise = np.random.default_rng(1), [], [], []
    for _ in range(25):
        direction = rng.normal(size=3)
        velocity = EARTH_KM_S * direction / np.linalg.norm(direction)
        fix, _, error = _solved(rng, camera=_camera(VIEW), truth=VIEW, velocity_km_s=velocity)
        assert fix.flags is Quality.OBSERVER_UNKNOWN
        assert not fix.flags.suspect
        errors.append(error)
        all_.append(fix.covariance_rad2)
        noise.append(fix.parts[Cause.NOISE])
    assert _nees(errors, noise) > 100.0
    assert NEES[0] < _nees(errors, all_) < NEES[1]


def test_a_known_velocity_leaves_the_noise_alone() -> None:
    rng, errors, covariances = np.random.default_rng(2), [], []
    for _ in range(25):
        fix, _, error = _solved(
            rng, camera=_camera(VIEW), truth=VIEW, velocity_km_s=MOVING.velocity_km_s, observer=MOVING
        )
        assert tuple(fix.parts) == (Cause.NOISE,)
        errors.append(error)
        covariances.append(fix.covariance_rad2)
    low, high = (float(chi2.ppf(p, 75)) / 75 for p in (FALSE_ALARM / 2, 1 - FALSE_ALARM / 2))
    assert low < _nees(errors, covariances) < high


def test_an_unknown_epoch_is_in_the_covariance_where_stars_move_together() -> None:
    rng, errors, covariances = np.random.default_rng(3), [], []
    for _ in range(25):
        years = 15.0 * rng.normal()
        fix, _, error = _solved(
            rng,
            camera=_camera(VIEW),
            truth=VIEW,
            velocity_km_s=np.zeros(3),
            motion_mas_yr=100.0,
            years=years,
            epoch=None,
            observer=ObserverState(position_km=np.zeros(3), velocity_km_s=np.zeros(3)),
        )
        assert fix.flags is Quality.EPOCH_UNKNOWN
        errors.append(error)
        covariances.append(fix.covariance_rad2)
    assert NEES[0] < _nees(errors, covariances) < NEES[1]


def test_the_error_of_the_camera_is_in_the_attitude_and_cancels_for_bodies_as_it_does() -> None:
    rng = np.random.default_rng(4)
    uncertainty = ModelUncertainty(
        estimated=ESTIMATED,
        covariance=np.diag(PARAMETER_SIGMAS**2),
        residual_sigma_px=SIGMA_PX,
        n_observations=100,
        n_images=1,
    )
    camera = _camera(VIEW, uncertainty)
    errors, covariances, noise, shifts, shift_covariances = [], [], [], [], []
    corner = np.array([60.0, 60.0])
    for _ in range(40):
        f, x, y, k1 = PARAMETER_SIGMAS * rng.normal(size=4)
        truth = replace(VIEW, focal_px=FOCAL_PX + f, center_px=(511.5 + x, 511.5 + y), k1=k1)
        fix, attitude, error = _solved(rng, camera=camera, truth=truth, velocity_km_s=np.zeros(3), observer=STILL)
        errors.append(error)
        covariances.append(fix.covariance_rad2)
        noise.append(fix.parts[Cause.NOISE])
        # Where the estimated camera and attitude put what the true ones see in a corner.
        direction = attitude.inv().apply(truth.directions(corner))
        shifts.append(corner - camera.model.project(fix.camera_from_inertial.apply(direction)))
        shift_covariances.append(_of_a_body(corner, 1e6 * direction, fix, camera).covariance_total)
    assert _nees(errors, noise) > 10.0
    assert NEES[0] < _nees(errors, covariances) < NEES[1]
    assert NEES[0] < _nees(shifts, shift_covariances) < NEES[1]
    assert np.sqrt(np.mean([np.diag(part) for part in shift_covariances])) < 0.5 * PARAMETER_SIGMAS[1]


STILL = ObserverState(position_km=np.zeros(3), velocity_km_s=np.zeros(3))


def test_flags_and_causes_of_an_attitude_follow_it_to_other_images() -> None:
    parts = {Cause.NOISE: 1e-12 * np.eye(3), Cause.ABERRATION: 4e-10 * np.eye(3)}
    errors = AttitudeErrors(parts=parts, by_camera=np.ones((3, 2)), flags=Quality.OBSERVER_UNKNOWN)
    pair = [
        StarAttitude(
            et=et, camera_from_inertial=Rotation.identity(), covariance_rad2=4.01e-10 * np.eye(3), errors=errors
        )
        for et in (0.0, 100.0)
    ]
    between = transfer_attitude(50.0, pair, options=TransferOptions(drift_arcsec_per_sqrt_s=0.0))
    assert isinstance(between, TransferredAttitude)
    # Two solutions halve the variance of the noise; the velocity is unknown in the same way in both.
    np.testing.assert_allclose(between.errors.parts[Cause.NOISE], 0.5e-12 * np.eye(3), rtol=0, atol=1e-20)
    np.testing.assert_allclose(between.errors.parts[Cause.ABERRATION], 4e-10 * np.eye(3), rtol=0, atol=1e-18)
    assert between.errors.by_camera is not None
    np.testing.assert_allclose(between.errors.by_camera, np.ones((3, 2)), rtol=0, atol=1e-12)
    image = Image(pixels=np.zeros((4, 4))).with_attitude(
        between.camera_from_inertial,
        source=AttitudeSource.INTERPOLATED,
        covariance_rad2=between.covariance_rad2,
        errors=between.errors,
    )
    assert image.attitude_errors.flags is Quality.OBSERVER_UNKNOWN
    assert image.with_attitude(Rotation.identity()).attitude_errors.flags is Quality.NONE


SMALL = 400
SMALL_VIEW = PinholeView(2400.0, (199.5, 199.5), SMALL, SMALL)
STRESS: dict[str, dict[str, Any]] = {
    "a background that rises": {"slope_dn": (800.0, 400.0)},
    "wings": {"psf": Psf(0.8, 0.1, 2.5)},
    "hot pixels": {"hot_pixels": 150},
    "motion of a pixel": {"psf": Psf(0.8, motion_px=(0.8, 0.6))},
}


@pytest.mark.parametrize("case", STRESS)
def test_attitudes_from_pixels_hold_their_covariance_where_models_are_wrong(case: str) -> None:
    options: dict[str, Any] = {"psf": Psf(0.8), "slope_dn": (0.0, 0.0), "hot_pixels": 0} | STRESS[case]
    camera = replace(
        _camera(SMALL_VIEW),
        columns=SMALL,
        rows=SMALL,
        psf=GaussianPsf(sigma_px=0.8),
        detector=Detector(gain_e_per_dn=2.0, read_noise_e=5.0),
    )
    errors, covariances = [], []
    for seed in range(STRESS_DRAWS):
        rng = np.random.default_rng(seed)
        attitude = Rotation.random(rng=rng)
        field = random_stars(rng, 100, axis=attitude.inv().apply([0.0, 0.0, 1.0]), radius_rad=0.13)
        light, _ = star_image(field, SMALL_VIEW, attitude, psf=options["psf"])
        light = light + background(light.shape, constant_dn=500.0, slope_dn=options["slope_dn"])
        defects = Defects(hot_pixels=options["hot_pixels"])
        exposed = record(light, rng, Recorder(gain_e_per_dn=2.0, read_noise_e=5.0), defects)
        apriori = Rotation.from_rotvec(1e-4 * rng.normal(size=3)) * attitude
        image = Image(pixels=exposed.pixels, camera_from_inertial=apriori, epoch=EPOCH, observer=STILL)
        fix = StarNavigation(camera, _catalog(field, np.zeros((100, 2)))).solve(image).unwrap()
        assert not fix.flags.suspect
        errors.append((attitude * fix.camera_from_inertial.inv()).as_rotvec())
        covariances.append(fix.covariance_rad2)
    freedom = 3 * STRESS_DRAWS
    low, high = (float(chi2.ppf(p, freedom)) / freedom for p in (FALSE_ALARM / 2, 1 - FALSE_ALARM / 2))
    assert NEES[0] * low < _nees(errors, covariances) < NEES[1] * high


def test_an_unknown_speed_is_no_negative_number() -> None:
    with pytest.raises(InputError, match="unknown_speed_km_s"):
        StarOptions(unknown_speed_km_s=-1.0)


@pytest.mark.parametrize(
    ("fault", "flag"),
    [
        ("none", Quality.NONE),
        ("slipped", Quality.AMBIGUOUS),
        ("narrow", Quality.BLURRED),
        ("defocused", Quality.DEFOCUSED),
    ],
)
def test_rows_that_slipped_far_and_narrow_stars_make_an_attitude_suspect_and_wide_round_ones_do_not(
    fault: str, flag: Quality
) -> None:
    camera = replace(
        _camera(SMALL_VIEW),
        columns=SMALL,
        rows=SMALL,
        psf=GaussianPsf(sigma_px=0.8),
        detector=Detector(gain_e_per_dn=2.0, read_noise_e=5.0),
    )
    rng = np.random.default_rng(8)
    attitude = Rotation.random(rng=rng)
    field = random_stars(rng, 100, axis=attitude.inv().apply([0.0, 0.0, 1.0]), radius_rad=0.13)
    light, _ = star_image(field, SMALL_VIEW, attitude, psf=Psf({"narrow": 0.5, "defocused": 1.3}.get(fault, 0.8)))
    if fault == "slipped":
        light[SMALL // 2 :] = np.roll(light[SMALL // 2 :], 40, axis=1)
    exposed = record(light + 500.0, rng, Recorder(gain_e_per_dn=2.0, read_noise_e=5.0))
    image = Image(pixels=exposed.pixels, camera_from_inertial=attitude, epoch=EPOCH, observer=STILL)
    fix = StarNavigation(camera, _catalog(field, np.zeros((100, 2)))).solve(image).unwrap()
    assert fix.flags is flag
