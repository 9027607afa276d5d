"""Replay of Artemis I: what it is made of, and that it says what its rules say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from giantlike.core.outcomes import Failure
from giantlike.independent import ReliefBody, rough
from giantlike.missions import Replay, ReplaySettings, run_replay, save_replay
from giantlike.missions.artemis1.calibrations import ground_model, lens_of, run_sessions
from giantlike.missions.artemis1.images import (
    detected_altitude_km,
    earth_shot,
    limb_px,
    moon_shot,
)
from giantlike.missions.artemis1.measure import iterative, non_iterative, residual_px
from giantlike.missions.artemis1.passes import load, preflight_sigmas_px, sun_direction, times_of
from giantlike.missions.artemis1.simulate import exposures_of
from giantlike.relative.horizon.geometry import Altitude, horizon_residuals
from tests.tolerances import PLACE_PX

SETTING = load()
NAMED = (
    *(f"Fig. {number}" for number in (4, 5, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21)),
    "Fig. 6",
)


@pytest.fixture(scope="module", name="told")
def _told(tmp_path_factory: pytest.TempPathFactory) -> tuple[Replay, Path]:
    settings = ReplaySettings(output=tmp_path_factory.mktemp("artemis1"), small=True)
    replay = run_replay("artemis1", settings)
    save_replay(replay, settings)
    return replay, settings.output


@pytest.mark.slow
def test_the_replay_has_every_figure(told: tuple[Replay, Path]) -> None:
    replay, output = told
    figures = [figure.reference for section in replay.sections for figure in section.figures]
    assert sorted(figures) == sorted(NAMED)
    assert (output / "report.html").stat().st_size > 50_000
    assert any("TUNED" in each for each in replay.assumptions)


@pytest.mark.slow
def test_the_limb_of_the_earth_and_the_bias_of_the_filter_come_out_as_flown(told: tuple[Replay, Path]) -> None:
    replay, _ = told
    found = {each.what: each for each in replay.comparisons}
    for number in (1, 2):
        altitude = found[f"pass {number}: average altitude of the limb by the whole-pass estimator, km"]
        assert isinstance(altitude.ours, float)
        assert 18.0 < altitude.ours < 29.0
        bias = found[f"bias of the radius at the end of pass {number} in a filter that assumes 35 km, km"]
        assert isinstance(bias.ours, float)
        assert altitude.ours + bias.ours == pytest.approx(35.0, abs=1.0)  # two ways to the same


def test_the_passes_are_those_of_table_1() -> None:
    assert [each.number for each in SETTING.passes] == [*range(1, 16), 18, 19, 20, 22, 23, 24, 25, 26]
    assert sum(each.target == "earth" for each in SETTING.passes) == 5
    assert times_of(SETTING, SETTING.find_pass(1)).size == 241
    assert times_of(SETTING, SETTING.find_pass(5)).size == 21
    assert SETTING.find_pass(3).range_km == pytest.approx(252_428, abs=1.0)


def test_preflight_models_have_the_published_values() -> None:
    far = preflight_sigmas_px("moon", 1e12)
    np.testing.assert_allclose(far, [0.15, 0.06, 0.12], rtol=1e-6)
    # 7291.7 px times 6562 ft over a range of a hundred million feet is 0.478 px.
    near = preflight_sigmas_px("moon", 1e8 * 0.3048e-3)
    np.testing.assert_allclose(near, np.hypot([0.15, 0.06, 0.12], [0.4785, 0.2392, 0.4785]), atol=1e-4)
    np.testing.assert_allclose(preflight_sigmas_px("earth", 1e5), [0.065, 0.025, 0.058])


def test_exposures_are_driven_down_and_then_toggle() -> None:
    exposures = exposures_of(SETTING, 20)
    assert exposures[0] == 200.0
    assert set(exposures[4:]) == {1.0, 50.0}
    assert np.all(exposures[4:-1] != exposures[5:])


def test_the_atmosphere_is_seen_where_it_becomes_opaque() -> None:
    expected_km = SETTING.air.limb_altitude_km(float(SETTING.figure("earth").radii_km.mean()))
    assert detected_altitude_km(SETTING, 1.0) == pytest.approx(expected_km, abs=0.02)
    assert detected_altitude_km(SETTING, 50.0) > detected_altitude_km(SETTING, 1.0) + 5.0


def test_limb_points_lie_on_the_horizon_of_the_ellipsoid() -> None:
    figure, position = SETTING.figure("earth"), np.array([900.0, -400.0, 150_000.0])
    points, normals = limb_px(SETTING.model, figure, position, np.linspace(0.0, 6.0, 40))
    residuals = horizon_residuals(points, SETTING.model, figure, position)[0]
    assert np.abs(residuals).max() < PLACE_PX
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)


def test_both_algorithms_find_the_body_in_an_image_through_the_true_lens_and_not_through_another() -> None:
    one, lens, figure = SETTING.find_pass(3), lens_of(SETTING, 1, 2), SETTING.figure("moon")
    sun, position = sun_direction(one.phase_deg), np.array([40_000.0, -25_000.0, one.range_km])
    radius = float(figure.radii_km[0])
    smooth = ReliefBody(figure.radii_km, rough(1, rms=1e-6))
    errors = []
    for camera in (lens, ground_model(SETTING)):
        shot = moon_shot(SETTING, smooth, one, position, lens, camera, np.random.default_rng(3))
        first = non_iterative(SETTING, shot, sun, figure)
        assert isinstance(first, tuple)
        second = iterative(SETTING, shot, sun, figure, first[0])
        assert isinstance(second, np.ndarray)
        errors.append([residual_px(camera, radius, each, position, sun) for each in (first[0], second)])
    assert np.abs(errors[0][0]).max() < 0.3  # bias of edges by moments
    assert np.abs(errors[0][1]).max() < 0.12  # knows law and blur
    assert np.abs(errors[1][1]).max() > 0.2  # the lens shifted after launch


def test_no_fix_comes_from_an_image_of_noise() -> None:
    one, figure = SETTING.find_pass(3), SETTING.figure("moon")
    sun, lens, rng = sun_direction(one.phase_deg), ground_model(SETTING), np.random.default_rng(5)
    smooth = ReliefBody(figure.radii_km, rough(1, rms=1e-6))
    shot = moon_shot(SETTING, smooth, one, np.array([0.0, 0.0, one.range_km]), lens, lens, rng)
    noise = replace(shot, pixels_dn=rng.normal(0.0, 3.0, shot.pixels_dn.shape))
    assert isinstance(non_iterative(SETTING, noise, sun, figure), Failure)


@pytest.mark.slow
def test_the_lens_is_found_from_star_images_and_a_radiation_strike_is_rejected_by_its_residual(
    told: tuple[Replay, Path],
) -> None:
    found = {each.what: each for each in told[0].comparisons}
    assert found["calibration with the strike, once outliers are rejected"].ours == "accepted"
    settings = ReplaySettings(output=told[1], small=True)
    (session,) = run_sessions(SETTING, settings, (2,))
    true = lens_of(SETTING, settings.seed, 2)
    result = session.fits[-1]
    off = np.array([getattr(session.camera, name) - getattr(true, name) for name in result.estimated])
    assert off @ np.linalg.solve(result.covariance, off) < stats.chi2.ppf(0.999, len(off))


def test_the_limb_of_an_image_of_the_earth_stands_at_the_altitude_of_its_light() -> None:
    one = SETTING.find_pass(1)
    sun, position = sun_direction(one.phase_deg), np.array([0.0, 0.0, one.range_km])
    shot = earth_shot(SETTING, position, sun, 1.0, np.random.default_rng(4))
    expected_km = detected_altitude_km(SETTING, 1.0)
    fitted = non_iterative(SETTING, shot, sun, Altitude(expected_km).above(SETTING.figure("earth")))
    assert isinstance(fitted, tuple)
    off = residual_px(SETTING.model, 6371.0, fitted[0], position, sun)
    assert abs(off[2]) < 0.2  # 4 km: edges by moments are not quite edges of area
