"""Attitudes from the limb of one rock: the turn about the line of sight, and all three angles, over many draws.

Images come from ``giantlike.independent``, which shares no code with the estimator (``stress_truth.py``). Each draw has
its own noise and its own errors of attitude, ephemeris and, where a case says so, pole and spin; their sigmas are told.
The fix becomes an observable and that an attitude, as ``giantlike export --pointing bodies`` makes it. Printed are, by
case, squared errors over covariances per degree of freedom (NEES) of the turn and of the attitude, and sigmas.

    python benchmarks/roll.py [--views 8] [--draws 6] [--only NAME]
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from stress_truth import READ_NOISE_DN, Case, Seen, view_of

from giantlike.core.arrays import Float, unit
from giantlike.core.outcomes import Failure, PositionFix
from giantlike.ephemeris import ApparentGeometry
from giantlike.gauntlet.bodies import TOLD_LAWS
from giantlike.image import Image
from giantlike.independent import Recorder, record
from giantlike.observables import ImageContext, Sighting, row_of_body
from giantlike.observables.pointing import Pointing, pointing_from_bodies
from giantlike.relative import LimbMatching
from giantlike.scene import Scene, Target, TargetUncertainty

ACROSS_DEG, ROLL_DEG = 0.02, 0.4
"""One sigma of the a priori attitude across the axis of the camera and about it, deg."""
EPHEMERIS_PX = 1.0
"""One sigma per axis of the ephemeris of the body, px at its range."""

_ROCK = Case(name="exact", body="rock")
CASES = (
    _ROCK,
    replace(_ROCK, name="300 px", diameter_px=300.0, phases_deg=(30.0, 90.0)),
    replace(_ROCK, name="relief 1 % not in the model", relief=0.01),
    replace(_ROCK, name="reflectance of another law", law="lommel_seeliger"),
    replace(_ROCK, name="pole and spin 0.2 deg off", pole_error_deg=0.2),
    replace(_ROCK, name="ellipsoid", body="ellipsoid", phases_deg=(15.0, 60.0)),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """One draw: squared errors over variances, and sigmas."""

    suspect: bool
    turn_nees: float | None = None
    turn_sigma_deg: float | None = None
    nees: float | None = None
    about_sight: float | None = None
    roll_sigma_deg: float | None = None
    roll_error_deg: float | None = None
    """Of the attitude found, about the line of sight."""


def drawn(seen: Seen, seed: int) -> tuple[Image, Scene, Float]:
    """Image and scene as they are told, and the rotation (3,) by which the told attitude is off, rad."""
    rng = np.random.default_rng([seen.number, seed, 3141])
    shot = record(seen.signal_dn, rng, Recorder(read_noise_e=READ_NOISE_DN))
    prior = np.radians([ACROSS_DEG, ACROSS_DEG, ROLL_DEG])
    off = rng.normal(0.0, prior)
    true_km, back = seen.position_camera_km, seen.attitude.inv()
    sigma_km = EPHEMERIS_PX * float(np.linalg.norm(true_km)) / seen.camera.model.fx_px
    pole_rad = math.radians(seen.case.pole_error_deg)
    wrong = pole_rad * rng.normal(size=3)
    geometry = ApparentGeometry(
        position_inertial_km=back.apply(true_km + rng.normal(0.0, sigma_km, 3)),
        inertial_from_body=back * seen.camera_from_body * Rotation.from_rotvec(-wrong),
        sun_direction_inertial=back.apply(seen.sun),
    )
    target = Target(
        name="BODY",
        shape=seen.shape,
        ephemeris=geometry,
        reflectance=TOLD_LAWS[seen.case.told_law],
        uncertainty=TargetUncertainty(pole_rad=pole_rad, spin_rad=pole_rad, ephemeris_km=sigma_km),
    )
    image = Image(
        pixels=shot.pixels.astype(np.float32),
        camera_from_inertial=Rotation.from_rotvec(-off) * seen.attitude,
        attitude_covariance_rad2=np.diag(prior**2),
        name=f"{seen.case.name} {seen.number} {seed}",
    )
    return image, Scene(targets=(target,)), off


def outcome(seen: Seen, seed: int) -> Outcome | None:
    """Fix, observable and attitude of a draw; None where there is no fix."""
    image, scene, off = drawn(seen, seed)
    fix = LimbMatching().estimate(image, seen.camera, scene)
    if isinstance(fix, Failure):
        return None
    if fix.flags.suspect:
        return Outcome(suspect=True)
    found = attitude(seen, image, scene, fix)
    error = (seen.attitude * found.camera_from_inertial.inv()).as_rotvec()
    sight = unit(seen.position_camera_km)
    about = float(sight @ error), math.sqrt(float(sight @ found.covariance_rad2 @ sight))
    turn = fix.turn
    turn_error, sigma = 0.0, math.nan
    if turn is not None:
        known = seen.camera_from_body.as_matrix() * math.radians(seen.case.pole_error_deg)
        by_body = turn.by_rotation[2] @ known
        sigma = math.sqrt(float(turn.covariance[2, 2] + by_body @ by_body))
        turn_error = turn.turn_rad - float(turn.by_rotation[2] @ off)
    return Outcome(
        suspect=False,
        turn_nees=None if turn is None else (turn_error / sigma) ** 2,
        turn_sigma_deg=None if turn is None else math.degrees(sigma),
        nees=float(error @ np.linalg.solve(found.covariance_rad2, error)),
        about_sight=(about[0] / about[1]) ** 2,
        roll_sigma_deg=math.degrees(about[1]),
        roll_error_deg=math.degrees(about[0]),
    )


def attitude(seen: Seen, image: Image, scene: Scene, fix: PositionFix) -> Pointing:
    """Attitude of an image by the row of its fix."""
    geometry = scene.geometry(image, "BODY")
    assert not isinstance(geometry, Failure)
    assert image.camera_from_inertial is not None
    context = ImageContext(
        file=image.name,
        camera=seen.camera,
        shared_camera="stress",
        camera_from_inertial=image.camera_from_inertial,
        attitude_source="a_priori",
        attitude_covariance_rad2=image.attitude_covariance_rad2,
    )
    sighting = Sighting(
        predicted_camera_km=geometry.position_camera_km,
        camera_from_body=geometry.camera_from_body,
        sun_direction_camera=geometry.sun_direction_camera,
        uncertainty=geometry.target.uncertainty,
    )
    found = pointing_from_bodies(seen.camera, [row_of_body(context, sighting, fix, is_preferred=True)])
    assert isinstance(found, Pointing)
    return found


def summary(case: Case, outcomes: list[Outcome | None]) -> dict[str, object]:
    """Figures of a case."""
    good = [one for one in outcomes if one is not None and not one.suspect]
    turned = [one for one in good if one.turn_nees is not None]

    def mean(values: list[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return round(float(np.mean(known)), 3) if known else None

    def median(values: list[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return round(float(np.median(np.abs(known))), 4) if known else None

    return {
        "case": case.name,
        "draws": len(outcomes),
        "no fix": sum(one is None for one in outcomes),
        "suspect": sum(one is not None and one.suspect for one in outcomes),
        "with a turn": len(turned),
        "turn NEES": mean([one.turn_nees for one in turned]),
        "attitude NEES/3": None if not good else round((mean([one.nees for one in good]) or 0.0) / 3.0, 3),
        "roll NEES": mean([one.about_sight for one in good]),
        "turn sigma deg, median": median([one.turn_sigma_deg for one in turned]),
        "roll sigma deg, median": median([one.roll_sigma_deg for one in good]),
        "roll error deg, median": median([one.roll_error_deg for one in good]),
    }


def main() -> None:
    """Print the figures of all cases, a line of JSON each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, default=8, help="views of each case: bodies, poses, phases")
    parser.add_argument("--draws", type=int, default=6, help="draws of each view")
    parser.add_argument("--only", help="name of one case")
    options = parser.parse_args()
    for case in CASES:
        if options.only in (None, case.name):
            seen = [view_of(case, number) for number in range(options.views)]
            outcomes = [outcome(one, seed) for one in seen for seed in range(options.draws)]
            print(json.dumps(summary(case, outcomes)), flush=True)


if __name__ == "__main__":
    main()
