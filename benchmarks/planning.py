"""Plans against what images give: expected stars, signals and fixes; truth and images by ``giantlike.independent``.

Usage: python benchmarks/planning.py [--images 300] [--draws 3] [--seed 0] [--estimators cross_correlation]

A plan is made of images of an ellipsoid of 30 to 160 px at phases of 20 to 100 degrees, of which relief, albedo, law,
size, pole, brightness and position are uncertain. Each image is then drawn once more, by a renderer and a detector that
share no code with the plan, and given to the estimators. ``predicted`` is the ratio of predicted to stated sigma across
the line of sight (median, 5 and 95 %, and the fraction within 0.67-1.5), ``nees`` the mean square of the errors by the
predicted covariance and by the stated one, ``brier`` the score of the probability of no usable fix, and that of a
constant one at the observed rate; ``peak`` the fraction of peaks within the interval of 5 to 95 %.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from giantlike.camera import Camera
from giantlike.camera_models import PinholeModel
from giantlike.core.arrays import Float
from giantlike.core.causes import sum_parts
from giantlike.core.detector import Detector, GaussianPsf
from giantlike.core.outcomes import Failure, PositionFix
from giantlike.core.photometry import Photometry
from giantlike.core.time import time_from_et
from giantlike.ephemeris import ApparentGeometry
from giantlike.image import Image
from giantlike.independent import PinholeView, Pose, Psf, Recorder, ReliefBody, bumps, record, render_body, rough
from giantlike.independent.laws import lambert, lommel_seeliger, mcewen
from giantlike.planning import Candidate, Plan, PlannedImage, PlanOptions, TruthOptions, plan_images
from giantlike.relative import ESTIMATORS
from giantlike.scene import Scene, Target, TargetUncertainty
from giantlike.shapes import Ellipsoid

FOCAL_PX, SIZE, PSF_PX, GAIN, READ_E, ALBEDO = 3000.0, 400, 0.8, 4.0, 12.0, 0.06
RADII_KM = np.array([0.30, 0.27, 0.25])
TRUTH = TruthOptions(relief=0.005, albedo=0.06, brightness=0.15, law=0.3, psf=0.05)
CAMERA = Camera(
    name="plan",
    columns=SIZE,
    rows=SIZE,
    model=PinholeModel(fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=(SIZE - 1) / 2, cy_px=(SIZE - 1) / 2),
    psf=GaussianPsf(sigma_px=PSF_PX),
    detector=Detector(gain_e_per_dn=GAIN, read_noise_e=READ_E, bias_dn=100.0, saturation_dn=16_000.0),
    photometry=Photometry(zero_point_e_s=2.0e5, covariance_mag2=np.diag([0.03**2, 0.0, 0.0])),
)
EXPOSURES_S = tuple(np.geomspace(3e-4, 0.1, 26).tolist())


def scene() -> Scene:
    """Scene of the plan; positions are those of the candidates."""
    nowhere = ApparentGeometry(position_inertial_km=np.array([0.0, 0.0, 1.0]))
    known = TargetUncertainty(scale=0.004, pole_rad=0.01, spin_rad=0.01, ephemeris_km=0.02)
    target = Target(
        name="ROCK", shape=Ellipsoid(radii_km=RADII_KM), ephemeris=nowhere, uncertainty=known, normal_albedo=ALBEDO
    )
    return Scene(targets=(target,))


def candidates(count: int, seed: int, diameters_px: tuple[float, float] = (30.0, 160.0)) -> list[Candidate]:
    """Images at drawn ranges, phases and orientations."""
    rng, radius_km = np.random.default_rng([seed, 10]), float(np.cbrt(RADII_KM.prod()))
    drawn = []
    for number in range(count):
        diameter_px = math.exp(rng.uniform(*np.log(diameters_px)))
        phase, side = np.radians(rng.uniform(20.0, 100.0)), rng.uniform(0.0, 2.0 * np.pi)
        sun = [np.sin(phase) * np.cos(side), np.sin(phase) * np.sin(side), -np.cos(phase)]
        sight = CAMERA.model.unproject(CAMERA.center_px + rng.uniform(-20.0, 20.0, 2))
        place = ApparentGeometry(
            position_inertial_km=2.0 * radius_km * FOCAL_PX / diameter_px * sight,
            inertial_from_body=Rotation.random(random_state=rng),
            sun_direction_inertial=np.array(sun),
        )
        drawn.append(
            Candidate(
                name=f"{number:04d}.fits",
                epoch=time_from_et(7e8),
                camera_from_inertial=Rotation.identity(),
                places={"ROCK": place},
            )
        )
    return drawn


@dataclass(frozen=True, eq=False)
class Taken:
    """An independent image of a candidate: pixels, true position and brightest pixel without noise."""

    image: Image
    position_km: Float
    peak_dn: float


def take(planned: PlannedImage, seed: int) -> Taken:
    """Draw the truth of a candidate from what the plan declares, and expose it."""
    rng, place = np.random.default_rng([seed, 11]), planned.candidate.places["ROCK"]
    known = scene().targets[0].uncertainty
    share, slope = TRUTH.law * rng.standard_normal(2)

    def law(mu0: Float, mu: Float, cos_phase: Float) -> Float:
        change = share * (lambert(mu0, mu, cos_phase) - lommel_seeliger(mu0, mu, cos_phase))
        mixed = np.maximum(mcewen(mu0, mu, cos_phase) + change, 0.0)
        return np.asarray(mixed * np.exp(-slope * np.arccos(np.clip(cos_phase, -1.0, 1.0))))

    assert TRUTH.albedo is not None
    body = ReliefBody(
        RADII_KM * (1.0 + known.scale * rng.standard_normal()),
        rough(int(rng.integers(2**31)), rms=TRUTH.relief, degrees=(2.5, 40.0), count=200, cells=64),
        bumps(int(rng.integers(2**31)), rms=TRUTH.albedo, cells=64),
    )
    turn = Rotation.from_rotvec(rng.standard_normal(3) * [known.pole_rad, known.pole_rad, known.spin_rad])
    position = place.position_inertial_km + known.ephemeris_km * rng.standard_normal(3)
    assert place.sun_direction_inertial is not None
    light = render_body(
        body,
        PinholeView(FOCAL_PX, ((SIZE - 1) / 2, (SIZE - 1) / 2), SIZE, SIZE),
        Pose(position, place.inertial_from_body * turn, place.sun_direction_inertial),
        law=law,
        psf=Psf(sigma_px=PSF_PX * math.exp(TRUTH.psf * rng.standard_normal())),
        peak_dn=None,
    )
    zero = 10.0 ** (0.4 * 0.03 * rng.standard_normal()) * math.exp(TRUTH.brightness * rng.standard_normal())
    sun_e_s = 2.0e5 * 10.0 ** (0.4 * (26.90 + 0.0)) * ALBEDO / math.pi / FOCAL_PX**2  # I/F 1: pi of a radiance of F
    signal_dn = light * zero * sun_e_s * planned.exposure_s / GAIN
    recorder = Recorder(gain_e_per_dn=GAIN, read_noise_e=READ_E, bias_dn=100.0, saturation_dn=16_000.0)
    pixels = record(signal_dn, rng, recorder).pixels.astype(np.uint16)
    return Taken(planned.candidate.image(planned.exposure_s, pixels), position, float(signal_dn.max()))


def compare(plan: Plan, numbers: Sequence[int], seed: int) -> dict[str, Any]:
    """Images of a plan taken and estimated, beside what was predicted."""
    results: dict[str, Any] = {}
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in plan.options.estimators}
    peaks, started = [], time.process_time()
    for number in numbers:
        planned = plan.images[number]
        taken = take(planned, seed + number)
        assert planned.light is not None
        low, _, high = planned.light.quantiles_dn
        peaks.append(low <= taken.peak_dn <= high)
        for name in rows:
            fix = ESTIMATORS[name]().estimate(taken.image, plan.camera, planned.candidate.scene(plan.scene))
            forecast = planned.fixes[name]
            failed = isinstance(fix, Failure) or fix.flags.suspect
            row = {"failed": float(failed), "chance": forecast.failure_probability}
            if not isinstance(fix, Failure) and forecast.covariance is not None:
                stated = sum_parts(fix.parts)
                error = fix.center_px - CAMERA.model.project(taken.position_km)
                if isinstance(fix, PositionFix):
                    error = np.append(error, math.log(fix.range_km / np.linalg.norm(taken.position_km)))
                size = min(len(error), len(forecast.covariance))
                row["ratio"] = math.sqrt(np.trace(forecast.covariance[:2, :2]) / np.trace(stated[:2, :2]))
                for key, covariance in (("predicted", forecast.covariance), ("stated", stated)):
                    row[key] = float(error[:size] @ np.linalg.solve(covariance[:size, :size], error[:size]) / size)
            rows[name].append(row)
    for name, found in rows.items():
        good = [row for row in found if not row["failed"] and "ratio" in row]
        ratios, rate = np.array([row["ratio"] for row in good]), float(np.mean([row["failed"] for row in found]))
        results[name] = {
            "images": len(found),
            "failed": rate,
            "predicted": [round(float(value), 3) for value in np.percentile(ratios, [50, 5, 95])],
            "within": round(float(np.mean((ratios > 0.67) & (ratios < 1.5))), 3),
            "nees_predicted": round(float(np.mean([row["predicted"] for row in good])), 3),
            "nees_stated": round(float(np.mean([row["stated"] for row in good])), 3),
            "brier": round(float(np.mean([(row["chance"] - row["failed"]) ** 2 for row in found])), 3),
            "brier_constant": round(rate * (1.0 - rate), 3),
        }
    return {"peak": float(np.mean(peaks)), "cpu_s": round(time.process_time() - started, 1), "fixes": results}


def run(images: int, draws: int, seed: int, estimators: Sequence[str]) -> dict[str, Any]:
    """Plan images, take them, compare."""
    options = PlanOptions(exposures_s=EXPOSURES_S, estimators=tuple(estimators), draws=draws, seed=seed, truth=TRUTH)
    started = time.process_time()
    plan = plan_images(candidates(images, seed), CAMERA, scene(), None, options)
    assert isinstance(plan, Plan)
    planned_s = time.process_time() - started
    numbers = [number for number, image in enumerate(plan.images) if image.failure is None]
    return {"plan_cpu_s": round(planned_s, 1), **compare(plan, numbers, seed)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=300)
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--estimators", nargs="+", default=["cross_correlation"])
    arguments = parser.parse_args()
    print(json.dumps(run(arguments.images, arguments.draws, arguments.seed, arguments.estimators), indent=1))
