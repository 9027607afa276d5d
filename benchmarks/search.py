"""Search for what moves.

Sources planted in LORRI frames (``residuals``), sequences in which nothing moves (``nothing``), particles (``events``).
Prints JSON. The frames lie in ``../shared/data/stars`` beside the project. What is planted is drawn here: Gaussians
integrated over pixels, with the shot noise of their light.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import erf
from scipy.stats import poisson

import giantlike as gl
from benchmarks import search_truth
from giantlike import search
from giantlike.catalogs import load_catalog
from giantlike.io.camera_sip import camera_of_sip
from giantlike.processing import detect_sources

FOLDER = Path(__file__).parents[2] / "shared" / "data" / "stars" / "lorri"
GAIN = 20.0  # electron/DN
WIDTHS_PX = {"wolf_359": 0.52, "proxima": 0.34}  # of what is planted: medians of the stars of the three frames
FIELDS = {"wolf_359": slice(3, 6), "proxima": slice(0, 3)}
A_FRAME, APART_PX = 8, 12.0


def read_frames() -> list[tuple[gl.Image, gl.Camera]]:
    """The six frames with the attitude and camera of their headers."""
    frames = []
    for path in sorted(FOLDER.glob("*.fits")):
        image = gl.Image.open(path, bottom_up=True)
        solved = camera_of_sip(image.metadata, columns=256, rows=256)
        east, north, turn = (math.radians(float(image.metadata[key])) for key in ("SDRA", "SDDEC", "SDTHETA"))
        camera = gl.Camera(
            name="lorri", columns=256, rows=256, model=solved.camera.model, detector=gl.Detector(gain_e_per_dn=GAIN)
        )
        covariance = np.diag([north, east, turn]) ** 2
        frames.append((image.with_attitude(solved.camera_from_inertial, covariance_rad2=covariance), camera))
    return frames


def plant(
    image: gl.Image, points_px: np.ndarray, flux_dn: np.ndarray, width_px: float, rng: np.random.Generator
) -> gl.Image:
    """The image with sources (n, 2), px, of fluxes (n,), DN, and a width."""
    rows, columns = image.pixels.shape
    light = np.zeros((rows, columns))
    for (x, y), flux in zip(points_px, flux_dn, strict=True):
        across, down = (
            np.diff(0.5 * erf((np.arange(size + 1) - 0.5 - place) / (math.sqrt(2.0) * width_px)))
            for size, place in ((columns, x), (rows, y))
        )
        light += flux * np.outer(down, across)
    return gl.Image(
        pixels=image.pixels + rng.poisson(light * GAIN) / GAIN,
        mask=image.mask,
        epoch=image.epoch,
        exposure_s=image.exposure_s,
        camera_from_inertial=image.camera_from_inertial,
        attitude_covariance_rad2=image.attitude_covariance_rad2,
        observer=image.observer,
        name=image.name,
    )


def scatter(rng: np.random.Generator) -> np.ndarray:
    """Places (n, 2), px, at least so far apart."""
    points: list[np.ndarray] = []
    while len(points) < A_FRAME:
        one = rng.uniform(5.0, 250.0, 2)
        if all(np.linalg.norm(one - other) > APART_PX for other in points):
            points.append(one)
    return np.array(points)


def residuals(draws: int) -> dict[str, Any]:
    """Share found, errors and classes of planted sources, by field and signal-to-noise ratio."""
    frames, catalog, result = read_frames(), load_catalog("default"), dict[str, Any]()
    for field, which in FIELDS.items():
        for snr in (5.0, 8.0, 12.0, 20.0):
            width = WIDTHS_PX[field]
            rng, rows, seconds = np.random.default_rng(int(snr)), [], []
            for image, camera in frames[which]:
                plain = search.residual_sources(image, camera, None, catalog, None).unwrap()
                first = detect_sources(image.pixels, detector=camera.detector, psf_sigma_px=width)
                assert not isinstance(first, gl.Failure)
                unit_dn = first.noise_dn * 2.0 * math.sqrt(math.pi * (width**2 + 1.0 / 12.0))  # flux of SNR 1
                for _ in range(draws):
                    points = scatter(rng)
                    more = plant(image, points, np.full(len(points), snr * unit_dn), width, rng)
                    started = time.process_time()
                    found = search.residual_sources(more, camera, None, catalog, None).unwrap()
                    seconds.append(time.process_time() - started)
                    for point in points:
                        away = np.linalg.norm(found.points_px - point, axis=1)
                        best, error = int(away.argmin()), found.points_px[int(away.argmin())] - point
                        alone = float(np.linalg.norm(plain.points_px - point, axis=1).min()) > 2.0
                        spread = found.covariance_px2[best]
                        nees = float(error @ np.linalg.solve(spread, error)) / 2.0
                        rows.append((away[best] < 1.0, alone, away[best] ** 2 / 2.0, nees, found.kinds[best]))
            hits = [row for row in rows if row[0]]
            lonely = [row for row in hits if row[1]]
            kinds = [row[4] for row in hits]
            result[f"{field} SNR {snr:g}"] = {
                "planted": len(rows),
                "found": round(len(hits) / len(rows), 3),
                "rms_px": round(math.sqrt(np.mean([row[2] for row in hits])), 3),
                "rms_px_alone": round(math.sqrt(np.mean([row[2] for row in lonely])), 3),
                "normalized_alone": round(math.sqrt(np.mean([row[3] for row in lonely])), 3),
                "normalized_median_alone": round(math.sqrt(np.median([row[3] for row in lonely]) / math.log(2.0)), 3),
                "classes": {str(name): kinds.count(name) for name in sorted(set(kinds))},
                "cosmic_rays_alone": sum(row[4] == search.SourceClass.COSMIC_RAY for row in lonely),
                "cpu_s": round(float(np.median(seconds)), 3),
            }
    return result


def nothing_planted(sequences: int) -> dict[str, Any]:
    """Tracks found where nothing moves, and how many may be: the frames in any order, and made sequences."""
    result: dict[str, Any] = {}
    frames, catalog = read_frames(), load_catalog("default")
    alone = [search.residual_sources(image, camera, None, catalog, None).unwrap() for image, camera in frames]
    orders = [list(one) for one in itertools.permutations(alone)]
    runs = {"frames in any order, 3 detections": (orders, 3)}
    for name, structure in (("uniform", False), ("structured", True)):
        made = [search_truth.empty_sequence(seed, structure=structure) for seed in range(sequences)]
        runs |= {f"{name}, {least} detections": (made, least) for least in (3, 4)}
    for name, (many, least) in runs.items():
        options = search.LinkOptions(max_rate_px_s=1.0, min_detections=least)
        chances = []
        for one in many:
            ordered = [replace(image, et=10.0 * k) for k, image in enumerate(one)] if many is orders else one
            chances += [track.expected_false for track in search.link(ordered, options)]
        result[name] = {
            f"expected <= {limit:g}": {
                "found": int(np.count_nonzero(np.array(chances) <= limit)),
                "may_be": int(poisson.ppf(0.95, limit * len(many))),
            }
            for limit in (0.01, 0.1, 1.0)
        } | {"sequences": len(many)}
    return result


def events(count: int) -> list[dict[str, Any]]:
    """Precision and recall of tracks of particles, by sequence."""
    rows = []
    for seed in range(count):
        sequence, owners, acceleration = search_truth.event(seed)
        options = search.LinkOptions(max_rate_px_s=0.4, max_acceleration_px_s2=acceleration / 2.0)
        started = time.process_time()
        tracks = [one for one in search.link(sequence, options) if one.accepted]
        seconds = time.process_time() - started
        found, right = set[int](), 0
        for track in tracks:
            names, counts = np.unique(
                [owners[k][i] for k, i in zip(track.images, track.sources, strict=True)], return_counts=True
            )
            best = int(counts.argmax())
            if names[best] >= 0 and counts[best] >= max(3.0, 0.75 * len(track)):
                right += 1
                found.add(int(names[best]))
        bright = np.concatenate([own[one.snr >= 7.0] for one, own in zip(sequence, owners, strict=True)])
        names, counts = np.unique(bright[bright >= 0], return_counts=True)
        wanted = set(names[counts >= 4].tolist())
        rows.append(
            {
                "tracks": len(tracks),
                "precision": round(right / max(len(tracks), 1), 4),
                "recall": round(len(found & wanted) / max(len(wanted), 1), 4),
                "cpu_s": round(seconds, 1),
            }
        )
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["residuals", "nothing", "events"])
    parser.add_argument("--count", type=int)
    arguments = parser.parse_args()
    work: dict[str, tuple[Any, int]] = {
        "residuals": (residuals, 15),
        "nothing": (nothing_planted, 200),
        "events": (events, 10),
    }
    function, usual = work[arguments.what]
    print(json.dumps(function(arguments.count or usual), indent=1))
