"""Estimators on the horizon of an ellipsoid: bias at long range, a pass of the Moon, rows of targets; prints JSON.

``bias``: the Christian-Robinson algorithm on horizon points of the Moon from 252,400 km with 0.1 px of noise, mean
range error of each method over its standard error. ``pass``: 102 images of the Moon in the geometry of Inman et al.,
Table 2 (Artemis I, pass 3), by the algorithm as flown (edges along the sunlight, whole pixels refined to a fraction,
least squares), by ``sigmoid_limb`` and by ``ellipsoid_cra``; standard deviations and correlations beside the table's.
``rows``: the rows of the table of targets, with the Cramer-Rao bound and the normalized error of the covariance.
``sizes``: error against size. ``altitude``: a hazy limb, its altitude known or estimated.

Usage: python benchmarks/horizon.py [bias pass rows sizes altitude] [--draws 12] [--truths 18] [--bias-draws 3000]
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable

import numpy as np
from monte_carlo import PHASES_DEG, Truth, render_cost_s, run_cell, summary, trials, truth_of
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.outcomes import Failure, PositionFix
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.processing.limb.edges import scan_edges
from giantlike.processing.limb.zernike import zernike_edges
from giantlike.ray_tracing import Body, LommelSeeliger, LunarLambert, McEwen, RenderOptions, Template, render
from giantlike.relative import EllipsoidCRA, Estimator, SigmoidLimb
from giantlike.relative.horizon.geometry import (
    Altitude,
    CraMethod,
    Figure,
    altitude_design,
    christian_robinson,
    horizon_residuals,
)
from giantlike.relative.horizon.profile import horizon_arc
from giantlike.scene import Scene, Target
from giantlike.shapes import Ellipsoid

MOON_KM = 1737.4
PASS_KM = 136_300 * 1.852  # Inman et al., Table 1, pass 3
IFOV_RAD = math.radians(28.2 / 3600.0)  # Inman et al., section IV.B
PASS_IMAGES = 102
PASS_PHASE_DEG = 60.0  # the paper does not say
PASS_DRIFT_PX = 25.0  # so that the limb meets pixels in all ways; nor does it say this
TABLE_2 = {  # px: standard deviations, and correlations of the two
    "std_non_iterative": {"x": 0.060, "y": 0.117, "radius": 0.030},
    "std_iterative": {"x": 0.061, "y": 0.112, "radius": 0.037},
    "correlation": {"x": 0.4851, "y": 0.9946, "radius": -0.2570},
}
ELLIPSOID = Ellipsoid(radii_km=np.array([0.3, 0.26, 0.22]))
ESTIMATORS: tuple[Estimator, ...] = (EllipsoidCRA(), SigmoidLimb())
SIZES_PX = (20.0, 30.0, 50.0, 100.0, 200.0, 300.0, 600.0, 1000.0)


def orion(size_px: int = 512) -> Camera:
    """The middle of the Orion camera's frame."""
    focal = 1.0 / IFOV_RAD
    middle = 0.5 * (size_px - 1)
    return Camera(
        name="Orion",
        columns=size_px,
        rows=size_px,
        model=PinholeModel(fx_px=focal, fy_px=focal, cx_px=middle, cy_px=middle),
        psf=GaussianPsf(sigma_px=0.7),
        detector=Detector(gain_e_per_dn=1.0, read_noise_e=5.0, saturation_dn=16000.0),
    )


def bias(draws: int) -> dict[str, object]:
    """Mean range error, km, over its standard error, for arcs of the limb and each method."""
    model = orion().model
    figure = Figure(radii_km=np.full(3, MOON_KM), camera_from_axes=Rotation.identity())
    truth = np.array([0.0, 0.0, PASS_KM])
    report: dict[str, object] = {"range_km": PASS_KM, "noise_px": 0.1, "draws": draws}
    arc = horizon_arc(model, figure, truth)
    assert not isinstance(arc, Failure)
    angles = np.arctan2(*(arc.points_px - model.project(truth)).T[::-1])
    turns = np.linspace(-math.radians(80.0), math.radians(80.0), 1000)
    radius = float(np.mean(np.linalg.norm(arc.points_px - model.project(truth), axis=1)))
    dense = model.project(truth) + radius * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    arcs = {160.0: dense} | {2.0 * d: arc.points_px[np.abs(angles) < math.radians(d)] for d in (90.0, 60.0, 40.0)}
    for arc_deg, points in arcs.items():
        random = np.random.default_rng(1)
        errors: dict[str, list[float]] = {method: [] for method in CraMethod}
        for _ in range(draws):
            noisy = points + 0.1 * random.normal(size=points.shape)
            for method in CraMethod:
                found = christian_robinson(noisy, model, figure, method=method, sigma_px=0.1)
                assert not isinstance(found, Failure), found
                errors[method].append(float(np.linalg.norm(found)) - PASS_KM)
        report[f"{arc_deg:g} deg of limb, {len(points)} points"] = {
            method: {
                "bias_km": round(float(np.mean(some)), 2),
                "standard_error_km": round(float(np.std(some)) / math.sqrt(draws), 2),
                "sigma_km": round(float(np.std(some)), 1),
            }
            for method, some in errors.items()
        }
    return report


