"""Simulated images against radiometry, astrometry and noise laws that do not come from this code."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import spiceypy
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.catalogs import apparent_directions
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector
from giantlike.core.errors import InputError
from giantlike.core.frames import direction_from_radec, rotate, rotation_between
from giantlike.core.photometry import SUN_MAGNITUDES, Photometry
from giantlike.core.time import et_from_time
from giantlike.core.units import AU_KM, RAD_PER_DEG, SPEED_OF_LIGHT_KM_S
from giantlike.ephemeris import ApparentGeometry, DistantLight
from giantlike.image import Image
from giantlike.io import read_geometry
from giantlike.scene import Scene, Target, TargetGeometry
from giantlike.shapes import load_shape, sphere
from giantlike.simulation import (
    ApproachOptions,
    Sources,
    Visit,
    demo_camera,
    plan_approach,
    simulate_image,
    write_approach,
)
from giantlike.simulation.approach import Approach
from giantlike.simulation.detector import HotPixels, expose
from giantlike.simulation.images import SimulatedImage
from giantlike.simulation.orbits import CircularOrbit
from giantlike.simulation.shot import make_black_image
from giantlike.simulation.stars import point_sources, star_field
from giantlike.simulation.write import TRUTH_FILE
from tests.simulated import ET, OBSERVER, shot_of, small_camera, small_catalog, sphere_scene
from tests.tolerances import EPOCH_S, FLOAT32_SUM, FLOAT64, FLOAT64_SUM, SAMPLED, SETTLED

SPHERE_FLUX = 2e-3  # relative: 5 x 5 rays a pixel on a disk of 60 px
SPHERE_PHOTOCENTER_PX = 0.005  # 5 x 5 jittered rays a pixel on a disk of 60 px
NOISE_SIGMAS = 4.5  # passed by chance once in 150,000 times
STELAB_RAD = 2e-8  # spiceypy's stelab is classical: (v/c)^2 at 30 km/s is 1e-8
ET_ROUNDING_KM = 1e-5  # 30 km/s in 3e-7 s, what two roundings of an et of 7.6e8 s amount to
POINT_SHARE = 1e-9  # double precision of the error function, relative to the whole source


def electrons(taken: SimulatedImage, camera: Camera) -> Float:
    return (taken.image.pixels.astype(np.float64) - camera.detector.bias_dn) * camera.detector.gain_e_per_dn


# detector -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("signal_e", [0.0, 40.0, 20_000.0])
def test_mean_and_variance_of_a_flat_field_are_those_of_the_detector(signal_e: float) -> None:
    detector = Detector(gain_e_per_dn=2.0, read_noise_e=6.0, saturation_dn=60_000.0, bias_dn=500.0)
    side = 500
    pixels = expose(np.full((side, side), signal_e), 1.0, detector, seed=1).pixels.astype(np.float64)
    variance = float(detector.variance_dn2(np.array(signal_e / detector.gain_e_per_dn)))
    five_sigma_of_mean = 5.0 * np.sqrt(variance) / side
    assert_allclose(pixels.mean(), 500.0 + signal_e / 2.0, rtol=0, atol=five_sigma_of_mean)
    five_sigma_of_variance = 5.0 * variance * np.sqrt(2.0) / side
    assert_allclose(pixels.var(), variance, rtol=0, atol=five_sigma_of_variance)


def test_pixels_are_cut_off_at_saturation_and_at_zero() -> None:
    detector = Detector(gain_e_per_dn=1.0, read_noise_e=20.0, saturation_dn=4095.0)
    signal = np.zeros((50, 50))
    signal[:25] = 1e6
    pixels = expose(signal, 1.0, detector, seed=0).pixels
    assert pixels.dtype == np.uint16
    assert np.all(pixels[:25] == 4095)
    assert pixels[25:].min() == 0


def test_without_a_known_saturation_sixteen_bits_are_the_limit() -> None:
    pixels = expose(np.full((4, 4), 1e7), 1.0, Detector(), seed=0).pixels
    assert np.all(pixels == 65535)


@pytest.mark.parametrize("signal", [np.full((3, 3), -1.0), np.full((3, 3), np.nan), np.zeros(9)])
def test_a_signal_that_no_light_can_give_is_refused(signal: Float) -> None:
    with pytest.raises(InputError, match="light_e"):
        expose(signal, 1.0, Detector(), seed=0)


def test_hot_pixels_fill_with_time_and_not_with_light() -> None:
    hot = HotPixels(points_px=np.array([[3, 1], [99, 0]]), rate_e_s=np.array([100.0, 50.0]))
    frame = hot.signal_e(8, 5, 2.0)
    assert frame[1, 3] == 200.0
    assert frame.sum() == 200.0  # the second lies outside


# stars ----------------------------------------------------------------------------------------------------


def test_a_point_source_is_the_gaussian_integrated_over_each_pixel() -> None:
    from photutils.psf import CircularGaussianSigmaPRF  # here, as importing it takes a second

    rng = np.random.default_rng(5)
    rows, columns = np.mgrid[0:24, 0:30]
    for sigma_px in (0.3, 0.8, 1.7):
        x, y = rng.uniform(8.0, 15.0, 2)
        mine = point_sources([[x, y]], [1.0], sigma_px=sigma_px, columns=30, rows=24)
        reference = CircularGaussianSigmaPRF(flux=1.0, x_0=x, y_0=y, sigma=sigma_px)(columns, rows)
        assert_allclose(mine, reference, rtol=0, atol=POINT_SHARE)


def test_sources_at_the_edge_keep_the_light_that_falls_on_the_detector() -> None:
    frame = point_sources([[-0.5, 10.0], [40.0, 10.0]], [2.0, 5.0], sigma_px=0.8, columns=20, rows=20)
    assert_allclose(frame.sum(), 1.0, rtol=0, atol=FLOAT64_SUM)  # half of the first, nothing of the second


def test_a_psf_of_no_width_puts_all_light_into_one_pixel() -> None:
    frame = point_sources([[3.4, 2.3]], [7.0], sigma_px=0.0, columns=8, rows=6)
    assert frame[2, 3] == pytest.approx(7.0, abs=FLOAT64)


def test_the_star_field_holds_every_catalog_star_on_the_detector_and_no_other() -> None:
    camera = demo_camera()
    attitude = Rotation.from_euler("xyz", [-60.0, 0.0, 20.0], degrees=True)
    ra, dec = 270.0, 30.0
    axis = rotate(attitude.inv(), [0.0, 0.0, 1.0])
    ra, dec = np.degrees(np.arctan2(axis[1], axis[0])), np.degrees(np.arcsin(axis[2]))
    catalog = small_catalog(4000, float(ra), float(dec), 15.0)
    field = star_field(catalog, camera, shot_of(attitude=attitude))
    directions = apparent_directions(
        catalog.stars,
        ET,
        observer_position_km=OBSERVER.position_km,
        observer_velocity_km_s=OBSERVER.velocity_km_s,
    )
    points = camera.model.project(rotate(attitude, directions))
    on_detector = camera.contains(points)
    assert 500 < on_detector.sum() < 3500
    assert set(catalog.stars.ids[on_detector]) == set(field.ids[camera.contains(field.points_px)])
    assert camera.contains(field.points_px, margin_px=-10.0).all()


def test_a_star_of_given_magnitude_gives_the_electrons_of_the_zero_point() -> None:
    camera = small_camera()
    catalog = small_catalog(1, 0.0, 90.0, 0.0)
    attitude = Rotation.from_rotvec([0.0, 0.0, 0.3])
    photometry = Photometry(zero_point_e_s=1e6)
    taken = simulate_image(
        shot_of(3.0, attitude),
        camera,
        Sources(scene=_dark_scene(), catalog=catalog, photometry=photometry),
        seed=2,
    )
    expected = 3e6 * 10.0 ** (-0.4 * catalog.stars.magnitude[0])
    x, y = np.rint(taken.stars.points_px[0]).astype(int)
    box = electrons(taken, camera)[y - 6 : y + 7, x - 6 : x + 7]
    assert_allclose(box.sum(), expected, rtol=0, atol=5.0 * np.sqrt(expected + 169 * 36.0))


def _dark_scene() -> Scene:
    """A ball far outside the field."""
    place = ApparentGeometry(position_inertial_km=np.array([1000.0, 0.0, 1.0]))
    return Scene(
        targets=(Target(name="BALL", shape=sphere(1.0), ephemeris=place),),
        light=DistantLight(np.array([0.0, 0.0, -1.0])),
    )


# bodies ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase_deg", [0.0, 40.0, 90.0, 120.0])
def test_a_lambert_sphere_has_the_light_and_the_photocenter_of_the_closed_form(phase_deg: float) -> None:
    """Flux 2/3 Phi(a); photocenter (3 pi / 16) r sin a (1 + cos a) / (sin a + (pi - a) cos a) towards the Sun."""
    camera = small_camera(focal_px=60_000.0)  # far away: the closed form holds to radius over range, here 1 / 2000
    sources = Sources(
        scene=sphere_scene(1000.0, phase_deg, 0.5), photometry=Photometry(), albedo=0.1, sun_distance_au=2.0
    )
    radius_km, range_km = 0.5, 1000.0
    exposure_s = 30_000.0 / sources.surface_rate_e_s(camera)
    taken = simulate_image(shot_of(exposure_s), camera, sources, seed=4)
    image = electrons(taken, camera)
    phase = phase_deg * RAD_PER_DEG
    law = np.sin(phase) + (np.pi - phase) * np.cos(phase)
    sun_e_s = 2e5 * 10.0 ** (-0.4 * SUN_MAGNITUDES["Gaia G"]) / 2.0**2
    expected = sun_e_s * exposure_s * (2.0 / 3.0) * 0.1 * (radius_km / range_km) ** 2 * law / np.pi
    shift = 3.0 * np.pi / 16.0 * 30.0 * np.sin(phase) * (1.0 + np.cos(phase)) / law
    disk = slice(camera.columns // 2 - 34, camera.columns // 2 + 34)  # 30 px of radius: less read noise than the frame
    light, columns = image[disk, disk], np.arange(camera.columns)[disk] - (camera.columns - 1) / 2
    variance_e2 = np.maximum(light, 0.0) + camera.detector.read_noise_e**2
    noise = float(np.sqrt(variance_e2.sum())) / expected
    assert noise < 5e-4
    assert_allclose(light.sum() / expected, 1.0, rtol=0, atol=SPHERE_FLUX + NOISE_SIGMAS * noise)
    noise_px = float(np.sqrt((variance_e2 * (columns - shift) ** 2).sum()) / light.sum())
    assert noise_px < 0.01
    tolerance = SPHERE_PHOTOCENTER_PX + NOISE_SIGMAS * noise_px
    assert_allclose((light * columns).sum() / light.sum(), shift, rtol=0, atol=tolerance)


def test_a_body_smaller_than_a_pixel_keeps_its_light_and_its_place() -> None:
    camera = small_camera(60)
    sources = Sources(scene=sphere_scene(100_000.0, 60.0))  # 0.6 px across
    exposure_s = 2e6 / sources.surface_rate_e_s(camera)
    attitude = Rotation.from_rotvec([0.0004, 0.0003, 0.0])
    taken = simulate_image(shot_of(exposure_s, attitude), camera, sources, seed=1)
    center = taken.templates["BALL"].center_px
    image = electrons(taken, camera)
    rows, columns = np.indices(image.shape)
    near = np.hypot(columns - center[0], rows - center[1]) < 6.0
    centroid = np.array([(columns * image)[near].sum(), (rows * image)[near].sum()]) / image[near].sum()
    law = np.sin(np.pi / 3) + (2 * np.pi / 3) * np.cos(np.pi / 3)
    shift = 3.0 * np.pi / 16.0 * 0.3 * np.sin(np.pi / 3) * 1.5 / law
    noise_px = 5.0 * 0.8 / np.sqrt(image[near].sum()) + 5.0 * 6.0 * 6.0 * np.sqrt(near.sum()) / image[near].sum()
    assert noise_px < 0.05
    assert_allclose(centroid - center, [shift, 0.0], rtol=0, atol=noise_px)


def test_a_body_hides_the_stars_behind_it_also_with_its_dark_side() -> None:
    camera = small_camera()
    catalog = small_catalog(3000, 0.0, 90.0, 3.0)
    scene = sphere_scene(1000.0, 150.0)
    taken = simulate_image(shot_of(), camera, Sources(scene=scene, catalog=catalog), seed=1)
    distance = np.linalg.norm(taken.stars.points_px - camera.center_px, axis=1)
    free = star_field(catalog, camera, shot_of())
    behind = np.linalg.norm(free.points_px - camera.center_px, axis=1) < 28.0
    assert behind.sum() > 10
    assert distance.min() > 29.0
    assert len(taken.stars.ids) < len(free.ids)


def test_equal_generators_give_equal_images_and_others_do_not() -> None:
    camera, scene = small_camera(), sphere_scene(1000.0, 60.0)
    first, second, third = (simulate_image(shot_of(1e-3), camera, Sources(scene=scene), seed=s) for s in (1, 1, 2))
    assert np.array_equal(first.image.pixels, second.image.pixels)
    assert not np.array_equal(first.image.pixels, third.image.pixels)


def test_a_camera_without_a_psf_takes_no_images() -> None:
    camera = dataclasses.replace(small_camera(), psf=None)
    with pytest.raises(InputError, match="psf"):
        simulate_image(shot_of(), camera, Sources(scene=sphere_scene(1000.0, 60.0)), seed=1)


def test_a_scene_without_a_sun_is_refused() -> None:
    scene = dataclasses.replace(sphere_scene(1000.0, 60.0), light=None)
    with pytest.raises(InputError, match="Sun"):
        simulate_image(shot_of(), small_camera(), Sources(scene=scene), seed=1)


# paths ----------------------------------------------------------------------------------------------------


def test_velocity_on_the_circle_is_the_derivative_of_position() -> None:
    orbit = CircularOrbit(radius_au=1.3, longitude_rad=0.7, inclination_rad=0.2, epoch_et=ET)
    step = 1000.0
    ahead, behind = orbit.state(ET + 5e5 + step)[0], orbit.state(ET + 5e5 - step)[0]
    assert_allclose((ahead - behind) / (2 * step), orbit.state(ET + 5e5)[1], rtol=0, atol=SETTLED)
    period_s = 1.3**1.5 * 365.2569 * 86400.0  # Kepler's third law, Gaussian year
    assert_allclose(orbit.state(ET + period_s)[0], orbit.state(ET)[0], rtol=0, atol=FLOAT32_SUM * AU_KM)


def test_the_body_turns_about_its_pole_once_a_period() -> None:
    orbit = CircularOrbit(pole_ra_deg=40.0, pole_dec_deg=-30.0, spin_period_s=20_000.0, epoch_et=ET)
    pole = direction_from_radec(40.0, -30.0)
    for fraction in (0.0, 0.3, 1.0):
        turned = orbit.inertial_from_body(ET + fraction * 20_000.0)
        assert_allclose(rotate(turned, [0.0, 0.0, 1.0]), pole, rtol=0, atol=FLOAT64)
        swept = (turned * orbit.inertial_from_body(ET).inv()).as_rotvec() @ pole
        assert_allclose(np.cos(swept), np.cos(2 * np.pi * fraction), rtol=0, atol=FLOAT64_SUM)


# approach -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plan() -> Approach:
    visits = (
        Visit(day=0.0, diameter_px=1.5, phase_deg=30.0),
        Visit(day=1.0, diameter_px=20.0, phase_deg=110.0, lost=True),
        Visit(day=2.0, diameter_px=60.0, phase_deg=60.0),
    )
    moon = (Visit(day=0.0, diameter_px=80.0, phase_deg=40.0), Visit(day=0.1, diameter_px=90.0, phase_deg=60.0))
    return plan_approach(ApproachOptions(seed=11, approach=visits, moon=moon, facets=3000))


def test_each_visit_sees_the_body_at_the_size_and_phase_asked_for(plan: Approach) -> None:
    seen = {}
    for frame in plan.frames:
        geometry = frame.scene.geometry(make_black_image(frame.shot, plan.camera))
        assert isinstance(geometry, TargetGeometry)
        if not frame.star_image:
            radius_km = geometry.target.shape.mean_radius_km
            seen[frame.shot.name] = (
                2 * radius_km / geometry.range_km * plan.camera.model.focal_length_px,
                np.degrees(geometry.phase_angle_rad),
            )
    expected = {
        "rock_01_short.fits": (1.5, 30.0),
        "rock_02_short.fits": (20.0, 110.0),
        "rock_03_short.fits": (60.0, 60.0),
        "moon_01_short.fits": (80.0, 40.0),
        "moon_02_short.fits": (90.0, 60.0),
    }
    assert seen.keys() == expected.keys()
    for name, values in expected.items():
        assert_allclose(seen[name][0], values[0], rtol=0, atol=SAMPLED / 2 * values[0])
        assert_allclose(seen[name][1], values[1], rtol=0, atol=0.1)  # light time and aberration: 0.01 deg


def test_apparent_places_are_those_of_light_time_and_stellar_aberration_by_spice(plan: Approach) -> None:
    for frame in plan.frames[::2]:
        et = et_from_time(frame.shot.epoch)
        observer, body = frame.shot.observer, frame.scene.targets[0].ephemeris
        assert isinstance(body, CircularOrbit)
        assert observer is not None
        light_time_s = 0.0
        for _ in range(6):
            vector = body.state(et - light_time_s)[0] - observer.position_km
            light_time_s = float(np.linalg.norm(vector)) / SPEED_OF_LIGHT_KM_S
        beta = observer.velocity_km_s / SPEED_OF_LIGHT_KM_S
        doppler = (1.0 + beta @ vector / np.linalg.norm(vector)) / np.sqrt(1.0 - beta @ beta)
        expected = doppler * spiceypy.stelab(vector, observer.velocity_km_s.copy())
        apparent = frame.scene.apparent(make_black_image(frame.shot, plan.camera), frame.scene.targets[0])
        assert isinstance(apparent, ApparentGeometry)
        range_km = float(np.linalg.norm(vector))
        assert_allclose(
            apparent.position_inertial_km / range_km,
            expected / range_km,
            rtol=0,
            atol=STELAB_RAD + ET_ROUNDING_KM / range_km,
        )


def test_the_a_priori_is_wrong_by_what_was_asked_for(plan: Approach) -> None:
    options, focal_px = plan.options, plan.camera.model.focal_length_px
    for frame in plan.frames:
        apparent = frame.scene.apparent(make_black_image(frame.shot, plan.camera), frame.scene.targets[0])
        assert isinstance(apparent, ApparentGeometry)
        truth, prediction = apparent.position_inertial_km, frame.apriori_geometry.position_inertial_km
        line = truth / np.linalg.norm(truth)
        error = (prediction - truth) / np.linalg.norm(truth)
        along = float(error @ line)
        assert abs(along) <= options.range_error * 1.001
        # The error is fixed in km; the range changes by up to 3 % while a visit lasts.
        across_px = float(np.linalg.norm(error - along * line)) * focal_px
        assert_allclose(across_px, options.position_error_px, rtol=0, atol=0.03 * options.position_error_px)
        attitude = frame.apriori_camera_from_inertial
        assert (attitude is None) == ("_02_" in frame.shot.name and frame.target == "ROCK")
        if attitude is not None:
            angle = np.linalg.norm(rotation_between(attitude, frame.shot.camera_from_inertial)) / RAD_PER_DEG
            assert 0.1 <= angle <= 0.3


def test_the_camera_turns_between_the_images_of_a_visit_by_its_drift(plan: Approach) -> None:
    first, second, third = (frame.shot.camera_from_inertial for frame in plan.frames[:3])
    drift = plan.options.drift_arcsec_s * plan.options.pair_gap_s
    walk = 4.0 * plan.options.jitter_arcsec_per_sqrt_s * np.sqrt(plan.options.pair_gap_s)
    for earlier, later in ((first, second), (second, third)):
        turn_arcsec = np.degrees(np.linalg.norm(rotation_between(earlier, later))) * 3600.0
        assert_allclose(turn_arcsec, drift, rtol=0, atol=walk)


@pytest.mark.parametrize(
    "wrong",
    [
        {"approach": (Visit(day=0.0, diameter_px=3.0, phase_deg=20.0),)},
        {
            "approach": (
                Visit(day=1.0, diameter_px=3.0, phase_deg=20.0),
                Visit(day=0.0, diameter_px=3.0, phase_deg=20.0),
            )
        },
        {"long_exposure_s": 0.1},
        {"attitude_error_deg": (0.3, 0.1)},
    ],
)
def test_an_approach_that_cannot_be_flown_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError):
        ApproachOptions(**wrong)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def written(plan: Approach, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("approach")
    write_approach(plan, folder, small_catalog(2000, 90.0, 0.0, 60.0), workers=2)
    return folder


def test_images_come_back_as_they_were_taken(plan: Approach, written: Path) -> None:
    frame = plan.frames[-2]
    catalog = small_catalog(2000, 90.0, 0.0, 60.0)
    image = Image.open(written / "images" / frame.shot.name)
    assert np.array_equal(image.pixels, plan.take(frame, catalog).image.pixels)
    assert image.pixels.dtype == np.uint16
    assert image.exposure_s == frame.shot.exposure_s
    assert image.et is not None
    assert_allclose(image.et, et_from_time(frame.shot.epoch), rtol=0, atol=EPOCH_S)


def test_the_body_is_saturated_in_star_images_only(plan: Approach, written: Path) -> None:
    limit = plan.camera.detector.saturation_dn
    for frame in plan.frames:
        saturated = (Image.open(written / "images" / frame.shot.name).pixels >= limit).sum()
        assert (saturated > 10) == frame.star_image


def test_nothing_that_a_campaign_reads_holds_the_truth(plan: Approach, written: Path) -> None:
    rows = {row.file: row for row in read_geometry(written / "geometry.csv").rows}
    for frame in plan.frames:
        image = Image.open(written / "images" / frame.shot.name)
        assert image.camera_from_inertial is None
        assert image.observer is not None
        assert frame.shot.observer is not None
        assert np.linalg.norm(image.observer.position_km - frame.shot.observer.position_km) > 1e-3
        row = rows[frame.shot.name]
        if row.camera_from_inertial is not None:
            assert np.linalg.norm(rotation_between(row.camera_from_inertial, frame.shot.camera_from_inertial)) > 1e-3
    campaign = (written / "campaign.toml").read_text()
    assert TRUTH_FILE not in campaign


def test_the_written_shape_is_the_body_that_was_photographed(plan: Approach, written: Path) -> None:
    shape = load_shape(written / "shapes" / "rock.obj", units="km")
    rock = next(target.shape for target in plan.targets if target.name == "ROCK")
    assert_allclose(shape.mean_radius_km, rock.mean_radius_km, rtol=0, atol=FLOAT64)
    assert_allclose(shape.circumscribing_radius_km, rock.circumscribing_radius_km, rtol=0, atol=FLOAT64)
