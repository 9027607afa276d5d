"""How often stars are named rightly, wrongly or not at all, and how long it takes; prints JSON as it goes.

Run with ``OMP_NUM_THREADS=1 python benchmarks/identification.py [--draws 10000] [--only NAME ...]``. Fields of the
default catalog in random directions: the brightest stars of the field with 0.2 magnitudes of scatter and centroid
noise, some missing, and false detections of any of their brightnesses anywhere. A field counts as ``right`` when
every corner of the image lies within ``RIGHT_PX`` of its place, as ``wrong`` when there is a solution and it does not.
Times are CPU on one thread; ``identification_ms`` is all but the weighted fits of the attitude, which ``solve_ms``
holds too. Rows of a long table are cumulative.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import resource
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import BrownModel, EquidistantModel
from giantlike.catalogs import MemoryCatalog, cache_folder, load_catalog
from giantlike.core.arrays import Float
from giantlike.core.frames import rotate
from giantlike.core.outcomes import AttitudeFix, Failure
from giantlike.image import Image
from giantlike.processing.detection.detections import Detections
from giantlike.stars import StarNavigation, StarOptions, navigation
from giantlike.stars import lost_in_space as search
from giantlike.stars.field import Sky
from giantlike.stars.refine import RefinedAttitude, refine_attitude
from giantlike.stars.star_index import Pattern, cap_radius_rad, sky_index

RIGHT_PX = 5.0  # of 1024, and up to a half pixel of centroid noise
SIZE = 1024
MAGNITUDE_NOISE = 0.2
_fit_s = [0.0]


def _timed_refine(*args: Any, **kwargs: Any) -> RefinedAttitude | Failure:
    start = time.process_time()
    try:
        return refine_attitude(*args, **kwargs)
    finally:
        _fit_s[0] += time.process_time() - start


@dataclasses.dataclass(frozen=True)
class Field:
    """What a simulated image shows."""

    n_stars: int = 30
    missing: float = 0.2
    n_false: int = 15
    sigma_px: float = 0.2

    def draw(self, rng: np.random.Generator, sky: Sky, camera: Camera) -> tuple[Rotation, Float]:
        """A random attitude and detections (m, 2), brightest first."""
        attitude = Rotation.random(rng=rng)
        stars = sky.field(camera, attitude, count=max(20 * self.n_stars, 400))
        places = camera.model.project(rotate(attitude, stars.directions_inertial))
        seen = np.flatnonzero(camera.contains(places))
        magnitude = stars.stars.magnitude[seen] + MAGNITUDE_NOISE * rng.normal(size=seen.size)
        chosen = np.argsort(magnitude)[: self.n_stars]
        chosen = chosen[rng.random(chosen.size) >= self.missing]
        points = places[seen[chosen]] + self.sigma_px * rng.normal(size=(chosen.size, 2))
        brightness = magnitude[chosen] if chosen.size else np.zeros(1)
        false = rng.uniform(-0.5, SIZE - 0.5, (self.n_false, 2))
        order = np.argsort(np.concatenate([magnitude[chosen], rng.choice(brightness, self.n_false)]))
        return attitude, np.concatenate([points, false])[order]


def as_detections(points: Float, sigma_px: float) -> Detections:
    n = len(points)
    return dataclasses.replace(
        Detections.empty(psf_sigma_px=0.8, noise_dn=3.0),
        points_px=points,
        covariance_px2=np.tile(sigma_px**2 * np.eye(2), (n, 1, 1)),
        flux_dn=np.linspace(2e4, 1e3, n),
        snr=np.linspace(600.0, 30.0, n),
        peak_dn=np.linspace(5e3, 2e2, n),
        area_px=np.full(n, 9),
        background_dn=np.zeros(n),
        width_px=np.full(n, 0.8),
        flags=np.zeros(n, dtype=np.uint16),
    )


def corner_error_px(estimate: Rotation, truth: Rotation, camera: Camera) -> float:
    """Largest shift of a corner (of the middle of an edge, where a lens leaves the corners dark)."""
    last = SIZE - 1.0
    places = np.array([[0, 0], [last, 0], [0, last], [last, last], [0, last / 2], [last / 2, 0], [last / 2, last / 2]])
    rays = camera.model.unproject(places)
    seen = np.isfinite(rays).all(axis=1)
    moved = camera.model.project(rotate(estimate * truth.inv(), rays[seen]))
    return float(np.linalg.norm(moved - places[seen], axis=1).max())


class Tally:
    """Counts and times of many images."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.whole: list[float] = []
        self.naming: list[float] = []

    def solve(
        self, image: Image, points: Float, sigma_px: float, solver: StarNavigation, truth: Rotation, camera: Camera
    ) -> None:
        """Solve one image and compare with the truth through the true camera."""
        detections = as_detections(points, sigma_px)
        _fit_s[0] = 0.0
        start = time.process_time()
        outcome = solver.solve_detections(image, detections)
        whole = time.process_time() - start
        self.whole.append(whole)
        self.naming.append(whole - _fit_s[0])
        if isinstance(outcome, AttitudeFix):
            error = corner_error_px(outcome.camera_from_inertial, truth, camera)
            self.counts["right" if error < RIGHT_PX else "wrong"] += 1
        else:
            self.counts[str(outcome.reason)] += 1

    def summary(self) -> dict[str, Any]:
        """What the table says."""
        n = len(self.whole)
        return {
            "fields": n,
            "right_percent": round(100.0 * self.counts["right"] / n, 3),
            "wrong": self.counts["wrong"],
            "others": {key: count for key, count in self.counts.items() if key not in ("right", "wrong")},
            "identification_ms": _quantiles(self.naming),
            "solve_ms": _quantiles(self.whole),
        }


