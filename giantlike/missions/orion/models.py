"""Section II: the measurement and error models compared with images of the package, with the constants of the paper."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from giantlike.cislunar.body_measurements import disk_diameter, range_from_disk_diameter, range_sigma
from giantlike.core.arrays import Float
from giantlike.missions.orion.constants import (
    EARTH_KM,
    FOOT_KM,
    MODEL,
    MOON_KM,
    ROUNDING,
    earth_errors,
    focal_px,
    moon_errors,
    table,
)
from giantlike.missions.orion.images import EstimatorErrors, ImagedScene, measure_errors, photograph
from giantlike.missions.replay import DERIVED, INDEPENDENT, Comparison, ReplaySettings, Stated

AXES = ("along the Sun", "across the Sun", "radius")
FAMILY = "ellipsoid_cra"  # the estimator of the flight software's family, by the Christian-Robinson algorithm
MOON_RANGES_KM, EARTH_RANGES_KM = (1e5, 2e5, 3.5e5), (2e5, 3.5e5)
RELIEF_RANGES_KM = (5e4, 1e5, 2e5)
PHASES_DEG, NEARLY_FULL_DEG = (30.0, 60.0, 90.0, 110.0), (5.0,)
DRAWS, SMALL_DRAWS = {"smooth Moon": 12, "Moon with relief": 6, "Earth": 8}, 2
"""Images at each range; a body with relief costs ten times as much."""
RELIEF_KM = 2.0  # root mean square of the made-up relief: the paper's variation of the terrain across the surface


def images_of_bodies(settings: ReplaySettings) -> dict[str, list[EstimatorErrors]]:
    """Errors of centers and radii of a smooth Moon, of one with relief, and of the Earth."""
    phases = NEARLY_FULL_DEG if settings.change == "nearly_full" else PHASES_DEG
    relief_km = 0.0 if settings.change == "smooth_moon" else RELIEF_KM
    plan = {
        "smooth Moon": ("Moon", MOON_RANGES_KM[2:] if settings.small else MOON_RANGES_KM, 0.0),
        "Moon with relief": ("Moon", RELIEF_RANGES_KM[2:] if settings.small else RELIEF_RANGES_KM, relief_km),
        "Earth": ("Earth", EARTH_RANGES_KM[1:] if settings.small else EARTH_RANGES_KM, 0.0),
    }
    views = [
        (
            name,
            ImagedScene(
                body=body,
                range_km=distance,
                phase_deg=phases[k % len(phases)],
                relief_km=relief,
                seed=settings.seed + k,
            ),
        )
        for name, (body, ranges, relief) in plan.items()
        for distance in ranges
        for k in range(SMALL_DRAWS if settings.small else DRAWS[name])
    ]
    found: dict[str, list[EstimatorErrors]] = {name: [] for name in plan}
    for done, (name, view) in enumerate(views):
        settings.progress("images of Moon and Earth", done, len(views))
        found[name].append(measure_errors(photograph(view), FAMILY))
    return found


def spread_px(results: Sequence[EstimatorErrors], range_km: float | None = None) -> Float:
    """Root mean square errors (3,), px, of fixes that are not suspect."""
    errors = [
        each.errors_px for each in results if not each.suspect and (range_km is None or each.view.range_km == range_km)
    ]
    return np.sqrt(np.mean(np.square(errors), axis=0)) if errors else np.full(3, np.inf)


def constants() -> list[Comparison]:
    """Eqs. 21 to 30: numbers of the paper by other numbers of the paper."""
    paper = table("paper")
    camera, terrain = paper["camera"], paper["terrain"]
    derived, arcsec = DERIVED, math.degrees(1.0 / focal_px()) * 3600.0
    relief_mm = camera["relief_focal_px"] * camera["pitch_um"] * 1e-3
    return [
        Stated("eq. 21", "tangent of a pixel", camera["tangent_per_px"], 1.0 / focal_px(), derived).near(
            ROUNDING, "4.8 um over 35.1 mm."
        ),
        Stated("eq. 21", "a pixel, arcsec", camera["arcsec_per_px"], arcsec, derived).near(
            ROUNDING, "The same in arcseconds."
        ),
        Stated(
            "eqs. 28-30", "focal length in the terrain terms, px", camera["relief_focal_px"], focal_px(), derived
        ).near(
            1e-4,
            f"Given to five digits, so asked for to 1e-4: 7291.7 px are {relief_mm:.2f} mm, "
            "not the 35.1 mm of eq. 21. The terrain term is 0.3 % low by it.",
        ),
        Stated(
            "eqs. 28-30", "variation of the terrain, km", terrain["relief_km"], terrain["relief_ft"] * FOOT_KM, derived
        ).near(ROUNDING, "6562 ft."),
    ]


def biases() -> list[Comparison]:
    """Eqs. 31 to 38: biases and noise of the paper as lengths, compared."""
    paper, derived = table("paper"), DERIVED
    moon, earth = moon_errors(), earth_errors(as_moon=False)
    lengths = {
        "moon radius": (33, moon.bias_px_km[2] / focal_px()),
        "moon center": (31, moon.bias_px_km[0] / focal_px()),
    }
    terrain = paper["terrain"]
    return [
        *(
            Stated(
                f"eq. {number}",
                f"{name} bias that shrinks with range, as a length at the body, km",
                terrain["relief_km"],
                length,
                derived,
            ).at_most(
                "The term over 7312.5 px. It is several times the terrain of 2 km that the text names as "
                "the cause: what was fitted to images of one side of the Moon stands for more than relief."
            )
            for name, (number, length) in lengths.items()
        ),
        Stated(
            "eq. 38",
            "altitude of the Earth's limb, km",
            paper["earth"]["limb_altitude_km"],
            paper["earth"]["limb_altitude_km"] + earth.bias_px_km[2] / focal_px(),
            derived,
        ).near(
            ROUNDING,
            "The bias of the radius that shrinks with range is a limb 7.9 km below the 35 km that were "
            "assumed; Artemis I then found some 25 km (Inman et al.).",
        ),
        Stated(
            "II.C",
            "noise of the Earth's limb against the Moon's",
            "the Moon's is more conservative",
            ", ".join(f"{e:g} < {m:g} px" for e, m in zip(earth.noise_px, moon.noise_px, strict=True)),
            derived,
        ).agrees(
            bool((earth.noise_px < moon.noise_px).all()),
            "Agrees where eqs. 34 to 36 are below the constants of eqs. 28 to 30, each.",
        ),
    ]


def range_errors(settings: ReplaySettings) -> list[Comparison]:
    """Eqs. 25 and 26 against ranges of drawn disk diameters."""
    rng, draws, kind = np.random.default_rng(settings.seed), 20_000, DERIVED
    found = []
    for name, radius_km, distance in (("Moon", MOON_KM, 2e5), ("Earth near entry", EARTH_KM, 3e4)):
        across = float(disk_diameter(distance, radius_km))
        diameter_px, sigma_px = focal_px() * across, 0.24
        drawn = range_from_disk_diameter(across + rng.normal(0.0, sigma_px, draws) / focal_px(), radius_km)
        ours = float(np.std(drawn))
        for equation, radius in ((25, radius_km), (26, 0.0)):
            paper = float(range_sigma(distance, radius, diameter_px, sigma_px))
            found.append(
                Stated(
                    f"eq. {equation}",
                    f"sigma of the range of the {name} at {distance:g} km by 0.24 px of diameter, km",
                    paper,
                    ours,
                    kind,
                ).near(
                    0.02,
                    "20,000 diameters with noise through eq. 11. "
                    + ("" if equation == 25 else "Eq. 26 leaves the radius out: near the Earth that shows."),
                )
            )
    return found


def image_comparisons(found: dict[str, list[EstimatorErrors]]) -> list[Comparison]:
    """Eqs. 28 to 36 compared with errors of the package's estimator on images of the independent renderer."""
    paper, kind = table("paper"), INDEPENDENT
    rows = []
    for name, body, equations in (("smooth Moon", "moon", (29, 30, 28)), ("Earth", "earth", (34, 35, 36))):
        ours = spread_px(found[name])
        rows += [
            Stated(
                f"eq. {equation}", f"{name}: error {axis}, px", paper[body]["noise_px"][k], ours[k], kind, "smooth_moon"
            ).near(
                MODEL,
                "Root mean square of a limb fit of the same family over made-up images of a smooth sphere. The "
                "paper's images have terrain, clouds or haze, and the flight fit its own edges: noise alone is not "
                "what limits them.",
            )
            for k, (axis, equation) in enumerate(zip(AXES, equations, strict=True))
        ]
    ratio = spread_px(found["smooth Moon"])
    rows.append(
        Stated(
            "eqs. 29, 30", "errors along over across the Sun", 0.15 / 0.06, ratio[0] / ratio[1], kind, "nearly_full"
        ).near(MODEL, "The lit limb is less than half of the outline, so the center is told better across the Sun.")
    )
    model = moon_errors()
    for distance in sorted({each.view.range_km for each in found["Moon with relief"]}):
        ours, stated_px = spread_px(found["Moon with relief"], distance), model.sigmas_px(distance)
        rows += [
            Stated(
                "eqs. 28-30",
                f"Moon with 2 km of relief at {distance:g} km: error {axis}, px",
                stated_px[k],
                ours[k],
                kind,
                "smooth_moon",
            ).near(
                MODEL,
                "Bumps of 2 km rms, estimator told a sphere. A limb averages over many bumps where the model "
                "takes the whole relief as the error; the share that remains depends on how wide the bumps are.",
            )
            for k, axis in enumerate(AXES)
        ]
    return rows
