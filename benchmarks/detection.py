"""Speed and accuracy of star detection, beside sep and photutils where installed; prints JSON.

Run with ``OMP_NUM_THREADS=1 python benchmarks/detection.py``. One frame of 2592 x 1944 pixels with 300 stars, photon
noise, read noise and quantization. ``ratio_to_cramer_rao`` is the rms error per axis of the stars found over the rms
of the bound of all; ``cpu_ms`` is processor time on one thread, the least of a few runs.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import time
import warnings
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import norm

from giantlike.core.arrays import Float
from giantlike.core.detector import Detector
from giantlike.processing import Detections, detect_sources
from giantlike.simulation.cosmic_rays import CosmicRays, draw_tracks

SHAPE, STARS, SIGMA_PX = (1944, 2592), 300, 0.8
GAIN, READ_NOISE_E, SKY_DN = 2.0, 5.0, 100.0
NOISE_DN = float(np.sqrt(SKY_DN / GAIN + (READ_NOISE_E / GAIN) ** 2 + 1.0 / 12.0))
DETECTOR = Detector(gain_e_per_dn=GAIN, read_noise_e=READ_NOISE_E)
THRESHOLD_SIGMA = 5.0
RUNS = 5
WIDTHS_PX = (0.6, 0.8, 1.0, 1.5)
HITS_PER_MEGAPIXEL = 200.0
PHASES = 8  # bins of the place in a pixel


def simulate(
    sigma_px: float, seed: int, *, faintest_snr: float = 20.0, hits_per_megapixel: float = 0.0, long_tracks: float = 0.0
) -> tuple[NDArray[np.uint16], Float, Float]:
    """Image, points (n, 2) at least 30 px apart, and fluxes (n,) from a signal to noise ratio upwards.

    Particles leave charge as in :mod:`giantlike.simulation.cosmic_rays`; a part ``long_tracks`` of them in a layer ten
    times as thick, so that their tracks are ten times as long.
    """
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(np.arange(50.0, SHAPE[0] - 50, 60), np.arange(50.0, SHAPE[1] - 50, 60))
    points = rng.permutation(np.stack([x.ravel(), y.ravel()], axis=1))[:STARS] + rng.uniform(-15, 15, (STARS, 2))
    faintest = faintest_snr * NOISE_DN * 2.0 * np.sqrt(np.pi * (sigma_px**2 + 1.0 / 12.0))
    flux = faintest * 10.0 ** rng.uniform(0.0, 1.5, STARS)
    across, down = (
        np.diff(norm.cdf(np.arange(SHAPE[axis] + 1) - 0.5, points[:, 1 - axis, None], sigma_px), axis=1)
        for axis in (1, 0)
    )
    electrons = rng.poisson(((down * flux[:, None]).T @ across + SKY_DN) * GAIN) + rng.normal(0, READ_NOISE_E, SHAPE)
    megapixels = SHAPE[0] * SHAPE[1] / 1e6
    for share, thickness_um in ((1.0 - long_tracks, 15.0), (long_tracks, 150.0)):
        rays = CosmicRays(hits_per_image=share * hits_per_megapixel * megapixels, thickness_um=thickness_um)
        electrons += draw_tracks(rays, SHAPE[1], SHAPE[0], 0.0, rng).deposited_e(SHAPE[1], SHAPE[0])
    return np.clip(np.round(electrons / GAIN), 0, 65535).astype(np.uint16), points, flux


def cramer_rao_px(points: Float, flux: Float, sigma_px: float) -> float:
    """Root mean square of the bound per axis, from derivatives of the normal distribution function."""
    edges = np.arange(-12.5, 13.0)
    variances = []
    for (x, y), f in zip(points - np.round(points), flux, strict=True):
        px, py = (np.diff(norm.cdf(edges, center, sigma_px)) for center in (x, y))
        dx, dy = (-np.diff(norm.pdf(edges, center, sigma_px)) for center in (x, y))
        star = np.outer(py, px)
        jacobian = np.stack([f * np.outer(py, dx), f * np.outer(dy, px), star, np.ones_like(star)]).reshape(4, -1)
        information = (jacobian / (NOISE_DN**2 + f * star.ravel() / GAIN)) @ jacobian.T
        variances.append(np.diag(np.linalg.inv(information))[:2].mean())
    return float(np.sqrt(np.mean(variances)))


def paired(found: Float, points: Float) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """Which of the true points (n,) were found within a pixel, and by which of ``found`` each of those."""
    distance, index = cKDTree(found).query(points)
    seen = np.asarray(distance < 1.0)
    return seen, np.asarray(index)[seen]


def measured(function: Callable[[], Float], points: Float, bound_px: float, runs: int = RUNS) -> dict[str, Any]:
    """Time a function that returns found points (m, 2), and compare them with the truth."""
    times = []
    for _ in range(runs):
        start = time.process_time()
        found = function()
        times.append(time.process_time() - start)
    seen, index = paired(found, points)
    error = found[index] - points[seen]
    return {
        "cpu_ms": round(1e3 * min(times), 1),
        "rms_px": round(float(np.sqrt(np.mean(error**2))), 5),
        "ratio_to_cramer_rao": round(float(np.sqrt(np.mean(error**2))) / bound_px, 3),
        "bias_px": [round(float(b), 5) for b in error.mean(axis=0)],
        "missed": int(np.count_nonzero(~seen)),
        "false": len(found) - int(np.count_nonzero(seen)),
    }


def ours(image: NDArray[np.uint16], psf_sigma_px: float | None) -> Detections:
    found = detect_sources(image, detector=DETECTOR, psf_sigma_px=psf_sigma_px)
    assert isinstance(found, Detections)
    return found


def with_sep(image: NDArray[np.uint16]) -> Float:
    import sep

    pixels = image.astype(np.float32)
    background = sep.Background(pixels)
    pixels -= background.back()
    found = sep.extract(pixels, THRESHOLD_SIGMA, err=background.globalrms)
    x, y, _ = sep.winpos(pixels, found["x"], found["y"], np.full(len(found), SIGMA_PX))
    return np.stack([x, y], axis=1)


def with_daofind(image: NDArray[np.uint16]) -> Float:
    from photutils.detection import DAOStarFinder

    pixels = image.astype(np.float32) - np.float32(np.median(image))
    finder = DAOStarFinder(threshold=THRESHOLD_SIGMA * NOISE_DN, fwhm=2.3548 * SIGMA_PX)
    found = finder(pixels)
    names = ("x_centroid", "y_centroid") if "x_centroid" in found.colnames else ("xcentroid", "ycentroid")
    return np.stack([np.asarray(found[name], dtype=np.float64) for name in names], axis=1)


def with_psf_photometry(image: NDArray[np.uint16]) -> Float:
    from astropy.nddata import NDData, StdDevUncertainty
    from astropy.table import Table
    from photutils.psf import CircularGaussianSigmaPRF, PSFPhotometry

    start = with_daofind(image)
    pixels = image.astype(np.float64) - np.median(image)
    noise = np.sqrt(NOISE_DN**2 + np.maximum(pixels, 0.0) / GAIN)
    photometry = PSFPhotometry(CircularGaussianSigmaPRF(sigma=SIGMA_PX), (7, 7), aperture_radius=3.0)
    table = photometry(
        NDData(pixels, uncertainty=StdDevUncertainty(noise)),
        init_params=Table({"x": start[:, 0], "y": start[:, 1]}),
    )
    return np.stack([np.asarray(table["x_fit"]), np.asarray(table["y_fit"])], axis=1)


def accuracy(draws: int) -> list[dict[str, Any]]:
    """Errors, and mean normalized squared errors (2 when covariances are right), over the width of the PSF.

    ``phase_bias_px`` is the largest mean error of the stars in an eighth of a pixel, with its standard error.
    """
    rows = []
    for sigma_px in WIDTHS_PX:
        errors, squares, bounds, phases = [], [], [], []
        for seed in range(draws):
            image, points, flux = simulate(sigma_px, seed)
            found = ours(image, sigma_px)
            seen, index = paired(found.points_px, points)
            error, covariance = found.points_px[index] - points[seen], found.covariance_px2[index]
            errors.append(error)
            phases.append(points[seen] - np.floor(points[seen]))
            squares.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error))
            bounds.append(cramer_rao_px(points, flux, sigma_px))
        error, nees = np.concatenate(errors), np.concatenate(squares)
        rms, bound = float(np.sqrt(np.mean(error**2))), float(np.sqrt(np.mean(np.square(bounds))))
        rows.append(
            {
                "psf_sigma_px": sigma_px,
                "stars": len(error),
                "ratio_to_cramer_rao": round(rms / bound, 3),
                "bias_px": [round(float(b), 5) for b in error.mean(axis=0)],
                **phase_bias(error.ravel(), np.concatenate(phases).ravel()),
                "mean_nees": round(float(nees.mean()), 3),
                "mean_nees_sigma": round(2.0 / np.sqrt(len(nees)), 3),
            }
        )
    return rows


def phase_bias(error: Float, phase: Float) -> dict[str, float]:
    """Largest weighted mean error in a bin of the place in the pixel, and the standard error there."""
    bins = np.minimum((phase * PHASES).astype(int), PHASES - 1)
    robust = 1.4826 * np.median(np.abs(error))
    means = [float(np.mean(np.clip(error[bins == k], -4 * robust, 4 * robust))) for k in range(PHASES)]
    worst = int(np.argmax(np.abs(means)))
    count = int(np.count_nonzero(bins == worst))
    return {
        "phase_bias_px": round(abs(means[worst]), 5),
        "phase_bias_sigma_px": round(float(np.std(error[bins == worst]) / np.sqrt(count)), 5),
    }


def completeness(draws: int, long_tracks: float) -> list[dict[str, Any]]:
    """Stars from a signal to noise ratio of 10 among 200 particles a megapixel: clean detections and false ones."""
    rows = []
    for sigma_px in WIDTHS_PX:
        stars = missed = not_clean = false = sep_false = sep_missed = 0
        cpu_ms = []
        for seed in range(draws):
            image, points, _ = simulate(sigma_px, 1000 + seed, faintest_snr=10.0, hits_per_megapixel=HITS_PER_MEGAPIXEL)
            start = time.process_time()
            found = ours(image, sigma_px)
            cpu_ms.append(1e3 * (time.process_time() - start))
            clean = found.points_px[found.clean]
            stars += len(points)
            missed += int(np.count_nonzero(~paired(found.points_px, points)[0]))
            not_clean += int(np.count_nonzero(~paired(clean, points)[0]))
            false += int(np.count_nonzero(~paired(points, clean)[0]))
            if importlib.util.find_spec("sep"):
                theirs = with_sep(image)
                sep_missed += int(np.count_nonzero(~paired(theirs, points)[0]))
                sep_false += int(np.count_nonzero(~paired(points, theirs)[0]))
        megapixels = draws * SHAPE[0] * SHAPE[1] / 1e6
        rows.append(
            {
                "psf_sigma_px": sigma_px,
                "stars": stars,
                "completeness_clean": round(1.0 - not_clean / stars, 5),
                "completeness_any": round(1.0 - missed / stars, 5),
                "false_clean_per_megapixel": round(false / megapixels, 3),
                "cpu_ms": round(min(cpu_ms), 1),
                "sep_completeness": round(1.0 - sep_missed / stars, 5),
                "sep_false_per_megapixel": round(sep_false / megapixels, 1),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=3, help="images per width of the PSF")
    draws = parser.parse_args().draws
    cv2.setNumThreads(1)
    image, points, flux = simulate(SIGMA_PX, 7)
    bound = cramer_rao_px(points, flux, SIGMA_PX)
    finders: dict[str, Any] = {
        "giantlike": measured(lambda: ours(image, SIGMA_PX).points_px, points, bound),
        "giantlike, own psf": measured(lambda: ours(image, None).points_px, points, bound),
    }
    if importlib.util.find_spec("sep"):
        finders["sep, windowed"] = measured(lambda: with_sep(image), points, bound)
    if importlib.util.find_spec("photutils"):
        finders["photutils DAOStarFinder"] = measured(lambda: with_daofind(image), points, bound, runs=1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            finders["photutils PSFPhotometry"] = measured(lambda: with_psf_photometry(image), points, bound, runs=1)
    print(
        json.dumps(
            {
                "frame": {"shape": SHAPE, "stars": STARS, "psf_sigma_px": SIGMA_PX, "cramer_rao_px": round(bound, 5)},
                "threads": os.environ.get("OMP_NUM_THREADS", "default"),
                "finders": finders,
                "ratio_to_sep": round(finders["giantlike"]["cpu_ms"] / finders["sep, windowed"]["cpu_ms"], 3)
                if "sep, windowed" in finders
                else None,
                "accuracy": accuracy(draws),
                "cosmic_rays": {
                    "hits_per_megapixel": HITS_PER_MEGAPIXEL,
                    "faintest_snr": 10,
                    "rows": completeness(draws, 0.0),
                    "a_tenth_long": completeness(draws, 0.1),
                },
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
