"""Lines and orbits of tracks: errors that hold, and a word where the range is not observed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.search_truth import event, orbit_track
from giantlike.core.errors import InputError
from giantlike.core.outcomes import Failure, Reason
from giantlike.dynamics import PointMasses, fly, fly_through
from giantlike.search import LinkOptions, MotionFix, MotionOptions, Orbit, Track, fit_motion, link

SEEDS = range(12)


@pytest.fixture(scope="module")
def fits() -> list[tuple[MotionFix | Failure, np.ndarray]]:
    result = []
    for seed in SEEDS:
        track, truth, _, gravity, sigma = orbit_track(seed)
        if track is not None:
            options = MotionOptions(models=("orbit",), gravity=gravity, gm_sigma_km3_s2=sigma)
            result.append((fit_motion(track, options), truth))
    return result


def test_errors_of_orbits_are_as_stated_with_wrong_gravity_attitude_and_spacecraft(
    fits: list[tuple[MotionFix | Failure, np.ndarray]],
) -> None:
    squares = []
    for fit, truth in fits:
        if isinstance(fit, MotionFix):
            assert isinstance(fit.orbit, Orbit)
            units = np.repeat([1.0, 1e-4], 3)
            error, covariance = (fit.orbit.state - truth) / units, fit.orbit.covariance / np.outer(units, units)
            squares.append(float(error @ np.linalg.solve(covariance, error)))
            assert np.allclose(sum(fit.orbit.parts.values()), fit.orbit.covariance, rtol=1e-6, atol=0.0)
            assert set(fit.orbit.parts) == {"noise", "attitude", "spacecraft", "gravity"}
    assert len(squares) >= 3
    assert max(squares) < 22.5  # of 6 coordinates once in a thousand
    assert sum(squares) / 6.0 < 2.0 * len(squares)


def test_mirror_images_across_the_sky_are_told(fits: list[tuple[MotionFix | Failure, np.ndarray]]) -> None:
    """Where two orbits fit, the range of the true one is among those in the detail."""
    told = [(fit, truth) for fit, truth in fits if isinstance(fit, Failure)]
    assert told
    for fit, _ in told:
        assert fit.reason is Reason.DEGENERATE_GEOMETRY
        assert "km" in fit.detail


def test_two_orbits_that_are_ends_of_one_valley_are_both_within_the_errors() -> None:
    """Near the plane of the sky through the body, images show only the square of the distance behind it."""
    track, truth, _, gravity, sigma = orbit_track(49)
    assert isinstance(track, Track)
    fit = fit_motion(track, MotionOptions(models=("orbit",), gravity=gravity, gm_sigma_km3_s2=sigma))
    assert isinstance(fit, MotionFix)
    assert isinstance(fit.orbit, Orbit)
    errors = (fit.orbit.state - truth) / np.sqrt(np.diag(fit.orbit.covariance))
    assert float(np.abs(errors).max()) < 3.0


def test_short_arcs_have_a_line_and_the_ranges_of_bound_orbits() -> None:
    track, _, _, gravity, sigma = orbit_track(1, images=6, step_s=20.0)
    assert isinstance(track, Track)
    fit = fit_motion(track, MotionOptions(gravity=gravity, gm_sigma_km3_s2=sigma))
    assert isinstance(fit, MotionFix)
    assert fit.model == "sky_line"
    assert isinstance(fit.orbit, Failure)
    assert fit.orbit.reason is Reason.DEGENERATE_GEOMETRY
    assert "bound at ranges" in fit.orbit.detail
    alone = fit_motion(track, MotionOptions(models=("orbit",), gravity=gravity))
    assert isinstance(alone, Failure)
    assert alone.reason is Reason.DEGENERATE_GEOMETRY


def test_without_gravity_or_body_there_are_lines_only() -> None:
    sequence, _, acceleration = event(3, particles=20, images=10)
    tracks = link(sequence, LinkOptions(max_rate_px_s=0.4, max_acceleration_px_s2=acceleration / 2.0))
    fits = [fit_motion(one, MotionOptions(gravity=PointMasses(4.89e-9))) for one in tracks]
    lines = [one for one in fits if isinstance(one, MotionFix)]
    assert lines
    assert all(one.orbit is None and one.model == "sky_line" for one in lines)
    assert all(one.reason is Reason.LARGE_RESIDUALS for one in fits if isinstance(one, Failure))  # strongly bent
    refused = fit_motion(tracks[0], MotionOptions(models=("orbit",), gravity=PointMasses(4.89e-9)))
    assert isinstance(refused, Failure)
    assert refused.reason is Reason.NO_GEOMETRY
    with pytest.raises(InputError, match="models"):
        MotionOptions(models=("parabola",))
    with pytest.raises(InputError, match="gm_sigma"):
        replace(MotionOptions(), gm_sigma_km3_s2=-1.0)


def test_flights_through_several_times_are_those_to_each() -> None:
    gravity, state = PointMasses(4.89e-9), np.array([0.5, 0.1, 0.0, 0.0, 9e-5, 2e-5])
    times = [300.0, -500.0, 0.0, 900.0, 300.0]
    through = fly_through(gravity, 100.0, state, times)
    for k, time in enumerate(times):
        one = fly(gravity, 100.0, state, time)
        assert through.state[k] == pytest.approx(one.state, abs=1e-8)
        assert through.by_state[k] == pytest.approx(one.by_state, rel=1e-6, abs=1e-6)
