"""The chain from light to numbers: every effect against the physics that it stands for, and what it must keep."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from giantlike.camera import Camera
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure
from giantlike.core.photometry import Photometry
from giantlike.ephemeris import DistantLight, FixedEphemeris
from giantlike.processing.detection.detect import detect_sources
from giantlike.scene import Scene, Target
from giantlike.shapes import sphere
from giantlike.simulation import Shot, Sources, simulate_image
from giantlike.simulation.cosmic_rays import CosmicRays, Tracks, draw_tracks
from giantlike.simulation.detector import DetectorModel, HotPixels, Stream, convert_charge, expose, scattered_pixels
from giantlike.simulation.effects import (
    DarkCurrent,
    FlatField,
    FrameTransfer,
    FullWell,
    StorageSide,
    StrayLight,
    pixel_response,
)
from giantlike.simulation.incident import IncidentLight, SimulationOptions, incident_light
from giantlike.simulation.shot import instants
from tests.simulated import OBSERVER, catalog_at, shot_of, small_camera, small_catalog, sphere_scene
from tests.tolerances import FLOAT32, FLOAT32_SUM, FLOAT64, FLOAT64_ROOT, FLOAT64_SUM, SAME_PLACE_PX, SETTLED

SIGMAS = 4.5  # a normal error exceeds it once in 150,000 times
WIDE = Detector(gain_e_per_dn=2.5, read_noise_e=8.0, bias_dn=200.0)
SIDE = 256


def flat(level_e: float, side: int = SIDE) -> Float:
    return np.full((side, side), level_e)


def numbers(light_e: Float, seed: int, model: DetectorModel | None = None, exposure_s: float = 1.0) -> Float:
    return expose(light_e, exposure_s, WIDE, seed=seed, model=model).pixels.astype(np.float64)


# noise ----------------------------------------------------------------------------------------------------


def test_the_photon_transfer_curve_gives_the_gain_and_the_read_noise_whatever_the_flat_field() -> None:
    """Half the variance of differences of two flats over their mean has the slope 1 / gain [DN / electron]."""
    model = DetectorModel(
        flat=FlatField(response=pixel_response(SIDE, SIDE, rms=0.02, random=Stream.PIXEL_RESPONSE.random(1)))
    )
    levels_e = np.linspace(200.0, 120_000.0, 10)
    means, variances = np.empty((2, levels_e.size))
    for k, level in enumerate(levels_e):
        first, second = (numbers(flat(level), seed, model) for seed in (2 * k, 2 * k + 1))
        means[k] = 0.5 * (first.mean() + second.mean()) - WIDE.bias_dn
        variances[k] = 0.5 * (first - second).var(ddof=1)
    sigma = variances * np.sqrt(2.0 / (SIDE**2 - 1))  # of a variance of that many normal numbers
    (slope, offset), covariance = np.polyfit(means, variances, 1, w=1.0 / sigma, cov="unscaled")
    assert_allclose(slope, 1.0 / WIDE.gain_e_per_dn, rtol=0, atol=SIGMAS * np.sqrt(covariance[0, 0]))
    assert np.sqrt(covariance[0, 0]) < 0.005 / WIDE.gain_e_per_dn
    expected = (WIDE.read_noise_e / WIDE.gain_e_per_dn) ** 2 + 1.0 / 12.0
    assert_allclose(offset, expected, rtol=0, atol=SIGMAS * np.sqrt(covariance[1, 1]))


def test_the_flat_field_makes_the_noise_of_one_image_grow_with_the_light_itself() -> None:
    rms, level_e = 0.02, 100_000.0
    model = DetectorModel(
        flat=FlatField(response=pixel_response(SIDE, SIDE, rms=rms, random=Stream.PIXEL_RESPONSE.random(4)))
    )
    variance = numbers(flat(level_e), 1, model).var()
    level_dn = level_e / WIDE.gain_e_per_dn
    expected = (rms * level_dn) ** 2 + float(WIDE.variance_dn2(np.array(level_dn)))
    assert_allclose(variance, expected, rtol=0, atol=SIGMAS * expected * np.sqrt(2.0 / SIDE**2))


def test_rounding_adds_a_twelfth_and_the_converter_ends_at_its_last_number() -> None:
    ramp = np.random.default_rng(3).uniform(0.0, 5000.0, (SIDE, SIDE))
    coarse = Detector(gain_e_per_dn=10.0, bias_dn=7.0)
    error = convert_charge(ramp, coarse) - (ramp / 10.0 + 7.0)
    of_variance = np.sqrt(1.0 / 180.0) / SIDE  # fourth moment 1/80 less 1/144
    assert_allclose(error.var(), 1.0 / 12.0, rtol=0, atol=SIGMAS * of_variance)
    assert np.abs(error).max() <= 0.5 + 1e-9
    assert convert_charge(np.array([[1e9]]), coarse, bits=12) == 4095
    assert convert_charge(np.array([[1e9]]), Detector(saturation_dn=3000.0), bits=12) == 3000
    assert convert_charge(np.array([[-1e9]]), coarse) == 0


def test_each_effect_has_random_numbers_of_its_own() -> None:
    light, plain = flat(50.0, 64), DetectorModel()
    rays = DetectorModel(cosmic_rays=CosmicRays(hits_per_image=30.0))
    without, hit = (expose(light, 1.0, WIDE, seed=9, model=model) for model in (plain, rays))
    assert (hit.cosmic_e > 0).any()
    assert np.array_equal(without.pixels[hit.cosmic_e == 0], hit.pixels[hit.cosmic_e == 0])
    quiet = dataclasses.replace(WIDE, read_noise_e=0.0)
    assert np.array_equal(expose(light, 1.0, quiet, seed=9, model=rays).cosmic_e, hit.cosmic_e)
    assert np.array_equal(expose(light, 1.0, WIDE, seed=9, model=rays).pixels, hit.pixels)
    assert not np.array_equal(expose(light, 1.0, WIDE, seed=10, model=rays).cosmic_e, hit.cosmic_e)
    drawn = [stream.random((9, 1)).integers(2**40) for stream in Stream]
    assert len(set(drawn)) == len(drawn)


def test_a_negative_seed_is_refused() -> None:
    with pytest.raises(InputError, match="seed"):
        expose(flat(1.0, 4), 1.0, WIDE, seed=-1)


# light and charge that the scene does not give -------------------------------------------------------------


def test_without_options_nothing_but_shot_noise_is_added() -> None:
    light = np.random.default_rng(1).uniform(0.0, 100.0, (40, 30))
    assert np.array_equal(DetectorModel().expected_e(light, 5.0), light)


def test_dark_current_grows_with_time_and_doubles_with_each_step_of_temperature() -> None:
    cold, warm = (
        DetectorModel(dark=DarkCurrent(rate_e_s=6.0, temperature_k=t, reference_temperature_k=280.0, doubling_k=7.0))
        for t in (259.0, 287.0)
    )
    dark = np.zeros((4, 5))
    assert_allclose(cold.expected_e(dark, 10.0), 6.0 * 10.0 / 8.0, rtol=FLOAT64_SUM)
    assert_allclose(warm.expected_e(dark, 2.0), 6.0 * 2.0 * 2.0, rtol=FLOAT64_SUM)
    assert DarkCurrent(rate_e_s=3.0).actual_rate_e_s == 3.0


def test_dark_current_does_not_go_through_the_flat_field_but_stray_light_does() -> None:
    response = np.full((6, 8), 0.5)
    flat_field = FlatField(response=response)
    dark = DetectorModel(flat=flat_field, dark=DarkCurrent(rate_e_s=4.0))
    stray = DetectorModel(flat=flat_field, stray=StrayLight(level_e_s=4.0))
    assert_allclose(dark.expected_e(np.zeros((6, 8)), 3.0), 12.0, rtol=FLOAT64_SUM)
    assert_allclose(stray.expected_e(np.zeros((6, 8)), 3.0), 6.0, rtol=FLOAT64_SUM)


def test_stray_light_is_a_plane_and_a_glow() -> None:
    stray = StrayLight(
        level_e_s=100.0, gradient_e_s_px=(0.5, -0.25), glow_e_s=40.0, glow_center_px=(10.0, 20.0), glow_sigma_px=3.0
    )
    rate = stray.rate_e_s(101, 61)
    plane = dataclasses.replace(stray, glow_e_s=0.0).rate_e_s(101, 61)
    assert plane[30, 50] == pytest.approx(100.0)
    assert plane[31, 52] - plane[30, 50] == pytest.approx(2 * 0.5 - 0.25)
    glow = rate - plane
    assert divmod(int(glow.argmax()), 101) == (20, 10)
    assert_allclose(glow.sum(), 40.0 * 2.0 * np.pi * 9.0, rtol=2e-3)  # 3.4 sigma of it lie inside the left edge
    steep = StrayLight(level_e_s=1.0, gradient_e_s_px=(1.0, 0.0)).rate_e_s(11, 3)
    assert steep.min() == 0.0


def test_vignetting_takes_its_part_in_the_corners_and_nothing_in_the_middle() -> None:
    factor = FlatField(vignetting=0.3).factor(1001, 501)
    assert factor[250, 500] == 1.0
    assert_allclose(factor[0, 0], 0.7, rtol=0, atol=2e-3)  # the middle of the corner pixel, not the corner
    assert_allclose(factor[250, 0], 1.0 - 0.3 * 500**2 / (500.5**2 + 250.5**2), rtol=FLOAT64_SUM)


def test_a_flat_field_of_another_size_is_refused() -> None:
    with pytest.raises(InputError, match="flat field"):
        expose(flat(1.0, 8), 1.0, WIDE, seed=0, model=DetectorModel(flat=FlatField(response=np.ones((3, 3)))))


def test_transfer_smear_is_the_mean_of_the_column_times_transfer_over_exposure_time() -> None:
    light = np.random.default_rng(2).uniform(0.0, 1e4, (50, 20))
    row_time_s, exposure_s = 2e-5, 0.04
    smear = FrameTransfer(row_time_s=row_time_s).smear_e(light, exposure_s)
    own = light * row_time_s / exposure_s  # a row does not smear itself
    expected = light.mean(axis=0) * (50 * row_time_s) / exposure_s
    assert_allclose(smear + own, np.broadcast_to(expected, light.shape), rtol=FLOAT64_SUM)


def test_without_a_sweep_before_only_the_rows_towards_the_storage_smear() -> None:
    light = np.zeros((10, 3))
    light[4, 1] = 1000.0
    for storage, beyond in ((StorageSide.FIRST_ROW, slice(5, None)), (StorageSide.LAST_ROW, slice(None, 4))):
        smear = FrameTransfer(row_time_s=1e-3, storage=storage, swept_before=False).smear_e(light, 0.1)
        expected = np.zeros_like(light)
        expected[beyond, 1] = 10.0
        assert_allclose(smear, expected, rtol=0, atol=FLOAT64_SUM)


# single pixels and particles ------------------------------------------------------------------------------


def test_hot_and_dead_pixels_are_where_they_are_said_to_be_and_nowhere_else() -> None:
    hot_px = np.array([[3, 5], [60, 61]])
    dead_px = np.array([[7, 8], [0, 0], [99, 1]])  # the last lies outside
    model = DetectorModel(
        hot_pixels=HotPixels(points_px=hot_px, rate_e_s=np.array([5e4, 8e4])),
        dead_px=dead_px,
        cosmic_rays=CosmicRays(hits_per_image=500.0),
    )
    quiet = dataclasses.replace(WIDE, read_noise_e=0.0)
    pixels = expose(flat(4000.0, 64), 1.0, quiet, seed=1, model=model).pixels
    dark = np.argwhere(pixels == 200)[:, ::-1]
    assert sorted(dark.tolist()) == [[0, 0], [7, 8]]
    expected = model.expected_e(flat(4000.0, 64), 1.0)
    assert sorted(np.argwhere(expected > 4000.0)[:, ::-1].tolist()) == [[3, 5], [60, 61]]


def test_scattered_pixels_cover_the_whole_detector_evenly() -> None:
    count = 40_000
    points = scattered_pixels(count, 40, 30, np.random.default_rng(5))
    assert points.min(axis=0).tolist() == [0, 0]
    assert points.max(axis=0).tolist() == [39, 29]
    for axis, size in ((0, 40), (1, 30)):
        spread = np.sqrt((size**2 - 1) / 12.0 / count)
        assert_allclose(points[:, axis].mean(), (size - 1) / 2, rtol=0, atol=SIGMAS * spread)


def test_the_number_of_hits_follows_area_and_exposure() -> None:
    rays = CosmicRays(rate_s_cm2=5.0, pixel_um=20.0)
    expected = 5.0 * (500 * 20e-4) * (400 * 20e-4) * 50.0  # 1 cm by 0.8 cm
    assert rays.mean_hits(500, 400, 50.0) == pytest.approx(expected)
    counts = [draw_tracks(rays, 500, 400, 50.0, np.random.default_rng([7, k])).charge_e.size for k in range(50)]
    assert_allclose(np.sum(counts), 50 * expected, rtol=0, atol=SIGMAS * np.sqrt(50 * expected))


def test_particles_from_everywhere_alike_leave_twice_the_charge_of_the_depth() -> None:
    """The mean of 1 / cos over an isotropic flux through a surface is 2; it is cut off at cos = 0.02 here."""
    count = 20_000.0
    rays = CosmicRays(hits_per_image=count, charge_spread=0.0, thickness_um=12.0, charge_e_um=80.0)
    charge = draw_tracks(rays, 300, 300, 1.0, np.random.default_rng(8)).charge_e / (12.0 * 80.0)
    mean = 2.0 * (1.0 - 0.02) / (1.0 - 0.02**2)
    variance = 2.0 * np.log(1.0 / 0.02) / (1.0 - 0.02**2) - mean**2
    assert_allclose(charge.mean(), mean, rtol=0, atol=SIGMAS * np.sqrt(variance / charge.size))
    assert charge.min() >= 1.0


def test_a_track_leaves_all_its_charge_along_a_straight_line() -> None:
    tracks = Tracks(
        start_px=np.array([[5.0, 5.0], [12.0, 30.0]]),
        end_px=np.array([[25.0, 15.0], [12.0, 30.0]]),
        charge_e=np.array([3000.0, 500.0]),
    )
    frame = tracks.deposited_e(40, 40)
    assert frame.sum() == pytest.approx(3500.0)
    assert frame[30, 12] == pytest.approx(500.0)
    y, x = np.nonzero(frame)
    track = y < 20
    off_px = np.abs((x[track] - 5.0) * 10.0 - (y[track] - 5.0) * 20.0) / np.hypot(20.0, 10.0)
    assert off_px.max() <= np.sqrt(0.5)  # half the diagonal of a pixel
    assert_allclose((frame[:20] * np.arange(40)).sum() / 3000.0, 15.0, rtol=0, atol=SETTLED)


# full well ------------------------------------------------------------------------------------------------


def test_blooming_keeps_the_charge_and_fills_no_pixel_beyond_its_capacity() -> None:
    random = np.random.default_rng(6)
    charge = random.uniform(0.0, 900.0, (200, 60))
    charge[90:110, 5:50:3] += random.uniform(0.0, 8000.0, (20, 15))
    held = FullWell(capacity_e=1000.0, blooming=True).held_e(charge)
    assert held.max() <= 1000.0 + 1e-9
    assert_allclose(held.sum(axis=0), charge.sum(axis=0), rtol=FLOAT64_SUM)
    untouched = (charge <= 1000.0).all(axis=0)
    assert untouched.any()
    assert np.array_equal(held[:, untouched], charge[:, untouched])
    assert (held >= np.minimum(charge, 1000.0) - 1e-9).all()


def test_charge_spills_half_either_way_along_the_column() -> None:
    charge = np.zeros((41, 3))
    charge[20, 1] = 9000.0
    held = FullWell(capacity_e=1000.0, blooming=True).held_e(charge)
    expected = np.zeros(41)
    expected[16:25] = 1000.0
    assert_allclose(held[:, 1], expected, rtol=0, atol=FLOAT64_SUM)
    assert held[:, [0, 2]].sum() == 0.0


def test_charge_that_reaches_an_edge_drains_off_and_without_blooming_it_is_lost_at_once() -> None:
    charge = np.zeros((10, 1))
    charge[0, 0] = 5000.0
    assert FullWell(capacity_e=1000.0, blooming=True).held_e(charge).sum() == pytest.approx(3000.0)
    assert FullWell(capacity_e=1000.0).held_e(charge).sum() == pytest.approx(1000.0)
    assert np.array_equal(FullWell().held_e(charge), charge)


# motion ---------------------------------------------------------------------------------------------------


def sky_light(camera: Camera, shot: Shot, count: int = 1, spread_deg: float = 0.0) -> IncidentLight:
    return incident_light(
        shot,
        camera,
        Sources(catalog=small_catalog(count, 0.0, 90.0, spread_deg), photometry=Photometry(zero_point_e_s=1e6)),
        np.random.default_rng(1),
    )


def turning(rate_rad_s: tuple[float, float, float], exposure_s: float = 2.0) -> Shot:
    shot = dataclasses.replace(shot_of(exposure_s), observer=None)
    return dataclasses.replace(shot, angular_rate_camera_rad_s=np.array(rate_rad_s))


def moments(frame: Float) -> tuple[Float, NDArray[np.float64]]:
    """Centroid (2,) and second moments (2, 2) of an image."""
    y, x = np.indices(frame.shape)
    points = np.stack([x.ravel(), y.ravel()], axis=-1)
    centroid = np.average(points, axis=0, weights=frame.ravel())
    return centroid, np.cov(points.T, aweights=frame.ravel(), ddof=0)


def test_smear_keeps_the_light_and_the_place_of_a_star_and_widens_it_along_the_motion() -> None:
    """A uniform motion over L adds L^2 / 12 to the variance along it; PSF and pixel give sigma^2 + 1/12."""
    camera = small_camera()
    still = sky_light(camera, turning((0.0, 0.0, 0.0)))
    moved = sky_light(camera, turning((0.0, 0.006, 0.0)))  # 12 px of 1000 px focal length in 2 s, along x
    centroid, variance = moments(moved.electrons)
    at_rest, width = moments(still.electrons)
    assert_allclose(moved.electrons.sum(), moved.star_electrons.sum(), rtol=FLOAT64_ROOT)
    assert_allclose(moved.electrons.sum(), still.electrons.sum(), rtol=FLOAT64_ROOT)
    assert_allclose(centroid, at_rest, rtol=0, atol=1e-3)  # the projection is not quite linear: 12 px in 1000
    round_px2 = 0.8**2 + 1.0 / 12.0
    assert_allclose(np.diag(width), round_px2, rtol=0, atol=0.02)  # a pixel adds 1/12 on average over places
    assert_allclose(np.diag(variance), [round_px2 + 12.0**2 / 12.0, round_px2], rtol=0, atol=0.02)


def test_a_camera_that_turns_to_the_right_sees_the_stars_go_left() -> None:
    shot = turning((0.0, 0.01, 0.0))  # about +y (down): the boresight goes from +z to +x
    star = rotate(shot.at(-1.0).camera_from_inertial.inv(), [0.0, 0.0, 1.0])
    assert rotate(shot.at(1.0).camera_from_inertial, star)[0] < -0.019


def test_a_turn_about_the_line_of_sight_smears_the_corners_and_not_the_middle() -> None:
    camera = small_camera()
    light = sky_light(camera, turning((0.0, 0.0, 0.02)), count=60, spread_deg=0.05)
    assert light.electrons.sum() == pytest.approx(light.star_electrons.sum(), rel=FLOAT32)
    _, variance = moments(light.electrons)
    _, still = moments(sky_light(camera, turning((0.0, 0.0, 0.0)), count=60, spread_deg=0.05).electrons)
    assert_allclose(variance, still, rtol=0, atol=0.2)  # all stars lie within 2 px of the axis


def test_moments_of_an_exposure_integrate_a_gaussian_over_its_path() -> None:
    steps = instants(3.0, 25.0, 0.8)
    assert sum(step.share for step in steps) == pytest.approx(1.0, abs=FLOAT64)
    offsets = np.array([step.since_middle_s for step in steps]) / 3.0 * 25.0
    shares = np.array([step.share for step in steps])
    at = np.linspace(-20.0, 20.0, 81)[:, None]
    mine = (shares * np.exp(-0.5 * ((at - offsets) / 0.8) ** 2)).sum(axis=1)
    fine = np.linspace(-12.5, 12.5, 100_001)[None, :]
    exact = np.array([np.exp(-0.5 * ((x - fine) / 0.8) ** 2).mean() for x in at[:, 0]])
    assert_allclose(mine, exact, rtol=0, atol=FLOAT32_SUM)
    assert len(instants(3.0, 0.01, 0.8)) == 1


def test_a_body_is_smeared_like_the_stars_about_it() -> None:
    camera = small_camera()
    shot = dataclasses.replace(shot_of(1e-3), angular_rate_camera_rad_s=np.array([0.0, 5.0, 0.0]))
    still = simulate_image(shot_of(1e-3), camera, Sources(scene=sphere_scene(1500.0, 30.0)), seed=1).readout.expected_e
    moved = simulate_image(shot, camera, Sources(scene=sphere_scene(1500.0, 30.0)), seed=1).readout.expected_e
    assert_allclose(moved.sum(), still.sum(), rtol=1e-3)  # sampling of a sphere of 40 px
    at_rest, width = moments(still)
    centroid, variance = moments(moved)
    assert_allclose(centroid, at_rest, rtol=0, atol=SAME_PLACE_PX)
    assert_allclose(variance - width, [[5.0**2 / 12.0, 0.0], [0.0, 0.0]], rtol=0, atol=0.2)


def test_a_star_behind_a_body_for_part_of_the_exposure_gives_part_of_its_light() -> None:
    """The spacecraft flies by at 30 km/s, 1000 km from a ball of 30 km, which crosses 15 px in half a second."""
    camera, exposure_s = small_camera(), 0.5
    ball = FixedEphemeris(position_km=OBSERVER.position_km + np.array([0.0, 0.0, 1000.0]))
    target = Target(name="BALL", shape=sphere(30.0), ephemeris=ball)
    scene = Scene(
        targets=(target,), light=DistantLight(np.array([0.0, 0.5, 0.8])), light_time=False, stellar_aberration=False
    )
    offsets = np.random.default_rng(2).uniform(-60.0, 60.0, (400, 2))
    light = incident_light(
        shot_of(exposure_s),
        camera,
        Sources(scene=scene, catalog=catalog_at(camera, camera.center_px + offsets)),
        np.random.default_rng(1),
        options=SimulationOptions(rays_per_pixel_side=1, min_rays_across=32),
    )
    share = light.star_electrons / (Photometry().star_rate_e_s(light.stars.magnitudes) * exposure_s)
    x, y = (light.stars.points_px - camera.center_px).T
    seconds = np.linspace(-0.5, 0.5, 2001)[:, None] * exposure_s
    # The ball goes up as the camera goes down. A pixel is hidden as a whole, so its edge is good to a pixel.
    most, least = ((np.hypot(x, y + 30.0 * seconds) > radius).mean(axis=0) for radius in (29.0, 31.0))
    quantum = 0.5 * np.pi / 31.0  # the largest share of one of the 31 moments
    assert (share > least - quantum).all()
    assert (share < most + quantum).all()
    assert ((share > 0.2) & (share < 0.8)).sum() > 10


# centroids ------------------------------------------------------------------------------------------------


def test_centroids_of_simulated_stars_are_unbiased() -> None:
    camera = dataclasses.replace(small_camera(400, focal_px=3000.0), detector=WIDE)
    places = np.stack(np.meshgrid(np.arange(20.0, 390.0, 20.0), np.arange(20.0, 390.0, 20.0)), axis=-1).reshape(-1, 2)
    places += np.random.default_rng(12).uniform(-0.5, 0.5, places.shape)
    shot = dataclasses.replace(shot_of(1.0), observer=None)
    zero_point_e_s = 3e6  # SNR 30 to 500 at magnitudes 4 to 8
    taken = simulate_image(
        shot,
        camera,
        Sources(catalog=catalog_at(camera, places), photometry=Photometry(zero_point_e_s=zero_point_e_s)),
        seed=5,
    )
    found = detect_sources(taken.image.pixels, detector=camera.detector, psf_sigma_px=0.8)
    assert not isinstance(found, Failure)
    distance = np.linalg.norm(found.points_px[:, None, :] - taken.stars.points_px[None, :, :], axis=2)
    of_star = distance.argmin(axis=0)
    matched = distance.min(axis=0) < 0.5
    assert matched.mean() > 0.95
    error = (found.points_px[of_star] - taken.stars.points_px)[matched]
    # Sky of read noise and rounding, photons of the star: the Cramer-Rao bound of a Gaussian, at least.
    electrons = taken.star_electrons[matched]
    noise_e2 = float(WIDE.variance_dn2(np.array(0.0))) * WIDE.gain_e_per_dn**2
    sigma = np.sqrt(0.72 / electrons + 8.0 * np.pi * 0.72**2 * noise_e2 / electrons**2)
    mean = (error / sigma[:, None] ** 2).sum(axis=0) / (1.0 / sigma**2).sum()
    bound = 1.0 / np.sqrt((1.0 / sigma**2).sum())
    assert bound < 0.001
    assert_allclose(mean, 0.0, rtol=0, atol=SIGMAS * 1.2 * bound)  # the fit reaches the bound to 1.04
