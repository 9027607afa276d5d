"""Edges to a fraction of a pixel: accuracy without and with noise, and speed, of two windows; prints JSON.

Disks of several radii, drawn ten times as fine and blurred, lit from twelve sides; errors are distances of the edge
points from the circle. With noise the squared errors stand beside the stated variance (1 where that is honest).

Usage: python benchmarks/edges.py [--quick]
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable

import cv2
import numpy as np

from giantlike.core.arrays import Float
from giantlike.core.detector import Detector
from giantlike.processing.limb.edges import EdgePoints, Pixels, scan_edges
from giantlike.processing.limb.zernike import zernike_edges

DETECTOR = Detector(gain_e_per_dn=1.0, read_noise_e=5.0)
LEVEL_DN = 1000.0
FINE = 10


def disk(radius_px: float, blur_px: float) -> tuple[Float, Float]:
    size = int(2 * radius_px + 24)
    center = np.array([size / 2 + 0.23, size / 2 - 0.31])
    x, y = np.meshgrid(*[(np.arange(size * FINE) + 0.5) / FINE - 0.5] * 2)
    drawn = (np.hypot(x - center[0], y - center[1]) < radius_px).astype(np.float64)
    if blur_px > 0:
        drawn = cv2.GaussianBlur(drawn, (0, 0), blur_px * FINE)
    return LEVEL_DN * drawn.reshape(size, FINE, size, FINE).mean(axis=(1, 3)), center


def methods(blur_px: float, curvature: float) -> dict[str, Callable[[Float, Pixels], EdgePoints]]:
    def zernike(size: int) -> Callable[[Float, Pixels], EdgePoints]:
        def measured(image: Float, seeds: Pixels) -> EdgePoints:
            return zernike_edges(
                image,
                np.ones(image.shape, dtype=bool),
                seeds,
                variance_dn2=DETECTOR.variance_dn2,
                blur_sigma_px=blur_px,
                size=size,
                curvature_px=curvature,
            )

        return measured

    return {"zernike 5x5": zernike(5), "zernike 7x7": zernike(7)}


def measured(radius_px: float, blur_px: float, *, noise: bool) -> dict[str, object]:
    light, center = disk(radius_px, blur_px)
    report: dict[str, object] = {}
    for name, method in methods(blur_px, 1.0 / radius_px).items():
        errors, chi2, spent = [], [], 0.0
        for number, angle in enumerate(np.radians(np.arange(5.0, 365.0, 30.0))):
            image = light
            if noise:
                random = np.random.default_rng(number)
                image = light + random.normal(size=light.shape) * np.sqrt(DETECTOR.variance_dn2(light))
            usable = np.ones(image.shape, dtype=bool)
            sunlight = [np.cos(angle), np.sin(angle)]
            seeds = scan_edges(image, usable, sunlight, threshold_dn=60.0, blur_sigma_px=blur_px)
            started = time.process_time()
            edges = method(image, seeds)
            spent += time.process_time() - started
            error = np.linalg.norm(edges.points_px - center, axis=1) - radius_px
            errors.append(error)
            chi2.append((error / edges.sigma_px) ** 2)
        all_errors = np.concatenate(errors)
        report[name] = {
            "edges": all_errors.size,
            "rms_px": round(float(np.sqrt(np.mean(all_errors**2))), 4),
            "mean_px": round(float(np.mean(all_errors)), 4),
            "q99_px": round(float(np.quantile(np.abs(all_errors), 0.99)), 4),
            "us_an_edge": round(1e6 * spent / all_errors.size, 1),
        }
        if noise:
            report[name]["squared_error_over_variance"] = round(float(np.mean(np.concatenate(chi2))), 2)  # type: ignore[index]
    return report


def main() -> None:
    radii = (60.0,) if "--quick" in sys.argv else (8.0, 25.0, 60.0, 150.0)
    report: dict[str, object] = {}
    for radius_px in radii:
        for blur_px in (0.0, 0.5, 0.7, 1.0):
            report[f"radius {radius_px:g}, blur {blur_px:g}"] = measured(radius_px, blur_px, noise=False)
    report["radius 60, blur 0.7, noise 5 DN and shot noise on 1000 DN"] = measured(60.0, 0.7, noise=True)
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
