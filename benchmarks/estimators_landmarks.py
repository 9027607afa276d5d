"""Accuracy, consistency and speed of ``surface_features``; prints JSON.

Rubble piles of 200,000 facets (the bodies of the template benchmark, finer) under Sun at 30 to 90 degrees of phase, 300
px across, 20 landmarks at most: truth rendered with three rays a pixel side at random places, McEwen, PSF 0.7 px, 3,000
DN at the brightest pixel, shot noise and 5 DN of read noise; the prediction is off by 10 px and 1.5 % of the range.
``exact law`` tells the estimator so, ``other law`` tells it Lommel-Seeliger. ``attitude free`` estimates the attitude
too, predicted half a degree off. ``surface fills the frame`` has the body 900 px across in a frame of 640.

Beside the errors stand the mean squared error of the position over its covariance (3 where that is honest), the band in
which 95 % of such means lie, and the Cramer-Rao bound: what the noise of the pixels of the landmarks used allows, with
the gain, its slopes and the background of each freed.

Usage: python benchmarks/estimators_landmarks.py [--draws N] [--quick]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel
from giantlike.core.arrays import Float, unit
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.frames import rotate
from giantlike.core.outcomes import Failure
from giantlike.core.pixel_box import BoxPixels
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.ray_tracing import Body, FocalPlane, LommelSeeliger, McEwen, Reflectance, RenderOptions, Template, render
from giantlike.relative import SurfaceFeatures, SurfaceFeaturesOptions
from giantlike.relative.landmarks.matching import fit_patch
from giantlike.relative.landmarks.rendering import LandmarkRenderer, rays_for
from giantlike.relative.landmarks.selection import LandmarkBuildOptions, build_landmarks, landmarks_of
from giantlike.relative.landmarks.surface_features import LandmarkFix
from giantlike.relative.landmarks.visibility import VisibilityOptions, viewer_for
from giantlike.scene import Scene, Target
from giantlike.shapes import irregular_body

SIZE_PX, PEAK_DN = 640, 3000.0
ERROR_PX, RANGE_ERROR = 10.0, 0.015
CAMERA = Camera(
    name="NavCam",
    columns=SIZE_PX,
    rows=SIZE_PX,
    model=BrownModel(fx_px=3473.3, fy_px=3473.4, cx_px=321.0, cy_px=317.0, k1=-0.54, k2=0.39, p1=-2.5e-4),
    psf=GaussianPsf(sigma_px=0.7),
    detector=Detector(gain_e_per_dn=1.0, read_noise_e=5.0, saturation_dn=4095.0),
)
ATTITUDE = Rotation.from_rotvec([0.3, -1.0, 0.4])
PHASES_DEG = (30.0, 45.0, 60.0, 75.0, 90.0)
BODIES = [irregular_body(seed, facets=200_000) for seed in (1, 2, 3)]
VISIBILITY = VisibilityOptions(max_landmarks=20)
KNOWN_LAW = McEwen()
TRUSTING = SurfaceFeaturesOptions(visibility=VISIBILITY)


@dataclass(frozen=True)
class Draw:
    """One image with its truth."""

    image: Image
    scene: Scene
    body: Body
    sun: Float
    scale_dn: float


@dataclass(frozen=True, kw_only=True)
class Case:
    """What is drawn and what the estimator is told."""

    diameter_px: float = 300.0
    told: Reflectance = KNOWN_LAW
    options: SurfaceFeaturesOptions = TRUSTING
    turn_rad: float = 0.0


def drawn(case: Case, seed: int) -> Draw:
    random = np.random.default_rng(seed)
    shape, pose = BODIES[seed % len(BODIES)], Rotation.random(random_state=seed)
    center_px = np.array([320.0, 318.0]) + random.uniform(0, 1, 2)
    sight = CAMERA.model.unproject(center_px)
    range_km = 2 * shape.mean_radius_km * CAMERA.model.focal_length_px / case.diameter_px
    phase = math.radians(PHASES_DEG[seed % len(PHASES_DEG)])
    sun = -math.cos(phase) * sight + math.sin(phase) * unit(np.cross(sight, [*random.normal(size=2), 0.0]))
    sun = unit(sun)
    body = Body(shape=shape, camera_from_body=pose, position_camera_km=range_km * sight, reflectance=McEwen())
    truth = rendered(body, sun, RenderOptions(rays_per_pixel_side=3, jitter_seed=seed))
    scale_dn = PEAK_DN / float(truth.max())
    pixels = np.rint(random.poisson(scale_dn * truth) + random.normal(0, 5.0, truth.shape))
    angle = random.uniform(0, 2 * np.pi)
    predicted_px = center_px + ERROR_PX * np.array([math.cos(angle), math.sin(angle)])
    factor = 1.0 + RANGE_ERROR * float(random.choice([-1, 1]))
    back, turn = ATTITUDE.inv(), Rotation.from_rotvec(case.turn_rad * unit(random.normal(size=3)))
    geometry = ApparentGeometry(
        position_inertial_km=rotate(back, range_km * factor * CAMERA.model.unproject(predicted_px)),
        inertial_from_body=back * turn * pose,
        sun_direction_inertial=rotate(back, sun),
    )
    target = Target(name="ROCK", shape=shape, ephemeris=geometry, reflectance=case.told)
    image = Image(pixels=pixels.astype(np.int16), camera_from_inertial=ATTITUDE, name=f"draw {seed}")
    return Draw(image, Scene(targets=(target,)), body, sun, scale_dn)


def rendered(body: Body, sun: Float, options: RenderOptions) -> Float:
    template = render(
        body, CAMERA.model, sun_direction_camera=sun, psf=CAMERA.psf, columns=SIZE_PX, rows=SIZE_PX, options=options
    )
    assert isinstance(template, Template), template
    return template.placed(SIZE_PX, SIZE_PX)


def bound(one: Draw, fix: LandmarkFix) -> tuple[float, float]:
    """Cramer-Rao bound of the center, rms per axis, px, and of the range, over the range; attitude known."""
    catalog = landmarks_of(one.body.shape)  # type: ignore[arg-type]
    viewer = viewer_for(catalog, one.body.shape)
    assert CAMERA.psf is not None
    plane = FocalPlane(model=CAMERA.model, columns=SIZE_PX, rows=SIZE_PX, psf=CAMERA.psf)
    renderer = LandmarkRenderer(
        catalog,
        plane,
        sun_direction_camera=one.sun,
        max_size_px=VISIBILITY.max_size_px,
        rays_per_pixel_side=2 * rays_for(CAMERA.psf.sigma_px),
        other_law=False,
    )
    seen = viewer.find_visible(one.body, plane, sun_direction_camera=one.sun, options=VisibilityOptions())
    used = {landmark: place for place, landmark in enumerate(item.name for item in catalog.landmarks)}
    wanted = np.array([used[name] for name in fix.landmark_names])
    keep = np.isin(seen.numbers, wanted)
    seen = replace(seen, numbers=seen.numbers[keep], predicted_px=seen.predicted_px[keep], size_px=seen.size_px[keep])
    information = np.zeros((3, 3))
    signal = one.scale_dn * rendered(one.body, one.sun, RenderOptions(rays_per_pixel_side=4))
    image = BoxPixels(
        values_dn=signal,
        usable=np.ones(signal.shape, dtype=bool),
        corner_px=(0, 0),
        noise_variance_dn2=CAMERA.detector.variance_dn2,
    )
    for patch in renderer.patches(one.body, seen)[0]:
        match = fit_patch(image, patch, np.zeros(2, np.int64), 1.0)
        if match is None:
            continue
        point = one.body.to_camera(viewer.points_body_km[patch.number]) + one.body.position_camera_km
        design = CAMERA.model.project_jacobian(point)
        information += design.T @ np.linalg.solve(match.covariance_px2, design)
    covariance = np.linalg.inv(information)
    project = CAMERA.model.project_jacobian(one.body.position_camera_km)
    range_km = float(np.linalg.norm(one.body.position_camera_km))
    sight = one.body.position_camera_km / range_km
    center = math.sqrt(float(np.trace(project @ covariance @ project.T)) / 2)
    return center, math.sqrt(float(sight @ covariance @ sight)) / range_km


def measured(case: Case, draws: int) -> dict[str, object]:
    estimator = SurfaceFeatures(case.options)
    errors, ranges, nees, seconds, used, failed, bounds, turns = [], [], [], [], [], [], [], []
    for seed in range(draws):
        one = drawn(case, seed)
        started = time.process_time()
        fix = estimator.estimate(one.image, CAMERA, one.scene)
        seconds.append(time.process_time() - started)
        if isinstance(fix, Failure):
            failed.append(f"{PHASES_DEG[seed % len(PHASES_DEG)]:g} deg: {fix.reason}: {fix.detail}")
            continue
        error_km = fix.position_camera_km - one.body.position_camera_km
        errors.append(fix.center_px - one.body.center_px(CAMERA.model))
        ranges.append(fix.range_km / float(np.linalg.norm(one.body.position_camera_km)) - 1.0)
        nees.append(float(error_km @ np.linalg.solve(fix.covariance_camera_km2, error_km)))
        turns.append((one.body.camera_from_body * fix.camera_from_body.inv()).magnitude())
        used.append(fix.n_used)
        if seed < 6 and case.turn_rad == 0.0:
            bounds.append(bound(one, fix))
    low, high = (float(chi2.ppf(chance, 3 * len(nees))) / len(nees) for chance in (0.025, 0.975))
    report: dict[str, object] = {
        "draws": draws,
        "failed": failed,
        "landmarks_used_mean": round(float(np.mean(used)), 1),
        "rms_px": np.sqrt(np.mean(np.square(errors), axis=0)).round(4).tolist(),
        "worst_px": round(float(np.abs(errors).max()), 4),
        "rms_range": float(f"{np.sqrt(np.mean(np.square(ranges))):.2g}"),
        "nees_of_3": round(float(np.mean(nees)), 2),
        "nees_band_95": [round(low, 2), round(high, 2)],
        "worst_nees": round(float(np.max(nees)), 1),
        "median_cpu_s": round(float(np.median(seconds)), 2),
    }
    if bounds:
        center, distance = np.sqrt(np.mean(np.square(bounds), axis=0))
        report["cramer_rao_px"], report["cramer_rao_range"] = round(float(center), 4), float(f"{distance:.2g}")
    if case.turn_rad > 0.0:
        report["rms_attitude_deg"] = float(f"{math.degrees(math.sqrt(float(np.mean(np.square(turns))))):.2g}")
    return report


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--quick", action="store_true", help="ten draws")
    arguments = parser.parse_args()
    draws = 10 if arguments.quick else arguments.draws
    started = time.process_time()
    build_landmarks(BODIES[0], LandmarkBuildOptions())
    report: dict[str, object] = {"build_150_landmarks_cpu_s": round(time.process_time() - started, 2)}
    free = SurfaceFeaturesOptions(visibility=VISIBILITY, attitude_sigma_deg=math.inf)
    cases = {
        "300 px, exact law": Case(),
        "300 px, other law": Case(told=LommelSeeliger()),
        "300 px, exact law, attitude free": Case(options=free, turn_rad=math.radians(0.5)),
        "surface fills the frame, exact law": Case(diameter_px=900.0),
    }
    for body in BODIES:
        landmarks_of(body)
    for name, case in cases.items():
        report[name] = measured(case, draws)
        print(name, json.dumps(report[name]), file=sys.stderr, flush=True)
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