def as_flown(image: Image, camera: Camera, sunlight: Float) -> Float:
    """The non-iterative algorithm as Inman et al. have it: edges from the side of the Sun, then least squares."""
    pixels = image.pixels.astype(np.float64)
    usable = np.ones(pixels.shape, dtype=bool)
    assert camera.psf is not None
    blur = camera.psf.sigma_px
    seeds = scan_edges(pixels, usable, sunlight, threshold_dn=100.0, blur_sigma_px=blur)
    edges = zernike_edges(pixels, usable, seeds, variance_dn2=camera.detector.variance_dn2, blur_sigma_px=blur)
    outward = edges.normals_px @ sunlight < -0.3  # the terminator and the cusps are left out
    figure = Figure(radii_km=np.full(3, MOON_KM), camera_from_axes=Rotation.identity())
    points = edges.points_px[outward]
    for _ in range(2):
        found = christian_robinson(points, camera.model, figure, method=CraMethod.LEAST_SQUARES)
        assert not isinstance(found, Failure), found
        residuals, _, _ = horizon_residuals(points, camera.model, figure, found)
        points = points[np.abs(residuals - np.median(residuals)) < 0.5]
    return np.asarray(found)


def pass_image(number: int) -> tuple[Image, Scene, Float]:
    """One image of the pass: a sphere under the lunar law, drifting through the frame; x is along the sunlight."""
    camera, random = orion(), np.random.default_rng(number)
    center = np.array([256.0, 256.0]) + PASS_DRIFT_PX * (number / PASS_IMAGES - 0.5) * np.array([0.6, 0.8])
    position = PASS_KM * camera.model.unproject(center)
    phase = math.radians(PASS_PHASE_DEG)
    sun = np.array([-math.sin(phase), 0.0, -math.cos(phase)])
    body = Body(
        shape=Ellipsoid(radii_km=np.full(3, MOON_KM)),
        camera_from_body=Rotation.identity(),
        position_camera_km=position,
        reflectance=LunarLambert(),
    )
    template = render(
        body,
        camera.model,
        sun_direction_camera=sun,
        psf=camera.psf,
        columns=camera.columns,
        rows=camera.rows,
        options=RenderOptions(rays_per_pixel_side=8, jitter_seed=number),
    )
    assert isinstance(template, Template)
    light = template.placed(camera.columns, camera.rows) * (3000.0 / float(template.brightness.max()))
    pixels = np.rint(random.poisson(light) + random.normal(0.0, 5.0, light.shape)).astype(np.int16)
    geometry = ApparentGeometry(
        position_inertial_km=position, inertial_from_body=Rotation.identity(), sun_direction_inertial=sun
    )
    scene = Scene(targets=(Target(name="MOON", shape=body.shape, ephemeris=geometry),))
    return Image(pixels=pixels, camera_from_inertial=Rotation.identity(), name=f"pass {number}"), scene, position


def moon_pass(images: int) -> dict[str, object]:
    """Residuals in center and apparent radius against a trajectory whose pointing is off by a jitter."""
    report: dict[str, object] = {"images": images, "phase_deg": PASS_PHASE_DEG, "table_2": TABLE_2}
    camera = orion()
    found: dict[str, list[Float]] = {"as flown": [], "sigmoid_limb": [], "ellipsoid_cra": []}
    for number in range(images):
        image, scene, known = pass_image(number)
        flown = as_flown(image, camera, np.array([1.0, 0.0]))
        fixes = [estimator.estimate(image, camera, scene) for estimator in (SigmoidLimb(), EllipsoidCRA())]
        assert all(isinstance(fix, PositionFix) for fix in fixes), fixes
        positions = [flown, *(fix.position_camera_km for fix in fixes if isinstance(fix, PositionFix))]
        for name, position in zip(found, positions, strict=True):
            found[name].append(_residual(camera, position, known))
    for jitter_px in (0.0, 0.05):
        jitter = jitter_px * np.random.default_rng(3).normal(size=(images, 3)) * [1.0, 1.0, 0.0]
        arrays = {name: np.array(values) + jitter for name, values in found.items()}
        report[f"pointing jitter {jitter_px:g} px"] = {
            **{name: {"mean": _named(a.mean(axis=0)), "std": _named(a.std(axis=0))} for name, a in arrays.items()},
            "correlation as flown, sigmoid_limb": _correlation(arrays["as flown"], arrays["sigmoid_limb"]),
            "correlation ellipsoid_cra, sigmoid_limb": _correlation(arrays["ellipsoid_cra"], arrays["sigmoid_limb"]),
        }
    return report


