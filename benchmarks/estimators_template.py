"""Accuracy, consistency and speed of the estimators that fit a rendered template; prints JSON.

Truth is rendered with rays at other places than the templates use, and with Poisson and read noise; a priori errors are
10 px and 1.5 % in range. Side by side stand the peak of the correlation alone (the paper's way) and the fit, and
OpenCV's correlation and a plain one by FFT.

Usage: python benchmarks/estimators_template.py [draws]
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import fftconvolve
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel
from giantlike.core.arrays import Float, unit
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.outcomes import CenterFix, PositionFix
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.processing.correlate import CorrelationPeak, locate_template, normalized_correlation
from giantlike.ray_tracing import Body, Lambert, McEwen, Reflectance, RenderOptions, Template, render
from giantlike.relative import CrossCorrelation, Estimator, Unresolved
from giantlike.scene import Scene, Target
from giantlike.shapes import irregular_body

CAMERA = Camera(
    name="NavCam",
    columns=640,
    rows=640,
    model=BrownModel(fx_px=3473.3, fy_px=3473.4, cx_px=321.0, cy_px=317.0, k1=-0.54, k2=0.39, p1=-2.5e-4),
    psf=GaussianPsf(sigma_px=0.75),
    detector=Detector(gain_e_per_dn=1.0, read_noise_e=5.0, saturation_dn=4095.0),
)
ATTITUDE = Rotation.from_rotvec([0.3, -1.0, 0.4])
PEAK_DN, ERROR_PX, RANGE_FACTOR = 3000.0, 10.0, 1.015
BODIES = [irregular_body(seed, facets=50_000) for seed in (1, 2, 3)]


@dataclass(frozen=True)
class Draw:
    """One image with its truth and the template at the predicted geometry."""

    image: Image
    scene: Scene
    center_px: Float
    range_km: float
    template: Template
    predicted_px: Float


def draw(diameter_px: float, phase_deg: float, law: Reflectance, seed: int) -> Draw:
    random = np.random.default_rng(seed)
    shape, pose = BODIES[seed % len(BODIES)], Rotation.random(random_state=seed)
    center = np.array([320.0, 318.0]) + random.uniform(0, 1, 2)
    sight = CAMERA.model.unproject(center)
    range_km = 2 * shape.mean_radius_km * CAMERA.model.focal_length_px / diameter_px
    side = unit(np.cross(sight, [*random.normal(size=2), 0.0]))
    sun = -math.cos(math.radians(phase_deg)) * sight + math.sin(math.radians(phase_deg)) * side

    def rendered(position_km: Float, reflectance: Reflectance, options: RenderOptions) -> Template:
        body = Body(shape=shape, camera_from_body=pose, position_camera_km=position_km, reflectance=reflectance)
        template = render(
            body, CAMERA.model, sun_direction_camera=sun, psf=CAMERA.psf, columns=640, rows=640, options=options
        )
        assert isinstance(template, Template), template
        return template

    truth = rendered(range_km * sight, law, RenderOptions(rays_per_pixel_side=4, jitter_seed=seed))
    signal = truth.placed(640, 640) * (PEAK_DN / float(truth.brightness.max()))
    pixels = np.rint(random.poisson(signal) + random.normal(0, CAMERA.detector.read_noise_e, signal.shape))
    angle = random.uniform(0, 2 * np.pi)
    predicted = center + ERROR_PX * np.array([math.cos(angle), math.sin(angle)])
    position = range_km * RANGE_FACTOR * CAMERA.model.unproject(predicted)
    back = ATTITUDE.inv()
    geometry = ApparentGeometry(
        position_inertial_km=back.apply(position),
        inertial_from_body=back * pose,
        sun_direction_inertial=back.apply(sun),
    )
    return Draw(
        image=Image(pixels=pixels.astype(np.int16), camera_from_inertial=ATTITUDE, name=f"draw {seed}"),
        scene=Scene(targets=(Target(name="ROCK", shape=shape, ephemeris=geometry),)),
        center_px=center,
        range_km=range_km,
        template=rendered(position, McEwen(), RenderOptions()),
        predicted_px=predicted,
    )


def timed(function: Callable[[], object]) -> tuple[object, float]:
    """Answer and processor time, s."""
    started = time.process_time()
    answer = function()
    return answer, time.process_time() - started


def measured(estimator: Estimator, draws: list[Draw]) -> dict[str, object]:
    errors, nees, ranges, seconds, failed = [], [], [], [], 0
    for one in draws:
        fix, spent = timed(lambda one=one: estimator.estimate(one.image, CAMERA, one.scene))  # type: ignore[misc]
        seconds.append(spent)
        if not isinstance(fix, CenterFix):
            failed += 1
            continue
        error = fix.center_px - one.center_px
        errors.append(error)
        nees.append(float(error @ np.linalg.solve(fix.covariance_px2, error)))
        if isinstance(fix, PositionFix):
            ranges.append(fix.range_km / one.range_km - 1.0)
    return {
        "failed": failed,
        "rms_px": np.sqrt(np.mean(np.square(errors), axis=0)).round(4).tolist() if errors else None,
        "worst_px": round(float(np.abs(errors).max()), 4) if errors else None,
        "nees_of_2": round(float(np.mean(nees)), 2) if nees else None,
        "rms_range": float(f"{np.sqrt(np.mean(np.square(ranges))):.2g}") if ranges else None,
        "median_s": round(float(np.median(seconds)), 3),
    }


def peak_only(draws: list[Draw]) -> list[float] | None:
    """Error of the paraboloid's peak, rms per axis, px."""
    errors = []
    for one in draws:
        corner = int(one.template.corner_px[0]), int(one.template.corner_px[1])
        usable = np.ones(one.image.pixels.shape, dtype=bool)
        peak = locate_template(one.image.pixels.astype(np.float64), usable, one.template.brightness, corner)
        if isinstance(peak, CorrelationPeak):
            errors.append(one.predicted_px + peak.offset_px - one.center_px)
    result: list[float] | None = np.sqrt(np.mean(np.square(errors), axis=0)).round(4).tolist() if errors else None
    return result