def _quantiles(seconds: list[float]) -> dict[str, float]:
    return {
        name: round(1e3 * float(np.quantile(seconds, q)), 1)
        for name, q in (("median", 0.5), ("p95", 0.95), ("max", 1.0))
    }


def _image(attitude: Rotation | None = None) -> Image:
    image = Image(pixels=np.zeros((SIZE, SIZE), np.uint8), name="simulated")
    return image if attitude is None else dataclasses.replace(image, camera_from_inertial=attitude)


def _turned(rng: np.random.Generator, attitude: Rotation, degrees: float) -> Rotation:
    axis = rng.normal(size=3)
    return Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)) * attitude


def a_priori(catalog: MemoryCatalog, draws: int) -> Iterator[dict[str, Any]]:
    """4 degrees, 24 stars, 10 % missing, 5 false; the attitude off by an angle about a random axis."""
    camera, field, sky = Camera.from_fov(4.0, SIZE, SIZE), Field(24, 0.1, 5, 0.1), Sky(catalog=catalog)
    solver = StarNavigation(camera, catalog)
    for degrees in (0.1, 0.3, 1.0, 3.0):
        rng, tally = np.random.default_rng(1), Tally()
        for _ in range(draws):
            attitude, points = field.draw(rng, sky, camera)
            tally.solve(_image(_turned(rng, attitude, degrees)), points, field.sigma_px, solver, attitude, camera)
        yield {"attitude_error_deg": degrees, **tally.summary()}


def lost_in_space(catalog: MemoryCatalog, draws: int) -> Iterator[dict[str, Any]]:
    """10 to 20 degrees, 30 stars, 20 % missing, 15 false, calibrated."""
    sky, options = Sky(catalog=catalog), StarOptions(lost_in_space=True)
    rng, tally = np.random.default_rng(2), Tally()
    for number in range(draws):
        camera = Camera.from_fov(float(rng.uniform(10.0, 20.0)), SIZE, SIZE)
        field = Field(sigma_px=float(rng.uniform(0.1, 0.5)))
        attitude, points = field.draw(rng, sky, camera)
        tally.solve(_image(), points, field.sigma_px, StarNavigation(camera, catalog, options), attitude, camera)
        if _is_tenth(number, draws):
            yield {"fov_deg": "10 to 20", **tally.summary()}


def noise(catalog: MemoryCatalog, draws: int) -> Iterator[dict[str, Any]]:
    """Only false detections, 8 to 60 of them; whatever is solved is wrong."""
    rng, tally = np.random.default_rng(3), Tally()
    for number in range(draws):
        camera = Camera.from_fov(float(rng.uniform(10.0, 20.0)), SIZE, SIZE)
        points = rng.uniform(-0.5, SIZE - 0.5, (int(rng.integers(8, 61)), 2))
        options = StarOptions(lost_in_space=True)
        tally.solve(_image(), points, 0.3, StarNavigation(camera, catalog, options), Rotation.random(rng=rng), camera)
        if _is_tenth(number, draws):
            yield {"fov_deg": "10 to 20", **tally.summary()}


