"""Tracks by a shape: landmarks found in independent images of a rotating rock, and the network that they make."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from benchmarks.network_truth import MEAN_KM, PERIOD_S, Sequence, Told, sequence
from giantlike.core.arrays import Float, unit
from giantlike.core.causes import Cause
from giantlike.core.errors import InputError
from giantlike.core.light import aberrate, boosted
from giantlike.core.outcomes import Failure, Reason
from giantlike.ephemeris import DistantLight
from giantlike.network import FoundTracks, NetworkFix, Photo, TrackOptions, adjust, find_tracks, photo_of
from giantlike.scene import Scene
from giantlike.shapes import Ellipsoid
from tests.tolerances import FLOAT64, FLOAT64_CHAIN

RIGHT_PX = 1.0


@cache
def seen() -> tuple[Sequence, FoundTracks]:
    """Images of a third of a revolution, poses off by 2 px and more."""
    rock = sequence(1, told=Told(relief=0.004, law="lommel_seeliger"), images=6, diameter_px=130.0, revolutions=0.35)
    found = find_tracks(rock.images, rock.camera, rock.scene)
    assert isinstance(found, FoundTracks), found
    return rock, found


def true_pixels(rock: Sequence, found: FoundTracks) -> Float:
    """Where the ground of each landmark is in the images, by the true poses."""
    tracks, names = found.tracks, [image.name for image in rock.images]
    points = rock.true_point(np.asarray(tracks.points_km))
    pixels = np.empty((len(tracks.point), 2))
    for number, photo in enumerate(found.photos):
        mine, k = tracks.photo == number, names.index(photo.name)
        inertial = rock.rotation.inertial_from_body(photo.et).apply(points[tracks.point[mine]])
        pixels[mine] = rock.view.project(rock.attitudes[k].apply(inertial - rock.positions_km[k]))
    return pixels


def test_landmarks_are_found_where_they_are_and_wrong_ones_are_rejected() -> None:
    rock, found = seen()
    off = np.linalg.norm(found.tracks.points_px - true_pixels(rock, found), axis=1)
    assert len(off) > 30
    assert np.mean(off < RIGHT_PX) > 0.8
    fix = adjust(found.photos, found.tracks)
    assert isinstance(fix, NetworkFix)
    assert np.mean(off[fix.used] > RIGHT_PX) < 0.06


def test_poses_get_better_and_their_covariance_holds() -> None:
    rock, found = seen()
    fix = adjust(found.photos, found.tracks).unwrap()
    before, after, squares = [], [], []
    for known, photo in zip(found.photos, fix.photos, strict=True):
        k = [image.name for image in rock.images].index(photo.name)
        before.append(np.linalg.norm(rock.positions_km[k] - known.position_km))
        error = rock.positions_km[k] - photo.position_km
        after.append(np.linalg.norm(error))
        turn = (rock.attitudes[k] * photo.camera_from_inertial.inv()).as_rotvec()
        pose = np.concatenate([turn, error])
        assert photo.covariance_pose is not None
        squares.append(pose @ np.linalg.solve(photo.covariance_pose, pose) / 6.0)
    assert np.mean(after) < 0.7 * np.mean(before)
    assert 0.3 < np.mean(squares) < 3.0


def test_the_spread_of_the_ground_about_the_shape_is_found() -> None:
    _, found = seen()
    true = 0.004 * MEAN_KM / np.sqrt(3.0)  # per axis, of heights along the radius
    assert 0.4 * true < found.sigma_points_km < 3.0 * true
    assert 0.0 < found.floor_px < 0.5
    told = find_tracks(seen()[0].images[:2], seen()[0].camera, seen()[0].scene,
                       options=TrackOptions(sigma_points_km=0.5))  # fmt: skip
    assert isinstance(told, FoundTracks)
    assert told.sigma_points_km == 0.5


def test_an_image_without_attitude_is_left_out_and_a_body_without_ground_is_refused() -> None:
    rock, _ = seen()
    lost = [*rock.images[:2], replace(rock.images[2], camera_from_inertial=None, attitude_covariance_rad2=None)]
    found = find_tracks(lost, rock.camera, rock.scene)
    assert isinstance(found, FoundTracks)
    assert [str(one.reason) for one in found.failures.values()] == ["no_attitude"]
    alone = find_tracks(rock.images[:1], rock.camera, rock.scene)
    assert isinstance(alone, Failure)
    assert alone.reason is Reason.TOO_FEW_MATCHES
    smooth = replace(rock.scene.targets[0], shape=Ellipsoid(radii_km=np.array([10.0, 9.0, 8.0])))
    refused = find_tracks(rock.images, rock.camera, replace(rock.scene, targets=(smooth,)))
    assert isinstance(refused, Failure)
    assert refused.reason is Reason.WRONG_SHAPE


def test_options_are_checked() -> None:
    with pytest.raises(InputError, match="search_px"):
        TrackOptions(search_px=0)
    with pytest.raises(InputError, match="min_score"):
        TrackOptions(min_score=1.0)
    with pytest.raises(InputError, match="sigma_points_km"):
        TrackOptions(sigma_points_km=-1.0)


class Moving:
    """Ephemeris of a body or camera that moves uniformly."""

    origin = "SOLAR SYSTEM BARYCENTER"

    def __init__(self, place_km: Float, velocity_km_s: Float, et: float) -> None:
        self.place_km, self.velocity_km_s, self.et = place_km, velocity_km_s, et

    def state(self, et: float) -> tuple[Float, Float]:
        return self.place_km + (et - self.et) * self.velocity_km_s, self.velocity_km_s

    def inertial_from_body(self, et: float) -> Rotation:
        return Rotation.from_rotvec([0.0, 0.0, 2.0 * np.pi * (et - self.et) / PERIOD_S])


def test_a_pose_of_a_moving_body_has_light_time_and_aberration_removed() -> None:
    rock, _ = seen()
    image, et = rock.images[0], rock.images[0].et
    assert image.camera_from_inertial is not None
    assert et is not None
    look = image.camera_from_inertial.inv().apply([0.0, 0.0, 50_000.0])
    velocity = np.array([12.0, -20.0, 15.0])
    body, camera = Moving(look, velocity, et), Moving(np.zeros(3), np.array([20.0, 10.0, -8.0]), et)
    scene = Scene(targets=(replace(rock.scene.targets[0], ephemeris=body),), observer=camera,
                  light=DistantLight(np.array([1.0, 0.0, 0.0])))  # fmt: skip
    photo = photo_of(image, rock.camera, scene)
    assert isinstance(photo, Photo)
    light_s = et - photo.et
    gone = look - light_s * velocity  # from the camera to the body when its light left
    assert_allclose(light_s * 299792.458, np.linalg.norm(gone), rtol=0, atol=0.05)  # 1e-7 s of epochs
    # in the rest frame of the body, the camera is where the light meets it
    away, met = -photo.position_km, boosted(gone, velocity)
    assert_allclose(unit(away), unit(met), rtol=0, atol=FLOAT64_CHAIN)
    assert_allclose(np.linalg.norm(away), np.linalg.norm(met), rtol=2e-5, atol=0)  # range by the apparent size
    assert_allclose(photo.inertial_from_body.as_matrix(), body.inertial_from_body(photo.et).as_matrix(), atol=FLOAT64)
    geometry = scene.geometry(image)
    assert not isinstance(geometry, Failure)
    seen_km = photo.camera_from_inertial.apply(-photo.position_km)
    assert_allclose(seen_km, geometry.position_camera_km, rtol=0, atol=1e-6)
    apparent = image.camera_from_inertial.inv().apply(seen_km / np.linalg.norm(seen_km))
    assert_allclose(apparent, aberrate(gone / np.linalg.norm(gone), camera.velocity_km_s), rtol=0, atol=FLOAT64 * 10)


def test_an_error_that_all_images_share_is_in_the_covariance_of_points_alone() -> None:
    _, found = seen()
    assert found.tracks.common_sigma_km > 0.0
    with_it = adjust(found.photos, found.tracks).unwrap()
    without = adjust(found.photos, replace(found.tracks, common_sigma_km=0.0)).unwrap()
    known = np.isfinite(with_it.points_km).all(axis=1)
    added = (with_it.covariance_points_km2 - without.covariance_points_km2)[known]
    common = np.broadcast_to(found.tracks.common_sigma_km**2 * np.eye(3), added.shape)
    assert_allclose(added, common, rtol=0, atol=FLOAT64)
    assert_allclose(with_it.covariance_poses, without.covariance_poses, rtol=0, atol=FLOAT64)
    total = sum(part.points_km2 for part in with_it.parts.values())
    assert_allclose(np.asarray(total)[known], with_it.covariance_points_km2[known], rtol=0, atol=FLOAT64)
    assert_allclose((with_it.parts[Cause.RELIEF].points_km2 - without.parts[Cause.RELIEF].points_km2)[known], common,
                    rtol=0, atol=FLOAT64)  # fmt: skip