def correlation_times() -> dict[str, float]:
    """Times, s, and largest difference for 300^2 in 380^2 px."""
    random = np.random.default_rng(1)
    image = random.normal(size=(380, 380))
    template = image[33:333, 47:347].copy()

    def by_fft() -> Float:
        pattern, ones = template - template.mean(), np.ones_like(template)
        cross = fftconvolve(image, pattern[::-1, ::-1], mode="valid")
        mean, square = fftconvolve(image, ones, mode="valid"), fftconvolve(image**2, ones, mode="valid")
        return np.asarray(cross / np.sqrt((pattern**2).sum() * (square - mean**2 / ones.size)))

    usable = np.ones(image.shape, dtype=bool)
    usable[0, 0] = False
    ours, ours_s = timed(lambda: normalized_correlation(image, template))
    _, masked_s = timed(lambda: normalized_correlation(image, template, image_usable=usable))
    oracle, oracle_s = timed(by_fft)
    difference = float(np.abs(np.asarray(ours) - np.asarray(oracle)).max())
    return {"whole_s": ours_s, "masked_s": masked_s, "scipy_fft_s": oracle_s, "largest_difference": difference}


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 6
    report: dict[str, object] = {"draws": count, "correlation": correlation_times()}
    for diameter_px in (1.0, 4.0, 8.0):
        for phase_deg in (30.0, 85.0):
            draws = [draw(diameter_px, phase_deg, McEwen(), seed) for seed in range(count)]
            report[f"unresolved {diameter_px:g} px {phase_deg:g} deg"] = measured(Unresolved(), draws)
    for diameter_px in (20.0, 60.0, 300.0):
        for phase_deg in (20.0, 70.0, 120.0):
            draws = [draw(diameter_px, phase_deg, McEwen(), seed) for seed in range(count)]
            name = f"cross_correlation {diameter_px:g} px {phase_deg:g} deg"
            report[name] = measured(CrossCorrelation(), draws) | {"peak_alone_rms_px": peak_only(draws)}
    draws = [draw(60.0, 40.0, Lambert(), seed) for seed in range(count)]
    report["cross_correlation 60 px 40 deg, Lambert truth"] = measured(CrossCorrelation(), draws)
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
