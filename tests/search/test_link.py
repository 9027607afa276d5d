"""Tracks: found where there are any, and as few without as they say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import poisson

from benchmarks.search_truth import PIXEL_RAD, as_residuals, camera, empty_sequence, event
from giantlike.core.errors import InputError
from giantlike.search import LinkOptions, Residuals, Track, compare_residuals, link

OPTIONS = LinkOptions(max_rate_px_s=1.0)


def with_object(seed: int, *, missed: tuple[int, ...] = (), rate: float = 0.5) -> list[Residuals]:
    """An empty sequence of eight images, and as the last source of those not missed an object on a straight line."""
    random, sequence = np.random.default_rng(100 + seed), empty_sequence(seed)
    start, direction = random.uniform(80.0, 170.0, 2), random.normal(size=2)
    direction /= np.linalg.norm(direction)
    result = []
    for k, one in enumerate(sequence):
        if k in missed:
            result.append(one)
            continue
        place = start + rate * one.et * direction - rate * sequence[4].et * direction
        sky = Rotation.identity().apply(np.array(camera(256).model.unproject(place)))
        truth = np.asarray(one.camera.model.project(one.camera_from_inertial.apply(sky)))
        both = as_residuals(
            one.camera,
            one.et,
            one.camera_from_inertial,
            np.vstack([one.points_px, truth]),
            np.append(one.snr, 12.0),
            random,
            sigma_px=np.append(np.full(len(one), 1e-6), 0.08),
        )
        spread = np.concatenate([one.covariance_px2, 0.08**2 * np.eye(2)[None]])
        result.append(replace(both, covariance_px2=spread, attitude_rad2=one.attitude_rad2))
    return result


def test_where_nothing_moves_tracks_are_as_few_as_stated() -> None:
    """Stars without catalog, hot pixels under drift, groups, jitter; a linker that counts no tries finds dozens."""
    count = 40
    chances = [one.expected_false for seed in range(count) for one in link(empty_sequence(seed), OPTIONS)]
    for limit in (0.01, 0.1, 1.0):
        assert np.count_nonzero(np.array(chances) <= limit) <= poisson.ppf(0.95, limit * count)


def test_objects_are_found_with_all_their_sources() -> None:
    found = 0
    for seed in range(12):
        missed = (3,) if seed % 2 else ()
        sequence = with_object(seed, missed=missed)
        tracks = [one for one in link(sequence, OPTIONS) if one.accepted]
        last = [len(sequence[k]) - 1 if k not in missed else -1 for k in range(8)]
        for one in tracks:
            right = [last[k] == i for k, i in zip(one.images, one.sources, strict=True)]
            if np.mean(right) > 0.99 and len(one) >= 6:
                found += 1
                assert np.hypot(*one.rate_px_s) == pytest.approx(0.5, abs=0.02)
                assert set(one.missed) <= {sequence[3].name} | {
                    sequence[k].name for k in set(range(8)) - set(one.images)
                }
    assert found >= 10


def test_particles_of_an_event_are_told_apart() -> None:
    sequence, owners, acceleration = event(3, particles=60, images=10)
    options = LinkOptions(max_rate_px_s=0.4, max_acceleration_px_s2=acceleration / 2.0)
    tracks = [one for one in link(sequence, options) if one.accepted]
    names = [[owners[k][i] for k, i in zip(one.images, one.sources, strict=True)] for one in tracks]
    pure = [one for one in names if one[0] >= 0 and len(set(one)) == 1]
    bright = np.concatenate([own[one.snr >= 7.0] for one, own in zip(sequence, owners, strict=True)])
    wanted = set(np.flatnonzero(np.bincount(bright[bright >= 0], minlength=60) >= 4).tolist())
    assert len(pure) >= 0.95 * len(tracks)
    assert len(wanted & {int(one[0]) for one in pure}) >= 0.9 * len(wanted)
    assert len({(k, i) for one in tracks for k, i in zip(one.images, one.sources, strict=True)}) == sum(
        map(len, tracks)
    )


def test_failed_fits_link_with_nothing() -> None:
    """Sources of unknown place suit any line: those that are not linkable are in no track."""
    sequence = []
    for one in with_object(1):
        wide = replace(one, covariance_px2=np.tile(25.0 * np.eye(2), (len(one), 1, 1)))
        sequence.append(replace(wide, linkable=np.zeros(len(one), dtype=bool)))
    assert link(sequence, OPTIONS) == ()


def test_an_acceleration_is_followed_where_it_is_asked_for() -> None:
    random, view = np.random.default_rng(5), camera(256)
    times = np.arange(8) * 10.0
    places = np.stack([40.0 + 1.5 * times, 60.0 + 0.5 * times + 0.5 * 0.02 * times**2], axis=1)
    sequence = [
        as_residuals(
            view, time, Rotation.identity(), place[None], np.array([20.0]), random, attitude_rad=0.02 * PIXEL_RAD
        )
        for time, place in zip(times, places, strict=True)
    ]
    straight, bent = (
        link(sequence, replace(OPTIONS, max_rate_px_s=3.0, max_acceleration_px_s2=a)) for a in (0.0, 0.02)
    )
    assert max(map(len, straight), default=0) < 8
    assert [len(one) for one in bent] == [8]
    assert isinstance(bent[0], Track)
    assert bent[0].acceleration_px_s2 == pytest.approx([0.0, 0.02], abs=0.002)


def test_times_that_go_back_and_rates_that_link_all_are_refused() -> None:
    sequence = empty_sequence(1)
    with pytest.raises(InputError, match="order of time"):
        link(sequence[::-1], OPTIONS)
    with pytest.raises(InputError, match="order of time"):
        link([sequence[0], sequence[0], *sequence[1:]], OPTIONS)
    with pytest.raises(InputError, match="min_detections"):
        LinkOptions(min_detections=2)
    crowded = [
        as_residuals(
            camera(), one.et, Rotation.identity(), np.random.default_rng(k).uniform(0, 1000, (10_000, 2)),
            np.full(10_000, 9.0), np.random.default_rng(k),
        )
        for k, one in enumerate(sequence[:4])
    ]  # fmt: skip
    with pytest.raises(InputError, match="max_rate_px_s"):
        link(crowded, OPTIONS)
    assert link(sequence[:3], OPTIONS) == ()


def test_an_image_of_another_sky_before_a_sequence_changes_nothing() -> None:
    """Its plane would stretch the distances between stars, which then seemed to move."""
    sequence = empty_sequence(1)
    turn = Rotation.from_rotvec([0.0, 1.2, 0.0])
    far = as_residuals(
        sequence[0].camera, -10.0, turn, np.array([[100.0, 100.0]]), np.array([9.0]), np.random.default_rng(1)
    )
    with_it = compare_residuals([far, *sequence])[1:]
    for one, other in zip(with_it, compare_residuals(sequence), strict=True):
        assert one.kinds.tolist() == other.kinds.tolist()
