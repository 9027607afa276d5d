"""Surface features: landmarks found on rendered bodies, position and attitude against the truth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import f

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.campaign.file.config import Campaign
from giantlike.campaign.file.options import options_from_mapping, with_files_found
from giantlike.core.arrays import Float, Mask
from giantlike.core.detector import GaussianPsf
from giantlike.core.errors import DataError, InputError
from giantlike.core.outcomes import Failure, Quality, Reason
from giantlike.core.time import et_from_time, time_from_utc
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.io import write_fits
from giantlike.io.image_files import read_image_file
from giantlike.io.spice import load_kernels, orientation
from giantlike.ray_tracing import FocalPlane, LommelSeeliger
from giantlike.ray_tracing.embree import Float32
from giantlike.ray_tracing.tracer import MeshTracer, tracer_for
from giantlike.relative import ESTIMATORS, Estimator, LandmarkFix, SurfaceFeatures, SurfaceFeaturesOptions
from giantlike.relative.landmarks.rendering import LandmarkRenderer
from giantlike.relative.landmarks.selection import LandmarkBuildOptions, build_landmarks, landmarks_of
from giantlike.relative.landmarks.visibility import LandmarkViewer, VisibilityOptions
from giantlike.scene import Scene, Target
from giantlike.shapes import TriangleMesh, irregular_body, load_shape, save_shape
from giantlike.shapes.landmarks import LandmarkCatalog, save_landmarks
from tests.limb_images import CAMERA, BodyImage, body_image
from tests.tolerances import FLOAT64, RARE

INDEPENDENT = 10  # few landmarks: covariances come from the scatter of about so many residuals
TOLD_RAYS, TOLD_LIGHT = 0.5, 1e-3  # of the rays to the Sun; of the brightest pixel, rms: shadows of less than a cell
RAYS = 0.02  # of the brightest pixel, rms: four rays a pixel through other places of facets
NOISE_PX, NOISE_RANGE = 0.06, 6e-4  # four times what 20 landmarks usually state


@cache
def rock() -> TriangleMesh:
    return irregular_body(2, facets=25_000)


@cache
def case(seed: int, phase_deg: float, *, believes_other_law: bool = False) -> BodyImage:
    """An image whose prediction is off by 10 px and 1.5 % of the range."""
    one = body_image(rock(), seed, phase_deg=phase_deg, radius_px=110.0).believed(off_px=(8.0, -6.0), range_error=0.015)
    target = replace(one.target, reflectance=LommelSeeliger()) if believes_other_law else one.target
    return replace(one, target=target)


def misturned(one: BodyImage, error_rad: np.ndarray) -> BodyImage:
    """The same with a predicted attitude of the body that is off."""
    geometry = one.target.ephemeris
    assert isinstance(geometry, ApparentGeometry)
    turned = Rotation.from_rotvec(error_rad) * geometry.inertial_from_body
    return replace(one, target=replace(one.target, ephemeris=replace(geometry, inertial_from_body=turned)))


def estimated(one: BodyImage, options: SurfaceFeaturesOptions | None = None) -> LandmarkFix:
    fix = SurfaceFeatures(options).estimate(one.image, CAMERA, one.scene)
    assert isinstance(fix, LandmarkFix), fix
    return fix


def refused(one: BodyImage, options: SurfaceFeaturesOptions | None = None) -> Failure:
    failure = SurfaceFeatures(options).estimate(one.image, CAMERA, one.scene)
    assert isinstance(failure, Failure)
    return failure


def limit(size: int) -> float:
    """What a squared error over its covariance exceeds once in a million, if the covariance is honest."""
    return size * float(f.ppf(1.0 - RARE, size, INDEPENDENT))


def assert_sound(one: BodyImage, fix: LandmarkFix) -> None:
    assert one.nees(fix) < limit(3), (one.error_px(fix), one.range_error(fix))
    assert np.sqrt(np.linalg.eigvalsh(fix.covariance_px2)[-1]) < NOISE_PX
    assert fix.sigma_range_km / fix.range_km < NOISE_RANGE


@pytest.mark.parametrize(("seed", "phase_deg"), [(1, 35.0), (3, 85.0)])
def test_the_position_is_found_from_a_prediction_ten_pixels_and_a_percent_off(seed: int, phase_deg: float) -> None:
    one = case(seed, phase_deg)
    fix = estimated(one)
    assert_sound(one, fix)
    assert fix.estimator == "surface_features"
    assert repr(fix).startswith("LandmarkFix(")
    assert len(repr(fix)) < 200
    assert fix.n_used == len(fix.landmark_names) == len(fix.landmark_px) >= 6
    assert_allclose(fix.residuals.reshape(-1, 2), fix.landmark_px - fix.landmark_predicted_px, rtol=0, atol=0.1)
    assert not fix.flags.suspect
    assert fix.score > 0.8
    assert fix.provenance["landmarks_sha256"] == landmarks_of(rock()).sha256
    assert not fix.pose_covariance[3:].any()
    assert fix.attitude_change_rad == pytest.approx(0.0, abs=FLOAT64)


@pytest.mark.slow
def test_a_law_that_is_told_wrong_costs_little_and_the_covariance_knows() -> None:
    one = case(2, 60.0, believes_other_law=True)
    assert_sound(one, estimated(one))


@pytest.mark.parametrize(("sigma_deg", "error_rad"), [(0.2, 3e-3), (float("inf"), 0.015)])
def test_an_attitude_that_is_off_is_found_with_the_position(sigma_deg: float, error_rad: float) -> None:
    one = case(1, 35.0)
    error = error_rad * np.array([0.5, -0.6, 0.6])
    fix = estimated(misturned(one, error), SurfaceFeaturesOptions(attitude_sigma_deg=sigma_deg))
    geometry = one.target.ephemeris
    assert isinstance(geometry, ApparentGeometry)
    turn = (geometry.inertial_from_body * fix.camera_from_body.inv()).as_rotvec()  # camera axes are inertial here
    errors = np.concatenate([one.position_camera_km - fix.position_camera_km, turn])
    scale = np.sqrt(np.diag(fix.pose_covariance))
    nees = (errors / scale) @ np.linalg.solve(fix.pose_covariance / np.outer(scale, scale), errors / scale)
    assert nees < limit(6)
    assert scale[3:].max() < 3e-3
    assert_allclose(fix.attitude_change_rad, -error, rtol=0, atol=6.0 * scale[3:].max())
    assert_allclose(fix.covariance_camera_km2, fix.pose_covariance[:3, :3], rtol=0, atol=0)


def test_landmarks_that_something_else_covers_are_left_out() -> None:
    one = case(1, 35.0)
    whole = estimated(one)
    x, y = np.rint(whole.landmark_px[np.argsort(whole.landmark_px[:, 0])[2]]).astype(int)
    pixels = one.image.pixels.copy()
    speckle = np.random.default_rng(5).uniform(0, 3000, (45, 45))
    pixels[y - 22 : y + 23, x - 22 : x + 23] = speckle.astype(pixels.dtype)
    covered = replace(one, image=replace(one.image, pixels=pixels))
    fix = estimated(covered)
    assert_sound(one, fix)
    assert np.abs(fix.landmark_px - [x, y]).max(axis=1).min() > 8.0
    mask = np.zeros(pixels.shape, dtype=bool)
    mask[y - 22 : y + 23, x - 22 : x + 23] = True
    assert_sound(one, estimated(replace(covered, image=replace(covered.image, mask=mask))))


@pytest.mark.slow
def test_landmarks_from_a_file_of_the_same_shape_give_the_same_answer(tmp_path: Path) -> None:
    one = case(2, 60.0)
    save_landmarks(landmarks_of(rock()), tmp_path / "rock.npz")
    options = with_files_found(
        options_from_mapping(SurfaceFeaturesOptions, {"landmarks": "rock.npz"}, "options"), tmp_path, "options"
    )
    from_file, own = estimated(one, options), estimated(one)
    assert from_file.landmark_names == own.landmark_names
    assert_allclose(from_file.position_camera_km, own.position_camera_km, rtol=0, atol=own.sigma_range_km)
    with pytest.raises(InputError, match="there is no"):
        with_files_found(SurfaceFeaturesOptions(landmarks=Path("none.npz")), tmp_path, "options")
    (tmp_path / "bad.npz").write_bytes(b"nothing")
    with pytest.raises(DataError, match="cannot be read as a catalog of landmarks"):
        refused(one, SurfaceFeaturesOptions(landmarks=tmp_path / "bad.npz"))


@pytest.mark.slow
def test_maps_alone_do_where_the_target_is_only_an_ellipsoid(tmp_path: Path) -> None:
    one = case(2, 60.0)
    built = build_landmarks(rock(), LandmarkBuildOptions(samples=61))
    maps = LandmarkCatalog(built.landmarks)  # of no known shape, as maplets are
    save_landmarks(maps, tmp_path / "maps.npz")
    target = replace(one.target, shape=rock().best_fit_ellipsoid.ellipsoid)
    fix = estimated(replace(one, target=target), SurfaceFeaturesOptions(landmarks=tmp_path / "maps.npz"))
    assert one.nees(fix) < limit(3)
    assert np.abs(one.error_px(fix)).max() < 0.2  # no shadows of other ground, facets of another size
    assert abs(one.range_error(fix)) < 2e-3


def test_landmarks_in_use_are_seen_lit_and_not_oblique() -> None:
    one = case(3, 85.0)
    geometry = one.scene.geometry(one.image)
    assert not isinstance(geometry, Failure)
    body, sun = geometry.body(), geometry.sun_direction_camera
    options, catalog = VisibilityOptions(), landmarks_of(rock())
    viewer = LandmarkViewer(catalog, rock())
    plane = FocalPlane(model=CAMERA.model, columns=400, rows=400)
    seen = viewer.find_visible(body, plane, sun_direction_camera=sun, options=options)
    sun_body = body.to_body(sun)
    camera_km = body.camera_body_km
    for number in range(len(catalog)):
        landmark = catalog.landmarks[number]
        toward = camera_km - landmark.point_body_km
        toward = toward / np.linalg.norm(toward)
        cosines = np.array([landmark.normal_body @ toward, landmark.normal_body @ sun_body])
        if number in seen.numbers:
            assert cosines[0] > np.cos(np.radians(options.max_emission_deg))
            assert cosines[1] > np.cos(np.radians(options.max_incidence_deg))
            ground = landmark.grid_body_km(7) + 0.01 * landmark.size_km * landmark.normal_body
            tracer = tracer_for(rock())
            assert np.mean(tracer.is_occluded(ground, camera_km - ground)) < 0.2
            assert np.mean(tracer.is_occluded(ground, np.broadcast_to(sun_body, ground.shape))) < 0.55
    assert seen.numbers.size > 5
    assert seen.dark > 0
    assert seen.oblique > len(catalog) // 3
    few = replace(options, max_landmarks=5)
    chosen = viewer.find_visible(body, plane, sun_direction_camera=sun, options=few)
    assert chosen.numbers.size == 5
    assert set(chosen.numbers) <= set(seen.numbers)


def test_landmarks_of_a_pose_nearby_look_as_if_traced_anew() -> None:
    one = case(3, 85.0)
    geometry = one.scene.geometry(one.image)
    assert not isinstance(geometry, Failure)
    body, catalog = geometry.body(), landmarks_of(rock())
    plane = FocalPlane(model=CAMERA.model, columns=400, rows=400, psf=GaussianPsf(sigma_px=0.7))
    sun = geometry.sun_direction_camera
    renderer = LandmarkRenderer(
        catalog, plane, sun_direction_camera=sun, max_size_px=64.0, rays_per_pixel_side=2, other_law=True
    )
    seen = LandmarkViewer(catalog, rock()).find_visible(
        body, plane, sun_direction_camera=sun, options=VisibilityOptions()
    )
    _, traced = renderer.patches(body, seen)
    assert traced is not None
    near = replace(body, position_camera_km=body.position_camera_km * np.array([1.0, 1.0, 1.0005]) + [2e-4, -1e-4, 0.0])
    shift_px = near.center_px(CAMERA.model) - body.center_px(CAMERA.model)
    assert 0.02 < np.abs(shift_px).max() < 0.3
    seen = replace(seen, predicted_px=seen.predicted_px + shift_px)
    moved, same = renderer.patches(near, seen, traced)
    anew, other = renderer.patches(near, seen)
    assert same is traced
    assert other is not traced
    for one_patch, another in zip(moved, anew, strict=True):
        assert one_patch.box == another.box
        assert another.other is not None
        assert one_patch.other is not None
        for found, expected in ((one_patch.light, another.light), (one_patch.other, another.other)):
            difference = (found - expected)[another.mask]
            assert np.sqrt(np.mean(difference**2)) < RAYS * np.max(expected[another.mask])
    far = replace(body, position_camera_km=1.02 * body.position_camera_km)
    assert renderer.patches(far, seen, traced)[1] is not traced


def test_ground_that_a_rough_render_saw_lit_sends_no_rays_to_the_sun(monkeypatch: pytest.MonkeyPatch) -> None:
    one = case(3, 85.0)
    geometry = one.scene.geometry(one.image)
    assert not isinstance(geometry, Failure)
    body, sun, cells = geometry.body(), geometry.sun_direction_camera, CAMERA.binned(2, detector=CAMERA.detector)
    renderer, rough = (
        LandmarkRenderer(
            landmarks_of(rock()),
            FocalPlane(model=camera.model, columns=camera.columns, rows=camera.rows, psf=camera.psf),
            sun_direction_camera=sun,
            max_size_px=size_px,
            rays_per_pixel_side=2,
            other_law=False,
        )
        for camera, size_px in ((CAMERA, 64.0), (cells, 32.0))
    )
    viewer = LandmarkViewer(landmarks_of(rock()), rock())
    seen = viewer.find_visible(body, renderer.plane, sun_direction_camera=sun, options=VisibilityOptions())
    _, ground = rough.roughly().patches(body, replace(seen, predicted_px=0.5 * (seen.predicted_px - 0.5)))
    cast, dark = [0], MeshTracer.dark

    def counted(tracer: MeshTracer, points_km: Float32, normals: Float32, to_sun: Float) -> Mask:
        cast[-1] += len(points_km)
        return dark(tracer, points_km, normals, to_sun)

    monkeypatch.setattr(MeshTracer, "dark", counted)
    alone, _ = renderer.patches(body, seen)
    cast.append(0)
    told, _ = renderer.patches(body, seen, None, ground)
    assert cast[1] < TOLD_RAYS * cast[0]
    for patch, expected in zip(told, alone, strict=True):
        difference = (patch.light - expected.light)[expected.mask]
        assert np.sqrt(np.mean(difference**2)) < TOLD_LIGHT * np.max(expected.light[expected.mask])


def test_what_cannot_be_done_is_a_failure_with_its_reason() -> None:
    one = case(1, 35.0)
    ellipsoid = replace(one, target=replace(one.target, shape=rock().best_fit_ellipsoid.ellipsoid))
    assert refused(ellipsoid).reason is Reason.WRONG_SHAPE
    away = one.believed(off_px=(900.0, 0.0))
    assert refused(away).reason is Reason.OUT_OF_FRAME
    assert refused(case(4, 170.0)).reason in {Reason.NOT_LIT, Reason.TOO_FEW_MATCHES}
    random = np.random.default_rng(3).poisson(500, one.image.pixels.shape).astype(one.image.pixels.dtype)
    noise = replace(one, image=replace(one.image, pixels=random))
    assert refused(noise).reason in {Reason.LOW_CORRELATION, Reason.TOO_FEW_MATCHES, Reason.PEAK_AT_EDGE}
    picky = SurfaceFeaturesOptions(visibility=VisibilityOptions(min_size_px=60.0))
    failure = refused(one, picky)
    assert failure.reason is Reason.TOO_FEW_MATCHES
    assert "too small" in failure.detail


def test_it_is_an_estimator_with_options_from_a_campaign_file() -> None:
    estimator = ESTIMATORS["surface_features"]()
    assert isinstance(estimator, Estimator)
    table = {"attitude_sigma_deg": float("inf"), "visibility": {"max_landmarks": 20}}
    options = options_from_mapping(SurfaceFeaturesOptions, table, "options")
    assert options == SurfaceFeaturesOptions(
        attitude_sigma_deg=float("inf"), visibility=VisibilityOptions(max_landmarks=20)
    )
    for wrong, needle in (({"search_px": 0}, "search_px"), ({"min_landmarks": 1}, "min_landmarks")):
        with pytest.raises(InputError, match=needle):
            options_from_mapping(SurfaceFeaturesOptions, wrong, "options")
    assert Quality.MANY_REJECTED.suspect


def test_a_campaign_file_names_its_landmarks_relative_to_itself(tmp_path: Path) -> None:
    one = case(1, 35.0)
    save_landmarks(landmarks_of(rock()), tmp_path / "rock-landmarks.npz")
    save_shape(rock(), tmp_path / "rock.ply")
    CAMERA.save(tmp_path / "camera.toml")
    write_fits(tmp_path / "a.fits", one.image.pixels)
    table = {
        "campaign": {"name": "rock", "output": "run"},
        "images": {"files": ["a.fits"]},
        "camera": {"file": "camera.toml"},
        "targets": [
            {
                "name": "BODY",
                "shape": "rock.ply",
                "units": "km",
                "estimators": ["surface_features"],
                "options": {"surface_features": {"landmarks": "rock-landmarks.npz"}},
            }
        ],
    }
    path = tmp_path / "campaign.toml"
    path.write_text(tomli_w.dumps(table))
    (estimator,) = Campaign.load(path).targets[0].estimators
    assert estimator.options.landmarks == tmp_path / "rock-landmarks.npz"
    assert isinstance(estimator.estimate(one.image, CAMERA, one.scene), LandmarkFix)
    path.write_text(tomli_w.dumps(table).replace("rock-landmarks", "no-landmarks"))
    with pytest.raises(DataError, match=r"options\.surface_features\.landmarks: there is no 'no-landmarks\.npz'"):
        Campaign.load(path)


@pytest.mark.real_data
@pytest.mark.parametrize("name", ["m0154651923f6_2p_cif_gbl.fit", "m0157063318f4_2p_iof_gbl.fit"])
def test_a_shape_coarser_than_the_frame_has_no_landmarks_for_it(data_dir: Path, name: str) -> None:
    # NEAR at Eros: plates of the shape are 0.5 km wide, the frames show 1.3 km by 1.8 km
    stored = read_image_file(data_dir / "bodies" / "near_msi" / name)
    number = {key: float(stored.header[f"NEAR-{key:03d}"]) for key in (18, 19, 20, 21, 22, 23, 24, 25, 27, 28, 29)}
    axes = Rotation.from_matrix([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])  # boresight +X, samples +Z
    attitude = axes * Rotation.from_quat([number[key] for key in (19, 20, 21, 22)], scalar_first=True)
    eros_km = np.array([number[key] for key in (27, 28, 29)])
    et = et_from_time(time_from_utc("1996-02-17T20:43:29")) + number[18]  # mission elapsed time, from launch
    with load_kernels([str(data_dir / "kernels" / "pck00011.tpc")], base=Path()):
        turn = orientation("IAU_EROS", et)
    geometry = ApparentGeometry(
        position_inertial_km=eros_km - np.array([number[key] for key in (23, 24, 25)]),
        inertial_from_body=turn,
        sun_direction_inertial=-eros_km / np.linalg.norm(eros_km),
    )
    focal_px = 1.0 / 95.9e-6
    model = PinholeModel(fx_px=focal_px, fy_px=focal_px, cx_px=268.0, cy_px=205.5)
    camera = Camera(name="NEAR MSI", columns=537, rows=412, model=model, psf=GaussianPsf(sigma_px=0.8))
    scene = Scene(targets=(Target(name="EROS", shape=eros(data_dir), ephemeris=geometry),))
    image = Image(pixels=stored.pixels, camera_from_inertial=attitude, name=name)
    failure = SurfaceFeatures().estimate(image, camera, scene)
    assert isinstance(failure, Failure)
    assert failure.reason in {Reason.TOO_FEW_MATCHES, Reason.OUT_OF_FRAME}
    assert "landmarks can be used" in failure.detail


@cache
def eros(data_dir: Path) -> TriangleMesh:
    return load_shape(data_dir / "shapes" / "eros007790.tab")