def _residual(camera: Camera, position: Float, known: Float) -> Float:
    """Center (x, y) and apparent radius, px, of a position less those of the trajectory."""
    focal = camera.model.focal_length_px
    radius = [focal * math.tan(math.asin(MOON_KM / float(np.linalg.norm(place)))) for place in (position, known)]
    return np.array([*(camera.model.project(position) - camera.model.project(known)), radius[0] - radius[1]])


def _named(values: Float) -> dict[str, float]:
    return {name: round(float(value), 4) for name, value in zip(("x", "y", "radius"), values, strict=True)}


def _correlation(first: Float, second: Float) -> dict[str, float]:
    return _named(np.array([np.corrcoef(first[:, i], second[:, i])[0, 1] for i in range(3)]))


def truths_for(diameter_px: float, count: int) -> list[Truth]:
    """Triaxial ellipsoids with the phase angles in turn."""
    return [
        truth_of(
            ELLIPSOID,
            diameter_px,
            PHASES_DEG[number % len(PHASES_DEG)],
            McEwen(),
            100 + number,
            size_px=512 if diameter_px <= 300.0 else 1024 if diameter_px <= 600.0 else 2048,
        )
        for number in range(count)
    ]


def rows(sizes_px: tuple[float, ...], draws: int, count: int, report: dict[str, object]) -> None:
    """Rows of the table of targets, for the law that is told and for another one."""
    for diameter_px in sizes_px:
        truths = truths_for(diameter_px, count)
        run_cell(f"{diameter_px:g} px, bare render", {"cpu_s": render_cost_s(truths[0])}, report)
        for estimator in ESTIMATORS:
            for name, told in (("exact law", None), ("other law", LommelSeeliger())):
                done = trials(estimator, truths, draws, told=told)
                run_cell(f"{estimator.name} {diameter_px:g} px, {name}", summary(done, truths), report)


def altitude(draws: int) -> dict[str, object]:
    """Range of the Earth from 300,000 km with a limb 25 km high, by what is known of that altitude.

    Points of the horizon with 0.1 px of noise; every draw has its own altitude, normal about 25 km.
    """
    model, radii = orion(1024).model, np.array([6378.14, 6378.14, 6356.75])
    figure = Figure(radii_km=radii, camera_from_axes=Rotation.from_rotvec([1.2, 0.4, 0.2]))
    truth = 300_000.0 * model.unproject(np.array([530.0, 500.0]))
    report: dict[str, object] = {"draws": draws}
    for sigma_km in (0.0, 5.0, 20.0):
        random = np.random.default_rng(2)
        errors, stated = [], []
        for _ in range(draws):
            true_km = 25.0 + sigma_km * random.normal()
            arc = horizon_arc(model, Altitude(true_km).above(figure), truth)
            assert not isinstance(arc, Failure)
            points = arc.points_px[: len(arc.points_px) // 2]
            points = points + 0.1 * random.normal(size=points.shape)
            seen = Altitude(25.0).above(figure)
            found = christian_robinson(points, model, seen, sigma_px=0.1)
            assert not isinstance(found, Failure)
            _, design, _ = horizon_residuals(points, model, seen, found)
            lift = altitude_design(points, model, seen, found)
            gain = np.linalg.pinv(design)
            covariance = gain @ (0.01 * np.eye(len(points)) + sigma_km**2 * np.outer(lift, lift)) @ gain.T
            sight = truth / np.linalg.norm(truth)
            errors.append(float(np.linalg.norm(found) - np.linalg.norm(truth)))
            stated.append(float(np.sqrt(sight @ covariance @ sight)))
        report[f"altitude known to {sigma_km:g} km"] = {
            "range_error_rms_km": round(float(np.sqrt(np.mean(np.square(errors)))), 1),
            "stated_sigma_km": round(float(np.mean(stated)), 1),
        }
    return report


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=["bias", "pass", "rows", "altitude"])
    parser.add_argument("--draws", type=int, default=12, help="of every truth")
    parser.add_argument("--truths", type=int, default=18, help="of every cell")
    parser.add_argument("--bias-draws", type=int, default=3000)
    parser.add_argument("--images", type=int, default=PASS_IMAGES, help="of the pass")
    arguments = parser.parse_args()
    report: dict[str, object] = {}
    singles: dict[str, Callable[[], dict[str, object]]] = {
        "bias": lambda: bias(arguments.bias_draws),
        "pass": lambda: moon_pass(arguments.images),
        "altitude": lambda: altitude(200),
    }
    for part in arguments.parts:
        if part in singles:
            run_cell(part, singles[part](), report)
        else:
            rows({"rows": (300.0,), "sizes": SIZES_PX}[part], arguments.draws, arguments.truths, report)
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
