"""Accuracy, consistency and speed of the estimators that fit a rendered template; prints JSON.

Truth is rendered with rays at other places than the templates use, and with Poisson and read noise; a priori errors are
10 px and 1.5 % in range. Side by side stand the peak of the correlation alone (the paper's way) and the fit, and
OpenCV's correlation and a plain one by FFT. ``small`` measures bodies of a few pixels instead, whose a priori range is
off by a normal deviate of the 2 % that the estimators expect: mean squared error over covariance with the band in which
95 % of such means lie, and the Cramer-Rao bound of the noise, once with all that the fit frees and once with brightness
and background alone.

Usage: python benchmarks/estimators_template.py [draws] | small [draws]
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import fftconvolve
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

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
from giantlike.relative.template_render import KNOWN_BLUR_SIGMA_PX2
from giantlike.relative.unresolved import UnresolvedOptions
from giantlike.scene import Scene, Target
from giantlike.shapes import Shape, irregular_body

PSF_PX = 0.75
CAMERA = Camera(
    name="NavCam",
    columns=640,
    rows=640,
    model=BrownModel(fx_px=3473.3, fy_px=3473.4, cx_px=321.0, cy_px=317.0, k1=-0.54, k2=0.39, p1=-2.5e-4),
    psf=GaussianPsf(sigma_px=PSF_PX),
    detector=Detector(gain_e_per_dn=1.0, read_noise_e=5.0, saturation_dn=4095.0),
)
ATTITUDE = Rotation.from_rotvec([0.3, -1.0, 0.4])
PEAK_DN, ERROR_PX, RANGE_FACTOR = 3000.0, 10.0, 1.015
RANGE_SIGMA = 0.02  # what the estimators expect
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
    body: Body
    sun: Float
    scale_dn: float


def draw(
    diameter_px: float,
    phase_deg: float,
    law: Reflectance,
    seed: int,
    *,
    range_sigma: float | None = None,
    shape: Shape | None = None,
) -> Draw:
    """An image; the a priori range is off by 1.5 %, or by a normal deviate of ``range_sigma``."""
    random = np.random.default_rng(seed)
    shape, pose = shape or BODIES[seed % len(BODIES)], Rotation.random(random_state=seed)
    center = np.array([320.0, 318.0]) + random.uniform(0, 1, 2)
    sight = CAMERA.model.unproject(center)
    range_km = 2 * shape.mean_radius_km * CAMERA.model.focal_length_px / diameter_px
    side = unit(np.cross(sight, [*random.normal(size=2), 0.0]))
    sun = -math.cos(math.radians(phase_deg)) * sight + math.sin(math.radians(phase_deg)) * side

    body = Body(shape=shape, camera_from_body=pose, position_camera_km=range_km * sight, reflectance=law)
    truth = rendered(body, sun, RenderOptions(rays_per_pixel_side=4, min_rays_across=150, jitter_seed=seed))
    scale_dn = PEAK_DN / float(truth.brightness.max())
    signal = scale_dn * truth.placed(640, 640)
    pixels = np.rint(random.poisson(signal) + random.normal(0, CAMERA.detector.read_noise_e, signal.shape))
    angle = random.uniform(0, 2 * np.pi)
    predicted = center + ERROR_PX * np.array([math.cos(angle), math.sin(angle)])
    factor = RANGE_FACTOR if range_sigma is None else math.exp(random.normal(0.0, range_sigma))
    position = range_km * factor * CAMERA.model.unproject(predicted)
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
        template=rendered(replace(body, position_camera_km=position, reflectance=McEwen()), sun, RenderOptions()),
        predicted_px=predicted,
        body=body,
        sun=sun,
        scale_dn=scale_dn,
    )


def rendered(body: Body, sun: Float, options: RenderOptions, *, psf_variance_px2: float = PSF_PX**2) -> Template:
    psf = GaussianPsf(sigma_px=math.sqrt(psf_variance_px2))
    template = render(body, CAMERA.model, sun_direction_camera=sun, psf=psf, columns=640, rows=640, options=options)
    assert isinstance(template, Template), template
    return template


def bounds_px(one: Draw) -> tuple[float, float]:
    """Cramer-Rao bounds of the centre, root mean square per axis, px: with all that the fit frees; brightness alone."""
    options = RenderOptions(rays_per_pixel_side=16, min_rays_across=150)

    def light(
        x_px: float = 0.0,
        y_px: float = 0.0,
        *,
        log_range: float = 0.0,
        law: Reflectance = one.body.reflectance,
        psf_variance_px2: float = PSF_PX**2,
    ) -> Float:
        position = one.range_km * math.exp(log_range) * CAMERA.model.unproject(np.add(one.center_px, (x_px, y_px)))
        body = replace(one.body, position_camera_km=position, reflectance=law)
        template = rendered(body, one.sun, options, psf_variance_px2=psf_variance_px2)
        return one.scale_dn * template.placed(640, 640)[280:360, 280:360]

    here, lambert = light(), light(law=Lambert())
    columns = [
        (light(0.1) - light(-0.1)) / 0.2,
        (light(0.0, 0.1) - light(0.0, -0.1)) / 0.2,
        here,
        np.ones_like(here),
        (light(log_range=0.03) - light(log_range=-0.03)) / 0.06,
        (light(psf_variance_px2=PSF_PX**2 + 0.1) - light(psf_variance_px2=PSF_PX**2 - 0.1)) / 0.2,
        lambert * here.sum() / lambert.sum() - here,
    ]
    design = np.stack([column.ravel() for column in columns], axis=1)
    information = (design / CAMERA.detector.variance_dn2(here.ravel())[:, None]).T @ design
    known = np.diag([0.0, 0.0, 0.0, 0.0, RANGE_SIGMA**-2, KNOWN_BLUR_SIGMA_PX2**-2, 1.0])
    free, plain = np.linalg.inv(information + known), np.linalg.inv(information[:4, :4])
    return math.sqrt(float(np.trace(free[:2, :2])) / 2), math.sqrt(float(np.trace(plain[:2, :2])) / 2)


def small_bodies(count: int) -> dict[str, object]:
    """Bodies of a few pixels over phase angle and size."""
    low, high = (float(chi2.ppf(chance, 2 * count)) / count for chance in (0.025, 0.975))
    report: dict[str, object] = {"draws": count, "nees_band_95": [round(low, 2), round(high, 2)]}
    estimators = (Unresolved(UnresolvedOptions(max_diameter_px=40.0)), CrossCorrelation())
    for diameter_px in (0.5, 1.0, 2.0, 4.0, 8.0, 12.0):
        for phase_deg in (20.0, 50.0, 80.0, 120.0):
            draws = [draw(diameter_px, phase_deg, McEwen(), seed, range_sigma=RANGE_SIGMA) for seed in range(count)]
            bounds = np.sqrt(np.mean(np.square([bounds_px(one) for one in draws[:6]]), axis=0)).round(4).tolist()
            report[f"{diameter_px:g} px {phase_deg:g} deg"] = {"bounds_px": bounds} | {
                one.name: measured(one, draws) for one in estimators
            }
            print(json.dumps({f"{diameter_px:g} px {phase_deg:g} deg": [*report.values()][-1]}), file=sys.stderr)
    return report


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
    if sys.argv[1:2] == ["small"]:
        print(json.dumps(small_bodies(int(sys.argv[2]) if len(sys.argv) > 2 else 200), indent=2))
        return
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