def _is_tenth(number: int, draws: int) -> bool:
    """Whether another tenth of the draws is done."""
    return (number + 1) % max(draws // 10, 1) == 0


def uncalibrated(catalog: MemoryCatalog, draws: int) -> Iterator[dict[str, Any]]:
    """10 to 20 degrees; the focal length off by up to 20 % and 10 px of radial distortion in the corner, unknown."""
    sky = Sky(catalog=catalog)
    for worst in (0.05, 0.19):
        rng, tally = np.random.default_rng(4), Tally()
        options = StarOptions(lost_in_space=True, estimate_scale=True, scale_error=min(1.05 * worst, 0.2))
        for _ in range(draws):
            guess = Camera.from_fov(float(rng.uniform(10.0, 20.0)), SIZE, SIZE)
            focal = guess.model.focal_length_px * float(rng.uniform(1.0 - worst, 1.0 + worst))
            corner = SIZE / np.sqrt(2.0)
            k1 = float(rng.choice([-1.0, 1.0])) * 10.0 * focal**2 / corner**3
            model = BrownModel(fx_px=focal, fy_px=focal, cx_px=(SIZE - 1) / 2, cy_px=(SIZE - 1) / 2, k1=k1)
            camera = dataclasses.replace(guess, model=model)
            field = Field(n_stars=40)
            attitude, points = field.draw(rng, sky, camera)
            tally.solve(_image(), points, field.sigma_px, StarNavigation(guess, catalog, options), attitude, camera)
        yield {"focal_length_error": worst, **tally.summary()}


def fields_of_view(catalog: MemoryCatalog, draws: int) -> Iterator[dict[str, Any]]:
    """Calibrated pinholes of 1 to 45 degrees, and equidistant fisheyes."""
    sky = Sky(catalog=catalog)
    for fov_deg in (2, 3, 4, 6, 10, 15, 20, 30, 45, 120, 180, 1):
        camera = Camera.from_fov(min(fov_deg, 60.0), SIZE, SIZE)
        if fov_deg > 60:
            focal = SIZE / np.radians(fov_deg)
            middle = (SIZE - 1) / 2
            model = EquidistantModel(fx_px=focal, fy_px=focal, cx_px=middle, cy_px=middle)
            camera = dataclasses.replace(camera, model=model)
        field = Field(n_stars=30 if fov_deg <= 30 else 60 if fov_deg <= 60 else 120)
        rng, tally = np.random.default_rng(5), Tally()
        solver = StarNavigation(camera, catalog, StarOptions(lost_in_space=True))
        for _ in range(draws):
            attitude, points = field.draw(rng, sky, camera)
            tally.solve(_image(), points, field.sigma_px, solver, attitude, camera)
        yield {"fov_deg": fov_deg, "stars_before_losses": field.n_stars, **tally.summary()}


def indices(catalog: MemoryCatalog, _: int) -> Iterator[dict[str, Any]]:
    """Size of the indices, and the time to load them from the cache (or to make them, at first)."""
    for fov_deg in (2, 4, 10, 20, 45):
        for pattern in Pattern:
            radius = cap_radius_rad(np.radians(0.45 * fov_deg))
            start = time.process_time()
            index = sky_index(catalog, pattern, radius)
            spent = time.process_time() - start
            arrays = (index.ids, index.directions, index.patterns, index.cells)
            yield {
                "fov_deg": fov_deg,
                "pattern": str(pattern),
                "patterns": len(index),
                "stars": len(index.ids),
                "megabytes": round(sum(array.nbytes for array in arrays) / 1e6, 1),
                "cpu_s": round(spent, 2),
            }


SECTIONS = {
    "indices": (indices, 1.0),
    "a_priori": (a_priori, 0.1),
    "fields_of_view": (fields_of_view, 0.01),
    "uncalibrated": (uncalibrated, 0.03),
    "lost_in_space": (lost_in_space, 1.0),
    "noise": (noise, 1.0),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=10_000, help="random fields of the largest tables")
    parser.add_argument("--only", nargs="*", default=list(SECTIONS), choices=list(SECTIONS))
    arguments = parser.parse_args()
    for module in (navigation, search):  # the only way to tell naming stars from weighing them
        vars(module)["refine_attitude"] = _timed_refine
    catalog = load_catalog("default")
    for name in arguments.only:
        section, share = SECTIONS[name]
        for row in section(catalog, max(int(share * arguments.draws), 2)):
            print(json.dumps({"section": name, **row}), flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    cached = sum(path.stat().st_size for path in Path(cache_folder()).glob("star-index-*")) / 1e6
    print(json.dumps({"section": "memory", "peak_rss_mb": round(peak), "cache_mb": round(cached, 1)}))


if __name__ == "__main__":
    main()
